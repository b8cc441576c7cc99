"""Flight among obstacles: clear according to another library, between knots too; and landings."""

import warnings
from types import SimpleNamespace

import igl
import numpy as np
import pytest
import trimesh
from scipy.optimize import nnls
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

import vehsim
from vehsim import Mark, World
from vehsim.errors import InputError, SolveError
from vehsim.planning import planner
from vehsim.planning.certificates import certify
from vehsim.planning.guesses import routes
from vehsim.planning.guesses.routes import around
from vehsim.planning.request.landing import landing_clearance, rounded
from vehsim.planning.request.ranges import stay
from vehsim.planning.request.request import make_request
from vehsim.rig.parts import solids
from vehsim.runtime.progress import silent
from vehsim.world.distance.clearance import ObstacleScene
from vehsim.world.ground.touchdown import height_below, put_down
from vehsim.world.obstacles import obstacles as ob
from vehsim.world.obstacles.obstacles import hulls_of
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def helicopter():
    return vehsim.load_vehicle("helicopter")


def apart(a, b):
    """Distance of two convex point sets (n, 3), (m, 3): the nearest points as a non-negative least-squares problem."""
    sums = 1e3 * np.array([[1.0] * len(a) + [0.0] * len(b), [0.0] * len(a) + [1.0] * len(b)])
    weights, _ = nnls(np.vstack([np.hstack([a.T, -b.T]), sums]), [0, 0, 0, 1e3, 1e3], maxiter=10_000)
    return np.linalg.norm(
        weights[: len(a)] @ a / weights[: len(a)].sum() - weights[len(a) :] @ b / weights[len(a) :].sum()
    )


def strewn(vehicle):
    """Points (n, 3) m spread over a vehicle's hulls, a few centimetres apart at their corners, and which are the
    disc's."""
    rng = np.random.default_rng(0)
    points, on_disc = [], []
    for solid in solids(vehicle.rig.asset):
        for mesh in map(trimesh.convex.convex_hull, solid.hulls):
            points += [mesh.vertices, trimesh.sample.sample_surface(mesh, 300, seed=rng)[0]]
            on_disc += [np.full(len(cloud), solid.path == "main_rotor") for cloud in points[-2:]]
    return np.vstack(points), np.concatenate(on_disc)


def seen_by_igl(clip, hulls, times, frame=lambda t: np.eye(4)):
    """Signed distances (times,) m from points on the vehicle to convex ``hulls`` that ``frame`` (4, 4) moves.

    Upper bounds of the true distances; the difference is due to the spacing of the points.
    """
    shapes = [trimesh.convex.convex_hull(hull) for hull in hulls]
    (points, on_disc), out, there_at = strewn(clip.vehicle), [], clip.at(times)
    hub = next(solid.T_rp[:3, 3] for solid in solids(clip.vehicle.rig.asset) if solid.path == "main_rotor")
    tilts = Rotation.from_euler("YX", np.stack([there_at.channels[f"disc_{k}"] for k in ("pitch", "roll")], axis=1))
    for t, T, tilt in zip(times, there_at.matrices(), tilts, strict=True):
        T = np.linalg.inv(frame(t)) @ T
        there = np.where(on_disc[:, None], tilt.apply(points - hub) + hub, points) @ T[:3, :3].T + T[:3, 3]
        out.append(
            min(
                igl.signed_distance(
                    there, np.array(s.vertices), np.array(s.faces), igl.SIGNED_DISTANCE_TYPE_WINDING_NUMBER
                )[0].min()
                for s in shapes
            )
        )
    return np.array(out)


def hulls_in(world):
    return [hull for obstacle in world.standing for hull in obstacle.hulls]


TOWN = (
    ob.box("tower", (40, 0, 0), (12, 12, 60)),
    ob.sphere("balloon", (70, 14, 27), 6.0),
    ob.box("wall", (90, -30, 0), (3, 50, 60), 10),
)


@pytest.fixture(scope="module")
def flight(helicopter):
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=REST),
        Mark("free", position=(120, 0, 30), velocity=REST),
    ]
    return vehsim.plan(helicopter, World(obstacles=TOWN), marks, segments=48, clearance=1.5)


