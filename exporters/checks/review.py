"""Compare finished motion with a real machine: how hard, how smoothly and how calmly at rest a vehicle is driven.

The envelope is that of a character of the vehicle, see `vehsim.vehicles.definition.character`. A motion outside is not
wrong: the review says where a viewer may not believe it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, ValidationError

from vehsim.audit import MEASURES, PER_FRAME, Scene, Track, track_of_clip
from vehsim.clip.samples import frame_rate
from vehsim.delivery.earlier import SIGN
from vehsim.delivery.reports import REMEDY, reading_report
from vehsim.intake.foreign import refuse
from vehsim.intake.tables import dotted
from vehsim.planning.terms import LIMITS
from vehsim.planning.trim import flies, steady
from vehsim.vehicles.definition.character import NORMAL, REVIEW_UNITS, SHARES_OF_TIME, Reviewed, Trait
from vehsim.vehicles.definition.quantities import in_degrees
from vehsim.world.ground.below import above_ground
from vehsim.world.ground.touchdown import feet, height_below

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.world.world import World

Array = NDArray[np.float64]

ALWAYS = ("acceleration", "bank", "g_load")
"""Limits that every review shows, with or without an envelope."""
BY_WAVES = frozenset({"acceleration", "jerk"})
"""What waves determine more than a driver."""
ROOM = 0.1
"""Share of the envelope by which a motion may exceed it: plans hold to its limits by prices."""
RELEASED = 1e-3
"""Share of its range within which a control of a vehicle at rest is at a bound."""
POINTS = 240
"""Largest number of points of a curve; each is the worst of its interval."""
AT_BOUND = 0.01
"""Share of its range within which a control is at its bound."""
TURN = 0.1
"""Share of its range by which a control turns back in a reversal."""
SPAN = 0.5
"""Seconds over which jerk is averaged."""
RESTS, MOVES = 0.01, 1.0
"""Speeds, m/s: below the first a vehicle rests; above the second its slip is measured."""
SETTLES = 2.0
"""Seconds before and after rest in which a vehicle settles."""
STANDS, LOW = 0.01, 0.3
"""Heights of the lowest foot, m: below the first a vehicle at rest stands; below the second, its slide is measured."""
STAYS = 0.1
"""Seconds for which a vehicle rests where it stops; for less, it only turns back there."""


def review(clip: Clip, world: World | None = None, character: str = NORMAL) -> list[dict[str, Any]]:
    """What a clip in a ``world`` shows beside the envelope of a character, as JSON data: one row per quantity.

    Power depends on its wind and on the height above its ground. On its waves, acceleration and jerk of a boat have no
    envelope: that is one of driving, and there the sea moves it.
    ``name``, ``unit``, ``worst`` and its ``frame``, the ``envelope`` (None: there is none) and its ``source``,
    ``inside`` (None without envelope), and a ``curve``: frames and values. SI units, radians.
    """
    track, vehicle = track_of_clip(clip), clip.vehicle
    rows = []
    for name, unit, values, trait in _curves(track, vehicle, world):
        known = np.flatnonzero(np.isfinite(values))
        if not len(known):
            continue
        if world is not None and world.waves and name in BY_WAVES and vehicle.hull is not None:
            trait = None
        k = known[np.argmax(values[known])]
        worst = float(np.mean(values[known] >= 1 - AT_BOUND) if name in SHARES_OF_TIME else values[k])
        envelope = None if trait is None else trait.of(character)
        rows.append(
            {
                "name": name,
                "unit": unit,
                "worst": _short(worst),
                "frame": float(track.frames[k]),
                "envelope": envelope,
                "source": "" if trait is None else trait.source,
                "inside": None if envelope is None else bool(worst <= (1 + ROOM) * envelope),
                "curve": _thinned(track.frames[known], values[known]),
            }
        )
    return rows


def _paired(curve: list[list[float]]) -> list[list[float]]:
    if len(curve) != 2 or len(curve[0]) != len(curve[1]):
        raise ValueError("a curve has frames, and as many values")
    return curve


_Finite = Annotated[float, Field(allow_inf_nan=False)]


class _Row(BaseModel, strict=True):
    """A row of `review` that was read from a file."""

    name: str
    unit: str
    worst: _Finite
    frame: _Finite
    envelope: _Finite | None
    source: str
    inside: bool | None
    curve: Annotated[list[list[_Finite]], AfterValidator(_paired)]


def review_of(path: Path) -> dict[str, Any]:
    """The shot's name, frame rate and reviews by vehicle from a delivery's ``report.json``. Raises ``InputError``."""
    with reading_report(path) as report:
        found = {name: summary["review"] for name, summary in report["vehicles"].items()}
        try:
            TypeAdapter(dict[str, list[_Row]]).validate_python(found)
        except ValidationError as error:
            wrong = error.errors(include_url=False)[0]
            key = dotted(("vehicles", *wrong["loc"]))
            raise refuse(path / SIGN, key, f"not a review: {wrong['msg']}", REMEDY) from None
        return {"shot": report["shot"], "fps": str(frame_rate(report["fps"])), "vehicles": found}


def outside(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """The rows outside the envelope, in words."""
    return [
        f"{row['name']}: {shown(row['worst'], row['unit'])}, {shown(row['envelope'], row['unit'])} in the envelope, "
        f"at frame {row['frame']:g}"
        for row in rows
        if row["inside"] is False
    ]


def shown(value: float, unit: str) -> str:
    """A value in the user's units: degrees, per cent and kilowatts."""
    factor, name = {"share": (100.0, "%"), "W": (1e-3, "kW")}.get(unit) or in_degrees(unit)
    return f"{factor * value:.3g} {name}".rstrip()


