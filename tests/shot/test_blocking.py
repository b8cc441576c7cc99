"""Blocking in, motion out: an animator's prim becomes marks, and physical motion is written over the same prim."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vehsim import Shot
from vehsim.errors import InputError, ShotError
from vehsim.rig.blocking import nearest_rotations, read_blocking, write_over

FPS = Fraction(24)
KEYS = {1001: ((0.0, 0.0, 10.0), 0.0), 1050: ((10.0, 4.0, 12.0), 30.0), 1100: ((20.0, -3.0, 9.0), -45.0)}


def stage_with(
    path: Path, up: str = "Z", metres: float = 1.0, keys: Any = KEYS, parent: bool = False, fps: int = 24
) -> Path:
    """A prim /World/heli keyed at world positions (m, Z up) and headings (deg), for any axes of the stage.

    With ``parent``, the prim above it rotates and moves all the time.
    """
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, up)
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(1001)
    stage.SetEndTimeCode(1100)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    heli = UsdGeom.Xform.Define(stage, "/World/heli")
    box = UsdGeom.Cube.Define(stage, "/World/heli/box")
    box.CreateExtentAttr([(-1, -1, -1), (1, 1, 1)])
    axes = np.eye(3) if up == "Z" else np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # Z up -> the stage's
    if parent:
        turn, slide = world.AddRotateZOp(), world.AddTranslateOp()
        for frame in range(1001, 1101):
            turn.Set(3.0 * (frame - 1001), frame)
            slide.Set(Gf.Vec3d(0.1 * frame, 5.0, 0.0), frame)
    move = heli.AddTransformOp()
    cache = UsdGeom.XformCache()
    for frame, (place, heading) in keys.items():
        wanted = np.eye(4)
        turned = Rotation.from_euler("z", heading, degrees=True).as_matrix()
        wanted[:3, :3] = 2.0 * axes @ turned @ axes.T  # the prim is scaled, too
        wanted[:3, 3] = axes @ place / metres
        cache.SetTime(frame)
        above = np.array(cache.GetLocalToWorldTransform(world.GetPrim())).T
        move.Set(Gf.Matrix4d((np.linalg.inv(above) @ wanted).T.tolist()), frame)
    stage.GetRootLayer().Save()
    return path


@pytest.mark.parametrize(("up", "metres"), [("Z", 1.0), ("Y", 0.01), ("Y", 1.0), ("Z", 0.3048)])
@pytest.mark.parametrize("parent", [False, True])
def test_poses_are_read_in_the_world_in_metres_z_up(tmp_path: Path, up: str, metres: float, parent: bool) -> None:
    blocking = read_blocking(stage_with(tmp_path / "in.usda", up, metres, parent=parent), "/World/heli", FPS)
    for frame, (place, heading) in KEYS.items():
        k = blocking.index(frame)
        assert blocking.positions[k] == pytest.approx(place, abs=1e-6)
        assert (np.degrees(blocking.headings[k]) - heading + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-6)
        assert np.allclose(blocking.rotations[k] @ blocking.rotations[k].T, np.eye(3), atol=1e-9)


def test_the_nose_may_be_any_axis_of_the_prim(tmp_path: Path) -> None:
    path = stage_with(tmp_path / "in.usda", "Y", 0.01)
    headings = {}
    for forward in ("X", "-X", "Z", "-Z"):
        headings[forward] = np.degrees(read_blocking(path, "/World/heli", FPS, forward).headings[0]) % 360
    assert headings == pytest.approx({"X": 0.0, "-X": 180.0, "Z": 270.0, "-Z": 90.0})
    with pytest.raises(InputError, match="up axis"):
        read_blocking(path, "/World/heli", FPS, "Y")


@pytest.mark.parametrize(("way", "along"), [((0, 9, 0), "-Z"), ((0, -9, 0), "Z"), ((9, 0, 0), None), ((9, 9, 0), None)])
def test_a_prim_that_moves_across_its_nose_is_warned_of(tmp_path: Path, way: Any, along: str | None) -> None:
    """As from Maya, where noses are Z: the marks' headings would be a quarter turn off."""
    path = stage_with(tmp_path / "in.usda", "Y", 0.01, keys={1001: ((0, 0, 8), 0.0), 1100: ((*way[:2], 8), 0.0)})
    assert read_blocking(path, "/World/heli", FPS).moves_along == along
    marks = {"usd": "in.usda", "prim": "/World/heli"}

    def warned() -> list[str]:
        vehicle = {"name": "it", "asset": "helicopter", "motion": {"method": "plan", "marks": marks}}
        shot = Shot.from_dict({"shot": {"schema": 1, "name": "across"}, "vehicle": [vehicle]}, tmp_path)
        return [problem.remedy for problem in shot.check() if problem.key.endswith("marks.forward")]

    assert warned() == ([f'give forward = "{along}", or forward = "X" if that is meant'] if along else [])
    marks["forward"] = "X"
    assert warned() == []


