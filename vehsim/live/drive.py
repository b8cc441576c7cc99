"""A vehicle that is driven from the browser: the simulation of ``method = "sticks"``, in step with the clock.

The simulation asks a `Driver` for the controls at every knot. It answers when that knot's time has come, with what the
sticks say then, and keeps a row of the recording. The recording, simulated again, gives the same bytes.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.errors import InputError, Problem, SolveError
from vehsim.integrators.record import channel_laws
from vehsim.lie.quaternions import continuous, from_yaw, rotate, yaw_of
from vehsim.shot.checks import Context
from vehsim.shot.motions.simulate import ForwardMotion
from vehsim.shot.motions.sticks import SticksMotion
from vehsim.shot.shot import Shot
from vehsim.vehicles.definition.commands import Actuated
from vehsim.world.ground.placing import place_on_terrain

if TYPE_CHECKING:
    from vehsim.runtime.progress import Progress
    from vehsim.vehicles import State, Vehicle

Array = NDArray[np.float64]

LONGEST = 600.0
"""Longest recording of a shot without an end frame, s."""
RESPONSE = 0.15
"""Time in which a joint follows its stick, s."""
SHOWN = 1 / 60
"""Shortest time between two pictures, s."""
LATE = 0.1
"""How far a slow simulation may be behind the clock before the clock waits for it, s."""
SHARE = 0.3
"""Largest share of the time that pictures take from the simulation."""
SLOWER = (120, 60)
"""Steps per second, at least, that a drive falls back to where its default is too many for this machine."""
TRIED = 24
"""Steps that are timed before a drive."""
BUSY = 0.6
"""Largest share of the time that steps may take in a trial: pictures and other programs need the rest."""
START_DECIMALS = 6
"""Decimals of a start that is taken from a planned motion."""
SETTLED = 3
"""Samples from which wheels are placed on a terrain: the body leans, but its springs have settled."""


class Stopped(Exception):
    """The drive has ended."""


class Sticks:
    """Sticks from -1 to 1, one for each control of a vehicle, and the controls that they mean.

    In the middle, a stick gives zero, or the control that holds a flying vehicle in balance; at its ends, the
    control's bounds. The stick of a control that sets the rate of a joint with limits gives the joint's value instead,
    so that a released steering wheel returns.
    """

    def __init__(self, vehicle: Vehicle, wind: Array) -> None:
        from vehsim.planning.trim import flies, trim

        self.vehicle = vehicle
        self.values: Array = np.zeros(len(vehicle.controls))
        self._rest = trim(vehicle, (wind[0], wind[1], wind[2])) if flies(vehicle) else 0 * self.values
        scale = np.array([control.scale for control in vehicle.controls])
        self._lower, self._upper = (
            np.array([getattr(control, end) for control in vehicle.controls]) for end in ("lower", "upper")
        )
        self._ends = np.maximum(self._lower, self._rest - 3 * scale), np.minimum(self._upper, self._rest + 3 * scale)

    def move(self, values: Sequence[float]) -> None:
        """Put the sticks elsewhere. Raises ``InputError`` if there are not as many as controls."""
        if len(values) != len(self.values):
            raise InputError(f"{len(values)} sticks", f"{self.vehicle.name} has {len(self.values)}", key="values")
        self.values = np.array(values, float)

    def controls(self, state: State) -> Array:
        """The controls (c,) in SI units."""
        at, (low, high) = self.values, self._ends
        wanted = self._rest + np.where(at < 0, -at * (low - self._rest), at * (high - self._rest))
        limits = self.vehicle.joint_limits
        for joint, control in self.vehicle.driven:
            if (name := self.vehicle.joints[joint]) in limits:
                goal = at[control] * (limits[name][1] if at[control] > 0 else -limits[name][0])
                now = 0.0 if state.joints is None else float(state.joints[joint])
                wanted[control] = (goal - now) / RESPONSE
        return np.clip(wanted, self._lower, self._upper)


@dataclass(frozen=True)
class Clock:
    """The time that a drive keeps to; a test has its own."""

    now: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep


class Driver:
    """A law for `vehsim.simulate`: the controls of ``before`` until ``since`` s, then those of the sticks.

    Both are commands. ``show`` receives time, state and controls of every knot; ``ended`` says whether to stop, which
    raises `Stopped`. ``times`` and ``rows`` are the recording. ``behind`` s: by how much the simulation was too slow.
    """

    blind = True
    """It needs no state of the knot itself: see `vehsim.integrators.forced.Course`."""

    def __init__(
        self,
        sticks: Sticks,
        show: Callable[[float, State, Array], None],
        ended: Callable[[], bool],
        before: Callable[[float, Any], Array] | None = None,
        since: float = -1.0,
        clock: Clock | None = None,
    ) -> None:
        self._sticks, self._show, self._ended, self._clock = sticks, show, ended, clock or Clock()
        self._before, self._since = before, since
        self._started: float | None = None
        self._actuators = Actuated(sticks.vehicle, lambda t, state: self.rows[-1])
        self.behind = 0.0
        self.times: list[float] = []
        self.rows: list[Array] = []

    def __call__(self, t: float, state: State) -> Array:
        if self._ended():
            raise Stopped
        recorded = self._before is not None and t <= self._since
        if not recorded:
            self._wait(t)
        controls = self._before(t, state) if recorded and self._before else self._sticks.controls(state)
        self.times.append(t)
        self.rows.append(controls)
        self._show(t, state, self._actuators(t, state))  # the simulation's own actuators do the same
        return controls

    def _wait(self, t: float) -> None:
        """Wait until the clock shows ``t`` s; if it is much later, set it back."""
        now = self._clock.now()
        if self._started is None:
            self._started = now - t
        late = now - self._started - t
        if late < 0:
            self._clock.sleep(-late)
        elif late > LATE:
            self._started += late
            self.behind += late


class Trial:
    """A law that lets the simulation take some steps, and times them."""

    blind = True

    def __init__(self, sticks: Sticks, clock: Clock) -> None:
        self._sticks, self._clock = sticks, clock
        self._knots: list[float] = []

    def __call__(self, t: float, state: State) -> Array:
        self._knots.append(self._clock.now())
        if len(self._knots) > TRIED:
            raise Stopped
        return self._sticks.controls(state)

    @property
    def seconds(self) -> float:
        """The median time of a step, s."""
        return float(np.median(np.diff(self._knots))) if len(self._knots) > 1 else 0.0


class Window:
    """The last moments of a driven vehicle as a clip, with its channels: what a picture needs."""

    def __init__(self, vehicle: Vehicle, world: Any, fps: Fraction, first: int) -> None:
        self._vehicle, self._world, self._fps, self._first = vehicle, world, fps, first
        self._length = 1
        self._moving: Vehicle | None = None
        self._samples: list[tuple[float, State, Array, Array]] = []
        self._turned = np.zeros(0)
        self._last = 0.0

    def pass_by(self, t: float, state: State, controls: Array) -> None:
        """Count the turns of wheels and rotors up to ``t`` s."""
        if self._moving is None:
            self._begin(state)
        self._turned, self._last = self._turned + (t - self._last) * self._laws(t, state, controls)[1], t

    def add(self, t: float, state: State, controls: Array) -> Clip:
        """The clip up to ``t`` s."""
        vehicle = self._moving
        assert vehicle is not None
        values = self._laws(t, state, controls)[0] + self._turned
        self._samples = [one for one in self._samples[-self._length + 1 :] if self._length > 1]
        self._samples.append((t, state, controls, values))
        times, states, rows, channels = zip(*self._samples, strict=True)
        joints = np.zeros(len(vehicle.joints))
        clip = Clip(
            vehicle=vehicle,
            times=np.array(times),
            positions=np.array([each.position for each in states], float),
            orientations=continuous(np.array([each.orientation for each in states], float)),
            twists=np.array([each.twist for each in states], float),
            joints=np.array([joints if each.joints is None else each.joints for each in states], float),
            joint_rates=np.array([joints if each.joint_rates is None else each.joint_rates for each in states], float),
            controls=np.array(rows),
            channels=dict(zip(vehicle.channels, np.array(channels).T, strict=True)),
            fps=self._fps,
            start_frame=self._first,
        )
        return place_on_terrain(clip, self._world, samples=1)

    def _begin(self, state: State) -> None:
        """The state shows whether a boat floats or glides in the plane."""
        flat = self._vehicle.planar
        self._moving = flat if flat is not None and len(np.ravel(state.twist)) == flat.group.dim else self._vehicle
        self._function = channel_laws(self._moving)
        self._turned = np.zeros(len(self._moving.channels))
        if self._world.terrain is not None and self._moving.group.planar:
            self._length = SETTLED

    def _laws(self, t: float, state: State, controls: Array) -> tuple[Array, Array]:
        """Values and rates of the channels; each channel has one of them, and zero for the other."""
        assert self._moving is not None
        s = len(self._moving.joints)
        r, u = (np.zeros(s) if each is None else each for each in (state.joints, state.joint_rates))
        values, rates = self._function(t, r, u, state.twist, controls)
        return np.ravel(values), np.ravel(rates)


class DrivenMotion(SticksMotion):
    """The motion of ``method = "sticks"`` whose controls a `Driver` gives, instead of a file."""

    driver: Any = None

    def seconds(self, context: Context) -> float:
        return LONGEST if context.last is None else context.seconds(context.last)

    def controls(self, vehicle: Vehicle, context: Context) -> Any:
        return self.driver


@dataclass(frozen=True)
class KnownMotion:
    """The motion of a vehicle that does not notice the driven one: its clip."""

    clip: Clip
    method: str = "clip"

    def solve(self, vehicle: Vehicle, context: Context, progress: Progress) -> tuple[Clip, dict[str, Any]]:
        return self.clip, {}


@dataclass(frozen=True)
class Recording:
    """What was driven: controls (n, c) in SI units at ``frames`` (n,), whole ones at both ends.

    ``motion``: the other keys of its table in the shot file; ``problem``: why the simulation ended by itself.
    """

    motion: dict[str, Any]
    frames: Array
    controls: Array
    problem: Problem | None = None


def record(
    shot: Shot,
    name: str,
    clips: Mapping[str, Clip],
    show: Callable[[Clip, float], object],
    ended: Callable[[], bool],
    sticks: Sticks,
    since: int | None = None,
    clock: Clock | None = None,
) -> Recording:
    """Drive the vehicle ``name`` of a shot whose present motion is ``clips``, until ``ended``.

    ``show`` receives the last moments as a clip for each picture, and by how many seconds the simulation was too slow.
    The vehicle starts as in its present motion; ``since``: it plays its recording up to this frame first. Raises
    ``InputError`` if nothing was recorded.
    """
    clock, header = clock or Clock(), shot.file.shot
    table: Any = next(table for table in shot.file.vehicle if table.name == name)
    vehicle, keys = shot.vehicle(table), _start_of(table.motion, clips[name], shot.world)
    if since is None and "step" not in keys:
        trial = Trial(sticks, clock)
        with suppress(Stopped, SolveError):
            _simulate(shot, name, clips, keys, trial)
        keys |= affordable_step(trial.seconds, shot.fps)
    context = Context(shot.world, shot.fps, header.first, header.last, shot.folder)
    window = Window(vehicle, shot.world, shot.fps, header.first)
    due = clock.now()

    def passed(t: float, state: State, controls: Array) -> None:
        nonlocal due
        window.pass_by(t, state, controls)
        if (began := clock.now()) >= due:
            show(window.add(t, state, controls), driver.behind)
            due = began + max(SHOWN, (clock.now() - began) / SHARE)

    before = None if since is None else table.motion.controls(vehicle, context)
    driver = Driver(sticks, passed, ended, before, -1.0 if since is None else context.seconds(since), clock)
    problem = None
    try:
        _simulate(shot, name, clips, keys, driver)
    except Stopped:
        pass
    except SolveError as error:  # the step after the last row
        problem = error.problem
        del driver.times[-1:], driver.rows[-1:]
    frames = header.first + np.array(driver.times) * float(shot.fps)
    frames = np.where(np.abs(frames - np.round(frames)) < 1e-6, np.round(frames), frames)
    whole = frames <= np.floor(frames[-1:])
    if whole.sum() < 2:
        raise InputError("nothing was recorded", "drive for at least one frame", key=name)
    if problem is None and since is not None and frames[-1] <= since:  # it would be the old recording, cut short
        remedy = f"wait until the recording has been played up to frame {since}, then drive"
        raise InputError("nothing was recorded", remedy, key=name)
    return Recording(keys, frames[whole], np.array(driver.rows)[whole], problem)


def _simulate(shot: Shot, name: str, clips: Mapping[str, Clip], keys: Mapping[str, Any], law: Any) -> None:
    """Simulate the vehicle ``name`` under ``law`` in the shot's world, among the other vehicles' present motion."""
    motions: dict[str, Any] = {other: KnownMotion(clip) for other, clip in clips.items()}
    for other in shot.file.vehicle:
        if isinstance(other.motion, ForwardMotion) and shot.world.contact is not None:
            motions[other.name] = other.motion  # it feels the driven one
    motions[name] = DrivenMotion(**keys, file="-", driver=law)
    tables = [other.model_copy(update={"motion": motions[other.name]}) for other in shot.file.vehicle]
    driven = Shot(shot.file.model_copy(update={"vehicle": tables}), shot.folder)
    vars(driven)["world"] = shot.world
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the solve of the recording gives them
        driven.solve(checked=True, cached=False)


def affordable_step(seconds: float, fps: Fraction) -> dict[str, float]:
    """The key ``step`` of a recording whose steps take ``seconds`` each on this machine: empty for the default.

    Steps that are chosen divide a frame.
    """
    if seconds <= BUSY * ForwardMotion.model_fields["step"].default:
        return {}
    steps = [1 / float(fps * ceil(rate / fps)) for rate in SLOWER]
    return {"step": next((step for step in steps if seconds / step <= BUSY), steps[-1])}


def _start_of(motion: Any, clip: Clip, world: Any) -> dict[str, Any]:
    """The keys of a recording's table but its file: start and step of a simulated motion, else where a clip starts."""
    if isinstance(motion, ForwardMotion):
        return {"method": "sticks", **motion.model_dump(mode="json", exclude_unset=True, include={"start", "step"})}
    planar = clip.vehicle.group.planar
    place, turn, twist = clip.positions[0].copy(), clip.orientations[0], clip.twists[0]
    if planar and world.terrain is not None:
        place[2] = world.height(place[None, :2])[0]
    turn = from_yaw(yaw_of(turn)) if planar else turn
    spin, velocity = ([0.0, 0.0, twist[0]], [*twist[1:], 0.0]) if planar else (twist[:3], twist[3:])
    start = {
        "position": _rounded(place),
        **({"heading": _rounded(np.degrees(yaw_of(turn)))} if planar else {"orientation": _rounded(turn)}),
        "velocity": _rounded(rotate(turn, np.array(velocity))),
        "spin": _rounded(np.degrees(spin)),
    }
    joints = dict(zip(clip.vehicle.joints, _rounded(clip.joints[0]), strict=True))
    return {"method": "sticks", "start": start | ({"joints": joints} if joints else {})}


def _rounded(values: Any) -> Any:
    """Numbers for a shot file, without the last digits of a solver."""
    return (np.round(values, START_DECIMALS) + 0.0).tolist()  # + 0.0: no -0.0
