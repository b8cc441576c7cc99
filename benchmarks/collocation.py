"""DMOC compared with direct collocation of the same vehicles, marks, cost and solver, as in SYM and NH.

``python -m benchmarks.collocation [VEHICLE ...]`` prints a table, for all vehicles or those named; without names it
writes ``RESULTS.collocation.md`` beside this file. Every row is the median over random goals of one solve each, from
one initial guess, without coarser or finer levels; *executed* is the distance from the plan when an independent, fine
integration executes the controls.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import vehsim
from benchmarks.collocated import SCHEMES, Collocated, Collocation, solve
from benchmarks.machine import headed
from vehsim import Mark
from vehsim.planning.problem.transcription import Array, Transcription

REST = (0.0, 0.0, 0.0)
TASKS = {
    ("helicopter_lie", "smoothness"): (121, (0, 0, 30), (40, 10, 35)),
    ("helicopter_lie", "effort"): (121, (0, 0, 30), (40, 10, 35)),
    ("car_lie", "effort"): (145, (0, 0, 0), (25, 6, 0)),
    ("two_wheeled", "effort"): (241, (0, 0, 0), (10, 4, 0)),
}
"""(vehicle, cost) -> last frame at 24 fps, start and the goals' mean, m, from rest to rest."""

OURS = {"order 2": 2, "order 4": 4}
"""Method -> order of DMOC, which `plan` refines from 2 to 4."""
MAIN, RIVAL, SEGMENTS, GOALS, TURNS = "order 4", "hermite-simpson", (16, 32, 64), 9, 5
SPREAD, ASIDE, HEADING = 0.4, 20.0, 40.0
"""By how much the distances of random goals differ, by their mean; how far they lie aside of it and how far they are
turned, at most, degrees."""
SAME = 0.05
"""Largest distance of two motions to the same optimum, at their knots, by the distance to the goal."""
TOP = [
    "# DMOC and collocation, measured",
    "",
    "Order 4 of DMOC divided by Hermite-Simpson: executed error, CPU time of a solve, iterations, and CPU time of",
    f"an iteration; medians over {GOALS} random goals, in brackets the least and the most. Both have the same solver",
    "and start. At most 1 is the target. Only goals count at which both end at the same optimum: their knots are apart",
    f"by at most {SAME * 100:.0f} % of the distance to the goal.",
    "",
    "| vehicle, cost | N | goals | executed error | CPU time | iterations | CPU time of an iteration |",
    "|---|---|---|---|---|---|---|",
]
HEAD = [
    "Order 4 (`vehsim/planning/problem/simpson.py`) is Hermite-Simpson's rule on the group: it keeps quaternions at",
    "unit norm and constraints at every knot and middle, and is symmetric in time; momentum is conserved to fourth",
    "order. In the plane its equations are those of Hermite-Simpson in other variables. In space, rotations are",
    "exponentials, and the gyroscopic force of velocities quadratic in time is integrated exactly, which makes most of",
    "the difference. Both are differentiated by the chain rule through the middle of a segment (`Element.inner`), ours",
    "also through the mean of both attitudes. Where that is cheap, here for the helicopter and the robot, the velocity",
    "at the middle is not a variable of ours either (`Element.reduced`).",
    "",
    f"One thread, no compiler. CPU times are the least of {TURNS} turns, in which all methods solve one after another.",
    "They include the guess and the execution of the controls, but not building. Medians over the same goals:",
    "",
    "| vehicle, cost | method | N | cost by Hermite-Simpson's | executed, off by (m) | quaternion drift | iterations "
    "| CPU (s) |",
    "|---|---|---|---|---|---|---|---|",
]

