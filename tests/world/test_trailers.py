"""Trailers follow the ground: their wheels touch it, they stay hitched, and clearances see them tilted."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.rig.parts import read_parts, solids
from vehsim.world.ground.placing import place_on_terrain
from vehsim.world.obstacles.obstacles import box, moving
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

TRUCK = vehsim.load_vehicle("truck")


def world_of(height, cell=1.0, size=160.0):
    x = np.arange(-size / 2, size / 2 + cell / 2, cell)
    return World(Terrain("ground", height(*np.meshgrid(x, x)), (x[0], x[0]), (cell, cell)))


def hilly():
    return world_of(lambda x, y: 1.5 * np.sin(2 * np.pi * x / 50) * np.cos(2 * np.pi * y / 40))


def driven(vehicle, world, speed=6.0, seconds=3.0, yaw=0.6, **joints):
    at = (-30.0, -20.0)
    start = vehsim.State(
        position=(*at, float(world.height([at])[0])),
        orientation=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)),
        twist=(0, speed, 0),
        joints=tuple(joints.get(name, 0.0) for name in vehicle.joints),
    )
    return vehsim.simulate(vehicle, world, None, start, duration=seconds, step=1 / 240)


def gaps(clip, world, ops, frames):
    """Smallest signed height (m) above the terrain of each wheel's own mesh.

    ``ops``: the wheel's part -> its chain of (channel, axis, place at rest in the root's frame), outermost first; None
    for an axis slides upwards.
    """
    parts = {part.path: part for part in read_parts(clip.vehicle.rig.asset)}
    found = []
    for k in frames:
        for path, chain in ops.items():
            part = parts[path]
            points = part.points @ part.T_rp[:3, :3].T + part.T_rp[:3, 3]
            for channel, axis, place in reversed(chain):
                value = clip.channels[channel][k]
                if axis is None:
                    points = points + np.array([0, 0, value])
                else:
                    points = (points - place) @ Rotation.from_euler(axis, value).as_matrix().T + place
            points = points @ clip.matrices()[k][:3, :3].T + clip.matrices()[k][:3, 3]
            found.append((points[:, 2] - world.height(points[:, :2])).min())
    return np.array(found)


@pytest.mark.parametrize("name", ["car", "truck"])
def test_springs_end_a_loop_as_they_begin_it(name):
    """They began in equilibrium and ended as the lap left them."""
    vehicle, turn = vehsim.load_vehicle(name), np.linspace(0, 2 * np.pi, 601)
    clip = driven(vehicle, World("flat"), seconds=12.0).at(np.linspace(0, 12, 601))
    yaw = Rotation.from_rotvec(np.outer(turn + np.pi / 2, [0, 0, 1])).as_quat(scalar_first=True)
    twists = np.tile([np.pi / 6, 20 * np.pi / 6, 0.0], (601, 1))
    ring = np.column_stack([20 * np.cos(turn), 20 * np.sin(turn), 0 * turn])
    spun = {channel: values for channel, values in clip.channels.items() if channel.startswith("roll_")}
    still = {joint: 0 * turn for joint in vehicle.joints}
    lap = replace(clip, positions=ring, orientations=yaw, twists=twists, channels=still | spun)
    closed, once = (place_on_terrain(lap, hilly(), loop=loop) for loop in (True, False))
    sprung = [n for n in closed.channels if n in ("heave", "pitch", "roll") or n.startswith(("hitch_p", "hitch_r"))]
    assert len(sprung) == 3 + 2 * (name == "truck")
    assert max(abs(once.channels[channel][-1] - once.channels[channel][0]) for channel in sprung) > 1e-2
    for channel in sprung:
        values, before = closed.channels[channel], once.channels[channel]
        assert values[-1] == pytest.approx(values[0], abs=1e-4) and np.ptp(values) > 0.02
        step = np.diff(values)
        assert abs(step[0] - step[-1]) < 2 * np.abs(np.diff(step)).max()
        assert values[300:] == pytest.approx(before[300:], abs=1e-2)  # what began otherwise fades


def test_every_wheel_of_a_truck_on_hills_touches_the_ground():
    """Every tyre's mesh, posed as USD poses it: within 2 mm of the terrain, in a bend."""
    world = hilly()
    clip = driven(TRUCK, world, sigma=0.2, hitch_1=0.3).resample()
    pin = np.array([-1.8, 0.0, 1.2])
    hitch = [("hitch_1", "Z", pin), ("hitch_pitch_1", "Y", pin), ("hitch_roll_1", "X", pin)]
    ops = {}
    for side, y in (("l", 1.03), ("r", -1.03)):
        rear, front, towed = np.array([[-1.8, y, 0.5], [1.8, y, 0.5], [-8.0, y, 0.5]])
        ops[f"wheel_r{side}"] = [(f"travel_r{side}", None, rear), (f"roll_r{side}", "Y", rear)]
        steered = [(f"travel_f{side}", None, front), (f"steer_f{side}", "Z", front), (f"roll_f{side}", "Y", front)]
        ops[f"steer_f{side}/wheel_f{side}"] = steered
        wheel = [(f"travel_t1_{side}", None, towed), (f"roll_t1_{side}", "Y", towed)]
        ops[f"trailer_1/wheel_t1_{side}"] = [*hitch, *wheel]
    assert np.abs(gaps(clip, world, ops, range(0, len(clip), 8))).max() < 2e-3
    assert np.ptp(clip.channels["hitch_pitch_1"]) > 0.1 and np.ptp(clip.channels["hitch_roll_1"]) > 0.05


