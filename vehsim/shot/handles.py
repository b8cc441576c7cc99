"""Motion through the handles: a vehicle that still moves at the ends of its motion continues, and came, by its physics.

Beyond its ends a vehicle keeps its controls. Afterwards it is simulated; before, the same discrete mechanics run
backwards: a variational step with ``-h`` reverses the step with ``h``. Where that would become violent, it comes with
constant velocity.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import SolveError, VehsimError
from vehsim.shot.follow_through import rests

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.integrators.integrator import Integrator
    from vehsim.integrators.phase import Phase
    from vehsim.world.world import World

Array = NDArray[np.float64]

SUDDENLY, FREELY = 2.0, np.array([0.5, 1.0])
"""How much more suddenly than in the motion itself velocities may change in the handle before it, as a factor, and what
they may do in any case, rad/s^2 and m/s^2."""


def carry_on(name: str, clip: Clip, first: int, last: int, handles: int, world: World) -> Clip:
    """The clip on frames ``first`` to ``last``, if it moves at its ends and lacks at most ``handles`` frames.

    If it rests, or lacks more, it is unchanged; warns if the motion cannot be continued.
    """
    lacking = {-1: last - clip.end_frame, 0: clip.start_frame - first}
    for end, frames in lacking.items():
        if 0 < frames <= handles and not rests(clip, end):
            try:
                clip = _after(clip, last, world) if end else _before(name, clip, first, world)
            except VehsimError as error:
                where = "after its last" if end else "before its first"
                message = f"{name}: it stands still in the handle {where} frame: its motion does not continue: {error}"
                warnings.warn(message, stacklevel=3)
    return clip


def _after(clip: Clip, last: int, world: World) -> Clip:
    from vehsim.simulation import simulate

    seconds = float((last - clip.start_frame) / clip.fps) - clip.times[-1]
    onward = simulate(clip.vehicle, world, clip.controls[-1], clip.state(-1), seconds, fps=clip.fps)
    return _joined(clip, replace(onward, times=onward.times + clip.times[-1]))


def _before(name: str, clip: Clip, first: int, world: World) -> Clip:
    from vehsim.integrators.integrator import Integrator
    from vehsim.integrators.record import build_clip
    from vehsim.world.ground.below import with_ground

    frames = clip.start_frame - first
    count = frames * int(np.ceil(240 / float(clip.fps)))
    h = frames / float(clip.fps) / count
    wind = np.asarray(world.wind, float)
    far = (float(np.linalg.norm(clip.twists[0])) + 10.0) * frames / float(clip.fps)
    places = clip.positions[0] + far * np.array([[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])
    level = world.on_level(clip.positions[:1], places[:, :2])
    integrator = Integrator(with_ground(clip.vehicle, level, places), h, wind=wind)
    controls, state = clip.controls[0], clip.state(0)
    start = integrator.start(state, controls)
    anchor = integrator.anchor(state, start)

    def earlier(phases: list[Phase]) -> Clip:
        """The clip of these phases, the last of which is the earliest."""
        g, r, pi = (np.array([getattr(phase, part) for phase in reversed(phases)], float) for part in ("g", "r", "pi"))
        times, held = h * np.arange(len(phases), dtype=float), np.tile(controls, (len(phases), 1))
        return build_clip(integrator.mechanics, times, g, r, pi, held, anchor, wind, fps=clip.fps, start_frame=first)

    try:
        phases = [start]
        for k in range(count):
            phases.append(integrator._substep(phases[-1], controls, controls, -h, -k))
        before = earlier(phases)
        sudden = not _as_gentle(before, clip)
    except SolveError:
        sudden = True
    if sudden:
        before = earlier(_steadily(integrator, start, controls, h, count, _limits(clip)))
        message = (
            f"{name}: it comes through the handle before frame {clip.start_frame} with the velocity it has there: "
            "backwards in time, its own motion with constant controls would become violent; if that matters, begin the "
            "plan earlier"
        )
        warnings.warn(message, stacklevel=4)
    return _joined(before, replace(clip, times=clip.times + frames / float(clip.fps)))


def _as_gentle(before: Clip, clip: Clip) -> bool:
    """Whether velocities change in a handle hardly more suddenly than in the motion itself, and joints stay within
    their limits.

    What drag and dampers slow down forwards in time grows backwards: a boat would spin, and a trailer fold.
    """
    low, high = _limits(clip)
    if ((before.joints < low) | (before.joints > high)).any():
        return False
    kinds = np.split(np.arange(clip.vehicle.group.dim), [1 if clip.vehicle.group.planar else 3])

    def largest(motion: Clip) -> Array:
        change = np.diff(motion.twists, axis=0) / np.diff(motion.times)[:, None]
        return np.array([np.linalg.norm(change[:, kind], axis=1).max(initial=0.0) for kind in kinds])

    return bool(np.all(largest(before) <= np.maximum(SUDDENLY * largest(clip), FREELY)))


def _limits(clip: Clip) -> tuple[Array, Array]:
    """The lowest and highest values of joints (s,), at least those of a motion."""
    given = [clip.vehicle.joint_limits.get(joint, (-np.inf, np.inf)) for joint in clip.vehicle.joints]
    low, high = np.array(given, float).reshape(-1, 2).T
    return np.minimum(low, clip.joints.min(axis=0)), np.maximum(high, clip.joints.max(axis=0))


def _steadily(
    integrator: Integrator, start: Phase, controls: Array, h: float, count: int, limits: tuple[Array, Array]
) -> list[Phase]:
    """Phases back in time from ``start``, each ``h`` s earlier than the one before, at its velocity in body axes, with
    joints up to their ``limits``."""
    import casadi as ca

    mechanics, t = integrator.mechanics, ca.SX.sym("t")
    group = mechanics.vehicle.group
    u, xi = mechanics.knot_velocity(*map(ca.SX, (start.r, start.pi, controls)))
    back = ca.Function("back", [t], [group.compose(ca.SX(start.g), group.exp(-t * xi)), start.r - t * u])
    found = [[np.asarray(part).ravel() for part in back(k * h)] for k in range(1, count + 1)]
    return [start, *(replace(start, g=g, r=np.clip(r, *limits)) for g, r in found)]


def _joined(earlier: Clip, later: Clip) -> Clip:
    """Two clips of one vehicle, the first sample of the later being the last of the earlier; channels continue."""
    names = ("positions", "orientations", "twists", "joints", "joint_rates", "controls")
    sign = np.sign(earlier.orientations[-1] @ later.orientations[0]) or 1.0
    later = replace(later, orientations=later.orientations * sign)
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(earlier, name)[:-1], getattr(later, name)]) for name in names
    }
    channels = {}
    for name, values in earlier.channels.items():
        on = later.channels.get(name, np.zeros(len(later)))
        integrated = (channel := earlier.vehicle.channels.get(name)) is not None and channel.rate is not None
        channels[name] = np.concatenate([values[:-1], on + (values[-1] - on[0]) * integrated])
    return replace(
        earlier,
        times=np.concatenate([earlier.times[:-1], later.times]),
        channels=channels,
        channel_rates=_both(earlier.channel_rates, later.channel_rates),
        events=[*earlier.events, *later.events],
        energy=_both(earlier.energy, later.energy),
        commands=_both(earlier.commands, later.commands),
        **columns,
    )


def _both(earlier: Mapping[str, Array], later: Mapping[str, Array]) -> dict[str, Array]:
    """What both clips have, one after the other."""
    return {name: np.concatenate([values[:-1], later[name]]) for name, values in earlier.items() if name in later}
