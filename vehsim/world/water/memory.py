"""The memory of the water: a state-space model of the waves that a hull radiates.

The kernel of Cummins' equation follows from the damping, ``K(t) = 2 / pi integral B(w) cos(w t) dw`` (Ogilvie 1964).
The eigensystem realization of its samples (Juang and Pappa 1985) gives poles and inputs; the outputs are fitted to
damping and added mass by least squares, such that a constant velocity has no force. Where waves ring between two
hulls, the frequencies do not resolve the kernel; poles then follow from damping and added mass by vector fitting
(Gustavsen and Semlyen 1999).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.vehicles.definition.coefficients import Memory

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

POWERS = (2, 4, 8)
"""Above the highest frequency, damping is a sum of these powers of it, which agrees with the added mass. That of no
motion is negative; differences of neighbouring powers, zero at the highest frequency, let it rise before it falls."""
AGREES = 0.95
"""Share of the highest frequency below which it does: nearer to it, the damping at the highest alone decides."""
HIGHEST = 4.0
"""Up to this multiple of the highest frequency, where damping is negligible."""
FINE = 3
"""Samples of the kernel per half period of the highest frequency."""
LONG = 0.5
"""Length of the kernel, over the period of the difference of two frequencies: later values are not known."""
MOST = 240
"""Most samples of the kernel, halved."""
ORDERS = (4, 6, 8, 10, 12, 16, 20, 24, 28, 32, 40, 48, 56, 64)
"""Orders that are tried, until the error is at most `ERROR`; it must not be larger than `WORST`."""
ERROR, WORST = 0.005, 0.03
SPREADS, GAIN = (0.5, 1.0, 2.0, 4.0), 0.03
"""Widths of peaks in spacings of the frequencies that are tried, until no motion gains more than this."""
FAINT = 0.02
"""The error is relative to the force at each frequency, down to this share of the largest."""
GUESSED = 0.1
"""Weight of frequencies above the highest in the fit."""
POLES = (14, 18, 22, 26, 30)
"""Numbers of poles that are tried where waves ring, until the error is at most `CLOSE`; it must not be larger than
`RINGS`: root mean square of the error at each frequency, relative to the force there, of which faint modes have little.
"""
CLOSE, RINGS = 0.001, 0.05
PEAKED = 0.6
"""Waves ring where frequencies are closer than this share of the largest spacing: added to resolve a peak."""
ROUNDS, NARROW = 10, 0.2
"""Relocations of these poles, and their least damping over the least spacing of the frequencies: narrower peaks are not
resolved, and would ring for ever."""
FAINTEST = 1e-3
"""As `FAINT`, beside a peak a thousand times as high; and the least peak of a state, over the largest of all."""
WEAK = 1e-6
"""Modes with less damping than this share of the strongest, over a lever arm that makes them alike, are left out."""


@dataclass(frozen=True, eq=False)
class Radiation:
    """``damping`` (n, 6, 6) and ``added`` mass (n, 6, 6) at ``omega`` (n,) rad/s: at all frequencies, as functions."""

    omega: Array
    damping: Array
    added: Array

    @property
    def infinite(self) -> Array:
        """The added mass (6, 6) at infinite frequency that agrees with the damping (Ogilvie 1964). That of a panel
        method does not: its error, small beside the added mass, may be large beside what varies with the frequency."""
        return self._fit[1]

    @property
    def excess(self) -> Array:
        """Of the added mass (n, 6, 6) over that at infinite frequency."""
        return self.added - self.infinite

    @property
    def peaked(self) -> bool:
        """Whether frequencies were added to resolve a peak."""
        spacing = np.diff(self.omega)
        return bool(spacing.min() < PEAKED * spacing.max())

    @cached_property
    def within(self) -> Callable[[Array], Array]:
        """The damping (m, 6, 6) up to the highest frequency: a cubic spline from zero at frequency zero."""
        from scipy.interpolate import CubicSpline

        knots, values = np.concatenate([[0.0], self.omega]), np.concatenate([np.zeros((1, 6, 6)), self.damping])
        return CubicSpline(knots, values)  # type: ignore[no-any-return]  # scipy is untyped

    def spread(self, width: float) -> Radiation:
        """With every frequency's damping spread over ``width`` spacings."""
        w = self.omega
        share = [np.exp(-0.5 * ((w[:, None] + sign * w) / (width * np.diff(w).mean())) ** 2) for sign in (-1, 1)]
        damping = np.einsum("mn,nij->mij", share[0] + share[1], self.damping)
        return Radiation(w, damping / (share[0] + share[1]).sum(axis=1)[:, None, None], self.added)

    @cached_property
    def _fit(self) -> tuple[Array, Array]:
        """Coefficients (powers, 6, 6) of the damping above the highest frequency, and the added mass (6, 6) at infinite
        frequency, such that ``excess = 2 / pi integral B(v) / (v^2 - w^2) dv`` (Kramers and Kronig) holds below
        `AGREES` of it."""
        from scipy.optimize import nnls

        top, used = self.omega[-1], self.omega < AGREES * self.omega[-1]
        w = self.omega[used, None]
        v = top * (np.arange(2000) + 0.5) / 2000
        smooth = (self.within(v)[None] - self.damping[used, None]) / (v**2 - w**2)[:, :, None, None]
        principal = np.log((top - w) / (top + w)) / (2 * w)
        known = smooth.sum(axis=1) * top / 2000 + principal[:, :, None] * self.damping[used]
        middle = self.added[used].mean(axis=0)
        rest = (np.pi / 2 * (self.added[used] - middle) - known).reshape(-1, 36)
        x, weights = _trapezoid(1.0, 60.0, 6000)
        parts = weights * x ** -np.array(POWERS)[:, None] @ (1 / ((top * x[:, None]) ** 2 - w.T**2)) * top
        last = self.damping[-1].reshape(36)
        level = np.abs(parts).max()  # of the column of the constant: as large as the others
        rows = np.column_stack([(parts[1:] - parts[0]).T, np.full(len(w), level)])
        *more, offset = np.linalg.lstsq(rows, rest - np.outer(parts[0], last), rcond=1e-3)[0]
        found = np.concatenate([[last - np.sum(more, axis=0)], more]).reshape(-1, 6, 6)
        offset = offset.reshape(6, 6)
        falling = np.eye(len(POWERS))
        terms = np.vstack([falling, falling[:-1] - falling[1:]])  # none of them negative
        for i in range(6):  # no motion gains energy
            scale = max(float(np.linalg.norm(rest[:, 7 * i])), 1e-300)
            known_last = np.append(terms.sum(axis=1) * 1e3 / max(last[7 * i], 1e-300), [0, 0])
            rows = np.vstack(
                [np.column_stack([(terms @ parts).T, *level * np.outer([1, -1], np.ones(len(w)))]) / scale, known_last]
            )
            *shares, up, down = nnls(rows, np.append(rest[:, 7 * i] / scale, 1e3))[0]
            found[:, i, i], offset[i, i] = shares @ terms, up - down
        return found, middle + 2 / np.pi * level * offset

    def above(self, omega: Array) -> Array:
        """The damping (m, 6, 6) above the highest frequency."""
        share = (self.omega[-1] / omega) ** np.array(POWERS)[:, None]
        return np.einsum("pm,pij->mij", share, self._fit[0])

    def kernel(self, times: Array) -> Array:
        """``K`` (m, 6, 6) at ``times`` (m,) s."""
        top = self.omega[-1]
        step = min(np.diff(self.omega).min() / 8, np.pi / 8 / max(float(np.max(times)), 1e-9))
        found = np.zeros((len(times), 36))
        for of, low, high in ((self.within, 0.0, top), (self.above, top, 5 * HIGHEST * top)):
            w, weights = _trapezoid(low, high, int(np.ceil((high - low) / step)))
            found += np.cos(np.multiply.outer(times, w)) @ (weights[:, None] * of(w).reshape(-1, 36))
        return 2 / np.pi * found.reshape(-1, 6, 6)


