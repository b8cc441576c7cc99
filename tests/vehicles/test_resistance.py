"""Resistance and attitude of hulls on calm water, against Savitsky's equations written down a second time, published
examples and closed forms."""

import shutil

import casadi as ca
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import vehsim
from vehsim.errors import InputError
from vehsim.lie.quaternions import from_vectors
from vehsim.vehicles import State
from vehsim.vehicles.definition.resistance import ALLOWANCE, VISCOSITY, Curves, Planing, SpeedSpline, ittc57, running
from vehsim.vehicles.library.hull_form import particulars
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.hull_mesh import HullMesh, wetted
from vehsim.world.world import World

BOAT = vehsim.load_vehicle("boat")
POUND, FOOT, KNOT, G = 0.45359237, 0.3048, 1852 / 3600, 9.81


def savitsky(speed, mass, beam, deadrise, lcg, vcg, thrust):
    """Trim (degrees), wetted length over beam, friction (N) and resistance (N) from Savitsky 1964, by bisection;
    ``deadrise`` in degrees. Independent of vehsim."""

    def root(f, low, high):
        for _ in range(200):
            middle = (low + high) / 2
            low, high = (middle, high) if f(low) * f(middle) > 0 else (low, middle)
        return (low + high) / 2

    def lift(flat):  # eq. 16
        return flat - 0.0065 * deadrise * flat**0.6

    cv = speed / np.sqrt(G * beam)
    pressure = 0.5 * 1025 * speed**2 * beam**2
    flat = root(lambda c: lift(c) - mass * G / pressure, 1e-3, 30.0)

    def at(tau):
        ratio = root(lambda k: tau**1.1 * (0.012 * np.sqrt(k) + 0.0055 * k**2.5 / cv**2) - flat, 1e-6, 1e3)  # eq. 15
        slow = 1 - lift(0.012 * np.sqrt(ratio) * tau**1.1) / ratio / np.cos(np.radians(tau))
        reynolds = speed * np.sqrt(slow) * ratio * beam / 1.19e-6
        coefficient = 0.075 / (np.log10(reynolds) - 2) ** 2 + 0.0004
        drag = pressure * slow * ratio / np.cos(np.radians(deadrise)) * coefficient  # eq. 20
        arm = lcg - ratio * beam * (0.75 - 1 / (5.21 * cv**2 / ratio**2 + 2.39))  # eq. 25
        low = vcg - beam / 4 * np.tan(np.radians(deadrise))
        t = np.radians(tau)
        moment = mass * G * ((1 - np.sin(t) ** 2) * arm / np.cos(t) - thrust * np.sin(t)) + drag * (low - thrust)
        return ratio, drag, mass * G * np.tan(t) + drag / np.cos(t), moment  # eq. 35

    tau = root(lambda t: at(t)[3], 0.6, 19.0)
    return tau, *at(tau)[:3]


@pytest.mark.parametrize("speed", [5.5, 8.0, 10.0, 16.0, 25.0])
def test_equilibria_are_savitskys(speed):
    hull = Planing(2.0, np.radians(20), 2.21, 0.632, 0.4, 1696.0, 5.6)
    found, expected = hull.at(speed), savitsky(speed, 1696.0, 2.0, 20.0, 2.21, 0.632, 0.4)
    given = (np.degrees(found.trim), found.ratio, found.friction, found.resistance)
    np.testing.assert_allclose(given, expected, rtol=1e-4)


def test_the_example_of_savitsky_1964():
    """60,000 lb at 40 knots, table 1 at a trim of 2 degrees: mean wetted length 3.85 beams and friction 7,340 lb, from
    charts and another friction line."""
    hull = Planing(14 * FOOT, np.radians(10), 29 * FOOT, 2 * FOOT, 0.5 * FOOT, 60_000 * POUND, 50.0)
    steady, _ = hull._held(40 * KNOT, 2.0)
    assert steady.ratio == pytest.approx(3.85, rel=0.03)
    assert steady.friction == pytest.approx(7340 * POUND * G, rel=0.03)


def test_the_example_of_principles_of_yacht_design():
    """Larsson and Eliasson, the power boat of 9.75 t at 40 knots: trim 4.17 degrees, wetted length 1.81 beams,
    resistance 13.3 kN, of which 6.46 kN are friction without an allowance for roughness. Its shaft is inclined by 3
    degrees, which is neglected here."""
    hull = Planing(2.74, np.radians(17.9), 3.55, 1.145, 0.49, 9750.0, 20.0)
    steady = hull.at(20.6)
    assert np.degrees(steady.trim) == pytest.approx(4.17, abs=0.15)
    smooth = float(ittc57(20.6 * steady.ratio * 2.74 / VISCOSITY))
    friction = steady.friction * smooth / (smooth + ALLOWANCE)
    assert (steady.ratio, friction) == pytest.approx((1.812, 6461), rel=0.02)
    assert steady.resistance - steady.friction + friction == pytest.approx(13_325, rel=0.02)


