"""A shot solved: frames and degrees of the file become seconds and radians of the physics."""

from __future__ import annotations

import dataclasses
import tomllib
import warnings
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehsim import Clip, Shot, State, World, load_vehicle, simulate
from vehsim.cameras.camera import CameraRig
from vehsim.errors import InputError, ShotError
from vehsim.shot.motions.limits import LimitTable
from vehsim.shot.schema.shot_file import schema
from vehsim.shot.schema.tables import CameraTable, parse_fps

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    "given, exact",
    [
        (24, Fraction(24)),
        ("24", Fraction(24)),
        (24.0, Fraction(24)),
        (12.5, Fraction(25, 2)),
        ("24000/1001", Fraction(24000, 1001)),
        ("23.976", Fraction(24000, 1001)),
        (23.976, Fraction(24000, 1001)),
        ("23.98", Fraction(24000, 1001)),
        ("29.97", Fraction(30000, 1001)),
        ("59.94", Fraction(60000, 1001)),
    ],
)
def test_frame_rates_are_exact(given: Any, exact: Fraction) -> None:
    assert parse_fps(given) == exact


def test_commands_are_linear_between_frames(small: dict[str, Any]) -> None:
    """A torque rising linearly over 12 frames gives the closed form's speed: v = tau t^2 / (2 T m_eff r). The model of
    the papers follows its commands at once."""
    small["vehicle"][0]["asset"] = "car_lie"
    small["vehicle"][0]["motion"]["commands"] = [{"frame": 1001, "torque": 0.0}, {"frame": 1013, "torque": 1000.0}]
    take = Shot.from_dict(small).solve()
    clip = take.clips["car"]
    physics = tomllib.loads((ROOT / "assets/vehicles/car/vehicle.toml").read_text())["physics"]
    radius = physics["wheel_radius"]
    inertia = physics["mass"] + physics["wheel_inertia"] / radius**2
    assert take.frames == (1001, 1013)
    assert clip.twists[-1, 1] == pytest.approx(1000.0 * 0.5 / 2 / radius / inertia, rel=1e-6)
    assert clip.frames[-1] == 1013


@pytest.mark.parametrize(("level", "warned"), [(-1.0, False), (2.5, True)])
def test_what_goes_under_water_is_warned_of(small: dict[str, Any], recwarn: Any, level: float, warned: bool) -> None:
    """It does not float, so nothing keeps it out: helicopters flew below the sea without a word."""
    small["world"] = {"water": {"level": level}}
    start = {"position": [0.0, 0.0, 2.0]}
    motion = {"method": "simulate", "duration": 0.25, "pilot": {"name": "hover", "position": [0.0, 0.0, 2.0]}}
    small["vehicle"][0] |= {"asset": "helicopter", "motion": motion | {"start": start}}
    Shot.from_dict(small).solve()
    said = [str(one.message) for one in recwarn if "under water" in str(one.message)]
    assert (
        said
        == [
            "car: goes under water at frame 1001, down to 0.50 m; raise its marks, or keep a plan above with "
            "[[vehicle.motion.stay]] above = 2.5"
        ]
        * warned
    )


def test_start_is_in_degrees_and_world_axes(small: dict[str, Any]) -> None:
    start = {"position": [1.0, 2.0, 0.0], "heading": 90.0, "velocity": [0.0, 5.0, 0.0], "joints": {"sigma": 0.1}}
    small["vehicle"][0]["motion"] = {"method": "simulate", "duration": 0.25, "start": start}
    clip = Shot.from_dict(small).solve().clips["car"]
    half = np.sqrt(0.5)
    np.testing.assert_allclose(clip.positions[0], [1, 2, 0], atol=1e-9)
    np.testing.assert_allclose(clip.orientations[0], [half, 0, 0, half], atol=1e-9)
    assert clip.twists[0, 1] == pytest.approx(5.0, abs=0.1)
    assert clip.joints[0][load_vehicle("car").joints.index("sigma")] == pytest.approx(0.1)
    assert clip.positions[-1, 1] > 3


def test_angles_of_commands_are_in_degrees(small: dict[str, Any]) -> None:
    commands = [{"frame": 1001, "collective": 18639.0, "pitch": 5.0}]
    vehicle = {"asset": "helicopter", "motion": {"method": "simulate", "duration": 0.1, "commands": commands}}
    small["vehicle"][0] |= vehicle
    clip = Shot.from_dict(small).solve().clips["car"]
    index = clip.vehicle.control_names.index("pitch")
    np.testing.assert_allclose(clip.controls[:, index], np.deg2rad(5.0))


