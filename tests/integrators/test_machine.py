"""Machine code, fleets, and states that share rows: each gives the same motion as one step at a time."""

import copy
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError, SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.fast import machine
from vehsim.vehicles import State
from vehsim.vehicles.models.snakeboard import snakeboard

H = 1 / 120
CASES = {
    "helicopter": (State(twist=(0.1, 0.2, 0.3, 1, 2, 3)), lambda t: (18639 + 900 * np.sin(t), 50 * t, 0.02, 0 * t)),
    "car": (State(twist=(0, 5.0, 0)), lambda t: (900 * np.sin(2 * t), 0.3 * np.cos(t))),
}
needs_compiler = pytest.mark.skipif(machine.compiler() is None, reason="no C compiler")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    machine._warn_once.cache_clear()
    return tmp_path / "machine-code"


def fresh(name):
    """A vehicle without cached functions."""
    return replace(vehsim.load_vehicle(name))


def table(name, n):
    t = H * np.arange(n + 1)
    return np.column_stack([np.broadcast_to(column, t.shape) for column in CASES[name][1](t)])


def same(clip, other, atol=1e-11):
    for field in ("positions", "orientations", "twists", "joints", "joint_rates"):
        np.testing.assert_allclose(getattr(clip, field), getattr(other, field), rtol=1e-11, atol=atol)
    for group in ("channels", "energy"):
        assert getattr(clip, group).keys() == getattr(other, group).keys()
        for key, values in getattr(clip, group).items():
            np.testing.assert_allclose(values, getattr(other, group)[key], rtol=1e-9, atol=1e-6)


@needs_compiler
@pytest.mark.parametrize("name", CASES)
def test_machine_code_gives_the_same_motion_and_is_cached(name, cache):
    vehicle, (start, _), controls = fresh(name), CASES[name], table(name, 300)
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
    built = {path: path.stat().st_mtime_ns for path in cache.iterdir()}
    assert len(built) >= 3 and all(path.suffix == ".so" for path in built)  # step, clip, public step, ...
    again = Integrator(fresh(name), H, compiled=True)
    same(again.rollout(start, controls), plain)
    assert {path: path.stat().st_mtime_ns for path in cache.iterdir()} == built


@needs_compiler
def test_a_spoilt_library_is_built_again_and_long_steps_fall_back(cache):
    start, controls = State(twist=(0.4, 3.0, 0.3, 1, 0, 0)), np.tile([18639.0, 0, 0, 0], (40, 1))
    plain = Integrator(fresh("helicopter"), 0.2, "exp").rollout(start, controls)
    for _ in range(2):
        same(Integrator(fresh("helicopter"), 0.2, "exp", compiled=True).rollout(start, controls), plain, atol=1e-8)
        for path in cache.iterdir():  # not truncated in place: it may be mapped
            path.unlink()
            path.write_bytes(b"\x7fELF cut short")


def test_missing_and_broken_compilers_warn(monkeypatch, tmp_path):
    start, controls = CASES["car"][0], table("car", 20)
    plain = Integrator(fresh("car"), H).rollout(start, controls)
    monkeypatch.setattr(machine, "compiler", lambda: None)
    with pytest.warns(UserWarning, match="no C compiler: set CC"):
        without = Integrator(fresh("car"), H, compiled=True)
    assert not without.compiled
    same(without.rollout(start, controls), plain)
    monkeypatch.setattr(machine, "compiler", lambda: [shutil.which("false") or "false"])
    with pytest.warns(UserWarning, match="cannot build here"):
        without = Integrator(fresh("car"), H, compiled=True)
    assert not without.compiled
    same(without.rollout(start, controls), plain)


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
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


@needs_compiler
@pytest.mark.parametrize("what", ["folder", "above", "library", "link"])
def test_machine_code_that_others_can_write_is_not_run(what, cache, recwarn):
    """A folder of other users is not used; a library in ours is built again."""
    start, controls = State(twist=(0, 5.0, 0)), table("car", 10)
    plain = Integrator(fresh("car"), H).rollout(start, controls)
    same(Integrator(fresh("car"), H, compiled=True).rollout(start, controls), plain)
    assert cache.stat().st_mode & 0o077 == 0
    for path in list(cache.iterdir()):
        evil = path.with_name("evil.so")
        shutil.copy(path, evil)
        path.unlink()
        if what == "link":
            path.symlink_to(evil)
        else:
            path.write_bytes(b"not what was built")
            path.chmod(0o666 if what == "library" else 0o600)
    before = {path: path.read_bytes() for path in cache.iterdir()}
    cache.chmod(0o777 if what == "folder" else 0o700)
    cache.parent.chmod(0o777 if what == "above" else 0o700)
    again = Integrator(fresh("car"), H, compiled=True)
    same(again.rollout(start, controls), plain)
    texts = [str(w.message) for w in recwarn if "other users can write" in str(w.message)]
    if what in ("folder", "above"):
        assert len(texts) == 1 and f"chmod go-w {cache if what == 'folder' else cache.parent}," in texts[0]
        assert {path: path.read_bytes() for path in cache.iterdir()} == before
    else:
        libraries = [path for path in cache.iterdir() if path.name != "evil.so"]
        assert not texts and all(not path.is_symlink() and path.stat().st_mode & 0o077 == 0 for path in libraries)
