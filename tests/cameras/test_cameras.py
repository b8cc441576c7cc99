"""Every rig keeps its target framed and its horizon level, stays above the ground and moves smoothly."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from fractions import Fraction
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from vehsim import cameras
from vehsim.cameras import framing
from vehsim.cameras.camera import CameraRig
from vehsim.cameras.cuts import shown_of
from vehsim.cameras.framing import JERK, solve_camera, vehicle_outline
from vehsim.cameras.path import Levels
from vehsim.clip.clip import Clip
from vehsim.errors import InputError
from vehsim.lie import SE3
from vehsim.vehicles import load_vehicle
from vehsim.world.obstacles.obstacles import box
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

ASPECT = 16 / 9
FPS = 24
UP = np.array([0.0, 0.0, 1.0])


def clip_along(positions, yaw, bank=0.0):
    """A vehicle of a 2 m cube on ``positions`` (n, 3), one per frame, rotated to ``yaw`` and rolled by ``bank``."""
    n = len(positions)
    euler = np.stack([np.broadcast_to(yaw, n), np.zeros(n), np.broadcast_to(bank, n)], axis=1)
    orientations = Rotation.from_euler("ZYX", euler).as_quat(scalar_first=True)
    signs = np.where((orientations[1:] * orientations[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    orientations *= np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    vehicle = SimpleNamespace(name="cube", joints=(), control_names=(), rig=None, group=SE3)
    times = np.arange(n) / FPS
    twists = np.zeros((n, 6))
    velocity = np.gradient(positions, 1 / FPS, axis=0)
    twists[:, 3:] = Rotation.from_quat(orientations, scalar_first=True).inv().apply(velocity)
    empty = np.zeros((n, 0))
    return Clip(vehicle, times, positions, orientations, twists, empty, empty, empty, {}, Fraction(FPS), 1001)  # type: ignore[arg-type]


T = np.arange(121) / FPS
MOTIONS = {
    "hover": clip_along(np.tile([0.0, 0, 30], (121, 1)), 0.3),
    "straight": clip_along(np.stack([15 * T, 0 * T, 30 + 0 * T], 1), 0.0),
    "jittery": clip_along(np.stack([15 * T, 0 * T, 30 + 0 * T], 1), 0.3 * np.sin(40 * T), 0.3 * np.cos(37 * T)),
    "shaking": clip_along(np.stack([15 * T, 0.15 * np.sin(40 * T), 30 + 0.1 * np.cos(43 * T)], 1), 0.0),
    "circle": clip_along(np.stack([6 * np.sin(1.5 * T), 6 - 6 * np.cos(1.5 * T), 30 + 0 * T], 1), 1.5 * T),
    "start and stop": clip_along(np.stack([20 * (1 - np.cos(1.25 * T)), 0 * T, 30 + 0 * T], 1), 0.0),
}


@pytest.fixture(scope="module")
def hills():
    x, y = np.meshgrid(np.arange(-150, 151, 3.0), np.arange(-150, 151, 3.0))
    return World(Terrain("hills", 14 * np.sin(x / 17) * np.cos(y / 13) + 12, (-150.0, -150.0), (3.0, 3.0)))


def rotations(camera):
    return Rotation.from_quat(camera.orientations, scalar_first=True).as_matrix()


def on_screen(camera, clip):
    """Normalised picture coordinates (n, k, 2), -1 to 1, of the cube's corners, by USD's own frustum."""
    from pxr import Gf

    corners = np.array([[x, y, z, 1] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
    result = np.empty((len(camera.frames), 8, 2))
    for k, matrix in enumerate(clip.matrices()):
        lens = Gf.Camera()
        lens.focalLength = camera.lens_mm
        lens.horizontalAperture, lens.verticalAperture = camera.aperture_mm
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotations(camera)[k], camera.positions[k]
        lens.transform = Gf.Matrix4d(*pose.T.ravel().tolist())
        view = lens.frustum.ComputeViewMatrix() * lens.frustum.ComputeProjectionMatrix()
        for j, corner in enumerate(corners):
            result[k, j] = view.Transform(Gf.Vec3d(*(matrix @ corner)[:3]))[:2]
    return result


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("rig", ["chase", "follow", "orbit"])
def test_target_fills_its_share_of_the_frame(rig, motion):
    clip = MOTIONS[motion]
    camera = solve_camera(CameraRig(rig=rig), {"cube": clip}, World(), (1001, 1121), ASPECT)
    seen = on_screen(camera, clip)
    heights = np.ptp(seen[..., 1], axis=1) / 2
    assert heights.min() >= 0.08 and heights.max() <= 0.37  # 0.35 of it upright: one jitters from side to side
    assert np.abs(seen).max() < 0.95, "inside the frame"


@pytest.mark.parametrize("pitch", [40, 60, -60])
def test_steeply_pitched_targets_stay_large(pitch):
    """From behind, a helicopter of 13 m appears 3 m high, and 10 m when it dives: this is no reason to move far
    away."""
    dive = np.radians(pitch) * np.clip(np.minimum(T - 1, 4 - T), 0, 1)
    positions = np.stack([25 * T, 0 * T, 60 + 0 * T], 1)
    helicopter, still = load_vehicle("helicopter"), clip_along(positions, 0.0)
    turns = Rotation.from_euler("Y", dive[:, None]).as_quat(scalar_first=True)
    empty, none = np.zeros((len(T), 0)), np.zeros((len(T), len(helicopter.control_names)))
    channels = {name: np.zeros(len(T)) for name in helicopter.channels}
    clip = Clip(helicopter, still.times, positions, turns, still.twists, empty, empty, none, channels, still.fps, 1001)
    camera = solve_camera(CameraRig(), {"it": clip}, World(), (1001, 1121), ASPECT)
    outline = vehicle_outline(helicopter)
    corners = outline @ clip.matrices()[:, :3, :3].swapaxes(1, 2) + clip.positions[:, None]
    seen = (corners - camera.positions[:, None]) @ rotations(camera)
    across, along = (np.ptp(seen[..., k] / -seen[..., 2], axis=1) * 35 / 20.25 for k in (0, 1))
    assert along.max() < 0.62 and across.min() > 0.45
    assert along[[0, -1]].min() > 0.19, "level, it is no smaller for what it does elsewhere"
    apart = np.linalg.norm(camera.positions - clip.positions, axis=1)
    assert apart.max() < 2.1 * 21.1  # where it stands behind one that stays level


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("rig", sorted(cameras.RIGS))
def test_horizon_is_level_and_the_camera_upright(rig, motion):
    camera = solve_camera(CameraRig(rig=rig, level=True), {"cube": MOTIONS[motion]}, World(), (1001, 1121), ASPECT)
    R_wc = rotations(camera)
    assert np.abs(R_wc[:, 2, 0]).max() < 1e-9
    assert R_wc[:, 2, 1].min() > 0.5
    assert np.abs(np.linalg.norm(camera.orientations, axis=1) - 1).max() < 1e-12
    assert ((camera.orientations[1:] * camera.orientations[:-1]).sum(axis=1) > 0).all()


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("rig", sorted(cameras.RIGS))
def test_camera_stays_above_the_ground_and_sees_its_target(hills, rig, motion):
    clip = MOTIONS[motion]
    camera = solve_camera(CameraRig(rig=rig), {"cube": clip}, hills, (1001, 1121), ASPECT)
    if rig == "first_person":  # where its vehicle goes
        return
    half = np.array(camera.aperture_mm) / (2 * camera.lens_mm) * camera.clip_range[0]
    corners = np.array([[x, y, -camera.clip_range[0]] for x in (-half[0], half[0]) for y in (-half[1], half[1])])
    near = camera.positions[:, None] + corners @ rotations(camera).swapaxes(1, 2)
    assert (near[..., 2].ravel() > hills.height(near[..., :2].reshape(-1, 2))).all(), "the near plane is in the ground"
    above = camera.positions[:, 2] - hills.height(camera.positions[:, :2])
    assert above.min() >= 1.5 - 1e-6 > camera.clip_range[0]
    along = np.linspace(0, 0.75, 40)[:, None, None]
    sight = camera.positions + along * (clip.positions + UP - camera.positions)
    assert (hills.height(sight[..., :2].reshape(-1, 2)) - sight[..., 2].ravel()).max() < 0.3


@pytest.mark.parametrize("motion", ["straight", "jittery", "shaking", "circle", "start and stop"])
def test_chase_moves_smoothly(motion):
    """Its jerk is of the order of the path's own for any motion of the body, and in hover it does not move at all."""
    camera = solve_camera(CameraRig(), {"cube": MOTIONS[motion]}, World(), (1001, 1121), ASPECT)
    jerk = np.linalg.norm(np.diff(camera.positions, 3, axis=0), axis=1) * FPS**3
    assert jerk.max() < 60.0  # m/s^3; an unfiltered circle has 20, the jittery body 14,000
    turned = np.diff(Rotation.from_quat(camera.orientations, scalar_first=True).as_euler("ZXY"), axis=0) * FPS
    assert np.abs(np.diff(turned, axis=0)).max() * FPS < 12.0  # rad/s^2


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize("rig", sorted(set(cameras.RIGS) - {"first_person"}))
def test_jerk_is_bounded_over_hills_too(hills, rig, motion):
    camera = solve_camera(CameraRig(rig=rig, distance=12.0), {"cube": MOTIONS[motion]}, hills, (1001, 1121), ASPECT)
    jerk = np.linalg.norm(np.diff(camera.positions, 3, axis=0), axis=1) * FPS**3
    assert jerk.max() <= JERK * 14.0