@pytest.mark.parametrize("hitch", [0.0, 0.5])
def test_on_an_inclined_plane_a_truck_is_as_straight_as_on_level_ground(hitch):
    """All wheels are in one plane: the trailer does not tilt relative to the tractor at any hitch angle."""
    world = world_of(lambda x, y: 0.08 * x - 0.05 * y)
    clip = driven(TRUCK, world, speed=0.0, seconds=1 / 24, hitch_1=hitch)
    assert abs(clip.channels["pitch"][0]) > 0.02
    lean = 0.015  # of the springs, by weight along the slope
    assert abs(clip.channels["hitch_pitch_1"][0]) < lean and abs(clip.channels["hitch_roll_1"][0]) < 2 * lean
    stiff = replace(TRUCK, rig=replace(TRUCK.rig, suspension=replace(TRUCK.rig.suspension, mass_height=0.0)))
    clip = driven(stiff, world, speed=0.0, seconds=1 / 24, hitch_1=hitch)
    assert clip.channels["hitch_pitch_1"][0] == pytest.approx(0.0, abs=1e-5)
    assert clip.channels["hitch_roll_1"][0] == pytest.approx(0.0, abs=1e-5)


TRAIN = """
schema = 1
name = "train"
model = "truck"
asset = "train.usda"
origin = [0, 0, 0]
[physics]
mass = 7000.0
wheel_inertia = 30.0
yaw_inertia = 30000.0
wheel_radius = 0.5
wheelbase = 3.5
half_track = 1.0
hitches = [5.0, 4.0]
trailer_masses = [6000.0, 5000.0]
trailer_inertias = [40000.0, 30000.0]
[channels.hitch_roll_1]            # channels in any order
prim = "first"
op = "rotateX"
[channels.hitch_pitch_1]
prim = "first"
op = "rotateY"
[channels.hitch_1]
prim = "first"
op = "rotateZ"
[channels.hitch_2]
prim = "first/second"
op = "rotateZ"
[channels.hitch_pitch_2]
prim = "first/second"
op = "rotateY"
[channels.hitch_roll_2]
prim = "first/second"
op = "rotateX"
"""


