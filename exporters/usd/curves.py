"""Motion as sparse curves: cubic Bezier splines on scalar ops, with as few keys as a tolerance permits.

A curve passes within its tolerance of the clip at 64 instants of every frame. Its tangents have the clip's slopes;
their widths are fitted, which needs half as many keys as widths of a third. Keys are on whole frames, except where
motion changes faster than one key per frame can follow. Where a channel turns one way, its curve does too. The root's
orientation becomes three rotations, in the order that stays farthest from gimbal lock. Where an earlier curve still
shows the motion, as outside an animator's edit, its keys stay.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import permutations
from typing import Any, NamedTuple

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
SAME = 1e-3
"""Share of the tolerance by which a key of an earlier curve may be off, in value and, over its segment, in slope."""
DAMPING = 1e-6
"""Share of the trace of the normal equations that is added to their diagonal: for a straight line they are singular."""
WIDTHS = (0.03, 0.9)
"""Least and largest width of a tangent, in lengths of its segment. Those of a segment add up to one length at most:
some tools shorten longer ones."""
ROUNDS = 7
"""Rounds of Gauss and Newton's method at most for the widths of a segment."""
EASED = 1 / 3
"""With which power of their number the share of the tolerance falls that curves of one pose are first given each."""
EPSILON = float(np.finfo(float).eps)
"""Least trace of the normal equations, so that they are not singular where nothing changes."""


@dataclass(frozen=True)
class Curve:
    """A cubic Bezier curve: ``values`` (k,) at ``frames`` (k,). Its tangents before and after each key have ``slopes``
    (k, 2) per frame, and ``widths`` (k, 2) in frames."""

    frames: Array
    values: Array
    slopes: Array
    widths: Array

    def __call__(self, frames: Array) -> Array:
        """Values (n,) at ``frames`` (n,); held outside."""
        if len(self.frames) == 1:
            return np.full(len(frames), self.values[0])
        t = np.clip(frames, self.frames[0], self.frames[-1])
        k = np.clip(np.searchsorted(self.frames, t, side="right") - 1, 0, len(self.frames) - 2)
        h = self.frames[k + 1] - self.frames[k]
        widths = np.stack([self.widths[k, 1], self.widths[k + 1, 0]])
        slopes = np.stack([self.slopes[k, 1], self.slopes[k + 1, 0]])
        s = _parameters((t - self.frames[k]) / h, widths / h)
        points = _control_points(self.values[k], self.values[k + 1], slopes, widths)
        return np.asarray((_weights(s) * points).sum(axis=0))

    @classmethod
    def of(cls, spline: Any) -> Curve | None:
        """The curve of USD's ``spline``; None if it is no cubic Bezier curve without jumps and loops."""
        from pxr import Ts

        knots = list(spline.GetKnots().values()) if spline else []
        smooth = all(k.GetNextInterpolation() == Ts.InterpCurve and not k.IsDualValued() for k in knots)
        if len(knots) < 2 or spline.GetCurveType() != Ts.CurveTypeBezier or spline.HasLoops() or not smooth:
            return None
        slopes = np.array([[k.GetPreTanSlope(), k.GetPostTanSlope()] for k in knots])
        widths = np.array([[k.GetPreTanWidth(), k.GetPostTanWidth()] for k in knots])
        return cls(
            np.array([k.GetTime() for k in knots]), np.array([k.GetValue() for k in knots], float), slopes, widths
        )

    def spline(self) -> Any:
        """The same curve for USD."""
        from pxr import Ts

        spline = Ts.Spline("double")
        for frame, value, slopes, widths in zip(
            self.frames.tolist(), self.values.tolist(), self.slopes.tolist(), self.widths.tolist(), strict=True
        ):
            knot = Ts.Knot("double")
            knot.SetTime(frame)
            knot.SetValue(value)
            knot.SetNextInterpolation(Ts.InterpCurve)
            knot.SetPreTanWidth(widths[0])
            knot.SetPreTanSlope(slopes[0])
            knot.SetPostTanWidth(widths[1])
            knot.SetPostTanSlope(slopes[1])
            spline.SetKnot(knot)
        return spline


class _Tangents(NamedTuple):
    """``slopes`` (2,) per instant and ``widths`` (2,) in instants after the start and before the end of a segment."""

    slopes: Array
    widths: Array


def instants(first: float, last: float) -> Array:
    """The instants (n,) of the frames from ``first`` to ``last``."""
    return first + np.arange(round((last - first) * INSTANTS) + 1) / INSTANTS


