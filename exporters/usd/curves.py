"""Motion as sparse curves: cubic Bezier splines on scalar ops, with as few keys as a tolerance permits.

A curve passes within its tolerance of the clip at 64 instants of every frame. Keys are on whole frames, except where
motion changes faster than one key per frame can follow. Where a channel turns one way, its curve does too. The root's
orientation becomes three rotations, in the order that stays farthest from gimbal lock.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise, permutations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.lie.quaternions import angles_between

Array = NDArray[np.float64]

INSTANTS = 64
"""Instants of every frame at which a curve is compared with the clip; a power of two."""
LOCK = np.radians(10.0)
"""Least distance of the middle rotation from gimbal lock, rad; closer to it, orientations are sampled."""
COMFORT = np.radians(30.0)
"""A distance from gimbal lock at which the usual order, heading, pitch, roll, is kept."""


@dataclass(frozen=True)
class Curve:
    """A piecewise cubic: ``values`` (k,) at ``frames`` (k,), and ``slopes`` (k, 2) per frame before and after each."""

    frames: Array
    values: Array
    slopes: Array

    def __call__(self, frames: Array) -> Array:
        """Values (n,) at ``frames`` (n,); held outside."""
        if len(self.frames) == 1:
            return np.full(len(frames), self.values[0])
        t = np.clip(frames, self.frames[0], self.frames[-1])
        k = np.clip(np.searchsorted(self.frames, t, side="right") - 1, 0, len(self.frames) - 2)
        h = self.frames[k + 1] - self.frames[k]
        ends = (self.values[k], self.values[k + 1], self.slopes[k, 1] * h, self.slopes[k + 1, 0] * h)
        return _cubic((t - self.frames[k]) / h, *ends)

    def spline(self) -> Any:
        """The same curve for USD; tangents reach a third of the way to the next key."""
        from pxr import Ts

        spline = Ts.Spline("double")
        thirds = np.diff(self.frames, prepend=self.frames[0], append=self.frames[-1]) / 3
        for frame, value, slopes, before, after in zip(
            self.frames.tolist(), self.values.tolist(), self.slopes.tolist(), thirds, thirds[1:], strict=False
        ):
            knot = Ts.Knot("double")
            knot.SetTime(frame)
            knot.SetValue(value)
            knot.SetNextInterpolation(Ts.InterpCurve)
            knot.SetPreTanWidth(float(before))
            knot.SetPreTanSlope(slopes[0])
            knot.SetPostTanWidth(float(after))
            knot.SetPostTanSlope(slopes[1])
            spline.SetKnot(knot)
        return spline


def instants(first: float, last: float) -> Array:
    """The instants (n,) of the frames from ``first`` to ``last``."""
    return first + np.arange(round((last - first) * INSTANTS) + 1) / INSTANTS


def fit(frames: Array, values: Array, tolerance: float) -> Curve:
    """A curve within ``tolerance`` of ``values`` (n,) at ``frames`` (n,), `instants` that start on a whole frame.

    From key to key, the longest segment that fits is chosen. Both ends of a standstill are keys.
    """
    values = np.asarray(values, float)
    if len(frames) == 1 or np.ptp(values) == 0:
        return Curve(frames[:1], values[:1], np.zeros((1, 2)))
    slopes = _slopes(values, tolerance)
    keys = [0]
    for stop in _standstills(values):
        while keys[-1] < stop:
            keys.append(_farthest(values[: stop + 1], slopes, keys[-1], tolerance))
    chosen = slopes[keys]
    for k, (start, end) in enumerate(pairwise(keys)):
        chosen[k, 1], chosen[k + 1, 0] = _tamed(values[start : end + 1], chosen[k, 1], chosen[k + 1, 0])
    return Curve(frames[keys], values[keys], chosen * INSTANTS)


def _standstills(values: Array) -> list[int]:
    """The whole frames at which a standstill of a frame or more begins and ends, and the last index."""
    still = np.concatenate([[False], np.diff(values) == 0, [False]]).astype(int)
    runs = np.flatnonzero(np.diff(still)).reshape(-1, 2)
    whole = np.stack([-(-runs[:, 0] // INSTANTS), runs[:, 1] // INSTANTS], axis=1) * INSTANTS
    return sorted({*whole[whole[:, 1] > whole[:, 0]].ravel().tolist(), len(values) - 1})


def _farthest(values: Array, slopes: Array, start: int, tolerance: float) -> int:
    """The end of the longest segment from ``start`` that fits: a whole frame or, within a frame, half of it, and so
    on."""

    def fits(end: int) -> bool:
        return _fits(values[start : end + 1], slopes[start, 1], slopes[end, 0], tolerance)

    last = len(values) - 1
    whole = min((start // INSTANTS + 1) * INSTANTS, last)
    if not fits(whole):
        step = INSTANTS // 2
        while step > 1 and (start + step >= whole or not fits(start + step)):
            step //= 2
        return start + step
    ends = [*range(whole, last, INSTANTS), last]
    good, reach = 0, 1
    while good + reach < len(ends) and fits(ends[good + reach]):
        good, reach = good + reach, 2 * reach
    while reach > 1:
        reach //= 2
        if good + reach < len(ends) and fits(ends[good + reach]):
            good += reach
    return ends[good]


def _fits(values: Array, before: float, after: float, tolerance: float) -> bool:
    """Whether the cubic with these end slopes per instant, `_tamed`, is within the tolerance."""
    h = len(values) - 1
    before, after = _tamed(values, before, after)
    cubic = _cubic(np.linspace(0.0, 1.0, h + 1), values[0], values[-1], before * h, after * h)
    return bool(np.abs(cubic - values).max() <= tolerance)


def _tamed(values: Array, before: float, after: float) -> tuple[float, float]:
    """End slopes per instant with which a cubic turns one way if ``values`` do: between 0 and three times the mean
    slope (Fritsch and Carlson 1980)."""
    steps = np.diff(values)
    if (steps < 0).any() and (steps > 0).any():
        return before, after
    most = 3 * float(values[-1] - values[0]) / len(steps)
    low, high = min(most, 0.0), max(most, 0.0)
    return min(max(before, low), high), min(max(after, low), high)


def _slopes(values: Array, tolerance: float) -> Array:
    """Slopes (n, 2) per instant, before and after each value: equal, except at a kink."""
    ahead = np.diff(values)
    if len(values) == 2:
        return np.repeat(ahead, 4).reshape(2, 2)
    after = np.append(1.5 * ahead[:-1] - 0.5 * ahead[1:], [1.5 * ahead[-1] - 0.5 * ahead[-2]] * 2)
    after[-2] = ahead[-1]
    before = np.concatenate([after[:1], ahead[:1], 1.5 * ahead[1:] - 0.5 * ahead[:-1]])
    after[-1] = before[-1]
    # beside a standstill, an extrapolated difference may have the other sign
    forward, backward = np.append(ahead, ahead[-1]), np.insert(ahead, 0, ahead[0])
    after[after * forward <= 0], before[before * backward <= 0] = 0.0, 0.0
    middle = np.empty(len(values))
    middle[1:-1], middle[[0, -1]] = (values[2:] - values[:-2]) / 2, (after[0], before[-1])
    smooth = (np.abs(after - before) * INSTANTS < tolerance) & (forward * backward != 0)
    return np.stack([np.where(smooth, middle, before), np.where(smooth, middle, after)], axis=1)


def _cubic(s: Array, a: Any, b: Any, da: Any, db: Any) -> Array:
    """The cubic from ``a`` to ``b`` with end slopes ``da`` and ``db``, at ``s`` from 0 to 1."""
    r = 1 - s
    return np.asarray(r * r * ((1 + 2 * s) * a + s * da) + s * s * ((1 + 2 * r) * b - r * db))


# ---------------------------------------------------------------- poses


def fit_positions(frames: Array, positions: Array, tolerance: float) -> list[Curve]:
    """Curves of x, y and z whose distance from ``positions`` (n, 3) is at most ``tolerance``."""
    return _fit_together(
        frames,
        positions,
        tolerance,
        lambda curves: np.linalg.norm(np.stack([c(frames) for c in curves], 1) - positions, axis=1),
    )


def fit_rotations(frames: Array, q: Array, angle: float) -> tuple[str, list[Curve]] | None:
    """Three rotations whose product is within ``angle`` rad of unit quaternions (n, 4): their axes, such as "ZYX", from
    the outermost, and their curves in degrees. None if every order comes too close to gimbal lock."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_quat(q, scalar_first=True)
    axes, angles = _order(rotations)
    if not axes:
        return None
    angles = np.unwrap(angles, axis=0)

    def error(curves: Sequence[Curve]) -> Array:
        turned = np.radians(np.stack([curve(frames) for curve in curves], 1))
        return angles_between(Rotation.from_euler(axes, turned).as_quat(scalar_first=True), q)

    degrees = _fit_together(frames, np.degrees(angles), np.degrees(angle), lambda c: np.degrees(error(c)))
    return axes, degrees


