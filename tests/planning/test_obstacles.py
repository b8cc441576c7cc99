"""Cars among obstacles: clear according to an independent library, between knots too; infeasible marks are named."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import shapely

import vehsim
from vehsim import Mark, State, World
from vehsim.errors import InputError, SolveError
from vehsim.lie.quaternions import yaw_of
from vehsim.planning import certificates
from vehsim.planning.certificates import certify_plane
from vehsim.planning.certify import _settles
from vehsim.planning.constraints import features
from vehsim.planning.constraints.block import Finding
from vehsim.planning.constraints.features import CORNERS, bodies_of, form_of, gap
from vehsim.planning.constraints.features import element as row_of
from vehsim.planning.constraints.obstacle_clearance import ObstacleClearance, Poses
from vehsim.planning.drafts import draft
from vehsim.planning.guesses import astar
from vehsim.planning.guesses.astar import guess_drive, turning_radius
from vehsim.planning.guesses.pacing import changes_of_gear
from vehsim.planning.iterate import Certificate
from vehsim.planning.outlines import clearances, inner_discs, least_clearance, simplified
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.legs import divided, same_choices
from vehsim.planning.request.marks import Gate
from vehsim.planning.request.marks_near_obstacles import levels_at, marks_too_near, parts_in_reach, straightened
from vehsim.planning.request.request import make_request
from vehsim.planning.trajectory import Trajectory
from vehsim.rig.parts import read_parts
from vehsim.world.obstacles import obstacles as ob
from vehsim.world.obstacles.articulated import articulated_footprint
from vehsim.world.obstacles.plane import distance, placed
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)
WALLS = [  # a ring about (20, 0)
    ob.box("east", (26, 0, 0), (1, 14, 2)),
    ob.box("west", (14, 0, 0), (1, 14, 2)),
    ob.box("north", (20, 6.5, 0), (13, 1, 2)),
    ob.box("south", (20, -6.5, 0), (13, 1, 2)),
]


@pytest.fixture(scope="module")
def car():
    return vehsim.load_vehicle("car")


def yard(seed, count=8):
    rng = np.random.default_rng(seed)
    obstacles = []
    for i in range(count):
        centre = rng.uniform((9, -9), (41, 9))
        if i % 3 == 0:
            obstacles.append(ob.ellipse(f"e{i}", centre, rng.uniform(1, 2.5, 2), rng.uniform(0, 180)))
        else:
            angles = np.sort(rng.uniform(0, 2 * np.pi, 6))
            ring = np.column_stack([np.cos(angles), np.sin(angles)]) * rng.uniform(1, 2.5)
            obstacles.append(ob.polygon(f"p{i}", centre + ring))
    return World(obstacles=obstacles)


def rows_among(car, world):
    return ObstacleClearance(car, parts_in_reach(car, world, across()), 0.5)


def across(length=50.0, **goal):
    return [
        Mark(1001, position=REST, heading=0, velocity=REST),
        Mark("free", position=(length, 0, 0), heading=0, velocity=REST, **goal),
    ]


def gap_by_shapely(clip, world):
    """Smallest distance at 2000 times, with footprints and obstacles in shapely; ellipses as rings of 400 corners."""
    motion = clip.at(np.linspace(0, clip.times[-1], 2000))
    yaw = yaw_of(motion.orientations)
    outlines = placed(ob.footprint(clip.vehicle), motion.positions[:, :2], yaw)
    shapes = [part for o in world.obstacles for part in o.parts]
    union = shapely.unary_union([
        shapely.Polygon(part.outline(400) if hasattr(part, "outline") else part) for part in shapes
    ])  # fmt: skip
    return float(shapely.distance(shapely.polygons(outlines), union).min())


@pytest.mark.parametrize("seed", range(2))
def test_a_car_finds_a_path_and_keeps_its_clearance(car, seed):
    world = yard(seed)
    plan = vehsim.plan(car, world, across(), segments=48, clearance=0.5)
    assert plan.success, plan.message
    checked = gap_by_shapely(plan.clip, world)
    assert checked >= 0.5 - 2e-3
    assert plan.clearance == pytest.approx(checked, abs=2e-3)  # the certificate is not optimistic
    np.testing.assert_allclose(plan.clip.positions[-1, :2], (50, 0), atol=1e-6)
    assert np.abs(plan.clip.joints[:, car.joints.index("sigma")]).max() <= 0.7 + 1e-6


@pytest.mark.parametrize("name", ["two_wheeled", "simple_car"])
def test_other_vehicles_drive_among_obstacles_too(name):
    vehicle, scale = vehsim.load_vehicle(name), 0.2 if name == "two_wheeled" else 1.0
    stones = [ob.ellipse("stone", (20 * scale, 0), (3 * scale, 2 * scale)), ob.box("crate", (34 * scale, 3 * scale, 0),
              (4 * scale, 6 * scale, 1), 20)]  # fmt: skip
    world = World(obstacles=stones)
    plan = vehsim.plan(vehicle, world, across(50 * scale), segments=48, clearance=0.5 * scale)
    assert plan.success, plan.message
    assert gap_by_shapely(plan.clip, world) >= 0.5 * scale - 2e-3


def test_a_car_parks_between_two_others(car):
    """In a gap two metres longer than itself: possible only in reverse."""
    world = World(obstacles=[ob.box("behind", (-5.4, -3, 0), (4.3, 1.9, 1.4)), ob.box("ahead", (5.4, -3, 0),
                  (4.3, 1.9, 1.4)), ob.box("kerb", (0, -4.75, 0), (26, 0.8, 0.15))])  # fmt: skip
    marks = [
        Mark(1001, position=(-7, 0, 0), heading=0, velocity=REST),
        Mark("free", position=(0, -3, 0), heading=0, velocity=REST),
    ]
    plan = vehsim.plan(car, world, marks, segments=64, clearance=0.2, limits={"speed": 3.0})
    assert plan.success, plan.message
    assert gap_by_shapely(plan.clip, world) >= 0.2 - 2e-3
    assert plan.clip.twists[:, 1].min() < -0.3 and plan.clip.twists[:, 1].max() > 0.3  # it went both ways


def test_a_moving_obstacle_is_avoided(car):
    """Another car crosses where the first would meet it: ignoring it leads to a collision, considering it does not."""
    start = vehsim.State(position=(20, -24, 0), orientation=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)), twist=(0, 6.0, 0))
    other = vehsim.simulate(car, World(), start=start, duration=8.0, fps=24, start_frame=1001)
    crossing = ob.moving("crossing", other)
    marks = [
        Mark(1001, position=REST, heading=0, velocity=(5, 0, 0)),
        Mark(1193, position=(40, 0, 0), heading=0, velocity=(5, 0, 0)),
    ]
    blind = vehsim.plan(car, World(), marks, segments=48)
    seeing = vehsim.plan(car, World(obstacles=[crossing]), marks, segments=48, clearance=0.5)
    assert certify_plane(blind.clip, [(crossing, 0)])[0] < 0
    assert seeing.success, seeing.message
    assert certify_plane(seeing.clip, [(crossing, 0)])[0] >= 0.5 - 2e-3


def test_obstacles_above_or_below_the_vehicle_do_not_matter(car):
    overhead = World(obstacles=[ob.box("bridge", (20, 0, 5), (4, 40, 1)), ob.box("drain", (30, 0, -2), (4, 40, 1))])
    assert parts_in_reach(car, overhead, across()) == []


def hill() -> Terrain:
    """A ridge across the way, 6 m high at x = 20, with a valley 8 m deep between banks at x = 60."""
    x, y = np.meshgrid(np.arange(-40.0, 101.0, 2.0), np.arange(-40.0, 41.0, 2.0))
    heights = 6 * np.exp(-(((x - 20) / 12) ** 2)) - 8 * np.exp(-(((x - 60) / 10) ** 6)) + 0 * y
    return Terrain("ridge", heights, (-40.0, -40.0), (2.0, 2.0))


def test_what_stands_on_higher_ground_is_in_the_way(car):
    """A car on level ground before the ridge planned to drive through the shed on it."""
    shed, bridge = ob.box("shed", (20, 0, 5.8), (4, 3, 3)), ob.box("bridge", (60, 0, -0.2), (34, 6, 1))
    other = vehsim.simulate(
        car, World(), np.zeros((25, 2)), start=State(position=(20, 10, 6)), duration=1.0, step=1 / 24
    )
    parked = ob.moving("parked", other)
    world = World(terrain=hill(), obstacles=[shed, bridge, parked])
    assert [obstacle.name for obstacle, _ in parts_in_reach(car, world, across())] == ["shed", "parked"]
    plan = vehsim.plan(car, World(terrain=hill(), obstacles=[shed]), across(40), segments=48, clearance=0.5)
    assert plan.success, plan.message
    assert gap_by_shapely(plan.clip, World(obstacles=[shed])) >= 0.5 - 2e-3


@pytest.mark.parametrize(
    "obstacles, complaint",
    [
        ([ob.box("hut", (0, 0, 0), (9, 9, 3))], r"mark\[0\].position = .*in obstacle 'hut'; move the mark"),
        ([ob.polygon("c", [(47, -3), (53, -3), (53, 3), (47, 3)][::-1])], r"mark\[1\].position = .*in obstacle 'c'"),
        ([ob.box("wall", (50, 2.0, 0), (9, 0.5, 3))], r"mark\[1\].position = .*only 0.69 m from obstacle 'wall'"),
    ],
    ids=["start inside", "goal inside, clockwise", "goal too near"],
)
def test_marks_in_obstacles_are_refused(car, obstacles, complaint):
    with pytest.raises(InputError, match=complaint):
        vehsim.plan(car, World(obstacles=obstacles), across(), segments=32)


def test_a_mark_that_no_heading_clears_is_refused(car):
    """Shapely rotates the car about the mark: 5 cm below the clearance of the best heading is planned, 5 cm above
    refused."""
    walls = [ob.box("wall", (50, 2.5, 0), (30, 0.5, 3)), ob.box("rail", (50, -3.5, 0), (30, 0.5, 3))]
    union = shapely.unary_union([shapely.Polygon(part) for wall in walls for part in wall.parts])
    yaw = np.linspace(0, 2 * np.pi, 3601)
    turned = placed(ob.footprint(car), np.tile([50.0, 0.0], (len(yaw), 1)), yaw)
    best = float(shapely.distance(shapely.polygons(turned), union).max())
    mark = Mark("free", position=(50, 0, 0))

    def complaints(clearance, mark=mark):
        return [message for _, message, _ in marks_too_near(car, World(obstacles=walls), [mark], clearance)]

    assert not complaints(best - 0.05)
    assert complaints(best + 0.1) == [f"only {best:.2f} m from obstacle 'wall' at any heading"]
    # it may pass elsewhere in the gate
    assert not complaints(best + 0.1, replace(mark, gate=Gate((1, 0, 0), radius=2)))


@pytest.mark.parametrize(
    "place, joints, told",
    [
        ((-9, 0, 0), {"hitch_1": 0.0}, "its trailer_1 is in obstacle 'wall'"),
        ((-9, 0, 0), None, "its trailer_1 is in obstacle 'wall'"),
        ((-11.9, 0, 0), None, "its trailer_1 is only 0.50 m from obstacle 'wall'"),
        ((0, 0, 0), None, "in obstacle 'wall'"),
        ((-8.5, 6, 0), {"hitch_1": -0.8}, "its trailer_1 is in obstacle 'wall'"),  # only as the mark turns it
        ((-8.5, 6, 0), {"hitch_1": 0.8}, None),
        ((-8.5, 6, 0), None, None),
    ],
)
def test_a_trailer_near_an_obstacle_is_named(place, joints, told):
    truck, world = vehsim.load_vehicle("truck"), World(obstacles=[ob.box("wall", place, (2, 2, 4))])
    marks = [Mark(1, position=REST, heading=0, velocity=REST, joints=joints)]
    assert [message for _, message, _ in marks_too_near(truck, world, marks, 1.0)] == [told] * (told is not None)


@pytest.mark.parametrize("width", [9.0, 7.0])
def test_a_truck_turns_into_a_street(width):
    """Its trailer, 8.6 m behind the king pin, follows it round the corner; in line with it, it would be in a house."""
    truck, half = vehsim.load_vehicle("truck"), width / 2
    houses = {"corner": ((-10, 30), (60, 60)), "south": ((0, -5), (120, 10)), "east": ((25, 30), (10, 140))}
    aside = {"corner": (-half, half), "south": (0, -half), "east": (half, 0)}
    world = World(obstacles=[
        ob.box(name, (x + aside[name][0], y + aside[name][1], 0), (*size, 8))
        for name, ((x, y), size) in houses.items()
    ])  # fmt: skip
    marks = [
        Mark(1, position=(-22, 0, 0), heading=0, velocity=REST),
        Mark(961, position=(20, 45, 0), heading=90, velocity=REST),
    ]
    plan = vehsim.plan(truck, world, marks, clearance=0.3)
    assert plan.success and plan.character == "normal", plan.message
    clip = plan.clip.at(np.linspace(0, plan.clip.times[-1], 1500))
    assert clip.twists[:, 1].min() > -0.1  # it does not back up
    assert world.clearance(truck, clip.positions, clip.orientations, channels=clip.channels).min() >= 0.3 - 2e-3
    straight = placed(ob.footprint(truck), clip.positions[:, :2], yaw_of(clip.orientations))
    assert min(distance(straight, obstacle.parts[0]).min() for obstacle in world.obstacles) < -0.5


@pytest.mark.parametrize("train", [False, True])
def test_rows_place_a_trailer_where_it_is(train, monkeypatch):
    """Behind a turned tractor, folded: by its outline as the rig turns it; a second trailer behind a first one too."""
    truck = vehsim.load_vehicle("truck")
    [part] = articulated_footprint(truck)
    if train:
        part = replace(part, pivots=(*part.pivots, ("hitch_1", -0.7, np.array([-9.0, 0.1]))))
        monkeypatch.setattr(features, "articulated_footprint", lambda vehicle: (part,))
    _, body = bodies_of.__wrapped__(truck)
    rng = np.random.default_rng(5)
    yaw, places, folded = rng.uniform(-3, 3, 40), rng.uniform(-9, 9, (40, 2)), rng.uniform(-1.5, 1.5, 40)
    joints = np.zeros((len(truck.joints), 40))
    joints[truck.joints.index("hitch_1")] = folded
    turned, *place = np.asarray(body.pose(np.vstack([yaw, places.T]), joints))
    expected = placed(part.at({"hitch_1": folded}), places, yaw)
    np.testing.assert_allclose(placed(part.outline, np.transpose(place), turned), expected, atol=1e-12)


def test_trailers_meet_what_stands_higher_up_the_hill():
    """On a slope, 10 m above the first mark, a crate is as high above the ground as the trailer."""
    truck, slope = (
        vehsim.load_vehicle("truck"),
        Terrain("slope", np.outer(np.ones(6), np.arange(13.0)), (0, -25), (10, 10)),
    )
    world = World(terrain=slope, obstacles=[ob.box("crate", (100, 5, 10), (2, 2, 2))])
    marks = [replace(mark, position=(20.0 + mark.position[0], 0, 2.0)) for mark in across(90.0)]
    parts = parts_in_reach(truck, world, marks)
    levels = levels_at(truck, world, marks, parts)
    assert levels == pytest.approx([10.0], abs=0.2)
    rows = ObstacleClearance(truck, parts, 0.5, levels=levels)
    assert {number for _, number, _ in rows.features} == {0, 1}
    assert {number for _, number, _ in replace(rows, levels=[0.0], owners=None).features} == {0}


@pytest.mark.parametrize(("name", "size", "wide"), [("car", 1.0, 2.1), ("truck", 2.2, 3.1)])
@pytest.mark.parametrize("clearance", [0.0, 0.3, 1.0])
def test_a_guess_leads_straight_through_a_gap_ahead(name, size, wide, clearance):
    """Though it leaves less room than half a cell of the grid: it led round the walls, or in a circle first."""
    vehicle, middle = vehsim.load_vehicle(name), wide / 2 + clearance + 0.075 + 10 * size
    world = World(
        obstacles=[ob.box(f"{side:+d}", (25 * size, side * middle, 0), (2, 20 * size, 3)) for side in (1, -1)]
    )
    ends = np.array([(0.0, 0, 0), (50 * size, 0, 0)])
    path = guess_drive(vehicle, parts_in_reach(vehicle, world, across()), ends, (0.0, 0.0), clearance)
    np.testing.assert_allclose(path[:, [1, 3]], 0.0, atol=1e-6)


def test_a_guess_leads_through_a_gap_aside_without_backing_up():
    """Arcs meet the gap exactly only after going back; a guess that meets it nearly is the better start."""
    truck = vehsim.load_vehicle("truck")
    walls = [ob.box(f"{side:+d}", (55, 13.2 + side * 23.925, 0), (2, 44, 3)) for side in (1, -1)]
    ends = np.array([(0.0, 0, 0), (110, 0, 0)])
    path = guess_drive(truck, parts_in_reach(truck, World(obstacles=walls), across()), ends, (0.0, 0.0), 0.3)
    assert not changes_of_gear(path)[-1]
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum() < 125
    narrow = np.abs(path[:, 0] - 55) < 1
    assert np.abs(path[narrow, 1] - 13.2).max() < 0.6


def test_a_swinging_trailer_keeps_its_clearance():
    """Around a block: the trailer, rotated about its king pin here, keeps the clearance according to shapely."""
    truck = vehsim.load_vehicle("truck")
    world = World(obstacles=[ob.box("silo", (30, -1, 0), (8, 8, 6), heading=45)])
    marks = [
        Mark(1, position=REST, heading=0, velocity=REST),
        Mark("free", position=(60, 6, 0), heading=20, velocity=REST),
    ]
    plan = vehsim.plan(truck, world, marks, segments=64, clearance=0.7, limits={"speed": 8})
    assert plan.success and plan.clearance >= 0.7 - 0.011
    trailer = next(p for p in read_parts(truck.rig.asset, truck.rig.root or None) if p.path == "trailer_1")
    corners, pin = np.vstack(trailer.hulls)[:, :2], trailer.T_rp[:2, 3]
    motion = plan.clip.at(np.linspace(0, plan.clip.times[-1], 1000))
    yaw = yaw_of(motion.orientations)
    pins = placed(pin[None], motion.positions[:, :2], yaw)[:, 0]
    turned = placed(corners, pins, yaw + motion.channels["hitch_1"])
    seen = shapely.distance(
        shapely.convex_hull(shapely.multipoints(turned)), shapely.Polygon(world.obstacles[0].parts[0])
    )
    assert plan.clearance - 1e-3 <= seen.min() <= plan.clearance + 0.05


def bay(wide):
    """Two blocks 16 m long, with a bay ``wide`` m between them."""
    sides = (wide / 2 + 1.5, -wide / 2 - 1.5)
    return World(obstacles=[ob.box(f"block {y:+g}", (0.0, y, 0.0), (16.0, 3.0, 3.0)) for y in sides])


def to_bay(start, **more):
    first = Mark(1, position=start, heading=0, velocity=REST, **more)
    return [first, Mark("free", position=(4.0, 0.0, 0.0), heading=0, velocity=REST)]


@pytest.mark.parametrize(
    ("wide", "start"), [(4.4, (20, 0, 0)), (3.8, (20, 0, 0)), (4.4, (30, 8, 0)), (4.0, (35, -6, 0))]
)
def test_a_truck_backs_its_trailer_into_a_bay(wide, start):
    """Straight back, and from beside the bay: it pulls ahead, and backs in with its trailer straight."""
    truck, world = vehsim.load_vehicle("truck"), bay(wide)
    plan = vehsim.plan(truck, world, to_bay(start), clearance=0.3)
    assert plan.success, plan.message
    clip = plan.clip
    hitch = clip.joints[:, truck.joints.index("hitch_1")]
    np.testing.assert_allclose(hitch[[0, -1]], 0, atol=1e-6)
    gaps = world.clearance(truck, clip.positions, clip.orientations, channels=clip.channels)
    assert gaps.min() > 0.3 - 0.011


def test_trailers_stand_straight_first_and_in_bays_unless_marks_say_otherwise():
    truck, world = vehsim.load_vehicle("truck"), bay(4.4)
    first, last = to_bay((20, 0, 0))
    straight, bent = (math.nan, math.nan, 0.0), (math.nan, math.nan, 0.05)

    def joints(world, *marks):
        return [mark.joints for mark in straightened(truck, world, marks)]

    np.testing.assert_equal(joints(world, first, last), [straight, straight])
    np.testing.assert_equal(joints(world, first, replace(last, joints=bent)), [straight, bent])
    assert joints(world, first, replace(last, velocity=None))[1] is None
    for open_side in (World(obstacles=world.obstacles[:1]), None):  # where it can turn
        np.testing.assert_equal(joints(open_side, first, last)[0], straight)
        assert joints(open_side, first, last)[1] is None
    moving = [replace(first, velocity=(2.0, 0.0, 0.0)), last]
    np.testing.assert_equal(joints(None, *moving)[0], straight)
    assert straightened(truck, None, moving, loop=True)[0].joints is None
    assert joints(None, replace(first, joints=bent), last) == [bent, None]
    marks = [first, last]
    chosen, aside = straightened(truck, world, marks), replace(last, joints=bent)
    assert same_choices(to_bay((21, 0, 0)), marks, chosen)[1].joints is chosen[1].joints
    assert same_choices([aside], [aside], [aside])[0].joints is bent


def test_a_truck_starts_with_its_trailer_behind_it():
    """A free trailer started folded by 63 degrees, in the open."""
    truck = vehsim.load_vehicle("truck")
    marks = [
        Mark(frame, position=place, heading=heading, velocity=REST)
        for frame, place, heading in ((1, (0.0, 0.0, 0.0), 0.0), (961, (60.0, 10.0, 0.0), 20.0))
    ]
    plan = vehsim.plan(truck, marks=marks)
    assert plan.success, plan.message
    hitch = np.degrees(plan.clip.joints[:, truck.joints.index("hitch_1")])
    assert abs(hitch[0]) < 1e-6 and np.abs(hitch).max() < 5


def test_other_guesses_come_before_folded_trailers():
    """Its trailer started folded by 63 degrees, without a word: only then were other ways into the lane tried."""
    truck = vehsim.load_vehicle("truck")
    walls = [ob.box(f"wall {side}", (-10, 3.2 * side, 0), (14, 0.5, 3)) for side in (-1, 1)]
    marks = [
        Mark(1, position=(25, -15, 0), heading=90, velocity=REST),
        Mark("free", position=(-5, 0, 0), heading=0, velocity=REST),
    ]
    plan = vehsim.plan(truck, World(obstacles=walls), marks, clearance=0.4)
    assert plan.success, plan.message
    np.testing.assert_allclose(plan.clip.joints[0, 2], 0, atol=1e-6)


def test_drafts_keep_trailers_straight_in_bays():
    truck = vehsim.load_vehicle("truck")
    first, last = to_bay((20, 0, 0))
    marks = [first, replace(last, frame=241)]
    plan = vehsim.plan(truck, bay(4.4), marks, clearance=0.3)
    drawn = draft(truck, bay(4.4), marks, plan.clip, fps=24, segments=64, clearance=0.3)
    for there in (4.0, 4.5, 5.0):
        drawn = drawn.moved([first, replace(marks[1], position=(there, 0, 0))])
        assert drawn.success
        np.testing.assert_allclose(drawn.clip().joints[[0, -1], 2], 0, atol=1e-6)


def test_a_replan_keeps_trailers_straight():
    truck = vehsim.load_vehicle("truck")
    plan = vehsim.plan(truck, bay(4.4), to_bay((20, 0, 0)), clearance=0.3)
    again = plan.replan(to_bay((21, 0, 0)))
    assert again.success, again.message
    np.testing.assert_allclose(again.clip.joints[[0, -1], 2], 0, atol=1e-6)


def test_a_path_is_divided_by_frames():
    path = np.array([[0.0, 0, 0], [0, 30, 0], [10, 30, 0]])
    marks = [Mark(1, position=(0, 0, 0)), Mark(11), Mark(37), Mark(41, position=(10, 30, 0))]
    legs = divided([path], marks)
    assert [len(leg) for leg in legs] == [2, 3, 2]
    np.testing.assert_allclose([leg[-1] for leg in legs], [(0, 10, 0), (6, 30, 0), (10, 30, 0)])


def test_a_walled_in_vehicle_is_reported(car):
    """With the key of its mark, and without a remedy that does not help."""
    marks = [Mark(1, position=(20, 0, 0), heading=0, velocity=REST), Mark("free", position=(50, 0, 0))]
    told = r"^mark\[1\].position: no path from .*obstacles close it; open a gap, or move the mark$"
    with pytest.raises(SolveError, match=told):
        vehsim.plan(car, World(obstacles=WALLS), marks, segments=32, clearance=0.3)


def test_a_gap_that_is_too_narrow_comes_with_the_clearance_that_it_allows(car):
    walls = [ob.box(name, (15, y, 1), (4, 40, 2)) for name, y in (("left", 21.2), ("right", -21.2))]
    walls += [ob.box(name, (5, y, 1), (92, 4, 2)) for name, y in (("north", 42), ("south", -42))]
    walls += [ob.box(name, (x, 0, 1), (4, 88, 2)) for name, x in (("west", -40), ("east", 50))]
    marks = [Mark(1, position=(0, 0, 0), heading=0, velocity=REST), Mark("free", position=(32, 0, 0))]
    with pytest.raises(SolveError, match=r"open a gap, lower the clearance to 0\.\d+ m at most, or move the mark$"):
        vehsim.plan(car, World(obstacles=walls), marks, segments=32, clearance=0.6)


def test_a_path_out_of_the_walls_is_found(car):
    """The same ring with its east wall moved away: overlapping corners are no problem."""
    marks = [
        Mark(1, position=(19, 0, 0), heading=180, velocity=REST),
        Mark("free", position=(50, 0, 0), velocity=REST),
    ]
    world = World(obstacles=WALLS[1:])
    plan = vehsim.plan(car, world, marks, segments=64, clearance=0.3)
    assert plan.success, plan.message
    assert gap_by_shapely(plan.clip, world) >= 0.3 - 2e-3


def test_a_motion_from_another_planner_can_be_the_guess(car):
    world = yard(1)
    first = vehsim.plan(car, world, across(), segments=48, clearance=0.5, refine=False)
    again = vehsim.plan(car, world, across(), segments=48, clearance=0.5, guess=first.clip, refine=False)
    assert again.success and gap_by_shapely(again.clip, world) >= 0.5 - 2e-3
    assert np.abs(again.clip.positions[::8, 1] - first.clip.positions[::8, 1]).max() < 1.0  # the same way round


PARTS = [ob.polygon("p", [(0, 0), (3, 0), (2, 2)]), ob.ellipse("e", (1, 1), (2, 0.8), 30)]


def rows_of(vehicle, shape, poses):
    """All features of a shape, (features, n) m, at poses (n, 3) of the root: yaw, x, y."""
    form, body = form_of(shape), bodies_of(vehicle)[0].outline
    numbers = form.numbers(shape)
    return np.array([
        np.ravel(gap(f.kind, body)(poses.T, np.tile(numbers[list(f.numbers)], (len(poses), 1)).T,
                                   np.tile(f.constants, (len(poses), 1)).T))
        for f in form.features(shape, body)
    ])  # fmt: skip


@pytest.mark.parametrize("part", PARTS)
def test_rows_equal_the_exact_distance(car, part):
    """Outside, the smallest row is the distance of the optimiser's polygon from the part."""
    rng = np.random.default_rng(2)
    poses = np.column_stack([rng.uniform(-np.pi, np.pi, 300), rng.uniform(-7, 9, (300, 2))])
    body = np.array(bodies_of(car)[0].outline)
    exact = distance(placed(body, poses[:, 1:], poses[:, 0]), part.parts[0])
    poses, exact = poses[exact > 0.02], exact[exact > 0.02]
    assert len(exact) > 50
    np.testing.assert_allclose(rows_of(car, part.parts[0], poses).min(axis=0), exact, atol=1e-5)