def test_flies_around_obstacles_at_rest(flight, helicopter):
    """As near as certified and no nearer, by libigl's distances; on a straight line it would hit the tower."""
    assert flight.success and flight.clearance >= 1.5 - 0.01
    hulls = hulls_in(World(obstacles=TOWN))
    seen = seen_by_igl(flight.clip, hulls, np.linspace(0, flight.duration, 200)).min()
    assert flight.clearance - 1e-3 <= seen <= flight.clearance + 0.15
    marks = [Mark(1, position=(0, 0, 30)), Mark(121, position=(120, 0, 30))]
    straight = vehsim.plan(helicopter, None, marks, segments=8).clip
    assert seen_by_igl(straight, hulls, straight.times).min() < 0


def test_a_range_may_begin_on_the_path_around_an_obstacle(helicopter):
    """The mark at the start of a stay has no position: the tower is halfway between its neighbours."""
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=REST),
        Mark(289, position=(80, 0, 30), heading=0, velocity=REST),
    ]
    low = stay((145, 289), below=40)
    plan = vehsim.plan(helicopter, World(obstacles=TOWN[:1]), marks, segments=32, terms=[low], refine=False)
    assert plan.success and plan.clearance >= 1 - 0.01


def test_certification_finds_what_samples_miss(flight):
    """Between samples too: with two poses per segment it finds the same minimum as with 32, to a millimetre."""
    world = World(obstacles=TOWN)
    fine = flight.clip.at(np.linspace(0, flight.duration, 32 * (len(flight.clip) - 1) + 1))
    exact = world.clearance(flight.clip.vehicle, fine.positions, fine.orientations, channels=fine.channels).min()
    assert certify(flight.clip, world, samples=1) == pytest.approx(exact, abs=2e-3)


def test_distances_to_obstacles_agree_with_least_squares(helicopter):
    """MuJoCo's results for hulls in any pose compared with another method, also for a vehicle that is a point."""
    rng = np.random.default_rng(1)
    boxes = [ob.box(f"b{i}", rng.uniform(-9, 9, 3), rng.uniform(1, 4, 3), rng.uniform(0, 90)) for i in range(3)]
    positions, turned = rng.uniform(8, 16, (4, 3)), rng.normal(size=(4, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    found = ObstacleScene(helicopter.rig, boxes).clearance(positions, turned, each=True)
    point = ObstacleScene(None, boxes).clearance(positions, turned, each=True)
    from vehsim.lie import SO3

    for k, (p, R) in enumerate(zip(positions, SO3.matrix(turned), strict=True)):
        for n, box in enumerate(boxes):
            nearest = min(apart(hull @ R.T + p, box.hulls[0]) for hull in hulls_of(helicopter))
            assert max(found[k, n], 0.0) == pytest.approx(nearest, abs=1e-4)
            assert point[k, n] == pytest.approx(apart(p[None], box.hulls[0]), abs=1e-4)


def test_distances_of_many_poses_are_those_of_each(helicopter):
    """Pairs of hulls are left out by bounds for many poses at once, none of which depends on the other poses."""
    rng = np.random.default_rng(2)
    boxes = [ob.box(f"b{i}", rng.uniform(-9, 9, 3), rng.uniform(1, 12, 3), rng.uniform(0, 90)) for i in range(4)]
    positions, turned = rng.uniform(4, 20, (70, 3)), rng.normal(size=(70, 4))
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    scene = ObstacleScene(helicopter.rig, boxes)
    found = scene.clearance(positions, turned, each=True)
    alone = [scene.clearance(p[None], q[None], each=True)[0] for p, q in zip(positions, turned, strict=True)]
    np.testing.assert_array_equal(found, alone)
    np.testing.assert_array_equal(found.min(axis=1), scene.clearance(positions, turned)[:, 0])


def test_no_overlap_is_left_out(helicopter):
    """Bounds leave out pairs of hulls: the deepest overlap is that of all pairs."""
    import mujoco

    rng = np.random.default_rng(4)
    boxes = [ob.box(f"b{i}", rng.uniform(-9, 3, 3), rng.uniform(4, 20, 3), rng.uniform(0, 90)) for i in range(3)]
    scene = ObstacleScene(helicopter.rig, boxes)
    own, theirs = [
        [k for k in range(scene.model.ngeom) if scene.model.geom(k).name.startswith(start)]
        for start in ("vehicle", "obstacle")
    ]
    for position, turned in zip(rng.uniform(-6, 6, (60, 3)), rng.normal(size=(60, 4)), strict=True):
        found = scene.clearance(position[None], turned[None] / np.linalg.norm(turned))[0, 0]
        every = [mujoco.mj_geomDistance(scene.model, scene.data, a, b, 100.0, None) for a in own for b in theirs]
        assert found == pytest.approx(min(every), abs=1e-6)


def test_moving_obstacles_are_avoided(helicopter):
    """Two helicopters on crossing paths reach the crossing together: they would touch, but keep 2 m apart."""
    crossing = [
        Mark(1, position=(60, -60, 30), heading=90, velocity=(0, 12, 0)),
        Mark(241, position=(60, 60, 30), heading=90, velocity=(0, 12, 0)),
    ]
    other = vehsim.plan(helicopter, None, crossing, segments=24).clip
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=(12, 0, 0)),
        Mark(241, position=(120, 0, 30), heading=0, velocity=(12, 0, 0)),
    ]
    world = World(obstacles=[ob.moving("other", other)])
    seeing = vehsim.plan(helicopter, world, marks, segments=24, clearance=2.0)
    assert seeing.success and seeing.clearance >= 2.0 - 0.01
    assert seeing.tightenings == 0  # the plan knows where the other one is, and when
    assert certify(vehsim.plan(helicopter, None, marks, segments=24).clip, world) < 0
    times = np.linspace(0, other.times[-1], 81)
    seen = seen_by_igl(seeing.clip, hulls_of(helicopter), times, lambda t: other.at([t]).matrices()[0]).min()
    assert seeing.clearance - 1e-3 <= seen <= seeing.clearance + 0.3


