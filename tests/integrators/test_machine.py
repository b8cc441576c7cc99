"""Machine code, fleets, and states that share rows: each gives the same motion as one step at a time."""

import copy
import pickle
import threading
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError, SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.fast import kernel
from vehsim.integrators.fast.kernel import Kernel
from vehsim.runtime import machine_code
from vehsim.runtime.machine_code import MachineCode
from vehsim.vehicles import State
from vehsim.vehicles.models.snakeboard import snakeboard

H = 1 / 120
CASES = {
    "helicopter": (State(twist=(0.1, 0.2, 0.3, 1, 2, 3)), lambda t: (18639 + 900 * np.sin(t), 50 * t, 0.02, 0 * t)),
    "car": (State(twist=(0, 5.0, 0)), lambda t: (900 * np.sin(2 * t), 0.3 * np.cos(t))),
}


@pytest.fixture(autouse=True)
def empty_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "cache"))


def fresh(name):
    """A vehicle without cached functions."""
    return replace(vehsim.load_vehicle(name))


def table(name, n):
    t = H * np.arange(n + 1)
    return np.column_stack([np.broadcast_to(column, t.shape) for column in CASES[name][1](t)])


def same(clip, other):
    for field in ("positions", "orientations", "twists", "joints", "joint_rates"):
        np.testing.assert_array_equal(getattr(clip, field), getattr(other, field))
    for group in ("channels", "energy"):
        assert getattr(clip, group).keys() == getattr(other, group).keys()
        for key, values in getattr(clip, group).items():
            np.testing.assert_array_equal(values, getattr(other, group)[key])


def test_a_long_step_by_machine_code_falls_back_too():
    start, controls = State(twist=(0.4, 3.0, 0.3, 1, 0, 0)), np.tile([18639.0, 0, 0, 0], (40, 1))
    plain = Integrator(fresh("helicopter"), 0.2, "exp").rollout(start, controls)
    same(Integrator(fresh("helicopter"), 0.2, "exp", compiled=True).rollout(start, controls), plain)


