"""Exact steering of the canonical systems: Brockett's, its second-degree extension, chained form (SIN sec. 2 and 3).

Each works between arbitrary states. Amplitudes follow from the requested displacement in closed form or by a linear
solve. Brockett's optimal inputs between general end points are in `optimal.py`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from itertools import combinations, product
from math import factorial
from typing import Any, Literal

import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.canonical.optimal import closed_loop, extremal
from vehsim.sinusoids.laws import Law
from vehsim.sinusoids.models import chained, first_degree, second_degree, second_degree_triples
from vehsim.sinusoids.steering import Stage, Steering, integrate
from vehsim.sinusoids.system import Array, DriftlessSystem

Waves = Mapping[int, tuple[int, Callable[[Array], Array]]]
"""Input -> frequency, and sine or cosine."""

EXACT = 1e-9
"""Accuracy of steering for canonical systems, relative to the size of the states."""


def steer_first_degree(m: int, start: Any, goal: Any, *, optimal: bool = False) -> Steering:
    """Brockett's system from ``start`` to ``goal``: straight to the x_i, then one closed loop for all x_ij at once.

    The loop is Brockett's: the skew matrix of required areas splits into planes, the largest area takes frequency 1,
    the next 2, ...; amplitudes in closed form. ``optimal``: instead, one stage ``u = e^{As} u_0`` for everything.
    """
    system, x0, x1 = _ends(first_degree(m), start, goal)
    if optimal:
        a, u0 = extremal(x1[:m] - x0[:m], wanted_areas(m, x0, x1))
        return _exact(system, x0, x1, [Stage("optimal", rotation_law(a, u0), cycles=max(1, m // 2))])
    middle = x0.copy()
    middle[:m] = x1[:m]
    for row, (i, j) in enumerate(combinations(range(m), 2)):
        middle[m + row] += (x0[i] + x1[i]) / 2 * (x1[j] - x0[j])
    stages = _straight(x1[:m] - x0[:m])
    areas = wanted_areas(m, middle, x1)
    if np.abs(areas).max() > 0:
        stages.append(Stage("loop", rotation_law(*closed_loop(areas)), cycles=max(1, m // 2)))
    return _exact(system, x0, x1, stages or [_rest(m)])


def wanted_areas(m: int, x0: Array, x1: Array) -> Array:
    """Skew matrix (m, m) of the areas ``1/2 int (x_i dx_j - x_j dx_i)``, from the start, that lead from x0 to x1."""
    d, areas = x1[:m] - x0[:m], np.zeros((m, m))
    for row, (i, j) in enumerate(combinations(range(m), 2)):
        areas[i, j] = x1[m + row] - x0[m + row] - x0[i] * d[j] - d[i] * d[j] / 2
    return areas - areas.T


def rotation_law(a: Array, u0: Array) -> Law:
    """``u(s) = e^{As} u_0`` for skew ``A``: sinusoids at the frequencies of A's eigenvalues."""
    values, vectors = np.linalg.eigh(1j * a)
    weights = vectors.conj().T @ u0
    return lambda s: np.real(np.exp(-1j * np.outer(s, values)) * weights @ vectors.T)