@pytest.mark.parametrize("part", PARTS)
def test_frozen_expressions_do_not_change_derivatives(car, part):
    """Slopes and curvatures, although frozen, are the derivatives of the values: inside and outside."""
    t = transcribe(car)
    rng, shape = np.random.default_rng(4), part.parts[0]
    kinds = {feature.kind: feature for feature in form_of(shape).features(shape, bodies_of(car)[0].outline)}
    for kind, feature in kinds.items():
        element = row_of(t, kind, 0)
        p = np.concatenate([form_of(shape).numbers(shape)[list(feature.numbers)], [0.5], feature.constants])
        value = lambda x, e=element, p=p: float(e.value(x, p)[1])
        for _ in range(12):
            x = np.zeros(element.y.shape[0])
            x[:3] = rng.uniform(-np.pi, np.pi), *rng.uniform(-4, 6, 2)
            slope, bend = np.zeros(len(x)), np.zeros((len(x), len(x)))
            slope[element.jacobian_pattern[1]] = np.ravel(element.jacobian(x, p)[1])
            hessian, i, j = element.hessian
            bend[i, j] = bend[j, i] = np.ravel(hessian(x, p, 0.0, 1.0))
            way = np.append(rng.standard_normal(3), np.zeros(len(x) - 3))
            found = np.array([value(x + s * way) for s in (-2e-4, -1e-4, 0, 1e-4, 2e-4)])
            ends = (found[3] - found[1]) / 2e-4, (found[4] - found[0]) / 4e-4
            if abs(ends[0] - ends[1]) > 1e-4:  # between features it has an edge
                continue
            assert slope @ way == pytest.approx(ends[0], abs=1e-4)
            assert way @ bend @ way == pytest.approx((found[3] - 2 * found[2] + found[1]) / 1e-8, abs=3e-2, rel=2e-2)