BLOCKS = {  # motion -> centre (x, y) m and size (x, y, z) m of a box that stands on 24 m, beside the cube's way
    "straight": ((40.0, -5.0), (12.0, 4.0, 9.0)),
    "circle": ((0.0, 6.0), (5.0, 5.0, 10.0)),
    "start and stop": ((20.0, -6.0), (20.0, 3.0, 9.0)),
}


def within(points, motion, more=0.0):
    """Whether ``points`` (..., 3) are in the motion's box, or ``more`` m beside it."""
    centre, size = BLOCKS[motion]
    lower = np.array([centre[0] - size[0] / 2, centre[1] - size[1] / 2, 24.0])
    return ((points > lower - more) & (points < lower + size + more)).all(axis=-1)


@pytest.mark.parametrize(
    ("rig", "motion"),  # no straight rail has a view of a target that circles a block
    [pair for pair in product(("chase", "follow", "orbit", "dolly"), BLOCKS) if pair != ("dolly", "circle")],
)
def test_camera_sees_its_target_past_obstacles(rig, motion):
    clip, (centre, size) = MOTIONS[motion], BLOCKS[motion]
    world = World(obstacles=[box("block", (*centre, 24.0), size)])
    rows = CameraRig(rig=rig, distance=14.0, height=2.0)
    camera = solve_camera(rows, {"cube": clip}, world, (1001, 1121), ASPECT)
    sight = camera.positions + np.linspace(0, 1, 500)[:, None, None] * (clip.positions + UP - camera.positions)
    assert not within(sight, motion).any(), "hidden"
    assert not within(camera.positions, motion, 0.5).any(), "in the obstacle"
    jerk = np.linalg.norm(np.diff(camera.positions, 3, axis=0), axis=1) * FPS**3
    assert jerk.max() <= JERK * 14.0


def from_garage():
    """It leaves a garage, open ahead of it."""
    walls = [((0, 3), (8, 0.4, 3)), ((0, -3), (8, 0.4, 3)), ((-4, 0), (0.4, 6, 3))]
    t = np.clip(np.arange(300) / FPS - 2, 0, None)
    x = np.where(t < 4, t**2, 8 * t - 16)
    return np.stack([x, 0 * x, 0 * x], 1), 0 * x, [((0, 0, 3), (8, 6, 0.4)), *(((*at, 0), size) for at, size in walls)]