def fit(frames: Array, values: Array, tolerance: float, earlier: Curve | None = None) -> Curve:
    """A curve within ``tolerance`` of ``values`` (n,) at ``frames`` (n,), `instants` that start on a whole frame.

    From key to key, the longest segment that fits is chosen. Both ends of a standstill are keys. Segments of an
    ``earlier`` curve that show the values, up to a constant, are kept.
    """
    return _fit(frames, values, tolerance, earlier, None if earlier is None else earlier(frames))


def _fit(frames: Array, values: Array, tolerance: float, earlier: Curve | None, shown: Array | None) -> Curve:
    """`fit`, with the values ``shown`` (n,) by the earlier curve."""
    values = np.asarray(values, float)
    if len(frames) == 1 or np.ptp(values) == 0:
        return Curve(frames[:1], values[:1], np.zeros((1, 2)), np.zeros((1, 2)))
    slopes = _slopes(values, tolerance)
    kept = {} if earlier is None or shown is None else _kept(earlier, shown, frames, values, slopes, tolerance)
    keys, segments = [0], []
    for stop in sorted({*_standstills(values), *kept, *(end for end, _ in kept.values())}):
        while keys[-1] < stop:
            if keys[-1] in kept:
                end, tangents = kept[keys[-1]]
                keys.append(end)
                segments.append(tangents)
                continue
            end, tangents = _farthest(values[: stop + 1], slopes, keys[-1], tolerance)
            if not _fits(values[keys[-1] : end + 1], tangents, tolerance):  # between the probes
                end, tangents = _farthest(values[: stop + 1], slopes, keys[-1], tolerance, everywhere=True)
            keys.append(end)
            segments.append(tangents)
    chosen = np.zeros((len(keys), 2, 2))  # of each key: slopes and widths, before and after
    chosen[:-1, :, 1] = [[slopes[0], widths[0]] for slopes, widths in segments]
    chosen[1:, :, 0] = [[slopes[1], widths[1]] for slopes, widths in segments]
    chosen[[0, -1], 0, [0, 1]] = chosen[[0, -1], 0, [1, 0]]
    return Curve(frames[keys], values[keys], chosen[:, 0] * INSTANTS, chosen[:, 1] / INSTANTS)


def _kept(
    earlier: Curve, shown: Array, frames: Array, values: Array, slopes: Array, tolerance: float
) -> dict[int, tuple[int, _Tangents]]:
    """First index -> last index and tangents of the segments of an ``earlier`` curve that show ``values`` (n,) up to a
    constant: what accumulates, such as the angle of a wheel, is shifted behind an edit."""
    rows = np.round((earlier.frames - frames[0]) * INSTANTS).astype(int)
    lengths, widths = np.diff(earlier.frames), np.stack([earlier.widths[:-1, 1], earlier.widths[1:, 0]])
    whole = (rows >= 0) & (rows < len(frames))
    whole &= np.abs(earlier.frames - frames[np.clip(rows, 0, len(frames) - 1)]) < 1e-9
    usable = whole[:-1] & whole[1:] & (widths >= 0).all(axis=0) & (widths.sum(axis=0) <= lengths * (1 + 1e-9))
    off, same, found = values - shown, SAME * tolerance, {}
    for k in np.flatnonzero(usable).tolist():
        a, b = int(rows[k]), int(rows[k + 1])
        own = np.array([earlier.slopes[k, 1], earlier.slopes[k + 1, 0]]) / INSTANTS
        wanted, rise = np.array([slopes[a, 1], slopes[b, 0]]), values[b] - values[a]
        turned = np.abs(own - wanted) * (b - a) > same
        turned &= (own != 0) | (wanted * rise > 0)  # a slope against the rise was set to 0
        if not turned.any() and abs(off[b] - off[a]) <= same and np.abs(off[a : b + 1] - off[a]).max() <= tolerance:
            found[a] = b, _Tangents(own, widths[:, k] * INSTANTS)
    return found