def test_a_thin_wall_across_the_car_is_detected(car):
    """None of its corners lies in the car, nor any of the car's in it."""
    wall = ob.polygon("wall", [(-0.1, -9), (0.1, -9), (0.1, 9), (-0.1, 9)])
    assert rows_of(car, wall.parts[0], np.zeros((1, 3))).min() < -0.5


def test_only_features_near_each_other_become_rows(car):
    """A part in front: the car's tail and the part's far corners have no rows, and the others suffice."""
    world = World(obstacles=[ob.box("ahead", (6, 0, 0), (6, 3, 1))])
    rows = rows_among(car, world).near(Poses(np.zeros((3, 3)), np.zeros(3), np.zeros(3)))
    seen = [feature for (_, _, feature), seen in zip(rows.features, rows.active[:, 1], strict=True) if seen]
    assert 0 < len(seen) < 0.7 * len(rows.features)
    assert all(feature.constants[0] > -1 for feature in seen if feature.constants)  # of the car, not its tail
    gaps = rows_of(car, world.obstacles[0].parts[0], np.zeros((1, 3)))[:, 0]
    assert gaps[rows.active[:, 1]].min() == gaps.min()


def test_the_optimisers_outline_contains_the_vehicle(car):
    hull = ob.footprint(car)
    seen = simplified(hull, CORNERS)
    assert len(seen) <= CORNERS and shapely.Polygon(seen).buffer(1e-9).contains(shapely.Polygon(hull))
    assert shapely.Polygon(seen).area < 1.03 * shapely.Polygon(hull).area
    for centre, radius in inner_discs(seen):
        assert shapely.Polygon(seen).contains(shapely.Point(centre).buffer(0.98 * radius))