def test_a_pilot_takes_degrees(small: dict[str, Any]) -> None:
    pilot = {"name": "hover", "position": [0, 0, 10], "heading": 90}
    small["vehicle"][0] |= {"asset": "helicopter", "motion": {"method": "simulate", "duration": 0.5, "pilot": pilot}}
    shot = Shot.from_dict(small)
    assert shot.file.vehicle[0].motion.pilot.parameters()["heading"] == pytest.approx(np.pi / 2)  # type: ignore[union-attr]
    assert len(shot.solve().clips["car"]) > 12


@pytest.mark.parametrize("start", [{}, {"heading": 120, "position": [3, 4, 10]}])
@pytest.mark.parametrize("wind", [[0.0, 0.0, 0.0], [4.0, -6.0, 0.0]])
def test_a_simulated_helicopter_starts_in_balance(
    small: dict[str, Any], start: dict[str, Any], wind: list[float]
) -> None:
    """With the controls of its balance, it stays; level, it would slide aside."""
    from vehsim.planning.trim import steady

    turn = np.radians(start.get("heading", 0))
    c, s = np.cos(turn), np.sin(turn)
    felt = (float(c * wind[0] + s * wind[1]), float(c * wind[1] - s * wind[0]), 0.0)
    heli = load_vehicle("helicopter")
    balance = dict(zip(heli.control_names, steady(heli, (0.0, 0.0, 0.0), felt).controls, strict=True))
    degrees = {name: np.degrees(v) if name in ("pitch", "roll") else v for name, v in balance.items()}
    motion = {"method": "simulate", "duration": 2.0, "commands": [{"frame": 1001, **degrees}], "start": start}
    small["vehicle"][0] |= {"asset": "helicopter", "motion": motion}
    small["world"] = {"wind": wind}

    def moved() -> float:
        return float(np.ptp(Shot.from_dict(small).solve().clips["car"].positions, axis=0).max())

    assert moved() < 1e-3
    motion["start"] = {
        "position": start.get("position", [0, 0, 0]),
        "orientation": [np.cos(turn / 2), 0, 0, np.sin(turn / 2)],
    }
    assert moved() > 0.1


def test_a_motion_that_can_be_continued_has_the_same_content(small: dict[str, Any]) -> None:
    """What continues a simulation is no part of its motion."""
    small["world"] = {"terrain": "flat", "contact": {}}
    small["vehicle"][0] |= {
        "asset": "helicopter",
        "motion": {
            "method": "simulate",
            "duration": 0.2,
            "start": {"position": [0, 0, 1]},
            "commands": [{"frame": 1001, "collective": 0}],
        },
    }
    take = Shot.from_dict(small).solve()
    clip = take.clips["car"]
    assert clip.ending is not None
    bare = dataclasses.replace(take, clips={"car": dataclasses.replace(clip, ending=None)})
    assert take.content_hash == bare.content_hash
    moved = dataclasses.replace(clip, positions=clip.positions + 1e-9)
    assert dataclasses.replace(take, clips={"car": moved}).content_hash != take.content_hash


def test_a_saved_clip_is_used_unchanged(small: dict[str, Any], tmp_path: Path) -> None:
    clip = Shot.from_dict(small).solve().clips["car"]
    clip.save(tmp_path / "drive.npz")
    small["vehicle"][0]["motion"] = {"method": "clip", "path": "drive.npz"}
    again = Shot.from_dict(small, folder=tmp_path).solve().clips["car"]
    assert isinstance(again, Clip)
    np.testing.assert_array_equal(again.positions, clip.positions)


def test_a_clip_of_another_vehicle_or_rate_is_refused(small: dict[str, Any], tmp_path: Path) -> None:
    Shot.from_dict(small).solve().clips["car"].save(tmp_path / "drive.npz")
    small["vehicle"][0] |= {"asset": "helicopter", "motion": {"method": "clip", "path": "drive.npz"}}
    with pytest.raises(ShotError, match="another vehicle"):
        Shot.from_dict(small, folder=tmp_path).solve()
    small["vehicle"][0]["asset"] = "car"
    small["shot"]["fps"] = 25
    with pytest.raises(ShotError, match="24 frames per second, the shot at 25"):
        Shot.from_dict(small, folder=tmp_path).solve()