def _trapezoid(low: float, high: float, count: int) -> tuple[Array, Array]:
    """Places and weights of the trapezoidal rule."""
    places = np.linspace(low, high, count + 1)
    weights = np.full(count + 1, (high - low) / count)
    weights[[0, -1]] /= 2
    return places, weights


def radiating(damping: Array) -> Array:
    """The ``damping`` (n, 6, 6) without the motions that gain energy: by the error of panels, a motion that radiates
    hardly any waves, such as the surge of a slender hull with a little pitch, may have a negative one."""
    size = np.sqrt(np.maximum(np.einsum("nii->ni", damping).max(axis=0), 1e-300))
    units = np.multiply.outer(size, size)
    values, vectors = np.linalg.eigh(damping / units)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None]) @ np.swapaxes(vectors, 1, 2) * units)


def fitted(radiation: Radiation, infinite: Array | None = None) -> Memory | None:
    """A model of the radiation, with stable poles, in which no motion gains energy; None: there is none.

    ``infinite`` (6, 6): the added mass at infinite frequency, if waves ring between two hulls, so that it does not
    follow from the damping. Where peaks are resolved, it does, but a realization of the kernel fits the peaks alone:
    away from them, a thousandth of the peak is a large error. Without a model of these, they are damped: their peaks
    are spread out.
    """
    model = None
    if infinite is not None or radiation.peaked:
        model = _ringing(radiation, radiation.infinite if infinite is None else infinite)
    if model is None and infinite is None:
        model = _model(radiation, known=True)
    if model is not None:
        return model
    for spread in SPREADS:
        model = _model(radiation.spread(spread), known=False)
        if model is not None:
            return model
    return None