def around_wall():
    """It turns back round the end of a wall, lower than the camera can climb."""
    along = np.arange(480) * 6.0 / FPS
    yaw = np.clip((along - 40) / 5, 0, np.pi)
    arc = np.stack([40 + 5 * np.sin(yaw), 5 - 5 * np.cos(yaw), 0 * yaw], 1)
    arc[:, 0] += np.minimum(along - 40, 0) - np.maximum(along - 40 - 5 * np.pi, 0)
    return arc, yaw, [((20, 5, 0), (36, 4, 4))]


@pytest.mark.parametrize("drive", [from_garage, around_wall])
def test_a_chase_camera_soon_comes_down_behind_an_obstacle(drive):
    """It looked steeply down for three to five seconds after its usual place had a clear view again."""
    positions, yaw, boxes = drive()
    clip, frames = clip_along(positions, yaw), (1001, 1000 + len(positions))
    world = World("flat", obstacles=[box(f"b{k}", *where) for k, where in enumerate(boxes)])
    camera, usual = (solve_camera(CameraRig(), {"cube": clip}, w, frames, ASPECT) for w in (world, World("flat")))
    aims = positions + UP

    def steepness(of):
        away = of.positions - aims
        return np.degrees(np.arctan2(away[:, 2], np.linalg.norm(away[:, :2], axis=1)))

    def inside(points, more=0.0):
        lower = [np.array(centre) - np.array(size) * (0.5, 0.5, 0) for centre, size in boxes]
        return sum(
            ((points > low - more) & (points < low + size + more)).all(axis=-1)
            for low, (_, size) in zip(lower, boxes, strict=True)
        )

    hidden = inside(usual.positions + np.linspace(0, 1, 200)[:, None, None] * (aims - usual.positions)).any(axis=0)
    free = int(np.flatnonzero(hidden).max()) + 1
    steeper = steepness(camera) - steepness(usual)
    assert steeper[:free].max() > 20, "it does climb"
    assert steeper[free + 2 * FPS :].max() < 5
    assert not inside(camera.positions, 0.5).any()
    jerk = np.linalg.norm(np.diff(camera.positions, 3, axis=0), axis=1) * FPS**3
    assert jerk.max() <= JERK * np.linalg.norm(camera.positions - aims, axis=1).mean()


def test_an_obstacle_outside_the_view_does_not_move_the_camera():
    far = World(obstacles=[box("block", (0.0, 300.0, 24.0), (5.0, 5.0, 9.0))])
    for rig in ("chase", "follow", "dolly", "static"):
        alone, beside = (
            solve_camera(CameraRig(rig=rig), {"cube": MOTIONS["circle"]}, world, (1001, 1121), ASPECT)
            for world in (World(), far)
        )
        assert np.array_equal(alone.positions, beside.positions)


def test_a_dolly_rides_its_rail_abreast_of_the_target():
    clip, rig = MOTIONS["straight"], CameraRig(rig="dolly", position=(10.0, -20.0, 31.0), to=(60.0, -30.0, 35.0))
    camera = solve_camera(rig, {"cube": clip}, World(), (1001, 1121), ASPECT)
    rail = np.subtract(rig.to, rig.position) / np.linalg.norm(np.subtract(rig.to, rig.position))
    off = camera.positions - rig.position
    along = off @ rail
    assert np.abs(off - np.outer(along, rail)).max() < 1e-9
    assert along.min() > -1e-9 and along.max() < np.linalg.norm(np.subtract(rig.to, rig.position)) + 1e-9
    middle = slice(40, 80)  # away from the rail's ends it is where the target is nearest
    assert np.abs(((clip.positions + UP - camera.positions) @ rail)[middle]).max() < 1.0
    chosen = solve_camera(CameraRig(rig="dolly"), {"cube": clip}, World(), (1001, 1121), ASPECT)
    assert np.abs(on_screen(chosen, clip)).max() < 0.95


def hidden_frames(camera, clip, centre, size):
    """Number of frames on which the line to the middle of the cube intersects a box; ``centre``: that of its bottom."""
    half = np.array([*size[:2], 0.0]) / 2
    low, high = np.subtract(centre, half), np.add(centre, half) + np.array([0.0, 0.0, size[2]])
    along = np.linspace(0, 0.9, 200)[:, None, None]
    sight = camera.positions + along * (clip.positions + UP - camera.positions)
    return int(((sight > low) & (sight < high)).all(axis=2).any(axis=0).sum())


@pytest.mark.parametrize("rig", ["dolly", "crane", "static", "fly_by"])
@pytest.mark.parametrize("side", [1, -1])
def test_an_unplaced_camera_stands_on_the_open_side_of_a_wall(rig, side):
    clip, wall = MOTIONS["straight"], ((40.0, 4.5 * side, 0.0), (200.0, 1.0, 60.0))
    world = World(obstacles=[box("wall", *wall)])
    camera = solve_camera(CameraRig(rig=rig), {"cube": clip}, world, (1001, 1121), ASPECT)
    assert (camera.positions[:, 1] * side < 4.0).all() and hidden_frames(camera, clip, *wall) == 0


def fills(camera, clip):
    """Share (n,) of the picture's height that the cube occupies."""
    return np.ptp(on_screen(camera, clip)[..., 1], axis=1) / 2


def round_a_bend():
    """It goes 14 m round a bend, and hovers at the end of it."""
    t = np.clip(np.linspace(-0.2, 1.6, 300), 0, 1)
    t = t**2 * (3 - 2 * t)
    return clip_along(np.stack([14 * t, 5 * np.sin(np.pi * t), 10 + 0 * t], 1), 0.3 - 0.8 * t)


