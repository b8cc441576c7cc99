"""Planning measured: building, free space, canyon, obstacles, replanning, random goals.

``python -m benchmarks.planning [PART ...]`` prints a table and writes ``RESULTS.planning.md`` beside this file. Every
row says wall and CPU seconds (on a busy machine only the second means anything), what came out, and its target; the
load of the machine stands above.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

import vehsim
from vehsim import Mark
from vehsim.planning import attempt
from vehsim.planning.layout import Layout
from vehsim.planning.problem import build
from vehsim.planning.request import ask
from vehsim.planning.solver import Solver
from vehsim.planning.transcription import Transcription
from vehsim.world.obstacles import ellipse, polygon

REST = (0.0, 0.0, 0.0)
CANYON = {"limits": {"speed": 30.0, "bank": np.deg2rad(45.0), "ceiling": 36.0}}
_CANYON_MARKS = [
    Mark(1001, position=(0, 0, 30), heading=0, velocity=REST),
    Mark(1433, position=(180, 40, 28), velocity=REST),
]
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
        functions = list(build(t, Layout(t.sizes, (64,)), request, None).functions().values())
        kept = [function.serialize() for function in functions]
        _, wall, cpu = _timed(lambda files: [ca.Function.deserialize(file) for file in files], kept)
        size = f"{sum(map(len, kept)) / 1e6:.1f} MB"
        yield f"{name}: the same of 64 segments, read back as another process built it", "", [wall], [cpu], size


def _first(vehicle: Any, request: Any) -> Transcription:
    t = Transcription(vehicle)
    _built(t, request, 8)
    return t


def _built(t: Transcription, request: Any, segments: int) -> Solver:
    solver = Solver(build(t, Layout(t.sizes, (segments,)), request, None), max_iterations=200)
    solver.prepare("guess")
    return solver


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
    helicopter, world, marks = vehsim.load_vehicle("helicopter"), vehsim.World(terrain="canyon"), _CANYON_MARKS
    world.distance_field()
    for n, refine, target in ((64, False, ""), (128, False, "4 s"), (256, False, "5 s"), (128, True, "")):
        plan, wall, cpu = _timed(vehsim.plan, helicopter, world, marks, segments=n, refine=refine, **CANYON)
        out = f"{plan.success}, {plan.iterations} iterations, {plan.clearance:.2f} m clear, order {plan.order}"
        yield f"canyon N={n}, {'executed' if refine else 'planned'}", target, [wall], [cpu], out
        if n == 64:
            yield from _replans("canyon N=64", plan, marks, "300 ms", 5)


def cold() -> Iterator[Row]:
    """The canyon with nothing cached: the field measured, the way sought, the plan made."""
    kept = os.environ.get("VEHSIM_CACHE")
    with tempfile.TemporaryDirectory() as empty:
        os.environ["VEHSIM_CACHE"] = empty
        world = vehsim.World(terrain="canyon")
        plan, wall, cpu = _timed(_flown, world, 256)
    os.environ.pop("VEHSIM_CACHE")
    os.environ.update({"VEHSIM_CACHE": kept} if kept else {})
    yield "canyon N=256, nothing cached", "10 s", [wall], [cpu], f"{plan.success}, {plan.clearance:.2f} m clear"


def _flown(world: Any, segments: int) -> Any:
    return vehsim.plan(
        vehsim.load_vehicle("helicopter"), world, _CANYON_MARKS, segments=segments, refine=False, **CANYON
    )


def obstacles() -> Iterator[Row]:
    """A car through ten random obstacles, 0.5 m clear, certified."""
    car, walls, cpus, met = vehsim.load_vehicle("car"), [], [], 0
    marks = [Mark(1, position=REST, heading=0, velocity=REST), Mark(241, position=(60, 0, 0), heading=0, velocity=REST)]
    for seed in range(10):
        world = vehsim.World(obstacles=_yard(seed))
        plan, wall, cpu = _timed(vehsim.plan, car, world, marks, segments=64, refine=False, clearance=0.5)
        met += plan.success
        walls.append(wall)
        cpus.append(cpu)
    yield "car N=64 among 10 obstacles", "0.5 s", walls, cpus, f"{met} of 10"


def _yard(seed: int) -> list[Any]:
    rng = np.random.default_rng(seed)
    found: list[Any] = []
    while len(found) < 10:
        centre, radius = rng.uniform([4, -12], [56, 12]), rng.uniform(1, 3)
        if min(np.linalg.norm(centre), np.linalg.norm(centre - [60, 0])) < radius + 5:
            continue
        if len(found) % 2:
            found.append(ellipse(f"e{len(found)}", centre, (radius, 0.6 * radius), heading=rng.uniform(0, 180)))
        else:
            angles = np.sort(rng.uniform(0, 2 * np.pi, 5))
            ring = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
            found.append(polygon(f"p{len(found)}", ring))
    return found


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


NOTES = """
## What was tried

- **Multipliers.** Replans start from those of the last plan at a barrier of 1e-6: 7 or 8 iterations in the canyon where
  the motion alone takes 15 to 20, 4 where it takes 7 in free space. Where they mislead, the motion alone is tried, then
  a plan from scratch. Carried to a finer or higher discretisation they spare a third of the iterations in free space
  (order 4: 4 for 6); between rocks they cost (N=64: 29 for 22, N=256: 41 for 22): what pushes there lies elsewhere.