def _order(rotations: Any) -> tuple[str, Array]:
    """The order of axes that stays farthest from gimbal lock, the usual one if it stays far enough, and its angles (n,
    3) rad."""
    orders = ["ZYX", *("".join(order) for order in permutations("XYZ") if order != ("Z", "Y", "X"))]
    best: tuple[float, str, Array] = (LOCK, "", np.zeros((0, 3)))
    for axes in orders:
        with warnings.catch_warnings():  # of gimbal lock, which is measured here
            warnings.simplefilter("ignore", UserWarning)
            angles = rotations.as_euler(axes)
        away = float((np.pi / 2 - np.abs(angles[:, 1])).min())
        if away > best[0]:
            best = away, axes, angles
        if best[0] > COMFORT:
            break
    return best[1:]


def _fit_together(
    frames: Array, values: Array, tolerance: float, error: Callable[[Sequence[Curve]], Array]
) -> list[Curve]:
    """Curves of the columns of ``values`` with the largest equal tolerance at which their joint error is within
    ``tolerance``."""
    share = 1.0
    while True:
        curves = [fit(frames, column, share * tolerance) for column in values.T]
        if error(curves).max() <= tolerance or share < 1e-3:
            return curves
        share *= 0.75


def sampled_frames(frames: Array, q: Array, angle: float) -> Array:
    """The fewest equal parts of every frame at which samples of unit quaternions (n, 4) are slerped within ``angle``
    rad; returns their `frames`."""
    from vehsim.exporters.usd.sampling import slerp_errors

    step = INSTANTS
    while (
        step > 1 and slerp_errors(frames, q, np.unique([*range(0, len(frames), step), len(frames) - 1])).max() > angle
    ):
        step //= 2
    return frames[np.unique([*range(0, len(frames), step), len(frames) - 1])]


@contextmanager
def quiet() -> Iterator[None]:
    """Write a layer with splines: USD 26.11 then warns of loops that it reads itself, on the process's stderr."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def count_keys(layer: Any) -> dict[str, int]:
    """Attribute path -> the number of keys of its spline or of its samples, in a layer."""
    found: dict[str, int] = {}

    def visit(path: Any) -> None:
        if path.IsPropertyPath():
            attribute = layer.GetAttributeAtPath(path)
            spline = attribute.GetSpline() if attribute and attribute.HasSpline() else None
            count = layer.GetNumTimeSamplesForPath(path) if spline is None else len(spline.GetKnots())
            if count:
                found[str(path)] = count

    layer.Traverse("/", visit)
    return found
