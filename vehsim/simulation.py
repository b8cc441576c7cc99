"""Simulate a vehicle with its controls in a world; the result is a clip.

This module accepts controls in several forms, runs the integrator, and warns of questionable results. `integrators`
make the steps; `pilots` holds feedback laws.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.continuation import ended, memory_of, numbers_of, settings_of, surroundings
from vehsim.errors import InputError, Problem
from vehsim.runtime.progress import Progress
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.commands import Actuated, follow

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.integrators.integrator import Integrator
    from vehsim.integrators.phase import Phase
    from vehsim.world.world import World

MAX_STEPS = 10_000_000
"""Largest number of integration steps of a simulation."""


def simulate(
    vehicle: Vehicle,
    world: World | None = None,
    controls: Any = None,
    start: State | None = None,
    duration: float | None = None,
    step: float = 1 / 240,
    fps: Any = 24,
    start_frame: int = 1001,
    *,
    difference_map: str | None = None,
    order: int = 2,
    everywhere: bool = False,
    actuators: bool = True,
    after: Clip | None = None,
    progress: Progress | None = None,
) -> Clip:
    """Simulate ``vehicle`` for ``duration`` s under ``controls`` in ``world``; returns a `Clip` with a sample per step.

    ``controls``, in SI units and the order of ``vehicle.control_names``, are commands, which the vehicle's actuators
    follow within their lags and rates; if ``actuators`` is False, they are the controls themselves, such as those of a
    planned clip:

    - (c,): constant; None for a vehicle without controls, or all zeros;
    - (n, c): knot values evenly spaced over the duration, linear between (``duration`` None: one row per ``step``);
    - a function ``f(t, state) -> (c,)`` of time [s] and `State`, or a pilot (`vehsim.pilots`): called once at every
      knot, in order, with the state predicted there; between knots, its results are interpolated linearly.
      ``reset()`` is called first.

    ``step`` s is shortened, if necessary, to the vehicle's ``largest_step`` and to a whole fraction of a frame so that
    every frame is a knot; the duration is rounded up to whole steps. ``world.wind`` acts through the vehicle's drag. A
    planar vehicle keeps its start height; on a terrain, gravity pulls it along slopes, and its wheels follow the
    ground. Slopes are resolved where it can come within the duration, or ``everywhere``: then the duration does not
    change the motion before its end. ``after``: a clip of an earlier call, which is continued from its last sample. The
    result contains it, and has the same bytes as one simulation of the whole ``duration`` under the controls of both:
    ``controls`` act after its end only. Everything else must be as in the earlier call; without water, gusts and
    contact, so must be their form: numbers, or a function. ``difference_map`` and
    ``order`` as of `vehsim.integrators.Integrator`. Raises ``InputError`` naming key,
    value and remedy; ``SolveError`` with step, state and residual if a step fails.
    """
    from vehsim.integrators.forced import pushed, substeps
    from vehsim.integrators.integrator import Integrator
    from vehsim.lie.maps import DEFAULT_MAP
    from vehsim.world.ground.below import with_ground
    from vehsim.world.ground.placing import place_on_terrain
    from vehsim.world.world import World

    rate = _frame_rate(fps)
    h = _step(step, rate, vehicle.largest_step)
    difference_map = difference_map or DEFAULT_MAP
    vehicle, start = _on_water(vehicle, world, start)
    if getattr(world, "contact", None) is not None:
        _refuse_untouched(vehicle, [obstacle.name for obstacle in world.obstacles])  # type: ignore[union-attr]  # a world with contact
    table = None if callable(controls) else _table(vehicle, controls)
    steps = _steps(duration, table, step, h)
    begin = _standing(vehicle, world, start)
    _warn_windless(vehicle, world)
    actuators = actuators and vehicle.actuated
    near = None if everywhere else _reach(begin, steps * h)
    ground = world.on_level([begin.position], near) if isinstance(world, World) and near is not None else world
    weighed = with_ground(vehicle, ground, _places(begin, near))
    environment = world.environment(vehicle, start_time=start_frame / float(rate)) if isinstance(world, World) else None
    settings = {
        **settings_of(vehicle, h, rate, start_frame),
        "difference_map": difference_map,
        "order": order,
        "actuators": actuators,
        "world": "with external forces" if environment is not None else "without external forces",
        **surroundings(world if isinstance(world, World) else World()),
        "start": numbers_of(begin),
    }
    if environment is None:
        settings["controls"] = "a function" if table is None else "numbers"
    before = None if after is None else memory_of(after, steps, settings)

    if environment is not None:
        cuts = substeps(h, environment)
        flying = weighed if vehicle.group.dim == 6 else vehicle  # in the plane, contact and gusts know no slopes
        integrator = Integrator(flying, h / cuts, difference_map, order, wind=_wind(world))
        law = controls if table is None else _played(table, steps * h)
        law = Actuated(vehicle, law) if actuators else law
        clip, memory = pushed(integrator, environment, law, begin, steps, cuts, rate, start_frame, progress, before)
        clip = _commanded(clip, law)
    elif table is None:
        integrator = Integrator(weighed, h, difference_map, order, wind=_wind(world))
        law = Actuated(vehicle, controls) if actuators else controls
        clip, memory = _fly(integrator, law, begin, steps, rate, start_frame, progress, before)
        clip = _commanded(clip, law)
    else:
        integrator = Integrator(weighed, h, difference_map, order, wind=_wind(world))
        knots = _knots(table, steps, before)
        clip = _roll(integrator, follow(vehicle, knots, h) if actuators else knots, begin, rate, start_frame, progress)
        clip = _with_commands(clip, knots) if actuators else clip
        memory = {"knots": knots}

    clip = replace(clip, vehicle=vehicle)
    _warn_limits(vehicle, clip)
    _warn_targets(controls, clip)
    return ended(place_on_terrain(clip, world) if environment is None else clip, memory, settings)


@dataclass(frozen=True)
class Mover:
    """One of several vehicles that move together: its controls and start, as `simulate` takes them."""

    vehicle: Vehicle
    controls: Any = None
    start: State | None = None


def simulate_together(
    movers: Mapping[str, Mover],
    world: World,
    duration: float,
    step: float = 1 / 240,
    fps: Any = 24,
    start_frame: int = 1001,
    *,
    after: Mapping[str, Clip] | None = None,
    progress: Progress | None = None,
) -> dict[str, Clip]:
    """Simulate several vehicles at the same time in ``world``, whose ``contact`` says how they touch.

    ``movers``: name -> `Mover`; the other parameters as in `simulate`; ``after``: the clips of an earlier call, which
    are continued. Returns a clip for every name, with its contacts among its events. Raises the same errors as
    `simulate`.
    """
    from vehsim.integrators.environment import Nothing
    from vehsim.integrators.forced import Recording, pushed_together, substeps
    from vehsim.integrators.integrator import Integrator
    from vehsim.world.contact.contact import Contact, ContactScene
    from vehsim.world.ground.below import above_ground

    rate = _frame_rate(fps)
    finest = min((mover.vehicle.largest_step for mover in movers.values()), default=math.inf)
    h = _step(step, rate, finest)
    steps = _steps(duration, np.zeros((1, 0)), step, h)
    prepared = []
    for name, mover in movers.items():
        vehicle, start = _on_water(mover.vehicle, world, mover.start)
        _refuse_untouched(vehicle, [*(other for other in movers if other != name), *(o.name for o in world.obstacles)])
        table = None if callable(mover.controls) else _table(vehicle, mover.controls)
        law = mover.controls if table is None else _played(table, steps * h)
        law = Actuated(vehicle, law) if vehicle.actuated else law
        environment = world.environment(vehicle, alone=False) or Nothing(vehicle.group.dim)
        prepared.append((name, vehicle, law, _standing(vehicle, world, start), environment))
        _warn_windless(vehicle, world)
    touching = {name: vehicle for name, vehicle, *_ in prepared}
    meeting = ContactScene(touching, world, world.contact or Contact(), start_frame / float(rate))
    cuts = max(substeps(h, environment) for *_, environment in prepared)
    recordings = [
        Recording(
            Integrator(
                above_ground(vehicle, world, _places(begin, _reach(begin, steps * h))), h / cuts, wind=_wind(world)
            ),
            environment,
            law,
            begin,
            cuts,
        )
        for _, vehicle, law, begin, environment in prepared
    ]
    if after is not None and set(after) != set(movers):
        raise InputError("not the vehicles of movers", "give a clip of each", key="after", value=sorted(after))
    settings = {
        name: {
            **settings_of(vehicle, h, rate, start_frame),
            **surroundings(world),
            "movers": list(movers),
            "start": numbers_of(begin),
        }
        for name, vehicle, _, begin, _ in prepared
    }
    before = None
    if after is not None:
        left = [memory_of(after[name], steps, settings[name]) for name in movers]
        if len({len(after[name]) for name in movers}) > 1:
            raise InputError("clips of different lengths", "give those of one call", key="after")
        before = {**left[0], "recordings": [own["recordings"] for own in left]}
    memory = pushed_together(recordings, meeting, steps, cuts, progress, before)
    clips = {}
    for k, (recording, (name, vehicle, law, _, environment)) in enumerate(zip(recordings, prepared, strict=True)):
        events = sorted([*environment.events(), *meeting.events(k)], key=lambda event: event["time"])
        clips[name] = replace(_commanded(recording.clip(events, rate, start_frame), law), vehicle=vehicle)
        _warn_limits(vehicle, clips[name])
        _warn_targets(movers[name].controls, clips[name])
        own = {**memory, "recordings": memory["recordings"][k]}
        clips[name] = ended(clips[name], own, settings[name])
    return clips


def _commanded(clip: Clip, law: Any) -> Clip:
    """The clip with the commands of its law, if actuators followed them."""
    return _with_commands(clip, np.array(law.commands)) if isinstance(law, Actuated) else clip


def _with_commands(clip: Clip, commands: Array) -> Clip:
    return replace(clip, commands=dict(zip(clip.vehicle.control_names, commands.T, strict=True)))


def _roll(
    integrator: Integrator, knots: Array, begin: State, fps: Fraction, start_frame: int, progress: Progress | None
) -> Clip:
    """Simulate with known controls: the whole rollout in one call."""
    if progress:
        progress("simulate", 0.0)
    clip = integrator.rollout(begin, knots, fps=fps, start_frame=start_frame, rests=True)
    if progress:
        progress("simulate", 1.0)
    return clip


def _fly(
    integrator: Integrator,
    pilot: Callable[[float, State], Any],
    begin: State,
    steps: int,
    fps: Fraction,
    start_frame: int,
    progress: Progress | None,
    memory: Mapping[str, Any] | None,
) -> tuple[Clip, Mapping[str, Any]]:
    """Simulate with controls that depend on the state: evaluate them at each knot's predicted state, then step. A
    vehicle that has come to rest stays as it is until they change."""
    from vehsim.integrators.carried import carried, carry_on
    from vehsim.integrators.guards import warn_of_stiff_damping
    from vehsim.integrators.phase import packed, unpacked
    from vehsim.integrators.phase_integrator import BLOCK, constant
    from vehsim.integrators.record import build_clip
    from vehsim.vehicles.definition.states import control_vector

    vehicle = integrator.vehicle
    if hasattr(pilot, "reset"):
        pilot.reset()
    asked: list[tuple[float, State]] = []

    def controls_at(k: int, state: State) -> Array:
        asked.append((k * integrator.step_size, state))
        return control_vector(
            vehicle, pilot(k * integrator.step_size, state), f"controls(t = {k * integrator.step_size:.6g})"
        )

    idle = np.zeros(len(vehicle.controls))
    phase = integrator.start(begin, idle)
    anchor = integrator.anchor(begin, phase)
    # a complete state: missing parts of the start are filled in
    c = controls_at(0, integrator.state(phase, idle, anchor))
    phase = integrator.start(begin, c)
    phases: list[Phase] = [phase]
    controls = [c]
    held: Array | None = None
    if memory is not None:
        held = memory["held"]
        phases = [unpacked(integrator.mechanics, x) for x in memory["phases"]]
        controls, asked = list(memory["controls"]), list(memory["asked"])
        for t, state in asked[1:]:
            pilot(t, state)
        carry_on(pilot, memory["law"])
        phase, c = phases[-1], controls[-1]
    for k in range(len(phases) - 1, steps):
        guess = 2 * controls[-1] - controls[-2] if k else c
        held = held if constant(guess, held) else None
        predicted = integrator.advance(phase, c, guess, k) if held is None else phase
        after = controls_at(k + 1, integrator.state(predicted, guess, anchor))
        held = held if constant(after, held) else None
        phase = integrator.advance(replace(phase, z=predicted.z), c, after, k) if held is None else phase
        c = after
        phases.append(phase)
        controls.append(c)
        if held is None and len(phases) % BLOCK == 0:
            held = integrator.held(np.array([packed(p) for p in phases[-BLOCK:]]), np.array(controls[-BLOCK:]))
        if progress and k % 50 == 0:
            progress("simulate", k / steps)
    if progress:
        progress("simulate", 1.0)
    times = np.asarray(integrator.step_size * np.arange(steps + 1), float)
    g, r, pi = (np.array([getattr(p, name) for p in phases]) for name in ("g", "r", "pi"))
    rows, ends = np.array(controls), np.array([packed(phases[0]), packed(phases[-1])])
    warn_of_stiff_damping(integrator.mechanics, ends, rows, integrator.step_size, integrator.wind)
    clip = build_clip(
        integrator.mechanics, times, g, r, pi, rows, anchor, wind=integrator.wind, fps=fps, start_frame=start_frame
    )
    left = {"phases": np.array([packed(p) for p in phases]), "controls": rows, "held": held}
    return clip, {**left, "asked": tuple(asked), "law": carried(pilot)}


def _table(vehicle: Vehicle, controls: Any) -> Array:
    """Constant or knot controls as (n, c)."""
    names = vehicle.control_names
    try:
        table = np.zeros((1, len(names))) if controls is None else np.asarray(controls, float)
    except (TypeError, ValueError):
        table = np.full((1, 1, 1), np.nan)
    table = table[None] if table.ndim == 1 else table
    if table.ndim != 2 or table.shape[1] != len(names) or len(table) == 0:
        raise InputError(
            f"shape {np.shape(controls)}",
            f"give ({len(names)},) or (n, {len(names)}) numbers ({', '.join(names) or 'none'}), a function of (t, "
            "state), or a pilot",
            key="controls",
        )
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{names[column]} is not finite",
            "give a number",
            key=f"controls[{row}, {column}]",
            value=table[row, column],
        )
    return table


def _step(wanted: float, rate: Fraction, largest: float) -> float:
    """The longest step, s, of at most ``wanted`` and ``largest`` that divides a frame."""
    frame = 1 / float(rate)
    longest = min(_positive("step", wanted, "a number of seconds, such as 1/240"), largest)
    return frame / max(1, math.ceil(frame / longest - 1e-9))


def _steps(duration: float | None, table: Array | None, wanted: float, h: float) -> int:
    """Number of steps of ``h`` that cover the duration."""
    if duration is None:
        if table is None or len(table) < 2:
            raise InputError("missing", "give seconds, or one row of controls per step", key="duration")
        duration = (len(table) - 1) * wanted
    seconds = _positive("duration", duration, "a number of seconds")
    steps = math.ceil(seconds / h - 1e-6)
    if steps > MAX_STEPS:
        raise InputError(
            f"{steps:,} steps of {h:.3g} s", "shorten it, or take a longer step", key="duration", value=duration
        )
    return max(1, steps)


def _knots(table: Array, steps: int, before: Mapping[str, Any] | None) -> Array:
    """Controls (n, c) at every step, after those of a clip that is continued, whose rollout is repeated."""
    knots = np.repeat(table, steps + 1, axis=0) if len(table) == 1 else _spread(table, steps)
    return knots if before is None else np.concatenate([before["knots"], knots[len(before["knots"]) :]])


def _spread(table: Array, steps: int) -> Array:
    """Evenly spaced knot values (n, c), linear between, at ``steps + 1`` evenly spaced times."""
    at = np.linspace(0, len(table) - 1, steps + 1)
    return np.column_stack([np.interp(at, np.arange(len(table)), column) for column in table.T] or [at[:, None][:, :0]])


def _standing(vehicle: Vehicle, world: World | None, given: State | None) -> State:
    """The start, moved to the ground for a planar vehicle on a terrain; warns if it was elsewhere."""
    start = given or State()
    if world is None or world.terrain is None or not vehicle.group.planar:
        return start
    position = np.asarray(start.position, float).ravel()
    if position.shape != (3,) or not np.all(np.isfinite(position)):
        raise InputError("not a position", "give 3 finite numbers", key="state.position", value=start.position)
    ground = float(np.ravel(world.on_level([position]).height(position[None, :2]))[0])
    end = world.terrain.beyond(position)
    if end:
        message = f"{vehicle.name}: starts at {position[:2].tolist()}, outside the terrain, which ends at {end}"
        warnings.warn(f"{message}; the ground there is level and not drawn", stacklevel=3)
    if given is not None and abs(position[2] - ground) > 0.01:
        warnings.warn(
            f"{vehicle.name}: starts at z = {position[2]:.2f} m and was put on the ground, at {ground:.2f} m; "
            "start it there",
            stacklevel=3,
        )
    return replace(start, position=(position[0], position[1], ground))


def _on_water(vehicle: Vehicle, world: World | None, start: State | None) -> tuple[Vehicle, State | None]:
    """The moving vehicle and its start: by default afloat and at rest; in a world without water, its planar form."""
    if getattr(world, "water", None) is not None and vehicle.hull is not None:
        if start is None:
            from vehsim.world.water.buoyancy import Afloat

            assert world is not None
            start = Afloat(vehicle, world).riding()
        return vehicle, start
    if vehicle.planar is None:
        return vehicle, start
    if start is not None and np.shape(start.twist) == (6,):
        start = replace(start, twist=np.asarray(start.twist, float)[[2, 3, 4]])
    return vehicle.planar, start


def _refuse_untouched(vehicle: Vehicle, things: Collection[str]) -> None:
    """Raise ``InputError`` for a vehicle that would drive through ``things``, since contact moves bodies in space."""
    if things and vehicle.group.dim != 6:
        raise InputError.of(untouched(vehicle, things))


def untouched(vehicle: Vehicle, things: Collection[str]) -> Problem:
    """The problem of a vehicle in the plane among ``things`` that it can hit."""
    some = ", ".join(sorted(things)[:3])
    message = f"{vehicle.name} moves in the plane, where contact does not act: it would drive through {some}"
    remedy = "plan its motion, remove the contact, or take a vehicle that flies or floats"
    return Problem("asset", message, remedy, vehicle.name)


def _played(table: Array, duration: float) -> Callable[[float, State], Array]:
    """Evenly spaced knot values (n, c), linear between, as a function of time."""
    at = np.linspace(0, duration, len(table))

    def play(t: float, state: State) -> Array:
        return np.array([np.interp(t, at, column) for column in table.T])

    play.blind = True  # type: ignore[attr-defined]  # read by `Forced`: it ignores the state
    return play


def _places(start: State, near: Array | None) -> Array | None:
    """Places (n, 3) m where a vehicle may come: ``near`` (n, 2) m, at the height of its start."""
    return None if near is None else np.column_stack([near, np.full(len(near), np.asarray(start.position, float)[2])])


def _reach(start: State, duration: float) -> Array:
    """Corners (2, 2) m of the region that the vehicle can reach from its start, at 3 m/s^2."""
    speed = 0.0 if start.twist is None else float(np.linalg.norm(np.asarray(start.twist, float)))
    far = (speed + 3.0 * duration) * duration
    return np.asarray(start.position, float)[:2] + np.array([[-far], [far]])


def _wind(world: World | None) -> Array:
    wind = np.zeros(3) if world is None else np.asarray(world.wind, float)
    if wind.shape != (3,) or not np.all(np.isfinite(wind)):
        raise InputError(
            "not a wind", "give three finite numbers, m/s in world axes", key="world.wind", value=wind.tolist()
        )
    return wind


def _frame_rate(fps: Any) -> Fraction:
    try:
        rate = Fraction(fps).limit_denominator(100_000)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        rate = Fraction(0)
    if not 0 < rate <= 100_000:
        raise InputError("not a frame rate", 'give a positive number such as 24 or "24000/1001"', key="fps", value=fps)
    return rate


def _positive(key: str, value: Any, remedy: str) -> float:
    number = value if isinstance(value, int | float | np.floating | np.integer | Fraction) else math.nan
    if isinstance(value, bool) or not (math.isfinite(number) and number > 0):
        raise InputError("must be positive and finite", f"give {remedy}", key=key, value=value)
    return float(number)


def _warn_windless(vehicle: Vehicle, world: World | None) -> None:
    if world is not None and np.any(world.wind) and not vehicle.feels_wind:
        warnings.warn(
            f"world.wind = {list(map(float, world.wind))}: {vehicle.name} has no drag, so wind has no effect; "
            "give its vehicle.toml drag coefficients, or set the wind to zero",
            stacklevel=3,
        )


def _warn_limits(vehicle: Vehicle, clip: Clip) -> None:
    """Warn of controls, or their commands, and of joints beyond their bounds; nothing is clipped."""
    given = [clip.commands.get(c.name, clip.controls[:, i]) for i, c in enumerate(vehicle.controls)]
    columns = [(f"control {c.name}", row, c.lower, c.upper) for c, row in zip(vehicle.controls, given, strict=True)]
    limits = vehicle.joint_limits
    columns += [(f"joint {n}", clip.joints[:, i], *limits[n]) for i, n in enumerate(vehicle.joints) if n in limits]
    for name, values, lower, upper in columns:
        slack = 1e-6 * max(1.0, abs(lower) if np.isfinite(lower) else 0.0, abs(upper) if np.isfinite(upper) else 0.0)
        outside = np.flatnonzero((values < lower - slack) | (values > upper + slack))
        if outside.size:
            k = outside[0]
            warnings.warn(
                f"{vehicle.name}: {name} = {values[k]:.6g} at frame {clip.frames[k]:g} is outside "
                f"[{lower:g}, {upper:g}]; change the commands, or the bounds in vehicle.toml",
                stacklevel=3,
            )


def _warn_targets(pilot: Any, clip: Clip) -> None:
    """Warn of each of a pilot's ``targets`` that the clip misses, measured as an audit does."""
    from vehsim.audit import audit, track_of_clip
    from vehsim.requests import target_asks

    targets = pilot.targets(clip.duration) if hasattr(pilot, "targets") else []
    asks = target_asks(targets, clip.start_frame, clip.end_frame, float(clip.fps))
    for row in audit(track_of_clip(clip), asks) if asks else ():
        if row.met is False:
            warnings.warn(f"{clip.vehicle.name}: {row}", stacklevel=3)
