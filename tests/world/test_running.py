"""Where planing pressure acts on a bottom that runs through calm water."""

import numpy as np
import pytest
from hulls import floating

from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.hull_mesh import COLUMNS, DEPTH, HEAD, PLACE, THROUGH
from vehsim.world.water.running import WAGNER, Lift
from vehsim.world.world import World

UP = np.array([0.0, 0.0, 1.0])


def prism(length, beam, deadrise, height):
    """A hull with a V bottom, its keel's middle 0.5 m below the origin."""
    b, z = beam / 2, beam / 2 * np.tan(deadrise)
    ring = np.array([[0, 0], [b, z], [b, height], [-b, height], [-b, z]]) - [0, 0.5]
    points = np.array([[x, y, h] for x in (-length / 2, length / 2) for y, h in ring])
    faces = [(0, i, i + 1) for i in range(1, 4)] + [(5, 6 + i, 5 + i) for i in range(1, 4)]
    faces += [t for i in range(5) for j in [(i + 1) % 5] for t in ((i, 5 + i, j), (j, 5 + i, 5 + j))]
    faces = np.array(faces)
    corners = points[faces]
    inward = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0
    return points, faces[:, ::-1] if inward else faces


@pytest.mark.parametrize("drift", [0.0, 0.8, -0.8])
def test_water_rises_along_the_bottom_as_wagner_says(drift):
    """A wedge is wet up to pi/2 times the width below the undisturbed surface; with a drift, each side in proportion
    to its own speed into the water."""
    slope, down = np.tan(0.3), 1.0
    side = np.array([1.0, -1.0])
    places = np.column_stack([[0.0, 0.0], side, [slope, slope]])
    through = np.tile([10.0, drift, -down], (2, 1))
    rise = Lift(rise=WAGNER).risen(np.full(2, 0.2), places, np.zeros(2), through, down)
    entering = np.maximum(down + side * drift * slope, 0.0)
    np.testing.assert_allclose(0.2 + rise, 0.2 * (1 + (np.pi / 2 - 1) * entering / down), rtol=1e-12)


def test_planing_pressure_reaches_the_risen_water_and_not_the_sides():
    """On a prism that moves steadily, the pressure acts on a bottom pi/2 times as wide as the pool it cuts out of the
    undisturbed surface. Above the chines there is none."""
    afloat = Afloat(floating(prism(8.0, 2.4, 0.3, 1.5), 4000.0, planing=0.4), World(water=0.0))
    for deep, chines in ((0.1, False), (0.36, True)):
        columns = np.zeros((len(afloat.mesh.points), COLUMNS))
        columns[:, PLACE], columns[:, THROUGH] = afloat.mesh.points, [10.0, 0.0, -0.5]
        columns[:, DEPTH] = columns[:, HEAD] = deep - afloat.mesh.points[:, 2] - 0.5
        lift = Lift(planing=0.4, rise=WAGNER)
        wet, splashed = afloat.under(columns, afloat.mesh.faces, afloat.mesh.bottom, np.array([0.0, 0.0, 1.0]), lift)
        half = [np.abs(surface.corners[:, :, 1]).max() for surface in (wet, splashed)]
        assert half[0] == pytest.approx(deep / np.tan(0.3), rel=1e-6)
        assert half[1] == pytest.approx(min(np.pi / 2 * deep / np.tan(0.3), 1.2), rel=0.02)
        assert (splashed.corners[:, :, 2].max() + 0.5 > 1.2 * np.tan(0.3) - 1e-6) == chines
        same = afloat.under(
            columns, afloat.mesh.faces, afloat.mesh.bottom, np.array([0.0, 0.0, 1.0]), Lift(planing=0.4)
        )
        assert same[0] is same[1]


def test_planing_pressure_has_the_centre_of_wagners():
    """Its mean over the half width is as given, its centre at 2 / pi of it, and it grows towards the water's edge."""
    across = np.linspace(0.0, 1.0, 2001)
    pressure = Lift(rise=WAGNER).peaked(0.3 * (1 - across), np.full_like(across, 0.3))
    assert np.trapezoid(pressure, across) == pytest.approx(1.0)
    assert np.trapezoid(pressure * across, across) == pytest.approx(2 / np.pi, rel=1e-6)
    assert pressure[0] > 0
    assert np.diff(pressure).min() > 0