def test_certification_finds_the_closest_approach_between_samples(car):
    """A post beside a fast car: the closest approach lies between any two of few samples."""
    clip = vehsim.simulate(car, World(), start=vehsim.State(twist=(0, 15.0, 0)), duration=2.0, fps=24)
    few = np.linspace(0, len(clip) - 1, 5).astype(int)  # 7.5 m apart
    arrays = ("times", "positions", "orientations", "twists", "joints", "joint_rates", "controls")
    clip = replace(clip, channels={}, energy={}, commands={}, **{name: getattr(clip, name)[few] for name in arrays})
    post = ob.polygon("post", [(11.3, 1.6), (11.4, 1.6), (11.35, 1.7)])
    nearest, by_segment = certify_plane(clip, [(post, 0)], samples=1)
    widest = np.abs(ob.footprint(car)[:, 1]).max()
    assert nearest == pytest.approx(1.6 - widest, abs=2e-3)
    assert by_segment.shape == (1, len(clip) - 1)


@pytest.mark.parametrize(("ahead", "late"), [(7.0, 0), (8.0, 24), (-6.0, -30), (12.0, 400)])
def test_cars_in_a_row_are_certified_from_few_poses(car, ahead, late, monkeypatch):
    """Only their relative motion counts: by the ways of both, it took a hundred thousand poses and 22 s."""

    def drive(x, first):
        ends = [(first, (x, 0.0, 0.0), 0.0), (first + 240, (60.0 + x, 15.0, 0.0), 20.0)]
        marks = [Mark(frame, position=place, heading=nose, velocity=REST) for frame, place, nose in ends]
        return vehsim.plan(car, None, marks, fps=24).clip

    other, clip, measured = ob.moving("other", drive(ahead, 1 + late)), drive(0.0, 1), []
    real = certificates.gaps_to
    monkeypatch.setattr(certificates, "gaps_to", lambda *a: measured.append(len(a[1])) or real(*a))
    nearest, _ = certify_plane(clip, [(other, 0)])
    fine = clip.at(np.linspace(0, clip.duration, 20001))
    outlines = placed(ob.footprint(car), fine.positions[:, :2], yaw_of(fine.orientations))
    densely = distance(outlines, other.shapes_at(clip.start_frame / 24 + fine.times)[0]).min()
    assert nearest == pytest.approx(densely, abs=1.1e-3) and sum(measured) < 2000


