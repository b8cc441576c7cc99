"""Measure a delivery against its shot file from the stage and the TOML alone, without vehsim.

``python verify.py SHOT.toml STAGE.usda [--json]`` lists unmet requests; its exit code is then 1.

Every test is one-sided: a refuted delivery is certainly wrong. A mean over a frame is at most the greatest value in it,
so a mean beyond a limit proves that the limit was exceeded; a distance from a hull's corner to a mesh is at least the
distance of the two, so one below the clearance proves a violation. Only peaks between samples can pass unnoticed.

Velocities at a frame come from polynomials through four samples; twice their difference from polynomials through five
counts as their error. A tolerance of 0 means 1 mm, 0.05 degrees, 1 mm/s; limits have 1 % of slack.

Poses here are in metres, Z up, whatever the stage's units and axes.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray
PLACE, TURN, PACE, SPIN = 1e-3, 0.05, 1e-3, 0.05
"""Meaning of a tolerance of zero: m, degrees, m/s, degrees per second."""
SLACK = 1.01
"""Factor by which a limit may be exceeded."""
GRAVITY = 9.81
FLIES = {"helicopter", "hopper", "tumbler"}
ON_WHEELS = {
    "car": 0.004,
    "simple_car": 0.004,
    "drift_car": 0.004,
    "rally_car": 0.004,
    "truck": 0.006,
    "two_wheeled": 0.002,
    "snakeboard": 0.004,
}
"""Asset -> largest distance of the corners of its wheels' meshes from level ground, m: they are polygons."""
FADED = 12.0
"""Distance from a landing beyond which the full clearance from the ground is required, m."""


@dataclass(frozen=True)
class Row:
    """One unmet request: ``value`` exceeds ``bound`` at ``frame``."""

    ask: str
    text: str
    value: float
    bound: float
    frame: float


@dataclass
class Findings:
    rows: list[Row] = field(default_factory=list)
    checks: Counter[str] = field(default_factory=Counter)

    def hold(self, ask: str, value: Any, bound: float, frames: Any, text: str, unit: str = "") -> None:
        """Record that ``value`` (n,) at ``frames`` (n,) must not exceed ``bound``; if it does, the worst is
        reported."""
        value, frames = np.atleast_1d(np.asarray(value, float)), np.atleast_1d(np.asarray(frames, float))
        self.checks[ask] += 1
        if not len(value):
            return
        worst = int(np.argmax(np.where(np.isnan(value), np.inf, value)))
        if not value[worst] <= bound:
            message = f"{text}: {value[worst]:.5g} for {bound:.5g} {unit} at frame {frames[worst]:g}"
            self.rows.append(Row(ask, message, float(value[worst]), float(bound), float(frames[worst])))


# ---------------------------------------------------------------- the stage


class Stage:
    """A composed stage, read in metres, Z up."""

    def __init__(self, path: Path) -> None:
        from pxr import Usd, UsdGeom

        self.stage = Usd.Stage.Open(str(path))
        self.name = self.stage.GetDefaultPrim().GetName()
        self.unit = UsdGeom.GetStageMetersPerUnit(self.stage)
        up = UsdGeom.GetStageUpAxis(self.stage)
        turned = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # Y up to Z up
        self.axes = turned if up == "Y" else np.eye(3)
        self.first, self.last = self.stage.GetStartTimeCode(), self.stage.GetEndTimeCode()
        self.fps = self.stage.GetTimeCodesPerSecond()

    def prim(self, path: str) -> Any:
        return self.stage.GetPrimAtPath(f"/{self.name}/{path}")

    def matrices(self, prim: Any, frames: Iterable[float]) -> Array:
        """Local to world matrices (n, 4, 4) for column vectors, as the stage composes them."""
        from pxr import UsdGeom

        cache, found = UsdGeom.XformCache(), []
        for frame in frames:
            cache.SetTime(frame)
            found.append(np.array(cache.GetLocalToWorldTransform(prim)).T)
        return np.array(found)

    def poses(self, prim: Any, frames: Iterable[float]) -> tuple[Array, Array]:
        """Positions (n, 3) m and rotations (n, 3, 3) of a vehicle's root: its nose is X, its left side Y."""
        found = self.matrices(prim, frames)
        turned = self.axes @ found[:, :3, :3]
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
        return found[:, :3, 3] @ self.axes.T * self.unit, turned

    def samples(self, prim: Any) -> Array:
        """Time codes of the root's authored positions and orientations."""
        from pxr import UsdGeom

        times = [op.GetTimeSamples() for op in UsdGeom.Xformable(prim).GetOrderedXformOps()]
        return np.unique(np.concatenate([np.array(t, float) for t in times] or [np.zeros(0)]))

    def drive(self, prim: Any, kind: str, frames: Iterable[float]) -> Array | None:
        """The values (n,) of an animated op on a prim, such as ``rotateZ``, or the sums of its vectors, which have one
        component; None if it is not animated."""
        from pxr import UsdGeom

        for op in UsdGeom.Xformable(prim).GetOrderedXformOps():
            if f":{kind}" in op.GetOpName() and op.GetNumTimeSamples():
                values = np.array([op.Get(frame) for frame in frames], float)
                return values.reshape(len(values), -1).sum(axis=1)
        return None

    def meshes(self, prim: Any, wanted: Callable[[Any], bool] = lambda mesh: True) -> list[tuple[Any, Array, Array]]:
        """(prim, points (n, 3) in its own space, triangles (m, 3)) of the meshes below a prim."""
        from pxr import Usd, UsdGeom

        found = []
        for mesh in Usd.PrimRange(prim, Usd.TraverseInstanceProxies()) if prim else ():
            if mesh.IsA(UsdGeom.Mesh) and wanted(mesh):
                shape = UsdGeom.Mesh(mesh)
                points = np.array(shape.GetPointsAttr().Get(self.first), float)
                found.append((mesh, points, _triangles(shape)))
        return found

    def world(self, mesh: Any, points: Array, frames: Sequence[float]) -> Array:
        """Points (n, k, 3) m of a mesh at frames."""
        found = self.matrices(mesh, frames)
        placed = np.einsum("fij,kj->fki", found[:, :3, :3], points) + found[:, None, :3, 3]
        return placed @ self.axes.T * self.unit


