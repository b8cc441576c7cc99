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
    slopes = np.diff(rest, axis=0) / np.diff(times)[:, None]
    kicks = np.diff(slopes, axis=0, prepend=slopes[-1:] if loop else slopes[:1])
    start = np.array([lean[0], np.zeros(rest.shape[1])])
    path = _swung(times, lean, kicks, springs, start)
    if loop:  # what a lap leaves of a change at its start
        lap = _flow(float(times[-1] - times[0]), springs)
        start = start + np.linalg.solve(np.eye(2) - lap, path[-1] - start)
        path = _swung(times, lean, kicks, springs, start)
    return path[:, 0]


def followed(times: Array, aim: Array, springs: Suspension, start: Array, end: Array | None = None) -> Array:
    """The motion (n,) of a damped oscillator that follows ``aim`` (n,) from the state ``start`` (value, rate) on; with
    ``end``, to that state.

    An oscillator's own motion decays from its start; to reach ``end``, such a motion is added from either end, the
    later one backwards in time.
    """
    begun = np.array([aim[0], 0.0])
    level, kicks = aim[:, None], np.zeros((len(aim) - 1, 1))
    if end is None:
        return _swung(times, level, kicks, springs, start[:, None])[:, 0, 0]
    path = _swung(times, level, kicks, springs, begun[:, None])[:, :, 0]
    turned, lap = np.diag([1.0, -1.0]), _flow(float(times[-1] - times[0]), springs)
    both = np.block([[np.eye(2), turned @ lap], [lap, turned]])
    missing = np.linalg.solve(both, np.concatenate([start - path[0], end - path[-1]]))
    still = np.zeros((len(aim), 1))
    ahead = _swung(times, still, kicks, springs, missing[:2, None])[:, 0, 0]
    back = _swung(times[-1] - times[::-1], still, kicks, springs, missing[2:, None])[::-1, 0, 0]
    return path[:, 0] + ahead + back


def _swung(times: Array, level: Array, kicks: Array, springs: Suspension, start: Array) -> Array:
    """States (n, 2, k) of oscillators about a ``level`` (n, k), the mean of both ends during a step, from ``start``
    (2, k); ``kicks`` (n - 1, k): what their rates lose before every step."""
    state, path = start, [start]
    for h, kick, middle in zip(np.diff(times).tolist(), kicks, (level[:-1] + level[1:]) / 2, strict=True):
        flow = _oscillator(round(h, 12), 2 * np.pi * springs.frequency, springs.damping)
        offset, rate = state[0] - middle, state[1] - kick
        state = np.array([middle + flow[0][0] * offset + flow[0][1] * rate, flow[1][0] * offset + flow[1][1] * rate])
        path.append(state)
    return np.array(path)


def _flow(seconds: float, springs: Suspension) -> Array:
    return np.array(_oscillator(round(seconds, 12), 2 * np.pi * springs.frequency, springs.damping))


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