def test_violated_obstacles_are_activated_near_the_violation(car):
    """With no active part, straight through the first part: it becomes active there, the far part and the start do
    not."""
    world = World(obstacles=[ob.ellipse("e", (20, 0), (2, 1)), ob.ellipse("far", (20, 60), (2, 1))])
    positions, yaw, seconds = np.column_stack([np.linspace(0, 40, 41), np.zeros((41, 2))]), np.zeros(41), np.zeros(41)
    blind = rows_among(car, world).near(Poses(positions + 200, yaw, seconds))
    assert not blind.active.any()
    rows = blind.violated_at(Poses(positions, yaw, seconds))
    near, far = (rows.active[rows.owners == part].any(axis=0) for part in (0, 1))
    assert near[16:25].all() and not near[:10].any() and not far.any()
    assert not blind.active.any() and rows.violated_at(Poses(positions, yaw, seconds)) is rows


def test_active_sets_of_a_failed_refinement_are_dropped(car):
    """The coarse problem is then solved again, for a limit that it violates between knots, with its own active set."""
    world = World("flat", obstacles=[ob.ellipse("one", (-3.261, 21.034), (0.601, 1.577)),
                                     ob.ellipse("two", (-6.329, 20.485), (1.916, 1.499))])  # fmt: skip
    marks = [Mark(0, position=(1.64, 16.245, 0), heading=-163.666), Mark("free", position=(-6.77, 12.951, 0))]
    plan = vehsim.plan(car, world, marks, segments=8, clearance=1.05, limits={"speed": 2.256})
    assert "not refined to" in plan.message and plan.clearance >= 1.04


