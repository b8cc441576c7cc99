"""Clearances by MuJoCo compared with elementary geometry."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
import pytest
from elementary import ExactDistance
from scipy.ndimage import maximum_filter1d
from scipy.spatial.transform import Rotation

from vehsim.errors import InputError
from vehsim.world.distance.clearance import ObstacleScene
from vehsim.world.distance.scene import Scene, add_terrain, write_heights
from vehsim.world.obstacles.obstacles import box
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World


@pytest.fixture(scope="module")
def canyon():
    return World("canyon")


@pytest.fixture(scope="module")
def poses(canyon, vehicle):
    """1,000 random free poses, more than half of them within 3 m of a ridge: positions, quaternions, clearances."""
    rng = np.random.default_rng(7)
    heights = canyon.terrain.heights
    crest = np.zeros(heights.shape, bool)
    for axis in (0, 1):  # a ridge: higher than everything 4 cells to either side, and well above its surroundings
        crest |= (maximum_filter1d(heights, 9, axis=axis) == heights) & (heights > 10)
    rows, cols = np.nonzero(crest[15:-15, 15:-15])
    pick = rng.integers(len(rows), size=4000)
    ridge = canyon.terrain.vertices.reshape(*heights.shape, 3)[rows[pick] + 15, cols[pick] + 15]
    ridge = ridge + rng.uniform([-2, -2, 0], [2, 2, 8], (4000, 3))
    valley = rng.uniform([-60, -40, 5], [230, 80, 60], (2000, 3))
    positions = np.concatenate([ridge, valley])
    turns = Rotation.random(len(positions), rng=rng).as_quat(scalar_first=True)
    clearance = canyon.clearance(vehicle, positions, turns)
    near = np.flatnonzero((clearance > 0) & (clearance < 3) & (np.arange(6000) < 4000))[:600]
    far = np.flatnonzero((clearance > 0) & (np.arange(6000) >= 4000))[:400]
    chosen = np.concatenate([near, far])
    assert len(near) == 600 and len(far) == 400
    return positions[chosen], turns[chosen], clearance[chosen]


def placed(hulls, position, turn):
    rotation = Rotation.from_quat(turn, scalar_first=True)
    return [rotation.apply(hull) + position for hull in hulls]


def test_clearance_is_exact_against_elementary_geometry(canyon, hulls, poses):
    exact = ExactDistance(canyon.terrain)
    positions, turns, clearance = poses
    expected = [min(map(exact, placed(hulls, p, q))) for p, q in zip(positions, turns, strict=True)]
    assert np.count_nonzero(np.array(expected) < 3) >= 500
    np.testing.assert_allclose(clearance, expected, rtol=0, atol=1e-4)


def test_clearance_does_not_depend_on_the_pose_before(canyon, vehicle, poses):
    positions, turns, clearance = poses
    shuffled = np.random.default_rng(0).permutation(len(positions))
    again = canyon.clearance(vehicle, positions[shuffled], turns[shuffled])
    np.testing.assert_allclose(again, clearance[shuffled], rtol=0, atol=2e-6)


def test_a_pose_deep_in_the_rock_does_not_spoil_the_next(canyon, vehicle):
    """Depth is measured vertically: below a plateau it is larger than the horizontal distance to the cliff's face."""
    free = (180.0, 40.0, 28.0)
    inside = (free[0], free[1] + 30.0, 10.0)
    level = [[1, 0, 0, 0]] * 2
    alone = canyon.clearance(vehicle, [free], level[:1])[0]
    after = canyon.clearance(vehicle, [inside, free], level)
    assert after[0] < -30
    assert after[1] == pytest.approx(alone, abs=1e-6)


def test_one_plain_call_of_mujoco_misses_the_nearest_rock(canyon, vehicle, poses):
    """The reason for the repeated queries of `Scene`: if MuJoCo fixes this, they can be removed."""
    scene = Scene(canyon.terrain, vehicle.rig)
    errors = []
    for position, turn, true in zip(*(x[-200:] for x in poses), strict=True):
        scene._place(position[None], turn[None])
        answers = [mujoco.mj_geomDistance(scene.model, scene.data, h, scene._ground, 200, None) for h in scene._hulls]
        errors.append(min(answers) - true)
    assert max(errors) > 1.0