def _triangles(shape: Any) -> Array:
    counts = np.array(shape.GetFaceVertexCountsAttr().Get())
    indices = np.array(shape.GetFaceVertexIndicesAttr().Get())
    starts, faces = np.concatenate([[0], np.cumsum(counts)[:-1]]), []
    for k in range(1, int(counts.max()) - 1):
        rows = starts[counts > k + 1]
        faces.append(np.stack([indices[rows], indices[rows + k], indices[rows + k + 1]], axis=1))
    return np.concatenate(faces).astype(np.int64)


# ---------------------------------------------------------------- one vehicle's motion


@dataclass
class Motion:
    """A vehicle's delivered motion: samples at ``frames`` (n,), whole ones and authored ones between them."""

    stage: Stage
    name: str
    asset: str
    table: Mapping[str, Any]
    frames: Array
    positions: Array
    rotations: Array

    @property
    def prim(self) -> Any:
        return self.stage.prim(f"vehicles/{self.name}")

    @property
    def flies(self) -> bool:
        return self.asset in FLIES or (self.asset == "boat" and self.table["method"] != "plan")

    @cached_property
    def seconds(self) -> Array:
        return (self.frames - self.frames[0]) / self.stage.fps

    @cached_property
    def whole(self) -> Array:
        """Indices of whole frames."""
        return np.flatnonzero(np.abs(self.frames - np.round(self.frames)) < 1e-6)

    def at(self, frame: float) -> int:
        """The index of a whole frame, -1 if it was not delivered."""
        found = np.flatnonzero(np.abs(self.frames - frame) < 1e-6)
        return int(found[0]) if len(found) else -1

    def within(self, first: float, last: float) -> Array:
        """Indices of samples in a range of frames, ends included."""
        return np.flatnonzero((self.frames >= first - 1e-6) & (self.frames <= last + 1e-6))

    @cached_property
    def headings(self) -> Array:
        return np.degrees(np.arctan2(self.rotations[:, 1, 0], self.rotations[:, 0, 0]))

    def turning(self, i: int, rows: Array) -> Array:
        """Rotation of samples relative to sample i, (n, 3) rad; for driving vehicles only the heading, (n, 1).

        The body of a driving vehicle may nod on its springs.
        """
        if self.flies:
            return rotation_vectors(self.rotations[i].T @ self.rotations[rows])
        return np.radians((self.headings[rows] - self.headings[i] + 180) % 360 - 180)[:, None]

    @cached_property
    def shown(self) -> int:
        """Number of coordinates of the position that can be requested: the ground determines the height of driving
        vehicles."""
        return 3 if self.flies else 2

    def joint(self, name: str) -> Array | None:
        """A joint's values (n,) as its rig shows them; None if it does not."""
        reading = JOINTS.get((self.asset, name))
        return None if reading is None else reading(self)

    def part(self, path: str, kind: str) -> Array:
        values = self.stage.drive(self.stage.prim(f"vehicles/{self.name}/{path}"), kind, self.frames)
        return np.zeros(len(self.frames)) if values is None else values


def _steered(motion: Motion) -> Array:
    """The tangent of the steering angle: from the harmonic mean of both front wheels (Ackermann)."""
    left, right = (np.tan(np.radians(motion.part(f"steer_{side}", "rotateZ"))) for side in ("fl", "fr"))
    total = left + right
    return np.where(np.abs(total) < 1e-12, 0.0, 2 * left * right / np.where(np.abs(total) < 1e-12, 1.0, total))


def _turned(path: str, kind: str, sign: float = 1.0) -> Callable[[Motion], Array]:
    return lambda motion: sign * np.radians(motion.part(path, kind))


JOINTS: dict[tuple[str, str], Callable[[Motion], Array]] = {
    **{(asset, "sigma"): _steered for asset in ("car", "simple_car", "drift_car", "rally_car", "truck")},
    ("truck", "hitch_1"): _turned("trailer_1", "rotateZ"),
    ("snakeboard", "psi"): _turned("torso", "rotateZ"),
    ("snakeboard", "phi"): _turned("truck_rear", "rotateZ"),
    ("two_wheeled", "right"): _turned("wheel_right", "rotateY"),
    ("two_wheeled", "left"): _turned("wheel_left", "rotateY"),
    ("hopper", "psi"): _turned("leg", "rotateY"),
    ("hopper", "stretch"): lambda motion: -motion.part("leg/foot", "translate:slideZ"),
}


def rotation_vectors(rotations: Array) -> Array:
    """Rotation vectors (n, 3) rad of rotations (n, 3, 3), accurate also near zero."""
    skew = np.stack([rotations[:, a, b] - rotations[:, b, a] for a, b in ((2, 1), (0, 2), (1, 0))], axis=1) / 2
    sine = np.linalg.norm(skew, axis=1)
    angle = np.arctan2(sine, (np.trace(rotations, axis1=1, axis2=2) - 1) / 2)
    return skew * np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 1.0)[:, None]


def rates(times: Array, values: Array, i: int) -> list[tuple[Array, float]]:
    """Derivatives of values (n, k) at sample i from windows of four samples, each with its error."""

    def slope(rows: Array) -> Array:
        h = times[rows] - times[i]
        scale = np.abs(h).max()
        weights = np.linalg.solve(np.vander(h / scale, increasing=True).T, np.eye(len(rows))[1]) / scale
        return weights @ values[rows]

    found, count = [], len(times)
    for size in (4, 3):
        for start in range(i - size + 1, i + 1):
            rows = np.arange(start, start + size)
            if rows[0] < 0 or rows[-1] >= count:
                continue
            wider = [np.append(rows, rows[-1] + 1), np.insert(rows, 0, rows[0] - 1)]
            wider = [w for w in wider if w[0] >= 0 and w[-1] < count]
            if wider:
                mean = slope(rows)
                found.append((mean, min(float(np.abs(slope(w) - mean).max()) for w in wider)))
        if found:
            return found
    return [(np.zeros(values.shape[1]), math.inf)]