def test_a_violation_doubles_the_active_range_around_the_guess(car):
    """Knots slide along a guess: those before and behind a wall must have rows too."""
    along, still = np.column_stack([np.linspace(0, 40, 161), np.zeros((161, 2))]), np.zeros(161)
    rows = rows_among(car, World(obstacles=[ob.box("wall", (20, 0, 0), (1, 8, 1))]))
    rows = rows.near(Poses(np.add(along, (0, 20, 0)), still, still))
    assert not rows.active.any()
    rows = rows.near(Poses(np.add(along, (0, 6.0, 0)), still, still))  # 1 m beside the wall
    before, seen = (one.active.any(axis=0) for one in (rows, rows.violated_at(Poses(along, still, still))))
    ahead = along[:, 0] - 20 - 0.5 - np.ptp(ob.footprint(car)[:, 0]) / 2
    assert before.any() and 0.8 < ahead[before].max() < 1.2  # within 1.5 m of the corner
    assert 2.0 < ahead[seen].max() < 2.6  # within 2.5 m


def test_cars_weave_between_walls(car):
    """Four walls from either side in turn: knots may not jump over inactive walls."""
    walls = [ob.box(f"w{k}", (10 + 8 * k, 5.5 if k % 2 else -5.5, 0), (0.6, 14, 1)) for k in range(4)]
    ends = [ob.box("top", (22, 14, 0), (50, 0.5, 1)), ob.box("bottom", (22, -14, 0), (50, 0.5, 1))]
    world = World(obstacles=walls + ends)
    plan = vehsim.plan(car, world, across(46.0), segments=64, clearance=0.4, refine=False)
    assert plan.success, plan.message
    assert gap_by_shapely(plan.clip, world) >= 0.4 - 2e-3