def _standstills(values: Array) -> list[int]:
    """The whole frames at which a standstill of a frame or more begins and ends, and the last index."""
    still = np.concatenate([[False], np.diff(values) == 0, [False]]).astype(int)
    runs = np.flatnonzero(np.diff(still)).reshape(-1, 2)
    whole = np.stack([-(-runs[:, 0] // INSTANTS), runs[:, 1] // INSTANTS], axis=1) * INSTANTS
    return sorted({*whole[whole[:, 1] > whole[:, 0]].ravel().tolist(), len(values) - 1})


def _farthest(
    values: Array, slopes: Array, start: int, tolerance: float, everywhere: bool = False
) -> tuple[int, _Tangents]:
    """The end of the longest segment from ``start`` that fits at the probes or ``everywhere``: a whole frame or,
    within a frame, half of it, and so on; and its tangents."""

    def fitted(end: int) -> _Tangents | None:
        own = values[start : end + 1]
        found = _fitted(own, slopes[start, 1], slopes[end, 0], tolerance)
        return found if found is None or not everywhere or _fits(own, found, tolerance) else None

    last = len(values) - 1
    whole = min((start // INSTANTS + 1) * INSTANTS, last)
    step, best = INSTANTS, fitted(whole)
    if best is None:
        while best is None:  # ends at the latest with one instant, which every segment fits
            step //= 2
            best = fitted(start + step) if start + step < whole else None
        return start + step, best
    ends = [*range(whole, last, INSTANTS), last]
    good, reach = 0, 1
    while good + reach < len(ends) and (longer := fitted(ends[good + reach])):
        good, reach, best = good + reach, 2 * reach, longer
    while reach > 1:
        reach //= 2
        if good + reach < len(ends) and (longer := fitted(ends[good + reach])):
            good, best = good + reach, longer
    return ends[good], best


def _fitted(values: Array, before: float, after: float, tolerance: float) -> _Tangents | None:
    """Tangents with these slopes per instant whose cubic is within the tolerance of ``values`` (n,) at the probes; None
    if none is found.

    A third of the segment's length is tried as their widths, then better widths by Gauss and Newton's method for least
    squares. Slopes are kept, so that a key has the same slope on both sides, except at a kink.
    """
    h, rise, steps = len(values) - 1, values[-1] - values[0], np.diff(values)
    slopes, most = np.array([before, after]), np.full(2, WIDTHS[1] * h)
    if (steps >= 0).all() or (steps <= 0).all():
        # a cubic whose control points turn one way does so itself
        slopes[slopes * rise <= 0] = 0.0
        np.divide(rise, slopes, out=most, where=slopes != 0)
        most = np.minimum(most, WIDTHS[1] * h)
    widths = np.minimum(h / 3, most)
    for _ in range(ROUNDS):
        points = _control_points(values[0], values[-1], slopes, widths)
        t = _PROBES @ [0.0, widths[0], h - widths[1], h]
        k = np.minimum(t.astype(np.int64), h - 1)
        bent = (steps[np.minimum(k + 1, h - 1)] - steps[k]) / 2
        errors = _PROBES @ points - values[k] - (t - k) * (steps[k] + (t - k - 1) * bent)
        if h == 1 or np.abs(errors).max() <= tolerance:
            return _Tangents(slopes, widths)
        gradients = _TIMES * (slopes - steps[k, None])
        (a, b, _, c), (p, q) = (gradients.T @ gradients).ravel().tolist(), (errors @ gradients).tolist()
        damping = DAMPING * max(a + c, EPSILON)
        a, c = a + damping, c + damping
        step = np.array([c * p - b * q, a * q - b * p]) / (a * c - b * b)
        widths = np.minimum(np.maximum(widths - step, WIDTHS[0] * h), most)
        widths *= min(1.0, h / widths.sum())
    return None


def _control_points(start: Any, end: Any, slopes: Array, widths: Array) -> Array:
    """The four values of the control points of a segment from ``start`` to ``end``, with tangents (2, ...)."""
    return np.array([start, start + slopes[0] * widths[0], end - slopes[1] * widths[1], end])


def _fits(values: Array, tangents: _Tangents, tolerance: float) -> bool:
    """Whether a cubic with these tangents is within the tolerance of all ``values`` (n,)."""
    h = len(values) - 1
    points = _control_points(values[0], values[-1], *tangents)
    s = _parameters(np.arange(1, h) / h, tangents.widths[:, None] / h)
    return bool((np.abs(points @ _weights(s) - values[1:-1]) <= tolerance).all())


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


def _weights(s: Array) -> Array:
    """The weights (4, n) of the control points of a cubic Bezier curve at parameters (n,) from 0 to 1."""
    r = 1 - s
    return np.stack([r * r * r, 3 * r * r * s, 3 * r * s * s, s * s * s])


def _parameters(x: Array, widths: Array) -> Array:
    """The parameters (n,) at shares ``x`` (n,) of a segment's length, with widths (2, n or 1) in shares of it whose sum
    is at most 1: Newton's method, with bisection where it would leave its bracket."""
    start, end = widths[0], 1 - widths[1]
    cubic = 1 + 3 * (start - end), 3 * (end - 2 * start), 3 * start
    a, b, c = (np.broadcast_to(each, x.shape) for each in cubic)  # share = ((a s + b) s + c) s
    low, high, s = np.zeros_like(x), np.ones_like(x), x.copy()
    found, rows = s, np.arange(len(x))
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(60):
            error = ((a * s + b) * s + c) * s - x
            rest = np.abs(error) >= 1e-13
            if 2 * rest.sum() <= len(s):  # few need many steps
                found[rows] = s
                rows, x, a, b, c, low, high, s, error = (each[rest] for each in (rows, x, a, b, c, low, high, s, error))
                if not len(rows):
                    break
            np.copyto(low, s, where=error < 0)
            np.copyto(high, s, where=error > 0)
            newton = s - error / ((3 * a * s + 2 * b) * s + c)
            s = np.where((newton > low) & (newton < high), newton, (low + high) / 2)
    found[rows] = s
    return found


_PROBES = _weights(np.linspace(0, 1, 26)[1:-1]).T
"""Weights (24, 4) at the parameters at which widths are fitted."""
_TIMES = _PROBES[:, 1:3] * [1.0, -1.0]
"""Change (24, 2) of the times of the probes with the widths before and after."""


# ---------------------------------------------------------------- poses


def fit_positions(
    frames: Array, positions: Array, tolerance: float, earlier: Sequence[Curve | None] = (None, None, None)
) -> list[Curve]:
    """Curves of x, y and z whose distance from ``positions`` (n, 3) is at most ``tolerance``. ``earlier``: as for
    `fit`."""
    return _fit_together(
        frames,
        positions,
        tolerance,
        lambda curves: np.linalg.norm(np.stack([c(frames) for c in curves], 1) - positions, axis=1),
        earlier,
    )


def fit_rotations(
    frames: Array, q: Array, angle: float, earlier: Callable[[str], Curve | None] = lambda axis: None
) -> tuple[str, list[Curve]] | None:
    """Three rotations whose product is within ``angle`` rad of unit quaternions (n, 4): their axes, such as "ZYX", from
    the outermost, and their curves in degrees. None if every order comes too close to gimbal lock. ``earlier``: those
    about an axis, as for `fit`."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_quat(q, scalar_first=True)
    axes, angles = _order(rotations)
    if not axes:
        return None
    angles = np.unwrap(angles, axis=0)

    def error(curves: Sequence[Curve]) -> Array:
        turned = np.radians(np.stack([curve(frames) for curve in curves], 1))
        return angles_between(Rotation.from_euler(axes, turned).as_quat(scalar_first=True), q)

    degrees = _fit_together(
        frames, np.degrees(angles), np.degrees(angle), lambda c: np.degrees(error(c)), [*map(earlier, axes)]
    )
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
    frames: Array,
    values: Array,
    tolerance: float,
    error: Callable[[Sequence[Curve]], Array],
    earlier: Sequence[Curve | None],
) -> list[Curve]:
    """Curves of the columns of ``values`` whose joint error is within ``tolerance``: each within the same share of it,
    which is lowered as far as necessary."""
    moving = int(np.count_nonzero(np.ptp(values, axis=0)))
    share = max(moving, 1) ** -EASED  # curves are rarely all at their worst at one instant
    shown = [None if before is None else before(frames) for before in earlier]
    while True:
        within = share * tolerance
        columns = zip(values.T, earlier, shown, strict=True)
        curves = [_fit(frames, column, within, before, values_before) for column, before, values_before in columns]
        largest = float(error(curves).max())
        if largest <= tolerance or share < 1e-3:
            return curves
        share *= min(tolerance / largest, 0.95)


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
    """Path of an op -> the number of keys of its spline or of its samples, in a layer."""
    found: dict[str, int] = {}

    def visit(path: Any) -> None:
        if path.IsPropertyPath() and path.name.startswith("xformOp:"):
            attribute = layer.GetAttributeAtPath(path)
            spline = attribute.GetSpline() if attribute and attribute.HasSpline() else None
            count = layer.GetNumTimeSamplesForPath(path) if spline is None else len(spline.GetKnots())
            if count:
                found[str(path)] = count

    layer.Traverse("/", visit)
    return found
