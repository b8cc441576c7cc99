"""Rotor discs stand across the thrust, and clearances are those of the tilted disc."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.planning.certificates import certify
from vehsim.rig.linkage import moved
from vehsim.rig.parts import solids
from vehsim.world.obstacles import obstacles as ob
from vehsim.world.obstacles.articulated import carriers_of
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

HOVER, TOP = 40.0, 3.06
"""Height of the rig's root and of the hub above it, m."""


@pytest.fixture(scope="module", params=["helicopter", "helicopter_lie"])
def heli(request):
    return vehsim.load_vehicle(request.param)


def tilts(rng, n):
    return {"disc_pitch": rng.uniform(-0.2, 0.2, n), "disc_roll": rng.uniform(-0.2, 0.2, n)}


def tilted_hulls(vehicle, channels, k, position, turn):
    """The hulls in the world: the disc's turned by the textbook's two rotations about the hub, without the rig."""
    pitch, roll = (float(channels[name][k]) for name in ("disc_pitch", "disc_roll"))
    disc = Rotation.from_euler("YX", [pitch, roll])
    root = Rotation.from_quat(turn, scalar_first=True)
    for solid in solids(vehicle.rig.asset):
        for hull in solid.hulls:
            hub = solid.T_rp[:3, 3]
            yield root.apply(disc.apply(hull - hub) + hub if solid.path == "main_rotor" else hull) + position


def test_the_disc_stands_across_the_thrust(heli):
    """The axis of the disc in the body is the direction of the model's thrust, the force of the wrench without the
    tail's."""
    rng = np.random.default_rng(3)
    tilt = tilts(rng, 50)
    R, _ = moved(heli.rig, "main_rotor", {**tilt, "main_rotor": rng.uniform(-300, 300, 50)}, 50)
    c = ca.SX.sym("c", 4)
    force = ca.Function("force", [c], [heli.wrench(c)[3:6]])
    for k in range(50):
        thrust = np.ravel(force([18000.0, 0.0, tilt["disc_pitch"][k], tilt["disc_roll"][k]]))
        np.testing.assert_allclose(R[k, :, 2], thrust / 18000.0, atol=1e-12)


def test_clips_carry_the_tilt_of_their_controls(heli):
    marks = [
        vehsim.Mark(1, position=(0, 0, 30), heading=0, velocity=(0, 0, 0)),
        vehsim.Mark(200, position=(60, 10, 34), heading=0, velocity=(0, 0, 0)),
    ]
    clip = vehsim.plan(heli, None, marks, segments=16).clip
    names = list(heli.control_names)
    for channel, control in (("disc_pitch", "pitch"), ("disc_roll", "roll")):
        np.testing.assert_allclose(clip.channels[channel], clip.controls[:, names.index(control)], atol=1e-12)
        assert np.abs(clip.channels[channel]).max() > np.radians(0.5)


def test_only_what_turns_out_of_the_vehicle_is_carried():
    carried = {name: carriers_of(vehsim.load_vehicle(name)) for name in ("helicopter", "truck", "car", "boat")}
    assert carried == {"helicopter": ("main_rotor",), "truck": ("trailer_1",), "car": (), "boat": ()}


@pytest.mark.parametrize("kind", ["height field", "surface"])
def test_the_tilted_disc_keeps_off_the_ground(heli, kind, tmp_path):
    """Above level ground the clearance is the height of the lowest corner, the disc's when the machine banks."""
    rng = np.random.default_rng(5)
    terrain = Terrain("flat", np.zeros((9, 9)), (-80.0, -80.0), (20.0, 20.0))
    if kind == "surface":  # the same ground with a table far away, below which nothing is filled
        slab, top, leg = (
            trimesh.creation.box(size, trimesh.transformations.translation_matrix(place))
            for size, place in (((160, 160, 4), (0, 0, -2)), ((8, 8, 1), (70, 70, 9)), ((2, 2, 9), (70, 70, 4.4)))
        )
        trimesh.util.concatenate([slab, top, leg]).export(tmp_path / "table.obj")
        terrain = Terrain.load(tmp_path / "table.obj")
        assert terrain.surface is not None
    world, n = World(terrain), 24
    positions = np.column_stack([rng.uniform(-20, 20, (n, 2)), np.full(n, HOVER)])
    turns = Rotation.from_rotvec(np.outer(rng.uniform(1.0, 2.1, n) * rng.choice([-1, 1], n), [1.0, 0.0, 0.0]))
    turns, tilt = turns.as_quat(scalar_first=True), tilts(rng, n)
    found = world.clearance(heli, positions, turns, channels={**tilt, "main_rotor": rng.uniform(0, 300, n)})
    expected = [min(hull[:, 2].min() for hull in tilted_hulls(heli, tilt, k, positions[k], turns[k])) for k in range(n)]
    np.testing.assert_allclose(found, expected, atol=1e-5)
    assert np.abs(world.clearance(heli, positions, turns) - expected).max() > 0.3  # at rest it is another