@pytest.mark.parametrize("beside", [-4.0, 4.0])
def test_a_crane_rises_steadily_beside_a_chimney(beside):
    """It rose to look over a chimney that hid its target for a moment, and sank again."""
    clip, chimney = MOTIONS["straight"], ((42.0, beside, 0.0), (1.5, 1.5, 36.0))
    world = World(obstacles=[box("chimney", *chimney)])
    camera = solve_camera(CameraRig(rig="crane"), {"cube": clip}, world, (1001, 1121), ASPECT)
    away = np.linalg.norm(camera.positions - clip.positions, axis=1).min()
    rise = np.diff(camera.positions[:, 2])
    assert (rise >= 0).all() and 0 < rise.max() < 0.03 * away and np.ptp(camera.positions[:, :2], axis=0).max() < 1e-9
    assert hidden_frames(camera, clip, *chimney) == 0


@pytest.mark.parametrize(("azimuth", "usual"), [(None, 0.27), (20.0, 0.17)])
def test_a_crane_is_as_near_as_the_whole_way_of_its_target_allows(azimuth, usual):
    """Of the distances that it tried in turn, one was too near, the next one several times too far; and it stood where
    its target came too near."""
    clip = round_a_bend()
    camera = solve_camera(CameraRig(rig="crane", azimuth=azimuth), {"cube": clip}, World(), (1001, 1300), ASPECT)
    seen = fills(camera, clip)
    assert np.median(seen) > usual and seen.min() > 0.15 and seen.max() < 0.36


def test_an_unplaced_dolly_rides_where_a_house_does_not_hide_wheels():
    """It rode behind the house: its line of sight to the target's middle passed over the roof."""
    t = np.linspace(0, 1, 240)
    clip = clip_along(np.stack([40 * t, 0 * t, 0 * t], 1), 0.0)
    houses = [((20.0, 8.0, 0.0), (14.0, 6.0, 2.6)), ((20.0, -8.0, 0.0), (14.0, 6.0, 2.2))]
    world = World("flat", obstacles=[box(f"house{k}", *each) for k, each in enumerate(houses)])
    camera = solve_camera(CameraRig(rig="dolly"), {"cube": clip}, world, (1001, 1240), ASPECT)
    low = replace(clip, positions=clip.positions - (0.0, 0.0, 0.8))  # whose middle is 0.2 m above the ground
    assert sum(hidden_frames(camera, low, *each) for each in houses) == 0
    rail = camera.positions[-1] - camera.positions[0]
    off = np.cross(camera.positions - camera.positions[0], rail) / np.linalg.norm(rail)
    assert np.abs(off).max() < 1e-6 and np.linalg.norm(rail) > 38, "straight, as long as the way"
    lead = (camera.positions - clip.positions) @ rail / np.linalg.norm(rail)
    assert np.ptp(lead) < 2.0, "it keeps pace"


def test_cameras_avoid_parked_vehicles_like_obstacles():
    clip = MOTIONS["start and stop"]
    alone = solve_camera(CameraRig(rig="follow"), {"cube": clip}, World(), (1001, 1121), ASPECT)
    place = (clip.positions + alone.positions)[60] / 2
    parked, block = clip_along(np.tile(place, (121, 1)), 0.0), box("block", tuple(place), (2.0, 2.0, 2.0))
    camera = solve_camera(CameraRig(rig="follow"), {"cube": clip, "parked": parked}, World(), (1001, 1121), ASPECT)
    obstacle = solve_camera(CameraRig(rig="follow"), {"cube": clip}, World(obstacles=[block]), (1001, 1121), ASPECT)
    assert np.abs(camera.positions - obstacle.positions).max() < 1e-6
    before, after = (hidden_frames(each, clip, place, (2.0, 2.0, 2.0)) for each in (alone, camera))
    assert before > 5 and after < before / 2
    driven = {"cube": clip, "other": MOTIONS["straight"]}  # who moves is part of the picture
    moved = solve_camera(CameraRig(rig="follow"), driven, World(), (1001, 1121), ASPECT)
    assert np.array_equal(moved.positions, alone.positions)


def outside(camera, clip):
    """Distance (n,) m of the camera from the moving cube; negative inside."""
    turns = Rotation.from_quat(clip.orientations, scalar_first=True)
    away = np.abs(turns.inv().apply(camera.positions - clip.positions - UP)) - 1.0
    return np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)


def cuts_in():
    """It overtakes another one and stops ahead of it, at less than the camera's distance."""
    s = np.linspace(0, 1, 240)[:, None]
    s = s**3 * (10 - 15 * s + 6 * s**2)
    aside = 3.5 * np.exp(-(((s - 0.5) / 0.2) ** 2))
    first, second = np.hstack([60 * s, aside, 0 * s]), np.hstack([18 + 34 * s, 0 * s, 0 * s])
    return clip_along(first, 0.0), clip_along(second, 0.0), CameraRig(height=0.3, distance=8.0, margin=1.0)


def meets_another():
    """Another one comes towards it, in the lane in which the camera travels."""
    x = 8 * np.linspace(0, 8, 193)
    first = clip_along(np.stack([x, 0 * x, 0 * x], 1), 0.0)
    second = clip_along(np.stack([70 - x, 0 * x - 5.0, 0 * x], 1), np.pi)
    return first, second, CameraRig(rig="follow", azimuth=90.0, distance=5.1, height=0.6, lens_mm=24.0)


@pytest.mark.parametrize("drive", [cuts_in, meets_another])
def test_a_camera_does_not_go_through_another_vehicle(drive):
    """Moving vehicles were no obstacles for it."""
    clip, other, rig = drive()
    frames = (1001, 1000 + len(clip.times))
    alone = solve_camera(rig, {"cube": clip}, World("flat"), frames, ASPECT)
    assert outside(alone, other).min() < 0, "it would go through"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        camera = solve_camera(rig, {"cube": clip, "other": other}, World("flat"), frames, ASPECT)
    assert outside(camera, other).min() > 0.4 * rig.margin
    assert np.abs(on_screen(camera, clip)).max() < 0.95
    jerk = np.linalg.norm(np.diff(camera.positions, 3, axis=0), axis=1) * FPS**3
    assert jerk.max() <= JERK * 1.5 * rig.distance
    away = np.linalg.norm(camera.positions - alone.positions, axis=1)
    assert np.median(away) < 1.0, "it moves aside for a while only"