DROPPED = """## Tried and dropped

CPU times and executed errors are relative to Hermite-Simpson, on 2026-11-24: one solve for each N of 16, 32, 64.

- Suzuki's composition of five segments of order 2, which was order 4 until then: helicopter 2.4 to 5.7 times the CPU
  time, errors 0.2 to 1.7; car 1.9 to 2.6 times, errors 0.5; robot 2 to 3 times, errors 1.1 to 1.3.
- Galerkin segments with two Gauss points and two velocities, momentum exact, in the chart of `exp`: helicopter 1.4 to
  2.8 times the CPU time, errors 0.3 to 2.5. The same with polynomials in place of rotations within a segment: 1.1 to
  2.1 times, errors 0.6 to 2.9; car 0.9 to 1.05 times, errors 1.7; robot 0.9 to 1.0 times, errors 0.95.
- Hermite-Simpson with the momentum in space axes, hence exact: helicopter 0.9 to 1.5 times, errors 1.9 to 3.7.
- Order 4 with an exact law for the momentum at the end, `pi_1 - pi = ad(x)^T (pi + pi_1) / 2` plus impulses:
  helicopter 1.1 to 1.5 times, errors 0.9 to 2.4. The controls' torques are linear in body axes, where Simpson's rule
  integrates them exactly. So exact momentum costs accuracy here.
- Without the velocity at the middle as a variable for every vehicle: Hessians and Jacobians of the simple car take
  50 %, of the truck 45, of the shipped helicopter 52, of snakeboards 28, of boats 36, of the hopper 47 and of the
  rally car 69 % more instructions, which costs more than the smaller linear systems save. Solves of the simple car
  took 5 % longer, of the car 4 % less, but plans of the car the same. Where clearances read it, it stays a variable.
- Until 2026-11-27 without the gyroscopic term, and with the Hermite cubic of both quaternions in the middle: executed
  errors of the nine flights, medians for N = 16, 32 and 64, were 1.39, 1.14 and 0.99 for effort and 0.81, 0.80 and 0.72
  for smoothness, and a Hessian took 9,673 instructions (now 8,424, Hermite-Simpson 8,532). The mean of both attitudes
  as an inner expression saves 1,300, because all that depends on both depends on their mean alone.
- The gyroscopic term from the second difference of the whole momentum, gyroscopic forces included: errors for N = 16
  and 32 of 0.62 and 0.71 for effort, 0.44 and 0.43 for smoothness (now 0.67, 0.70, 0.47 and 0.50) for 3 % fewer
  instructions. But a quadrotor whose controls are free at both ends then ends 1.2 to 2.3 times as far off at 32
  segments as without the term (seven goals; now 0.8 to 1.1 times, four goals), and 3 to 17 times at 64 (now 2 to 7).
  From the forces instead of the momenta: the same errors, 40 % more instructions for the shipped helicopter.
- Gyroscopic forces exact for rates cubic in time, and the middle's momentum corrected for them: 0.4 to 0.8 times at 32
  segments with free ends, 1 to 5 at 64, and in balance 0.07 to 0.23; 30 % more instructions. The middle's momentum
  alone, `pi_m + h B(xi_1 - xi, d mu) / 32`: 11 % more, flights 3 % nearer.
- Rotations by the Magnus series to sixth order: with `a = h w_m`, `b = h (w_1 - w_0)`, `c = 2 h (w_0 - 2 w_m + w_1)`
  and `e = a x b`, `a + c / 12 + (a + c / 20 + e / 20) x (b + a x (2 c - e) / 60) / 12`. Without the gyroscopic term it
  gave errors of 0.92, 0.97, 0.96 and 0.99, beside it 0.45, 0.66, 0.37 and 0.39, for 14 % more instructions; a quadrotor
  gains nothing.
- The tangent of the rotation vector to seventh order: 2 % more instructions, the same errors. From the middle's rate
  alone: 1 % fewer, errors 0.98, 0.65, 1.35 and 1.44.
- Simpson's rule for quaternions without its part along them, so that they keep their norm: 40 to 50 % more
  instructions.
- Further inner expressions (forces at the ends, the middle's force, impulses, sums and differences of rates): 0 to 5 %
  more instructions. Products of the chain rule by halves of the symmetric Hessian: 5 to 10 % more.
- The rotation as a unit quaternion of a rational function instead of the implicit relation: 340 of 13,000 instructions
  less for the papers' helicopter, 900 of 28,600 more for the shipped one. Compared with the ends in body axes instead:
  800 less, but multipliers of order 2 would have to be rotated.
- Rotations by the exponential, until 2026-11-27: 12,013 instructions per Hessian of the helicopter; with the Cayley map
  and a corrected vector 10,734, with the logarithm of the ends 10,334, and with the implicit Cayley relation between
  both ends, which is used now, 10,032 (Hermite-Simpson 12,470). 56 flights (14 random goals, both costs, N = 16 and
  32, load 19): 908 iterations in all (exponential 905, Hermite-Simpson 880), 8.1 ms each (8.5, 7.8); CPU time over
  Hermite-Simpson, median, 1.07 (1.09). What remains is the linear systems' size.
- Other options of IPOPT for both, on 2026-11-27: 17 solves (ten random flights, the helicopter's tasks, car and robot)
  take 307 iterations, those of Hermite-Simpson 306, though single ones differ by a third either way; one more flight
  fails with both. Other steps of the multipliers, globalisations, oracles and centralities of the barrier, no
  multipliers from least squares, a larger first perturbation: 306 to 436 and 291 to 407 iterations, or solves that
  fail. Curvature tests in place of inertia end in worse optima (12 and 9 of 17). Mehrotra's corrector saves 6 and 17 %,
  and ends in a worse optimum once with either.
- Linear systems without MUMPS's own scaling and permutation: car and robot 10 to 20 % less, the helicopter at N = 64
  8 % more (Hermite-Simpson 3 to 13 % less). Other permutations, scalings and pivot tolerances: no faster.
- Segments' durations as parameters where frames are given: 6,188 (ours) and 7,925 instructions (Hermite-Simpson) per
  Hessian of the helicopter, so about 5 and 14 % of an iteration; plans with free frames would need a second set of
  derivatives.
- Velocities at the knots as inner expressions too: Hessians of snakeboards take 11,636 instead of 12,997 instructions,
  Jacobians of boats 12,413 instead of 7,264.
- Order 6, seven substeps of order 2 (Yoshida), as the second step of refinement until 2026-11-24. With twice as many
  segments of order 4 in its place: canyon flight 10.8 CPU s (before 13.0), landing 23.3 (21.1), river bend 15.9 (16.6),
  snakeboard to a mark 6.0 (9.2), with costs lower by 0.2, 3, 6 and 7 %.
- The coarse first solve at order 4 too: CPU times of six examples within 15 %, but parallel parking finds a worse
  manoeuvre (cost 31.5, before 22.5) in twice the time.
- Common subexpressions after differentiation: 2 to 10 % fewer instructions per Hessian, for 20 to 70 ms of building.
"""


