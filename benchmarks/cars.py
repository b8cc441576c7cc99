"""LIE Fig. 5: a car's position error and run time over one minute of random controls, against RK2 and RK4."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from vehsim.integrators import Integrator
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.phase import packed
from vehsim.integrators.references import reference_step
from vehsim.vehicles import State
from vehsim.vehicles.models.car import car

STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125)
FINE = 0.0015625
OURS = {"exp": ("exp", 2), "cay": ("cay", 2), "TLN": ("tln", 2), "order 4": ("tln", 4)}
REFERENCES = {"RK2": "rk2", "RK4": "rk4"}
RADIUS = 0.32
SECONDS = np.arange(1, 61)


def cars(runs: int) -> dict[str, Any]:
    """Method -> step -> (position error m, seconds per step interpreted, as machine code)."""
    vehicle = car(
        mass=1350.0, wheel_inertia=2.4, yaw_inertia=4100.0, wheel_radius=RADIUS, wheelbase=2.6, half_track=0.77
    )
    drives = _drives(runs)
    kernels = {
        (name, compiled): Kernel(reference_step(vehicle, method), compiled)
        for name, method in REFERENCES.items()
        for compiled in (False, True)
    }

    def run(name: str, h: float, speed: float, knots: np.ndarray, compiled: bool) -> tuple[np.ndarray, float]:
        n = round(60 / h)
        at = np.arange(n + 1) * h
        controls = np.column_stack([np.interp(at, STEPS[0] * np.arange(len(knots)), column) for column in knots.T])
        if name in OURS:
            integrator = Integrator(vehicle, h, *OURS[name], compiled=compiled)
            start = packed(integrator.start(State(twist=(0, speed, 0)), controls[0]))
            begin = time.process_time()
            x = integrator.history(start, controls)
        else:
            x = np.empty((n + 1, 6))
            x[0] = [0, 0, 0, 0, 0, speed / RADIUS]
            h_, wind = np.broadcast_to(np.array([h]), (n, 1)), np.broadcast_to(np.zeros(3), (n, 3))
            begin = time.process_time()
            kernels[name, compiled].rows([x[:-1], h_, controls[:-1], controls[1:], wind], [x[1:]], carries=True)
        clock = time.process_time() - begin
        return x[np.round(SECONDS / h).astype(int), 1:3], clock / n

    truths = [run("RK4", FINE, speed, knots, False)[0] for speed, knots in drives]
    table: dict[str, Any] = {}
    for name in (*OURS, *REFERENCES):
        table[name] = {}
        for h in STEPS:
            for compiled in (False, True):
                run(name, h, *drives[0], compiled)
            plain = [run(name, h, *drive, False) for drive in drives]
            error = np.mean([np.linalg.norm(r[0] - t, axis=1).mean() for r, t in zip(plain, truths, strict=True)])
            built = min(run(name, h, *drive, True)[1] for drive in drives[:10])
            table[name][str(h)] = [float(error), min(r[1] for r in plain), built]
        print(name, {h: [f"{v:.2g}" for v in row] for h, row in table[name].items()}, flush=True)
    return {"runs": runs, "table": table}


def _drives(count: int) -> list[tuple[float, np.ndarray]]:
    """Speed m/s at the start, and controls at the knots of the coarsest step, linear between, the same for all
    methods."""
    rng, knots, drives = np.random.default_rng(521), np.arange(round(60 / STEPS[0]) + 1) * STEPS[0], []
    for _ in range(count):
        a, b, w1, w2, p = rng.uniform((200, 0.05, 0.3, 0.3, 0), (1500, 0.5, 1.5, 1.5, 6.28))
        controls = np.column_stack([a * np.sin(w1 * knots + p), b * np.cos(w2 * knots)])
        drives.append((float(rng.uniform(1, 8)), controls))
    return drives