- **Sight.** Those who refine a motion see rock within 4 m beyond the clearance of it: two places in five. What is run
  through unseen is seen, and the solve begins again. An iteration at N=256: 63 ms for 103.
- **Common subexpressions** found before differentiating: Hessians a fifth to a third shorter, built as quickly.
- **MUMPS**: other orderings (AMF, PORD, METIS, QAMD, automatic), scalings and pivot tolerances: none is faster by more
  than the noise. Mehrotra's algorithm did not converge.
- **Barrier of first solves**: monotone from 1e-1 or 1e-2, probing and LOQO oracles against the adaptive quality
  function we keep. Monotone from 1e-2 solved the ten fields of obstacles in 520 iterations for 605, but the easy ones
  in more, and the canyon in 170 for 71.
- **Coarse levels solved to 1e-3 only** save about five iterations a level, a sixth of the solves of N=128. Not taken:
  a plan that runs out of time there would have a defect of 1e-4.
- **Barrier of finer solves**: 1e-5 for 1e-4 takes 22 iterations for 39 to N=256, the others as many; 1e-6 the same.
  Bounds pushed less far, other dual steps, other starts of multipliers, no refinement of steps: none is better by more
  than the noise. Fourfold where that leads on (32 to 128 to 256): 97 iterations for 120. At loads of 8 to 20, canyon
  N=256 took 3.3, 4.0 and 4.0 s of CPU time.
- **Coarse levels to 1e-3 or 1e-4 with constraints to 1e-9**: one or two iterations a level; not taken.
- **Field**: 6.3 s of CPU time were triangles sought from 1.3 million points, two thirds of them for points farther than
  any plan looks. Now these measure to where the corners of a cell twice as wide find the surface: 2.5 s; in the air up
  to 1 cm too far on average, in the rock up to 15, 1.5 m at worst, midway between crags. Cubic interpolation there
  would be off by 7 to 12 cm, either way.
- **Time limits** of 0.5 s: canyon N=64 and 256 0.52, helicopter N=256 0.49, cars 0.47 and 0.51 s of CPU time (for 0.63,
  0.62, 1.23, 0.61 and 0.54); of 1 s at most 1.04.
- **Time limits of the first plan of a process**, wall clock, N=128, three to five runs each, nothing else running: car
  among ten obstacles 0.5 s: 0.40 to 0.52 (0.69 to 0.97 before, mostly loading; 0.58 where the vehicle was never seen),
  helicopter in free space 0.5 s: 0.48 to 0.51, canyon 1 s: 0.79 to 1.00 (1.07 to 1.19 before), 2 s: 1.47 to 1.99,
  solved on 32 to 128 segments as before. What is left of loading: scipy for the way round obstacles (0.17 s) and in the
  canyon (0.25 s), MuJoCo's model (0.12 s). USD (0.2 s) is no longer loaded for vehicles that are known. Without time to
  solve, nothing is built.
- **Fewer levels** to N=128: 32 to 128 at once as long, 128 directly 4.0 and 4.3 s for 2.5 and 2.6.
- **Built problems shared between processes** (a thousand clips): a helicopter's is read back in 48 to 72 ms and
  built in 38; in the canyon, where the field is part of it, 367 ms and 48 MB for 70 ms; a car's in 10 for 19, without
  the 13 ms to write it, the disk and the checks. So each worker builds its own, once a shape of marks, and keeps it.
- **Cars among obstacles**: the median of the table's ten fields was 0.77 s of CPU time (0.45 to 0.67 since, at
  loads of 15 to 20), of ten others 0.30 for 0.51,
  all twenty solved and certified. Only features that can be nearest are rows, 654 to 716 for 915 to 1038 in easy
  fields; distances enter by value, slope and bend, so that Hessians take a fifth to an eighth; certification measures
  exactly only where bounds do not say enough: 0.03 to 0.09 s for 0.05 to 0.38. Not taken: features 1 or 3 m beyond
  the nearest for 2, parts 4 or 5 m away for 3 (a quarter fewer iterations, as much time).
- **What is run through unseen** is seen where it is near, not at every knot, and twice as far about the guess, along
  which knots slide: a car between four walls in turn got stuck after 929 iterations, now it is through after 376. The
  second solve begins at a barrier of 3e-3; A* measures only as far as its price reaches. Not taken: going on from the
  motion that ran through (up to 99 iterations for 43), 3e-3 in every first solve (28 fields in 949 iterations for 1157
  and a fifth less time, the same median, but cars park otherwise).
- **Gates for helicopters** (10.8 m across the rotor): routes were sought for a ball about all spheres, 15.9 m across.
  Where that has no way a ball as wide as the rotor looks for one: a partition with a gate of 15 m is flown through,
  13 m is refused by the route's grid. Given a path as guess, the same eight spheres pass 13 m and 24 spheres 12.5 m,
  banked; height is where they are coarse: 10 m passes, 9 m does not (3.3 m of helicopter), nor do 7 m with 24 spheres.
  So no more spheres: they cost twice the time. Where there is a way round, it is still the one taken.
"""

PARTS = {
    "building": building, "free": free_space, "canyon": canyon, "cold": cold, "obstacles": obstacles,
    "replan": replanning,
}  # fmt: skip


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
    lines += ["", f"Load {os.getloadavg()[0]:.1f} at the end.", NOTES]
    Path(__file__).with_name("RESULTS.planning.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