def test_the_friction_line_of_ittc_1957():
    np.testing.assert_allclose(ittc57(np.array([1e6, 1e7, 1e9])), 0.075 / np.array([4.0, 5.0, 7.0]) ** 2)
    barge = running(20_000.0, 10.0, 50.0, None, form=0.2)
    k = 12
    expected = (
        1.2 * 0.5 * 1025 * 50 * barge.speeds[k] ** 2 * 0.075 / (np.log10(barge.speeds[k] * 10 / VISCOSITY) - 2) ** 2
    )
    assert barge.resistance[k] == pytest.approx(expected)


def test_a_curve_is_one_function_for_numbers_and_plans():
    run = BOAT.hull.running
    u = ca.SX.sym("u")
    law = ca.Function("rate", [u], Curves([run.rate]).at(u))
    for speed in (-3.0, 0.5, 4.9, 10.0, 17.3, 60.0):
        assert float(law(speed)) == pytest.approx(run.rate(speed), rel=1e-4)
    speeds = np.linspace(0.5, 18, 400)
    forces = np.array([run.rate(s) * s for s in speeds])
    assert np.all(forces > 0) and np.abs(np.diff(forces, 2)).max() < 0.02 * forces.max()  # no kinks and no jumps
    np.testing.assert_allclose([SpeedSpline.constant(2.0)(s) for s in (0.0, 5.0)], 2.0)


def test_the_boat_resists_as_savitsky_says():
    """At 10 and 16 m/s; with a beam of 2 m and 20 degrees, and the thrust through the centre, 2.5 and 3.3 kN."""
    p = particulars_of_boat()
    for speed, usual in ((10.0, 2523.0), (16.0, 3277.0)):
        expected = savitsky(speed, 1696.0, p["chine_beam"], np.degrees(p["deadrise"]), 2.21, 0.6316, 0.867)[3]
        assert BOAT.hull.running.rate(speed) * speed == pytest.approx(expected, rel=0.01)
        assert expected == pytest.approx(usual, rel=0.07)


def test_its_hull_is_in_equilibrium_at_every_planing_speed():
    """With the trim, draft and resistance given, and its thrust, all forces on it vanish; no patch drives it. (Slower,
    it would displace more than its weight at Savitsky's draft, and floats higher.)"""
    afloat = Afloat(BOAT, World(water=0.0))
    run = BOAT.hull.running
    for k in np.flatnonzero(run.speeds > 7.0)[::2]:
        trim, (x, z) = run.trim[k], run.transom
        height = -run.draft[k] - x * np.sin(trim) - z * np.cos(trim)
        q = from_vectors(np.array([0.0, -trim, 0.0]))
        velocity = run.speeds[k] * np.array([np.cos(trim), 0.0, -np.sin(trim)])
        up = np.array([np.sin(trim), 0.0, np.cos(trim)])
        state = State(position=np.array([0.0, 0.0, height]) - _rotated(trim, BOAT.origin), orientation=q,
                      twist=np.array([0, 0, 0, *velocity]))  # fmt: skip
        wet = afloat.forces(0.0, state, np.array([run.resistance[k] / np.cos(trim), 0.0])).wrench
        total = wet + 1696.0 * G * np.array([0, 0, 0, *-up])
        total[3:] += 0.5 * 1.225 * 2.4 * run.speeds[k] ** 2 * velocity / run.speeds[k]  # without the air
        assert np.abs(total[3:]).max() < 0.01 * 1696.0 * G and abs(total[4 - 3]) < 300.0
        assert afloat.law.at(run.speeds[k]).rate > 0


def _rotated(trim, place):
    """``place`` of a body with its bow up by ``trim``, in world axes."""
    x, y, z = place
    return np.array([x * np.cos(trim) - z * np.sin(trim), y, x * np.sin(trim) + z * np.cos(trim)])


def particulars_of_boat():
    from vehsim.rig.parts import read_mesh

    points, faces = read_mesh(BOAT.rig.asset, "", "hull/hull")
    return particulars(points - np.array(BOAT.rig.origin), faces, 1696.0, True)


def test_the_boats_particulars_are_those_of_its_hull(tmp_path):
    """The numbers in its file are measured; without them, they are measured when it is loaded."""
    toml = (BOAT.rig.folder / "vehicle.toml").read_text()
    measured = particulars_of_boat()
    lines = [line for line in toml.splitlines() if line.partition(" =")[0] not in measured]
    assert len(toml.splitlines()) - len(lines) == len(measured) == 5
    shutil.copytree(BOAT.rig.folder, tmp_path / "boat")
    (tmp_path / "boat" / "vehicle.toml").write_text("\n".join(lines))
    without = vehsim.load_vehicle(tmp_path / "boat").hull.running
    np.testing.assert_allclose(without.resistance, BOAT.hull.running.resistance, rtol=5e-3, atol=0.5)
    heavy = vehsim.load_vehicle(tmp_path / "boat", {"mass": 2200.0}).hull.running
    assert heavy.rate(8.0) > 1.2 * without.rate(8.0)


