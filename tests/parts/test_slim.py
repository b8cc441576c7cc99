"""Decimation of generated skins: fewer triangles, the same shape, closed borders in the same places."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from vehsim.assets.generate._shapes import Surface, box, grown, join, painted, polygon, refined, revolve
from vehsim.assets.generate._slim import slimmed

TURN = np.linspace(-np.pi / 2, np.pi / 2, 61)
BALL = revolve(np.column_stack([np.cos(TURN).clip(0), np.sin(TURN)]), 120, crease=80)
PATCH = polygon([(-0.5, -0.3), (0.5, -0.3), (0.4, 0.4), (-0.4, 0.4)], 0.1, (1, 2))


def mesh(look: dict[str, Surface]) -> trimesh.Trimesh:
    every = join(*look.values())
    return trimesh.Trimesh(np.round(every.points, 7), every.faces)  # welds equal places


@pytest.mark.parametrize("tolerance", [0.001, 0.003])
def test_a_painted_ball_stays_closed_round_and_painted(tolerance):
    before = painted(BALL, [("mark", PATCH), ("rim", grown(PATCH, 0.02))], "rest")
    after = slimmed(before, tolerance)
    was, now = mesh(before), mesh(after)
    assert len(now.faces) < 0.65 * len(was.faces)
    assert was.is_watertight and now.is_watertight and now.is_winding_consistent
    assert now.volume == pytest.approx(was.volume, abs=2 * tolerance * was.area)
    assert np.linalg.norm(now.triangles_center, axis=1).min() > 1 - 5 * tolerance
    for name, surface in after.items():
        assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1)
        assert np.einsum("ij,ij->i", surface.normals, surface.points).min() > 0.99
        area, was_area = (trimesh.Trimesh(s.points, s.faces).area for s in (surface, before[name]))
        assert area == pytest.approx(was_area, rel=0.1 if name == "rim" else 0.02)
    border = after["mark"].points[np.abs(PATCH(after["mark"].points)) < 1e-4]
    assert len(border) > 16


def test_flat_sides_lose_their_triangles_and_creases_stay_sharp():
    cube = box([1.0, 1.0, 1.0])
    for axis in range(3):
        cube = refined(cube, axis, np.linspace(-0.4, 0.4, 9))
    (slim,) = slimmed({"cube": cube}, 0.001).values()
    assert len(slim.faces) < 0.06 * len(cube.faces)
    assert mesh({"cube": slim}).volume == pytest.approx(1.0)
    assert np.allclose(np.sort(np.abs(slim.normals), axis=1), [0, 0, 1])


def test_a_material_may_be_coarser_than_the_rest():
    before = painted(BALL, [("mark", PATCH)], "rest")
    even, coarse = slimmed(before, 0.0005), slimmed(before, 0.0005, mark=0.004)
    assert len(coarse["mark"].faces) < 0.6 * len(even["mark"].faces)
    assert len(coarse["rest"].faces) == pytest.approx(len(even["rest"].faces), rel=0.05)