def test_rows_name_their_obstacle(car):
    """A failure therefore names the obstacle that is too near, not the number of a row."""
    rows = rows_among(car, World(obstacles=[ob.box("pier", (4, 0, 0), (2, 30, 1)), *WALLS]))
    rows = rows.near(Poses(np.zeros((4, 3)), np.zeros(4), np.zeros(4)))
    t = transcribe(car)
    layout = Layout(t.sizes, (3,))
    problem = NonlinearProgram(layout.size)
    rows.add_active(problem, t, layout)
    assert set(problem.names()) == {"obstacle 'pier'"}
    request = make_request(
        car, None, [replace(mark, frame=1001 + 8 * i) for i, mark in enumerate(across())], fps=24, segments=4
    )
    values = problem.vector(rows.values(Trajectory(request, t, layout, np.ones(layout.size))))
    assert len(values) == problem.parameters and np.isfinite(values).all()


def test_initial_guesses_measure_distances_only_where_needed(car, monkeypatch):
    """Costs, and distances up to what matters, equal those with exact distances everywhere."""
    ends = np.array([(0.0, 0, 0), (60, 0, 0)])
    parts = parts_in_reach(car, yard(3), across())
    ground = astar._Ground(ob.footprint(car), parts, ends[:, :2], 0.5, 0.5, ())
    monkeypatch.setattr(astar, "gaps_to", lambda shape, grid, reach: distance(grid, shape))
    exact = astar._Ground(ob.footprint(car), parts, ends[:, :2], 0.5, 0.5, ())
    assert np.array_equal(ground.price, exact.price) and np.array_equal(ground.demanded, exact.demanded)
    assert np.array_equal(ground.capped, exact.capped)
    assert not np.array_equal(ground.distance, exact.distance)


