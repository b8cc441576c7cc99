"""Warm starts: multipliers give the active constraints, and rock far from a known motion need not be active."""

from dataclasses import replace

import numpy as np
import pytest

import vehsim
from tests.planning.test_plan import REST, tug
from vehsim import Mark
from vehsim.planning.constraints import clearance
from vehsim.planning.constraints.block import assemble
from vehsim.planning.constraints.clearance import Clearance
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.multipliers import _of_order, transferred
from vehsim.planning.problem.solver import Multipliers
from vehsim.world.terrain.terrain import Terrain


@pytest.fixture(scope="module")
def helicopter():
    return vehsim.load_vehicle("helicopter")


def flight(vehicle, segments, goal=(40, 10, 35)):
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=REST),
        Mark(121, position=goal, heading=20, velocity=REST),
    ]
    return marks, vehsim.plan(vehicle, None, marks, segments=segments, refine=False)


def test_multipliers_of_one_order_are_those_of_the_other():
    """The same linear combination of rows: those of either end at order 2, and of the middle and the end at order 4."""
    chance = np.random.default_rng(1)
    middle, end, rest, given = chance.normal(size=(4, 5, 3))
    given = np.hstack([given, chance.normal(size=(5, 6))])
    before = np.hstack([middle + end / 2, middle - end / 2, rest])  # as order 2 has them
    after = np.hstack([middle, end, rest])
    there = _of_order(given, 4, 3)
    np.testing.assert_allclose((there * after).sum(axis=1), (given * before).sum(axis=1))
    np.testing.assert_allclose(_of_order(there, 2, 3), given)


def test_multipliers_reach_problems_without_velocities_and_come_back(monkeypatch):
    """Those of the rows that both have; the others are left out, or zero."""
    plan = flight(vehsim.load_vehicle("helicopter_lie"), 16)[1]
    iterate = plan._iterate
    two, four = (replace(iterate.layout, order=order) for order in (2, 4))
    simple, reduced = (assemble(iterate.transcription, layout, iterate.blocks) for layout in (two, four))
    monkeypatch.setattr(NonlinearProgram, "reduce", lambda problem: None)
    whole = assemble(iterate.transcription, four, iterate.blocks)
    chance = np.random.default_rng(1)
    given = Multipliers(chance.normal(size=two.size), chance.normal(size=len(simple.bounds[0])), 1.0)
    there, true = (transferred(given, (simple, two), (problem, four)).g for problem in (reduced, whole))
    n, count, rows = iterate.transcription.sizes[2], whole.uses[0].count, whole.uses[0].rows
    assert reduced.uses[0].rows == rows - n and whole.uses[0].element.name == "dynamics"
    expected = true[: rows * count].reshape(count, rows)
    np.testing.assert_array_equal(there, np.append(expected[:, n:].ravel(), true[rows * count :]))
    back = transferred(Multipliers(given.x, there, 1.0), (reduced, four), (whole, four)).g
    expected[:, :n] = 0.0
    np.testing.assert_array_equal(back, true)


def with_multipliers(plan, multipliers):
    return replace(plan, _iterate=replace(plan._iterate, multipliers=multipliers))


def test_multipliers_spare_a_replan_iterations(helicopter):
    """The same solution as from the motion alone, in fewer iterations."""
    marks, plan = flight(helicopter, 16)
    moved = [marks[0], replace(marks[1], position=(40.6, 9.5, 35.6))]
    warm = plan.replan(moved)
    cold = with_multipliers(plan, None).replan(moved)
    assert warm.success and cold.success and warm.defect < 1e-8
    np.testing.assert_allclose(warm.clip.positions, cold.clip.positions, atol=1e-6)
    assert warm.iterations < cold.iterations


def test_misleading_multipliers_cost_time_and_nothing_else(helicopter):
    marks, plan = flight(helicopter, 16)
    moved = [marks[0], replace(marks[1], position=(40.6, 9.5, 35.6))]
    right = plan.replan(moved)
    true, where = plan._iterate.multipliers
    rng = np.random.default_rng(1)
    noise = replace(true, **{key: 1e6 * rng.standard_normal(len(getattr(true, key))) for key in ("x", "g")})
    wrong = with_multipliers(plan, (noise, where)).replan(moved)
    assert wrong.success and wrong.iterations > right.iterations
    np.testing.assert_allclose(wrong.clip.positions, right.clip.positions, atol=1e-6)