@pytest.mark.parametrize("name", CASES)
def test_machine_code_gives_the_same_bits(name):
    """From the first step, and from the first one that is worth it."""
    vehicle, (start, _), controls = fresh(name), CASES[name], table(name, 600)
    plain = Integrator(vehicle, H).rollout(start, controls)
    fast = Integrator(vehicle, H, compiled=True)
    assert fast.compiled and not Integrator(vehicle, H).compiled
    same(fast.rollout(start, controls), plain)
    motion, state = fast.stepper(start, controls[0]), start
    for k in range(20):
        motion.controls[:] = controls[k + 1]
        motion.step()
        state = fast.step(state, controls[k], controls[k + 1])
    for reached in (motion.state(), state):
        np.testing.assert_allclose(reached.position, plain.positions[20], atol=1e-11)
    own = fresh(name)
    long = Integrator(own, H).rollout(start, np.tile(controls, (1 + kernel.WORTH // len(controls), 1)))
    np.testing.assert_array_equal(long.positions[:601], plain.positions)


def small():
    x = ca.SX.sym("x", 2)
    return ca.Function("f", [x], [ca.vertcat(x[0] + ca.sin(x[1]), x[1])])


def evaluated(k, rows):
    out = np.empty_like(rows)
    k.rows([rows], [out])
    return out


def test_rows_become_machine_code_when_that_is_worth_it(monkeypatch):
    """All kernels of a function share it; one whose result differs from the interpreter's is not used."""
    rows = np.random.default_rng(0).normal(size=(kernel.WORTH - 1, 2))
    function = small()
    own, other = Kernel(function), Kernel(function)
    expected = evaluated(own, rows)
    np.testing.assert_allclose(expected, np.column_stack([rows[:, 0] + np.sin(rows[:, 1]), rows[:, 1]]), rtol=1e-15)
    assert not own.compiled
    evaluated(own, rows[:1])
    assert own.compiled and other.compiled and not Kernel(small()).compiled
    np.testing.assert_array_equal(evaluated(other, rows), expected)
    np.testing.assert_array_equal(np.ravel(own(rows[5])), expected[5])

    wrong = Kernel(small())
    monkeypatch.setattr(MachineCode, "rows", lambda self, inputs, outputs: [out.fill(1.0) for out in outputs])
    for _ in range(3):
        np.testing.assert_array_equal(evaluated(wrong, rows), expected)
    assert not wrong.compiled


def test_machine_code_of_another_process_is_found_earlier():
    rows = np.random.default_rng(0).normal(size=(kernel.KNOWN, 2))
    first = Kernel(small())
    expected = evaluated(first, rows)
    assert not first.compiled
    kernel._evaluations(small()).build()  # as that process does
    second = Kernel(small())
    evaluated(second, rows[:-1])
    assert not second.compiled
    evaluated(second, rows[:1])
    assert second.compiled
    np.testing.assert_array_equal(evaluated(second, rows), expected)


def test_wrong_code_in_the_cache_is_not_used_and_built_again():
    """That of another function, stored under this one's key."""
    x = ca.SX.sym("x", 2)
    other = ca.Function("f", [x], [x + 1])
    key = machine_code.code_key(small())
    MachineCode(other, key)
    rows = np.random.default_rng(0).normal(size=(kernel.WORTH, 2))
    own = Kernel(small())
    expected = np.column_stack([rows[:, 0] + np.sin(rows[:, 1]), rows[:, 1]])
    np.testing.assert_allclose(evaluated(own, rows[: kernel.KNOWN]), expected[: kernel.KNOWN], rtol=1e-15)
    assert not own.compiled
    np.testing.assert_allclose(evaluated(own, rows), expected, rtol=1e-15)
    assert own.compiled
    found = np.empty_like(rows)
    MachineCode.recalled(key).rows([rows[None]], [found[None]])
    np.testing.assert_array_equal(found, evaluated(own, rows))


@pytest.mark.parametrize("name", CASES)
def test_steps_one_by_one_become_machine_code_too(name, monkeypatch):
    """In place, and from state to state, unless they are short, as those of a car."""
    vehicle, start, controls = fresh(name), CASES[name][0], table(name, 60)
    integrator = Integrator(vehicle, H)
    plain = integrator.rollout(start, controls)
    monkeypatch.setattr(kernel, "WORTH", 20)
    integrator = Integrator(fresh(name), H)
    motion, state = integrator.stepper(start, controls[0]), start
    for k in range(60):
        if k == 40:
            for thread in threading.enumerate():  # machine code is built aside
                if thread is not threading.current_thread() and not thread.daemon:
                    thread.join()
        motion.controls[:] = controls[k + 1]
        motion.step()
        state = integrator.step(state, controls[k], controls[k + 1])
    assert motion._kernel.compiled == (name == "helicopter") and integrator._public._kernel.compiled
    np.testing.assert_array_equal(motion.state().position, plain.positions[60])
    np.testing.assert_allclose(state.position, plain.positions[60], atol=1e-11)


@pytest.mark.parametrize("error", [ImportError, OSError])
def test_without_llvm_the_interpreter_stays(error, monkeypatch):
    """It is not installed, or its library cannot be loaded."""
    start, controls = CASES["car"][0], table("car", 20)
    plain = Integrator(fresh("car"), H).rollout(start, controls)

    def fails():
        raise error("llvmlite")

    monkeypatch.setattr(machine_code, "_llvm", fails)
    kernel._warn_once.cache_clear()
    with pytest.warns(UserWarning, match="no machine code: .*llvmlite"):
        without = Integrator(fresh("car"), H, compiled=True)
    assert not without.compiled
    same(without.rollout(start, controls), plain)


@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_vehicles_side_by_side_move_as_they_do_one_by_one(name, compiled):
    vehicle, n, m = fresh(name), 300, 5
    integrator = Integrator(vehicle, H, compiled=compiled)
    states = [replace(CASES[name][0], position=(float(j), 2.0, 3.0)) for j in range(m)]
    controls = table(name, n) * np.linspace(0.5, 1.0, m)[:, None, None]
    clips = integrator.rollouts(states, controls, threads=2)
    for clip, state, rows in zip(clips, states, controls, strict=True):
        same(clip, integrator.rollout(state, rows))
    fleet = integrator.fleet(states, controls[:, 0], threads=2)
    fleet.advance(controls[:, 1:101])
    phases = fleet.advance(controls[:, 101:])
    assert phases.shape[:2] == (m, n - 99) and fleet.g.shape == (m, vehicle.group.size)
    for clip, state in zip(clips, fleet.states(), strict=True):
        np.testing.assert_allclose(state.position, clip.positions[-1], atol=1e-10)
        np.testing.assert_allclose(state.twist, clip.twists[-1], atol=1e-10)


def test_fleets_check_ranks_and_name_wrong_controls():
    board = snakeboard(mass=70.0, half_length=0.35, rotor_inertia=2.0, steering_inertia=0.1)
    integrator = Integrator(board, 0.015)
    through = State(twist=(0, 1.0, 0), joints=(0, 1.2), joint_rates=(0, 1.0))
    with pytest.raises(SolveError, match="constraints lose rank"):
        integrator.fleet([State(joints=(0.0, 0.1)), through]).advance(np.zeros((60, 2)))
    with pytest.raises(SolveError, match="constraints lose rank"):
        integrator.rollouts([through], np.zeros((60, 2)))
    for wrong in (np.zeros((3, 60, 2)), np.zeros(2), np.full((60, 2), np.nan), np.zeros((0, 2))):
        with pytest.raises(InputError, match="controls: shape"):
            integrator.rollouts([State(), State()], wrong)


@pytest.mark.parametrize("name", CASES)
def test_a_state_from_a_step_may_be_changed_copied_and_sent(name):
    """`step` returns states whose fields share a row; changes of them must take effect."""
    integrator, c = Integrator(fresh(name), H), table(name, 0)[0]
    state = integrator.step(integrator.step(CASES[name][0], c), c)
    plain = State(*(np.array(getattr(state, f)) for f in ("position", "orientation", "twist", "joints", "joint_rates")))
    moved = integrator.step(replace(plain, position=plain.position + np.array([5.0, 0, 0])), c)
    state_moved, deep, sent = (f(state) for f in (copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))))
    for other in (deep, sent, replace(state, position=state.position.copy()), state_moved):
        other.position[0] += 5
        np.testing.assert_array_equal(integrator.step(other, c).position, moved.position)