class _Curve(NamedTuple):
    """A quantity over time: its ``values`` (n,), and the ``trait`` with its envelope, None if it has none."""

    name: str
    unit: str
    values: Array
    trait: Trait | None


def _curves(track: Track, vehicle: Any, world: World | None) -> Iterator[_Curve]:
    """Every quantity that the motion shows."""
    planar, traits = {"planar": vehicle.group.planar}, vehicle.character

    def reviewed(name: Reviewed, values: Array) -> _Curve:
        return _Curve(name, REVIEW_UNITS[name], values, traits.review.get(name))

    for name in dict.fromkeys([*traits.limits, *ALWAYS]):
        yield _Curve(name, LIMITS[name].unit, MEASURES[name](track, planar, Scene()), traits.limits.get(name))
    yield reviewed("jerk", _jerk(track))
    yield reviewed("slip", _slip(track, vehicle))
    yield reviewed("settling", _settling(track, vehicle))
    if world is not None and flies(vehicle):
        yield reviewed("slide", _slide(track, vehicle, world))
    if track.controls is None or not len(vehicle.controls):
        return
    if (power := _power(track, vehicle, world)) is not None:
        yield reviewed("power", power)
    rates = [MEASURES["control_rate"](track, {"control": k}, Scene()) for k in range(len(vehicle.controls))]
    for control, rate in zip(vehicle.controls, rates, strict=True):
        trait, actuator = traits.control_rates.get(control.name), control.actuator
        if trait is None and np.isfinite(actuator.rate):
            most = actuator.rate
            trait = Trait(most, most, most, f"its actuator: {actuator.source}")
        if trait is not None:
            yield _Curve(f"rate of {control.name}", f"{control.unit}/s", rate, trait)
    lower, upper = (np.array([getattr(c, end) for c in vehicle.controls]) for end in ("lower", "upper"))
    bounded = np.isfinite(upper - lower)
    if bounded.any():
        balance = steady(vehicle, (0.0, 0.0, 0.0))
        idle = balance.controls if balance.holds else np.full(len(lower), np.nan)
        use = _use(*(values[..., bounded] for values in (track.controls, lower, upper, idle)))
        yield reviewed("saturation", use.max(axis=1))
    ranges = np.where(bounded, upper - lower, 2 * np.array([c.scale for c in vehicle.controls]))
    yield reviewed("reversals", _reversals(track, ranges))
    names = {name: trait.normal for name, trait in traits.control_rates.items()}
    most = np.array([names.get(control.name, control.scale) for control in vehicle.controls])
    yield reviewed("ease", _ease(track, np.array(rates).T / most))


