"""How waves act on hulls: added mass in closed form, and motions compared with stored numbers of Capytaine."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hulls import FORMS, box, floating, join, lofted, sphere

from vehsim.constants import GRAVITY
from vehsim.vehicles import State
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.potential import _potentials, response
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World

STORED = json.loads((Path(__file__).parent / "capytaine.json").read_text())
TWIST = [3, 4, 5, 0, 1, 2]
"""Capytaine's order of the modes, in a twist."""


def test_added_mass_of_a_sphere():
    """Deep below the surface half of the displaced mass; floating half-immersed, at high frequency, half of it in heave
    and 0.2732 in surge (Hulme 1982). It does not feel rotations."""
    points, faces = sphere(1.0, 3)
    deep = response(points[faces], surface=100.0)
    np.testing.assert_allclose(deep.added[3:, 3:], 2 / 3 * np.pi * np.eye(3), atol=0.02)
    half = response(points[faces][points[faces][:, :, 2].mean(axis=1) < 0], surface=0.0)
    np.testing.assert_allclose(np.diag(half.added)[3:] / (2 / 3 * np.pi), [0.2732, 0.2732, 0.5], rtol=0.025)
    np.testing.assert_allclose(half.added[:3], 0, atol=1e-3)
    spin = half.twist(np.cross([0.3, -0.2, 0.5], half.points))
    np.testing.assert_allclose(spin, 0, atol=1e-3)


def test_a_panel_may_have_its_middle_on_the_edge_of_another():
    """Slivers of a barge's capped end: its simulation ended with "SVD did not converge"."""
    triangle = np.array([[[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    on, beside = (_potentials(triangle, np.array([[0.75, y, 0.0]]))[0] for y in (0.0, 1e-9))
    np.testing.assert_allclose(on, beside, rtol=1e-6)
    assert on > 0


@pytest.mark.parametrize("name", STORED["hulls"])
def test_a_rigid_motion_of_the_water_is_found(name):
    hull = afloat(name, 0).response
    twist = np.array([0.3, -0.2, 0.1, 1.0, 2.0, -0.5])
    found = hull.twist(twist[3:] + np.cross(twist[:3], hull.points))
    np.testing.assert_allclose(found, twist, atol=1e-9)


def surface(hull):
    """The whole hull about its centre of mass, with a freeboard for boxes."""
    length, beam, draft = hull["size"]
    if hull["shape"] == "ellipsoid":
        points, faces = sphere(1.0, 3)
        return points * [length / 2, beam / 2, draft] - [0, 0, hull["centre"]], faces
    if hull["shape"] in FORMS:
        points, faces = lofted(hull["shape"], hull["size"], draft)
        return points - [hull["ahead"], 0, hull["centre"]], faces
    half = hull.get("apart", 0.0) / 2
    parts = [box(length, beam, 2 * draft, (0, y, -hull["centre"])) for y in sorted({half, -half})]
    return join(*parts)


def afloat(name, k, *where):
    """A hull with Capytaine's added mass in the k-th wave."""
    hull = STORED["hulls"][name]
    body = floating(surface(hull), hull["mass"], hull["inertia"], added_mass=np.array(hull["added"][k])[TWIST])
    water = Water(surface=wave(2 * AMPLITUDE, *where), height_field=0) if where else Water()
    return Afloat(body, World(water=water))


AMPLITUDE = 0.002


def motions(name, heading, k):
    """Heave over wave amplitude, roll and pitch over wave slope, from the forces on the hull held still in the wave,
    with Capytaine's added mass and damping in this wave."""
    hull = STORED["hulls"][name]
    length = STORED["lengths"][k] * hull["size"][0]
    body, number = afloat(name, k, length, np.radians(heading)), 2 * np.pi / length
    omega, damping = np.sqrt(GRAVITY * number), np.diag(hull["damping"][k])
    at = State(position=(0, 0, hull["centre"]))
    turns = np.exp(2j * np.pi * np.arange(6) / 6)
    force = np.zeros(6, complex)
    for turn in turns:
        t = float(np.angle(turn)) / omega
        flow = body.water.velocity(body.response.points + at.position, t)
        waves = body.forces(t, at, np.zeros(0)).wrench[TWIST] + damping @ body.response.twist(flow)[TWIST]
        force += turn * waves / (3 * AMPLITUDE)
    inertia = np.diag([*3 * [hull["mass"]], *hull["inertia"]]) + body.added_mass[np.ix_(TWIST, TWIST)]
    stiffness = np.diag([0, 0, *hull["stiffness"], 0]) + 1e-6 * hull["mass"] * np.eye(6)
    moved = np.linalg.solve(-(omega**2) * inertia - 1j * omega * damping + stiffness, force)
    return np.abs(moved)[2:5] / [1, number, number]


@pytest.mark.parametrize("heading", STORED["headings"])
@pytest.mark.parametrize("name", STORED["hulls"])
def test_responses_to_waves_are_capytaines(name, heading):
    """In waves of twice the length of the hull and more."""
    for k in (STORED["lengths"].index(x) for x in (2.0, 4.0)):
        wanted = STORED["hulls"][name]["motions"][STORED["headings"].index(heading)][k]
        np.testing.assert_allclose(motions(name, heading, k), wanted, rtol=0.17, atol=0.04)


@pytest.mark.parametrize(("name", "wanted"), [("barge", 0.045), ("pontoon", 0.045)])
def test_short_waves_hardly_move_a_long_hull(name, wanted):
    """In head seas from half of its length: the pushes on bow and stern cancel."""
    for k in (STORED["lengths"].index(x) for x in (0.5, 1.0, 1.5)):
        found = motions(name, 180.0, k)
        np.testing.assert_allclose(found[0], STORED["hulls"][name]["motions"][0][k][0], atol=wanted)
