"""CPU time of random plans in the default character, over that of another version of vehsim.

``python -m benchmarks.solve_time OTHER_PYTHON [--seeds 0-5] [--vehicles boat,car]`` plans random problems with this
version and with the one that ``OTHER_PYTHON`` imports, a problem at a time in turns, and prints a line per class. With
all vehicles it writes ``RESULTS.solve_time.md`` beside this file.

Run as a script, this file plans the problems that it is asked for and prints them as JSON. It then imports nothing of
this repository but what every version since 7a8cadaa has.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

PACE = {
    "helicopter": 7.0, "car": 4.0, "boat": 2.5, "two_wheeled": 0.5, "truck": 2.5, "simple_car": 4.0, "snakeboard": 0.5,
}  # fmt: skip
"""Unhurried mean speeds, m/s."""
REACH = {
    "helicopter": (60, 200), "car": (25, 80), "boat": (30, 120), "two_wheeled": (4, 16), "truck": (40, 90),
    "simple_car": (25, 80), "snakeboard": (1, 6),
}  # fmt: skip
"""Distances from the first to the last mark, m."""
SIZE = {
    "helicopter": 8.0, "car": 1.0, "boat": 1.2, "two_wheeled": 0.15, "truck": 1.5, "simple_car": 1.0, "snakeboard": 0.2
}  # fmt: skip
"""For obstacles: about half the width, m."""
KINDS = {
    **dict.fromkeys(("plain", "hurried", "way", "hold", "free"), tuple(PACE)),
    "wind": ("helicopter", "boat"),
    "obstacles": ("helicopter", "car", "boat", "two_wheeled", "truck", "simple_car"),
    "terrain": ("helicopter", "car", "truck"),
}
"""Kinds of problems, and the vehicles that have them."""
REST = (0.0, 0.0, 0.0)
FPS = 24
RUNS = 2
"""How often each problem is planned, unless on terrain: other programs make the machine slower for a while."""


def problem(vehicle: str, kind: str, seed: int) -> dict[str, Any]:
    """The arguments of `vehsim.plan` but the vehicle."""
    import vehsim
    from vehsim import Mark

    rng = np.random.default_rng([seed, sorted(PACE).index(vehicle)])
    length, flies = rng.uniform(*REACH[vehicle]), vehicle == "helicopter"
    bearing, turn = rng.uniform(-0.6, 0.6), rng.uniform(-40, 40)
    slack = rng.uniform(1.3, 1.8) * (0.75 if kind == "hurried" else 1.0)
    seconds = length / PACE[vehicle] * slack + (3.0 if vehicle == "snakeboard" else 0.0)
    seconds = 1.5 * seconds + 2.0 if kind == "hold" else seconds  # it stops on the way
    goal = length * np.array([math.cos(bearing), math.sin(bearing)])
    heading = math.degrees(bearing) + turn
    heights = [30.0, 30.0 + rng.uniform(-10, 10)] if flies else [0.0, 0.0]

    def mark(share: float, place: Any, height: float, **more: Any) -> Any:
        return Mark(1 + round(FPS * seconds * share), position=(*map(float, place), height), **more)

    first = mark(0, (0, 0), heights[0], heading=0.0, velocity=REST)
    last = mark(1, goal, heights[1], heading=heading, velocity=REST)
    between, asked, world = [], {}, None
    if kind in ("way", "hold"):
        aside = rng.uniform(-0.12, 0.12) * length * np.array([-math.sin(bearing), math.cos(bearing)])
        rests = {"velocity": REST, "hold": 2 * FPS} if kind == "hold" else {}
        between = [mark(rng.uniform(0.45, 0.55), goal / 2 + aside, sum(heights) / 2, **rests)]
    if kind == "free":
        last = Mark("free", position=last.position, heading=heading, velocity=REST)
    if kind == "wind":
        angle, speed = rng.uniform(-math.pi, math.pi), rng.uniform(2, 8)
        world = vehsim.World(wind=(speed * math.cos(angle), speed * math.sin(angle), 0.0))
    if kind == "terrain":
        world = vehsim.World(terrain=_hills(rng))
        ground = world.terrain.height(np.array([[0.0, 0.0], goal]))
        if flies:
            first, last = (
                Mark(one.frame, position=(*one.position[:2], float(z) + 15.0), heading=one.heading, velocity=REST)
                for one, z in zip((first, last), ground, strict=True)
            )
    if kind == "obstacles":
        world = vehsim.World(obstacles=_obstacles(rng, SIZE[vehicle], length, goal, flies))
        asked["clearance"] = 1.0 if flies else 0.4 * SIZE[vehicle]
    return {"world": world, "marks": [first, *between, last], **asked}


def _obstacles(rng: Any, size: float, length: float, goal: Any, tall: bool) -> list[Any]:
    try:
        from vehsim.world.obstacles.obstacles import box
    except ModuleNotFoundError:  # an old version
        from vehsim.world.obstacles import box

    found: list[Any] = []
    ahead = goal / np.linalg.norm(goal)
    for i in range(int(rng.integers(2, 7))):
        along, aside = rng.uniform(0.1, 0.9) * length, rng.uniform(-0.25, 0.25) * length
        centre = along * ahead + aside * np.array([-ahead[1], ahead[0]])
        width = size * rng.uniform(1.0, 3.0, 2)
        if min(np.linalg.norm(centre), np.linalg.norm(centre - goal)) > np.linalg.norm(width) + 5 * size:
            found.append(box(f"b{i}", (*centre, 0.0), (*width, 60.0 if tall else 2.0), heading=rng.uniform(0, 180)))
    return found


def _hills(rng: Any) -> Any:
    """Smooth heights over 480 x 480 m around the first mark."""
    try:
        from vehsim.world.terrain.terrain import Terrain
    except ModuleNotFoundError:
        from vehsim.world.terrain import Terrain

    n, cell = 97, 5.0
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    k[0, 0] = np.inf
    heights = np.real(np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) * k**-1.8 * np.exp(-((k / 0.04) ** 2))))
    heights = (heights - heights.min()) / np.ptp(heights) * 15.0
    return Terrain("hills", heights, (-240.0, -240.0), (cell, cell))


def timed(loaded: Any, vehicle: str, kind: str, seed: int) -> dict[str, Any]:
    """One problem of a vehicle planned."""
    import vehsim

    arguments = problem(vehicle, kind, seed)
    row: dict[str, Any] = {"class": f"{vehicle}, {kind}", "seed": seed}
    begun = time.process_time()
    try:
        made = vehsim.plan(loaded, **arguments)
    except Exception as error:  # an old version may refuse what a new one accepts
        row |= {"success": False, "message": str(error)}
    else:
        row |= {"success": bool(made.success), "iterations": made.iterations, "message": made.message}
        row["normal"] = getattr(made, "character", "normal") == "normal"
    return row | {"cpu": time.process_time() - begun}


def answer() -> None:
    """Plan each problem that a line of the standard input names, and print it as JSON."""
    import vehsim

    loaded: dict[str, Any] = {}
    for line in sys.stdin:
        vehicle, kind, seed = json.loads(line)
        if vehicle not in loaded:
            loaded[vehicle] = vehsim.load_vehicle(vehicle)
        print(json.dumps(timed(loaded[vehicle], vehicle, kind, seed)), flush=True)


def compared(pythons: list[str], vehicles: list[str], seeds: list[int]) -> tuple[list[dict[str, Any]], ...]:
    """The rows of each version. They plan a problem at a time in turns, `RUNS` times, and the least time counts; before
    it, one of its class that is not counted, as it loads libraries and builds derivatives."""
    rows: tuple[list[dict[str, Any]], ...] = tuple([] for _ in pythons)
    for vehicle in vehicles:
        sides = [_started(python) for python in pythons]
        for kind in (kind for kind, having in KINDS.items() if vehicle in having):
            for side in sides:
                _ask(side, vehicle, kind, 1000 + seeds[0])
            for seed in seeds:
                runs = 1 if kind == "terrain" else RUNS
                tried = [[_ask(side, vehicle, kind, seed) for side in sides] for _ in range(runs)]
                for found, answers in zip(rows, zip(*tried, strict=True), strict=True):
                    found.append(min(answers, key=lambda answer: answer["cpu"]))
        for side in sides:
            side.communicate()
        print(vehicle, *(sum(row["cpu"] for row in found) for found in rows), flush=True)
    return rows


def _started(python: str) -> subprocess.Popen[str]:
    """A process of one version that answers `_ask`."""
    command, folder = [python, __file__, "--answer"], Path(python).parents[2]
    return subprocess.Popen(command, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _ask(side: subprocess.Popen[str], *problem: str | int) -> dict[str, Any]:
    assert side.stdin is not None and side.stdout is not None
    side.stdin.write(json.dumps(problem) + "\n")
    side.stdin.flush()
    row: dict[str, Any] = json.loads(side.stdout.readline())
    return row


HEAD = """# Solve time against an old version, measured

