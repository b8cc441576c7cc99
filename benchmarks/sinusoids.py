"""Random start and goal pairs for every system steered by sinusoids, judged by an integrator of another house.

``python -m benchmarks.sinusoids [--pairs 1000]`` prints a table: how many pairs were steered, the largest end error
when the returned inputs are integrated by scipy's DOP853, and CPU time a pair. What could not be steered
counts as such.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.integrate import solve_ivp

from vehsim.errors import VehsimError
from vehsim.sinusoids import models
from vehsim.sinusoids.canonical import steer_chained, steer_first_degree, steer_second_degree
from vehsim.sinusoids.feedback import car_triangular
from vehsim.sinusoids.fourier import steer_triangular
from vehsim.sinusoids.trailers import steer_trailers


def end_error(steering) -> float:
    """Largest difference from the goal by DOP853, stage by stage, the fields evaluated one state at a time."""
    x, system = np.asarray(steering.start, float), steering.system
    for stage in steering.stages:

        def rate(t, x, stage=stage):
            return system.matrix(x) @ stage.inputs(np.array([t]))[0]

        longest = stage.duration / (6 * max(1, stage.cycles))
        x = solve_ivp(rate, (0, stage.duration), x, "DOP853", rtol=1e-11, atol=1e-12, max_step=longest).y[:, -1]
    return float(np.abs(x - steering.goal).max())


def pair(rng, *bounds):
    """Two states (n,) between minus and plus ``bounds``."""
    return rng.uniform(-1, 1, (2, len(bounds))) * bounds


def trailer_pair(rng, count):
    """Within 10 m, any car heading to 60 degrees, hitches to 30, steering to 23."""
    ends = np.zeros((2, 4 + count))
    ends[:, :2], ends[:, 2] = rng.uniform(-10, 10, (2, 2)), rng.uniform(-0.4, 0.4, 2)
    ends[:, 3] = rng.uniform(-1.05, 1.05, 2)
    for k in range(count):
        ends[:, 4 + k] = ends[:, 3 + k] + rng.uniform(-0.5, 0.5, 2)
    return ends


SYSTEMS = {
    "first degree, m = 3": (lambda r: pair(r, *[1.0] * 6), lambda a, b: steer_first_degree(3, a, b)),
    "second degree, m = 3": (
        lambda r: pair(r, *[1.0] * models.second_degree(3).n),
        lambda a, b: steer_second_degree(3, a, b),
    ),
    "chained, n = 5": (lambda r: pair(r, *[1.0] * 5), lambda a, b: steer_chained(5, a, b)),
    "hopper": (lambda r: pair(r, 1.0, 0.5, 1.0), lambda a, b: steer_triangular(models.hopper(), a, b)),
    "car, Fourier": (
        lambda r: pair(r, 5.0, 2.0, 0.6, 0.5),
        lambda a, b: steer_triangular(car_triangular(2.6), a, b, amplitude=2.6),
    ),
    **{
        f"{count} trailers": (
            lambda r, n=count: trailer_pair(r, n),
            lambda a, b, n=count: steer_trailers([1.5] * n, a, b),
        )
        for count in range(6)
    },
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--only", default="", help="systems whose name has this in it")
    wanted = parser.parse_args()
    print(f"{'system':24} {'steered':>12} {'largest error':>14} {'ms a pair':>10}")
    for name, (draw, steer) in SYSTEMS.items():
        if wanted.only not in name:
            continue
        rng, errors, spent = np.random.default_rng(0), [], 0.0
        for _ in range(wanted.pairs):
            start, goal = draw(rng)
            begun = time.process_time()
            try:
                steering = steer(start, goal)
            except VehsimError:
                continue
            finally:
                spent += time.process_time() - begun
            errors.append(end_error(steering))
        worst, each = max(errors, default=np.nan), spent / wanted.pairs * 1e3
        print(f"{name:24} {len(errors):5} of {wanted.pairs:4} {worst:14.1e} {each:10.0f}")


if __name__ == "__main__":
    main()