def off_rate(times: Array, values: Array, i: int, wanted: Array | float) -> float:
    """Lower bound on the difference of the derivative at sample i (or, for a number, of its norm) from the wanted
    value."""
    off = []
    for rate, error in rates(times, values, i):
        wrong = abs(np.linalg.norm(rate) - wanted) if np.ndim(wanted) == 0 else np.linalg.norm(rate - wanted)
        off.append(float(wrong) - 2 * error * math.sqrt(len(rate)))
    return max(0.0, min(off))


# ---------------------------------------------------------------- marks


def mark_off(motion: Motion, mark: Mapping[str, Any], frame: float) -> list[tuple[str, float, float, str]]:
    """What can be measured of a mark at a frame: (ask, difference, tolerance, unit)."""
    i, rows = motion.at(frame), []
    if i < 0:
        return [("mark.frame", math.inf, 0.0, "")]
    whole = motion.whole
    near = whole[np.abs(whole - i).argsort(kind="stable")[:13]]
    near.sort()
    k = int(np.flatnonzero(near == i)[0])
    times, shown = motion.seconds[near], motion.shown
    place, turned = motion.positions[i], motion.rotations[i]
    tolerance = mark.get("tolerance", 0.0) + PLACE
    if "position" in mark and not mark.get("gate"):
        off = np.abs(place - mark["position"])[:shown]
        if mark.get("on_ground"):
            rows.append(("mark.position", float(off[:2].max()), PLACE, "m"))
            rows.append(("on_ground.below", float(place[2] - mark["position"][2]), 0.5 + PLACE, "m"))
        else:
            rows.append(("mark.position", float(off.max()), tolerance, "m"))
    if gate := mark.get("gate"):
        rows += _gate_off(motion, i, mark["position"], gate)
    if "heading" in mark:
        off = (motion.headings[i] - mark["heading"] + 180) % 360 - 180
        rows.append(("mark.heading", abs(float(off)), TURN, "deg"))
    if "orientation" in mark:
        wanted = _matrix(mark["orientation"])
        if shown == 2:
            off = motion.headings[i] - math.degrees(math.atan2(wanted[1, 0], wanted[0, 0]))
            rows.append(("mark.orientation", abs((off + 180) % 360 - 180), TURN, "deg"))
        else:
            off = np.degrees(np.linalg.norm(rotation_vectors((wanted.T @ turned)[None])))
            rows.append(("mark.orientation", float(off), TURN, "deg"))
    if mark.get("pitch") is not None and motion.asset == "hopper":
        nose = math.degrees(math.atan2(-turned[2, 0], turned[2, 2]))
        rows.append(("mark.pitch", abs((nose - mark["pitch"] + 180) % 360 - 180), TURN, "deg"))
    velocity = mark.get("velocity")
    if velocity is None and mark.get("on_ground") and "speed" not in mark:
        velocity = [0.0, 0.0, 0.0]
    if velocity is not None:
        wrong = off_rate(times, motion.positions[near][:, :shown], k, np.array(velocity, float)[:shown])
        rows.append(("mark.velocity", wrong, PACE, "m/s"))
        if not any(velocity):
            turning = motion.turning(i, near)
            spin = off_rate(times, turning, k, np.zeros(turning.shape[1]))
            rows.append(("mark.rest", math.degrees(spin), SPIN, "deg/s"))
    if "speed" in mark:
        wrong = off_rate(times, motion.positions[near][:, :shown], k, float(mark["speed"]))
        rows.append(("mark.speed", wrong, PACE, "m/s"))
    if mark.get("on_ground"):
        level = math.degrees(math.acos(min(1.0, turned[2, 2])))
        rows.append(("on_ground.level", level, TURN, "deg"))
    for name, value in mark.get("joints", {}).items():
        found = motion.joint(name)
        if found is not None:
            rows.append(("mark.joints", abs(float(found[i]) - value), 1e-3, name))
    if hold := mark.get("hold"):
        rows += _hold_off(motion, mark, frame, frame + hold, tolerance)
    return rows


def _gate_off(motion: Motion, i: int, place: Sequence[float], gate: Mapping[str, Any]) -> list[Any]:
    axis = np.array(gate["direction"], float)
    axis /= np.linalg.norm(axis)
    level = np.cross([0.0, 0.0, 1.0], axis)
    width = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-9 else np.array([0.0, 1.0, 0.0])
    height = np.cross(axis, width)
    off = motion.positions[i] - place
    if motion.shown == 2:
        off[2] = 0.0
    rows = [("gate.plane", abs(float(off @ axis)), PLACE, "m")]
    if "radius" in gate:
        rows.append(("gate.opening", float(np.linalg.norm(off - (off @ axis) * axis)), gate["radius"] + PLACE, "m"))
    else:
        beyond = max(abs(off @ width) - gate["size"][0] / 2, abs(off @ height) - gate["size"][1] / 2)
        rows.append(("gate.opening", float(beyond), PLACE, "m"))
    through = [motion.positions[k] @ axis for k in (max(i - 1, 0), min(i + 1, len(motion.positions) - 1))]
    rows.append(("gate.direction", float(through[0] - through[1]), PLACE, "m"))
    return rows


def _hold_off(motion: Motion, mark: Mapping[str, Any], first: float, last: float, tolerance: float) -> list[Any]:
    rows, i = motion.within(first, last), motion.at(first)
    if motion.at(last) < 0:
        return [("hold.frames", math.inf, 0.0, "")]
    place, shown = motion.positions[i], motion.shown
    if "position" in mark and not mark.get("on_ground"):
        place = np.array(mark["position"], float)
    else:
        tolerance = PLACE
    off = np.abs(motion.positions[rows] - place)[:, :shown].max()
    turned = np.degrees(np.linalg.norm(motion.turning(i, rows), axis=1)).max()
    steps = np.diff(motion.positions[rows][:, :shown], axis=0)
    pace = (np.linalg.norm(steps, axis=1) / np.diff(motion.seconds[rows])).max()
    found = [("hold.position", float(off), tolerance, "m"), ("hold.turn", float(turned), TURN, "deg")]
    return [*found, ("hold.speed", float(pace), PACE, "m/s")]


