"""Pilots declare their targets, reach them in the time they name, and report when they do not."""

import json
import re
import warnings
from types import SimpleNamespace

import numpy as np
import pytest

import vehsim
from vehsim.pilots.controllers import FlyTo, FollowPath, Gait, Hover
from vehsim.shot.shot import Shot
from vehsim.simulation import simulate
from vehsim.vehicles import State
from vehsim.vehicles.models.helicopter import helicopter

STEP = 1 / 96


def simulated(pilot, duration, start=None, world=None, step=STEP):
    """The clip, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        clip = simulate(pilot_vehicle(pilot), world, pilot, start, duration=duration, step=step)
    json.dumps(pilot.targets(duration))
    return clip, [str(warning.message) for warning in caught]


def pilot_vehicle(pilot):
    return getattr(pilot, "vehicle", None) or getattr(pilot, "_vehicle", None) or pilot._law.vehicle


def paths(count):
    random = np.random.default_rng(3)
    for k in range(count):
        ways, angles = random.uniform(4, 20, 3), random.uniform(-0.6, 0.6, 3)
        steps = ways[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
        points = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])
        yield ["car", "truck"][k % 3 == 2], points, float(random.uniform(3, 10))


@pytest.mark.parametrize(("asset", "points", "speed"), list(paths(6)))
def test_a_path_with_too_little_time_reports_a_sufficient_time(asset, points, speed):
    pilot = FollowPath(vehsim.load_vehicle(asset), points, speed=speed)
    clip, warned = simulated(pilot, 3.0)
    (message,) = [text for text in warned if "pilot.position" in text]
    off = float(re.findall(r"pilot.position: ([\d.]+) m", message)[0])
    assert off == pytest.approx(np.linalg.norm(clip.positions[-1, :2] - points[-1]), abs=0.01)
    seconds = float(re.findall(r"give it ([\d.]+) s", message)[0])
    clip, warned = simulated(pilot, seconds)
    assert not warned
    assert np.linalg.norm(clip.positions[-1, :2] - points[-1]) < 0.25
    assert np.linalg.norm(clip.twists[-1]) < 0.2
    assert np.linalg.norm(np.diff(clip.positions, axis=0), axis=1).max() * 96 < 1.05 * speed


def draggy():
    drag = {"drag_linear": (150.0, 300.0, 400.0), "drag_quadratic": (5.0, 10.0, 20.0)}
    heli = helicopter(mass=1900.0, inertia=(1300, 4700, 4200), d_t=1.61, d_r=6.35, **drag)
    object.__setattr__(heli, "controls", vehsim.load_vehicle("helicopter").controls)
    return heli


@pytest.mark.parametrize("wind", [(0, 0, 0), (-3.5, 9.8, 0)])
@pytest.mark.parametrize(("goal", "speed"), [((-40, 42, 44), 7.7), ((21, 7, 30), 10.5)])
def test_fly_to_stays_at_its_goal(goal, speed, wind):
    """Drag decreases as it slows down: the wind trim lags behind that, and would carry it past its goal."""
    pilot = FlyTo(draggy(), goal, speed=speed)
    world, start = SimpleNamespace(wind=wind, terrain=None), State(position=(0, 0, 30))
    clip, _ = simulated(pilot, 30.0, start, world)
    off = np.linalg.norm(clip.positions - goal, axis=1)
    arrived = np.argmax(off < 0.1)
    assert 0 < arrived < len(off) - 96 and off[arrived:].max() < 0.25


@pytest.mark.parametrize("wind", [(0, 0, 0), (0, 8, 0), (-10, 0, 0), (10, 3, 0)])
@pytest.mark.parametrize("speed", [5.9, 14.0])
def test_fly_to_keeps_its_speed_over_ground_in_wind(wind, speed):
    heli = draggy()
    pilot = FlyTo(heli, (60, 20, 35), speed=speed, heading=0.3)
    world, start = SimpleNamespace(wind=wind, terrain=None), State(position=(0, 0, 30))
    _, warned = simulated(pilot, 2.0, start, world)
    (message,) = [text for text in warned if "pilot.position" in text]
    seconds = float(re.findall(r"give it ([\d.]+) s", message)[0])
    clip, warned = simulated(pilot, seconds, start, world)
    assert not warned
    assert np.linalg.norm(np.diff(clip.positions, axis=0), axis=1).max() * 96 < 1.03 * speed
    assert np.linalg.norm(clip.positions[-1] - [60, 20, 35]) < 0.5


def test_hovering_elsewhere_or_with_another_heading_warns():
    pilot = Hover(vehsim.load_vehicle("helicopter"), (0, 0, 30), heading=2.0)
    _, warned = simulated(pilot, 1.0, State(position=(20, 0, 30)))
    assert any("pilot.position" in text for text in warned) and any("pilot.heading" in text for text in warned)
    _, warned = simulated(pilot, 15.0, State(position=(2, 0, 30)))
    assert not warned


def test_a_path_with_too_sharp_bends_warns():
    pilot = FollowPath(vehsim.load_vehicle("car"), np.array([(0, 0), (8, 0), (8, 3), (0, 3)]), speed=6)
    assert any("pilot.path" in text and "give it wider bends" in text for text in simulated(pilot, 15.0)[1])


@pytest.mark.parametrize(("amplitude", "period"), [([0.9, -0.32], 0.6), ([0.3, -0.3], 0.3), ([1.1, 0.5], 0.8)])
def test_a_gait_beyond_its_torques_reports_a_sufficient_period(amplitude, period):
    board = vehsim.load_vehicle("snakeboard")
    _, warned = simulated(Gait(board, amplitude, period, [0, -0.6]), 4.0, step=1 / 240)
    message = next(text for text in warned if "pilot.amplitude.psi" in text)
    slower = float(re.findall(r"period of ([\d.]+) s", message)[0])
    gait = Gait(board, amplitude, slower, [0, -0.6])
    clip, warned = simulated(gait, 5.0, step=1 / 240)
    assert not warned
    late = clip.times > 1.0
    np.testing.assert_allclose(np.ptp(clip.joints[late], axis=0) / 2, np.abs(amplitude), rtol=0.05)
    wanted = np.array([gait.swing(t)[0] for t in clip.times])
    assert np.abs(clip.joints - wanted).max() < 8e-3  # rad: the legs follow their torques with a lag


def test_a_shot_reports_its_pilots_targets():
    motion = {"method": "simulate", "duration": 1.0, "step": 0.02, "pilot": {"name": "hover", "position": [0, 0, 9]}}
    motion["start"] = {"position": [0, 0, 9]}
    data = {
        "shot": {"schema": 1, "name": "s", "fps": 24},
        "vehicle": [{"name": "v", "asset": "helicopter", "motion": motion}],
    }
    rows = {row["key"]: row for row in Shot.from_dict(data).solve().report["audit"]["v"]}
    assert rows["pilot.position"]["wanted"]["position"] == [0.0, 0.0, 9.0]
    assert rows["pilot.position"]["met"] and rows["pilot.heading"]["met"]