@pytest.mark.parametrize(
    "mark, complaint",
    [
        (Mark(1, position=(40, 0, 30)), "in obstacle 'tower'; move the mark"),
        (Mark(1, position=(27.5, 0, 30), heading=0), r"only \d\.\d+ m from obstacle 'tower'"),
        (Mark(1, position=(40, 0, 20), heading=0, on_ground=True), "inside the ground or an obstacle; raise it"),
        (Mark(1, position=(0, 0, 20), heading=0, on_ground=True), "nothing below it to stand on"),
        (Mark(1, position=(40, 0, 80), on_ground=True), "give the position above the ground, and a heading"),
        (Mark(1, position=(40, 0, 80), heading=0, on_ground=True, speed=3.0), "stands still at this mark"),
    ],
)
def test_impossible_marks_are_refused(helicopter, mark, complaint):
    with pytest.raises(InputError, match=complaint):
        vehsim.plan(helicopter, World(obstacles=TOWN), [mark, Mark(99, position=(120, 0, 30))], clearance=1.5)


# ------------------------------------------------------------ landing


def hilly():
    x, y = np.meshgrid(np.arange(-40, 121, 2.0), np.arange(-40, 41, 2.0))
    return Terrain("hilly", 3 * np.sin(x / 17) * np.cos(y / 13) + 0.02 * x, (-40.0, -40.0), (2.0, 2.0))


PAD = ob.ellipse("pad", (70, 5), (6, 6), height=8.0, base=-2.0)


@pytest.fixture(scope="module")
def touchdown(helicopter):
    world = World(hilly(), obstacles=[PAD])
    marks = [
        Mark(1, position=(0, 0, 20), heading=0, velocity=REST),
        Mark(241, position=(70, 5, 30), heading=30, on_ground=True),
    ]
    return world, vehsim.plan(helicopter, world, marks, segments=48, clearance=1.0, refine=False)


