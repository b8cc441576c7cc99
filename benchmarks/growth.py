"""How CPU time and memory grow with a shot's size: ``make bench-growth`` (half an hour) writes ``RESULTS.growth.md``.

Each size runs in a process of its own, with one thread; solved motion is not taken from the cache.
``python -m benchmarks.growth FAMILY ...`` runs some families and only prints them.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.bench_export import Watch
from benchmarks.machine import headed

PHASES = ("check", "solve", "export")
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PXR_WORK_THREAD_LIMIT"), "1")
LIMIT = 1.2
HEAD = '[shot]\nschema = 1\nname = "{name}"\n{more}\n'
CAR = """[[vehicle]]
name = "car_{k}"
asset = "car"
[vehicle.motion]
method = "simulate"
duration = {seconds}
commands = [
    {{ frame = 1001, steering_rate = 0.05 }},
    {{ frame = 1024, steering_rate = 0.05 }},
    {{ frame = 1025, steering_rate = 0.0 }},
]
[vehicle.motion.start]
position = [{x}, {y}, 0]
velocity = [6, 0, 0]
"""
CHASE = '[camera]\nrig = "chase"\ntarget = "{target}"\n'
BOAT = """[world.water]
choppiness = 0.7
[[world.water.wave]]
height = 0.3
length = 12
heading = 196
[[world.water.wave]]
height = 0.2
length = 7.3
heading = 232
[[vehicle]]
name = "boat"
asset = "boat"
[vehicle.motion]
method = "simulate"
duration = {seconds}
commands = [{{ frame = 1001, thrust = 2800, steering = 3 }}]
[vehicle.motion.start]
velocity = [6, 0, 0]
"""
PLANNED = """[[vehicle]]
name = "one"
asset = "{asset}"
[vehicle.motion]
method = "plan"
segments = {segments}
{more}
[[vehicle.motion.mark]]
frame = 1001
position = {start}
heading = 0
velocity = [0, 0, 0]
[[vehicle.motion.mark]]
frame = {frame}
position = {goal}
heading = 0
velocity = [0, 0, 0]
"""


def frames_car(size: int) -> str:
    """A simulated car on flat ground, in circles, with a chase camera; by frames."""
    world = '[world]\nterrain = "flat"\n'
    return (
        HEAD.format(name="s", more=world) + CAR.format(k=0, seconds=size / 24, x=0, y=0) + CHASE.format(target="car_0")
    )


def frames_boat(size: int) -> str:
    """A simulated boat in waves, in circles, with a chase camera; by frames."""
    return HEAD.format(name="s", more="") + BOAT.format(seconds=size / 24) + CHASE.format(target="boat")


def clips(size: int) -> str:
    """A batch of simulated cars of 4 s, one worker; by clips."""
    sweep = f'[sweep]\n"vehicle.car_0.motion.start.velocity[0]" = {{ from = 4.0, to = 8.0, count = {size} }}\n'
    return HEAD.format(name="s", more="") + CAR.format(k=0, seconds=4, x=0, y=0) + sweep


def vehicles(size: int) -> str:
    """Simulated cars of 10 s on flat ground, 30 m apart; by vehicles."""
    cars = "".join(CAR.format(k=k, seconds=10, x=30 * (k % 8), y=30 * (k // 8)) for k in range(size))
    return HEAD.format(name="s", more='[world]\nterrain = "flat"\n') + cars


def segments_helicopter(size: int) -> str:
    """A planned helicopter in free space, 256 frames; by segments."""
    given = {"start": [0, 0, 10], "goal": [60, 10, 15], "frame": 1257, "more": ""}
    return HEAD.format(name="s", more="") + PLANNED.format(asset="helicopter", segments=size, **given)


def segments_car(size: int) -> str:
    """A planned car between six obstacles, 256 frames; by segments."""
    return _field(6, size, "car", [0, 0, 0], [40, 6, 0])


def obstacles_car(size: int) -> str:
    """A planned car with 64 segments through a field of posts that grows around it; by obstacles."""
    return _field(size, 64, "car", [0, 0, 0], [40, 6, 0])


def obstacles_helicopter(size: int) -> str:
    """A planned helicopter with 64 segments through a field of columns that grows around it; by obstacles."""
    return _field(size, 64, "helicopter", [0, 0, 10], [60, 18, 10], spread=3.0, height=25.0)


def _field(
    size: int, segments: int, asset: str, start: list[int], goal: list[int], spread: float = 1.0, height: float = 1.5
) -> str:
    """Round obstacles on a lattice of 8 x 6 m times ``spread``, the nearest ones to the middle of the way."""
    middle = (start[0] + goal[0]) / 2, (start[1] + goal[1]) / 2
    lattice = [(8 * spread * (i + 0.5), 6 * spread * (j + 0.5)) for i in range(-20, 21) for j in range(-20, 21)]
    near = sorted(lattice, key=lambda at: (math.dist(at, middle), at))[:size]
    posts = "".join(
        f'[[world.obstacle]]\nshape = "ellipse"\ncentre = [{x}, {y}]\nradii = [0.6, 0.9]\nheight = {height}\n'
        for x, y in near
    )
    given = {"start": start, "goal": goal, "frame": 1257, "more": "clearance = 0.3"}
    return HEAD.format(name="s", more='[world]\nterrain = "flat"\n' + posts) + PLANNED.format(
        asset=asset, segments=segments, **given
    )


FAMILIES: dict[str, tuple[Callable[[int], str], tuple[int, ...]]] = {
    "frames_car": (frames_car, (2500, 5000, 10_000, 20_000)),
    "frames_boat": (frames_boat, (625, 1250, 2500, 5000)),
    "clips": (clips, (125, 250, 500, 1000)),
    "vehicles": (vehicles, (6, 12, 25, 50)),
    "segments_helicopter": (segments_helicopter, (64, 128, 256, 512)),
    "segments_car": (segments_car, (64, 128, 256, 512)),
    "obstacles_car": (obstacles_car, (25, 50, 100, 200)),
    "obstacles_helicopter": (obstacles_helicopter, (25, 50, 100, 200)),
}
"""Name -> text of the shot file of a size, and sizes."""


@dataclass(frozen=True)
class Cost:
    """CPU seconds of a phase, and the largest resident memory until its end, MB."""

    seconds: float
    memory: float


def measure(name: str, size: int, cache: Path) -> dict[str, Cost]:
    """The cost of each phase of a shot in its own process; of a batch, that of the whole command and its worker."""
    with tempfile.TemporaryDirectory(prefix="growth-") as folder:
        file = Path(folder) / "s.toml"
        file.write_text(FAMILIES[name][0](size), encoding="utf-8")
        export = ["-m", "vehsim", "export", str(file), "--out", folder, "--to", "usd", "--workers", "1", "--quiet"]
        command = export if name == "clips" else ["-m", "benchmarks.growth", "--phases", str(file)]
        environment = os.environ | ONE_THREAD | {"VEHSIM_CACHE": str(cache), "VEHSIM_CACHE_GB": "0"}
        with subprocess.Popen([sys.executable, *command], env=environment, stdout=subprocess.PIPE) as process:
            watch = Watch(process.pid)
            said = process.communicate()[0]
            (_, _, worker), seconds = watch.end()
        if process.returncode:
            raise SystemExit(f"{name} {size}: exit code {process.returncode}")
        if name == "clips":
            return {"export": Cost(seconds, worker)}
        return {phase: Cost(*cost) for phase, cost in json.loads(said).items()}


def phases(file: Path) -> dict[str, tuple[float, float]]:
    """Run the phases of a shot in this process; their CPU seconds and memory so far, MB."""
    from vehsim import Shot

    costs, kept = {}, [Path(file)]

    def check() -> None:
        shot = Shot.load(file)
        assert not [problem for problem in shot.check() if problem.severity == "error"]
        kept.append(shot)

    work: dict[str, Callable[[], Any]] = {
        "check": check,
        "solve": lambda: kept.append(kept[-1].solve(checked=True, cached=False)),
        "export": lambda: kept[-1].export(file.parent / "out", to=("usd",)),
    }
    for phase, run in work.items():
        begin = time.process_time()
        run()
        spent = time.process_time() - begin
        costs[phase] = spent, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return costs


def exponent(sizes: Sequence[int], values: Sequence[float]) -> float:
    """p of ``values`` that grow like sizes^p, over the last two doublings; nan if they are not above zero."""
    return math.log(values[-1] / values[-3]) / math.log(sizes[-1] / sizes[-3]) if min(values) > 0 else math.nan


def rows(name: str, cache: Path) -> Iterator[str]:
    """A row of the table for the CPU time and for the memory of each phase of a family."""
    sizes = FAMILIES[name][1]
    measure(name, 1 + sizes[0] // 32, cache)  # compiles and converts what all sizes share
    costs = [measure(name, size, cache) for size in (1 + sizes[0] // 32, *sizes)]
    for phase in costs[0]:
        for unit, digits, of in (("CPU, s", 1, "seconds"), ("memory, MB", 0, "memory")):
            smallest, *values = (getattr(cost[phase], of) for cost in costs)
            own = [value - smallest for value in values]
            grows = values[-1] > 1.5 * smallest
            cells = [name, phase, unit, *(f"{value:.{digits}f}" for value in (smallest, *values))]
            found = [f"{exponent(sizes, each):.2f}" for each in (values, own)] if grows else ["flat", "flat"]
            yield "| " + " | ".join([*cells, *found]) + " |"


def main() -> None:
    words = sys.argv[1:]
    if words[:1] == ["--phases"]:
        print(json.dumps(phases(Path(words[1]))))
        return
    lines = [
        "| family | phase | | smallest | 1/8 | 1/4 | 1/2 | full | exponent | less the smallest |",
        "|" + "---|" * 10,
    ]
    print(*lines, sep="\n")
    with tempfile.TemporaryDirectory(prefix="growth-cache-") as cache:
        for name in words or FAMILIES:
            for row in rows(name, Path(cache)):
                print(row, flush=True)
                lines.append(row)
    if not words:
        about = [f"- `{name}`, {sizes[-1]:,}: {text.__doc__}" for name, (text, sizes) in FAMILIES.items()]
        page = "\n".join([HEADER, *lines, "", "Families, and their full size:", "", *about, "", NOTES])
        Path(__file__).with_name("RESULTS.growth.md").write_text(headed(page), encoding="utf-8")


HEADER = """# Growth with the size of a shot