def test_a_camera_is_named_that_a_vehicle_drives_through():
    clip, other, _ = meets_another()
    placed = CameraRig("kerb", rig="static", position=(30.0, -5.0, 1.6))
    (message,) = warned(placed, {"cube": clip, "truck": other}, World("flat"))
    assert "goes through the vehicle 'truck' at frame 11" in message
    assert not warned(replace(placed, position=(30.0, -8.0, 1.6)), {"cube": clip, "truck": other}, World("flat"))


def test_a_camera_through_an_obstacle_or_behind_one_is_named():
    clip = MOTIONS["straight"]
    low = replace(clip, positions=clip.positions - (0, 0, 30.0))
    house = World("flat", obstacles=[box("house", (40.0, -12.0, 0.0), (14.0, 8.0, 6.0))])
    rail = CameraRig("rail", rig="dolly", position=(0.0, -12.0, 2.0), to=(70.0, -12.0, 2.0))
    (message,) = warned(rail, {"cube": low}, house)
    assert "goes through the obstacle 'house'" in message
    behind = CameraRig("kerb", rig="static", position=(40.0, -25.0, 2.0))
    (message,) = warned(behind, {"cube": low}, house)
    assert "hide most of its target" in message
    first = 1001 + int(np.argmax(np.abs(low.positions[:, 0] - 40.0) / 25.0 < 7.0 / 9.0))
    assert abs(int(message.split("first in ")[1].split(";")[0]) - first) <= 3
    elsewhere = replace(behind, look_at=(40.0, -60.0, 2.0))
    assert not [said for said in warned(elsewhere, {"cube": low}, house) if "hide" in said], "it looks elsewhere"
    post = World("flat", obstacles=[box("post", (40.0, -12.0, 0.0), (0.3, 0.3, 6.0))])
    assert not warned(behind, {"cube": low}, post)


def test_a_crane_rises_by_the_requested_amount_from_rest_to_rest():
    clip, rig = MOTIONS["straight"], CameraRig(rig="crane", position=(30.0, -25.0, 31.0), rise=8.0)
    camera = solve_camera(rig, {"cube": clip}, World(), (1001, 1121), ASPECT)
    assert np.abs(camera.positions[:, :2] - rig.position[:2]).max() < 1e-9
    height = camera.positions[:, 2]
    assert (height[0], height[-1]) == pytest.approx((31.0, 39.0)) and (np.diff(height) >= -1e-9).all()
    assert height[1] - height[0] < 1e-3 and height[-1] - height[-2] < 1e-3


def test_a_fly_by_camera_is_close_and_pans_with_its_target():
    clip = MOTIONS["straight"]
    camera = solve_camera(CameraRig(rig="fly_by"), {"cube": clip}, World(), (1001, 1121), ASPECT)
    assert np.ptp(camera.positions, axis=0).max() < 1e-9
    heights = np.ptp(on_screen(camera, clip)[..., 1], axis=1) / 2
    assert 0.2 < heights.max() < 0.45 and heights[0] < 0.3 * heights.max()
    assert 60 < heights.argmax() < 100


def test_first_person_is_fixed_to_its_vehicle_and_banks_by_default():
    clip = MOTIONS["jittery"]
    rig = CameraRig(rig="first_person", eye=(0.5, 0.2, 1.8))
    camera = solve_camera(rig, {"cube": clip}, World(), (1001, 1121), ASPECT)
    T_wr = clip.matrices()
    assert np.allclose(camera.positions, (T_wr @ (0.5, 0.2, 1.8, 1.0))[:, :3], atol=1e-9)
    R_wc = rotations(camera)
    assert np.allclose(-R_wc[:, :, 2], T_wr[:, :3, 0], atol=1e-9)  # looks ahead
    assert np.allclose(R_wc[:, :, 1], T_wr[:, :3, 2], atol=1e-9)  # its up is the vehicle's


@pytest.mark.parametrize("framing", [(1 / 3, 0.0), (-0.5, 0.25), (0.0, -1 / 3)])
@pytest.mark.parametrize("rig", ["chase", "static", "orbit"])
def test_framing_places_the_target_in_the_picture(rig, framing):
    clip = MOTIONS["hover"]
    camera = solve_camera(CameraRig(rig=rig, framing=framing), {"cube": clip}, World(), (1001, 1121), ASPECT)
    assert np.abs(on_screen(camera, clip).mean(axis=1) - framing).max() < 0.06


def test_a_cut_equals_each_camera_in_turn_and_jumps_between_frames():
    clip = MOTIONS["straight"]
    rigs = [CameraRig(name="near"), CameraRig(name="far", rig="static", lens_mm=85.0)]
    both = {rig.name: solve_camera(rig, {"cube": clip}, World(), (1001, 1121), ASPECT) for rig in rigs}
    cut = cameras.cut("cut", both, [(1001, "near"), (1041, "far"), (1081, "near")])
    assert (np.diff(cut.frames) > 0).all()
    whole = np.isin(cut.frames, both["near"].frames)
    assert whole.sum() == 121
    expected = np.where((cut.frames[whole] >= 1041) & (cut.frames[whole] < 1081), 85.0, 35.0)
    assert np.allclose(cut.lens_mm[whole], expected)
    far = expected == 85.0
    assert np.allclose(cut.positions[whole], np.where(far[:, None], both["far"].positions, both["near"].positions))
    # everything that a shutter shows within half a frame of a frame belongs to that frame's camera
    for frame in (1040.0, 1041.0):
        for shutter in (-0.49, 0.49):
            seen = np.array([np.interp(frame + shutter, cut.frames, column) for column in cut.positions.T])
            source = both["near"] if frame < 1041 else both["far"]
            there = np.array([np.interp(frame + shutter, source.frames, column) for column in source.positions.T])
            assert np.allclose(seen, there, atol=1e-6)