def _jerk(track: Track) -> Array:
    """Magnitude of the jerk, m/s^3, on average over half a second; nan near the ends."""
    step, n = max(round(SPAN * float(track.fps) * PER_FRAME / 2), 1), len(track.frames)
    found = np.full(n, np.nan)
    if n > 2 * step:  # the change of the mean acceleration from one quarter of a second to the next
        first = (track.velocities[step : n - step] - track.velocities[: n - 2 * step]) / (SPAN / 2)
        second = (track.velocities[2 * step :] - track.velocities[step : n - step]) / (SPAN / 2)
        found[step : n - step] = np.linalg.norm(second - first, axis=1) / (SPAN / 2)
    return found


def _slip(track: Track, vehicle: Any) -> Array:
    """Angle between the nose or tail and the velocity of the body's origin, such as a car's rear axle, seen from above,
    rad; nan below 1 m/s."""
    nose, velocities = track.rotations[:, :2, 0], _rotated(track.rotations, _at_origin(track, vehicle))
    ahead = np.sum(nose * velocities[:, :2], axis=1)
    aside = nose[:, 0] * velocities[:, 1] - nose[:, 1] * velocities[:, 0]
    angle = np.arctan2(np.abs(aside), np.abs(ahead))
    return np.where(np.hypot(ahead, aside) > MOVES, angle, np.nan)


def _at_origin(track: Track, vehicle: Any, wind: ArrayLike = (0.0, 0.0, 0.0)) -> Array:
    """Velocities of the body's origin relative to the air (n, 3) m/s, body axes."""
    relative = _rotated(track.rotations.transpose(0, 2, 1), track.velocities - np.asarray(wind))
    return np.asarray(relative + np.cross(track.omegas, vehicle.origin))


def _rotated(rotations: Array, vectors: Array) -> Array:
    """``rotations`` (n, 3, 3) applied to ``vectors`` (n, 3)."""
    return np.einsum("nij,nj->ni", rotations, vectors)


def _power(track: Track, vehicle: Any, world: World | None) -> Array | None:
    """Power at the shafts of the rotors (n,) W; None if the vehicle does not state it."""
    import casadi as ca

    law = getattr(vehicle, "power", None)
    if law is None or track.controls is None:
        return None
    air, c, height = ca.SX.sym("air", 6), ca.SX.sym("c", len(vehicle.controls)), ca.SX.sym("height")
    power = ca.Function("power", [air, c, height], [law(air, c, height)])
    airs = np.hstack([track.omegas, _at_origin(track, vehicle, (0.0, 0.0, 0.0) if world is None else world.wind)])
    heights = _heights(vehicle, track.positions + track.rotations @ vehicle.origin, world)
    return np.asarray(power.map(len(airs))(airs.T, track.controls.T, heights[None])).ravel()


def _heights(vehicle: Any, points: Array, world: World | None) -> Array:
    """Heights (n,) m of a vehicle's body frame at ``points`` (n, 3) m above the ground that its rotors feel; inf over
    none."""
    ground = getattr(above_ground(vehicle, world, points), "ground", None)
    return np.full(len(points), np.inf) if ground is None else points[:, 2] - ground.heights(points[:, :2])


def _rests(track: Track) -> NDArray[np.intp]:
    """The samples at which the vehicle rests."""
    return np.flatnonzero(np.linalg.norm(track.velocities, axis=1) < RESTS)


def _settling(track: Track, vehicle: Any) -> Array:
    """How far the body's origin goes to and fro within two seconds of rest, m, seen from above or, if it flies, in
    height; nan elsewhere."""
    found, reach = np.full(len(track.frames), np.nan), round(SETTLES * float(track.fps) * PER_FRAME)
    stays, last = _stays(track), len(found) - 1
    places = track.positions + track.rotations @ vehicle.origin
    ways = (slice(0, 2),) if vehicle.group.planar else (slice(0, 2), slice(2, 3))
    for k, (begin, end) in enumerate(stays):
        since = (stays[k - 1][1] + begin) // 2 if k > 0 else 0
        until = (end + stays[k + 1][0]) // 2 if k + 1 < len(stays) else last
        arrival = places[max(since, begin - reach) : begin + 1][::-1]
        departure = places[end : min(until, end + reach) + 1]
        for i, leg in ((begin, arrival), (end, departure)):
            found[i] = np.nanmax([found[i], *(_to_and_fro(leg[:, way]) for way in ways)])
    return found