def test_simulation_runs_through_the_handles(small: dict[str, Any]) -> None:
    small["shot"] |= {"end_frame": 1010, "handles": 4}
    del small["vehicle"][0]["motion"]["duration"]
    take = Shot.from_dict(small).solve()
    clip = take.clips["car"]
    assert take.frames == (997, 1014) == (clip.start_frame, clip.end_frame)


def test_motion_cut_off_warns(small: dict[str, Any]) -> None:
    small["shot"]["end_frame"] = 1050
    with pytest.warns(UserWarning, match="car: its motion covers only frames 1001 to 1013 of 1001 to 1050"):
        take = Shot.from_dict(small).solve()
    clip = take.clips["car"]
    assert clip.end_frame == 1050
    np.testing.assert_array_equal(clip.positions[-1], clip.positions[clip.frames == 1013][0])


def test_a_hovering_helicopter_holds_with_its_rotor_turning(small: dict[str, Any]) -> None:
    small["shot"] |= {"start_frame": 1003, "end_frame": 1101, "handles": 2}
    marks = [
        {"frame": 1005, "position": [0, 0, 10], "velocity": [0, 0, 0]},
        {"frame": 1101, "position": [3, 0, 10], "velocity": [0, 0, 0]},
    ]
    small["vehicle"][0] |= {"asset": "helicopter", "motion": {"method": "plan", "segments": 16, "mark": marks}}
    clip = Shot.from_dict(small).solve().clips["car"]
    assert (clip.start_frame, clip.end_frame) == (1001, 1103)
    baked = clip.resample()
    np.testing.assert_allclose(baked.positions[:5], np.tile([0, 0, 10], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(baked.positions[-3:], np.tile([3, 0, 10], (3, 1)), atol=1e-6)
    turns = np.diff(baked.channels["main_rotor"])
    np.testing.assert_allclose(turns, turns[0], rtol=1e-6)


def test_several_vehicles_and_cameras(small: dict[str, Any]) -> None:
    small["vehicle"].append({**small["vehicle"][0], "name": "other"})
    small["camera"] = [{"name": "near", "target": "other", "lens_mm": 50}, {"name": "far", "rig": "orbit"}]
    shot = Shot.from_dict(small)
    take = shot.solve()
    assert set(take.clips) == {"car", "other"}
    assert [(camera.name, camera.lens_mm) for camera in take.cameras] == [("near", 50), ("far", 35)]
    assert all(len(camera.frames) == 13 for camera in take.cameras)
    alone = shot.only(["car"]).solve()
    assert set(alone.clips) == {"car"}
    with pytest.raises(ShotError, match="did you mean 'other'"):
        shot.only(["othr"])


def test_a_plan_hits_its_marks(small: dict[str, Any]) -> None:
    """From the file through the planner: frames, degrees and the marks in the stage."""
    marks = [
        {"frame": 1001, "position": [0, 0, 10], "heading": 30, "velocity": [0, 0, 0]},
        {"frame": 1097, "position": [10, 5, 12], "velocity": [0, 0, 0]},
    ]
    small["vehicle"][0] |= {"asset": "helicopter", "motion": {"method": "plan", "segments": 16, "mark": marks}}
    take = Shot.from_dict(small).solve()
    clip = take.clips["car"]
    assert take.frames == (1001, 1097)
    np.testing.assert_allclose(clip.positions[[0, -1]], [[0, 0, 10], [10, 5, 12]], atol=1e-6)
    w, _, _, z = clip.orientations[0]
    assert 2 * np.arctan2(z, w) == pytest.approx(np.deg2rad(30), abs=1e-6)
    assert [mark["frame"] for mark in take.report["marks"]["car"]] == [1001, 1097]
    assert take.report["vehicles"]["car"]["success"]


def test_paths_are_relative_to_the_shot_file(small: dict[str, Any], tmp_path: Path) -> None:
    np.save(tmp_path / "hill.npy", np.full((5, 5), 3.0))
    small["world"] = {"terrain": "hill.npy"}
    small["vehicle"][0]["motion"]["start"] = {"position": [1.0, 1.0, 3.0]}
    shot = Shot.from_dict(small, folder=tmp_path)
    assert shot.check() == []
    assert float(shot.world.height([(1.0, 1.0)])[0]) == 3.0


def test_camera_keys_are_those_of_the_camera_rig() -> None:
    rig = {field.name: field.default for field in dataclasses.fields(CameraRig)}
    assert {name: field.default for name, field in CameraTable.model_fields.items()} == rig


def test_every_key_is_documented() -> None:
    text = (ROOT / "docs" / "shot-file.md").read_text()
    for table in schema()["$defs"].values():
        for key in table["properties"]:
            assert f"`{key}`" in text, f"docs/shot-file.md does not explain {key}"


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.toml")), ids=lambda path: path.stem)
def test_examples_are_ready(path: Path) -> None:
    problems = Shot.load(path).check()
    assert [problem for problem in problems if problem.key != "sweep"] == []


def test_wheels_follow_the_ground_that_a_shot_stands_on(small: dict[str, Any], tmp_path: Path) -> None:
    """On ground with a slope of one in five, the root rises with it and has its pitch."""
    heights = 0.2 * np.tile(np.arange(41.0), (41, 1))
    np.savez(tmp_path / "slope.npz", heights=heights, origin=(-10.0, -20.0), cell=(1.0, 1.0))
    small["world"] = {"terrain": str(tmp_path / "slope.npz")}
    start = {"position": [0.0, 0.0, 0.0], "velocity": [6.0, 0.0, 0.0]}
    small["vehicle"][0]["motion"] = {"method": "simulate", "duration": 0.5, "start": start}
    with pytest.warns(UserWarning) as warned:
        take = Shot.from_dict(small).solve()
    texts = [str(warning.message) for warning in warned]
    assert any("car: starts at z = 0.00 m and was put on the ground, at 2.00 m" in text for text in texts)
    clip = take.clips["car"]
    # a wheel stands on a slope with its side, so its centre is a little nearer to it than its radius, seen upwards
    assert np.abs(clip.positions[:, 2] - 2.0 - 0.2 * clip.positions[:, 0]).max() < 0.01
    assert np.abs(clip.channels["pitch"] + np.arctan(0.2)).max() < 0.02
    assert not any("ground at frame" in text for text in texts), texts


def test_a_note_after_the_last_frame_warns(small: dict[str, Any]) -> None:
    small["note"] = [{"frame": 1005, "text": "here"}, {"frame": 1014, "text": "too late"}]
    with pytest.warns(UserWarning) as warned:
        Shot.from_dict(small).solve()
    texts = [str(warning.message) for warning in warned]
    assert texts == ["note[1].frame = 1014: after the last frame, 1013, so it is not shown; move it"]


@pytest.mark.parametrize("own", [False, True], ids=["in the film", "pictures of its own"])
def test_a_camera_is_judged_by_what_the_film_shows_of_it(small: dict[str, Any], own: bool) -> None:
    """It looks away from the car; the film shows its last three frames, too few to notice."""
    away = {"name": "away", "rig": "static", "position": [0, -9, 3], "look_at": [0, -40, 3]}
    small["camera"] = [{"name": "chase", "rig": "chase"}, away]
    small["cut"] = [{"frame": 1001, "camera": "chase"}, {"frame": 1011, "camera": "away"}]
    if own:
        small.setdefault("render", {})["cameras"] = ["away"]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        Shot.from_dict(small).solve()
    named = [str(each.message) for each in caught if "'away': its target is outside" in str(each.message)]
    assert len(named) == own


def test_cuts_outside_the_shot_are_not_shown(small: dict[str, Any]) -> None:
    """The last frame is known only after solving; the first cut that counts is the last one before the shot."""
    small["camera"] = [
        {"name": name, "rig": "static", "position": [0, -9, 3], "look_at": [x, 0, 0]}
        for name, x in (("a", 0.0), ("b", 1.0), ("c", 2.0), ("d", 3.0))
    ]
    frames = (990, 995, 1005, 1400)
    small["cut"] = [{"frame": at, "camera": name} for at, name in zip(frames, "abcd", strict=True)]
    with pytest.warns(UserWarning, match=r"cut\[3\].frame = 1400: after the last frame, 1013, so it is not shown"):
        take = Shot.from_dict(small).solve()
    assert take.cuts == ((995, "b"), (1005, "c"))
    cut = take.cameras[-1]
    assert cut.orientations[0] == pytest.approx(take.cameras[1].orientations[0])
    assert cut.orientations[-1] == pytest.approx(take.cameras[2].orientations[0])


def test_two_vehicles_of_one_model_are_told_apart(tmp_path: Path) -> None:
    """Warnings and errors about a motion have the name that the shot gives its vehicle."""
    np.savez(tmp_path / "high.npz", heights=np.full((41, 41), 2.0), origin=(-20.0, -20.0), cell=(1.0, 1.0))
    drive = {"method": "simulate", "duration": 0.2, "start": {"position": [0.0, 0.0, 0.0]}}
    marks = [{"frame": 1001, "position": [-12, 0, 2]}, {"frame": 1241, "position": [0, 0, 2]}]
    data: dict[str, Any] = {
        "shot": {"schema": 1, "name": "two"},
        "world": {"terrain": str(tmp_path / "high.npz")},
        "vehicle": [
            {"name": "first", "asset": "car", "motion": drive},
            {"name": "second", "asset": "car", "motion": drive},
        ],
    }
    with pytest.warns(UserWarning) as warned:
        Shot.from_dict(data).solve(cached=False)
    texts = [str(warning.message) for warning in warned]
    assert [text.split(":")[0] for text in texts if "starts at z" in text] == ["first", "second"]
    data["world"]["obstacle"] = [{"shape": "vehicle", "vehicle": "first"}]
    data["vehicle"][1]["motion"] = {"method": "plan", "mark": marks}
    with pytest.warns(UserWarning), pytest.raises(InputError, match=r"^second: mark\[1\].position = .* 'first'"):
        Shot.from_dict(data).solve(cached=False)


def test_wheels_on_level_ground_are_no_warning(small: dict[str, Any], recwarn: pytest.WarningsRecorder) -> None:
    small["world"] = {"terrain": "flat"}
    Shot.from_dict(small).solve()
    assert not [str(w.message) for w in recwarn if "ground" in str(w.message)]


def test_simulated_vehicles_meet_where_there_is_contact() -> None:
    """Two boats drift into each other: advanced together, each has an event for the other, and they do not
    penetrate."""

    def boat(name: str, x: float, vx: float) -> dict[str, Any]:
        start = {"position": [x, 0.0, 0.0], "velocity": [vx, 0.0, 0.0], "heading": 90.0}
        motion = {"method": "simulate", "duration": 1.2, "step": 1 / 96, "start": start}
        return {"name": name, "asset": "boat", "motion": motion}

    data = {
        "shot": {"schema": 1, "name": "meeting"},
        "world": {"water": {}, "contact": {"speed": 3.0}},
        "vehicle": [boat("a", -1.3, 1.5), boat("b", 1.3, -1.5)],
        "camera": [{"rig": "static"}],
    }
    take = Shot.from_dict(data).solve()
    a, b = take.clips["a"], take.clips["b"]
    assert a.events[0]["with"] == "b" and b.events[0]["with"] == "a"
    assert (b.positions[:, 0] - a.positions[:, 0]).min() > 1.8
    assert take.report["vehicles"]["a"]["together"] == ["a", "b"]


def test_a_vehicle_that_is_an_obstacle_pushes_those_that_are_simulated(tmp_path: Path) -> None:
    """A ram's saved motion meets a boat at rest on the water: the boat is pushed, and the ram does not change."""
    boat = load_vehicle("boat")
    there = State(position=(-7.0, 0.0, 0.0), twist=(0, 0, 0, 4.0, 0, 0))
    ram = simulate(boat, World(water=0.0), (4000.0, 0.0), there, duration=0.8, step=1 / 48, start_frame=1001)
    ram.save(tmp_path / "ram.npz")
    rest = {"method": "simulate", "duration": 0.8, "step": 1 / 96, "start": {"position": [0.0, 0.3, 0.0]}}
    data = {
        "shot": {"schema": 1, "name": "rammed"},
        "world": {
            "water": {}, "contact": {"speed": 3.0, "restitution": 0.1},
            "obstacle": [{"shape": "vehicle", "vehicle": "ram"}],
        },
        "vehicle": [
            {"name": "idle", "asset": "boat", "motion": rest},
            {"name": "ram", "asset": "boat", "motion": {"method": "clip", "path": str(tmp_path / "ram.npz")}},
        ],
        "camera": [{"rig": "static"}],
    }  # fmt: skip
    clips = Shot.from_dict(data).solve().clips
    assert clips["idle"].events[0]["with"] == "ram" and clips["idle"].twists[-1, 3] > 1.5
    assert np.array_equal(clips["ram"].positions, ram.positions)


def test_limits_have_one_order_in_every_process() -> None:
    """The rows of the problem have this order too; a set of names has another one in every process."""
    names = ["turn_rate", "speed", "climb", "bank", "g_load", "ceiling", "joints"]
    given = LimitTable.model_validate({name: 1.0 for name in names[:-1]} | {"joints": {"psi": 1.0}}).given()
    assert list(given) == sorted(names)