@dataclass(frozen=True, eq=False)
class Tried:
    """A solve, and its least CPU time, s."""

    answer: Collocated
    seconds: float

    @property
    def columns(self) -> list[float]:
        """Cost, executed error m, quaternion drift, iterations and CPU time s."""
        answer, solution = self.answer, self.answer.solution
        drift = np.abs(np.linalg.norm(answer.g[:, :4], axis=1) - 1).max()
        return [solution.cost, answer.executed.final, drift, solution.iterations, self.seconds]

    def ends_like(self, other: Tried) -> bool:
        """Whether both motions are solved, and lie near each other at their knots."""
        if not (self.answer.solution.success and other.answer.solution.success):
            return False
        a, b = (each.answer.g[:, -3:] if each.answer.g.shape[1] > 3 else each.answer.g[:, 1:] for each in (self, other))
        return bool(np.linalg.norm(a - b, axis=1).max() < SAME * np.linalg.norm(b[-1] - b[0]))


def main() -> None:
    named = sys.argv[1:]
    lines, ratios = [], []
    for (name, cost), (frame, start, mean) in TASKS.items():
        if named and name not in named:
            continue
        vehicle = vehsim.load_vehicle(name)
        vehicle = vehicle.planar or vehicle
        ours = Transcription(vehicle)
        methods: dict[str, tuple[Any, int]] = {method: (ours, order) for method, order in OURS.items()}
        methods |= {scheme: (Collocation(vehicle, scheme), 2) for scheme in SCHEMES}
        goals = _goals(frame, start, mean)
        _in_turn(methods, goals[0], SEGMENTS[0], cost)  # builds the elements
        for n in SEGMENTS:
            tried = [_in_turn(methods, marks, n, cost) for marks in goals]
            same = [each for each in tried if each[MAIN].ends_like(each[RIVAL])]
            table = {method: np.array([each[method].columns for each in same]) for method in methods}
            for method, rows in table.items():
                over = np.median(rows[:, 0] / table[RIVAL][:, 0])
                _, off, drift, iterations, seconds = np.median(rows, axis=0)
                kept = f"{drift:.0e}" if vehicle.group.size > vehicle.group.dim else ""
                lines.append(
                    f"| {name}, {cost} | {method} | {n} | {over:.4f} | {off:.1e} | {kept} | {iterations:.0f} "
                    f"| {seconds:.3f} |"
                )
                print(lines[-1], flush=True)
            _, off, _, iterations, seconds = (table[MAIN] / table[RIVAL]).T
            cells = " | ".join(map(_spread, (off, seconds, iterations, seconds / iterations)))
            ratios.append(f"| {name}, {cost} | {n} | {len(same)} of {GOALS} | {cells} |")
            print(ratios[-1], flush=True)
    if not named:
        page = [*TOP, *ratios, "", *HEAD, *lines, "", DROPPED]
        Path(__file__).with_name("RESULTS.collocation.md").write_text(headed("\n".join(page)), encoding="utf-8")


def _spread(ratios: Array) -> str:
    """The median, the least and the most."""
    return f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"


def _goals(frame: int, start: Sequence[float], mean: Sequence[float]) -> list[list[Mark]]:
    """Marks of random tasks, from rest to rest."""
    chance, way = np.random.default_rng(0), np.subtract(mean, start)
    goals = []
    for _ in range(GOALS):
        x, y, z = way * chance.uniform(1 - SPREAD, 1 + SPREAD)
        turn, heading = np.radians(chance.uniform(-ASIDE, ASIDE)), float(chance.uniform(-HEADING, HEADING))
        goal = start + np.array([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y, z])
        first = Mark(1, position=tuple(start), heading=0, velocity=REST)
        goals.append([first, Mark(frame, position=tuple(goal.tolist()), heading=float(heading), velocity=REST)])
    return goals


def _in_turn(
    methods: Mapping[str, tuple[Any, int]], marks: Sequence[Mark], segments: int, cost: str
) -> dict[str, Tried]:
    """Every method's result, with its least CPU time of `TURNS` turns."""
    tried: dict[str, Tried] = {}
    for _ in range(TURNS):
        for method, (transcription, order) in methods.items():
            began = time.process_time()
            answer = solve(transcription, marks, segments, order, cost=cost)
            spent = time.process_time() - began
            tried[method] = Tried(answer, min(spent, tried[method].seconds if method in tried else spent))
    return tried


if __name__ == "__main__":
    main()
