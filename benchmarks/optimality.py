"""Effort of sinusoids compared with the least effort between the same states in the same time, over random pairs.

``python -m benchmarks.optimality [--pairs 40]`` prints a table and writes ``RESULTS.optimality.md`` beside this file.
Effort is the integral of the squared inputs over unit time, which is divided optimally between the stages. Brockett's
systems are compared with their optimal inputs, the paper's car with `vehsim.plan` on the same car: a vehicle whose two
controls are the paper's two inputs, started from the sinusoids' path and from a straight line.
"""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np

import vehsim
from benchmarks.machine import headed
from vehsim import Mark
from vehsim.errors import VehsimError
from vehsim.lie import SE2
from vehsim.sinusoids.algebra.feedback import car_chained, car_triangular
from vehsim.sinusoids.canonical.chained import steer_chained, steer_first_degree
from vehsim.sinusoids.canonical.fourier import steer_through, steer_triangular
from vehsim.vehicles import Control, Nonholonomic

HEAD = """# Sinusoids compared with the least effort

{summary}

`python -m benchmarks.optimality` compares the integrals of the squared inputs for the same random states at both ends
and the same time; the time is divided optimally between the stages. *Least* is Brockett's optimum. For the car
(wheelbase 2.6 m, headings within 0.6 rad, the paper's inputs) it is the cheaper of two plans with {segments} segments,
from the sinusoids' path and from a straight line.

| system | pairs | method | times the least effort: median | from | to |
|---|---|---|---|---|---|
"""
WHEELBASE, SECONDS, SEGMENTS = 2.6, 10.0, 192
AMPLITUDES = (1.3, 2.6, -2.6, 4.0, -4.0)


def shares(steering):
    """The square roots of each stage's cost in unit time: the optimal shares of time are proportional to them."""
    return np.array([np.sqrt(replace(steering, stages=(replace(s, duration=1.0),)).effort) for s in steering.stages])


def least(steer, choices):
    """The cheapest steering that works: its effort in unit time, and the steering with this timing, over
    ``SECONDS``."""
    found = []
    for choice in choices:
        try:
            found.append(steer(choice))
        except VehsimError:
            continue
    best = min(found, key=lambda steering: shares(steering).sum())
    part = shares(best)
    return part.sum() ** 2, best.timed(list(SECONDS * part / part.sum()))


def paper_car():
    """A vehicle whose controls are SIN's inputs: the front wheels' speed, m/s, and steering rate, rad/s."""

    def constraints(r):
        turning, ahead = ca.sin(r[1]) / WHEELBASE, ca.cos(r[1])
        return ca.vertcat(ca.horzcat(-turning, 0), ca.horzcat(-ahead, 0), ca.DM([[0, 0]])), ca.DM.eye(3)

    return Nonholonomic(
        name="paper's car",
        group=SE2,
        joints=("way", "phi"),
        lagrangian=lambda r, u, xi: (ca.sumsqr(xi) + ca.sumsqr(u)) / 2,
        constraints=constraints,
        controls=(Control("speed"), Control("steering_rate")),
        rate_controls={"speed": "way", "steering_rate": "phi"},
        joint_limits={"phi": (-1.5, 1.5)},
    )


def planned(vehicle, start, goal, path):
    """The cheapest plan's effort in unit time."""
    marks = [
        Mark(1001 + frame, position=(*q[:2], 0), heading=float(np.degrees(q[2])), joints={"phi": q[3]})
        for frame, q in ((0, start), (round(24 * SECONDS), goal))
    ]
    efforts = []
    for guess in (path, None):
        plan = vehsim.plan(vehicle, None, marks, segments=SEGMENTS, guess=guess, refine=False, character="stunt")
        a, b, h = plan.clip.controls[:-1], plan.clip.controls[1:], np.diff(plan.clip.times)
        if plan.success:
            efforts.append(SECONDS * float(h @ np.sum(a * a + a * b + b * b, axis=1)) / 3)
    return min(efforts)


def brockett(m, count):
    rng, ratios = np.random.default_rng(0), []
    for _ in range(count):
        ends = rng.uniform(-1, 1, (2, m * (m + 1) // 2))
        ratios.append(
            shares(steer_first_degree(m, *ends)).sum() ** 2 / steer_first_degree(m, *ends, optimal=True).effort
        )
    return {"straight, then one loop": ratios}


def cars(count):
    rng, vehicle = np.random.default_rng(0), paper_car()
    triangular, chained = car_triangular(WHEELBASE), car_chained(WHEELBASE)
    ratios: dict[str, list[float]] = {"SIN's loops, the best of five": [], "chained form, the best of six": []}
    for _ in range(count):
        start, goal = rng.uniform(-1, 1, (2, 4)) * [5.0, 2.0, 0.6, 0.5]

        def loops(a, start=start, goal=goal):
            return steer_triangular(triangular, start, goal, amplitude=a)

        def sweep(a, start=start, goal=goal):
            return steer_through(chained, start, goal, lambda z0, z1: steer_chained(4, z0, z1, amplitude=a))

        efforts = least(loops, AMPLITUDES), least(sweep, (None, *AMPLITUDES))
        best = min(efforts, key=lambda found: found[0])[1].states
        optimum = planned(vehicle, start, goal, np.column_stack([best[:, :2], 0 * best[:, 0], best[:, 2]]))
        for (effort, _), row in zip(efforts, ratios.values(), strict=True):
            row.append(effort / optimum)
        print("car", *(f"{row[-1]:.2f}" for row in ratios.values()), flush=True)
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=40)
    count = parser.parse_args().pairs
    warnings.simplefilter("ignore")
    lines, medians = [], []
    for name, found in (
        ("Brockett, m = 2", brockett(2, count)),
        ("Brockett, m = 3", brockett(3, count)),
        ("the paper's car", cars(count)),
    ):
        for method, row in found.items():
            medians.append(f"{np.median(row):.1f} ({name}: {method})")
            lines.append(f"| {name} | {count} | {method} | {np.median(row):.1f} | {min(row):.2f} | {max(row):.1f} |")
    print(*lines, sep="\n")
    Path(__file__).with_name("RESULTS.optimality.md").write_text(
        headed(
            HEAD.format(segments=SEGMENTS, summary=f"Times the least effort, medians: {'; '.join(medians)}.")
            + "\n".join(lines)
            + "\n"
        )
    )


if __name__ == "__main__":
    main()