def test_far_parts_cost_nothing_and_are_bounded_from_below(car):
    world = yard(0)
    parts = parts_in_reach(car, world, across())
    outlines = placed(ob.footprint(car), np.array([[x, 0.0] for x in np.linspace(0, 50, 30)]), np.zeros(30))
    exact, bounded = (clearances(parts, outlines, np.zeros(30), reach) for reach in (np.inf, 2.0))
    assert np.all(bounded <= exact + 1e-9)
    np.testing.assert_allclose(bounded[exact < 1.9], exact[exact < 1.9])


def test_the_least_clearance_is_that_of_all_distances(car):
    """Near and far, also inside obstacles, and the same for equal obstacles."""
    parts, rng = parts_in_reach(car, yard(0), across()), np.random.default_rng(0)
    for x in (0.0, 12.0, 25.0, 500.0):
        outlines = placed(ob.footprint(car), x + rng.uniform(-4, 4, (40, 2)), rng.uniform(-3, 3, 40))
        for chosen in (parts, parts[:1] * 3):
            assert least_clearance(chosen, outlines, np.zeros(40)) == clearances(chosen, outlines, np.zeros(40)).min()


def test_turning_circles_follow_from_the_constraints(car):
    assert turning_radius(car) == pytest.approx(2.6 / 0.7, rel=2e-3)
    assert turning_radius(vehsim.load_vehicle("two_wheeled")) == 0.0


def test_guesses_drive_no_tighter_than_the_car_can(car):
    world = yard(2)
    parts = parts_in_reach(car, world, across())
    path = guess_drive(car, parts, np.array([(0, 0, 0), (50.0, 0, 0)]), (0.0, 0.0), 0.5)
    gaps = clearances(parts, placed(ob.footprint(car), path[:, :2], path[:, 3]), np.zeros(len(path)))
    assert gaps.min() > 0
    axle = path[:, :2] + np.column_stack([np.cos(path[:, 3]), np.sin(path[:, 3])]) * car.origin[0]
    way, turn = np.linalg.norm(np.diff(axle, axis=0), axis=1), np.abs(np.diff(path[:, 3]))
    assert np.median(turn / np.maximum(way, 1e-9)) < 1 / turning_radius(car) + 1e-3


def test_a_heading_decides_on_which_side_a_guess_passes():
    """Round the far side of the depot, a truck would have to turn by 270 degrees at the end, on 111 m."""
    truck = vehsim.load_vehicle("truck")
    parts = [(ob.box("depot", (40.0, 20.0, 0), (30, 10, 8)), 0)]
    path = guess_drive(truck, parts, np.array([(0.0, 0, 0), (62.0, 30.0, 0)]), (0.0, np.pi / 2), 0.5)
    assert np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1).sum() < 85
    assert np.abs(np.diff(path[:, 3])).sum() < np.pi
    assert clearances(parts, placed(ob.footprint(truck), path[:, :2], path[:, 3]), np.zeros(len(path))).min() > 0


def test_a_boat_is_guessed_to_turn_in_arcs_of_its_length():
    boat = vehsim.load_vehicle("boat")
    parts = [(ob.box("jetty", (20.0, 4.5, 0), (16, 2.4, 1.5)), 0)]
    path = guess_drive(boat, parts, np.array([(0.0, 0, 0), (20.0, 0, 0)]), (np.pi / 2, np.pi), 0.5)
    way, turn = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1), np.abs(np.diff(path[:, 3]))
    assert [path[0, 3], path[-1, 3] % (2 * np.pi)] == pytest.approx([np.pi / 2, np.pi])
    assert turn.max() < np.radians(20)  # it does not turn on the spot
    assert np.percentile(turn / way, 80) < 1.1 / np.ptp(ob.footprint(boat)[:, 0])


def test_worlds_of_the_same_shapes_share_a_problem(car):
    """The positions of parts are parameters: the same rows serve another world."""
    boxes = [ob.box("b", (x, 3, 0), (1, 1, 1)) for x in (10.0, 11.0)]
    blocks = [ObstacleClearance(car, [(box, 0)], 0.5) for box in boxes]
    t = transcribe(car)
    one, two = (
        replace(block, active=np.ones((len(block.features), 3), bool)).key(Layout(t.sizes, (2,)), t) for block in blocks
    )
    assert one == two and hash(one) == hash(two)


@pytest.mark.parametrize(
    ("before", "after", "settled"),
    [(0.13, 0.142, False), (0.142, 0.144, True), (0.142, 0.147, False), (0.12, 0.125, False), (0.144, 0.151, False)],
)
def test_tightening_ends_where_it_gains_little_within_the_tolerance(before: float, after: float, settled: bool) -> None:
    found = [SimpleNamespace(certificate=Certificate((Finding(gap, 0.15, False),))) for gap in (before, after)]
    assert _settles(*found) is settled
