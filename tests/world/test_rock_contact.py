"""Contact with terrain that has overhangs, compared with closed forms and with MuJoCo's contact with boxes."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from test_contact import block, thrown  # noqa: F401

import vehsim
from vehsim.rig.parts import collision_hulls
from vehsim.vehicles import State
from vehsim.world.contact.contact import Contact
from vehsim.world.contact.rock import Rock
from vehsim.world.obstacles import obstacles
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

BOXES = (
    ((-20, -15, -5), (20, 15, 0)),
    ((-10, -12, -1), (10, -3, 8)),
    ((-10, 3, -1), (10, 12, 8)),
    ((-10, -3.5, 4), (10, 3.5, 8)),
)
"""The ground, the walls and the roof of a tunnel along X."""


@pytest.fixture(scope="module")
def tunnel(tmp_path_factory):
    file = tmp_path_factory.mktemp("rock") / "tunnel.obj"
    trimesh.boolean.union([trimesh.creation.box(bounds=bounds) for bounds in BOXES]).export(file)
    return Terrain.load(file)


@pytest.fixture(scope="module")
def boxes():
    placed = [((np.add(a, b) / 2)[:2], a[2], np.subtract(b, a)) for a, b in BOXES]
    return [obstacles.box(f"b{k}", (*xy, z), size) for k, (xy, z, size) in enumerate(placed)]


@pytest.mark.parametrize("gap", [-0.008, 0.05])
def test_depths_and_distances_agree_with_mujoco_on_boxes(tunnel, boxes, block, gap):  # noqa: F811
    """Faces, edges and corners of the block and of the tunnel, at random attitudes."""
    body = block()
    rock = Rock(collision_hulls(body.rig.asset, None), tunnel, body.rig)
    world, random = World(obstacles=boxes), np.random.default_rng(5)
    errors, kinds = [], 0
    while len(errors) < 60:
        start = random.uniform((-12, -2, 1.2), (12, 2, 3), 3)
        turn = Rotation.random(rng=random).as_quat(scalar_first=True)
        if world.clearance(body, [start], [turn])[0] < 0.1:
            continue
        way, far, near = random.normal(size=3), 30.0, 0.0
        way /= np.linalg.norm(way)
        for along in np.linspace(0, 30, 200):
            if world.clearance(body, [start + along * way], [turn])[0] < gap:
                far = along
                break
            near = along
        if far == 30.0:
            continue
        for _ in range(40):
            middle = (near + far) / 2
            below = world.clearance(body, [start + middle * way], [turn])[0] < gap
            near, far = (near, middle) if below else (middle, far)
        place = start + far * way
        by_box = world.clearance_by_obstacle(body, [place], [turn])[0]
        if (by_box < 0.02).sum() > (gap < 0.02) + (gap >= 0.02) * (by_box < 0.06).sum():
            continue  # an overlap with two boxes has two depths
        found, points = rock.on(Rotation.from_quat(turn, scalar_first=True).as_matrix(), place)
        if gap < 0:
            assert found == 0.0 and points is not None
            deepest = points.depths.argmax()
            errors.append(-points.depths[deepest] - by_box.min())
            kinds += len(points.depths) > 1
            np.testing.assert_allclose(np.linalg.norm(points.normals, axis=1), 1.0)
        else:
            errors.append(found - by_box.min())
    assert np.abs(errors).max() < 1e-3


@pytest.mark.parametrize(
    ("start", "velocity", "axis"),
    [((0, 0, 2), (0, 5, 0), 1), ((0, 0, 2), (0, 0, 5), 2), ((0, 0, 2), (0, 0, -5), 2), ((-14, 6, 2), (5, 0, 0), 0)],
    ids=["wall", "roof", "floor", "from outside"],
)
def test_walls_roof_and_floor_give_their_restitution(tunnel, block, start, velocity, axis):  # noqa: F811
    contact = Contact(friction=0.0, restitution=0.5, speed=10.0)
    world = World(tunnel, contact=contact)
    clip = thrown(block(gravity=0.0), contact, start, (0, 0, 0, *velocity), 1.0, world)
    assert clip.events and clip.events[0]["with"] == "terrain"
    after = clip.twists[-1][3:]
    assert after[axis] == pytest.approx(-0.5 * velocity[axis], rel=0.03)
    assert np.abs(np.delete(after, axis)).max() < 0.05


def test_a_block_comes_to_rest_in_the_tunnel(tunnel, block):  # noqa: F811
    contact = Contact(friction=0.6, restitution=0.1, speed=5.0)
    clip = thrown(block(), contact, (0, 0, 0.5), (0, 0, 0, 1.0, 0, 0), 3.0, World(tunnel, contact=contact))
    assert np.abs(clip.positions[-1, 2] - 0.2) < 0.005 and np.abs(clip.twists[-1]).max() < 0.01
    (other,) = {event["with"] for event in clip.events}
    assert other == "terrain"


def test_the_edge_of_a_wall_stops_a_block(tunnel, block):  # noqa: F811
    """The vertical edge of the tunnel's mouth hits the middle of its side; no corner touches."""
    contact = Contact(friction=0.0, restitution=0.3, speed=10.0)
    edge, half = np.array([-10, 3, 2.0]), np.array([0.5, 0.3, 0.2])
    turned = Rotation.from_euler("z", 45, degrees=True)
    middle = edge - turned.apply([half[0], 0, 0])  # of the block, where the edge meets its side
    start = State(
        position=tuple(middle - turned.apply([1.4, 0, 0])),
        orientation=tuple(turned.as_quat(scalar_first=True)),
        twist=(0, 0, 0, 3.5, 0, 0),
    )
    world = World(tunnel, contact=contact)
    clip = vehsim.simulate(block(gravity=0.0), world, None, start, duration=1.0, step=1 / 60, fps=60)
    assert clip.events and clip.events[0]["with"] == "terrain"
    rotations = Rotation.from_quat(clip.orientations, scalar_first=True)
    assert (np.abs(rotations.inv().apply(edge - clip.positions)) - half).max(axis=1).min() > -0.02
    np.testing.assert_allclose(clip.twists[-1], (0, 0, 0, -0.3 * 3.5, 0, 0), atol=0.03)  # pushed through its middle