def test_lands_on_the_mark_at_its_frame(touchdown):
    """Skids on the pad to a tenth of a millimetre, level and at rest, at the requested frame."""
    _, plan = touchdown
    assert plan.success and plan.clip.end_frame == 241
    last = plan.clip.at([plan.duration])
    T = last.matrices()[0]
    low = np.vstack(hulls_of(plan.clip.vehicle)) @ T[:3, :3].T + T[:3, 3]
    assert low[:, 2].min() - PAD.top == pytest.approx(0.0, abs=1e-4)
    assert (low[:, 2] - PAD.top < 5e-3).sum() >= 8  # both skids
    np.testing.assert_allclose(last.positions[0, :2], (70, 5), atol=1e-6)
    assert np.degrees(np.arccos(min(1.0, last.matrices()[0, 2, 2]))) < 0.01
    assert np.abs(last.twists).max() < 1e-6


def test_comes_down_gently_and_never_into_the_ground(touchdown, helicopter):
    world, plan = touchdown
    times = np.linspace(0, plan.duration, 1500)
    motion = plan.clip.at(times)
    above = motion.positions - plan.clip.positions[-1]
    away = np.linalg.norm(above, axis=1)
    down = -np.gradient(motion.positions[:, 2], times)
    assert (down <= 0.5 + away + 0.2).all()
    gaps = world.clearance(helicopter, motion.positions, motion.orientations, channels=motion.channels)
    assert gaps.min() > -1e-3
    assert (gaps >= landing_clearance(away, 1.0, 0.0) - 0.02).all()
    # by libigl: never in the pad, and a metre from bare ground
    some = times[::30]
    assert seen_by_igl(plan.clip, PAD.hulls, some).min() > -1e-3
    (points, _), matrices = strewn(helicopter), plan.clip.at(some).matrices()
    there = np.vstack([points @ T[:3, :3].T + T[:3, 3] for T in matrices])
    squared = igl.point_mesh_squared_distance(there, world.terrain.vertices, world.terrain.faces)[0]
    assert np.sqrt(squared.min()) > 1.0 - 0.02


