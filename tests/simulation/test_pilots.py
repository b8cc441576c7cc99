"""Pilots reach their targets, from disturbed and upset starts, in wind, within their bounds."""

from types import SimpleNamespace

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.pilots.controllers import PILOTS, FlyTo, FollowPath, Hover
from vehsim.pilots.gait import Gait
from vehsim.simulation import simulate
from vehsim.vehicles import State
from vehsim.vehicles.models.helicopter import helicopter

STEP = 1 / 96


def within_bounds(clip):
    lower = [c.lower for c in clip.vehicle.controls]
    upper = [c.upper for c in clip.vehicle.controls]
    return np.all(clip.controls >= np.array(lower) - 1e-9) and np.all(clip.controls <= np.array(upper) + 1e-9)


def distance(clip, goal):
    return np.linalg.norm(clip.positions - goal, axis=1)


def heading(clip):
    T = clip.matrices()
    return np.arctan2(T[:, 1, 0], T[:, 0, 0])


def test_hover_converges_to_a_centimetre_from_a_disturbed_start():
    heli = vehsim.load_vehicle("helicopter")
    start = State(position=(5, -4, 27), twist=(0.1, -0.2, 0.3, 3, 1, -1))
    clip = simulate(heli, None, Hover(heli, (0, 0, 30), heading=0.5), start, duration=20.0, step=STEP)
    late = clip.times > 18
    assert distance(clip, (0, 0, 30))[late].max() < 0.01
    assert np.abs(heading(clip)[late] - 0.5).max() < 0.002
    assert within_bounds(clip)


def test_hover_trims_out_steady_wind():
    drag = {"drag_linear": (150.0, 300.0, 400.0), "drag_quadratic": (5.0, 10.0, 20.0)}
    heli = helicopter(mass=1900.0, inertia=(1300, 4700, 4200), d_t=1.61, d_r=6.35, **drag)
    bounds = vehsim.load_vehicle("helicopter").controls
    object.__setattr__(heli, "controls", bounds)
    wind = SimpleNamespace(wind=(6.0, -3.0, 0.0), terrain=None)
    clip = simulate(heli, wind, Hover(heli, (0, 0, 30)), State(position=(0, 0, 30)), duration=25.0, step=STEP)
    assert distance(clip, (0, 0, 30)).max() > 0.1
    assert distance(clip, (0, 0, 30))[clip.times > 23].max() < 0.01


@pytest.mark.parametrize("angle", [np.pi / 2, -np.pi / 2, np.pi])
@pytest.mark.parametrize("axis", [1, 2])
def test_hover_recovers_from_any_attitude(angle, axis):
    """Nose straight down or up, on its side, upside down: no NaN, and it recovers."""
    heli = vehsim.load_vehicle("helicopter")
    orientation = np.zeros(4)
    orientation[0], orientation[axis] = np.cos(angle / 2), np.sin(angle / 2)
    start = State(position=(0, 0, 500), orientation=orientation)
    clip = simulate(heli, None, Hover(heli, (0, 0, 500)), start, duration=90.0, step=1 / 48)
    assert np.all(np.isfinite(clip.positions)) and within_bounds(clip)
    assert distance(clip, (0, 0, 500))[-1] < 0.05


@pytest.mark.parametrize("toward", [None, 2.0])
def test_fly_to_arrives_and_stays(toward):
    heli = vehsim.load_vehicle("helicopter")
    goal = (100, 40, 45)
    pilot = FlyTo(heli, goal, speed=15, heading=toward)
    clip = simulate(heli, None, pilot, State(position=(0, 0, 30)), duration=40.0, step=STEP)
    assert distance(clip, goal)[clip.times > 38].max() < 0.02
    assert np.linalg.norm(clip.twists[:, 3:], axis=1).max() < 15 * 1.2
    expected = np.arctan2(40, 100) if toward is None else toward
    assert np.abs(heading(clip)[-1] - expected) < 0.01
    assert within_bounds(clip)


def test_fly_to_passes_its_waypoints():
    heli = vehsim.load_vehicle("helicopter")
    points = np.array([(60, 0, 40), (90, 40, 45), (60, 80, 50)])
    clip = simulate(
        heli, None, FlyTo(heli, waypoints=points, speed=12), State(position=(0, 0, 30)), duration=45.0, step=STEP
    )
    nearest = [distance(clip, point).min() for point in points]
    assert max(nearest) < 2.0 and distance(clip, points[-1])[-1] < 0.05


def test_a_pilot_forgets_when_reset():
    heli = vehsim.load_vehicle("helicopter")
    pilot = FlyTo(heli, (20, 5, 32), speed=5)
    first, second = (simulate(heli, None, pilot, State(position=(0, 0, 30)), duration=3.0, step=STEP) for _ in range(2))
    np.testing.assert_array_equal(first.positions, second.positions)


@pytest.mark.parametrize("start", [(0.0, 0.0, 0.0), (-1.0, 1.0, 0.0)])
def test_car_follows_a_path_and_stops_at_its_end(start):
    car = vehsim.load_vehicle("car")
    points = np.array([(0, 0), (30, 0), (50, 10), (60, 30), (50, 50)])
    pilot = FollowPath(car, points, speed=10)
    clip = simulate(car, None, pilot, State(position=start), duration=22.0, step=STEP)
    axle = (clip.matrices() @ [car.origin[0], 0, 0, 1])[:, :2]
    curve = pilot._route._curve(np.linspace(0, pilot._route.length, 5000))
    apart = np.array([np.linalg.norm(curve - point, axis=1).min() for point in axle])
    settled = clip.positions[:, 0] > 15
    assert apart[settled].max() < 0.25
    assert np.linalg.norm(clip.positions[-1, :2] - points[-1]) < 0.15
    assert abs(clip.twists[-1, 1]) < 0.02 and clip.twists[:, 1].max() == pytest.approx(10, abs=0.5)
    assert np.abs(clip.joints[:, 1]).max() <= 0.7 and within_bounds(clip)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda heli, car: Hover(car, (0, 0, 1)), "not a helicopter"),
        (lambda heli, car: FollowPath(heli, [(0, 0), (1, 1)]), "is not a car"),
        (lambda heli, car: Hover(heli, (0, 0)), "position"),
        (lambda heli, car: Hover(heli, (0, 0, np.nan)), "position"),
        (lambda heli, car: FlyTo(heli), "either position"),
        (lambda heli, car: FlyTo(heli, (1, 2, 3), speed=0), "speed"),
        (lambda heli, car: FlyTo(heli, waypoints=[(1, 2)]), "waypoints"),
        (lambda heli, car: FollowPath(car, [(0, 0)]), "points"),
        (lambda heli, car: FollowPath(car, "straight"), "points"),
    ],
)
def test_wrong_orders_are_named(make, message):
    with pytest.raises(InputError, match=message):
        make(vehsim.load_vehicle("helicopter"), vehsim.load_vehicle("car"))


def test_pilots_are_found_by_name():
    assert {"hover": Hover, "fly_to": FlyTo, "follow_path": FollowPath, "gait": Gait} == PILOTS
