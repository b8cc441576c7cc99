"""Actuators: controls follow commands with a lag, within a largest rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vehsim
from vehsim.errors import InputError
from vehsim.vehicles.definition.actuator import Actuator
from vehsim.vehicles.definition.commands import Actuated, follow, respond

BARE = ("helicopter_lie", "car_lie", "boat_lie", "snakeboard_lie")


def test_a_step_of_the_command_is_followed_exponentially():
    lag, h, position = Actuator(lag=0.2), 1 / 240, 0.0
    for k in range(1, 100):
        position = respond(lag, position, 1.0, 1.0, h)
        assert position == pytest.approx(1 - np.exp(-k * h / 0.2), abs=1e-14)


def test_a_ramp_is_followed_behind_by_the_lag_whatever_the_step():
    lag = Actuator(lag=0.2)
    for h in (0.5, 0.05, 0.001):
        position = respond(lag, -0.2 * 3.0, 0.0, 3.0 * h, h)
        assert position == pytest.approx(3.0 * (h - 0.2), abs=1e-14)


def test_the_rate_is_a_bound_and_an_ideal_actuator_follows_at_once():
    assert respond(Actuator(rate=2.0), 0.0, 1.0, 1.0, 0.1) == pytest.approx(0.2)
    assert respond(Actuator(rate=2.0, lag=1e-3), 1.0, -5.0, -5.0, 0.1) == pytest.approx(0.8)
    assert respond(Actuator(rate=2.0), 0.0, 0.1, 0.1, 0.1) == 0.1
    assert respond(Actuator(), 3.0, 0.0, 0.7, 0.1) == 0.7


def test_the_response_converges_to_the_differential_equation():
    actuator = Actuator(rate=1.5, lag=0.15)
    command = lambda t: np.sin(5 * t) + 0.3 * np.sin(31 * t)  # beyond the rate at times

    def law(t, a):
        return np.clip((command(t) - a) / actuator.lag, -actuator.rate, actuator.rate)

    true = solve_ivp(law, (0, 2), [0.0], rtol=1e-10, atol=1e-12, max_step=1e-3).y[0, -1]
    errors = []
    for h in (1 / 120, 1 / 240, 1 / 480):
        position = 0.0
        for k in range(round(2 / h)):
            position = respond(actuator, position, command(k * h), command((k + 1) * h), h)
        errors.append(abs(position - true))
    assert errors[-1] < 2e-3 and errors[0] / errors[-1] > 2.5


def test_a_table_and_a_law_are_followed_alike():
    car = vehsim.load_vehicle("car")
    h, commands = 1 / 240, np.cumsum(np.random.default_rng(5).normal(size=(200, 2)) * [400.0, 0.3], axis=0)
    law = Actuated(car, lambda t, state: commands[round(t / h)])
    followed = np.array([law(k * h, vehsim.State()) for k in range(len(commands))])
    assert np.allclose(followed, follow(car, commands, h), rtol=0, atol=1e-9)
    assert np.array_equal(np.array(law.commands), commands)
    assert (np.abs(np.diff(followed, axis=0)) <= np.array([11000.0, 8.0]) * h * (1 + 1e-9)).all()
    assert np.abs(np.diff(followed[:, 1])).max() == pytest.approx(8.0 * h)


@pytest.mark.parametrize("name", ["car", "helicopter"])
def test_a_simulation_moves_as_its_actuators_do(name):
    vehicle = vehsim.load_vehicle(name)
    rest = [0.0, 0.0] if name == "car" else [18639.0, 0.0, 0.0, 0.0]
    step = np.array([rest, *[[rest[0] + 1000.0, *rest[1:]]] * 48])
    start = vehsim.State(position=(0, 0, 50))
    clip = vehsim.simulate(vehicle, None, step, start=start, step=1 / 24)
    again = vehsim.simulate(vehicle, None, clip.controls, start=start, step=1 / 24, actuators=False)
    bare = vehsim.simulate(vehicle, None, step, start=start, step=1 / 24, actuators=False)
    assert np.array_equal(clip.commands[vehicle.control_names[0]], step[:, 0])
    assert np.array_equal(clip.positions, again.positions) and not again.commands
    # a constant force that is late by a lag T moves it by a (t T - T^2) less in t, at a speed of a t
    speed = abs(bare.twists[-1, 1 if name == "car" else 5])
    late, lag = np.linalg.norm(bare.positions[-1] - clip.positions[-1]) / speed, vehicle.controls[0].actuator.lag
    assert late == pytest.approx(lag - lag**2 / clip.duration, rel=0.01)


def test_commands_are_saved_and_resampled_with_a_clip(tmp_path):
    clip = vehsim.simulate(vehsim.load_vehicle("car"), None, lambda t, s: (500 * np.sin(t), 0.0), duration=1.0)
    loaded = vehsim.Clip.load(clip.save(tmp_path / "clip"))
    assert np.array_equal(loaded.commands["torque"], clip.commands["torque"])
    frames = clip.resample()
    assert np.allclose(frames.commands["torque"], 500 * np.sin(frames.times), atol=1e-9)


@pytest.mark.parametrize("name", vehsim.vehicles.available())
def test_shipped_actuators_are_slower_than_no_character_and_have_a_source(name):
    vehicle = vehsim.load_vehicle(name)
    if name in BARE:
        assert not vehicle.actuated
        return
    for control in vehicle.controls if vehicle.actuated else ():
        assert control.actuator.source and 0 < control.actuator.lag < 1
        trait = vehicle.character.control_rates.get(control.name)
        assert trait is None or control.actuator.rate > trait.brisk


@pytest.mark.parametrize("name", BARE)
def test_bare_models_are_their_bases_without_actuators(name):
    bare, base = vehsim.load_vehicle(name), vehsim.load_vehicle(name.removesuffix("_lie"))
    assert (
        bare.rig.asset.resolve() == base.rig.asset.resolve()
        and bare.rig.drives == base.rig.drives
        and bare.name == name
    )
    at_once = [replace(c, actuator=Actuator()) for c in base.controls]
    others = [a.name for a, b in zip(at_once, bare.controls, strict=True) if a != replace(b, actuator=Actuator())]
    assert others == (["yaw"] if name == "helicopter_lie" else [])  # that of the papers balances no torque of a rotor
    assert base.actuated


def test_actuators_can_be_replaced():
    car = vehsim.load_vehicle("car", {"actuators": {"torque": {"rate": 500.0}}})
    torque, steering = (control.actuator for control in car.controls)
    assert (torque.rate, torque.lag) == (500.0, 0.1) and steering.rate == 8.0
    with pytest.raises(InputError, match=r"parameters\.actuators\.torque\.lag"):
        vehsim.load_vehicle("car", {"actuators": {"torque": {"lag": -1.0}}})
    with pytest.raises(InputError, match=r"actuators\.throttle"):
        vehsim.load_vehicle("car", {"actuators": {"throttle": {"lag": 1.0}}})


def test_a_base_gives_what_a_file_does_not(tmp_path):
    def write(name, text):
        (tmp_path / name).mkdir()
        (tmp_path / name / "vehicle.toml").write_text(text)

    write("one", 'model = "rigid_body"\n[physics]\nmass = 2.0\ninertia = [1.0, 1.0, 1.0]\n')
    write("two", 'base = "../one"\nmodel = "rigid_body"\n[physics]\nmass = 3.0\n')
    write("three", 'base = "../two"\nmodel = "rigid_body"\n')
    two = vehsim.load_vehicle(tmp_path / "two")
    assert np.allclose(np.diag(two.inertia), [1, 1, 1, 3, 3, 3])
    (tmp_path / "one" / "vehicle.toml").write_text(
        'model = "rigid_body"\n[physics]\nmass = 2.0\ninertia = [4.0, 4.0, 4.0]\n'
    )
    assert np.allclose(np.diag(vehsim.load_vehicle(tmp_path / "two").inertia), [4, 4, 4, 3, 3, 3])
    with pytest.raises(InputError, match="base"):
        vehsim.load_vehicle(tmp_path / "three")
    write("as_one", 'base = "../one"\nphysics.mass = 5.0\n')
    assert np.allclose(np.diag(vehsim.load_vehicle(tmp_path / "as_one").inertia), [4, 4, 4, 5, 5, 5])
    write("bare", "")
    with pytest.raises(InputError, match=r'bare.vehicle\.toml: model: missing; .* base = "../car"'):
        vehsim.load_vehicle(tmp_path / "bare")
    write("of_bare", 'base = "../bare"\n')
    with pytest.raises(InputError, match=r"model: missing, also in the base; .*bare/vehicle.toml"):
        vehsim.load_vehicle(tmp_path / "of_bare")
    write("four", 'base = "../none"\nmodel = "rigid_body"\n')
    with pytest.raises(InputError, match="none"):
        vehsim.load_vehicle(tmp_path / "four")
