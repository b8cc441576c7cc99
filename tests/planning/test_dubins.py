"""Curves of two arcs and a straight line."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vehsim.planning.guesses import dubins

places, headings = st.floats(-50, 50), st.floats(-7, 7)


@given(st.tuples(places, places, headings), st.tuples(places, places, headings), st.floats(0.1, 10))
def test_curves_reach_the_goal_with_the_radius(start, goal, radius):
    found = dubins.curves(start, goal, radius)
    assert len(found) >= 2
    for parts in found:
        step = radius / 10
        poses = np.vstack([start, dubins.along(start, parts, step)])
        assert np.allclose(poses[-1, :2], goal[:2], atol=1e-6)
        assert math.cos(poses[-1, 2] - goal[2]) == pytest.approx(1, abs=1e-9)
        turns, steps = np.diff(poses[:, 2]), np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1)
        assert steps.max() <= step + 1e-9 and np.abs(turns).max() <= step / radius + 1e-9
        assert steps.sum() == pytest.approx(dubins.length(parts), rel=1e-3, abs=1e-6)
        assert dubins.length(parts) >= math.dist(start[:2], goal[:2]) - 1e-6


@pytest.mark.parametrize(
    "goal, length",
    [((8, 0, 0), 8), ((0, 4, math.pi), 2 * math.pi), ((2, 2, math.pi / 2), math.pi), ((4, 4, 0), 2 * math.pi)],
)
def test_shortest_curves_of_radius_two(goal, length):
    """Straight ahead, half a circle, a quarter, and two quarters one after the other."""
    assert min(map(dubins.length, dubins.curves((0, 0, 0), goal, 2.0))) == pytest.approx(length, abs=1e-6)
