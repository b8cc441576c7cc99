"""SYM section VI: poses as variables of the optimisation, or eliminated: reconstructed from the velocities.

``python -m benchmarks.eliminated`` prints a table and writes ``RESULTS.eliminated.md`` beside this file. Both forms
have the discrete mechanics of order 2, cost, guess and solver in common; without poses as variables, every pose is
the product of the steps before it.
"""

from __future__ import annotations

import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import vehsim
from benchmarks.machine import headed
from vehsim import Mark
from vehsim.planning import solve as planning
from vehsim.planning.guesses.routes import straight
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem.transcription import transcribe
from vehsim.planning.request.request import make_request

REST, TURNS = (0.0, 0.0, 0.0), 3
TASKS = {"helicopter_lie": (121, (0, 0, 30), (40, 10, 35)), "car_lie": (145, (0, 0, 0), (25, 6, 0))}
"""Vehicle -> last frame at 24 fps, start and goal, m, from rest to rest, rotated by 20 degrees."""
HEAD = [
    "# Poses kept or eliminated, measured",
    "",
    "SYM section VI (`benchmarks/eliminated.py`): the same discrete problem with poses as variables, and with poses",
    f"reconstructed from velocities. CPU times of a solve without building, the least of {TURNS}; nonzeros of the",
    "constraints' Jacobian and of the Hessian.",
    "",
    "| vehicle | N | poses | variables | Jacobian | Hessian | cost | iterations | CPU (s) |",
    "|---|---|---|---|---|---|---|---|---|",
]


def main() -> None:
    lines = []
    for name, task in TASKS.items():
        for n in (16, 32, 64):
            guess = guessed(name, *task, n)
            for kept in (True, False):
                lines.append(row(name, n, kept, *problem(guess, kept)))
                print(lines[-1], flush=True)
    if not sys.argv[1:]:
        text = headed("\n".join([*HEAD, *lines]) + "\n")
        Path(__file__).with_name("RESULTS.eliminated.md").write_text(text, encoding="utf-8")


def guessed(name: str, last: int, start: tuple[float, ...], goal: tuple[float, ...], n: int) -> Iterate:
    """The initial guess of a plan from start to goal on ``n`` segments."""
    marks = [
        Mark(1, position=start, heading=0, velocity=REST),
        Mark(last, position=goal, heading=20, velocity=REST),
    ]
    vehicle = vehsim.load_vehicle(name)
    request = make_request(vehicle, None, marks, fps=24, segments=n, character="stunt", cost="effort", refine=False)
    return planning.begin(Run(request, None), request, transcribe(vehicle), None, straight(request), coarse=False)


def problem(guess: Iterate, kept: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """The nonlinear program, and its start and bounds: from rest to rest with the least squared controls."""
    t, layout = guess.transcription, guess.layout
    size, s, momenta, count = t.sizes
    n, h = layout.segments, float(guess.lengths[0])
    v = {"z": ca.MX.sym("z", momenta, n), "pi": ca.MX.sym("pi", momenta, n + 1), "c": ca.MX.sym("c", count, n + 1)}
    states, k = guess.x[layout.knot(np.arange(n + 1))], np.arange(n)
    start = {
        "z": guess.x[layout.velocity(k)],
        "pi": states[size + s :],
        "c": guess.x[layout.control(np.arange(n + 1))],
    }
    first, goal = states[: size + s, 0], states[: size + s, -1]
    if kept:
        v["g"], start["g"] = ca.MX.sym("g", size + s, n + 1), states[: size + s]

    step, rows = t.segment, []
    here = v["g"][:, 0] if kept else ca.DM(first)
    for i in range(n):
        scaled = [v["c"][:, i + j] * t.control_scale for j in (0, 1)]
        left, right, g, r = step(here[:size], here[size:], v["z"][:, i], *scaled, h, np.zeros(3), np.zeros(0))
        ends = [v["pi"][:, i + j] * t.momentum_scale for j in (0, 1)]
        rows += [(left - ends[0]) / t.momentum_scale, (right - ends[1]) / t.momentum_scale]
        here = ca.vertcat(g, r)
        if kept:
            rows.append(here - v["g"][:, i + 1])
            here = v["g"][:, i + 1]
    moving = list(range(size - t.vehicle.group.dim, size))  # unit norm gives a quaternion's first component
    ends = [here[moving] - goal[moving], v["pi"][:, 0], v["pi"][:, n]]
    begins = [v["g"][:, 0] - first] if kept else []
    effort = sum(h / 3 * (ca.sumsqr(a) + ca.dot(a, b) + ca.sumsqr(b)) for a, b in pairwise(ca.horzsplit(v["c"])))
    program = {"x": ca.veccat(*v.values()), "f": effort, "g": ca.vertcat(*rows, *ends, *begins)}
    low, high = (
        np.array([getattr(control, end) for control in t.vehicle.controls]) / t.control_scale
        for end in ("lower", "upper")
    )
    bounds = {
        end: np.concatenate([np.full(value.size, infinite) if name != "c" else np.tile(bound, n + 1)
                             for name, value in start.items()])
        for end, bound, infinite in (("lbx", low, -np.inf), ("ubx", high, np.inf))
    }  # fmt: skip
    x0 = np.concatenate([value.ravel(order="F") for value in start.values()])
    return program, {"x0": x0, "lbg": 0, "ubg": 0, **bounds}


def row(name: str, n: int, kept: bool, program: dict[str, Any], given: dict[str, Any]) -> str:
    """A line of the table."""
    options = {"ipopt": {"print_level": 0, "sb": "yes", "max_iter": 500}, "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", program, options)
    times = []
    for _ in range(TURNS):
        began = time.process_time()
        found = solver(**given)
        times.append(time.process_time() - began)
    stats = solver.stats()
    iterations = stats["iter_count"] if stats["success"] else stats["return_status"]
    nonzeros = [solver.get_function(part).nnz_out(out) for part, out in (("nlp_jac_g", 1), ("nlp_hess_l", 0))]
    return (
        f"| {name} | {n} | {'kept' if kept else 'eliminated'} | {program['x'].numel()} | {nonzeros[0]} "
        f"| {nonzeros[1]} | {float(found['f']):.4f} | {iterations} | {min(times):.3f} |"
    )


if __name__ == "__main__":
    main()