def road_train(folder):
    """A tractor with two trailers, each hitched at an axle, with their own wheels."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(folder / "train.usda"))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/train").GetPrim())
    text = TRAIN

    def part(path, at, points, faces):
        UsdGeom.Xform.Define(stage, f"/train/{path}").AddTranslateOp().Set(Gf.Vec3d(*at))
        mesh = UsdGeom.Mesh.Define(stage, f"/train/{path}/shape")
        mesh.GetPointsAttr().Set([Gf.Vec3f(*map(float, p)) for p in points])
        mesh.GetFaceVertexCountsAttr().Set([len(face) for face in faces])
        mesh.GetFaceVertexIndicesAttr().Set([i for face in faces for i in face])

    box = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    turn = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    rim = 0.5 * np.column_stack([np.cos(turn), 0 * turn, np.sin(turn)])
    half = np.array([0, 0.12, 0])
    tyre = np.vstack([rim - half, rim + half])
    k, after = np.arange(96), (np.arange(96) + 1) % 96
    tread = [list(map(int, face)) for face in np.column_stack([k, after, after + 96, k + 96])]

    def wheels(path, x, z, channels):
        nonlocal text
        for side, y in (("l", 1.0), ("r", -1.0)):
            name = f"{path}wheel_{channels.format(side)}"
            part(name, (x, y, z), tyre, tread)
            kinds = ("roll", "travel") if not path else ("roll",)
            for kind in kinds:
                op = "rotateY" if kind == "roll" else "translateZ"
                text += f'[channels.{kind}_{channels.format(side)}]\nprim = "{name}"\nop = "{op}"\n'

    part("cab", (1.5, 0, 1.6), box * (4.5, 2.2, 1.4), sides)
    wheels("", 0.0, 0.5, "r{}")
    wheels("", 3.5, 0.5, "f{}")
    for path, x, z, number in (("first", 0.0, 1.0, 1), ("first/second", -5.0, 0.0, 2)):
        part(path, (x, 0, z), box * (4.0, 2.2, 1.2) + (-2.5 if number == 1 else -2.0, 0, 0.9), sides)
    for path, x, number in (("first/", -5.0, 1), ("first/second/", -4.0, 2)):
        wheels(path, x, -0.5, f"t{number}_{{}}")
    stage.Save()
    (folder / "vehicle.toml").write_text(text)
    return vehsim.load_vehicle(folder)


@pytest.mark.parametrize(
    ("place", "heading"), [((40.0, 0.0, 0.0), 0.0), ((60.0, 8.0, 0.0), 20.0), ((-20.0, 0.0, 0.0), 0.0)]
)
def test_a_custom_road_train_is_planned(tmp_path, place, heading):
    """Its file gives no scales of controls: with torques in N m, plans failed after a minute. In reverse, it folded."""
    train = road_train(tmp_path)
    marks = [
        vehsim.Mark(1, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        vehsim.Mark(481, position=place, heading=heading, velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(train, None, marks)
    assert plan.success and plan.character == "normal", plan.message
    ends = plan.clip.joints[[0, -1]][:, [train.joints.index(f"hitch_{k}") for k in (1, 2)]]
    assert np.degrees(np.abs(ends).max()) < 15


def test_a_custom_road_train_follows_the_ground(tmp_path):
    """Two trailers, one behind the other, without springs: they tilt until their wheels touch."""
    world, train = hilly(), road_train(tmp_path)
    clip = driven(train, world, sigma=0.15, hitch_1=0.2, hitch_2=-0.3).resample()
    first, second = np.array([[0.0, 0.0, 1.0], [-5.0, 0.0, 1.0]])
    one = [("hitch_1", "Z", first), ("hitch_pitch_1", "Y", first), ("hitch_roll_1", "X", first)]
    two = [*one, ("hitch_2", "Z", second), ("hitch_pitch_2", "Y", second), ("hitch_roll_2", "X", second)]
    ops = {}
    for side, y in (("l", 1.0), ("r", -1.0)):
        ops[f"first/wheel_t1_{side}"] = [*one, (f"roll_t1_{side}", "Y", np.array([-5.0, y, 0.5]))]
        ops[f"first/second/wheel_t2_{side}"] = [*two, (f"roll_t2_{side}", "Y", np.array([-9.0, y, 0.5]))]
    assert np.abs(gaps(clip, world, ops, range(0, len(clip), 8))).max() < 2e-3
    assert np.ptp(clip.channels["hitch_roll_2"]) > 0.03


def test_clearances_see_the_trailer_where_it_turns_and_tilts():
    """A wall along Y beside a truck in a bend on hills: its distance is that of the nearest corner of all hulls."""
    world = hilly()
    clip = driven(TRUCK, world, sigma=0.2, hitch_1=0.3).resample()
    wall = box("wall", (0.0, -60.0, -10.0), (300.0, 10.0, 30.0))
    seen = clip.at(clip.times[::24])
    placed = world.with_obstacles([wall]).clearance_by_obstacle(
        TRUCK, seen.positions, seen.orientations, channels=seen.channels
    )
    pin = np.array([-1.8, 0.0, 1.2])
    for k, found in enumerate(placed[:, 0]):
        angles = [seen.channels[name][k] for name in ("hitch_1", "hitch_pitch_1", "hitch_roll_1")]
        turn = Rotation.from_euler("ZYX", angles).as_matrix()
        corners = []
        for solid in solids(TRUCK.rig.asset, TRUCK.rig.root or None):
            for hull in solid.hulls:
                here = (hull - pin) @ turn.T + pin if solid.path.startswith("trailer_1") else hull
                corners.append(here @ seen.matrices()[k][:3, :3].T + seen.matrices()[k][:3, 3])
        assert found == pytest.approx(np.vstack(corners)[:, 1].min() + 55.0, abs=1e-5)
    straight = world.with_obstacles([wall]).clearance_by_obstacle(TRUCK, seen.positions, seen.orientations)
    assert np.abs(straight - placed).max() > 0.1


def test_a_truck_that_is_an_obstacle_has_its_trailer_where_it_turns():
    """The truck and a pole, from each one's side: as far apart whichever of the two is the obstacle."""
    world = hilly()
    clip = driven(TRUCK, world, sigma=0.2, hitch_1=0.5).resample()
    seen = clip.at(clip.times[::24])
    seconds = clip.start_frame / float(clip.fps) + seen.times
    point = replace(TRUCK, rig=None)
    turned = []
    for k in range(len(seen)):
        tail = seen.positions[k] + seen.matrices()[k][:3, :3] @ (-10.0, 2.0, 2.0)
        pole = box("pole", tail - (0.0, 0.0, 0.05), (0.1, 0.1, 0.1))
        one = World(obstacles=[pole]).clearance_by_obstacle(
            TRUCK, seen.positions[k : k + 1], seen.orientations[k : k + 1],
            channels={name: values[k : k + 1] for name, values in seen.channels.items()},
        )  # fmt: skip
        other = World(obstacles=[moving("truck", clip)]).clearance_by_obstacle(
            point, tail[None], np.array([[1.0, 0, 0, 0]]), seconds[k : k + 1]
        )
        turned.append(float(other[0, 0]))
        assert 0.0 <= other[0, 0] - one[0, 0] < 0.09  # half the pole's diagonal
    assert np.ptp(turned) > 0.05