def _matrix(q: Sequence[float]) -> Array:
    w, x, y, z = np.array(q, float) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def marks_as_rests(motion: Motion) -> list[dict[str, Any]]:
    """The marks of a sinusoid as those of a plan: at rest, with their headings, pitches and joints, or the defaults."""
    names = [name for (asset, name) in JOINTS if asset == motion.asset and name != "stretch"]
    return [
        {"heading": 0.0, "velocity": [0, 0, 0]}
        | ({"pitch": 0.0} if motion.asset == "hopper" else {})
        | mark
        | {"joints": dict.fromkeys(names, 0.0) | mark.get("joints", {})}
        for mark in motion.table["mark"]
    ]


def check_marks(motion: Motion, found: Findings) -> list[int]:
    """Check every mark at its frame; a mark at a free frame must be met before the next one. Returns their frames."""
    planned = motion.table["method"] == "plan"
    marks = list(motion.table["mark"]) if planned else marks_as_rests(motion)
    if not planned and motion.asset == "hopper":  # except at the ends it is in the air and moves
        marks = [{key: value for key, value in mark.items() if key != "velocity"} for mark in marks]
    frames: list[int] = []
    earliest = motion.stage.first
    for n, mark in enumerate(marks):
        if mark["frame"] != "free":
            frame = mark["frame"]
            measured = mark_off(motion, mark, frame)
        else:
            later = [m["frame"] for m in marks[n + 1 :] if m["frame"] != "free"]
            last = (later[0] - 1 if later else motion.stage.last) - mark.get("hold", 0)
            frame, measured = _best_frame(motion, mark, earliest, last, n == len(marks) - 1)
        for ask, off, bound, unit in measured:
            found.hold(ask, off, bound, frame, f"{motion.name}: mark[{n}] {ask}", unit)
        frames.append(int(frame))
        earliest = frame + mark.get("hold", 0) + 1
    return frames


def _best_frame(motion: Motion, mark: Mapping[str, Any], first: float, last: float, end: bool) -> tuple[int, list[Any]]:
    """The frame at which a free mark is met or missed least: the end for the last mark, otherwise near its place."""
    frames = np.arange(math.ceil(first), math.floor(last) + 1)
    if "position" in mark and len(frames):
        shown = 2 if mark.get("on_ground") else motion.shown
        off = motion.positions[[motion.at(f) for f in frames]] - mark["position"]
        frames = frames[np.argsort(np.linalg.norm(off[:, :shown], axis=1), kind="stable")]
    if end and len(frames):
        frames = np.insert(frames[:200], 0, math.floor(last))
    best: tuple[int, list[Any]] | None = None
    least = math.inf
    for frame in frames[:200]:
        measured = mark_off(motion, mark, float(frame))
        wrong = max((off / max(bound, 1e-6) for _, off, bound, _ in measured), default=0.0)
        if wrong <= 1.0:
            return int(frame), measured
        if wrong < least and not (end and best):
            least, best = wrong, (int(frame), measured)
    return best or (int(first), [("mark.frame", math.inf, 0.0, "")])


# ---------------------------------------------------------------- limits, looks, stays, loops


