"""Obstacles: solids that contain their meshes, and errors with key and remedy."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

import vehsim
from vehsim import World
from vehsim.errors import InputError
from vehsim.world.obstacles import obstacles as ob

L = [(0, 0), (6, 0), (6, 7), (3.5, 7), (3.5, 2.5), (0, 2.5)]


@pytest.mark.parametrize(
    "obstacle",
    [
        ob.polygon("l", L, height=2.0, base=0.5),
        ob.polygon("clockwise", L[::-1], height=2.0),
        ob.ellipse("e", (1, 2), (3, 1), 30, height=2.0),
        ob.box("b", (1, 2, 0), (4, 2, 1), 45),
        ob.cone("traffic", (1, 2, 0.5)),
        ob.cone("funnel", (1, 2, -3), radius=0.1, height=4.0, tip=2.0),
    ],
    ids=lambda o: o.name,
)
def test_meshes_are_closed_face_outwards_and_lie_in_their_hulls(obstacle):
    mesh = trimesh.Trimesh(obstacle.points, obstacle.faces)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    assert obstacle.bottom == pytest.approx(mesh.bounds[0, 2]) and obstacle.top == pytest.approx(mesh.bounds[1, 2])
    volume = sum(trimesh.convex.convex_hull(hull).volume for hull in obstacle.hulls)
    assert mesh.volume <= volume + 1e-9 and mesh.volume > 0.9 * volume  # less by the bevel


def test_a_mesh_is_replaced_by_the_hulls_of_its_bodies(tmp_path):
    two = trimesh.util.concatenate([trimesh.creation.box((1, 1, 1)), trimesh.creation.box((1, 1, 1))])
    two.vertices[8:] += (5, 0, 0)
    two.export(tmp_path / "two.ply")
    obstacle = ob.mesh("two", tmp_path / "two.ply", position=(0, 10, 0.5), heading=90, scale=2.0)
    assert len(obstacle.parts) == 2
    middles = sorted(tuple(np.round(part.mean(axis=0), 6).tolist()) for part in obstacle.parts)
    assert middles == [(0.0, 10.0), (0.0, 20.0)]
    assert (obstacle.bottom, obstacle.top) == pytest.approx((-0.5, 1.5))


@pytest.mark.parametrize(
    "make, complaint",
    [
        (
            lambda: ob.polygon("p", [(0, 0), (1, 1), (1, 0), (0, 2)]),
            "obstacle 'p': points: its edges cross or touch each other at",
        ),
        (lambda: ob.polygon("p", L, height=0.0), "obstacle 'p': height = 0.0"),
        (lambda: ob.ellipse("e", (0, 0), (1, -1)), "obstacle 'e': radii"),
        (lambda: ob.ellipse("e", (0,), (1, 1)), "obstacle 'e': centre"),
        (lambda: ob.box("b", (0, 0, 0), (1, 0, 1)), "obstacle 'b': size"),
        (lambda: ob.cone("c", (0, 0, 0), tip=0.0), "obstacle 'c': tip"),
        (lambda: replace(ob.cone("c", (0, 0, 0)), finish="gold"), "finish = 'gold': unknown; choose one of concrete"),
        (lambda: ob.mesh("m", "none.obj"), "no such file"),
        (lambda: World(obstacles=[ob.box("a", (0, 0, 0), (1, 1, 1))] * 2), "a name is used twice"),
        (lambda: World(obstacles=["rock"]), "not an obstacle"),
    ],
)
def test_invalid_obstacles_are_refused(make, complaint):
    with pytest.raises(InputError, match=complaint):
        make()


def test_a_flat_mesh_has_no_inside(tmp_path):
    trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], [(0, 1, 2), (0, 2, 3)]).export(tmp_path / "f.ply")
    with pytest.raises(InputError, match="flat"):
        ob.mesh("flat", tmp_path / "f.ply")


def test_moving_obstacles_go_where_their_clip_goes():
    car = vehsim.load_vehicle("car")
    clip = vehsim.simulate(
        car, World("flat"), start=vehsim.State(twist=(0, 4.0, 0)), duration=1.0, fps=24, start_frame=1001
    )
    moving = ob.moving("other", clip)
    seconds = 1001 / 24 + np.array([-1.0, 0.0, 0.5, 1.0, 9.0])
    (outlines,) = moving.shapes_at(seconds)
    np.testing.assert_allclose(np.diff(outlines.mean(axis=1)[:, 0]), [0, 2, 2, 0], atol=1e-6)
    assert not moving.is_static


def test_obstacles_are_part_of_a_worlds_hash():
    one, two = (World("flat", obstacles=[ob.box("a", (x, 0, 0), (1, 1, 1))]) for x in (0, 1))
    assert len({World("flat").content_hash, one.content_hash, two.content_hash}) == 3
    assert one.with_obstacles([]) is one
    more = one.with_obstacles([ob.box("b", (9, 0, 0), (1, 1, 1))])
    assert [o.name for o in more.obstacles] == ["a", "b"] and len(one.obstacles) == 1
    assert more.content_hash != one.content_hash


def test_a_footprint_is_the_car_from_above():
    corners = ob.footprint(vehsim.load_vehicle("car"))
    length, width = np.ptp(corners, axis=0)
    assert 4.0 < length < 4.6 and 1.8 < width < 2.3


def harbour(path):
    """A ring of 24 m with an entrance of 8 m."""
    ring = trimesh.creation.annulus(20.0, 24.0, 6.0, sections=32)
    gap = trimesh.creation.box((60.0, 8.0, 20.0))
    gap.apply_translation([30.0, 0.0, 0.0])
    mole = trimesh.boolean.difference([ring, gap])
    mole.export(path)
    return mole


def test_a_harbour_is_free_inside(tmp_path):
    pytest.importorskip("coacd", reason='needs pip install "vehsim[concave]"')
    mole = harbour(tmp_path / "mole.ply")
    with pytest.warns(UserWarning, match=r"concave: divided into \d+ convex hulls; their volume differs by \+\d"):
        obstacle = ob.mesh("mole", tmp_path / "mole.ply")
    hulls = [ConvexHull(hull) for hull in obstacle.hulls]
    assert sum(hull.volume for hull in hulls) == pytest.approx(mole.volume, rel=0.08)
    free, wall = [[0, 0, 0], [15, 0, 0], [-18, 0, 0], [22, 0, 0]], [[-22, 0, 0], [0, 22, 0], [0, -22, 0]]
    places = np.array([*free, *wall], float)
    inside = np.any([(h.equations[:, :3] @ places.T + h.equations[:, 3:] < 0).all(axis=0) for h in hulls], axis=0)
    assert inside.tolist() == [False] * 4 + [True] * 3


def test_without_coacd_a_warning_states_what_is_filled(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    harbour(tmp_path / "mole.ply")
    with pytest.warns(UserWarning, match=r"also fills 7\.\d+e\+03 m\^3 of free space"):
        assert len(ob.mesh("mole", tmp_path / "mole.ply").hulls) == 1
