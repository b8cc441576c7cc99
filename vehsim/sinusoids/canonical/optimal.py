"""Brockett's optimal inputs between general end points: ``u = e^{As} u_0`` with A skew (SIN sec. 2).

For two inputs the extremal is an arc of a circle, and one bracketed equation gives its angle. For more, the arcs of all
planes are continued to the required areas, with Newton's method at every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from vehsim.errors import SolveError
from vehsim.sinusoids.system import Array

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(96)


def extremal(displacement: Array, areas: Array) -> tuple[Array, Array]:
    """``A`` (m, m) skew and ``u_0`` (m,) that move by ``displacement`` (m,) and enclose ``areas`` (m, m) skew.

    Raises ``SolveError`` if the continuation ends before the areas are reached.
    """
    size = float(np.sqrt(displacement @ displacement + np.abs(areas).max()))
    if size == 0:
        return np.zeros_like(areas), np.zeros_like(displacement)
    d, y = displacement / size, areas / size**2  # the system's own dilation
    if np.abs(d).max() < 1e-13:
        a, u0 = closed_loop(y)
    elif len(d) == 2:
        turn, u0 = _arc(d, y[0, 1])
        a = np.array([[0.0, -turn], [turn, 0.0]])
    else:
        a, u0 = _continued(d, y)
    return a, u0 * size


def closed_loop(areas: Array) -> tuple[Array, Array]:
    """``A`` (m, m) skew and ``u_0`` (m,) of the least-effort closed loop with these areas: ``u = e^{As} u_0``."""
    m = len(areas)
    a, u0 = np.zeros((m, m)), np.zeros(m)
    for k, (area, e, f) in enumerate(area_planes(areas), 1):
        # k turns of a circle of radius r enclose k pi r^2
        turn = math.tau * k * np.sign(area)
        a += turn * (np.outer(f, e) - np.outer(e, f))
        u0 += math.tau * k * np.sqrt(abs(area) / (np.pi * k)) * e
    return a, u0


def motion(a: Array, u0: Array) -> tuple[Array, Array]:
    """Displacement (m,) and areas (m, m) of ``e^{As} u_0`` for s from 0 to 1."""
    values, vectors = np.linalg.eigh(1j * a)
    weights = vectors.conj().T @ u0
    s, w = (_NODES + 1) / 2, _WEIGHTS / 2
    phase = -1j * np.outer(s, values)
    u = np.real(np.exp(phase) * weights @ vectors.T)
    # (e^z - 1) / z, smooth at 0
    growth = np.where(np.abs(phase) < 1e-8, 1 + phase / 2, np.expm1(phase) / np.where(phase == 0, 1, phase))
    x = np.real(s[:, None] * growth * weights @ vectors.T)
    areas = (x * w[:, None]).T @ u
    return w @ u, (areas - areas.T) / 2


def _arc(d: Array, area: float, turns: int = 1) -> tuple[float, Array]:
    """Dido's arc over the chord ``d`` (2,): its signed angle and its initial velocity (2,).

    ``area (8 sin^2(w/2)) = chord^2 (w - sin w)``: the angle w just below ``turns`` full turns if there is one, else the
    only one below a full turn.
    """
    from scipy.optimize import brentq

    chord, wanted = float(np.hypot(*d)), abs(area)
    if wanted < 1e-15 * chord**2:
        return 0.0, d.copy()

    def gap(w: float) -> float:
        return 8 * wanted * np.sin(w / 2) ** 2 - chord**2 * (w - np.sin(w))

    full = math.tau * turns
    low = full - np.pi
    if turns == 1 or gap(low) <= 0:
        # near zero: 2 wanted w^2 = chord^2 w^3 / 6
        full, low = math.tau, min(1e-3, 6 * wanted / chord**2) if chord else 1e-3
    w = brentq(gap, low, full, xtol=1e-15, rtol=1e-15) if chord > 1e-9 * np.sqrt(wanted) else full
    speed = w * chord / (2 * np.sin(w / 2)) if w < 1 else w * np.sqrt(2 * wanted / (w - np.sin(w)))
    turn = w * np.sign(area)
    angle = np.arctan2(d[1], d[0]) - turn / 2
    return turn, speed * np.array([np.cos(angle), np.sin(angle)])


def _guess(d: Array, y: Array) -> tuple[Array, Array]:
    """An arc in every plane of the areas, with the smallest possible angles, and straight along the rest."""
    a, u0, rest = np.zeros_like(y), np.zeros_like(d), d.copy()
    for k, (area, e, f) in enumerate(area_planes(y), 1):
        turn, first = _arc(np.array([e @ d, f @ d]), area, k)
        a += turn * (np.outer(f, e) - np.outer(e, f))
        u0 += first[0] * e + first[1] * f
        rest -= (e @ d) * e + (f @ d) * f
    return a, u0 + rest


def area_planes(areas: Array) -> list[tuple[float, Array, Array]]:
    """A skew matrix as areas in orthogonal planes, largest first: (area, e, f), e and f orthonormal (m,)."""
    from scipy.linalg import schur

    block, q = schur(areas, output="real")
    planes, i = [], 0
    while i < len(areas) - 1:
        if abs(block[i, i + 1]) > 1e-14 * np.abs(areas).max():
            planes.append((float(block[i, i + 1]), q[:, i], q[:, i + 1]))
            i += 1
        i += 1
    return sorted(planes, key=lambda plane: -abs(plane[0]))


def _continued(d: Array, y: Array) -> tuple[Array, Array]:
    """Continue from the guess, which is an extremal for its own areas, to the required areas."""
    m = len(d)
    pairs = np.triu_indices(m, 1)

    def unpack(p: Array) -> tuple[Array, Array]:
        a = np.zeros((m, m))
        a[pairs] = p[: len(pairs[0])]
        return a - a.T, p[len(pairs[0]) :]

    a, u0 = _guess(d, y)
    unknowns = np.concatenate([a[pairs], u0])
    moved, enclosed = motion(a, u0)

    def gap(p: Array, share: float) -> Array:
        d_, y_ = motion(*unpack(p))
        wanted = (1 - share) * enclosed + share * y
        return np.concatenate([(y_ - wanted)[pairs], d_ - (1 - share) * moved - share * d])

    share, step, tangent = 0.0, 0.25, np.zeros_like(unknowns)
    while share < 1:
        step = min(step, 1 - share)
        trial = _newton(partial(gap, share=share + step), unknowns + step * tangent)
        if trial is None:
            step /= 2
            if step < 1e-4:
                raise SolveError(
                    f"lost the extremal at {share:.4f} of the wanted areas",
                    "steer in two stages (optimal=False), which is exact",
                    key="optimal",
                )
            continue
        tangent, unknowns = (trial - unknowns) / step, trial
        share += step
        step *= 1.5
    return unpack(unknowns)


def _newton(gap: Callable[[Array], Array], start: Array) -> Array | None:
    """Newton with central differences; None if it does not converge."""
    p = start.copy()
    for _ in range(12):
        value = gap(p)
        if np.abs(value).max() < 3e-14:
            return p
        h = 1e-6
        columns = [(gap(p + h * e) - gap(p - h * e)) / (2 * h) for e in np.eye(len(p))]
        change = np.linalg.lstsq(np.array(columns).T, -value, rcond=1e-12)[0]
        if np.abs(change).max() > 2.0:
            return None
        p += change
    return p if np.abs(gap(p)).max() < 1e-12 else None