def _ringing(radiation: Radiation, infinite: Array) -> Memory | None:
    """The model with poles that fit damping and added mass, over ``infinite`` (6, 6), at each frequency."""
    omega, damping = radiation.omega, radiation.damping
    size, units = _sizes(damping)
    wanted = (damping + 1j * omega[:, None, None] * (radiation.added - infinite)) / units
    above = omega[-1] * np.linspace(1, HIGHEST, len(omega) // 2 + 1)[1:]
    strength = np.linalg.norm(wanted, axis=(1, 2))
    weight = 1 / (FAINTEST + strength / strength.max())
    inside = np.arange(len(omega) + len(above)) < len(omega)
    weights = np.append(weight, np.full(len(above), weight[-1])) * np.stack([np.where(inside, 1.0, GUESSED), inside])
    every, whole = np.concatenate([omega, above]), np.concatenate([wanted, radiation.above(above) / units])
    one, other = np.triu_indices(6)
    responses = wanted[:, one, other]
    largest = np.sqrt((np.abs(responses * weight[:, None]) ** 2).mean(axis=0))
    responses = responses[:, largest > 0] / largest[largest > 0]
    narrowest, best = NARROW * np.diff(omega).min(), None
    for count in POLES:
        start = np.linspace(omega[0] / 2, 1.1 * omega[-1], count)
        poles = start * (1j - 0.05)
        for _ in range(ROUNDS):
            poles = _relocated(poles, omega, responses, weight)
        poles = np.where(poles.imag > 0, np.minimum(poles.real, -narrowest) + 1j * poles.imag, poles)
        states, inputs = _states(poles, omega, wanted, weight)
        outputs = _outputs(states, inputs, every, whole, weights)
        wrong = Memory(states, inputs, outputs).transfer(omega) - wanted
        miss = float(np.sqrt(((np.linalg.norm(wrong, axis=(1, 2)) / strength) ** 2).mean()))
        scale = np.where(np.isfinite(size), size, 0.0)
        model = Memory(states, inputs * scale, outputs * scale[:, None])
        if miss < (RINGS if best is None else best[0]) and gain(model, omega[-1]) < GAIN:
            best = miss, model
        if best is not None and best[0] <= CLOSE:
            break
    return None if best is None else best[1]


def _fractions(poles: Complex, omega: Array) -> Complex:
    """The transforms (m, n) that the real numbers (n,) of a kernel weigh: two for a pole and its conjugate, one for a
    real pole."""
    s = 1j * omega
    columns: list[Complex] = []
    for pole in poles:
        if pole.imag == 0:
            columns.append(1 / (s - pole))
        else:
            one, two = 1 / (s - pole), 1 / (s - pole.conj())
            columns += [one + two, 1j * (one - two)]
    return np.array(columns, complex).T


def _relocated(poles: Complex, omega: Array, wanted: NDArray[Any], weight: Array) -> Complex:
    """Poles nearer to those of all responses ``wanted`` (m, k) at ``omega`` (m,), by one round of vector fitting."""
    parts = _fractions(poles, omega)
    n, left, right = parts.shape[1], [], []
    for response in wanted.T:
        rows = np.column_stack([parts, -response[:, None] * parts, response]) * weight[:, None]
        r = np.asarray(np.linalg.qr(np.concatenate([rows.real, rows.imag]), mode="r"))
        left.append(r[n : 2 * n, n : 2 * n])
        right.append(r[n : 2 * n, 2 * n])
    found = np.linalg.lstsq(np.concatenate(left), np.concatenate(right), rcond=None)[0]
    system, first, k = np.zeros((n, n)), np.zeros(n), 0
    for pole in poles:
        if pole.imag == 0:
            system[k, k], first[k], k = pole.real, 1.0, k + 1
        else:
            system[k : k + 2, k : k + 2] = [[pole.real, pole.imag], [-pole.imag, pole.real]]
            first[k], k = 2.0, k + 2
    zeros = np.linalg.eigvals(system - np.outer(first, found))
    zeros = zeros[zeros.imag >= 0]
    return np.asarray(-np.abs(zeros.real) + 1j * zeros.imag)


def _states(poles: Complex, omega: Array, wanted: NDArray[Any], weight: Array) -> tuple[Complex, Complex]:
    """The poles (n,) and inputs (n, 6) of the strongest states at ``poles`` for the transform ``wanted`` (m, 6, 6)."""
    parts = _fractions(poles, omega) * weight[:, None]
    target = (wanted * weight[:, None, None]).reshape(len(omega), 36)
    rows, given = (np.concatenate([each.real, each.imag]) for each in (parts, target))
    found = iter(list(np.linalg.lstsq(rows, given, rcond=None)[0].reshape(-1, 6, 6)))
    states: list[complex] = []
    inputs: list[Complex] = []
    for pole in poles:
        residue = next(found) + (1j * next(found) if pole.imag else 0.0)
        _, strength, directions = np.linalg.svd(np.asarray(residue))
        for k in np.flatnonzero(strength > FAINTEST * abs(pole.real)):
            states.append(pole)
            inputs.append(directions[k])
    return np.array(states, complex), np.array(inputs, complex)


def _sizes(damping: Array) -> tuple[Array, Array]:
    """By which forces of modes (6,) and coefficients (6, 6) are divided; infinite for modes that make no waves."""
    most = np.abs(np.einsum("nii->ni", damping)).max(axis=0)
    arm = np.sqrt(most[:3].max() / max(most[3:].max(), 1e-300))
    used = most > WEAK * most[3:].max() * np.array([arm, arm, arm, 1, 1, 1]) ** 2
    size = np.where(used, np.sqrt(np.maximum(most, 1e-300)), np.inf)
    return size, np.multiply.outer(size, size)


def gain(memory: Memory, top: float) -> float:
    """The greatest negative damping up to ``top`` rad/s, of any motion, over the greatest damping."""
    omega = np.linspace(0, top, 400)
    found = memory.transfer(omega).real
    size = np.sqrt(np.maximum(np.abs(np.einsum("nii->ni", found)).max(axis=0), 1e-300))
    found = (found + np.swapaxes(found, 1, 2)) / 2 / np.multiply.outer(size, size)
    return float(-np.linalg.eigvalsh(found).min())


def _model(radiation: Radiation, known: bool) -> Memory | None:
    """``known``: whether the added mass agrees with the damping. None: no order is good enough."""
    omega, damping, excess = radiation.omega, radiation.damping, radiation.excess
    size, units = _sizes(damping)
    step = np.pi / omega[-1] / FINE
    count = min(int(LONG * 2 * np.pi / np.diff(omega).min() / step) // 2, MOST)
    samples = radiation.kernel(step * np.arange(2 * count)) / units
    index = np.add.outer(np.arange(count), np.arange(count))

    def hankel(first: int) -> Array:
        return np.asarray(
            samples[np.minimum(index + first, 2 * count - 1)].transpose(0, 2, 1, 3).reshape(6 * count, -1)
        )

    above = omega[-1] * np.linspace(1, HIGHEST, len(omega) // 2 + 1)[1:]
    wanted = np.concatenate([damping + 1j * omega[:, None, None] * excess, radiation.above(above)]) / units
    every, inside = np.concatenate([omega, above]), np.arange(len(omega) + len(above)) < len(omega)
    size_of = np.linalg.norm(wanted, axis=(1, 2))
    relative = 1 / (FAINT + size_of / size_of.max())
    weights = relative * np.stack([np.where(inside, 1.0, GUESSED), np.where(inside & known, 1.0, 0.0)])
    left, strength, right = np.linalg.svd(hankel(0), full_matrices=False)
    shifted, best = hankel(1), None
    whole = float(np.linalg.norm(wanted[inside] if known else damping / units))
    for order in ORDERS:
        root = np.sqrt(strength[:order])
        system = (left[:, :order] / root).T @ shifted @ (right[:order].T / root)
        values, vectors = np.linalg.eig(system)
        inputs = np.linalg.solve(vectors, (root[:, None] * right[:order, :6]).astype(complex))
        stable = (np.abs(values) < 1) & (values.imag >= 0) & (np.abs(np.angle(values)) < 0.9 * np.pi)
        poles, inputs = np.log(values[stable]) / step, inputs[stable]
        outputs = _outputs(poles, inputs, every, wanted, weights)
        wrong = Memory(poles, inputs, outputs).transfer(omega) - wanted[inside]
        miss = float(np.linalg.norm(wrong if known else wrong.real)) / whole
        scale = np.where(np.isfinite(size), size, 0.0)
        model = Memory(poles, inputs * scale, outputs * scale[:, None])
        if (best is None or miss < best[0]) and gain(model, omega[-1]) < GAIN:
            best = miss, model
        if best is not None and best[0] <= ERROR:
            break
    return None if best is None or best[0] > WORST else best[1]


def _outputs(poles: Complex, inputs: Complex, omega: Array, wanted: NDArray[Any], weights: Array) -> Complex:
    """Weighted least squares (6, n) for the Fourier transform (m, 6, 6) of a kernel, whose integral is zero."""

    def of(s: Array) -> tuple[Complex, Complex]:
        """Factors (6 m, n) of the outputs' real and imaginary parts in the transform."""
        one, two = (
            (inputs_of.T / (1j * s[:, None, None] - poles_of)).reshape(-1, len(poles)) / 2
            for poles_of, inputs_of in ((poles, inputs), (poles.conj(), inputs.conj()))
        )
        return one + two, 1j * (one - two)

    rows = np.concatenate(of(omega), axis=1)
    _, s, v = np.linalg.svd(np.concatenate(of(np.zeros(1)), axis=1).real)
    free = v[int((s > 1e-9 * s.max()).sum()) :].T
    rows = np.concatenate([rows.real, rows.imag]) @ free
    target = wanted.transpose(0, 2, 1).reshape(-1, 6)
    weight = np.concatenate([np.repeat(part, 6) for part in weights])[:, None]
    found = free @ np.linalg.lstsq(weight * rows, weight * np.concatenate([target.real, target.imag]), rcond=1e-12)[0]
    n = len(poles)
    return np.asarray(found[:n] + 1j * found[n:]).T


@dataclass(eq=False)
class Remembered:
    """The state of a `Memory` while a hull moves: ``x`` (n,), complex, at ``time`` s, when the twist was ``twist``."""

    CARRIED = ("time", "x", "twist")
    memory: Memory
    time: float = np.inf
    x: NDArray[np.complex128] | None = None
    twist: Array | None = None

    def wrench(self, t: float, twist: Array) -> Array:
        """The wrench (6,) at ``t`` s on a hull with a ``twist`` (6,) that changed linearly since the last call: exact.

        An earlier time than that of the last call begins anew, without memory.
        """
        poles, h = self.memory.poles, t - self.time
        if self.x is None or self.twist is None or h < 0:
            self.x = np.zeros(len(poles), complex)
        elif h > 0:
            z = poles * h
            grown = np.exp(z)
            # integrals of exp(poles (h - s)) and of exp(poles (h - s)) s / h; by their series if z is small
            near = np.abs(z) < 1e-2
            safe = np.where(near, 1.0, z)
            flat = np.where(near, 1 + z / 2 + z**2 / 6 + z**3 / 24, (grown - 1) / safe)
            rising = np.where(near, 0.5 + z / 6 + z**2 / 24 + z**3 / 120, (grown - 1 - z) / safe**2)
            before, after = self.memory.inputs @ self.twist, self.memory.inputs @ twist
            self.x = grown * self.x + h * (flat * before + rising * (after - before))
        self.time, self.twist = t, np.array(twist, float)
        return -(self.memory.outputs @ self.x).real