def test_the_tilted_disc_keeps_off_obstacles(heli):
    """Beside boxes, MuJoCo's distance is that of trimesh's collision library for the turned hulls."""
    rng = np.random.default_rng(8)
    box = ob.box("slab", (0, 0, HOVER + TOP + 3.0), (14, 14, 1), 0)
    world, n = World(obstacles=[box]), 12
    positions = np.column_stack([rng.uniform(-4, 4, (n, 2)), np.full(n, HOVER)])
    turns, tilt = np.tile([1.0, 0, 0, 0], (n, 1)), tilts(rng, n)
    found = world.clearance(heli, positions, turns, channels=tilt)
    slab = trimesh.convex.convex_hull(box.hulls[0])
    for k in range(n):
        manager = trimesh.collision.CollisionManager()
        for i, hull in enumerate(tilted_hulls(heli, tilt, k, positions[k], turns[k])):
            manager.add_object(str(i), trimesh.convex.convex_hull(hull))
        assert found[k] == pytest.approx(manager.min_distance_single(slab), abs=1e-4)


def test_the_arms_of_a_rider_who_twists_keep_off_obstacles():
    """Beside a beam at the height of the arms, the distance is that of trimesh's collision library for a torso that is
    turned about the hips."""
    board, angles = vehsim.load_vehicle("snakeboard"), np.linspace(-1.2, 1.2, 7)
    beam = ob.box("beam", (0, 1.0, 1.0), (6, 1, 1), 0)
    at, turns = np.zeros((len(angles), 3)), np.tile([1.0, 0, 0, 0], (len(angles), 1))
    found = World(obstacles=[beam]).clearance(board, at, turns, channels={"hips": angles})
    for distance, angle in zip(found, angles, strict=True):
        manager, twist = trimesh.collision.CollisionManager(), Rotation.from_euler("z", angle)
        for solid in solids(board.rig.asset):
            hips = solid.T_rp[:3, 3]
            for hull in solid.hulls:
                there = twist.apply(hull - hips) + hips if solid.path.startswith("torso") else hull
                manager.add_object(str(len(manager._objs)), trimesh.convex.convex_hull(there))
        assert distance == pytest.approx(
            manager.min_distance_single(trimesh.convex.convex_hull(beam.hulls[0])), abs=1e-4
        )
    assert np.ptp(found) > 0.1


def test_certificates_see_a_disc_that_tilts_between_samples(heli):
    """A disc that sways while the machine hovers below a slab: two poses a segment are enough to find its nearest."""
    marks = [
        vehsim.Mark(1, position=(0, 0, HOVER), heading=0, velocity=(0, 0, 0)),
        vehsim.Mark(97, position=(0, 0, HOVER), heading=0, velocity=(0, 0, 0)),
    ]
    clip = vehsim.plan(heli, None, marks, segments=16).clip
    sway = 0.18 * np.sin(np.linspace(0, 3.3 * np.pi, len(clip)))
    clip = replace(clip, channels={**clip.channels, "disc_roll": sway})
    world = World(obstacles=[ob.box("slab", (0, 0, HOVER + TOP + 3.0), (14, 14, 1), 0)])
    fine = clip.at(np.linspace(0, clip.duration, 40 * (len(clip) - 1) + 1))
    nearest = world.clearance(heli, fine.positions, fine.orientations, channels=fine.channels).min()
    assert nearest < world.clearance(heli, fine.positions, fine.orientations).min() - 0.5
    assert certify(clip, world, samples=1) == pytest.approx(nearest, abs=2e-3)