def test_approaches_a_place_among_hills(helicopter):
    """Tighter solves must be tighter beside the landing too: others ended 0.25 m too near the slope above it."""
    world = World("hills")
    marks = [
        Mark(1001, position=(-60, -30, 25), velocity=(12, 0, 0)),
        Mark(1361, position=(55, 0, 0), heading=60, on_ground=True),
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it stands up to half a metre above the ground
        plan = vehsim.plan(helicopter, world, marks)
    assert plan.success, plan.message
    motion = plan.clip.at(np.linspace(0, plan.duration, 1500))
    away = np.linalg.norm(motion.positions - plan.clip.positions[-1], axis=1)
    gaps = world.clearance(helicopter, motion.positions, motion.orientations, channels=motion.channels)
    assert (gaps >= landing_clearance(rounded(away**2), 1.0, 0.0) - 0.02).all()


def test_landing_on_rough_ground_warns(helicopter):
    """From the pad to uneven bare ground: it stands on its highest point; the height elsewhere is reported."""
    world = World(hilly(), obstacles=[PAD])
    marks = [
        Mark(1, position=(70, 5, 30), heading=180, on_ground=True),
        Mark(193, position=(20, 0, 30), heading=180, on_ground=True, hold=12),
    ]
    with pytest.warns(
        UserWarning, match=r"stands up to 0\.\d\d m above it elsewhere; land on level ground or on a pad"
    ):
        plan = vehsim.plan(helicopter, world, marks, segments=48, clearance=1.0, refine=False)
    assert plan.success and plan.clip.end_frame == 205
    ends = plan.clip.at([0.0, plan.duration])
    touching = world.clearance(helicopter, ends.positions, ends.orientations)
    assert touching.min() > -1e-9 and touching.max() < 1e-4
    held = plan.clip.at(np.linspace(192 / 24, plan.duration, 20))
    assert np.ptp(held.positions, axis=0).max() < 1e-6


def test_put_down_is_exact(helicopter):
    """On level ground the skids' lowest point is at the ground's height; under a bridge it stands below the bridge."""
    flat = World("flat", obstacles=[ob.box("bridge", (0, 0, 10), (20, 20, 2))])
    level = np.array([1.0, 0, 0, 0])
    lowest = min(hull[:, 2].min() for hull in hulls_of(helicopter))
    ground = float(flat.height([(0, 0)])[0])
    assert put_down(flat, helicopter, (0, 0, 4), level)[2] == pytest.approx(ground - lowest, abs=1e-4)
    assert put_down(flat, helicopter, (0, 0, 40), level)[2] == pytest.approx(12 - lowest, abs=1e-4)
    points = np.array([(0, 0, 5.0), (0, 0, 11), (0, 0, 40), (30, 0, 40)])
    np.testing.assert_allclose(height_below(flat, points), [ground, 12, 12, ground], atol=1e-9)


def test_helicopters_pass_gates_narrower_than_their_spheres(helicopter):
    """A hall divided by walls: 15 m between them, 10.8 m across the rotor, 15.9 m across all spheres.

    If the gap is a metre too narrow, the message says so, and how much of the required width is the helicopter.
    """

    def hall(gate):
        walls = [ob.box(f"wall{s}", (40, s * (gate / 2 + 12), 0), (3, 24, 40)) for s in (1, -1)]
        sides = [ob.box(f"side{s}", (40, s * 32, -2), (124, 2, 44)) for s in (1, -1)]
        ends = [ob.box(f"end{x}", (x, 0, -2), (2, 66, 44)) for x in (-21, 101)]
        return World(obstacles=walls + sides + ends + [ob.box(f"z{z}", (40, 0, z), (124, 66, 2)) for z in (-2, 40)])

    marks = [Mark(1, position=(0, 0, 18), heading=0, velocity=REST), Mark("free", position=(80, 0, 18), velocity=REST)]
    plan = vehsim.plan(helicopter, hall(15.0), marks, segments=32, clearance=0.5, refine=False)
    assert plan.success, plan.message
    assert plan.clearance > 0.49
    with pytest.raises(SolveError, match=r"no path from .* 5.4 m for the helicopter itself"):
        vehsim.plan(helicopter, hall(9.0), marks, segments=32, clearance=0.5)


def slot(width, length=60):
    """Two walls, ``width`` m apart, higher than the ceiling of the tests below and too deep to dive below them."""
    sides = [(s, s * (width + length) / 2) for s in (1, -1)]
    return World(obstacles=[ob.box(f"wall{s}", (0, y, -60), (6, length, 180)) for s, y in sides])


def test_a_helicopter_flies_level_through_a_gap_that_its_spheres_do_not_fit(helicopter):
    """13.2 m between the walls: 10.7 m across the rotor and 1 m on either side; spheres need 15.9 m or a steep bank."""
    marks = [Mark(1, position=(-50, 6, 12), heading=0, velocity=REST), Mark(313, position=(50, -4, 12), velocity=REST)]
    world = slot(13.2, length=200)  # too long to fly around
    plan = vehsim.plan(helicopter, world, marks, segments=48, limits={"ceiling": 30})
    assert plan.success, plan.message
    assert 0.99 < plan.clearance < 1.3  # 1.25 if it is level
    inside = np.abs(plan.clip.positions[:, 0]) < 4
    up = plan.clip.matrices()[inside, 2, 2]
    assert np.degrees(np.arccos(up.min())) < 20


def terrain_with_gap(folder, width):
    """Ground with a wall 60 m high and 300 m long, with a gap in its middle, as one mesh."""
    walls = [((57, s * width / 2, -1), (63, s * (width / 2 + 150), 60)) for s in (1, -1)]
    boxes = [trimesh.creation.box(bounds=np.sort(corners, axis=0)) for corners in walls]
    ground = trimesh.creation.box(bounds=[(-100, -250, -2), (250, 250, 0)])
    path = folder / f"gap{width}.obj"
    trimesh.util.concatenate([ground, *boxes]).export(path)
    return World(terrain=path)


def test_a_gap_that_saves_a_long_way_is_flown_through(helicopter, tmp_path):
    """Its walls are terrain, whose spheres need 15.8 m and a 2.2 m grid: the way around is three times as long."""
    marks = [
        Mark(1, position=(0, 10, 15), heading=0, velocity=REST),
        Mark(441, position=(120, -10, 15), velocity=REST),
    ]
    plan = vehsim.plan(helicopter, terrain_with_gap(tmp_path, 16.0), marks, segments=48)
    assert plan.success, plan.message
    assert plan.clearance > 0.99
    assert np.linalg.norm(np.diff(plan.clip.positions, axis=0), axis=1).sum() < 130


def test_where_a_gap_is_too_hard_the_way_around_it_is_tried(helicopter, tmp_path, monkeypatch):
    """8 m is passed only on the side."""
    ends = np.array([(0, 10, 15), (60, 0, 15), (120, -10, 15)], float)
    marks = [Mark(1 + 600 * k, position=ends[2 * k], heading=0, velocity=REST) for k in (0, 1)]
    request = make_request(helicopter, terrain_with_gap(tmp_path, 8.0), marks, fps=24, segments=48)
    (way,) = around(request, [ends])
    assert np.abs(way[:, 1]).max() > 150 and around(request, [way]) == []
    monkeypatch.setattr(routes, "find_paths", lambda *_: [ends])
    flown = SimpleNamespace(success=True)
    monkeypatch.setattr(planner, "_gentle", lambda request, progress, path, beyond: path if path is None else flown)
    assert planner._unless_too_hard(request, None, None, []) is flown


@pytest.mark.parametrize("character", ["normal", "stunt"])
def test_a_mark_in_a_slot_that_only_the_hulls_fit(helicopter, character):
    """It arrives along the slot and stops in it; the spheres are 1.5 m too wide for the mark."""
    marks = [Mark(1, position=(-40, 0, 12), heading=0, velocity=REST), Mark(289, position=(0, 0, 12), velocity=REST)]
    options = {"segments": 32, "limits": {"ceiling": 30}, "character": character}
    plan = vehsim.plan(helicopter, slot(13.0), marks, **options)
    assert plan.success, plan.message
    assert plan.clearance > 0.99
    with pytest.raises(InputError, match="at any heading"):
        vehsim.plan(helicopter, slot(11.0), marks, **options)


def test_the_surface_is_measured_only_where_a_sphere_is_near(helicopter):
    """In a canyon, a seventh of it; there, at its points nearest to the rock, elsewhere it counts as the sphere."""
    from vehsim.lie import SO3
    from vehsim.planning.constraints.clearance import SIGHT, Clearance, SphereCover
    from vehsim.planning.constraints.spheres import sphere_cover, surface_by_sphere

    world, marks = slot(30.0), [Mark(1, position=(-20, 0, 12)), Mark(100, position=(20, 0, 12))]
    field = world.distance_field(box=np.array([[-60, -20, -5], [60, 20, 60.0]]))
    cover = SphereCover(field, *sphere_cover(helicopter))
    block = Clearance(make_request(helicopter, world, marks, fps=24, segments=16), cover, 1.0)
    places, (points, first) = np.array([(-15.0, 3, 12), (0, -4, 15), (8, 2, 10)]), surface_by_sphere(helicopter)
    R = SO3.matrix(np.tile([0.8, 0, 0, 0.6], (3, 1)))
    spheres = block._spheres(field, places, R)
    near = spheres < block.required + SIGHT
    assert 0 < near.mean() < 1
    found = block._surface(spheres, places, R)
    whole = [np.minimum.reduceat(field.value(p + points @ turn.T), first) for p, turn in zip(places, R, strict=True)]
    np.testing.assert_allclose(found, np.where(near, whole, spheres), atol=1e-12)


def test_the_surface_in_the_spheres_is_as_far_away_as_the_hulls(helicopter):
    """Points on the surface against MuJoCo's distances of the hulls, at poses beside a wall."""
    from vehsim.lie import SO3
    from vehsim.planning.constraints.spheres import sphere_cover, surface_by_sphere

    rng, world = np.random.default_rng(1), slot(30.0)
    places = rng.uniform((-20, -9, 5), (20, 9, 20), (20, 3))
    turns = rng.normal(size=(20, 4)) * [1, 0.2, 0.2, 1]
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    hulls = world.clearance(helicopter, places, turns)
    points, first = surface_by_sphere(helicopter)
    field = world.distance_field(box=np.array([[-30, -20, -5], [30, 20, 30.0]]))
    surface = [field.value(p + points @ R.T).min() for p, R in zip(places, SO3.matrix(turns), strict=True)]
    np.testing.assert_allclose(surface, hulls, atol=0.15)
    centres, _ = sphere_cover(helicopter)
    assert len(first) == len(centres) and first[0] == 0 and (np.diff([*first, len(points)]) > 0).all()


@pytest.mark.parametrize("scale", [(1, 1, 1), (10, 10, 0.02), (30, 0.05, 0.05), (0.1, 0.1, 0.1)])
@pytest.mark.parametrize("spacing", [0.3, 0.6])
def test_points_on_a_hull_are_as_dense_as_promised(scale, spacing):
    """Round hulls, thin discs, slivers and small ones: any point of the surface is near one of them."""
    from vehsim.planning.constraints.spheres import _surface

    hull = trimesh.convex.convex_hull(np.random.default_rng(2).normal(size=(40, 3)) * scale)
    points = _surface(hull.vertices, spacing)
    samples, _ = trimesh.sample.sample_surface(hull, 20_000, seed=3)
    assert KDTree(points).query(samples)[0].max() <= spacing / np.sqrt(3)
    assert (
        np.sqrt(igl.point_mesh_squared_distance(points, np.array(hull.vertices), np.array(hull.faces))[0].max()) < 1e-5
    )


@pytest.mark.filterwarnings("ignore")
def test_a_flight_passes_between_two_towers_if_that_is_easier(monkeypatch):
    """It went round both, 26 m aside, and banked by 45 degrees."""
    towers = [ob.box("left", (45, 7, 0), (9, 9, 45)), ob.box("right", (85, -9, 0), (10, 10, 50))]
    world = World("flat", obstacles=[*towers, ob.box("aside", (62, 34, 0), (12, 8, 30))])
    marks = [Mark(frame, position=(x, 0, 22), velocity=(15, 0, 0)) for frame, x in ((1, 0), (181, 130))]
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), world, marks, segments=64)
    assert plan.success and plan.clearance > 0.99
    assert np.abs(plan.clip.positions[:, 1]).max() < 10
    bank = np.degrees(np.arccos(plan.clip.matrices()[:, 2, 2])).max()
    assert bank < 33

    request = make_request(plan.clip.vehicle, world, marks, fps=24, segments=64)
    monkeypatch.setattr(routes, "SHORTER", 0.0)  # as before
    assert np.abs(np.vstack(routes.find_paths(request, None, silent))[:, 1]).max() > 20


@pytest.mark.parametrize(("bottom", "dives"), [(0.0, True), (3.0, False)], ids=["standing", "hanging"])
def test_a_flight_below_obstacles_that_stand_is_warned_of(helicopter, bottom, dives):
    wall = ob.box("wall", (60.0, 0.0, bottom), (4.0, 300.0, 80.0))
    ends = {1001: (0.0, 0.0, 15.0), 1481: (120.0, 0.0, 15.0)}
    marks = [Mark(frame, position=place, heading=0, velocity=REST) for frame, place in ends.items()]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plan = vehsim.plan(helicopter, world=World(obstacles=[wall]), marks=marks, clearance=1.0)
    assert plan.success
    lowest = plan.clip.positions[:, 2].min()
    assert lowest < 0
    said = [str(warning.message) for warning in caught if "below its obstacles" in str(warning.message)]
    assert len(said) == dives
    assert all(f"z = {lowest:.1f} m" in each and 'terrain = "flat"' in each for each in said)
