"""simulate: controls in every form, frames on knots, wind, ground, and wrong input named."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.simulation import simulate
from vehsim.vehicles import State
from vehsim.vehicles.models.helicopter import helicopter
from vehsim.world.terrain.terrain import Terrain

HOVER = np.array([1900 * 9.81, 0.0, 0.0, 0.0])


@dataclass
class Field:
    """The part of a world that simulate uses."""

    wind: tuple = (0.0, 0.0, 0.0)
    terrain: object = None


@pytest.fixture
def heli():
    return vehsim.load_vehicle("helicopter_lie")


@pytest.fixture
def car():
    return vehsim.load_vehicle("car_lie")


def test_constant_array_and_function_agree(heli):
    start = State(position=(0, 0, 30), twist=(0, 0, 0.1, 5, 0, 0))
    hold = np.array([19000.0, 100.0, 0.02, 0.01])
    clips = [
        simulate(heli, None, hold, start, duration=1.0),
        simulate(heli, None, np.tile(hold, (7, 1)), start, duration=1.0),
        simulate(heli, None, lambda t, state: hold, start, duration=1.0),
    ]
    for clip in clips[1:]:
        np.testing.assert_allclose(clip.positions, clips[0].positions, atol=1e-10)
        np.testing.assert_allclose(clip.controls, clips[0].controls, atol=1e-10)


def test_a_function_of_time_replays_as_knot_controls(car):
    def law(t, state):
        return np.array([500 * np.cos(t), 0.3 * np.sin(t) - 0.1 * state.twist[1] * 0])

    flown = simulate(car, None, law, State(twist=(0, 5, 0)), duration=2.0)
    replayed = simulate(car, None, flown.controls, State(twist=(0, 5, 0)), duration=2.0)
    np.testing.assert_allclose(replayed.positions, flown.positions, atol=1e-10)
    np.testing.assert_allclose(flown.controls[:, 0], 500 * np.cos(flown.times), atol=1e-9)


def test_feedback_is_second_order_and_called_once_a_knot_in_order():
    """A spring and damper on height, against the closed form of the damped oscillator."""
    heli = vehsim.load_vehicle("helicopter_lie")
    mass, times = 1900.0, []

    def law(t, state):
        times.append(t)
        return [mass * (9.81 - 4 * state.position[2] - 1 * state.twist[5]), 0, 0, 0]

    errors = []
    for step in (1 / 48, 1 / 96):
        times.clear()
        clip = simulate(heli, None, law, State(position=(0, 0, 1)), duration=3.0, step=step)
        np.testing.assert_allclose(times, clip.times, atol=1e-12)
        w, t = np.sqrt(4 - 0.25), clip.times
        exact = np.exp(-t / 2) * (np.cos(w * t) + 0.5 / w * np.sin(w * t))
        errors.append(np.abs(clip.positions[:, 2] - exact).max())
    assert errors[0] < 2e-3 and errors[0] / errors[1] == pytest.approx(4, rel=0.2)


def test_array_is_spread_over_the_duration_and_linear_between(heli):
    clip = simulate(heli, None, [HOVER, HOVER * 1.1, HOVER], duration=2.0)
    np.testing.assert_allclose(clip.controls[:, 0], HOVER[0] * (1.1 - 0.1 * np.abs(clip.times - 1)), rtol=1e-12)
    by_rows = simulate(heli, None, np.tile(HOVER, (241, 1)))
    assert by_rows.duration == pytest.approx(1.0)


@pytest.mark.parametrize("fps", [24, 25, Fraction(24000, 1001), "30000/1001", 23.976, 60])
@pytest.mark.parametrize("step", [1 / 240, 0.01, 0.3])
def test_every_frame_falls_on_a_knot(car, fps, step):
    clip = simulate(car, None, [100, 0], duration=1.1, step=step, fps=fps)
    assert np.diff(clip.times).max() <= min(step, float(1 / clip.fps)) + 1e-12
    wanted = np.arange(1001, clip.end_frame + 1)
    assert np.isin(wanted, clip.frames).all() and clip.duration >= 1.1 - 1e-9
    assert clip.duration < 1.1 + np.diff(clip.times).max()


def test_wind_acts_and_warns_without_drag():
    drifting = helicopter(mass=1900.0, inertia=(1300, 4700, 4200), d_t=1.61, d_r=6.35, drag_linear=(200.0,) * 3)
    clip = simulate(drifting, Field(wind=(3, 0, 0)), HOVER, duration=2.0)
    assert clip.twists[-1, 3] == pytest.approx(3 * (1 - np.exp(-200 / 1900 * 2)), rel=1e-4)
    with pytest.warns(UserWarning, match=r"world.wind .* has no drag"):
        bare = vehsim.load_vehicle("helicopter_lie")
        simulate(bare, Field(wind=(3, 0, 0)), HOVER, duration=0.1)


def test_planar_vehicles_keep_their_height_or_stand_on_the_ground(car):
    clip = simulate(car, None, [100, 0], State(position=(1, 2, 7)), duration=1.0)
    np.testing.assert_allclose(clip.positions[:, 2], 7, atol=1e-12)
    with pytest.warns(UserWarning, match=r"starts at z = 7.00 m and was put on the ground, at 6.00 m"):
        plain = Terrain("plain", np.full((2, 2), 6.0), (-500.0, -500.0), (1000.0, 1000.0))
        clip = simulate(car, vehsim.World(plain), [100, 0], State(position=(10, 2, 7)), duration=1.0)
    np.testing.assert_allclose(clip.positions[:, 2], 6, atol=0.02)


def test_leaving_bounds_warns_without_clipping(car):
    with pytest.warns(UserWarning, match=r"control torque = 9000 at frame 1001 is outside \[-4000, 2500\]"):
        clip = simulate(car, None, [9000, 0], duration=0.2)
    assert clip.controls.max() == 9000
    with pytest.warns(UserWarning, match=r"joint sigma .* is outside \[-0.7, 0.7\]"):
        simulate(car, None, [0, 0.8], duration=1.0)


def test_progress_runs_from_zero_to_one(car):
    seen = []
    simulate(car, None, lambda t, s: (0, 0), duration=1.0, progress=lambda text, done: seen.append((text, done)))
    fractions = [done for _, done in seen]
    assert fractions[0] == 0 and fractions[-1] == 1 and fractions == sorted(fractions)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controls": [1, 2, 3]}, "controls: shape"),
        ({"controls": [[1, 2, 3, np.nan]]}, r"controls\[0, 3\] = nan: roll is not finite"),
        ({"controls": "full ahead"}, "controls: shape"),
        ({"controls": np.zeros((2, 2, 4))}, "controls: shape"),
        ({"controls": lambda t, s: [1, 2]}, r"controls\(t = 0\)"),
        ({"controls": lambda t, s: [np.nan] * 4}, "give 4 finite numbers: collective, yaw, pitch, roll"),
        ({"duration": None}, "duration: missing"),
        ({"duration": -1}, "duration = -1"),
        ({"duration": np.inf}, "duration = inf"),
        ({"duration": "long"}, "duration = 'long'"),
        ({"duration": 1e9}, "shorten it"),
        ({"step": 0}, "step = 0"),
        ({"step": 1e-12, "duration": 5.0}, "longer step"),
        ({"fps": 0}, "fps = 0"),
        ({"fps": "fast"}, "fps = 'fast'"),
        ({"order": 5}, "order = 5"),
        ({"difference_map": "log"}, "difference_map = 'log'"),
        ({"start": State(position=(0, 0, np.inf))}, "state.position"),
        ({"world": Field(wind=(0, 0))}, "world.wind"),
    ],
)
@pytest.mark.filterwarnings("ignore:world.wind")
def test_wrong_input_is_named_before_any_work(heli, changes, message):
    good = {"world": None, "controls": HOVER, "duration": 0.1}
    with pytest.raises(InputError, match=message):
        simulate(heli, **{**good, **changes})
