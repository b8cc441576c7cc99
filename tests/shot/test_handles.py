"""Through its handles a vehicle moves by its physics, forwards and backwards, with the controls at its ends."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.shot import Shot, handles

MARKS = {
    "car": [((0, 0, 0), (12, 0, 0)), ((26, 3, 0), (14, 0, 0))],
    "helicopter": [((0, 0, 10), (12, 0, 0)), ((26, 6, 12), (12, 5, 0))],
}


def solve(asset, handles=8, end=1049):
    marks = [
        {"frame": frame, "position": list(place), "velocity": list(speed)}
        for frame, (place, speed) in zip((1001, 1049), MARKS[asset], strict=True)
    ]
    shot = {
        "shot": {"schema": 1, "name": "handles", "end_frame": end, "handles": handles},
        "vehicle": [{"name": "it", "asset": asset, "motion": {"method": "plan", "character": "stunt", "mark": marks}}],
    }
    return Shot.from_dict(shot).solve()


@pytest.mark.parametrize("asset", MARKS)
def test_motion_continues_by_its_physics_through_handles(asset):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        take = solve(asset)
    clip = take.clips["it"]
    assert take.frames == (993, 1057) and (clip.start_frame, clip.end_frame) == (993, 1057)
    marked = clip.at([8 / 24, 56 / 24])
    assert marked.positions == pytest.approx(np.array([MARKS[asset][0][0], MARKS[asset][1][0]], float), abs=1e-6)
    # the motion before the first mark leads to it, by the forward integrator
    again = vehsim.simulate(clip.vehicle, take.world, clip.controls[0], clip.state(0), 8 / 24)
    k = np.argmin(np.abs(clip.times - 8 / 24))
    assert np.abs(again.positions[-1] - clip.positions[k]).max() < 1e-9
    assert np.abs(again.twists[-1] - clip.twists[k]).max() < 1e-9
    # nothing jumps: neither the velocity nor the speed of a wheel or rotor
    whole = clip.resample()
    steps = np.diff(whole.positions, axis=0)
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() * 24**2 < 15
    for name, values in whole.channels.items():
        if clip.vehicle.channels[name].rate is not None:
            assert np.abs(np.diff(values, 2)).max() < 0.1 * np.abs(np.diff(values)).max(), name


def test_motion_shorter_than_the_shot_without_handles_warns():
    with pytest.warns(UserWarning, match="cut off while it moves"):
        take = solve("car", end=1060)
    clip = take.clips["it"]
    assert np.ptp(clip.resample().positions[-5:], axis=0).max() == 0.0
    cut = len(clip) - np.argmax(np.any(np.diff(clip.positions, axis=0)[::-1] != 0, axis=1)) - 1
    after = clip.times[cut] + np.arange(1, 64) / 64 / float(clip.fps)
    assert np.abs(clip.at(after).positions - clip.positions[cut]).max() < 2e-4, "it stays where it was cut off"


def test_a_boat_at_rest_keeps_its_rudder_angle():
    """Its propeller continues at its rate; the rudder follows its control, which is constant."""
    from dataclasses import replace

    from vehsim.shot.follow_through import hold

    t = np.linspace(0, 1, 25)
    boat = vehsim.load_vehicle("boat").planar
    clip = Integrator(boat, 1 / 24).rollout(vehsim.State(), np.column_stack([1000 + 0 * t, 0.4 * t]))
    clip = replace(clip, twists=np.where(t[:, None] == 1, 0.0, clip.twists))
    held = hold(clip, clip.start_frame, clip.end_frame + 48)
    assert held.channels["steer"][-1] == clip.channels["steer"][-1] != 0
    assert held.channels["propeller"][-1] - clip.channels["propeller"][-1] > 1.0


def test_brakes_are_released_where_a_stunt_has_stopped():
    """It brakes until its last frame: 3,300 N m stayed on while the car was parked."""
    from vehsim.shot.follow_through import hold

    marks = [vehsim.Mark(49, position=(0, 0, 0), velocity=(0, 0, 0), heading=0)]
    marks += [vehsim.Mark(169, position=(30, 0, 0), velocity=(0, 0, 0))]
    clip = vehsim.plan(vehsim.load_vehicle("car"), None, marks, character="stunt", segments=16).clip
    held = hold(clip, 1, 241)
    assert np.abs(clip.controls[[0, -1], 0]).min() > 1000
    np.testing.assert_allclose(held.controls[(held.frames < 48.5) | (held.frames > 169.5)], 0.0, atol=1e-2)
    inside = (held.frames > 48.9) & (held.frames < 169.1)
    np.testing.assert_array_equal(held.controls[inside], clip.controls)


def test_a_stopped_car_settles_on_its_springs_with_its_wheels_at_rest():
    """The last rates of wheels and springs must not continue: they once moved the car off its wheels."""
    from dataclasses import replace

    from vehsim.shot.follow_through import hold
    from vehsim.world.ground.placing import place_on_terrain

    world = vehsim.World("flat")
    clip = vehsim.simulate(vehsim.load_vehicle("car"), world, [900.0, 0.0], vehsim.State(), 0.5)
    twists = clip.twists.copy()
    twists[-1] = 0.0  # braked hard, with its nose still down
    clip = replace(clip, twists=twists)
    with pytest.warns(UserWarning, match="more than the grip of tyres"):
        held = place_on_terrain(hold(clip, clip.start_frame, clip.end_frame + 96), world)
    after = held.frames > clip.end_frame + 1
    for wheel in ("rl", "rr", "fl", "fr"):
        assert np.ptp(held.channels[f"roll_{wheel}"][after]) < 0.02
        assert abs(held.channels[f"travel_{wheel}"][-1]) < 1e-3
        assert np.abs(held.channels[f"travel_{wheel}"]).max() < 0.12
    assert abs(held.channels["pitch"][-1]) < 1e-3 and np.ptp(held.positions[after, :2]) < 20
    assert np.abs(held.matrices()[-1][:3, :3] - np.eye(3)).max() < 2e-3


@pytest.mark.parametrize(("asset", "speed"), [("boat", 4.0), ("drift_car", 14.0)])
def test_what_is_damped_comes_steadily_through_the_handle(asset, speed):
    """Backwards in time its motion grows: within a second, a boat would spin at 45 rad/s and move at 29 m/s."""
    marks = [
        {"frame": frame, "position": list(place), "velocity": [speed, side, 0]}
        for frame, place, side in ((1001, (0, 0, 0), 0), (1049, (2.2 * speed, 1, 0), 1))
    ]
    if asset == "boat":
        marks[0]["heading"] = -15  # without it, it begins in a steady bend
    vehicle = {"name": "it", "asset": asset, "motion": {"method": "plan", "mark": marks}}
    shot = {"shot": {"schema": 1, "name": "handles", "end_frame": 1049, "handles": 24}, "vehicle": [vehicle]}
    with pytest.warns(UserWarning, match="through the handle before frame 1001 with the velocity it has there"):
        clip = Shot.from_dict(shot).solve().clips["it"]
    k = np.argmin(np.abs(clip.times - 1.0))
    assert (clip.start_frame, clip.frames[k]) == (977, pytest.approx(1001))
    assert np.abs(clip.twists[: k + 1] - clip.twists[k]).max() < 1e-9
    whole = clip.resample()
    assert np.linalg.norm(np.diff(whole.positions[:25], axis=0), axis=1) == pytest.approx(speed / 24, rel=0.01)
    for name, values in whole.channels.items():
        if name.startswith("roll_"):
            assert np.diff(values[:25]) == pytest.approx(np.diff(values[24:26])[0], rel=0.05), name


def test_an_end_that_cannot_be_continued_leaves_the_other(monkeypatch):
    """A snakeboard whose joints turned through a singular place afterwards stood still before its first mark too."""

    def lost(*_):
        raise InputError("constraints lose rank", "", key="constraints")

    monkeypatch.setattr(handles, "_after", lost)
    with pytest.warns(UserWarning, match="stands still in the handle after its last frame.*lose rank"):
        clip = solve("car").clips["it"]
    speeds = np.linalg.norm(np.diff(clip.resample().positions, axis=0), axis=1) * 24
    assert speeds[0] > 10 and speeds[-1] == 0


def test_trailers_stay_within_their_limits_before_a_motion():
    """Backwards in time, a trailer that is pulled folds: from 40 degrees, this one would by 90."""
    marks = [
        {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [6, 0, 0], "joints": {"hitch_1": 0.7}},
        {"frame": 1121, "position": [40, 0, 0], "heading": 0, "velocity": [8, 0, 0]},
    ]
    shot = {
        "shot": {"schema": 1, "name": "folded", "end_frame": 1121, "handles": 24},
        "vehicle": [{"name": "it", "asset": "truck", "motion": {"method": "plan", "mark": marks}}],
    }
    with pytest.warns(UserWarning, match="through the handle before frame 1001 with the velocity it has there"):
        clip = Shot.from_dict(shot).solve().clips["it"]
    hitch = np.degrees(clip.joints[:, clip.vehicle.joints.index("hitch_1")])
    assert clip.start_frame == 977 and 39 < np.abs(hitch).max() < 63.1