def _slide(track: Track, vehicle: Any, world: World) -> Array:
    """Largest speed of a foot over the ground, m/s, just above it within two seconds of standing there; nan
    elsewhere."""
    found, reach = np.full(len(track.frames), np.nan), round(SETTLES * float(track.fps) * PER_FRAME)
    for begin, end in _stays(track):
        span = np.arange(max(begin - reach, 0), min(end + reach + 1, len(found)))
        arms = np.einsum("nij,kj->nki", track.rotations[span], feet(vehicle))
        places = track.positions[span, None] + arms
        heights = places[..., 2] - height_below(world, places.reshape(-1, 3)).reshape(places.shape[:2])
        if heights[begin - span[0]].min() < STANDS:
            omegas = _rotated(track.rotations[span], track.omegas[span])
            velocities = track.velocities[span, None] + np.cross(omegas[:, None], arms)
            speeds = np.linalg.norm(velocities[..., :2], axis=2).max(axis=1)
            found[span] = np.fmax(found[span], np.where(heights.min(axis=1) < LOW, speeds, np.nan))
    return found


def _stays(track: Track) -> list[tuple[int, int]]:
    """The first and last sample of each time at which the vehicle rests and does not only turn back."""
    rests = _rests(track)
    runs = np.split(rests, np.flatnonzero(np.diff(rests) > 1) + 1) if len(rests) else []
    ends, least = {0, len(track.frames) - 1}, STAYS * float(track.fps) * PER_FRAME
    return [(int(run[0]), int(run[-1])) for run in runs if len(run) > least or ends & {run[0], run[-1]}]


def _to_and_fro(places: Array) -> float:
    """How far a path (n, d), which starts at rest, comes nearer again to a place where it was, m: the largest sum.

    A smooth bend of less than half a turn never does so; what passes its mark and returns does so by the way back.
    """
    places = places[:: -(-len(places) // POINTS)]
    distances = np.linalg.norm(places[:, None] - places[None], axis=2)
    nearer = np.triu(np.maximum(distances[:, :-1] - distances[:, 1:], 0.0))  # from each place on
    return float(nearer.sum(axis=1).max())


def _use(controls: Array, lower: Array, upper: Array, idle: Array) -> Array:
    """How near each control (n, c) is to its bounds: 0 in the middle of its range, 1 at a bound.

    A bound at which it is ``idle`` (c,) with the vehicle at rest, as of a brake, does not count: it is 0 there.
    """
    room = upper - lower
    released = np.minimum(np.abs(idle - lower), np.abs(idle - upper)) < RELEASED * room
    return np.abs(controls - np.where(released, idle, (lower + upper) / 2)) / np.where(released, room, room / 2)


def _reversals(track: Track, ranges: Array) -> Array:
    """Reversals per minute up to each sample (n,) of the control with the most: it turned back by a tenth of its
    range."""
    assert track.controls is not None
    minutes = max(float(track.seconds[-1] - track.seconds[0]), SETTLES) / 60
    counts = np.zeros(track.controls.shape)
    for k, span in enumerate(ranges.tolist()):
        extreme, way, count = track.controls[0, k], 0, 0
        for i, value in enumerate(track.controls[:, k].tolist()):
            if way * (value - extreme) > 0 or (way == 0 and abs(value - extreme) > TURN * span):
                way, extreme = (1 if value > extreme else -1), value
            elif way and way * (extreme - value) > TURN * span:
                way, extreme, count = -way, value, count + 1
            counts[i, k] = count
    return np.asarray(counts.max(axis=1) / minutes)


def _ease(track: Track, rates: Array) -> Array:
    """The largest rate of a control (n,), as a share of its largest, where the motion begins or ends at rest."""
    found, rests = np.full(len(track.frames), np.nan), _rests(track)
    ends = [k for k in (0, len(track.frames) - 1) if k in rests]
    found[ends] = rates[ends].max(axis=1)
    return found


def _thinned(frames: Array, values: Array) -> list[list[float]]:
    """Frames and values of a curve: of each interval its largest value."""
    parts = np.array_split(np.arange(len(frames)), min(POINTS, len(frames)))
    chosen = [int(part[np.argmax(values[part])]) for part in parts]
    return [[_short(frames[k]) for k in chosen], [_short(values[k]) for k in chosen]]


def _short(value: float) -> float:
    return float(f"{value:.5g}") if abs(value) < 1e4 else float(f"{value:.7g}")