def test_keys_of_the_same_pose_are_a_hold(tmp_path: Path) -> None:
    keys = {1001: KEYS[1001], 1040: KEYS[1050], 1060: KEYS[1050], 1100: KEYS[1100]}
    assert read_blocking(stage_with(tmp_path / "in.usda", keys=keys), "/World/heli", FPS).keys == (
        (1001, 0), (1040, 20), (1100, 0)
    )  # fmt: skip


def baked(places: np.ndarray) -> dict[int, Any]:
    return {1001 + k: (tuple(place), 0.0) for k, place in enumerate(places)}


def test_keys_and_holds_are_found_in_baked_motion(tmp_path: Path) -> None:
    """Straight, held for a second, then around a corner: the corner and both ends of the hold are keys."""
    t = np.arange(100)
    x = np.interp(t, [0, 30, 54, 75, 99], [0, 15, 15, 30, 30])
    y = np.interp(t, [0, 30, 54, 75, 99], [0, 0, 0, 0, 18])
    path = stage_with(tmp_path / "in.usda", keys=baked(np.stack([x, y, 0 * x + 8], axis=1)))
    assert read_blocking(path, "/World/heli", FPS).keys == ((1001, 0), (1031, 24), (1076, 0), (1100, 0))


@pytest.mark.parametrize("power", [2, 3, 5])
@pytest.mark.parametrize(
    "keys",
    [
        {0: (0, 0), 30: (15, 0), 70: (40, 0), 99: (50, 0)},  # stops on a straight line
        {0: (0, 0), 30: (15, 0), 70: (15, 30), 99: (30, 30)},  # around corners
        {0: (0, 0), 30: (15, 0), 70: (0, 0), 99: (3, 5)},  # and back
    ],
)
def test_eased_stops_in_baked_motion_are_keys(tmp_path: Path, keys: dict[int, tuple[float, float]], power: int) -> None:
    """Every pose is eased in and out, and no frame is held."""
    eases = {2: lambda s: (1 - np.cos(np.pi * s)) / 2, 3: lambda s: s**2 * (3 - 2 * s)}
    ease = eases.get(power, lambda s: s**3 * (10 - 15 * s + 6 * s**2))
    t, places = np.arange(100), np.tile([0.0, 0.0, 8.0], (100, 1))
    for (first, start), (last, end) in pairwise(keys.items()):
        share = ease((t[first : last + 1] - first) / (last - first))[:, None]
        places[first : last + 1, :2] = (1 - share) * start + share * np.array(end)
    found = read_blocking(stage_with(tmp_path / "in.usda", keys=baked(places)), "/World/heli", FPS).keys
    assert [frame - 1001 for frame, _ in found] == list(keys)


def test_stepped_blocking_has_poses_without_holds(tmp_path: Path) -> None:
    x = np.repeat([0.0, 10.0, 25.0], [40, 40, 20])
    path = stage_with(tmp_path / "in.usda", keys=baked(np.stack([x, 0 * x, 0 * x + 8], axis=1)))
    assert read_blocking(path, "/World/heli", FPS).keys == ((1001, 0), (1041, 0), (1081, 0))


def over(folder: Path, up: str, metres: float, layer: Path, fps: int = 24) -> None:
    """The animator's stage below our layer: both.usda."""
    times = f"timeCodesPerSecond = {fps}\n framesPerSecond = {fps}\n startTimeCode = 1001\n endTimeCode = 1100"
    (folder / "both.usda").write_text(
        f'#usda 1.0\n(\n defaultPrim = "World"\n metersPerUnit = {metres}\n upAxis = "{up}"\n {times}\n'
        f" subLayers = [@{layer}@, @./in.usda@]\n)\n"
    )


@pytest.mark.parametrize(("up", "metres"), [("Z", 1.0), ("Y", 0.01)])
@pytest.mark.parametrize("parent", [False, True])
@pytest.mark.parametrize("fps", [24, 25])
def test_motion_written_over_the_prim_is_visible(
    tmp_path: Path, up: str, metres: float, parent: bool, fps: int
) -> None:
    from pxr import Usd, UsdGeom

    path, rate = stage_with(tmp_path / "in.usda", up, metres, parent=parent, fps=fps), Fraction(fps)
    blocking = read_blocking(path, "/World/heli", rate)
    frames = np.arange(1001.0, 1101.0)
    t = (frames - 1001) / fps
    positions = np.stack([8 * np.sin(t), 3 * t, 10 + np.cos(t)], axis=1)
    rotations = Rotation.from_euler("ZYX", np.stack([t, 0.2 * np.sin(t), 0.3 * np.cos(t)], axis=1)).as_matrix()
    layer = write_over(blocking, frames, positions, rotations, tmp_path / "over.usdc")
    over(tmp_path, up, metres, layer, fps)
    both = read_blocking(tmp_path / "both.usda", "/World/heli", rate)
    assert np.allclose(both.positions, positions, atol=1e-6)
    assert np.allclose(both.rotations, rotations, atol=1e-6)
    stage = Usd.Stage.Open(str(tmp_path / "both.usda"))
    local = np.array(UsdGeom.XformCache(1050).GetLocalToWorldTransform(stage.GetPrimAtPath("/World/heli")))[:3, :3]
    assert np.linalg.norm(local, axis=1) == pytest.approx(2.0)  # scaled as it was


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"prim": "/World/hel"}, "choose one of /World/heli"),
        ({"prim": "heli"}, "give one such as /World/heli"),
        ({"usd": "none.usda"}, "no such file"),
        ({"frames": [1001, 2000]}, "the blocking goes from 1001 to 1100"),
        ({"prim": "/World/heli/box", "forward": "Z"}, "up axis"),
        ({"use": ["place"]}, "position"),
    ],
)
def test_unreadable_blockings_are_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    stage_with(tmp_path / "in.usda")
    with pytest.raises(ShotError, match=says):
        Shot.from_dict(shot_with(change), tmp_path).solve()


