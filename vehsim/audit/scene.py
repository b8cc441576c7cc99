"""The surroundings from which a motion must keep clear, as measures query them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vehsim.audit.track import Track
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]


class Scene:
    """Empty space; subclasses describe a `World` or a composed stage."""

    reach = 0.0
    """Greatest distance of any point of the vehicle from its root, m."""
    fastest = 0.0
    """Greatest speed of any point of any other moving object, m/s."""

    def away(self, track: Track, obstacles_only: bool) -> Array:
        """Signed distance (n,) m of the vehicle to terrain and obstacles at every sample; negative inside."""
        return np.full(len(track.frames), np.inf)

    def swept(self, track: Track) -> Array | None:
        """How far any point of the vehicle's parts has moved against its body since the first sample, at most, (n,) m;
        None if that is not known."""
        return np.zeros(len(track.frames))

    def followed(self, track: Track, relief: Sequence[Sequence[float]] | None) -> tuple[Array, Array]:
        """Of the ground below a vehicle on wheels: its slopes (n, 2) m/m, along X and Y, and the vertical acceleration
        (n,) m/s^2 that its bend adds to that of the slope.

        The ground is as smooth as it carries the weight: in the box ``relief`` (2, 2) m, level outside; None: level
        everywhere. nan if that is not known.
        """
        found = np.full((len(track.frames), 3), 0.0 if relief is None else np.nan)
        return found[:, :2], found[:, 2]

    def wheel_gap(self, track: Track, prims: Sequence[str]) -> Array:
        """Height (n,) m above the ground of the wheel with the largest gap; nan if there are no wheels."""
        return np.full(len(track.frames), np.nan)

    def wheel(self, track: Track, wheel: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        """Of a wheel as `rolling_wheels` describes it: centre (n, 3) m and axle (n, 3), pointing to the left, in the
        world, and how far it has turned forwards (n,) rad; nan if that is not known."""
        missing = np.full((len(track.frames), 7), np.nan)
        return missing[:, :3], missing[:, 3:6], missing[:, 6]

    def spin(self, track: Track, channel: str) -> tuple[Array, Array]:
        """How far a part that a ``channel`` turns at a rate has turned (n,) rad, and this rate by its law (n,) rad/s;
        nan if that is not known."""
        missing = np.full((len(track.frames), 2), np.nan)
        return missing[:, 0], missing[:, 1]


class WorldScene(Scene):
    """A `World` and the ``vehicle`` that moves in it: trailers turn and tilt, all other hulls are as at rest."""

    def __init__(self, world: Any, vehicle: Any) -> None:
        self.world, self.vehicle = world, vehicle
        self.reach, self.fastest = _reach(vehicle), 0.0
        for other in () if world is None else world.moving:
            begin = other.clip.start_frame / float(other.clip.fps)
            _, _, velocities, omegas = other.motion_at(begin + other.clip.times)
            speeds = np.linalg.norm(velocities, axis=1) + _reach(other.clip.vehicle) * np.linalg.norm(omegas, axis=1)
            turning = np.diff(_swept(other.clip.vehicle, other.channels_at(begin + other.clip.times), len(speeds)))
            swinging = float((turning / np.diff(other.clip.times)).max(initial=0.0))
            self.fastest = max(self.fastest, float(speeds.max(initial=0.0)) + swinging)

    def away(self, track: Track, obstacles_only: bool) -> Array:
        from vehsim.lie.quaternions import quaternions

        if self.world is None:
            return super().away(track, obstacles_only)
        poses = track.positions, quaternions(track.rotations)
        return _away(self.world, self.vehicle, *poses, track.seconds, track.channels, obstacles_only)

    def followed(self, track: Track, relief: Sequence[Sequence[float]] | None) -> tuple[Array, Array]:
        if relief is None or self.world is None or self.world.terrain is None:
            return super().followed(track, relief)
        from vehsim.world.ground.slope import relief_of

        ground = relief_of(self.world.terrain, np.asarray(relief, float))
        return ground.followed(track.positions[:, :2], track.velocities[:, :2])

    def swept(self, track: Track) -> Array:
        return _swept(self.vehicle, track.channels, len(track.frames))

    def wheel(self, track: Track, wheel: Mapping[str, Any]) -> tuple[Array, Array, Array]:
        from vehsim.lie.quaternions import matrices, quaternions
        from vehsim.rig.linkage import part_poses

        if wheel["channel"] not in track.channels:
            return super().wheel(track, wheel)
        root = track.positions, quaternions(track.rotations)
        positions, orientations = part_poses(self.vehicle.rig, wheel["prim"], track.channels, *root)
        R = matrices(orientations)
        turned = wheel["gain"] * track.channels[wheel["channel"]]
        return positions + R @ wheel["centre"], R @ wheel["axle"], turned

    def spin(self, track: Track, channel: str) -> tuple[Array, Array]:
        import casadi as ca

        law = self.vehicle.channels[channel].rate
        if track.controls is None or channel not in track.channels:
            return super().spin(track, channel)
        given = [track.seconds - track.seconds[0], *self._motion(track), track.controls]
        columns = [np.reshape(values, (len(track.frames), -1)).T for values in given]
        symbols = [ca.SX.sym("x", len(column)) for column in columns]
        rates = ca.Function("rate", symbols, [law(*symbols)])(*columns)
        return track.channels[channel], np.broadcast_to(np.asarray(rates, float).ravel(), len(track.frames))

    def _motion(self, track: Track) -> tuple[Array, Array, Array]:
        """Joints, their rates, and the twist of the body frame, (n, .) each."""
        n, R = len(track.frames), track.rotations
        joints, rates = (np.array([*some.values()]).reshape(-1, n).T for some in (track.joints, track.joint_rates))
        origin = np.zeros(3) if self.vehicle.rig is None else np.asarray(self.vehicle.rig.origin)
        velocities = np.einsum("nji,nj->ni", R, track.velocities) + np.cross(track.omegas, origin)
        twists = np.hstack([track.omegas, velocities])
        return joints, rates, twists[:, 2:5] if self.vehicle.group.planar else twists


def rolling_wheels(rig: Any) -> list[dict[str, Any]]:
    """The wheels of a rig that ``roll_*`` channels turn, as JSON data.

    Each has its ``prim`` below the root, ``radius`` m, and, in the root's frame at rest, ``centre`` (3,) m and ``axle``
    (3,), which points to the left; it turns forwards by ``gain`` times the ``channel``.
    """
    from vehsim.rig.linkage import screws
    from vehsim.world.ground.wheels import wheels_of

    found = []
    for wheel in wheels_of(rig):
        if wheel.roll is None or not wheel.roll.startswith("roll_"):
            continue
        drive = rig.drives[wheel.roll]
        (screw,) = [screw for screw in screws(rig, drive.prim) if screw.channel == wheel.roll]
        gain = float(np.copysign(np.linalg.norm(screw.axis), screw.axis[1]))
        found.append(
            {
                "prim": drive.prim,
                "radius": float(wheel.rings[:, 1].max()),
                "centre": wheel.centre.tolist(),
                "axle": (screw.axis / gain).tolist(),
                "channel": wheel.roll,
                "gain": gain,
            }
        )
    return found


def can_hit(vehicle: Any, world: Any) -> bool:
    """Whether there is anything from which a vehicle must keep clear: on the ground, obstacles, walls and roofs."""
    terrain = None if world is None else world.terrain
    near = terrain is not None and not (vehicle.group.planar and terrain.surface is None)
    return vehicle.rig is not None and world is not None and bool(world.obstacles or near)


def distances(clip: Clip, world: Any) -> Array:
    """Signed distance (n,) m of a vehicle to terrain and obstacles, on the ground to obstacles and the walls and roofs
    of a terrain with overhangs, at every sample."""
    poses, seconds = (clip.positions, clip.orientations), clip.frames / float(clip.fps)
    return _away(world, clip.vehicle, *poses, seconds, clip.channels, clip.vehicle.group.planar)


def _away(
    world: Any, vehicle: Any, positions: Array, orientations: Array, seconds: Array, channels: Any, obstacles_only: bool
) -> Array:
    if obstacles_only:
        found = world.clearance_by_obstacle(vehicle, positions, orientations, seconds, channels)
        walls = np.inf
        if vehicle.group.planar:
            walls = world.clearance_from_walls(vehicle, positions, orientations, channels)
        return np.minimum(found.min(axis=1, initial=np.inf), walls)
    return np.asarray(world.clearance(vehicle, positions, orientations, seconds, channels))


def _swept(vehicle: Any, channels: Mapping[str, Array], count: int) -> Array:
    """How far trailers and discs have moved against their vehicle since the first of ``count`` samples, at most, m."""
    from vehsim.world.obstacles.articulated import swings_of

    moved = np.zeros(count)
    for name, far in swings_of(vehicle).items() if channels else ():
        if name in channels:
            moved[1:] += far * np.cumsum(np.abs(np.diff(channels[name])))
    return moved


def _reach(vehicle: Any) -> float:
    from vehsim.world.obstacles.obstacles import hulls_of

    return max((float(np.linalg.norm(hull, axis=1).max()) for hull in hulls_of(vehicle)), default=0.0)