@pytest.mark.parametrize(
    ("cuts", "message"),
    [
        ([], "one after the other"),
        ([(1001, "near"), (1001, "near")], "one after the other"),
        ([(1001, "nowhere")], "choose one of near"),
        ([(1001, "near"), (1010, "wide")], "film backs"),
    ],
)
def test_invalid_cuts_are_named(cuts, message):
    rigs = [CameraRig(name="near"), CameraRig(name="wide", aperture_width_mm=24.0)]
    both = {rig.name: solve_camera(rig, {"cube": MOTIONS["hover"]}, World(), (1001, 1121), ASPECT) for rig in rigs}
    with pytest.raises(InputError, match=message):
        cameras.cut("cut", both, cuts)


def test_chase_stands_still_while_its_target_hovers():
    camera = solve_camera(CameraRig(), {"cube": MOTIONS["hover"]}, World(), (1001, 1121), ASPECT)
    assert np.ptp(camera.positions, axis=0).max() < 1e-9


def test_chase_stays_behind():
    camera = solve_camera(CameraRig(), {"cube": MOTIONS["straight"]}, World(), (1001, 1121), ASPECT)
    offset = camera.positions - MOTIONS["straight"].positions
    assert (offset[:, 0] < -3).all() and np.abs(offset[:, 1]).max() < 0.1 * np.abs(offset[:, 0]).min()


def test_static_camera_stands_where_it_is_put_and_pans(hills):
    clip = MOTIONS["straight"]
    rig = CameraRig(rig="static", position=(30.0, -60.0, 45.0))
    camera = solve_camera(rig, {"cube": clip}, World(), (1001, 1121), ASPECT)
    assert np.abs(camera.positions - rig.position).max() < 1e-9
    assert np.abs(on_screen(camera, clip)).max() < 0.5
    fixed = solve_camera(CameraRig(rig="fixed", position=(30.0, -60.0, 45.0), look_at=(30.0, 0.0, 30.0)),
                         {"cube": clip}, World(), (1001, 1121), ASPECT)  # fmt: skip
    assert np.ptp(fixed.orientations, axis=0).max() < 1e-12


def test_a_camera_put_under_the_ground_is_raised_over_it(hills):
    clip, rig = MOTIONS["hover"], CameraRig(rig="static", position=(20.0, 20.0, 0.0))
    camera = solve_camera(rig, {"cube": clip}, hills, (1001, 1121), ASPECT)
    assert camera.positions[0, 2] >= hills.height([[20.0, 20.0]])[0] + rig.margin - 1e-9
    assert np.ptp(camera.positions, axis=0).max() == 0.0


def test_distance_and_lens_are_obeyed():
    clip = MOTIONS["hover"]
    camera = solve_camera(CameraRig(distance=25.0, lens_mm=50.0), {"cube": clip}, World(), (1001, 1121), ASPECT)
    assert camera.lens_mm == 50.0
    assert np.allclose(np.linalg.norm(camera.positions - (clip.positions + UP), axis=1), 25.0, rtol=0.02)
    assert camera.aperture_mm == pytest.approx((36.0, 20.25))


def test_the_subject_is_constant_beyond_the_clips_ends():
    camera = solve_camera(CameraRig(), {"cube": MOTIONS["straight"]}, World(), (990, 1130), ASPECT)
    assert camera.frames[0] == 990 and len(camera.frames) == len(camera.positions) == 141


@pytest.mark.parametrize(
    ("rig", "message"),
    [
        (CameraRig(rig="drone"), "choose one of chase"),
        (CameraRig(target="b"), "choose one of cube"),
        (CameraRig(rig="static", position=(1, 2, 3), look_at=(1.0, 2.0, 3.0)), "give another point to look at"),
    ],
)
def test_wrong_rigs_are_named_with_the_remedy(rig, message):
    with pytest.raises(InputError, match=message):
        solve_camera(rig, {"cube": MOTIONS["hover"]}, World(), (1001, 1121), ASPECT)


def rolling(seed, height):
    """Random hills, of waves 40 to 120 m long."""
    random = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-120, 120, 121), np.linspace(-120, 120, 121))
    z = 0 * x
    for _ in range(8):
        k = random.normal(size=2) * 2 * np.pi / random.uniform(40, 120)
        z += height * np.sin(k[0] * x + k[1] * y + random.uniform(0, 2 * np.pi))
    return World(Terrain(f"rolling_{seed}", z, (-120.0, -120.0), (2.0, 2.0)))


@pytest.mark.parametrize("above", [0.0, 5.0], ids=["on the ground", "flying"])
@pytest.mark.parametrize("seed", range(8))
def test_a_chase_camera_stays_behind_its_target_on_hills(seed, above):
    """It is raised over ground that rises behind the target, and not moved beside it; it is never in the ground."""
    world, random = rolling(seed, (1.2, 2.0)[seed % 2]), np.random.default_rng(seed + 100)
    heading, start = random.uniform(-np.pi, np.pi), random.uniform(-40, 40, 2)
    way = start + np.outer(8 * T, [np.cos(heading), np.sin(heading)])
    clip = clip_along(np.column_stack([way, world.height(way) + 1.0 + above]), heading)
    camera = solve_camera(CameraRig(), {"cube": clip}, world, (1001, 1121), ASPECT)
    offset = clip.positions - camera.positions
    off = np.degrees(np.arctan2(offset[:, 1], offset[:, 0]) - heading)
    off = np.abs((off + 180) % 360 - 180)
    assert off[0] < 25 and off.max() < 25
    assert np.min(camera.positions[:, 2] - world.height(camera.positions[:, :2])) > 0.5


def hill_with_a_tunnel(folder, side, high):
    """A hill with a tunnel along X, from y = -``side`` to ``side`` m and ``high`` m high."""
    file = folder / f"tunnel{high}.obj"
    boxes = ((-60, -50, -5), (60, 50, 0)), ((-25, -30, -1), (25, 30, 24)), ((-30, -side, 0), (30, side, high))
    ground, hill, bore = (trimesh.creation.box(bounds=bounds) for bounds in boxes)
    trimesh.boolean.union([ground, trimesh.boolean.difference([hill, bore])]).export(file)
    return World(Terrain.load(file))


