"""Plans of easy marks take few iterations, and few operations in each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import vehsim
from vehsim import Mark
from vehsim.audit import track_of_clip
from vehsim.planning import iterate, planner, solve
from vehsim.planning.constraints.dynamics import equations
from vehsim.planning.costs import RunningCosts
from vehsim.planning.guesses.routes import find_paths
from vehsim.planning.problem import solver
from vehsim.planning.problem.solver import FAR, FIRST, curvature
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.request import make_request
from vehsim.runtime.progress import silent
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)


def marks(*rows):
    return [Mark(frame, position=(x, y, 0.0), heading=heading, velocity=REST) for frame, x, y, heading in rows]


def test_a_hessian_that_must_be_made_convex_takes_few_iterations():
    """With IPOPT's own multiples of the identity, this truck took 41 iterations and this boat 66."""
    truck = vehsim.plan(vehsim.load_vehicle("truck"), None, marks((1, 0, 0, 0), (706, 57, 10, -14)))
    boat = vehsim.plan(vehsim.load_vehicle("boat"), None, marks((1, 0, 0, 0), (1003, 65, 39, 3)))
    assert truck.success and truck.iterations < 25
    assert boat.success and boat.iterations < 30


def test_a_flight_that_presses_on_its_character_is_solved_within_it_at_once(monkeypatch):
    """It was solved without the limits first, and then again; to the same motion."""
    x, y = np.meshgrid(np.arange(-120, 121, 4.0), np.arange(-60, 61, 4.0))
    hill = 22 * np.exp(-(x**2 + y**2) / (2 * 22**2)) + 3 * np.sin(x / 15) * np.sin(y / 11)
    world = vehsim.World(terrain=Terrain("hill", hill, (-120.0, -60.0), (4.0, 4.0)))
    ends = [Mark(frame, position=(x, 0, 14), velocity=REST) for frame, x in ((1, -70), (361, 70))]
    helicopter, soft = vehsim.load_vehicle("helicopter"), []
    solving = solve._answer

    def answer(run, iterate, *more):
        soft.append(iterate.block(RunningCosts).restrained)
        return solving(run, iterate, *more)

    monkeypatch.setattr(solve, "_answer", answer)
    once = vehsim.plan(helicopter, world, ends)
    assert all(soft)
    soft.clear()
    monkeypatch.setattr(planner, "PRESSED", (np.inf, np.inf))
    twice = vehsim.plan(helicopter, world, ends)
    assert soft[:2] == [False, True] and once.iterations < twice.iterations
    assert once.success and once.character == "normal" and once.cost == pytest.approx(twice.cost, rel=1e-5)
    np.testing.assert_allclose(once.clip.positions, twice.clip.positions, atol=1e-3)


def test_a_hurried_boat_takes_few_iterations():
    """With the curvature of constraints from the first iteration, it took 33."""
    plan = vehsim.plan(vehsim.load_vehicle("boat"), None, marks((1, 0, 0, 0), (824, 84, -23.8, -52.6)))
    assert plan.success and plan.character == "normal" and plan.iterations < 20


def test_the_curvature_of_constraints_counts_near_a_motion_and_after_some_iterations():
    assert curvature(0, 1.0) == FAR
    assert 0 < curvature(FIRST - 1, 2 * FAR) < 1
    assert curvature(0, FAR) == curvature(FIRST, 1.0) == 1


def test_a_hurried_helicopter_takes_few_iterations():
    """With steps that reduce either the cost or violations, it took 20, and with the curvature of constraints 15."""
    first, last = marks((1, 0, 0, 0), (743, 164.15, 71.6, 14))
    last = replace(last, position=(164.15, 71.6, 3.7))
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, [first, last])
    assert plan.success and plan.character == "normal" and plan.iterations < 12


@pytest.mark.parametrize(
    ("name", "last", "start"),
    [("boat", 1003, "plane"), ("boat", "free", "open"), ("helicopter", 1003, "space"), ("truck", 1003, "open")],
)
def test_the_first_solve_starts_as_suits_what_guides_the_vehicle(name, last, start, monkeypatch):
    starts = []
    plain = solver.Solver.prepare
    monkeypatch.setattr(solver.Solver, "prepare", lambda s, kind, *rest: starts.append(kind) or plain(s, kind, *rest))
    plan = vehsim.plan(vehsim.load_vehicle(name), None, marks((1, 0, 0, 0), (last, 65, 9, 3)))
    assert plan.success and starts[0] == start


def test_a_first_solve_that_fails_is_begun_again_with_other_steps(monkeypatch):
    starts = []
    plain = solver.Solver.solve

    def solve(self, x, *rest, start="guess", **more):
        starts.append(rest[4] if len(rest) > 4 else start)
        answer = plain(self, x, *rest, **more)
        return replace(answer, success=False) if starts[-1] == "space" else answer

    monkeypatch.setattr(solver.Solver, "solve", solve)
    plan = vehsim.plan(vehsim.load_vehicle("helicopter"), None, marks((1, 0, 0, 0), (1003, 65, 9, 3)))
    assert plan.success and starts[:2] == ["space", "open"] and "space" not in starts[2:]