def check_limits(motion: Motion, first: float, last: float, found: Findings) -> None:
    rows = motion.within(first, last)
    if len(rows) < 3 or not (limits := motion.table.get("limits")):
        return
    t, x, R, frames = motion.seconds[rows], motion.positions[rows], motion.rotations[rows], motion.frames[rows]
    h = np.diff(t)[:, None]
    v = np.diff(x, axis=0) / h
    a = 2 * np.diff(v, axis=0) / (h[1:] + h[:-1])
    if motion.flies:
        turning = rotation_vectors(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / h
    else:
        turning = np.radians((np.diff(motion.headings[rows]) + 180) % 360 - 180)[:, None] / h
    flat = np.r_[1.0, 1.0, 1.0 if motion.flies else 0.0]  # driving vehicles follow the ground up and down
    measured: dict[str, Array] = {
        "speed": np.linalg.norm(v, axis=1),
        "climb": np.abs(v[:, 2]),
        "turn_rate": np.degrees(np.linalg.norm(turning, axis=1)),
        "bank": np.degrees(np.arccos(np.clip(R[:, 2, 2], -1, 1))),
        "ceiling": x[:, 2],
        "acceleration": np.linalg.norm(a * flat, axis=1),
        "g_load": np.linalg.norm(a / GRAVITY + [0, 0, 1], axis=1),
    }
    sigma = motion.joint("sigma")
    if sigma is not None:
        measured["steering"] = np.degrees(np.abs(np.arctan(sigma[rows])))
        measured["steering_rate"] = np.degrees(np.abs(np.diff(np.arctan(sigma[rows])))) / h[:, 0]
    hitch = motion.joint("hitch_1")
    if hitch is not None:
        measured["hitch"] = np.degrees(np.abs(hitch[rows]))
    for name, bound in limits.items():
        if name in ("joints", "joint_rates"):
            for joint, given in bound.items():
                values = motion.joint(joint)
                if values is None:
                    continue
                low, high = (-given, given) if not isinstance(given, list) else given
                values = values[rows] if name == "joints" else np.diff(values[rows]) / h[:, 0]
                middle, half = (low + high) / 2, (high - low) / 2
                off = np.abs(values - middle)
                found.hold(f"limit {name}", off, half * SLACK, frames[: len(off)], f"{motion.name}: {name}.{joint}")
        elif name in measured:
            most = bound + 0.01 if name == "ceiling" else bound * SLACK
            found.hold(f"limit {name}", measured[name], most, frames[: len(measured[name])], f"{motion.name}: {name}")


def check_looks(motion: Motion, first: float, last: float, found: Findings) -> None:
    for n, look in enumerate(motion.table.get("look", [])):
        rows = motion.within(*look.get("frames", (first, last)))
        axis = look.get("axis", "x")
        nose = motion.rotations[rows][:, :, "xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
        offset = np.array(look["at"], float) - motion.positions[rows]
        if look.get("level", True):
            nose, offset = nose[:, :2], offset[:, :2]
        far = np.linalg.norm(offset, axis=1) > 0.1
        dot = np.sum(nose * offset, axis=1) / (np.linalg.norm(nose, axis=1) * np.linalg.norm(offset, axis=1) + 1e-12)
        off = np.degrees(np.arccos(np.clip(dot, -1, 1)))[far]
        bound = look.get("within", 5.0) * SLACK + TURN
        found.hold("look", off, bound, motion.frames[rows][far], f"{motion.name}: look[{n}]", "deg")


def check_stays(motion: Motion, first: float, last: float, found: Findings) -> None:
    for n, stay in enumerate(motion.table.get("stay", [])):
        rows = motion.within(*stay.get("frames", (first, last)))
        x, frames = motion.positions[rows], motion.frames[rows]
        over = []
        if "above" in stay:
            over.append(stay["above"] - x[:, 2])
        if "below" in stay:
            over.append(x[:, 2] - stay["below"])
        if "inside" in stay:
            x0, y0, x1, y1 = stay["inside"]
            over += [x0 - x[:, 0], x[:, 0] - x1, y0 - x[:, 1], x[:, 1] - y1]
        found.hold("stay", np.max(over, axis=0), PLACE, frames, f"{motion.name}: stay[{n}], m beyond it")


def check_loop(motion: Motion, first: float, last: float, found: Findings) -> None:
    if not motion.table.get("loop"):
        return
    i, j = motion.at(first), motion.at(last)
    off = np.linalg.norm((motion.positions[j] - motion.positions[i])[: motion.shown])
    turned = np.degrees(np.linalg.norm(rotation_vectors((motion.rotations[i].T @ motion.rotations[j])[None])))
    found.hold("loop.place", off, PLACE, last, f"{motion.name}: loop, place", "m")
    found.hold("loop.turn", turned, TURN, last, f"{motion.name}: loop, attitude", "deg")
    whole = motion.whole[(motion.whole >= i) & (motion.whole <= j)]
    times, places = motion.seconds[whole], motion.positions[whole][:, : motion.shown]
    ends = [rates(times, places, k)[0] for k in (0, len(whole) - 1)]
    off = np.linalg.norm(ends[0][0] - ends[1][0]) - 4 * (ends[0][1] + ends[1][1])
    found.hold("loop.velocity", off, PACE, last, f"{motion.name}: loop, velocity", "m/s")
    for name in ("sigma", "hitch_1", "phi"):
        values = motion.joint(name)
        if values is not None:
            found.hold("loop.joints", abs(values[j] - values[i]), 1e-3, last, f"{motion.name}: loop, {name}")


# ---------------------------------------------------------------- clearance and the ground


def _is_hull(mesh: Any) -> bool:
    from pxr import UsdPhysics

    return bool(mesh.HasAPI(UsdPhysics.CollisionAPI))


def _counts(motion: Motion, mesh: Any) -> bool:
    """Whether a mesh counts: steered wheels, feet and riders of driving vehicles count in their rest pose, so not
    here."""
    path = str(mesh.GetPath()).split(f"/{motion.name}/", 1)[-1]
    turns = ("steer_", "truck_", "outboard", "torso", "pelvis")
    return motion.asset == "helicopter" or not path.startswith(turns) or path.startswith("truck_body")


def _distances(points: Array, shape: tuple[Array, Array]) -> Array:
    """Distances (n,) m of points (n, 3) to triangles; negative inside a closed shape."""
    import igl

    points = np.ascontiguousarray(points)
    squared = igl.point_mesh_squared_distance(points, *shape)[0]
    inside = igl.winding_number(*shape, points) > 0.5
    return np.where(inside, -1, 1) * np.sqrt(squared)


class Ground:
    """A terrain's mesh, queried from above."""

    def __init__(self, stage: Stage) -> None:
        parts = stage.meshes(stage.prim("env/terrain"), lambda mesh: mesh.GetName() != "horizon")
        self.points = np.zeros((0, 3))
        self.faces = np.zeros((0, 3), np.int64)
        for mesh, points, faces in parts:
            self.faces = np.vstack([self.faces, faces + len(self.points)])
            self.points = np.vstack([self.points, stage.world(mesh, points, [stage.first])[0]])
        corners = self.points[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) if len(corners) else corners
        self.normals = normals * np.where(normals[:, 2:] < 0, -1, 1) if len(corners) else normals

    def __bool__(self) -> bool:
        return bool(len(self.faces))

    def distances(self, points: Array) -> Array:
        """Signed distances (n,) m: negative below."""
        import igl

        near = self._near(points)
        squared, which, closest = igl.point_mesh_squared_distance(
            np.ascontiguousarray(points), self.points, np.ascontiguousarray(self.faces[near])
        )[:3]
        above = np.sum((points - closest) * self.normals[near][which], axis=1) >= 0
        # on a ridge the nearest triangle may face away from a point above it: the triangle below decides
        shapes = self.points[self.faces[near]]
        bounds = shapes[:, :, :2].min(axis=1), shapes[:, :, :2].max(axis=1)
        for k in np.flatnonzero(~above):
            beneath = np.all((bounds[0] <= points[k, :2]) & (points[k, :2] <= bounds[1]), axis=1)
            above[k] = _is_over(points[k], shapes[beneath])
        return np.where(above, 1, -1) * np.sqrt(squared)

    def gap(self, points: Array, faces: Array) -> float:
        """Distance of a hull, m, also where its edges are nearest; below the ground that of its deepest corner."""
        import fcl

        least = float(self.distances(points).min())
        if least <= 0:
            return least
        sides = []
        for corners, triangles in ((points, faces), (self.points, self.faces[self._near(points)])):
            mesh = fcl.BVHModel()
            mesh.beginModel(len(triangles), len(corners))
            mesh.addSubModel(corners, triangles)
            mesh.endModel()
            sides.append(fcl.CollisionObject(mesh, fcl.Transform()))
        return max(0.0, float(fcl.distance(*sides)))

    def _near(self, points: Array) -> Array:
        """The triangles within 30 m, (n,) bool: distant ones need no tree."""
        low, high = points.min(axis=0)[:2] - 30, points.max(axis=0)[:2] + 30
        corners = self.points[self.faces][:, :, :2]
        return np.asarray(np.all((corners.max(axis=1) >= low) & (corners.min(axis=1) <= high), axis=1))


def _is_over(point: Array, shapes: Array) -> bool:
    """Whether a point is above the triangles (n, 3, 3) vertically above or below it; False if there are none."""
    a, b, c = (shapes[:, k, :2] - point[:2] for k in range(3))

    def cross(p: Array, q: Array) -> Array:
        return p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]

    weights = np.stack([cross(b, c), cross(c, a), cross(a, b)], axis=1)
    total = weights.sum(axis=1)
    inside = (total != 0) & (np.all(weights >= 0, axis=1) | np.all(weights <= 0, axis=1))
    heights = np.sum(weights[inside] * shapes[inside][:, :, 2], axis=1) / total[inside]
    return len(heights) > 0 and bool(point[2] >= heights.max())


def check_clearance(
    motion: Motion,
    others: Mapping[str, Motion],
    world: Mapping[str, Any],
    marks: list[tuple[Any, int]],
    found: Findings,
) -> None:
    """Check that no hull comes nearer to terrain, obstacle or another vehicle than requested, except at landings."""
    stage = motion.stage
    first, last = marks[0][1], marks[-1][1] + marks[-1][0].get("hold", 0)
    rows = motion.within(first, last)
    rows = rows[np.isin(rows, motion.whole)]
    rows = rows[:: max(1, len(rows) // 250)]
    frames = motion.frames[rows]
    required = motion.table.get("clearance", 1.0 if motion.table["method"] == "plan" else 0.1)
    hulls = [part for part in stage.meshes(motion.prim, _is_hull) if _counts(motion, part[0])]
    placed = [stage.world(mesh, points, frames) for mesh, points, _ in hulls]
    everything = np.concatenate(placed, axis=1)
    landings = np.array([motion.positions[motion.at(f)] for m, f in marks if m.get("on_ground")]).reshape(-1, 3)
    away = np.linalg.norm(motion.positions[rows][:, None] - landings, axis=2).min(axis=1, initial=math.inf)
    wanted = np.where(away > FADED + 3 * required, required, 0.0) - PLACE

    def nearest(distances: Array) -> Array:
        return distances.reshape(len(frames), -1).min(axis=1)

    shapes: dict[str, list[tuple[Array, Array]]] = {}
    for mesh, points, faces in stage.meshes(stage.prim("env/obstacles")):
        name = str(mesh.GetPath()).split("/env/obstacles/")[1].split("/")[0]
        shapes.setdefault(name, []).append((stage.world(mesh, points, [stage.first])[0], faces))
    for name, parts in shapes.items():
        for shape in parts:
            gap = nearest(_distances(everything.reshape(-1, 3), shape))
            back = np.array([_from_other_side(shape[0], hulls, placed, k) for k in range(len(frames))])
            gap = np.minimum(gap, back)
            found.hold(
                "clearance", wanted - gap, 0.0, frames, f"{motion.name}: {name}, m too near", f"of {required:g} m"
            )
    for table in world.get("obstacle", []):
        other = others.get(table.get("vehicle", ""))
        if table["shape"] != "vehicle" or other is None or other is motion:
            continue
        theirs = [part for part in stage.meshes(other.prim, _is_hull) if _counts(other, part[0])]
        gap = np.full(len(frames), math.inf)
        for mesh, points, faces in theirs:
            there = stage.world(mesh, points, frames)
            for k in range(len(frames)):
                middle, reach = there[k].mean(axis=0), np.ptp(there[k], axis=0).max()
                if np.linalg.norm(everything[k] - middle, axis=1).min() > reach + required:
                    continue
                gap[k] = min(gap[k], _distances(everything[k], (there[k], faces)).min())
        wide = np.full(len(frames), required - PLACE)
        found.hold(
            "clearance", wide - gap, 0.0, frames, f"{motion.name}: {other.name}, m too near", f"of {required:g} m"
        )
    ground = Ground(stage)
    if ground and motion.asset == "helicopter":
        gap = nearest(ground.distances(everything.reshape(-1, 3)))
        found.hold("clearance", wanted - gap, 0.0, frames, f"{motion.name}: terrain, m too near", f"of {required:g} m")
    for mark, frame in marks:
        if not mark.get("on_ground"):
            continue
        parts_there = [(stage.world(mesh, points, [frame])[0], faces) for mesh, points, faces in hulls]
        points = np.concatenate([part for part, _ in parts_there])
        gaps = [min(ground.gap(*part) for part in parts_there)] if ground else []
        gaps += [_distances(points, shape).min() for parts in shapes.values() for shape in parts]
        off = f"{motion.name}: off what it stands on"
        found.hold("on_ground.touch", abs(min(gaps)), PLACE, frame, off, "m")


def _from_other_side(points: Array, hulls: list[Any], placed: list[Array], k: int) -> float:
    """Distance of an obstacle's corners to hulls at frame k."""
    gap = math.inf
    for (_, _, faces), there in zip(hulls, placed, strict=True):
        middle, reach = there[k].mean(axis=0), np.ptp(there[k], axis=0).max()
        near = points[np.linalg.norm(points - middle, axis=1) < reach + 5]
        if len(near):
            gap = min(gap, float(_distances(near, (there[k], faces)).min()))
    return gap


def check_descent(motion: Motion, marks: list[tuple[Any, int]], found: Findings) -> None:
    """Check the descent towards a landing: at most 0.5 m/s, and 1 m/s more per metre of distance."""
    for n, (mark, frame) in enumerate(marks):
        if not mark.get("on_ground") or n == 0:
            continue
        before = marks[n - 1][1] + marks[n - 1][0].get("hold", 0)
        rows = motion.within(before, frame)
        x, t = motion.positions[rows], motion.seconds[rows]
        away = np.linalg.norm(x - x[-1], axis=1)
        down = -np.diff(x[:, 2]) / np.diff(t)
        allowed = 0.5 + np.maximum(away[1:], away[:-1])
        text = f"{motion.name}: m/s faster down than allowed"
        found.hold("on_ground.descent", down - allowed * SLACK, 0.0, motion.frames[rows][1:], text)


def check_wheels(motion: Motion, found: Findings) -> None:
    """Check that the lowest corner of every wheel touches the ground."""
    ground, stage = Ground(motion.stage), motion.stage
    rough = ON_WHEELS.get(motion.asset)
    if not ground or rough is None:
        return
    if np.ptp(ground.points[:, 2]) > 1e-6:
        rough += 0.006
    rows = motion.whole[:: max(1, len(motion.whole) // 60)]
    frames = motion.frames[rows]
    wheels: dict[str, list[Array]] = {}
    for mesh, points, _ in stage.meshes(motion.prim):
        names = [part for part in str(mesh.GetPath()).split("/") if part.startswith("wheel_")]
        if names and not _is_hull(mesh):
            wheels.setdefault(names[0], []).append(stage.world(mesh, points, frames))
    for name, parts in wheels.items():
        points = np.concatenate(parts, axis=1)
        reach = points[:, :, 2].min(axis=1)[:, None] + np.ptp(points[0, :, 2]) / 2
        low = [frame[frame[:, 2] <= r] for frame, r in zip(points, reach, strict=True)]
        gaps = ground.distances(np.concatenate(low))
        ends = np.cumsum([len(part) for part in low])[:-1]
        gap = np.array([part.min() for part in np.split(gaps, ends)])
        found.hold("wheels", np.abs(gap), rough, frames, f"{motion.name}: {name} off the ground", "m")


# ---------------------------------------------------------------- what starts somewhere and goes on


def check_start(motion: Motion, frame: float, found: Findings) -> None:
    """Check that a simulation starts in the requested state and ends where its pilot was sent."""
    start, i = motion.table.get("start"), motion.at(frame)
    if start is not None and i >= 0:
        mark = {"frame": frame, "velocity": start.get("velocity", [0, 0, 0])}
        mark |= {key: start[key] for key in ("position", "orientation", "joints") if key in start}
        if "orientation" not in start:
            mark["heading"] = start.get("heading", 0.0)
        if start.get("spin"):
            mark.pop("velocity")
        for ask, off, bound, unit in mark_off(motion, mark, frame):
            if ask != "mark.rest":  # a vehicle at rest may start to move
                found.hold(ask.replace("mark", "start"), off, bound, frame, f"{motion.name}: {ask} of its start", unit)
    pilot = motion.table.get("pilot")
    end = motion.positions[-1]
    goal = pilot and pilot.get("position", (pilot.get("points") or [None])[-1])
    if goal is not None:
        off = np.linalg.norm((end - np.resize(goal, 3))[: len(goal)])
        found.hold("pilot", off, 0.5, motion.frames[-1], f"{motion.name}: from where {pilot['name']} was sent", "m")
    if motion.table["method"] == "integrate":  # no forces act on it
        last = frame + _seconds(motion.table, motion.stage.fps) * motion.stage.fps
        rows = motion.whole[motion.frames[motion.whole] <= last + 1e-6]
        bend = np.linalg.norm(np.diff(motion.positions[rows], n=2, axis=0), axis=1) * motion.stage.fps**2
        found.hold("free flight", bend, 1e-3, motion.frames[rows][1:-1], f"{motion.name}: leaves its straight line")


def check_handles(motion: Motion, header: Mapping[str, Any], first: float, last: float, found: Findings) -> None:
    """Check that a motion continues through its handles: velocities on both sides of the cut agree."""
    for frame, end in ((first, "start_frame"), (last, "end_frame")):
        if header.get("handles", 0) < 4 or header.get(end, 1001) != frame:
            continue
        i = motion.at(frame)
        sides = [motion.whole[motion.whole <= i][-7:], motion.whole[motion.whole >= i][:7]]
        (before, error), (after, other) = (
            rates(motion.seconds[rows], motion.positions[rows], int(np.flatnonzero(rows == i)[0]))[0] for rows in sides
        )
        jump = np.linalg.norm(after - before) - 4 * (error + other)
        found.hold("handles", jump, 0.01, frame, f"{motion.name}: its velocity jumps where a handle begins", "m/s")


# ---------------------------------------------------------------- the world


def check_world(stage: Stage, shot: Mapping[str, Any], folder: Path, found: Findings) -> None:
    """Check that obstacles have the requested place, height and width, and the ground the heights of its file."""
    world = shot.get("world", {})
    standing = [table for table in world.get("obstacle", []) if table["shape"] != "vehicle"]
    groups: dict[str, list[Array]] = {}
    for mesh, points, _ in stage.meshes(stage.prim("env/obstacles")):
        name = str(mesh.GetPath()).split("/env/obstacles/")[1].split("/")[0]
        groups.setdefault(name, []).append(stage.world(mesh, points, [stage.first])[0])
    found.hold("obstacles", abs(len(groups) - len(standing)), 0, stage.first, "standing obstacles more or less")
    for table, (name, parts) in zip(standing, groups.items(), strict=False):
        corners, wanted = np.concatenate(parts), np.array(_box_of(table))
        off = np.abs([corners.min(axis=0), corners.max(axis=0)] - wanted).max()
        round_off = 0.05 * np.ptp(wanted, axis=0).max() if table["shape"] in ("ellipse", "sphere", "cone") else 0.0
        found.hold("obstacles", off, PLACE + round_off, stage.first, f"{name}: its box is off", "m")
    terrain = world.get("terrain", "")
    if terrain.endswith(".npz"):
        file = np.load(folder / terrain)
        rows, cols = np.indices(file["heights"].shape)
        k = np.linspace(0, rows.size - 1, 500).astype(int)
        x, y = (file["origin"][n] + file["cell"][n] * grid.ravel()[k] for n, grid in ((0, cols), (1, rows)))
        gaps = Ground(stage).distances(np.column_stack([x, y, file["heights"].ravel()[k]]))
        found.hold("terrain", np.abs(gaps), PLACE, stage.first, "the ground is off its file", "m")
    elif terrain == "flat":
        ground = Ground(stage).points
        found.hold("terrain", np.abs(ground[:, 2]), PLACE, stage.first, "the ground is not at zero", "m")


def _box_of(table: Mapping[str, Any]) -> tuple[Any, Any]:
    """The lower and upper corner of an obstacle of a shot file."""
    turned = math.radians(table.get("heading", 0.0))
    if table["shape"] == "sphere":
        centre, radius = np.array(table["centre"]), table["radius"]
        return centre - radius, centre + radius
    if table["shape"] == "cone":
        (x, y, low), radius = table["centre"], max(table.get("radius", 0.2), table.get("tip", 0.03))
        return (x - radius, y - radius, low), (x + radius, y + radius, low + table.get("height", 0.75))
    if table["shape"] == "box":
        (x, y, low), (length, width, height) = table["centre"], table["size"]
        reach = [abs(length * math.cos(turned)) + abs(width * math.sin(turned))]
        reach.append(abs(length * math.sin(turned)) + abs(width * math.cos(turned)))
        return (x - reach[0] / 2, y - reach[1] / 2, low), (x + reach[0] / 2, y + reach[1] / 2, low + height)
    low = table.get("base", 0.0)
    if table["shape"] == "polygon":
        corners = np.array(table["points"])
    else:
        around = np.linspace(0, 2 * math.pi, 721)
        a, b = table["radii"][0] * np.cos(around), table["radii"][1] * np.sin(around)
        corners = np.column_stack(
            [a * math.cos(turned) - b * math.sin(turned), a * math.sin(turned) + b * math.cos(turned)]
        )
        corners += table["centre"]
    return (*corners.min(axis=0), low), (*corners.max(axis=0), low + table.get("height", 1.0))


# ---------------------------------------------------------------- the whole delivery


def rate(given: Any) -> float:
    """Frames per second of a shot file: NTSC rates are multiples of 1000/1001."""
    text = str(given)
    value = float(Fraction(text))
    whole = round(value) * 1000 / 1001
    return whole if "/" not in text and value != round(value) and abs(value - whole) < 0.005 else value


def verify(shot: Mapping[str, Any], path: Path, folder: Path = Path()) -> Findings:
    """What is refuted of a delivery, and the number of measurements of each kind of ask; ``folder``: the shot
    file's."""
    found, stage = Findings(), Stage(path)
    header = shot["shot"]
    fps, first = rate(header.get("fps", 24)), header.get("start_frame", 1001) - header.get("handles", 0)
    found.hold("time codes", abs(stage.fps - fps), 1e-6, first, "time codes a second")
    found.hold("time codes", abs(stage.first - first), 0.0, first, "first frame")
    if "end_frame" in header:
        last = header["end_frame"] + header.get("handles", 0)
        found.hold("time codes", abs(stage.last - last), 0.0, last, "last frame")
    wanted = shot.get("export", {})
    found.hold("units", abs(stage.unit / wanted.get("meters_per_unit", 1.0) - 1), 1e-9, first, "metres a unit")
    found.hold("units", float((stage.axes[1, 1] == 1) != (wanted.get("up_axis", "Z") == "Z")), 0.0, first, "up axis")

    check_world(stage, shot, folder, found)
    motions = {table["name"]: read_motion(stage, table) for table in shot["vehicle"]}
    ends = [first]
    for motion in motions.values():
        whole = motion.frames[motion.whole]
        gaps = np.setdiff1d(np.arange(stage.first, stage.last + 1), np.round(stage.samples(motion.prim), 6))
        found.hold(
            "samples", len(gaps) if len(whole) > 1 and np.ptp(motion.positions) else 0, 0, first, "frames without"
        )
        if "mark" in motion.table:
            marks = list(zip(motion.table["mark"], check_marks(motion, found), strict=True))
            begin, end = marks[0][1], marks[-1][1] + marks[-1][0].get("hold", 0)
            ends.append(end)
            check_limits(motion, begin, end, found)
            check_looks(motion, begin, end, found)
            check_stays(motion, begin, end, found)
            check_loop(motion, begin, end, found)
            check_clearance(motion, motions, shot.get("world", {}), marks, found)
            check_descent(motion, marks, found)
            check_handles(motion, header, begin, end, found)
        else:
            check_start(motion, first, found)
            if "duration" in motion.table:
                ends.append(math.floor(first + _seconds(motion.table, fps) * fps + 1e-6))
        check_wheels(motion, found)
    if "end_frame" not in header:
        found.hold("time codes", abs(stage.last - max(ends)), 0.0, stage.last, f"last frame, requested {max(ends):g}")
    return found


def _seconds(table: Mapping[str, Any], fps: float) -> float:
    """Duration of a motion that is computed in steps: rounded up to whole steps."""
    if table["method"] == "integrate":
        step = table.get("step", 1 / 24)
    else:  # a whole number of steps per frame
        step = 1 / fps / math.ceil(1 / fps / table.get("step", 1 / 240) - 1e-9)
    return float(step * math.ceil(table["duration"] / step - 1e-6))


def read_motion(stage: Stage, table: Mapping[str, Any]) -> Motion:
    prim = stage.prim(f"vehicles/{table['name']}")
    authored = stage.samples(prim)
    inside = authored[(authored >= stage.first) & (authored <= stage.last)]
    frames = np.unique(np.round(np.concatenate([np.arange(stage.first, stage.last + 1), inside]), 9))
    positions, rotations = stage.poses(prim, frames)
    return Motion(stage, table["name"], table["asset"], table["motion"], frames, positions, rotations)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shot", type=Path)
    parser.add_argument("stage", type=Path)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(arguments)
    found = verify(tomllib.loads(options.shot.read_text(encoding="utf-8")), options.stage, options.shot.parent)
    if options.json:
        print(json.dumps({"refuted": [asdict(row) for row in found.rows], "checks": found.checks}))
    else:
        for line in _lines(found):
            print(line)
    return 1 if found.rows else 0


def _lines(found: Findings) -> Iterator[str]:
    yield from (row.text for row in found.rows)
    yield f"{sum(found.checks.values())} things measured, {len(found.rows)} refuted"


if __name__ == "__main__":
    sys.exit(main())
