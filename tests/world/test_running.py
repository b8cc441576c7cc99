"""Where planing pressure acts on a bottom that runs through calm water."""

from dataclasses import replace

import numpy as np
import pytest
from hulls import floating

import vehsim
from vehsim.vehicles import State
from vehsim.vehicles.definition.resistance import running
from vehsim.vehicles.library.hull_form import particulars
from vehsim.vehicles.models.boat import boat
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


def skiff():
    """A planing boat of 750 kg on 1.7 by 5.2 m with 24 degrees of deadrise, and an outboard of 2600 N."""
    points, faces = prism(5.2, 1.7, np.radians(24.0), 1.1)
    points = points + np.array([0.7, 0.0, -0.05])  # the transom is 1.9 m behind the centre of mass
    made = boat(
        mass=750.0,
        inertia=(265.0, 1267.0, 1331.0),
        thrusters=((-2.0, 0.0, -0.7),),
        rudder=(-2.0, 0.0, -0.6),
        rudder_area=0.062,
        full_thrust=2600.0,
        damping=(0.0, 225.0, 1950.0),
        damping_quadratic=(0.0, 45.0, 0.0),
        added_mass=(53.0, 1014.0, 317.0, 37.5, 225.0, 900.0),
        impact=1.5,
        **particulars(points, faces, 750.0, planing=True),
    )
    return replace(made, hull=replace(made.hull, points=points, faces=faces))


def rise_of(lift, trim=0.05, **motion):
    """How much the water rises at (right, left) of a wedge 1 m behind the place where its keel goes under, with a
    ``trim`` rad at 10 m/s."""
    slope, ahead = np.tan(0.3), np.array([-2.0, -1.0, 1.0])
    places = np.array([[x, y, slope * abs(y)] for x in ahead for y in (-1.0, 1.0)])
    through = np.tile([10.0, motion.get("drift", 0.0), motion.get("heave", 0.0) - 10 * trim], (6, 1))
    through[:, 2] += motion.get("roll", 0.0) * places[:, 1]
    deep = -places[:, 0] * trim
    return lift.risen(deep, places, np.zeros(6), through, np.arange(6))[2:4]


@pytest.mark.parametrize(("drift", "roll"), [(0.0, 0.0), (0.8, 0.0), (-0.8, 0.0), (0.0, 0.3), (4.0, 0.0)])
def test_water_rises_along_the_bottom_as_wagner_says(drift, roll):
    """A wedge is wet up to pi/2 times the width below the undisturbed surface; with a drift or a roll, each side in
    proportion to its own speed into the water, which is that of its way since the keel went under."""
    lift, slope, side = Lift(rise=WAGNER), np.tan(0.3), np.array([-1.0, 1.0])
    found = rise_of(lift, drift=drift, roll=roll)
    entering = np.maximum(0.5 + side * (drift * slope - roll), 0.0)
    np.testing.assert_allclose(found, (np.pi / 2 - 1) * 0.05 * entering / 0.5, rtol=0.1, atol=1e-12)
    assert found[0] == found[1] or np.sign(found[1] - found[0]) == np.sign(drift * slope - roll)


def test_a_hull_that_heaves_is_not_wet_further_out():
    """With a drift, a bottom that leaves the water would otherwise be wet further out, and lifted the more."""
    lift = Lift(rise=WAGNER)
    up, down = rise_of(lift, drift=2.0, heave=0.45), rise_of(lift, drift=2.0, heave=-0.45)
    np.testing.assert_allclose(up, down, rtol=0.01)


def test_the_resistance_of_a_planing_hull_acts_up_to_the_risen_water():
    """As on Savitsky's hulls; so a hull that skids on one half of its bottom does not lose half of its friction."""
    afloat = Afloat(floating(prism(8.0, 2.4, 0.3, 1.5), 4000.0, planing=0.4), World(water=0.0))
    columns = np.zeros((len(afloat.mesh.points), COLUMNS))
    columns[:, PLACE], columns[:, THROUGH] = afloat.mesh.points, [10.0, 0.0, -0.5]
    columns[:, DEPTH] = columns[:, HEAD] = 0.1 - afloat.mesh.points[:, 2] - 0.5
    pushes = []
    for rise in (0.0, WAGNER):
        lift = Lift(rate=50.0, rise=rise)
        surfaces = afloat.under(columns, afloat.mesh.faces, afloat.mesh.bottom, UP, lift)
        still = afloat.surface(*surfaces, Lift(rise=rise))[0][3]
        pushes.append(afloat.surface(*surfaces, lift)[0][3] - still)
    assert pushes[1] / pushes[0] == pytest.approx(np.pi / 2, rel=0.02)


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


def test_a_light_hull_settles_in_a_hard_turn_at_full_thrust():
    """750 kg on 2 by 5 m, 20 degrees of helm at 18 m/s: it leans inwards and loses speed. With a fin that turns as a
    whole, and water that rose the further the less it moved down, it rolled from side to side by 36 degrees."""
    start = State(position=np.array([0.0, 0.0, 0.4]), twist=np.array([0.0, 0.0, 0.0, 15.0, 0.0, 0.0]))
    helm = lambda t, _: np.array([2600.0, np.radians(np.clip(20 * (t - 9), 0, 20))])
    clip = vehsim.simulate(skiff(), World(water=0.0), helm, start=start, duration=20.0, step=1 / 48)
    last = clip.times > 16.0
    lean = -np.degrees(np.arcsin(clip.matrices()[last, 2, 1]))
    assert lean.min() > 5.0 and lean.max() < 20.0 and np.ptp(lean) < 2.0
    assert np.ptp(np.degrees(clip.twists[last, 2])) < 3.0
    assert clip.twists[-1, 3] < 0.8 * clip.twists[clip.times <= 9.0, 3].max()


def test_a_displacement_hull_resists_as_its_friction_line_says():
    """Slamming pressed on the bow of a hull that moves ahead steadily: three times the friction at 2 m/s."""
    run = running(4000.0, 8.0, 25.0, None)
    body = floating(prism(8.0, 2.4, np.radians(15), 1.5), 4000.0, (3e3, 2e4, 2e4), running=run, impact=1.0)
    afloat = Afloat(body, World(water=0.0))
    for speed in (1.0, 2.0, 4.0):
        ahead = State(position=(0, 0, afloat.floating()[0]), twist=np.array([0, 0, 0, speed, 0, 0]))
        surge = afloat.forces(0.0, ahead, np.zeros(0)).wrench[3]
        assert surge == pytest.approx(-speed * run.rate(speed), rel=1e-3)