{heading}
`python -m benchmarks.solve_time OTHER_PYTHON` plans random problems from rest to rest in the default character, with
this version and with commit {other}, whose character is a stunt, a problem at a time in turns. The numbers are CPU
seconds of `vehsim.plan` in a warm process, the less of two runs, on terrain of one; the first plan of each class is not
counted. *Hurried* has three quarters of the time of *plain*; *way* has a mark to pass on the way, *hold* a rest of two
seconds there; *free*: the planner chooses the last frame; *wind*: 2 to 8 m/s; *obstacles*: two to six boxes around the
way; *terrain*: hills of 15 m. Ratios are those of problems that both versions solve, if this one keeps to the character
`normal`; where marks leave too little time for it, it tries several characters.

Of {count} such problems, {within} take at most 1.5 times the CPU time; the median ratio is {median:.2f}. All together
take {total:.2f} times the CPU time. Classes whose median is above 1.5: {slow}.
Plans above 1.5: {above}.

| class | ratio, median | most | all | CPU, median s: old | new | iterations: old | new | solved: old | new | normal |
|---|---|---|---|---|---|---|---|---|---|---|
"""


def page(old: list[dict[str, Any]], new: list[dict[str, Any]], other: str) -> str:
    """The page of results."""
    from benchmarks.machine import heading

    rows, ratios, slow, above, sums = [], [], [], [], np.zeros(2)
    for name in dict.fromkeys(row["class"] for row in new):
        pairs = [(a, b) for a, b in zip(old, new, strict=True) if b["class"] == name]
        both = [(a, b) for a, b in pairs if a["success"] and b["success"] and b["normal"]]
        solved = [sum(row["success"] for row in side) for side in zip(*pairs, strict=True)]
        rest = f"{solved[0]} of {len(pairs)} | {solved[1]} | {sum(b.get('normal', False) for _, b in pairs)}"
        if not both:
            rows.append(f"| {name} | | | | | | | | {rest} |")
            continue
        cpu = np.array([[a["cpu"], b["cpu"]] for a, b in both])
        ratio, (before, now) = cpu[:, 1] / cpu[:, 0], np.median(cpu, axis=0)
        steps = np.median([[a["iterations"], b["iterations"]] for a, b in both], axis=0)
        rows.append(
            f"| {name} | {np.median(ratio):.2f} | {ratio.max():.2f} | {cpu[:, 1].sum() / cpu[:, 0].sum():.2f} "
            f"| {before:.2f} | {now:.2f} | {steps[0]:.0f} | {steps[1]:.0f} | {rest} |"
        )
        ratios.extend(ratio)
        above += [f"{name}, {b['seed']} ({r:.2f})" for (_, b), r in zip(both, ratio, strict=True) if r > 1.5]
        sums += cpu.sum(axis=0)
        if np.median(ratio) > 1.5:
            slow.append(name.replace(", ", " "))
    head = HEAD.format(
        heading="\n".join(heading()), other=other, count=len(ratios), within=int(np.sum(np.array(ratios) <= 1.5)),
        median=np.median(ratios), total=sums[1] / sums[0], slow=", ".join(slow) or "none",
        above="; ".join(above) or "none",
    )  # fmt: skip
    return head + "\n".join(rows) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("python")
    parser.add_argument("--seeds", default="0-5")
    parser.add_argument("--vehicles", default=",".join(PACE))
    parser.add_argument("--other", default="7a8cadaa")
    options = parser.parse_args()
    low, high = map(int, options.seeds.split("-"))
    vehicles = options.vehicles.split(",")
    sides = compared([options.python, sys.executable], vehicles, list(range(low, high + 1)))
    text = page(*sides, options.other)
    print(text)
    if vehicles == list(PACE):
        Path(__file__).with_name("RESULTS.solve_time.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--answer"]:
        warnings.simplefilter("ignore")
        answer()
    else:
        main()
