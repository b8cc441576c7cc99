"""NH Figs. 2 to 5: DMOC and collocation in ten random worlds, by the number of segments.

``python -m benchmarks.worlds [VEHICLE ...]`` prints a table, for all vehicles or those named; without names it writes
``RESULTS.worlds.md`` beside this file, and the figures to ``docs/papers/``. Every row is the mean of one solve in each
world, from the guess of A*, with the same solver, costs and limits for every scheme; *executed* controls are integrated
finely and independently.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import vehsim
from benchmarks._figures import loglog
from benchmarks.collocated import Collocated, Collocation, solve
from benchmarks.machine import headed
from vehsim import Mark, World
from vehsim.batch.sweep import load_shots
from vehsim.planning.problem.transcription import Transcription
from vehsim.world.obstacles.obstacles import box

ROOT = Path(__file__).resolve().parents[1]
SEGMENTS, WORLDS = (8, 16, 32, 64, 128), 10
FIGURES = {
    "nh_fig_2": ("CPU time of a solve [s]", 0),
    "nh_fig_3": ("objective, relative distance from its optimum", 1),
    "nh_fig_4": ("executed: distance from the goal [m]", 2),
    "nh_fig_5": ("executed: mean distance from the plan [m]", 3),
}
"""Name -> what it shows, and its column."""
SCHEMES = {
    "DMOC, order 2": (Transcription, 2),
    "DMOC, order 4": (Transcription, 4),
    "trapezoidal": (lambda vehicle: Collocation(vehicle, "trapezoidal"), 2),
    "Hermite-Simpson": (lambda vehicle: Collocation(vehicle, "hermite-simpson"), 2),
}
"""Scheme -> how it transcribes a vehicle, and the order of the layout."""
REST = (0.0, 0.0, 0.0)
HEAD = [
    "# DMOC and collocation in ten random worlds, measured",
    "",
    "NH Figs. 2 to 5 (`benchmarks/worlds.py`). Worlds of the robot and of the simple car are those of",
    "`examples/robot_worlds.toml` and `examples/simple_car_worlds.toml`; the helicopter flies between random towers.",
    "The cost is effort. The optimum is the cost of order 4 on 256 segments. Means are over worlds in which all",
    "schemes end near that optimum (within 30 %): elsewhere they pass an obstacle on different sides. CPU times",
    "include the guess by A*, building and the execution of the controls, which are the same work for all schemes.",
    "",
    "| vehicle | N | scheme | solved | worlds compared | CPU (s) | cost over optimum, less 1 | off the goal (m) "
    "| off the plan, mean (m) |",
    "|---|---|---|---|---|---|---|---|---|",
]


def ground(example: str, last: int) -> Iterator[tuple[World, list[Mark]]]:
    """The worlds of an example's sweep, with a known last frame."""
    for shot in load_shots(ROOT / "examples" / f"{example}.toml"):
        first, goal = shot.file.vehicle[0].motion.mark
        yield (
            shot.world,
            [
                Mark(1, position=tuple(first.position), heading=0, velocity=REST),
                Mark(last, position=tuple(goal.position), heading=0, velocity=REST),
            ],
        )


def towers() -> Iterator[tuple[World, list[Mark]]]:
    """Towers of random size and place between a helicopter and its goal."""
    for seed in range(WORLDS):
        chance = np.random.default_rng(seed)
        obstacles = [
            box(
                f"tower {k}",
                (15 + 15 * k, float(chance.uniform(-8, 8)), 0),
                (*map(float, chance.uniform(3, 7, 2)), 80),
                heading=float(chance.uniform(0, 90)),
            )
            for k in range(3)
        ]
        yield (
            World(obstacles=obstacles),
            [
                Mark(1, position=(0, 0, 30), heading=0, velocity=REST),
                Mark(241, position=(60, float(chance.uniform(-10, 10)), 30), heading=0, velocity=REST),
            ],
        )


TASKS: dict[str, Any] = {
    "two_wheeled": lambda: ground("robot_worlds", 361),
    "simple_car": lambda: ground("simple_car_worlds", 385),
    "helicopter_lie": towers,
}
"""Vehicle -> its worlds and marks."""


def main() -> None:
    named, lines, drawn = sys.argv[1:], [], {}
    for name in named or TASKS:
        rows = measured(name)
        for (scheme, n), (solved, compared, means) in rows.items():
            cells = " | ".join([f"{means[0]:.2f}", *(f"{value:.1e}" for value in means[1:])])
            lines.append(f"| {name} | {n} | {scheme} | {solved} of {WORLDS} | {compared} | {cells} |")
            print(lines[-1], flush=True)
        drawn[name] = rows
    if not named:
        text = headed("\n".join([*HEAD, *lines]) + "\n")
        Path(__file__).with_name("RESULTS.worlds.md").write_text(text, encoding="utf-8")
        for figure, (title, column) in FIGURES.items():
            for name, rows in drawn.items():
                curves = {scheme: [(n, abs(rows[scheme, n][2][column])) for n in SEGMENTS] for scheme in SCHEMES}
                loglog(ROOT / "docs" / "papers" / f"{figure}_{name}.svg", f"{name}: {title}", "segments", "", curves)


def measured(name: str) -> dict[tuple[str, int], tuple[int, int, np.ndarray[Any, Any]]]:
    """(scheme, segments) -> the number of worlds solved, the number compared, and the means of the figures' columns."""
    vehicle, worlds = vehsim.load_vehicle(name), list(TASKS[name]())
    ways = {scheme: (make(vehicle), order) for scheme, (make, order) in SCHEMES.items()}
    best = [_solved(*ways["DMOC, order 4"], *world, 256)[0].solution.cost for world in worlds]
    rows = {}
    for n in SEGMENTS:
        tries = {scheme: [_solved(*way, *world, n) for world in worlds] for scheme, way in ways.items()}
        table = {scheme: np.array([_columns(*made, cost) for made, cost in zip(answers, best, strict=True)])
                 for scheme, answers in tries.items()}  # fmt: skip
        same = np.all([np.abs(columns[:, 1]) < 0.3 for columns in table.values()], axis=0)
        for scheme, columns in table.items():
            solved = sum(made.solution.success for made, _ in tries[scheme])
            means = columns[same].mean(axis=0) if same.any() else np.full(4, np.nan)
            rows[scheme, n] = solved, int(same.sum()), means
    return rows


def _solved(
    transcription: Transcription, order: int, world: World, marks: list[Mark], n: int
) -> tuple[Collocated, float]:
    """One solve, and its CPU time, s, with the guess and the execution of the controls."""
    options = {"world": world, "cost": "effort", "clearance": 0.1}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = time.process_time()
        made = solve(transcription, marks, n, order, **options)
    return made, time.process_time() - began


def _columns(made: Collocated, seconds: float, best: float) -> list[float]:
    """The columns of the figures; nan if it was not solved."""
    if not made.solution.success:
        return [np.nan] * 4
    return [seconds, made.solution.cost / best - 1, made.executed.final, made.executed.mean]


if __name__ == "__main__":
    main()