def wedge(length, beam, deadrise, height):
    """A prismatic hull whose keel is on X, from its transom at 0."""
    b, z = beam / 2, beam / 2 * np.tan(deadrise)
    ring = np.array([[0, 0], [b, z], [b, height], [-b, height], [-b, z]])
    points = np.array([[x, y, h] for x in (0.0, length) for y, h in ring])
    faces = [(0, i + 1, i) for i in range(1, 4)] + [(5, 5 + i, 6 + i) for i in range(1, 4)]
    faces += [t for i in range(5) for j in [(i + 1) % 5] for t in ((i, j, 5 + i), (j, 5 + j, 5 + i))]
    return points, np.array(faces)


def test_particulars_of_a_prism():
    points, faces = wedge(8.0, 2.4, np.radians(15), 1.5)
    found = particulars(points, faces[:, ::-1] if _inward(points, faces) else faces, 4000.0, True)
    assert found["chine_beam"] == pytest.approx(2.4, rel=0.02) and found["wetted_length"] == pytest.approx(8.0)
    assert np.degrees(found["deadrise"]) == pytest.approx(15.0, abs=0.3)
    np.testing.assert_allclose(found["transom"], [0.0, 0.0], atol=0.01)
    rise = 1.2 * np.tan(np.radians(15))
    depth = (4000 / 1025 / 8 - 1.2 * rise) / 2.4  # of the vertical sides
    area = 8 * (2 * depth + 2.4 / np.cos(np.radians(15))) + 2 * 4000 / 1025 / 8
    assert found["wetted_area"] == pytest.approx(area, rel=1e-3)


def _inward(points, faces):
    corners = points[faces]
    return np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) < 0


def outwards(length, beam, deadrise, height):
    points, faces = wedge(length, beam, deadrise, height)
    return points, faces[:, ::-1] if _inward(points, faces) else faces


@pytest.mark.parametrize("speed", [6.5, 9.0, 14.0, 22.0])
def test_the_volume_that_a_planing_bottom_displaces(speed):
    """That of a prism in the hull mesh, with dry chines and with wet ones; the curve for plans follows it."""
    planing = Planing(2.03, 0.3345, 2.21, 0.632, 0.867, 1696.0, 5.62)
    steady = planing.at(speed)
    prism = HullMesh(*outwards(steady.keel * 2, 2.03, 0.3345, 3.0)).refined(0.1)
    up = np.array([np.sin(steady.trim), 0.0, np.cos(steady.trim)])
    depth = steady.draft - prism.points @ up
    cut = wetted(np.column_stack([prism.points, depth]), prism.faces)
    assert planing.displaced(steady) == pytest.approx(cut.volume(up), rel=1e-3)
    run = running(1696.0, 5.62, 10.41, planing)
    share = np.interp(speed, run.speeds, run.immersion)
    assert share == pytest.approx(cut.volume(up) * 1025 / 1696, rel=0.06)


def test_two_hulls_have_no_chine_beam():
    points, faces = wedge(8.0, 1.0, np.radians(15), 1.5)
    faces = faces[:, ::-1] if _inward(points, faces) else faces
    both = np.concatenate([np.add(points, (0, 2, 0)), np.add(points, (0, -2, 0))])
    with pytest.raises(InputError, match="one keel with two chines"):
        particulars(both, np.concatenate([faces, faces + len(points)]), 2000.0, True)


def test_a_curve_has_the_derivatives_of_a_natural_cubic_spline():
    """Its coefficients are sums of steps, which must not be differentiated, and nothing jumps at a knot."""
    curve = BOAT.hull.running.rate
    spline = CubicSpline(curve.knots, [curve(speed) for speed in curve.knots], bc_type="natural")
    u = ca.SX.sym("u")
    (value,) = Curves([curve]).at(u)
    bend, slope = ca.hessian(value, u)
    law = ca.Function("rate", [u], [value, slope, bend])
    for speed in (0.7, 4.9, 10.0, 17.3, curve.knots[9] + 1e-9, curve.knots[9] - 1e-9):
        x = np.hypot(speed, 1e-3)
        for order, made in enumerate(map(float, law(speed))):
            assert made == pytest.approx(float(spline(x, order)), rel=1e-4)


def test_curves_are_looked_up_piece_by_piece():
    """At, between and beyond the knots, and at both signs; the same as everywhere at once."""
    curves = BOAT.hull.running.curves(350.0)
    speeds = np.array([0.0, 0.3, curves.splines[0].knots[3], -7.7, 13.0, 90.0])
    pieces = curves.pieces_at(len(speeds))(speeds[None])
    u, piece = ca.SX.sym("u"), ca.SX.sym("piece", curves.size)
    within = ca.Function("within", [u, piece], curves.at(u, piece)).map(len(speeds))(speeds[None], pieces)
    everywhere = ca.Function("everywhere", [u], curves.at(u)).map(len(speeds))(speeds[None])
    for spline, some, every in zip(curves.splines, within, everywhere, strict=True):
        np.testing.assert_allclose(some, every, rtol=1e-10)
        np.testing.assert_allclose(np.ravel(some), [spline(np.hypot(x, 1e-3)) for x in speeds], rtol=1e-9, atol=1e-9)