def test_a_boat_held_at_rest_takes_few_iterations():
    """One thrust is to balance three forces, so that the constraints depend on each other: it took 302 iterations."""
    first, last = marks((1, 0, 0, 0), (1992, 65, 39, 3))
    pause = Mark(981, position=(34.4, 16.6, 0.0), velocity=REST, hold=48)
    plan = vehsim.plan(vehsim.load_vehicle("boat"), None, [first, pause, last])
    assert plan.success and plan.iterations < 100


def test_a_car_on_tyres_goes_ahead_and_aside():
    """Its guess slid sideways along a straight path: that took 747 iterations, and failed."""
    plan = vehsim.plan(vehsim.load_vehicle("drift_car"), None, marks((1, 0, 0, 0), (337, 40, 10, 0)))
    assert plan.success and plan.character == "normal" and plan.iterations < 250


def test_the_guess_of_a_car_on_tyres_follows_its_marks():
    def guess(vehicle, *rows):
        given = make_request(vehsim.load_vehicle(vehicle), vehsim.World(), marks(*rows), fps=24, segments=64)
        return find_paths(given, None, silent)[0]

    path = guess("drift_car", (1, 0, 0, 0), (337, 40, 10, 30))
    first, last = path[1] - path[0], path[-1] - path[-2]
    assert abs(math.degrees(math.atan2(first[1], first[0]))) < 3
    assert abs(math.degrees(math.atan2(last[1], last[0])) - 30) < 3
    assert len(guess("car", (1, 0, 0, 0), (337, 40, 10, 60))) == 2  # it cannot slide
    assert len(guess("drift_car", (1, 0, 0, 0), (337, 40, 10, 60))) == 2  # too sharp
    assert len(guess("drift_car", (1, 0, 0, 0), (337, -40, 10, 0))) == 2  # the mark is behind it


def test_a_motion_that_actuators_cannot_follow_is_solved_again_from_itself(monkeypatch):
    starts = []
    from vehsim.planning import solve

    plain = solve._solve_active

    def watched(run, start, kind, patience):
        solved = plain(run, start, kind, patience)
        starts.append((kind, start.x, solved.x))
        return solved

    monkeypatch.setattr(solve, "_solve_active", watched)
    world = vehsim.World(wind=(-6.0, 3.0, 0.0))
    plan = vehsim.plan(vehsim.load_vehicle("boat"), world, marks((1, 0, 0, 0), (700, 65, 39, 3)))
    again = [k for k, (kind, _, _) in enumerate(starts) if kind == "again"]
    assert plan.success and again
    for k in again:
        assert (starts[k][1] == starts[k - 1][2]).all()


def test_a_coarse_motion_is_measured_once(monkeypatch):
    tracks = []
    made = iterate.track_of_clip
    monkeypatch.setattr(iterate, "track_of_clip", lambda clip: tracks.append(made(clip)) or tracks[-1])
    plan = vehsim.plan(vehsim.load_vehicle("car"), None, marks((1, 0, 0, 0), (481, 30, 5, 10)))
    assert plan.success and len(tracks) == 1 and not tracks[0].channels


def test_the_finished_motion_is_not_interpolated_again(monkeypatch):
    """Its audit takes the track of the coarse one, with channels."""
    tracks = []

    def watched(clip, known=None):
        tracks.append((known, track_of_clip(clip, known), track_of_clip(clip)))
        return tracks[-1][1]

    monkeypatch.setattr(planner, "track_of_clip", watched)
    plan = vehsim.plan(vehsim.load_vehicle("boat"), None, marks((1, 0, 0, 0), (481, 40, 5, 10)))
    (known, made, whole), *others = tracks
    assert plan.success and known is not None and not others and set(made.channels) == {"propeller", "steer"}
    for name in ("frames", "positions", "rotations", "velocities", "omegas", "controls"):
        assert (getattr(made, name) == getattr(whole, name)).all()
    assert all((made.channels[name] == values).all() for name, values in whole.channels.items())


@pytest.mark.parametrize(("order", "most"), [(2, 2500), (4, 4000)])
def test_derivatives_of_a_planing_hull_take_few_operations(order, most):
    """In a Hessian: 6820 and 18715 when every piece of its curves was differentiated, and 3708 and 7119 when its pieces
    were sums of steps."""
    element = equations(transcribe(vehsim.load_vehicle("boat").planar), order)
    assert element.hessian[0].n_instructions() < most


def test_slow_flights_take_few_iterations():
    """A slow flight costs about as much at any pace: steps of 50 m that cost more were taken, 263 iterations in all."""
    first = Mark(1, position=(0.0, 0.0, 30.0), heading=0.0, velocity=REST)
    way = Mark(473, position=(80.65, 39.07, 31.85))
    last = Mark(990, position=(164.15, 71.6, 33.71), heading=14.0, velocity=REST)
    helicopter = vehsim.load_vehicle("helicopter")
    for marks in ([first, last], [first, way, last]):
        plan = vehsim.plan(helicopter, None, marks)
        assert plan.success and plan.character == "normal" and plan.iterations < 25
