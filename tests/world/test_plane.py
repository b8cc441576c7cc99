"""Plane geometry compared with shapely, and invalid polygons."""

import numpy as np
import pytest
import shapely

from vehsim.world.obstacles.plane import (
    Ellipse,
    convex_hull,
    convex_parts,
    distance,
    foot_on_ellipse,
    placed,
    signed_area,
    simple_polygon,
)

NOTCHED = [(0, 0), (4, 0), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)]


def blob(rng, centre=(0, 0), corners=8, size=1.0):
    return convex_hull(rng.normal(size=(corners, 2)) * size + np.asarray(centre))


@pytest.mark.parametrize("seed", range(40))
def test_polygon_distances_agree_with_shapely(seed):
    rng = np.random.default_rng(seed)
    a, b = blob(rng), blob(rng, rng.normal(size=2) * 3, 7, rng.uniform(0.3, 2))
    d, s = distance(a[None], b)[0], shapely.Polygon(a).distance(shapely.Polygon(b))
    assert d == pytest.approx(s, abs=1e-12) if s > 0 else d <= 0


@pytest.mark.parametrize("seed", range(20))
def test_overlap_is_undone_by_its_depth_and_not_by_less(seed):
    rng = np.random.default_rng(seed)
    a, b = blob(rng), blob(rng, (0.3, 0.2))
    depth = -distance(a[None], b)[0]
    assert depth > 0
    ways = [depth * 1.001 * np.array([np.cos(t), np.sin(t)]) for t in np.linspace(0, 2 * np.pi, 4000)]
    far = distance(a + np.array(ways)[:, None], b)
    assert far.max() > 0
    assert distance(a + 0.99 * np.array(ways)[:, None], b).max() <= 0


@pytest.mark.parametrize("seed", range(20))
def test_ellipses_are_as_far_as_a_fine_ring(seed):
    rng = np.random.default_rng(seed)
    turn, radii = rng.uniform(0, 6), rng.uniform(0.2, 3, 2)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    ellipse = Ellipse(rng.normal(size=2), radii, R)
    a = blob(rng, rng.normal(size=2) * 4)
    t = np.linspace(0, 2 * np.pi, 20001)
    ring = shapely.Polygon(ellipse.centre + (np.column_stack([np.cos(t), np.sin(t)]) * radii) @ R.T)
    d, s = distance(a[None], ellipse)[0], ring.distance(shapely.Polygon(a))
    assert d == pytest.approx(s, abs=1e-6) if s > 0 else d <= 1e-6


def test_points_keep_their_distance_too():
    square = np.array([(0.0, 0), (2, 0), (2, 2), (0, 2)])
    points = np.array([[[3.0, 1.0]], [[3.0, 3.0]], [[1.0, 0.5]]])
    np.testing.assert_allclose(distance(points, square), [1.0, np.sqrt(2), -0.5])
    circle = Ellipse(np.zeros(2), np.array([2.0, 2.0]), np.eye(2))
    np.testing.assert_allclose(distance(points[:1], circle), [np.sqrt(10) - 2])


def test_the_line_to_the_foot_is_normal_to_the_ellipse():
    """The line to the nearest point is normal to the ellipse, however long and thin it is."""
    rng = np.random.default_rng(0)
    for radii in ([3.0, 1.0], [10.0, 0.05], [1.0, 1.0]):
        radii = np.array(radii)
        points = rng.normal(size=(200, 2)) * 12
        points = points[((points / radii) ** 2).sum(axis=1) > 1.0001]
        foot = foot_on_ellipse(points, radii)
        np.testing.assert_allclose(((foot / radii) ** 2).sum(axis=1), 1, atol=1e-9)
        normal, way = foot / radii**2, points - foot
        sine = normal[:, 0] * way[:, 1] - normal[:, 1] * way[:, 0]
        np.testing.assert_allclose(sine / np.linalg.norm(normal, axis=1), 0, atol=1e-6)


@pytest.mark.parametrize("corners", [NOTCHED, NOTCHED[::-1]], ids=["counter-clockwise", "clockwise"])
def test_parts_are_convex_and_are_the_polygon(corners):
    polygon = simple_polygon(corners)
    assert signed_area(polygon) > 0
    parts = convex_parts(polygon)
    union = shapely.unary_union([shapely.Polygon(part) for part in parts])
    assert union.symmetric_difference(shapely.Polygon(corners)).area < 1e-12
    assert sum(map(signed_area, parts)) == pytest.approx(8.0)
    for part in parts:
        assert shapely.Polygon(part).convex_hull.area == pytest.approx(signed_area(part))


@pytest.mark.parametrize(
    "corners, complaint",
    [
        ([(0, 0), (1, 1), (1, 0), (0, 2)], r"cross or touch each other at \[0.666667, 0.666667\]"),
        ([(0, 0), (4, 0), (4, 4), (2, 0), (0, 4)], "cross or touch"),
        ([(0, 0), (2, 0), (1, 0), (1, 1)], "cross or touch"),
        ([(0, 0), (1, 0), (1, 0)], "2 different corners"),
        ([(0, 0), (1, 0), (np.nan, 1)], "not a list of corners"),
        ("round", "not a list of corners"),
    ],
)
def test_invalid_polygons_are_explained(corners, complaint):
    with pytest.raises(ValueError, match=complaint):
        simple_polygon(corners)


def test_placed_turns_then_moves():
    at = placed(np.array([[1.0, 0.0]]), np.array([[5.0, 5.0]]), np.array([np.pi / 2]))
    np.testing.assert_allclose(at, [[[5.0, 6.0]]])
