"""DMOC compared with direct collocation of the same vehicles, marks, cost and solver, as in SYM and NH.

``python -m benchmarks.collocation [VEHICLE ...]`` prints a table, for all vehicles or those named; without names it
writes ``RESULTS.collocation.md`` beside this file. Every row is one solve from one initial guess, without coarser or
finer levels; *executed* is the distance from the plan when an independent, fine integration executes the controls.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import vehsim
from benchmarks.collocated import SCHEMES, Collocated, Collocation, solve
from benchmarks.machine import headed
from vehsim import Mark
from vehsim.planning.problem.transcription import Transcription

REST = (0.0, 0.0, 0.0)
TASKS = {
    ("helicopter_lie", "smoothness"): (121, (0, 0, 30), (40, 10, 35)),
    ("helicopter_lie", "effort"): (121, (0, 0, 30), (40, 10, 35)),
    ("car_lie", "effort"): (145, (0, 0, 0), (25, 6, 0)),
    ("two_wheeled", "effort"): (241, (0, 0, 0), (10, 4, 0)),
}
"""(vehicle, cost) -> last frame at 24 fps, start and goal, m, from rest to rest, rotated by 20 degrees."""

OURS = {"order 2": 2, "order 4": 4}
"""Method -> order of DMOC, which `plan` refines from 2 to 4."""
RIVAL, TURNS = "hermite-simpson", 5
TOP = [
    "# DMOC and collocation, measured",
    "",
    "Order 4 of DMOC divided by Hermite-Simpson: executed error, and CPU time of a solve including building. Both have",
    "the same solver and start. At most 1 is the target.",
    "",
    "| vehicle, cost | N | executed error | CPU time |",
    "|---|---|---|---|",
]
HEAD = [
    "Order 4 (`vehsim/planning/problem/simpson.py`) is Hermite-Simpson's rule on the group: it keeps quaternions at",
    "unit norm and constraints at every knot and middle, and is symmetric in time; momentum is conserved to fourth",
    "order. In the plane its equations are those of Hermite-Simpson in other variables. Both are differentiated by the",
    "chain rule through the middle of a segment (`Element.inner`), which saves 25 % (ours) and 17 % (the other) of",
    "a helicopter's Hessian: 7,506 and 10,358 instructions are left. Ours has the larger linear systems. Where ours",
    "takes a tenth longer or more, it needs more iterations, as it happens: over seventeen solves both need as many.",
    "",
    f"One thread, no compiler. CPU times are the least of {TURNS} turns, in which all methods solve one after another.",
    "",
    "| vehicle, cost | method | N | cost | executed, off by (m) | quaternion drift | iterations | CPU (s) |",
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
- Without the velocity at the middle as a variable: 5 to 20 % less CPU time for the helicopter. But holds, clearances at
  the middle and finer levels use it. Again on 2026-11-27: car and robot 5 to 10 % less, the helicopter the same per
  iteration, since a Hessian takes 16,488 instructions instead of 12,013, which outweighs the smaller linear systems.
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


def main() -> None:
    named = sys.argv[1:]
    lines, ratios = [], []
    for (name, cost), (frame, start, goal) in TASKS.items():
        if named and name not in named:
            continue
        vehicle = vehsim.load_vehicle(name)
        vehicle = vehicle.planar or vehicle
        marks = [
            Mark(1, position=start, heading=0, velocity=REST),
            Mark(frame, position=goal, heading=20, velocity=REST),
        ]
        ours = Transcription(vehicle)
        methods: dict[str, tuple[Any, int]] = {method: (ours, order) for method, order in OURS.items()}
        methods |= {scheme: (Collocation(vehicle, scheme), 2) for scheme in SCHEMES}
        for n in (16, 32, 64):
            answers, spent = _in_turn(methods, marks, n, cost)
            for method, answer in answers.items():
                drift = ""
                if vehicle.group.size > vehicle.group.dim:
                    drift = f"{np.abs(np.linalg.norm(answer.g[:, :4], axis=1) - 1).max():.0e}"
                solution = answer.solution
                lines.append(
                    f"| {name}, {cost} | {method} | {n} | {solution.cost:.4f} | {answer.executed.final:.1e} | {drift} "
                    f"| {solution.iterations if solution.success else solution.message} | {spent[method]:.3f} |"
                )
                print(lines[-1], flush=True)
            near = answers["order 4"].executed.final / answers[RIVAL].executed.final
            ratios.append(f"| {name}, {cost} | {n} | {near:.2f} | {spent['order 4'] / spent[RIVAL]:.2f} |")
    print("\n".join(ratios))
    if not named:
        page = [*TOP, *ratios, "", *HEAD, *lines, "", DROPPED]
        Path(__file__).with_name("RESULTS.collocation.md").write_text(headed("\n".join(page)), encoding="utf-8")


def _in_turn(
    methods: Mapping[str, tuple[Any, int]], marks: Sequence[Mark], segments: int, cost: str
) -> tuple[dict[str, Collocated], dict[str, float]]:
    """Every method's result, and its least CPU time, s, of `TURNS` turns after one that builds its elements."""
    answers, spent = {}, {method: np.inf for method in methods}
    for turn in range(TURNS + 1):
        for method, (transcription, order) in methods.items():
            began = time.process_time()
            answers[method] = solve(transcription, marks, segments, order, cost=cost)
            if turn:
                spent[method] = min(spent[method], time.process_time() - began)
    return answers, spent


if __name__ == "__main__":
    main()
