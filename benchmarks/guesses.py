"""Plans started from sinusoids compared with plans started from a straight line, over random pairs.

``python -m benchmarks.guesses [--trucks 20] [--parks 20]`` prints a table and writes ``RESULTS.guesses.md`` beside this
file: a truck reverses its trailer into a bay, and a car parks in a gap between two others. Each plan has the duration
of the sinusoids, joints straight at both ends, and effort as its cost.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np

import vehsim
from benchmarks.machine import headed
from vehsim import Mark
from vehsim.errors import VehsimError
from vehsim.sinusoids.manoeuvres.guess import initial_guess
from vehsim.world.obstacles.obstacles import box
from vehsim.world.world import World

HEAD = """# Sinusoids as an initial guess, measured

`python -m benchmarks.guesses` compares three initial guesses. *Straight*: the straight line between the marks; *own*:
the default of `plan`, a path around obstacles; *sinusoid*: `vehsim.sinusoids.manoeuvres.guess`. Iterations and CPU
seconds, including those for the guess, are medians over the pairs that all three solved. *Cheaper* counts the pairs
among these whose final cost is at least 1 % below that from the straight line.

| task | pairs | guess | solved | iterations | CPU, s | cheaper |
|---|---|---|---|---|---|---|
"""
GUESSES = ("straight", "own", "sinusoid")


def bay(rng):
    """A truck's pair: from the street into a bay behind it, rotated by up to 90 degrees."""
    start, goal = (20 + rng.uniform(-5, 5), 0, 0), (-8 + rng.uniform(-4, 4), rng.uniform(-12, 12), 0)
    return start, goal, rng.uniform(-90, 90), None


def gap(rng):
    """A car's pair: from ahead of a gap 2.4 to 4.4 m longer than the car into its middle."""
    ahead = 2.1 + 2.15 + rng.uniform(1.2, 2.2)
    boxes = [box(name, (x, -2.3, 0), (4.3, 1.8, 1.2)) for name, x in (("behind", -ahead), ("ahead", ahead))]
    return (rng.uniform(4, 9), rng.uniform(0, 2), 0), (0, -2.3, 0), 0.0, World().with_obstacles(boxes)


def compare(vehicle, draw, count):
    """Success, iterations, cost and CPU seconds (pairs, guesses, 4)."""
    rng, rows = np.random.default_rng(1), []
    joints = dict.fromkeys(vehicle.joints[1:], 0.0)
    while len(rows) < count:
        start, goal, heading, world = draw(rng)
        rest = {"velocity": (0, 0, 0), "joints": joints}
        marks = [Mark(1001, position=start, heading=0.0, **rest), Mark(1002, position=goal, heading=heading, **rest)]
        begun = time.process_time()
        path = initial_guess(vehicle, marks, world, 0.15)
        made = time.process_time() - begun
        seconds = np.abs(np.hypot(*np.diff(path[:, :2], axis=0).T)).sum() / 1.0 + 5.0
        marks[1] = Mark(1001 + round(24 * seconds), position=goal, heading=heading, **rest)
        guesses = {"straight": np.array([start, goal], float), "own": None, "sinusoid": path}
        row = []
        for name in GUESSES:
            begun = time.process_time()
            found = vehsim.plan(
                vehicle, world, marks, clearance=0.15, guess=guesses[name], refine=False, character="stunt"
            )
            spent = time.process_time() - begun + (made if name == "sinusoid" else 0.0)
            row.append((found.success, found.iterations, found.cost, spent))
        rows.append(row)
        print(vehicle.name, len(rows), row, flush=True)
    return np.array(rows, float)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trucks", type=int, default=20)
    parser.add_argument("--parks", type=int, default=20)
    wanted = parser.parse_args()
    warnings.simplefilter("ignore")
    lines = []
    for task, name, draw, count in (
        ("trailer into a bay", "truck", bay, wanted.trucks),
        ("car into a gap", "car", gap, wanted.parks),
    ):
        try:
            rows = compare(vehsim.load_vehicle(name), draw, count)
        except VehsimError as error:
            raise SystemExit(f"{task}: {error}") from None
        both = rows[:, :, 0].all(axis=1)
        for k, guess in enumerate(GUESSES):
            cheaper = int(np.sum(rows[both, k, 2] < 0.99 * rows[both, 0, 2]))
            iterations, spent = np.median(rows[both, k][:, [1, 3]], axis=0) if both.any() else (np.nan, np.nan)
            solved = int(rows[:, k, 0].sum())
            ended = f"{solved} | {iterations:.0f} | {spent:.1f} | {cheaper} of {both.sum()}"
            lines.append(f"| {task} | {count} | {guess} | {ended} |")
    print(*lines, sep="\n")
    Path(__file__).with_name("RESULTS.guesses.md").write_text(headed(HEAD + "\n".join(lines) + "\n"))


if __name__ == "__main__":
    main()