def steer_second_degree(m: int, start: Any, goal: Any) -> Steering:
    """SIN's three-level algorithm, exact: the x_i straight, then all x_ij by one loop, then each x_ijk by sinusoids.

    A pair's ``x_iji`` and ``x_ijj`` move by frequencies 1 and 2, ``x_ijk`` with three different indices by frequencies
    that resonate only together; every loop leaves the coordinates steered before unchanged.
    """
    system, x0, x1 = _ends(second_degree(m), start, goal)
    triples = second_degree_triples(m)
    below = m + m * (m - 1) // 2
    stages = _straight(x1[:m] - x0[:m])
    x = _after(system, x0, stages)
    areas = wanted_areas(m, x, x1)
    if np.abs(areas).max() > 0:
        stages.append(Stage("areas", rotation_law(*closed_loop(areas)), cycles=max(1, m // 2)))
        x = _after(system, x, stages[-1:])
    missing = dict(zip(triples, x1[below:] - x[below:], strict=True))
    for i, j in combinations(range(m), 2):
        for still, fast, triple in ((i, j, (i, j, i)), (j, i, (i, j, j))):
            law, gain = _pair_loop(m, still, fast)
            stages += _cubic_stage(law, gain(triple), missing[triple], f"x{still + 1}{fast + 1}{still + 1}")
    for i, j, k in combinations(range(m), 3):
        stages += _triple_stages(m, (i, j, k), missing)
    return _exact(system, x0, x1, stages or [_rest(m)])


def _pair_loop(m: int, still: int, fast: int) -> tuple[Any, Any]:
    """``u_still = sin, u_fast = cos of twice the frequency``, and its effect on a triple at unit amplitude."""
    waves: Waves = {still: (1, np.sin), fast: (2, np.cos)}
    return _waves(m, waves), lambda triple: _cubic_effect(waves, triple)


def _triple_stages(m: int, indices: tuple[int, int, int], missing: dict[tuple[int, int, int], float]) -> list[Stage]:
    """Two stages that move ``x_ijk`` and ``x_ikj`` by the missing displacement: a 2 x 2 linear solve for the cubes."""
    i, j, k = indices
    wanted = np.array([missing[i, j, k], missing[i, k, j]])
    families: list[Waves] = [
        {i: (1, np.cos), j: (3, np.cos), k: (4, np.cos)},
        {i: (3, np.cos), j: (1, np.cos), k: (4, np.cos)},
        {i: (4, np.cos), j: (1, np.cos), k: (3, np.cos)},
    ]
    effects = np.array([[_cubic_effect(w, t) for w in families] for t in ((i, j, k), (i, k, j))])
    pairs = list(combinations(range(3), 2))
    best = max(pairs, key=lambda p: abs(np.linalg.det(effects[:, p])))
    cubes = np.linalg.solve(effects[:, best], wanted)
    stages = []
    for family, cube in zip(best, cubes, strict=True):
        stages += _cubic_stage(_waves(m, families[family]), 1.0, cube, f"x{i + 1}{j + 1}{k + 1}", cycles=4)
    return stages


def _waves(m: int, waves: Waves) -> Any:
    """Amplitude -> law: each input of ``waves`` is amplitude x frequency x its wave."""

    def law_of(amplitude: float, sign: float = 1.0) -> Law:
        def law(s: Array) -> Array:
            u = np.zeros((len(s), m))
            for n, (index, (frequency, wave)) in enumerate(waves.items()):
                factor = sign if n == len(waves) - 1 else 1.0
                u[:, index] = factor * amplitude * math.tau * frequency * wave(math.tau * frequency * s)
            return u

        return law

    return law_of


def _cubic_stage(law_of: Any, gain: float, wanted: float, label: str, cycles: int = 2) -> list[Stage]:
    """A loop whose effect is ``gain`` times the cube of its amplitude, odd in the sign of its last input."""
    if wanted == 0:
        return []
    cube = wanted / gain
    amplitude = abs(cube) ** (1 / 3)
    return [Stage(label, law_of(amplitude, float(np.sign(cube))), cycles=cycles, amplitudes={"all": amplitude})]


def _cubic_effect(waves: Waves, triple: tuple[int, int, int]) -> float:
    """Net motion of ``x_ijk`` over a loop of unit waves from the origin; trigonometric polynomials, so exact."""
    s = np.arange(64) / 64

    def rate(index: int) -> Array:
        frequency, wave = waves.get(index, (0, np.cos))
        return math.tau * frequency * wave(math.tau * frequency * s)

    i, j, k = triple
    inner = periodic_integral(rate(i))
    return float(np.mean(periodic_integral(inner * rate(j)) * rate(k)))


def periodic_integral(rate: Array) -> Array:
    """Integral from 0 of the oscillating part of a periodic function sampled over its period 1."""
    spectrum = np.fft.rfft(rate)
    spectrum[0] = 0
    k = np.arange(len(spectrum))
    spectrum[1:] /= 1j * math.tau * k[1:]
    value = np.fft.irfft(spectrum, len(rate))
    return value - value[0]


def steer_chained(
    n: int, start: Any, goal: Any, *, method: Literal["together", "staged"] = "together", amplitude: float | None = None
) -> Steering:
    """Chained form of length n from ``start`` to ``goal``.

    ``"together"``: ``v1 = d + a sin``, ``v2`` a sum of cosines of 0 to n - 2 times its phase, all in one stage: for a
    given ``a`` the rest is a linear solve. Amplitude and first phase, 0 or a right angle, are those of least effort, or
    ``amplitude`` at phase 0. Beyond n = 14, states swing so far that round-off may prevent them from reaching the goal.
    ``"staged"``: SIN's algorithm, one coordinate per stage, ``v1 = a sin, v2 = b cos of k times``, amplitudes in closed
    form.
    """
    system, z0, z1 = _ends(chained(n), start, goal)
    if method == "staged":
        return _exact(system, z0, z1, _chained_stages(n, z0, z1, amplitude))
    if method != "together":
        raise InputError("no such method", "choose 'together' or 'staged'", key="method", value=method)
    d = z1[0] - z0[0]
    if amplitude is None and np.array_equal(z0[1:], z1[1:]) and not np.any(z0[1 : n - 1] * d):
        return _exact(system, z0, z1, _straight(np.array([d, 0.0])) or [_rest(2)])
    if amplitude is None:
        size = max(1.0, abs(d)) * np.geomspace(0.1, 8.0, 24)
        members = product(size, (1.0, -1.0), (0.0, math.tau / 4))
        trials = [_chained_together(n, z0, z1, sign * a, phase) for a, sign, phase in members]
        law = min(trials, key=lambda t: t[1])[0]
    else:
        law = _chained_together(n, z0, z1, amplitude)[0]
    return _exact(system, z0, z1, [Stage("together", law, cycles=max(1, n - 2))])


@lru_cache
def _gauss(count: int) -> tuple[Array, Array]:
    return np.polynomial.legendre.leggauss(count)


def _chained_together(n: int, z0: Array, z1: Array, a: float, phase: float = 0.0) -> tuple[Law, float]:
    """The law and its effort for ``z1(s) = z1(0) + d s + a (cos phase - cos(2 pi s + phase))``.

    With a phase of a right angle, z1 swings to both sides: long chains then need less effort and lose fewer digits.
    """
    nodes, weights = _gauss(40 + 12 * n)
    s, w = (nodes + 1) / 2, weights / 2
    d = z1[0] - z0[0]
    extra = 3 if d else 0
    order = np.arange(n - 1 + extra)
    waves = np.cos(np.outer(order, math.tau * s + phase))
    ahead = d * (1 - s) - a * (np.cos(phase) - np.cos(math.tau * s + phase))  # z1(1) - z1(s)
    # contribution of v2 at s to z_(k+2) at the end: (z1(1) - z1(s))^k / k!
    effect = np.array([ahead**k / factorial(k) for k in range(n - 1)]) * w @ waves.T
    free = [sum(z0[1 + i] * d ** (k - i) / factorial(k - i) for i in range(k + 1)) for k in range(n - 1)]
    wanted = z1[1:] - np.array(free)
    size = np.abs(effect).max(axis=1)
    scale = np.where(size > 0, size, 1.0)  # a sweep without amplitude moves only z1 and z2
    b = np.linalg.lstsq(effect / scale[:, None], wanted / scale, rcond=1e-15)[0]
    b += np.linalg.lstsq(effect / scale[:, None], (wanted - effect @ b) / scale, rcond=1e-15)[0]

    def law(s: Array) -> Array:
        turn = math.tau * s + phase
        return np.column_stack([d + a * math.tau * np.sin(turn), np.cos(np.outer(turn, order)) @ b])

    return law, d**2 + (math.tau * a) ** 2 / 2 + float(w @ (b @ waves) ** 2)


def _chained_stages(n: int, z0: Array, z1: Array, amplitude: float | None) -> list[Stage]:
    stages = _straight(z1[:2] - z0[:2])
    z = z0.copy()
    d, rate = z1[0] - z0[0], z1[1] - z0[1]
    for k in range(n - 2, 0, -1):  # z_(k+2) after constant inputs
        z[k + 1] = sum(z0[1 + i] * d ** (k - i) / factorial(k - i) for i in range(k + 1))
        z[k + 1] += rate * d**k / factorial(k + 1)
    for k in range(1, n - 1):
        wanted = z1[k + 1] - z[k + 1]
        if wanted == 0:
            continue
        # v1 = 2 pi a sin, v2 = b cos(k ...): z_(k+2) moves by b (a/2)^k / k!, and no state below it moves
        cost = k * (wanted * factorial(k)) ** 2 * 4**k / math.tau**2
        a = abs(amplitude) if amplitude else cost ** (1 / (2 * k + 2))
        b = wanted * factorial(k) * (2 / a) ** k
        stages.append(Stage(f"z{k + 2}", _pair(a, b, k), cycles=k, amplitudes={"v1": a, "v2": b}))
        z = _after(chained(n), np.concatenate([z1[:2], z[2:]]) if k == 1 else z, stages[-1:])
    return stages or [_rest(2)]


def _pair(a: float, b: float, k: int) -> Law:
    return lambda s: np.column_stack([math.tau * a * np.sin(math.tau * s), b * np.cos(math.tau * k * s)])


def _straight(displacement: Array) -> list[Stage]:
    """Constant inputs; none if start and goal are equal."""
    if not np.any(displacement):
        return []
    return [Stage("straight", lambda s: np.tile(displacement, (len(s), 1)))]


def _rest(m: int) -> Stage:
    return Stage("rest", lambda s: np.zeros((len(s), m)))


def _after(system: DriftlessSystem, x: Array, stages: list[Stage]) -> Array:
    for stage in stages:
        x = integrate(system, stage, x, np.array([0.0, stage.duration]))[-1]
    return x


def _ends(system: DriftlessSystem, start: Any, goal: Any) -> tuple[DriftlessSystem, Array, Array]:
    return system, system.check_state("start", start), system.check_state("goal", goal)


def _exact(system: DriftlessSystem, x0: Array, x1: Array, stages: list[Stage]) -> Steering:
    size = max(1.0, float(np.abs(x0).max()), float(np.abs(x1).max()))
    return Steering(system, x0, x1, tuple(stages)).checked(EXACT * size)