def test_the_chosen_frames_are_named(tmp_path: Path) -> None:
    from vehsim.cli.arguments import chosen_frames

    stage_with(tmp_path / "in.usda", keys={**KEYS, 1060: KEYS[1050]})
    (line,) = chosen_frames(Shot.from_dict(shot_with({}), tmp_path))
    assert line == "heli: marks from /World/heli at frames 1001, 1050 to 1060, 1100"
    (line,) = chosen_frames(Shot.from_dict(shot_with({"frames": [1010, 1090]}), tmp_path))
    assert line.endswith("at frames 1010, 1090")


def test_another_frame_rate_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="24 time codes per second, the shot 30"):
        read_blocking(stage_with(tmp_path / "in.usda"), "/World/heli", Fraction(30))


@pytest.mark.broken_stages
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_keys_that_are_not_numbers_are_named(tmp_path: Path, value: float) -> None:
    stage = stage_with(tmp_path / "in.usda", keys={**KEYS, 1060: ((value, 0.0, 0.0), 0.0)})
    with pytest.raises(InputError, match=r"in.usda: /World/heli: its transform is not a number at frame 1051"):
        read_blocking(stage, "/World/heli", FPS)


def shot_with(change: dict[str, Any]) -> dict[str, Any]:
    marks = {"usd": "in.usda", "prim": "/World/heli", **change}
    motion = {"method": "plan", "segments": 16, "marks": marks}
    return {
        "shot": {"schema": 1, "name": "blocked"},
        "vehicle": [{"name": "heli", "asset": "helicopter", "motion": motion}],
    }


def test_a_shot_hits_its_blocking_and_reports_departures(tmp_path: Path) -> None:
    stage_with(tmp_path / "in.usda", "Y", 0.01)
    take = Shot.from_dict(shot_with({"tolerance": 0.2}), tmp_path).solve()
    clip = take.clips["heli"].resample()
    for frame, (place, heading) in KEYS.items():
        k = frame - 1001
        assert np.abs(clip.positions[k] - place).max() <= 0.2 + 1e-6
        nose = clip.matrices()[k, :3, 0]
        assert np.degrees(np.arctan2(nose[1], nose[0])) == pytest.approx(heading, abs=1e-3)
    report = take.report["vehicles"]["heli"]["blocking"]
    assert report["keys"] == [1001, 1050, 1100]
    own = read_blocking(tmp_path / "in.usda", "/World/heli", FPS)
    off = np.linalg.norm(clip.positions - own.positions, axis=1)
    assert report["largest"] == pytest.approx(off.max()) and report["largest_frame"] == 1001 + off.argmax()
    folder = take.export(tmp_path / "out")
    over(tmp_path, "Y", 0.01, folder / "layers" / "heli.blocking.usdc")
    shown = read_blocking(tmp_path / "both.usda", "/World/heli", FPS)
    assert np.allclose(shown.positions, clip.positions, atol=1e-5)


def test_the_nearest_rotations_are_those_of_a_singular_value_decomposition():
    """For turns with a scale, which are common, and for shears and mirrors, for which no root suffices."""
    random = np.random.default_rng(3)
    turns = Rotation.random(60, random_state=3).as_matrix()
    for matrices in (turns, 0.01 * turns, turns @ np.diag([1.0, 1.0, -1.0]), turns @ np.diag([1.0, 2.0, 1 + 1e-13])):
        mixed = np.concatenate([matrices, matrices + 0.3 * random.normal(size=matrices.shape)])
        u, _, v = np.linalg.svd(mixed)
        u[..., -1] *= np.sign(np.linalg.det(u @ v))[:, None]
        found = nearest_rotations(mixed)
        assert np.abs(found @ found.swapaxes(1, 2) - np.eye(3)).max() < 1e-13 and (np.linalg.det(found) > 0).all()
        assert (
            np.abs(
                np.trace(found.swapaxes(1, 2) @ mixed, axis1=1, axis2=2)
                - np.trace((u @ v).swapaxes(1, 2) @ mixed, axis1=1, axis2=2)
            ).max()
            < 1e-12
        )