def multipliers_of(name, segments, **limits):
    """A solved problem and its multipliers, from rest to rest in seven seconds."""
    z = 30.0 if name == "helicopter" else 0.0
    marks = [
        Mark(1, position=(0, 0, z), heading=0, velocity=REST),
        Mark(169, position=(40, 8, z), heading=0, velocity=REST),
    ]
    vehicle = vehsim.load_vehicle(name)
    plan = vehsim.plan(vehicle, None, marks, segments=segments, refine=False, limits=limits, character="stunt")
    return plan._iterate.multipliers


@pytest.mark.parametrize(
    ("name", "limits", "part"), [("helicopter", {}, "dynamics"), ("car", {"speed": 7.5}, "limit speed")]
)
def test_carried_multipliers_are_nearly_those_of_the_finer_problem(name, limits, part):
    """Costates are functions of time, and the sum of a limit's multipliers does not depend on the number of
    instants."""
    coarse, (true, where) = multipliers_of(name, 24, **limits), multipliers_of(name, 48, **limits)
    guess = transferred(*coarse, where)
    assert guess.x.shape == true.x.shape and guess.g.shape == true.g.shape
    rows = np.array([label.split("[")[0] == part for label in where[0].names()])
    assert np.linalg.norm(true.g[rows]) > 0.1
    assert np.linalg.norm(guess.g[rows] - true.g[rows]) < 0.35 * np.linalg.norm(true.g[rows])
    if part != "dynamics":
        assert guess.g[rows].sum() == pytest.approx(true.g[rows].sum(), rel=0.1)


def test_distant_rock_need_not_be_active(helicopter, monkeypatch):
    """With all, some, or none of the rock active at first, the motion is the same, with the requested clearance."""
    x, y = np.meshgrid(np.arange(0, 81, 4.0), np.arange(-24, 25, 4.0))
    world = vehsim.World(
        terrain=Terrain("ridge", 20 * np.exp(-(((x - 40) / 7) ** 2)) + 0 * y, (0.0, -24.0), (4.0, 4.0))
    )
    marks = [
        Mark(1, position=(10, 0, 9), heading=0, velocity=REST),
        Mark(193, position=(70, 0, 9), velocity=REST),
    ]
    plans = {}
    for sight in (clearance.SIGHT, 1e6, -50.0):
        monkeypatch.setattr(clearance, "SIGHT", sight)
        plans[sight] = vehsim.plan(helicopter, world, marks, segments=48, clearance=2.0, refine=False)
    usual, all_seen, blind = plans.values()
    active = [plan._iterate.block(Clearance).near.mean() for plan in (usual, all_seen, blind)]
    assert 0 < active[0] < 1 == active[1]
    assert active[2] > 0  # the violated rock has become active
    for other in plans.values():
        assert other.success and other.clearance >= 2.0 - 0.01
        assert other.cost == pytest.approx(usual.cost, rel=1e-6)
        np.testing.assert_allclose(other.clip.positions, usual.clip.positions, atol=1e-3)


@pytest.mark.parametrize("solver", ["ipopt", "sqpmethod", "fatrop"])
def test_every_solver_replans(solver):
    """If a warm start does not help, as with solvers that take no multipliers, from scratch."""
    vehicle, upright = tug(), (1.0, 0.0, 0.0, 0.0)
    marks = [
        Mark(1, position=REST, orientation=upright, velocity=REST),
        Mark(73, position=(6, 0, 0), orientation=upright, velocity=REST),
    ]
    plans = [
        vehsim.plan(vehicle, None, marks, segments=8, refine=False, solver=s, character="stunt")
        for s in ("ipopt", solver)
    ]
    moved = [marks[0], replace(marks[1], position=(5.4, 0.6, 0.5))]
    usual, other = (plan.replan(moved) for plan in plans)
    assert usual.success and other.success, other.message
    assert other.cost == pytest.approx(usual.cost, rel=1e-5)
    np.testing.assert_allclose(other.clip.positions, usual.clip.positions, atol=1e-4)
