"""Planning measured: building, free space, canyon, replanning, random goals.

``python -m benchmarks.planning [PART ...]`` prints a table and writes ``RESULTS.planning.md`` beside this file. Every
row says wall and CPU seconds (on a busy machine only the second means anything), what came out, and its target; the
load of the machine stands above.
"""

from __future__ import annotations

import os
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import vehsim
from vehsim import Mark
from vehsim.planning import attempt
from vehsim.planning.layout import Layout
from vehsim.planning.problem import build
from vehsim.planning.request import ask
from vehsim.planning.solver import Solver
from vehsim.planning.transcription import Transcription

REST = (0.0, 0.0, 0.0)
CANYON = {"limits": {"speed": 30.0, "bank": np.deg2rad(45.0), "ceiling": 36.0}}
Row = tuple[str, str, Sequence[float], Sequence[float], str]
"""What, target, wall s, CPU s, what came out."""


def _timed(work: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[Any, float, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    answer = work(*arguments, **options)
    return answer, time.perf_counter() - wall, time.process_time() - cpu


def building() -> Iterator[Row]:
    """A vehicle differentiated, and problems built from it at any length."""
    for name in ("helicopter", "car"):
        vehicle = vehsim.load_vehicle(name)
        marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark(97, position=(20, 4, 0), velocity=REST)]
        request = ask(vehicle, None, marks, fps=24, segments=8)
        t, wall, cpu = _timed(_first, vehicle, request)
        yield f"{name}: differentiated, first problem built", "0.3 s", [wall], [cpu], ""
        for n in (16, 64, 256):
            _, wall, cpu = _timed(_built, t, request, n)
            yield f"{name}: problem of {n} segments built", "0.1 s", [wall], [cpu], ""


def _first(vehicle: Any, request: Any) -> Transcription:
    t = Transcription(vehicle)
    _built(t, request, 8)
    return t


def _built(t: Transcription, request: Any, segments: int) -> Solver:
    return Solver(build(t, Layout(t.sizes, (segments,)), request, None), max_iterations=200)


def free_space() -> Iterator[Row]:
    """The helicopter to random goals from a straight line: as asked, and refined until its controls lead there."""
    helicopter, rng = vehsim.load_vehicle("helicopter"), np.random.default_rng(7)
    goals = [(rng.uniform([-100, -100, 30], [100, 100, 90]), rng.uniform(-180, 180)) for _ in range(50)]
    for refine, target in ((False, "0.2 s median, 50 of 50"), (True, "")):
        walls, cpus, met = [], [], 0
        for goal, heading in goals:
            start = Mark(1, position=(0, 0, 50), heading=0, velocity=REST)
            marks = [start, Mark("free", position=goal, heading=heading, velocity=REST)]
            plan, wall, cpu = _timed(vehsim.plan, helicopter, None, marks, segments=64, refine=refine)
            met += plan.success and (not refine or plan.executed.final < attempt.EXECUTED)
            walls.append(wall)
            cpus.append(cpu)
        yield f"helicopter N=64, free space, {'executed' if refine else 'planned'}", target, walls, cpus, f"{met} of 50"


def canyon() -> Iterator[Row]:
    """Rest to rest through the shipped canyon, 1 m clear, certified and executed; the field from its cache."""
    helicopter, world = vehsim.load_vehicle("helicopter"), vehsim.World(terrain="canyon")
    marks = [
        Mark(1001, position=(0, 0, 30), heading=0, velocity=REST),
        Mark(1433, position=(180, 40, 28), velocity=REST),
    ]
    world.distance_field()
    for n, refine, target in ((64, False, ""), (128, False, "4 s"), (256, False, "5 s"), (128, True, "")):
        plan, wall, cpu = _timed(vehsim.plan, helicopter, world, marks, segments=n, refine=refine, **CANYON)
        out = f"{plan.success}, {plan.iterations} iterations, {plan.clearance:.2f} m clear, order {plan.order}"
        yield f"canyon N={n}, {'executed' if refine else 'planned'}", target, [wall], [cpu], out
        if n == 64:
            yield from _replans("canyon N=64", plan, marks, "300 ms", 5)


def _replans(name: str, plan: Any, marks: list[Mark], target: str, count: int) -> Iterator[Row]:
    """Warm answers to a last mark moved by a metre in some direction."""
    rng, walls, cpus, met, defect = np.random.default_rng(3), [], [], 0, 0.0
    flat = plan.clip.vehicle.group.dim == 3
    for _ in range(count + 1):
        way = rng.standard_normal(3) * [1, 1, not flat]
        goal = np.asarray(marks[-1].position) + way / np.linalg.norm(way)
        moved = [*marks[:-1], Mark(marks[-1].frame, position=goal, heading=marks[-1].heading, velocity=REST)]
        again, wall, cpu = _timed(plan.replan, moved)
        walls.append(wall)
        cpus.append(cpu)
        met += again.success
        defect = max(defect, again.defect)
    yield f"{name} replanned", target, walls[1:], cpus[1:], f"{met} of {count + 1}, defect below {defect:.0e}"


def replanning() -> Iterator[Row]:
    """A mark moved by a metre; the first answer, which builds, is left out."""
    for name, n, frame, goal, target in (
        ("helicopter", 16, 121, (40, 10, 35), "40 ms at the 90th percentile"),
        ("car", 64, 193, (40, 10, 0), "40 ms median"),
    ):
        vehicle = vehsim.load_vehicle(name)
        height = goal[2] and 30.0
        start = Mark(1, position=(0, 0, height), heading=0, velocity=REST)
        marks = [start, Mark(frame, position=goal, heading=20.0, velocity=REST)]
        plan = vehsim.plan(vehicle, None, marks, segments=n, refine=False)
        yield from _replans(f"{name} N={n}", plan, marks, target, 20)


PARTS = {"building": building, "free": free_space, "canyon": canyon, "replan": replanning}


def main() -> None:
    warnings.simplefilter("ignore")
    asked = sys.argv[1:] or list(PARTS)
    lines = [
        "# Planning, measured",
        "",
        f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start; one thread, no compiler.",
        "",
        "| what | wall, median (90 %) | CPU, median (90 %) | target | |",
        "|---|---|---|---|---|",
    ]
    for part in asked:
        for what, target, walls, cpus, out in PARTS[part]():
            cells = [f"{np.median(v):.3f} ({np.quantile(v, 0.9):.3f})" for v in (walls, cpus)]
            lines.append(f"| {what} | {cells[0]} | {cells[1]} | {target} | {out} |")
            print(lines[-1], flush=True)
    lines += ["", f"Load {os.getloadavg()[0]:.1f} at the end."]
    Path(__file__).with_name("RESULTS.planning.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