def test_a_pose_in_the_rock_is_negative(canyon, vehicle, hulls):
    """Inside means: a corner of a hull lies below the surface, or the surface pierces a hull."""
    rng = np.random.default_rng(3)
    xy = rng.uniform([-60, -40], [230, 80], (300, 2))
    positions = np.column_stack([xy, canyon.height(xy) + rng.uniform(-30, 3, 300)])
    turns = Rotation.random(300, rng=rng).as_quat(scalar_first=True)
    clearance = canyon.clearance(vehicle, positions, turns)
    for position, turn, value in zip(positions, turns, clearance, strict=True):
        corners = np.concatenate(placed(hulls, position, turn))
        depth = (canyon.height(corners[:, :2]) - corners[:, 2]).max()
        if depth > 0:
            assert value == pytest.approx(-depth, abs=1e-4)
    assert (clearance < 0).sum() > 200


def test_a_spike_through_the_rotor_disc_is_inside(vehicle):
    """No corner of a hull is in the rock, but it touches."""
    heights = np.zeros((41, 41))
    heights[20, 20] = 6.0
    world = World(Terrain("spike", heights, origin=(-20, -20), cell=(1, 1)))
    level = [[1, 0, 0, 0]] * 2
    clearance = world.clearance(vehicle, [[4.2, 0, 2.0], [4.2, 0, 3.2]], level)
    assert clearance[0] < 0 < clearance[1]
    assert clearance[1] == pytest.approx(6.1 - 6.0, abs=1e-5)


def test_the_height_field_in_mujoco_is_the_terrain(canyon):
    spec = mujoco.MjSpec()
    add_terrain(spec, canyon.terrain)
    model = spec.compile()
    write_heights(model, canyon.terrain)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rng = np.random.default_rng(1)
    xy = rng.uniform(canyon.terrain.lower[:2] + 0.01, canyon.terrain.upper[:2] - 0.01, (500, 2))
    hit = np.zeros(1, np.int32)
    down = np.array([0.0, 0, -1])
    depth = [mujoco.mj_ray(model, data, np.array([*p, 200.0]), down, None, 1, -1, hit, None) for p in xy]
    np.testing.assert_allclose(200 - np.array(depth), canyon.height(xy), atol=2e-5)


def test_beyond_the_borders_the_ground_continues(vehicle):
    world = World(Terrain("plate", np.full((11, 11), 2.0)))
    inside, outside, below = world.clearance(vehicle, [[5, 5, 10], [500, 5, 10], [500, 5, 1]], [[1, 0, 0, 0]] * 3)
    assert inside == pytest.approx(8, abs=1e-5)
    assert outside == pytest.approx(8, abs=1e-5)
    assert below == pytest.approx(-1, abs=1e-5)


def test_clearance_in_empty_space_is_infinite(vehicle):
    assert World().clearance(vehicle, np.zeros((2, 3)), [[1, 0, 0, 0]] * 2).tolist() == [np.inf, np.inf]


def test_broken_poses_are_named(canyon, vehicle):
    with pytest.raises(InputError, match=r"positions\[1\]"):
        canyon.clearance(vehicle, [[0, 0, 30], [0, np.nan, 30]], [[1, 0, 0, 0]] * 2)
    with pytest.raises(InputError, match=r"orientations\[0\]"):
        canyon.clearance(vehicle, [[0, 0, 30]], [[0, 0, 0, 0]])


@pytest.mark.parametrize("where", ["terrain", "obstacles"])
def test_threads_share_a_scene(canyon, vehicle, poses, where):
    """Four at once, each with other poses, find what one finds: MuJoCo releases Python's lock."""
    positions, turns, _ = poses
    if where == "terrain":
        scene = Scene(canyon.terrain, vehicle.rig)
    else:
        rng = np.random.default_rng(3)
        places = rng.uniform([-60, -40, 5], [230, 80, 60], (30, 3))
        scene = ObstacleScene(vehicle.rig, [box(f"b{k}", place, (8, 8, 20)) for k, place in enumerate(places)])
    parts = np.array_split(np.arange(len(positions)), 4)
    expected = [scene.clearance(positions[part], turns[part]) for part in parts]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda part: scene.clearance(positions[part], turns[part]), parts))
    for own, wanted in zip(found, expected, strict=True):
        np.testing.assert_array_equal(own, wanted)
