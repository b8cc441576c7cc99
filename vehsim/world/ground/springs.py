"""The springs between a body and its wheels: how it lags behind the ground, and leans with acceleration."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from vehsim.rig.rig import Suspension
from vehsim.world.ground.wheels import Wheel

Array = NDArray[np.float64]

LARGEST_LEAN = 0.2
"""Largest pitch or roll by acceleration, rad."""


def deflections(times: Array, rest: Array, lean: Array, springs: Suspension, loop: bool = False) -> Array:
    """Coordinates (n, k) of a body relative to its ``rest`` (n, k) on the wheels, from equilibrium at the start; in a
    ``loop``, they end as they begin.

    A damped oscillator for each, ``d'' + 2 zeta omega d' + omega^2 d = omega^2 lean - rest''``, stepped exactly with
    ``rest`` linear between samples. ``lean`` (n, k): the equilibrium under the current acceleration and gravity.
    """
    omega, zeta = 2 * np.pi * springs.frequency, springs.damping
    load = omega**2 * lean
    steps = np.diff(times)
    slopes = np.diff(rest, axis=0) / steps[:, None]
    kicks = np.diff(slopes, axis=0, prepend=slopes[-1:] if loop else slopes[:1])

    def swung(d: Array, rate: Array) -> tuple[Array, Array]:
        path = [d]
        for h, kick, a, b in zip(steps.tolist(), kicks, load[:-1], load[1:], strict=True):
            flow = _oscillator(round(h, 12), omega, zeta)
            level = (a + b) / (2 * omega**2)
            offset, rate = d - level, rate - kick
            d, rate = level + flow[0][0] * offset + flow[0][1] * rate, flow[1][0] * offset + flow[1][1] * rate
            path.append(d)
        return np.array(path), rate

    start = np.array([load[0] / omega**2, np.zeros(rest.shape[1])])
    path, rate = swung(*start)
    if not loop:
        return path
    # what a lap leaves of a change at its start
    lap = np.array(_oscillator(round(float(times[-1] - times[0]), 12), omega, zeta))
    return swung(*start + np.linalg.solve(np.eye(2) - lap, [path[-1], rate] - start))[0]


@lru_cache(maxsize=256)
def _oscillator(h: float, omega: float, zeta: float) -> list[list[float]]:
    """The matrix (2, 2) that advances (d, d') by ``h`` s in ``d'' + 2 zeta omega d' + omega^2 d = 0``."""
    from scipy.linalg import expm

    flow: list[list[float]] = expm(h * np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]])).tolist()
    return flow


def lean_of(along: Array, across: Array, wheels: Sequence[Wheel], springs: Suspension) -> Array:
    """Equilibrium (n, 3) of the springs under a force ``along`` and ``across`` the body (n,), per mass, m/s^2: heave
    zero, pitch and roll rad."""
    lean = np.zeros((len(along), 3))
    centres = np.array([wheel.centre for wheel in wheels])
    length, width = ((centres[:, :2] - centres[:, :2].mean(axis=0)) ** 2).mean(axis=0)
    stiffness = (2 * np.pi * springs.frequency) ** 2
    if length > 1e-4:
        lean[:, 1] = -springs.mass_height * along / (stiffness * length)
    if width > 1e-4:
        lean[:, 2] = springs.mass_height * across / (stiffness * width)
    return np.clip(lean, -LARGEST_LEAN, LARGEST_LEAN)