@pytest.fixture(scope="module")
def tunnel(tmp_path_factory):
    return hill_with_a_tunnel(tmp_path_factory.mktemp("tunnel"), 6, 12)


def in_hill(positions, side, high):
    x, y, z = positions.T
    return (abs(x) < 25) & (abs(y) < 30) & (z < 24) & ~((abs(y) < side) & (z < high))


@pytest.mark.parametrize("rig", ["chase", "fly_by", "orbit"])
def test_cameras_of_a_flight_through_a_tunnel_are_not_in_its_rock(tunnel, rig):
    through = clip_along(np.stack([14 * T - 35, 0 * T, 5 + 0 * T], 1), 0.0)
    camera = solve_camera(CameraRig("it", rig=rig), {"v": through}, tunnel, (1001, 1121))
    assert not in_hill(camera.positions, 6, 12).any()
    assert rig == "fly_by" or camera.positions[:, 2].max() < 12  # not above the hill, where it saw only the roof


def test_a_chase_camera_follows_a_car_through_a_low_tunnel(tmp_path):
    """2.8 m wide and 3 m high: it sees the car at every frame, along a line that is free of rock."""
    tunnel = hill_with_a_tunnel(tmp_path, 1.4, 3)
    through = clip_along(np.stack([14 * T - 35, 0 * T, 0 * T], 1), 0.0)
    camera = solve_camera(CameraRig("it", rig="chase"), {"v": through}, tunnel, (1001, 1121))
    aims = np.stack([14 * T - 35, 0 * T, 1 + 0 * T], 1)
    for share in np.linspace(0.0, 0.9, 10):
        sight = camera.positions + share * (aims - camera.positions)
        assert not in_hill(sight, 1.4, 3).any() and sight[:, 2].min() > 0


def test_a_fixed_camera_in_a_hill_without_a_tunnel_below_it_is_raised(tunnel):
    there = CameraRig("it", rig="static", position=(0.0, 20.0, 16.0))
    through = clip_along(np.stack([14 * T - 35, 0 * T + 40, 5 + 0 * T], 1), 0.0)
    with pytest.warns(UserWarning, match="is inside the rock, and the camera was raised; give it another place"):
        camera = solve_camera(there, {"v": through}, tunnel, (1001, 1121))
    assert camera.positions[:, 2].min() > 24