`make bench-growth`. CPU time and peak memory of each phase at an eighth, a quarter, half and all of the full size. The
exponents are those of the last two doublings, of the whole cost and of the cost less that of the smallest shot (a 256th
of the full size), which starts Python and loads libraries. `flat`: the full size costs less than 1.5 times the
smallest. Memory is the largest of the process so far, so an export that needs less than solving shows that of solving.
"""
NOTES = """## What exceeds 1.2

- `segments_helicopter`, solve, less the smallest: 1.28; the whole cost: 1.07. The last solve, at order 4, takes 5
  iterations with 128 segments, 20 with 256 and 7 with 512, at 0.10, 0.16 and 0.39 s of CPU time each, and 512 segments
  are reached over 256. The smallest shot asks for 3 segments; the planner uses 16, so it costs more than its share.

No other exponent does. The export of `frames_boat` had 1.23 until a box of a fixed size followed each boat and its wake
took two thirds of the time: 1.12 and 1.13 now.

## Limits of these measurements

- Boats are measured up to 5,000 frames, not 20,000. At the rates of the last doubling (18 ms to solve a frame, 49 ms
  and 0.5 MB to export it), 20,000 frames would take 23 minutes and 11 GB; they were not run.
- A shot of 20,000 frames with a car needs 2.4 GB. Its growth is linear: 110 kB per frame, most of it for the contact
  of wheels with the ground and for the corners that the camera keeps in the picture, for all frames at once.
- Planned shots have 256 frames; segments and obstacles grow, not their way.
"""


if __name__ == "__main__":
    main()
