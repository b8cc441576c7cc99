"""Hulls in the ground: the deepest point compared with dense samples, and hulls that come to rest on peaks."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_contact import slab

import vehsim
from vehsim.lie import SE3
from vehsim.vehicles import Holonomic, Rig, State
from vehsim.world.contact.contact import Contact
from vehsim.world.contact.grounding import Underside
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

BARGE = np.array([[x, y, z] for x in (-5.0, 5.0) for y in (-2.0, 2.0) for z in (-0.75, 0.75)])
KEEL = np.array([[-3, 0, -0.5], [3, 0.2, -0.6], *[[x, y, 0.4] for x in (-3.2, 3.4) for y in (-1, 1)]])


def rough(seed, cell=0.8, height=0.6):
    heights = np.random.default_rng(seed).uniform(-height, 0, (60, 60))
    return Terrain("rough", heights, (-30 * cell, -30 * cell), (cell, 1.1 * cell))


def sampled(points, count, random):
    """Points all over a convex hull's surface."""
    from scipy.spatial import ConvexHull

    corners = points[ConvexHull(points).simplices]
    weights = random.dirichlet((1, 1, 1), (count, len(corners)))
    return np.einsum("nfk,fki->nfi", weights, corners).reshape(-1, 3)


@pytest.mark.parametrize("hull", [BARGE, KEEL], ids=["barge", "keel"])
@pytest.mark.parametrize("seed", range(4))
def test_no_point_of_a_hull_is_deeper_than_the_deepest_found(hull, seed):
    """The gap to the ground is at most that of 40,000 samples of the hull; it touches when they do."""
    random, terrain = np.random.default_rng(seed), rough(seed)
    side = Underside([hull], terrain)
    samples = sampled(hull, 4000, random)
    for _ in range(6):
        turn = Rotation.from_euler("ZYX", random.normal(size=3) * [2, 0.1, 0.1])
        position = np.array([*random.uniform(-10, 10, 2), 0.0])
        places = turn.apply(samples) + position
        nearest = (places[:, 2] - terrain.height(places[:, :2])).min()
        for above in (2.0, 0.05, -0.02):  # height of the lowest sample above the ground
            gap, points = side.on(turn.as_matrix(), position + np.array([0, 0, above - nearest]))
            assert (points is None) == (gap > 0)
            if above < 0:  # depths are along the normals: of the ground, or of the hull's face that a peak is in
                assert points is not None and 0.5 * -above < max(points.depths) < -above + 0.06
                np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1)
            elif points is None:
                assert gap <= above
            else:
                assert above < 0.1 and max(points.depths) < 0.06  # missed by the samples


@pytest.mark.parametrize("shape", ["cone", "ridge"])
def test_a_barge_rests_on_a_peak_between_its_corners(tmp_path, shape):
    """On a cone below its middle, or across a ridge: at most two centimetres deep, although its corners are in the
    air."""
    slab(tmp_path / "barge.usda", (10.0, 4.0, 1.5))
    x = np.arange(-20.0, 20.5, 0.5)
    far = np.hypot(x, x[:, None]) if shape == "cone" else np.abs(x + 0 * x[:, None])
    terrain = Terrain(shape, 2.0 - 0.8 * far, (-20, -20), (0.5, 0.5))
    mass, size = 5e3, np.array([10.0, 4.0, 1.5])
    turning = mass / 12 * (size @ size - size**2)
    barge = Holonomic(
        name="barge", group=SE3, inertia=[*turning, *[mass] * 3], gravity=9.81, rig=Rig(tmp_path / "barge.usda", "")
    )
    start = State(position=(0, 0, 2.0 + 0.75 + 0.3))
    world = World(terrain, contact=Contact(0.6, 0.1, 5.0))
    clip = vehsim.simulate(barge, world, None, start, duration=0.8, step=1 / 60, fps=60)
    assert clip.positions[:, 2].min() > 2.73 and clip.positions[-1, 2] == pytest.approx(2.75, abs=0.02)
    assert clip.events[0]["with"] == "terrain" and abs(clip.twists[-1, 5]) < 0.1


@pytest.mark.parametrize("cell", [0.05, 0.5])
def test_a_cliff_is_detected_before_contact(tmp_path, cell):
    """High above the ground, at 20 m/s, a block meets a wall of ten metres: at most two centimetres deep."""
    slab(tmp_path / "block.usda", (1.0, 0.6, 0.4))
    rig = Rig(tmp_path / "block.usda", "")
    block = Holonomic(name="block", group=SE3, inertia=[4, 10, 11, *[100.0] * 3], gravity=0.0, rig=rig)
    x = np.arange(-2.0, 4.0 + cell, cell) + np.zeros((20, 1))
    terrain = Terrain("cliff", np.where(x > 1.0, 10.0, 0.0), (-2.0, -10 * cell), (cell, cell))
    for place in (-0.7, -0.5):
        start = State(position=(place, 0.1, 6.0), twist=(0, 0.5, 1, 20.0, 0, 0))
        clip = vehsim.simulate(block, World(terrain, contact=Contact()), None, start, 0.15, step=1 / 60, fps=60)
        side = Underside(
            [np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.3, 0.3) for z in (-0.2, 0.2)])], terrain
        )
        found = [side.on(matrix[:3, :3], matrix[:3, 3])[1] for matrix in clip.matrices()]
        assert max((points.depths.max() for points in found if points), default=0.0) < 0.02
        assert len(clip.events) == 1 and clip.events[0]["speed"] == pytest.approx(20.0, abs=1.0)
        assert (
            -0.5 * 20 < clip.twists[-1, 3] < 0
        )  # thrown back by no more than the restitution, 0.3, and what spin gives


@pytest.mark.parametrize("shape", ["ridge", "step"])
def test_elastic_blows_on_edges_of_the_ground_keep_the_energy(tmp_path, shape):
    """A block's corners and edges against a ridge and a cliff's edge, in any orientation, with the right normals."""
    size, mass = np.array([1.0, 0.6, 0.4]), 100.0
    slab(tmp_path / "block.usda", size)
    turning = mass / 12 * (size @ size - size**2)
    rig = Rig(tmp_path / "block.usda", "")
    block = Holonomic(name="block", group=SE3, inertia=[*turning, *[mass] * 3], gravity=0.0, rig=rig)
    x = np.arange(-20.0, 20.5, 0.5) + np.zeros((81, 1))
    terrain = Terrain(
        shape, 2 - 0.8 * np.abs(x) if shape == "ridge" else np.where(x > 0, 2.0, 0.0), (-20, -20), (0.5, 0.5)
    )
    for seed in range(6):
        random = np.random.default_rng(seed)
        turn = Rotation.random(rng=random)
        way = np.array([random.uniform(-0.6, 0.6), random.uniform(-0.3, 0.3), -1.0])
        way *= 10 / np.linalg.norm(way)
        position = [random.uniform(-0.5, 0.5), random.uniform(-3, 3), 2.2] - 0.12 * way
        start = State(position, turn.as_quat(scalar_first=True), (0, 0, 0, *turn.inv().apply(way)))
        clip = vehsim.simulate(block, World(terrain, contact=Contact(0.0, 1.0)), None, start, 0.4, step=1 / 60, fps=60)
        energy = clip.twists**2 @ np.diag(block.inertia) / 2
        assert clip.events and energy[-1] == pytest.approx(energy[0], rel=0.1), seed
