"""The measure of each kind of ask: a few lines of geometry each, independent of the optimiser.

A measure takes a `Track` cut to the ask's frames, the requested values and the scene, and returns a value for every
sample. If the request says ``planar``, a vehicle on wheels or calm water is measured from above, and its rotation by
its heading, because the ground and its springs determine the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.audit.scene import Scene
from vehsim.audit.track import PER_FRAME, Track
from vehsim.constants import GRAVITY
from vehsim.runtime.registry import Registry

Array = NDArray[np.float64]
Wanted = Mapping[str, Any]

Measure = Callable[[Track, Wanted, Scene], Array]

STRIDE = 16
"""Frames between the first distances to terrain and obstacles; between them it is measured where it may be least."""


def _position(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the root from a place, along the axis with the largest distance, m."""
    off = np.abs(track.positions - wanted["position"])[:, wanted["axes"]].max(axis=1)
    return _less(off, track.blur.position)


def _distance(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the root from a place, along some axes, m."""
    off = _norms((track.positions - wanted["position"])[:, wanted["axes"]])
    return _less(off, track.blur.position)


def _off_path(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of a point of the vehicle from a polyline, seen from above, m."""
    points = np.array(wanted["points"], float)[:, :2]
    at = (track.positions + track.rotations @ np.asarray(wanted["offset"], float))[:, None, :2]
    begin, along = points[:-1], np.diff(points, axis=0)
    share = np.sum((at - begin) * along, axis=2) / np.maximum(np.sum(along**2, axis=1), 1e-12)
    off = _norms(at - begin - np.clip(share, 0, 1)[..., None] * along).min(axis=1)
    return _less(off, track.blur.position)


def _swing(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Half of the range of a joint, plus half of what linear interpolation hides of its peaks, at the last sample; nan
    before it."""
    hidden = track.blur.joints.get(wanted["joint"], np.zeros(1)).max()
    return _at_end(track, (np.ptp(_joint(track, wanted, scene)) + hidden) / 2)


def _heading(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Angle between the nose, seen from above, and a heading, rad."""
    yaw = np.arctan2(track.rotations[:, 1, 0], track.rotations[:, 0, 0])
    off = np.abs((yaw - wanted["heading"] + np.pi) % (2 * np.pi) - np.pi)
    return _less(off, track.blur.angle)


def _orientation(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Angle of the rotation from a requested orientation, rad."""
    from vehsim.lie.quaternions import matrices

    q = np.asarray(wanted["orientation"], float)
    return _less(_angles(matrices(q / np.linalg.norm(q)), track.rotations), track.blur.angle)


def _velocity(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Magnitude of the difference from a velocity, m/s."""
    off = np.linalg.norm((track.velocities - wanted["velocity"])[:, wanted["axes"]], axis=1)
    return _less(off, track.blur.velocity)


def _speed_error(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Difference from a speed, m/s."""
    off = np.abs(_norms(_shown(track.velocities, wanted)) - wanted["speed"])
    return _less(off, track.blur.velocity)


def _joint_error(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Difference from a joint's value."""
    return np.abs(_joint(track, wanted, scene) - wanted["value"])


def _drift(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the root from its place at the first sample, m."""
    return _norms(_shown(track.positions - track.positions[0], wanted))


def _turned(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Rotation angle since the first sample, rad."""
    return _between(track.rotations[0], track.rotations, wanted)


def _closure(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the last sample from the first, m; nan before."""
    return _at_end(track, _norms(_shown(track.positions[-1] - track.positions[0], wanted)))


def _closure_angle(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Angle between the first and the last orientation, rad; nan before."""
    return _at_end(track, _between(track.rotations[0], track.rotations[-1:], wanted)[0])


def _closure_velocity(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Difference between the last velocity and the first, m/s; nan before."""
    off = _norms(_shown(track.velocities[-1] - track.velocities[0], wanted))
    blur = track.blur.velocity[0] + track.blur.velocity[-1]
    return _at_end(track, max(off - blur, 0.0))


def _gate_plane(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Signed distance of the root from a gate's plane, m."""
    return np.asarray(_in_gate(track, wanted)[:, 0])


def _gate_opening(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Place of the root in a gate's opening, relative to its edge: 1 is on the edge."""
    along, up = (np.abs(_in_gate(track, wanted)[:, 1:]) / np.asarray(wanted["half"])).T
    if wanted["planar"]:
        return np.asarray(along)
    return np.asarray(np.hypot(along, up) if wanted["round"] else np.maximum(along, up))


def _gate_direction(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """The highest velocity through a gate that the poses allow, m/s."""
    axis = np.array(wanted["gate"][0])
    if wanted["planar"]:
        axis[2] = 0.0
    return np.asarray(track.velocities @ axis + track.blur.velocity)


def _in_gate(track: Track, wanted: Wanted) -> Array:
    off = track.positions - wanted["position"]
    if wanted["planar"]:
        off[:, 2] = 0.0
    return np.asarray(off @ np.asarray(wanted["gate"]).T)


def _speed(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Speed of the root, m/s."""
    return _norms(_shown(track.velocities, wanted))


def _ceiling(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Height of the root, m."""
    return track.positions[:, 2]


def _climb(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Vertical speed, up or down, m/s.

    The velocities of a vehicle that moves in the plane are level; the ground and its springs raise it.
    """
    if wanted.get("planar") and len(track.frames) > 1:
        return np.abs(np.gradient(track.positions[:, 2], track.seconds))
    return np.abs(track.velocities[:, 2])


def _turn_rate(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Magnitude of the angular velocity, rad/s."""
    if not wanted.get("planar"):
        return _less(_norms(track.omegas), track.blur.omega)
    nose, aside, up = np.moveaxis(track.rotations, 2, 0)
    moving = track.omegas[:, 2:] * aside - track.omegas[:, 1:2] * up  # rate of change of the nose's direction
    rate = (nose[:, 0] * moving[:, 1] - nose[:, 1] * moving[:, 0]) / (nose[:, 0] ** 2 + nose[:, 1] ** 2)
    return _less(np.abs(rate), track.blur.omega)


def _bank(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Angle between the body's Z axis and the world's, rad."""
    return np.arccos(np.clip(track.rotations[:, 2, 2], -1.0, 1.0))


def _acceleration(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Magnitude of the root's mean acceleration over the frame around each sample, m/s^2; nan within half a frame of
    the ends."""
    return _norms(_shown(_accelerations(track), wanted))


def _grip(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """The friction that tyres need, over the frame around each sample: the force along the ground over that across it.

    The vehicle follows the ground. inf where that falls away faster than gravity; nan within half a frame of the ends.
    """
    slopes, lifts = scene.followed(track, wanted.get("relief"))
    level = _accelerations(track)[:, :2]
    force = np.column_stack([level, np.sum(level * slopes, axis=1) + lifts + GRAVITY])
    normal = np.column_stack([-slopes, np.ones(len(slopes))]) / np.hypot(1, _norms(slopes))[:, None]
    across = np.sum(force * normal, axis=1)
    along = _norms(force - across[:, None] * normal)
    return np.asarray(np.divide(along, across, out=np.full_like(along, np.inf), where=~(across <= 0)))


def _g_load(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Acceleration felt by the crew, over the frame around each sample, in g; nan within half a frame of the ends."""
    return _norms((_shown(_accelerations(track), wanted) + np.array([0.0, 0.0, GRAVITY])) / GRAVITY)


def _accelerations(track: Track) -> Array:
    half, n = PER_FRAME // 2, len(track.frames)
    found = np.full((n, 3), np.nan)
    if n > PER_FRAME:
        change = track.velocities[PER_FRAME:] - track.velocities[:-PER_FRAME]
        found[half : n - half] = change * float(track.fps)
    return found


def _steering(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Steering angle, to either side, rad: its tangent is the joint ``sigma``."""
    return np.abs(np.arctan(track.joints["sigma"]))


def _steering_rate(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Rate of the steering angle, rad/s."""
    return np.abs(track.joint_rates["sigma"] / (1 + track.joints["sigma"] ** 2))


def _joint(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """A joint's value."""
    return track.joints[wanted["joint"]]


def _joint_rate(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """A joint's rate."""
    return track.joint_rates[wanted["joint"]]


def _control_rate(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Rate of a control, of either sign, in its unit per second; nan without controls, as on a stage."""
    if track.controls is None or len(track.frames) < 2:
        return np.full(len(track.frames), np.nan)
    rates = np.abs(np.diff(track.controls[:, wanted["control"]]) / np.diff(track.seconds))
    return np.append(rates, rates[-1])


def _command(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """The command that a control follows with a lag, in the control's unit; nan without controls, as on a stage."""
    if track.controls is None or len(track.frames) < 2:
        return np.full(len(track.frames), np.nan)
    control = track.controls[:, wanted["control"]]
    commands = control[1:] + wanted["lag"] * np.diff(control) / np.diff(track.seconds)
    return np.append(commands, commands[-1])


def _look(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Angle between a body axis and the direction to a point, rad."""
    shown = slice(0, 2 if wanted["level"] else 3)
    there = (np.asarray(wanted["at"]) - track.positions)[:, shown]
    axis = wanted["sign"] * track.rotations[:, shown, wanted["axis"]]
    cosine = np.sum(there * axis, axis=1) / np.maximum(_norms(there) * _norms(axis), 1e-12)
    return _less(np.arccos(np.clip(cosine, -1.0, 1.0)), track.blur.angle)


def _outside(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the root outside a box, m."""
    low, high = (
        np.array([end if x is None else x for x in side])
        for end, side in zip((-np.inf, np.inf), wanted["box"], strict=True)
    )
    off = np.maximum(low - track.positions, track.positions - high).max(axis=1)
    return _less(np.maximum(off, 0.0), track.blur.position)


def _descent(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Speed of descent minus the permitted speed at its distance from a landing, m/s."""
    distance = _norms(track.positions - wanted["place"])
    fast = -track.velocities[:, 2] - wanted["sink"] * distance
    return _less(fast, track.blur.velocity)


def _stands(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Signed distance of the hulls from the ground or obstacle below, m, on whole frames; nan between."""
    return _on_frames(track, lambda part: scene.away(part, False))


def _wheels(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Height above or below the ground of the wheel with the largest gap, m, on whole frames; nan between."""
    return _on_frames(track, lambda part: scene.wheel_gap(part, wanted["prims"]))


def _rolling(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """How far a wheel has turned since any earlier frame, more or less than it came and beyond a share of that, rad, on
    whole frames, of the worst wheel; nan between."""

    def off(part: Track) -> Array:
        return np.max([_off_pace(*_rolled(part, wheel, scene), wanted["share"]) for wheel in wanted["wheels"]], axis=0)

    return _on_frames(track, off)


def _rolled(track: Track, wheel: Mapping[str, Any], scene: Scene) -> tuple[Array, Array]:
    """How far a wheel has turned, and how far it rolls on the way of its centre at right angles to its axle, on an arc
    between two samples, (n,) rad each."""
    centres, axles, turned = scene.wheel(track, wheel)
    steps, axle = np.diff(centres, axis=0), axles[1:] + axles[:-1]
    axle = axle / np.linalg.norm(axle, axis=1, keepdims=True)
    ahead = steps - np.sum(steps * axle, axis=1, keepdims=True) * axle
    half = np.minimum(_norms(np.diff(axles, axis=0)) / 2, 1.0)
    arcs = _norms(ahead) / np.sinc(np.arcsin(half) / np.pi)
    forward = ahead[:, 1] * axle[:, 0] < ahead[:, 0] * axle[:, 1]  # an axle points to the left
    way = np.concatenate([[0.0], np.cumsum(np.where(forward, arcs, -arcs))])
    return turned, way / wheel["radius"]


def _spinning(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """How far a propeller or rotor has turned since any earlier sample, more or less than its law says and beyond a
    share of that, rad; nan without controls, as on a stage."""
    turned, rates = scene.spin(track, wanted["channel"])
    steps = np.diff(track.seconds) * (rates[1:] + rates[:-1]) / 2
    return _off_pace(turned, np.concatenate([[0.0], np.cumsum(steps)]), wanted["share"])


def _off_pace(values: Array, expected: Array, share: float) -> Array:
    """By how much two sums (n,) have drifted apart since any earlier sample, beyond a ``share`` of the way of the
    expected one."""
    allowed = share * np.concatenate([[0.0], np.cumsum(np.abs(np.diff(expected)))])
    apart = [sign * (values - expected) - allowed for sign in (1.0, -1.0)]
    return np.asarray(np.max([drift - np.minimum.accumulate(drift) for drift in apart], axis=0))


def _clearance(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the hulls from terrain and obstacles, m, plus the allowance near a landing; nan where it is known to
    be larger."""
    least = float(wanted["clearance"])

    def measured(part: Track) -> Array:
        away = scene.away(part, wanted["obstacles_only"])
        for place in wanted.get("landings", ()):
            tip = wanted.get("round", 0.0)
            far = np.hypot(_norms(part.positions - place), tip) - tip
            near = np.tanh(wanted["slope"] * far / max(least, 1e-6))
            away = away + least * (1 - near)
        return away + part.blur.position

    swept = scene.swept(track)
    moved = np.concatenate([[0.0], np.cumsum(_norms(np.diff(track.positions, axis=0)))])
    turned = np.concatenate([[0.0], np.cumsum(_norms(track.omegas[1:]))]) / (PER_FRAME * float(track.fps))
    others = scene.fastest / float(track.fps) * np.arange(len(moved)) / PER_FRAME
    way = (1 + wanted["slope"]) * moved + scene.reach * turned + others + (0.0 if swept is None else swept)

    def lower(a: NDArray[np.intp], b: NDArray[np.intp]) -> Array:
        """A lower bound of the distances between two samples each."""
        sure = found - track.blur.position
        return np.asarray((sure[a] + sure[b] - (way[b] - way[a])) / 2)

    whole = _whole(track)
    found = np.full(len(track.frames), np.nan)
    rows = np.union1d(whole[:: 1 if swept is None else STRIDE], whole[-1:])
    while len(rows):
        found[rows] = measured(track._select(rows))
        known = whole[~np.isnan(found[whole])]
        finite = found[known][np.isfinite(found[known])]
        needed = max(least, float(finite.min(initial=np.inf)))
        a, b = known[:-1], known[1:]
        unsure = (lower(a, b) < needed) | np.isinf(found[a]) | np.isinf(found[b])
        place = np.searchsorted(whole, known)
        middle = (place[:-1] + place[1:]) // 2
        rows = whole[middle[unsure & (middle > place[:-1])]]
    known = np.flatnonzero(np.isfinite(found))
    near = lower(known[:-1], known[1:]) < least
    for a, b in zip(known[:-1][near], known[1:][near], strict=True):
        rows = np.arange(a + 1, b)
        if len(rows):
            found[rows] = measured(track._select(rows))
    return found


def _on_frames(track: Track, measured: Callable[[Track], Array]) -> Array:
    """An expensive value on whole frames and at both ends; nan between."""
    found, whole = np.full(len(track.frames), np.nan), _whole(track)
    found[whole] = measured(track._select(whole))
    return found


def _whole(track: Track) -> NDArray[np.intp]:
    """The samples on whole frames, and both ends."""
    whole = np.abs(track.frames - np.round(track.frames)) < 1e-6
    whole[[0, -1]] = True
    return np.flatnonzero(whole)


def _angles(R: Array, others: Array) -> Array:
    """Angles (n,) rad between a rotation (3, 3) and others (n, 3, 3); accurate for small angles too."""
    chord = np.linalg.norm(others - R, axis=(1, 2)) / np.sqrt(8.0)
    return np.asarray(2 * np.arcsin(np.clip(chord, 0.0, 1.0)))


def _between(R: Array, others: Array, wanted: Wanted) -> Array:
    """Angles (n,) rad between a rotation and others; for ``planar`` requests between their headings."""
    if not wanted.get("planar"):
        return _angles(R, others)
    yaw = np.arctan2(others[:, 1, 0], others[:, 0, 0]) - np.arctan2(R[1, 0], R[0, 0])
    return np.abs((yaw + np.pi) % (2 * np.pi) - np.pi)


def _shown(vectors: Array, wanted: Wanted) -> Array:
    """Vectors (..., 3); for ``planar`` requests their horizontal components."""
    return vectors * [1.0, 1.0, 0.0] if wanted.get("planar") else vectors


def _norms(vectors: Array) -> Array:
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def _at_end(track: Track, value: Any) -> Array:
    found = np.full(len(track.frames), np.nan)
    found[-1] = value
    return found


def _less(values: Array, blur: Array) -> Array:
    """A difference minus the blur of the representation."""
    return np.maximum(values - blur, np.minimum(values, 0.0))


def _frame(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """The frame of the sample; differs from the requested frame if the motion does not reach it."""
    return track.frames


def _off_frame(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """Distance of the requested frame from a whole frame."""
    return np.abs(track.frames - np.round(track.frames))


def _law(track: Track, wanted: Wanted, scene: Scene) -> Array:
    """A component of a user's law; nan where the representation shows no controls.

    The law is a serialised CasADi function of position (3,), rotation (9,) by rows, velocity (3,), angular velocity
    (3,) in body axes, acceleration (3,), joints, their rates, controls, seconds since the frame ``start``, and the
    ground's slope (2,) and lift. For ``planar`` requests the rotation is the heading alone.
    """
    import casadi as ca

    n = len(track.frames)
    if track.controls is None:
        return np.full(n, np.nan)
    rotations = track.rotations
    if wanted["planar"]:
        yaw = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])
        zero, one = np.zeros(n), np.ones(n)
        rotations = np.array([[np.cos(yaw), -np.sin(yaw), zero], [np.sin(yaw), np.cos(yaw), zero], [zero, zero, one]])
        rotations = np.moveaxis(rotations, 2, 0)
    slopes, lifts = scene.followed(track, wanted.get("relief"))
    columns = [
        track.positions,
        rotations.reshape(n, 9),
        track.velocities,
        track.omegas,
        _accelerations(track),
        np.array([*track.joints.values()]).reshape(-1, n).T,
        np.array([*track.joint_rates.values()]).reshape(-1, n).T,
        track.controls,
        (track.seconds - wanted["start"] / float(track.fps))[:, None],
        slopes,
        lifts[:, None],
    ]
    law = ca.Function.deserialize(wanted["law"])  # those that were stored before slopes take fewer columns
    values = law(*(column.T for column in columns[: law.n_in()]))
    return np.asarray(values, float)[wanted["component"]]


MEASURES: Registry[Measure] = Registry(
    "vehsim.measures",
    {
        "frame": _frame,
        "off_frame": _off_frame,
        "position": _position,
        "distance": _distance,
        "off_path": _off_path,
        "swing": _swing,
        "heading": _heading,
        "orientation": _orientation,
        "velocity": _velocity,
        "speed_error": _speed_error,
        "joint_error": _joint_error,
        "drift": _drift,
        "turned": _turned,
        "closure": _closure,
        "closure_angle": _closure_angle,
        "closure_velocity": _closure_velocity,
        "gate_plane": _gate_plane,
        "gate_opening": _gate_opening,
        "gate_direction": _gate_direction,
        "speed": _speed,
        "ceiling": _ceiling,
        "climb": _climb,
        "turn_rate": _turn_rate,
        "bank": _bank,
        "acceleration": _acceleration,
        "g_load": _g_load,
        "grip": _grip,
        "steering": _steering,
        "steering_rate": _steering_rate,
        "joint": _joint,
        "joint_rate": _joint_rate,
        "control_rate": _control_rate,
        "command": _command,
        "look": _look,
        "outside": _outside,
        "descent": _descent,
        "stands": _stands,
        "clearance": _clearance,
        "wheels": _wheels,
        "rolling": _rolling,
        "spinning": _spinning,
        "law": _law,
    },
)
"""Measure name -> its function. Packages add the measures of their limits as entry points."""