@pytest.mark.parametrize(
    ("rig", "place", "says"),
    [
        ("static", (0.0, -20.0, -2.0), "-2.0] is 2 m below the ground, and the camera was raised; give it another"),
        ("fly_by", (0.0, -20.0, -2.0), "2 m below the ground"),
        ("static", (0.0, 30.0, 3.0), "is inside the obstacle 'tower', and the camera stays there"),
        ("static", (0.0, 28.0, 8.5), ""),
        ("static", (0.0, -20.0, 2.0), ""),
        ("static", None, ""),
    ],
)
def test_a_camera_that_is_placed_in_the_ground_or_an_obstacle_is_named(rig, place, says):
    world = World("flat", obstacles=[box("tower", (0, 30, 0), (6, 6, 8))])
    through = clip_along(np.stack([14 * T - 35, 0 * T, 1 + 0 * T], 1), 0.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solve_camera(CameraRig("it", rig=rig, position=place), {"v": through}, world, (1001, 1121))
    said = [str(each.message) for each in caught]
    assert len(said) == bool(says) and all(says in each and "camera 'it': position" in each for each in said)


def test_a_distant_camera_knows_no_more_columns(tunnel):
    levels = Levels(tunnel.terrain.surface)
    assert levels.below(np.array([[0.0, 0.0], [0.0, 20.0]]), np.array([5.0, 5.0]), True).tolist() == [0.0, 24.0]
    assert levels.below(np.array([[0.0, 0.0], [0.0, 20.0]]), np.array([5.0, 5.0]), False).tolist() == [0.0, -np.inf]
    levels.below(np.array([[4000.0, -3000.0]]), np.array([100.0]), False)
    assert levels._levels.size < 8 * 500**2


def test_a_camera_that_cannot_avoid_the_rock_is_named(tunnel):
    there = CameraRig("it", rig="static", position=(0.0, 0.0, 16.0))  # in the roof
    through = clip_along(np.stack([14 * T - 35, 0 * T, 5 + 0 * T], 1), 0.0)
    with pytest.warns(UserWarning, match="camera 'it' is inside the rock at frame 1001; give it another place"):
        solve_camera(there, {"v": through}, tunnel, (1001, 1121))


def test_a_dense_mesh_has_a_light_outline(tmp_path):
    """Cameras project every corner of a vehicle at every frame: 10,242 corners of a ball cost seconds."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(tmp_path / "ball.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/ball").GetPrim())
    mesh, ball = UsdGeom.Mesh.Define(stage, "/ball/hull"), trimesh.creation.icosphere(5, 3.0)
    mesh.CreatePointsAttr(ball.vertices)
    mesh.CreateFaceVertexCountsAttr(np.full(len(ball.faces), 3))
    mesh.CreateFaceVertexIndicesAttr(ball.faces.ravel())
    stage.Save()
    outline = vehicle_outline(SimpleNamespace(rig=SimpleNamespace(asset=tmp_path / "ball.usda", root="")))
    directions = np.random.default_rng(3).normal(size=(200, 3))
    reach = (outline @ directions.T).max(axis=0) / np.linalg.norm(directions, axis=1)
    assert len(outline) <= 2000 and reach.min() > 3.0 * (1 - 3e-3)


def test_frames_without_room_do_not_move_the_whole_camera_away():
    """Where rock leaves no room, the camera backs off for some frames only; each round moved it away for all frames."""
    back = np.where(np.arange(100) < 10, 2.0, 1.0)
    assert framing._rescale(np.full(100, 0.2) / np.sqrt(back), back, 0.2) == pytest.approx(1.0)
    assert framing._rescale(np.full(100, 0.2) * back, np.ones(100), 0.2) == pytest.approx(0.4 / framing.FILL_RANGE[1])


def pitched(degrees, height=20.0):
    """It flies along X with its nose up, more and more."""
    level = clip_along(np.stack([15 * T, 0 * T, height + 0 * T], 1), 0.0)
    turns = Rotation.from_euler("Y", -np.radians(degrees) * T[:, None] / T[-1]).as_quat(scalar_first=True)
    return replace(level, orientations=turns)


def warned(rig, clips, world, shown=None):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        solve_camera(rig, clips, world, (1001, 1121), ASPECT, shown)
    return [str(w.message) for w in caught]


def test_a_static_camera_that_does_not_hold_its_target_is_named():
    """Looking along Y from the middle of the way, it holds a cube of 2 m while that is within its view."""
    clip = MOTIONS["straight"]
    low = replace(clip, positions=clip.positions - (0, 0, 30.0))
    x, half = low.resample().positions[:, 0], 36 / 2 / 35
    rig = CameraRig("kerb", rig="static", position=(x.mean(), -20.0, 2.0), look_at=(x.mean(), 0.0, 2.0))
    (says,) = warned(rig, {"cube": low}, World("flat"))
    out = np.abs(x - x.mean()) - 1 > 21 * half
    first, last = 1001 + np.flatnonzero(out)[[0, -1]]
    found = [int(number) for number in re.findall(r"\d+", says)]
    assert found[:4] == pytest.approx([out.sum(), 121, first, last], abs=2)
    assert says.startswith("camera 'kerb': its target is outside the picture in") and "leave out look_at" in says
    assert not warned(replace(rig, look_at=None), {"cube": low}, World("flat")), "the remedy helps"
    (ahead,) = warned(replace(rig, look_at=(x.mean(), -40.0, 2.0)), {"cube": low}, World("flat"))
    assert "in 121 of 121 frames" in ahead
    parked = replace(low, positions=np.tile((x.mean(), 5.0, 0.0), (len(low.times), 1)))
    assert not warned(rig, {"cube": low, "parked": parked}, World("flat")), "it shows a vehicle, and names no target"
    assert warned(replace(rig, target="cube"), {"cube": low, "parked": parked}, World("flat"))


def test_frames_that_a_cut_list_does_not_show_are_not_warned_of():
    """Of three pieces of a film, two are of a camera: the frames before the next cut belong to it."""
    cuts = ((1001, "away"), (1041, "b"), (1081, "away"))
    pieces = shown_of("away", cuts, 1121)
    assert pieces == [(1001, 1040), (1081, 1121)] and shown_of("c", cuts, 1121) == []
    clip = MOTIONS["straight"]
    low = replace(clip, positions=clip.positions - (0, 0, 30.0))
    x = low.resample().positions[:, 0]
    rig = CameraRig("away", rig="static", position=(x.mean(), -20.0, 2.0), look_at=(x.mean(), -40.0, 2.0))
    for frames, warns in ((pieces, "in 81 of 81 frames"), ([(1001, 1005)], None), (None, "in 121 of 121 frames")):
        texts = warned(rig, {"cube": low}, World("flat"), frames)
        assert not texts if warns is None else warns in texts[0]


def test_a_camera_that_shows_only_the_sky_is_named():
    """From 17 degrees on, the lower edge of the picture is a degree below the horizon or higher."""
    rig, clips = CameraRig(name="nose", rig="first_person"), {"cube": pitched(34)}
    (says,) = warned(rig, clips, World("flat"))
    edge = np.degrees(np.arctan(36 / ASPECT / 2 / 35)) - 1.0
    frames = int((34 * T / T[-1] > edge).sum())
    assert f"camera 'nose' shows only the sky in {frames} of 121 frames, first in {1122 - frames};" in says
    (again,) = warned(rig, clips, World(water=0.0))
    assert again == says
    assert not warned(rig, clips, World()), "there is nothing else to show"
    assert not warned(replace(rig, framing=(0.0, -0.9)), {"cube": pitched(-20)}, World("flat"))
    (tilted,) = warned(replace(rig, framing=(0.0, 0.5)), clips, World("flat"))
    assert int(tilted.split(" frames")[0].split()[-3]) < frames, "the remedy helps"


def test_a_camera_that_looks_up_at_something_is_not_warned_of(hills):
    up, cube = CameraRig(rig="first_person"), pitched(34)
    ahead = clip_along(cube.positions + np.stack([30 + 0 * T, 0 * T, 30 * np.tan(np.radians(34 * T / T[-1]))], 1), 0.0)
    assert not warned(up, {"cube": cube, "ahead": ahead}, World("flat"))
    tower = World("flat", obstacles=[box("tower", (140.0, 0.0, 0.0), (10.0, 10.0, 120.0))])
    assert not warned(up, {"cube": cube}, tower)
    low = CameraRig(rig="static", position=(30.0, -10.0, 2.0))
    assert not warned(low, {"cube": cube}, World("flat")), "it shows its target"
    # a slope ahead of a camera that looks up
    slope = World(Terrain("slope", np.tile(np.linspace(0, 300, 61), (61, 1)), (0.0, -150.0), (5.0, 5.0)))
    still = replace(pitched(0), positions=np.tile([100.0, 0.0, 105.0], (121, 1)))
    turned = Rotation.from_euler("Y", np.full((121, 1), -np.radians(30))).as_quat(scalar_first=True)
    assert not warned(up, {"cube": replace(still, orientations=turned)}, slope)
    assert warned(replace(up, azimuth=180.0), {"cube": replace(still, orientations=turned)}, slope) == []
    (says,) = warned(replace(up, azimuth=0.0), {"cube": replace(still, orientations=turned)}, World("flat"))
    assert "in 121 of 121 frames" in says
