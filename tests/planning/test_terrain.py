"""Plans near rock: through the gap, at the requested distance, certified on the exported motion."""

import subprocess
import sys

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.planning.certificates import certify
from vehsim.planning.constraints.spheres import sphere_cover
from vehsim.planning.request import request
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def helicopter():
    return vehsim.load_vehicle("helicopter")


@pytest.fixture(scope="module")
def world():
    """A wall 40 m high across the path, with a gap at y = 25."""
    x, y = np.meshgrid(np.arange(0, 121, 3.0), np.arange(-60, 61, 3.0))
    wall = 40 * np.exp(-(((x - 60) / 8) ** 2)) * (1 - np.exp(-(((y - 25) / 14) ** 4)))
    return vehsim.World(terrain=Terrain("gap", wall, (0.0, -60.0), (3.0, 3.0)))


@pytest.fixture(scope="module")
def flight(helicopter, world):
    marks = [
        Mark(1, position=(15, 0, 12), heading=0, velocity=REST),
        Mark("free", position=(105, 0, 12), velocity=REST),
    ]
    return vehsim.plan(helicopter, world, marks, segments=32, clearance=1.5, limits={"ceiling": 25.0})


def test_flies_through_the_gap(flight):
    assert flight.success
    at = int(np.argmin(np.abs(flight.clip.positions[:, 0] - 60)))
    assert flight.clip.positions[at, 1] > 8
    assert flight.clip.positions[:, 2].max() <= 25 + 1e-6


def test_over_a_wide_terrain_only_the_part_around_the_marks_is_measured(helicopter, monkeypatch):
    """And the plan is the same as with the field of the whole, on the same grid."""
    x, y = np.meshgrid(np.arange(0, 601, 6.0), np.arange(0, 601, 6.0))
    marks = [Mark(1, position=(230, 280, 16), heading=0, velocity=REST),
             Mark(400, position=(320, 300, 16), velocity=REST)]  # fmt: skip
    measured, plans = [], []
    monkeypatch.setattr("vehsim.world.distance.field.kept", lambda kind, content, make, most: (
        measured.append(np.prod(content[4])) or make()))  # fmt: skip
    for much in (request.MUCH, np.inf):
        monkeypatch.setattr(request, "MUCH", much)
        world = vehsim.World(terrain=Terrain("waves", 6 * np.sin(x / 40) * np.sin(y / 50), cell=(6.0, 6.0)))
        plans.append(vehsim.plan(helicopter, world, marks, segments=32, clearance=4.0))
    assert len(measured) == 2 and measured[0] < 0.3 * measured[1]
    assert all(plan.success for plan in plans)
    np.testing.assert_allclose(plans[0].clip.positions, plans[1].clip.positions, atol=1e-2)


def test_a_flight_loads_little_of_scipy(flight):
    """Only what libigl loads: the rest would take a tenth of the time of a process's first plan. The vehicle's hulls
    are in the cache, since it has flown before."""
    code = """
import sys, numpy as np, vehsim
from vehsim.world.terrain.terrain import Terrain
x, y = np.meshgrid(np.arange(0, 121, 4.0), np.arange(0, 121, 4.0))
world = vehsim.World(Terrain("hill", 15 * np.exp(-((x - 60) ** 2 + (y - 62) ** 2) / 300), cell=(4.0, 4.0)))
ends = [vehsim.Mark(1, position=(20, 60, 8), heading=0, velocity=(0, 0, 0)),
        vehsim.Mark(300, position=(100, 60, 8), velocity=(0, 0, 0))]
assert vehsim.plan(vehsim.load_vehicle("helicopter"), world, ends, segments=32).success
print(*(name for name in ("igl", "scipy.special", "scipy.linalg", "scipy.ndimage") if name in sys.modules))
"""
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == ["igl"]


def test_clearance_is_certified_on_the_exported_motion(flight, helicopter, world):
    """An independent, finer check of the clip finds no smaller distance than the plan, and it is the requested one."""
    assert flight.clearance >= 1.5 - 0.01
    times = np.linspace(0, flight.duration, 1500)
    motion = flight.clip.at(times)
    nearest = world.clearance(helicopter, motion.positions, motion.orientations, channels=motion.channels).min()
    assert nearest >= flight.clearance - 0.01
    assert certify(flight.clip, world, samples=16) == pytest.approx(nearest, abs=0.02)


def test_cover_holds_every_hull(helicopter):
    from vehsim.rig.parts import collision_hulls

    centres, radii = sphere_cover(helicopter)
    rng = np.random.default_rng(0)
    for hull in collision_hulls(helicopter.rig.asset):
        mixes = rng.dirichlet(np.full(len(hull), 0.2), 400) @ hull  # points of the convex hull
        distance = np.linalg.norm(mixes[:, None] - centres, axis=2) - radii
        assert distance.min(axis=1).max() <= 0


def test_a_gap_that_is_too_narrow_is_reported(helicopter, world):
    from vehsim.errors import SolveError

    marks = [
        Mark(1, position=(15, 0, 12), velocity=REST),
        Mark("free", position=(105, 0, 12), velocity=REST),
    ]
    with pytest.raises(SolveError, match="no path from"):
        vehsim.plan(helicopter, world, marks, segments=16, clearance=11.9, limits={"ceiling": 20.0})


def test_the_safety_cost_increases_the_distance(helicopter, world):
    """Along the wall, with room to keep away: repulsion does so, effort alone does not."""
    marks = [
        Mark(1, position=(40, -45, 12), heading=90, velocity=(0, 8, 0)),
        Mark(97, position=(40, -13, 12), velocity=(0, 8, 0)),
    ]
    options = {"segments": 12, "refine": False, "limits": {"ceiling": 14.0}}
    near = vehsim.plan(helicopter, world, marks, **options)
    far = vehsim.plan(helicopter, world, marks, cost={"safety": 50.0, "effort": 1.0}, **options)
    assert near.success and far.success
    assert far.clip.positions[6, 0] < near.clip.positions[6, 0] - 0.5
