"""Write a first shot file for a vehicle (``vehsim new``): commented, exports without changes.

This module chooses numbers that suit the vehicle's size and the terrain, and explains them. The method follows from the
vehicle's group, joints, controls and hull.
"""

from __future__ import annotations

import json
import math
import os
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.constants import GRAVITY
from vehsim.errors import InputError, ShotError
from vehsim.intake.tables import NAME
from vehsim.intake.usd import open_stage

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle
    from vehsim.world.terrain.terrain import Terrain

FPS, FIRST = 24, 1001
LENGTHS = 4.0
"""Length of the first motion, in lengths of the vehicle."""
PACE = 0.33
"""Mean speed over ``sqrt(g * length)``: eases in and out at any size."""
SWIMMING = 0.53
"""Share of this speed for vehicles that move by swinging their joints."""
EASE = 1.5
"""Minimum ratio of the duration to that with full controls."""
GENTLE = 1.2
"""Minimum ratio of the duration to that of the smoothest motion within the normal acceleration."""
SHORTEST, DRIFT = 4.0, 8.0
"""Minimum duration of a motion, and duration for a vehicle without controls, s."""
SETTLING = 11.0
"""Time that a pilot needs to start and to stop, s."""
STEERS = {"rad": 0.3, "1/s": 0.1}
"""Share of a steering control's bound in the first commands, by its unit; others turn the body directly: 0.02."""
TRIES = 4
"""How often the duration is doubled if the check finds it too short."""
WIDE = 34
"""Column of the comments."""


@dataclass(frozen=True)
class Course:
    """The course of the motion: ``ahead`` (x, y) from ``start`` (x, y) m, at height ``base`` m; ``length`` m of the
    vehicle.

    ``terrain``: the ground, None if ``base`` is the same everywhere. ``seconds``: the duration.
    """

    start: tuple[float, float]
    ahead: tuple[float, float]
    base: float
    length: float
    seconds: float
    terrain: Terrain | None = None

    @property
    def reach(self) -> float:
        return LENGTHS * self.length

    @property
    def heading(self) -> float:
        """The direction in degrees."""
        return math.degrees(math.atan2(self.ahead[1], self.ahead[0]))

    def at(self, along: float, aside: float, up: float = 0.0) -> str:
        """A place as TOML: ``along`` the course and to its left, both in units of the reach, and ``up`` m."""
        (x, y), (c, s) = self.start, self.ahead
        x, y = x + self.reach * (along * c - aside * s), y + self.reach * (along * s + aside * c)
        z = self.base if self.terrain is None else float(self.terrain.height([(x, y)])[0])
        return _array(x, y, z + up)

    def frame(self, share: float = 1.0) -> int:
        """The frame after this share of the duration."""
        return FIRST + round(share * self.seconds * FPS)


def new_shot(target: Path, asset: str, terrain: str | None = None, method: str | None = None) -> tuple[Path, str]:
    """Write a commented shot of one vehicle to ``target`` (``.toml`` is added); returns the file and its method.

    ``asset``: a shipped vehicle's name or the path of a vehicle's folder. Raises ``InputError`` for a file that is
    there, an unknown vehicle or terrain, and a method that does not suit the vehicle.
    """
    from vehsim.vehicles import load_vehicle

    path = target if target.suffix == ".toml" else target.with_name(f"{target.name}.toml")
    name = path.stem
    if not re.fullmatch(NAME, name):
        close = re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)[:100]
        raise InputError(
            "letters, digits and _ only, no digit first", f"try {close or 'shot'!r}", key="NAME", value=name
        )
    if os.path.lexists(path):
        raise InputError("exists and is not overwritten", "give another name, or remove it", file=path)
    if not path.parent.is_dir():
        raise InputError("no such folder", "make it first", file=path.parent)
    vehicle = load_vehicle(Path(asset).expanduser() if _is_folder(asset) else asset)
    place = "flat" if terrain is None and not _drifts(vehicle) and vehicle.hull is None else terrain
    chosen = method or default_method(vehicle, place)
    if chosen not in METHODS:
        raise InputError("unknown", f"choose one of {', '.join(METHODS)}", key="--method", value=chosen)
    text = _feasible(path, vehicle, _beside(asset, path.parent), chosen, place)
    with path.open("x", encoding="utf-8") as file:
        file.write(text)
    return path, chosen


def default_method(vehicle: Vehicle, place: str | None = None) -> str:
    """The method that shows most of what a vehicle can do: a plan if it can be planned within a minute. The first plan
    of the shipped car with springs of its own took 97 CPU seconds."""
    slow = vehicle.attitude is not None or (place not in (None, "flat") and _swims(vehicle))
    return "simulate" if _drifts(vehicle) or slow else "sinusoid" if _hops(vehicle) else "plan"


def _drifts(vehicle: Vehicle) -> bool:
    return not vehicle.controls


def _hops(vehicle: Vehicle) -> bool:
    """Whether only the joints act, so that the vehicle turns in the air."""
    return vehicle.group.dim == 6 and bool(vehicle.joints) and vehicle.hull is None


def _is_folder(asset: str) -> bool:
    return (Path(asset).expanduser() / "vehicle.toml").is_file()


def _beside(name: str, folder: Path) -> str:
    """The path of a file or folder relative to ``folder``; names of shipped assets stay as they are."""
    path = Path(name).expanduser()
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix() if path.exists() else name


def _feasible(path: Path, vehicle: Vehicle, asset: str, method: str, place: str | None) -> str:
    """The text of a shot that passes its check, with a sufficient duration. Raises ``InputError``."""
    from vehsim.shot import Shot

    course = _course(vehicle, place)
    named = None if place is None else _beside(place, path.parent)
    for _ in range(TRIES):
        text = _text(path, vehicle, asset, method, named, course)
        shot = Shot.from_dict(tomllib.loads(text), path.parent, str(path))
        errors = [problem for problem in shot.check() if problem.severity == "error"]
        if not errors:
            return text
        if not all(problem.key.endswith("frame") for problem in errors):
            break
        course = replace(course, seconds=2 * course.seconds)
    raise ShotError(errors)


# ---------------------------------------------------------------- where


def _course(vehicle: Vehicle, place: str | None) -> Course:
    """A place with enough room for the vehicle. Raises ``InputError`` for an unknown terrain."""
    from vehsim.cameras.framing import vehicle_outline
    from vehsim.world.terrain.terrain import Terrain

    outline = vehicle_outline(vehicle)
    length = float(np.ptp(outline[:, :2], axis=0).max())
    floats, flies = vehicle.hull is not None, vehicle.group.dim == 6
    # height of the root above the end of a leg or the skids
    sole = -float(outline[:, 2].min()) if flies and not floats else 0.0
    above = 0.0 if _drifts(vehicle) or floats else sole if _hops(vehicle) else max(3.0, 1.2 * length)
    lift = above if flies else 0.0
    first = Course((0.0, 0.0), (1.0, 0.0), lift, length, _seconds(vehicle, length))
    if place is None or place == "flat":
        return first
    terrain = Terrain.load(Path(place).expanduser() if Path(place).expanduser().exists() else place)
    start, ahead, top = _room(terrain, first.reach, length, level=not flies and not floats)
    if flies or floats:
        return replace(first, start=start, ahead=ahead, base=round(top + lift + 2.0 * floats, 2))
    from vehsim.world.ground.trailers import follows_ground

    if np.ptp(terrain.heights) > 0.01 and not follows_ground(vehicle):
        remedy = "add channels hitch_pitch* and hitch_roll* to its vehicle.toml, or leave --terrain out"
        raise InputError("its trailers do not follow uneven ground", remedy, subject=vehicle.name)
    return replace(first, start=start, ahead=ahead, terrain=terrain)


def _seconds(vehicle: Vehicle, length: float) -> float:
    """Duration of the course, s: at a speed that suits the length, within what the controls can reach and stop from."""
    if _drifts(vehicle):
        return DRIFT
    pace = PACE * math.sqrt(GRAVITY * length) * (SWIMMING if _swims(vehicle) else 1.0)
    faster, slower = _push(vehicle)
    hard = math.sqrt(2 * LENGTHS * length * (1 / faster + 1 / slower)) if min(faster, slower) > 1e-6 else 0.0
    normal = vehicle.character.limits.get("acceleration")
    gentle = 0.0 if normal is None else math.sqrt(6 * LENGTHS * length / normal.normal)
    return max(SHORTEST, LENGTHS * length / pace, EASE * hard, GENTLE * gentle)


def _push(vehicle: Vehicle) -> tuple[float, float]:
    """Acceleration and deceleration from rest with the controls, m/s^2; zeros if unknown."""
    from vehsim.vehicles import State

    flat = vehicle.planar or vehicle
    bounds = np.array([[control.lower, control.upper] for control in flat.controls])
    if flat.group.dim != 3 or not np.isfinite(bounds).all():
        return 0.0, 0.0
    a, b = flat.linearize(State(), np.zeros(len(flat.controls)))
    ahead = (a @ b)[1][:, None] * bounds  # of d eta/dt: yaw, forward, sideways
    return float(ahead.max(1).sum()), float(-ahead.min(1).sum())


def _swims(vehicle: Vehicle) -> bool:
    from vehsim.planning.trim import swims

    return bool(vehicle.controls) and vehicle.group.dim == 3 and swims(vehicle)


def _room(
    terrain: Terrain, reach: float, width: float, level: bool
) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Start (x, y), direction (x, y) and highest ground of a corridor: the most ``level`` one, or the lowest.

    Raises ``InputError`` if the terrain is shorter than the corridor.
    """
    low, high = terrain.lower[:2], terrain.upper[:2]
    angles = np.deg2rad(np.arange(0, 360, 22.5))
    behind = width if level else 0.0  # a trailer
    along, aside = np.meshgrid(np.linspace(-behind, 1.1 * reach, 17), np.linspace(-0.5, 1, 5) * max(width, 0.3 * reach))
    turn = np.stack([np.cos(angles), np.sin(angles)], 1)
    local = turn[:, None, None, :] * along[..., None]
    local = local + np.stack([-turn[:, 1], turn[:, 0]], 1)[:, None, None, :] * aside[..., None]
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, 25) for a, b in zip(low, high, strict=True))), -1).reshape(-1, 2)
    points = grid[:, None, None, None, :] + local  # start, angle, aside, along, xy
    inside = np.all((points >= low) & (points <= high), axis=(2, 3, 4))
    if not inside.any():
        raise InputError(
            f"has no {1.1 * reach:.3g} m straight on", "give a larger one", subject=f"terrain {terrain.name!r}"
        )
    heights = terrain.height(points.reshape(-1, 2)).reshape(points.shape[:-1])
    step = along[0, 1] - along[0, 0]
    steep = np.abs(np.diff(heights, axis=3)).max((2, 3)) / step
    bumpy = np.abs(np.diff(heights, 2, axis=3)).max((2, 3)) / step
    middle = np.linalg.norm((grid - (low + high) / 2) / (high - low), axis=1)[:, None]
    cost = (steep + 3 * bumpy + 0.02 * middle if level else heights.max((2, 3)) + 0.01 * middle) + np.where(
        inside, 0, np.inf
    )
    i, j = np.unravel_index(np.argmin(cost), cost.shape)
    start, ahead = grid[i].round(1), turn[j]
    return (float(start[0]), float(start[1])), (float(ahead[0]), float(ahead[1])), float(heights[i, j].max())


# ---------------------------------------------------------------- words


def _text(path: Path, vehicle: Vehicle, asset: str, method: str, place: str | None, course: Course) -> str:
    from vehsim.shot.schema.shot_file import SCHEMA_FILE, SCHEMA_LINE

    top = f"{SCHEMA_LINE}\n" if (path.parent / SCHEMA_FILE).is_file() else ""
    lines = f"""\
# A first shot for {vehicle.name}, made by `vehsim new`. Change anything, then:
#   vehsim check {path.name}
#   vehsim export {path.name} --out out --to usd,strobe,figures
# A film takes longer: --to usd,mp4. Every key: docs/shot-file.md.
[shot]
schema = 1
name = {_quoted(path.stem)}
fps = {FPS} # or "23.976"
start_frame = {FIRST}
# end_frame = {course.frame() + 24} # default: where the motion ends

[world]
{_world(vehicle, place, course)}
# wind = [0, 3, 0] # m/s; moves vehicles that have drag

[[vehicle]]
name = {_quoted(re.sub(r"[^A-Za-z0-9_]|^(?=[0-9])", "_", vehicle.name)[:100])}
asset = {_quoted(asset)} # a shipped vehicle (vehsim vehicles), or a folder with a vehicle.toml
{_variants(vehicle)}
[vehicle.motion]
{METHODS[method](vehicle, course)}
[camera]
rig = "follow" # or "chase", "orbit", "static", "dolly", "crane", "fly_by", "first_person"
azimuth = {_number(round(course.heading) - 60)} # deg: the viewing direction, from world X
lens_mm = 35
fill = 0.3 # share of the picture's height that the vehicle takes

[render]
size = [960, 540] # pixels
"""
    return top + _aligned(lines)


def _world(vehicle: Vehicle, place: str | None, course: Course) -> str:
    ground = (
        "" if place is None else f"terrain = {_quoted(place)} # vehsim terrains; or the path of a mesh or height map"
    )
    if vehicle.hull is None:
        return ground or '# terrain = "flat" # default: empty space'
    waves = '# wave = [{ height = 0.2, length = 8, heading = 150 }] # m, m, deg; method = "simulate" rides them'
    return "\n".join(filter(None, [ground, "[world.water]", f"level = {_number(course.base)} # m", waves]))


def _variants(vehicle: Vehicle) -> str:
    """The asset's variant sets, commented out, with the first choice of each."""
    if vehicle.rig is None:
        return ""

    stage = open_stage(vehicle.rig.asset, load=False)
    root = stage.GetPrimAtPath(f"/{vehicle.rig.root.strip('/')}") if vehicle.rig.root else stage.GetDefaultPrim()
    sets = root.GetVariantSets()
    names = {name: sets.GetVariantSet(name).GetVariantNames() for name in sets.GetNames()}
    if not names:
        return ""
    chosen = ", ".join(f"{name} = {_quoted(found[0])}" for name, found in names.items())
    choices = "; ".join(f"{name}: {', '.join(found)}" for name, found in names.items())
    return f"# variants = {{ {chosen} }} # {choices}\n"


def _plan(vehicle: Vehicle, course: Course) -> str:
    """From rest to rest, a little to the left."""
    if _drifts(vehicle) or _hops(vehicle):
        raise InputError(
            f"{vehicle.name} {_why(vehicle)}", f"choose {default_method(vehicle)}", key="--method", value="plan"
        )
    flies = vehicle.group.dim == 6 and vehicle.hull is None
    swings = vehicle.joints if _swims(vehicle) else ()
    first, last = (
        _joints(names) for names in (swings or [vehicle.joints[i] for i in vehicle.tied], swings)
    )  # trailers start in line
    gap = 1.0 if flies else 0.1 * course.length
    up = round(0.3 * course.length, 1) if flies else 0.0
    turned = 0 if _swims(vehicle) else 30
    clear = "terrain and obstacles" if flies else "obstacles"
    fast = _number(_round_up(3 * course.reach / course.seconds))
    return f"""\
method = "plan" # the motion that hits the marks at the least cost; or "simulate", "sinusoid"
cost = "effort" # or "time", "energy", "smoothness" ...; weights: {{ effort = 1, time = 0.5 }}
segments = 64 # fast manoeuvres need more
clearance = {_number(round(gap, 2))} # m, from {clear}
# limits = {{ speed = {fast} }} # m/s; all of them: vehsim export --help

[[vehicle.motion.mark]]
frame = {FIRST}
position = {course.at(0, 0)} # m; of the rig's root
heading = {_number(round(course.heading))} # deg, counter-clockwise from world X
velocity = [0, 0, 0] # m/s: at rest; without it, any velocity
{first}
# [[vehicle.motion.mark]] # a mark between: remove the # of these three lines
# frame = {course.frame(0.5)}
# position = {course.at(0.5, 0.06, up / 2)}

[[vehicle.motion.mark]]
frame = {course.frame()} # or "free": the planner chooses
position = {course.at(1, 0.25, up)}
heading = {_number(round(course.heading) + turned)}
velocity = [0, 0, 0]
{last}"""


def _joints(names: Sequence[str]) -> str:
    return f"joints = {{ {', '.join(f'{name} = 0' for name in names)} }} # rad\n" if names else ""


def _sinusoid(vehicle: Vehicle, course: Course) -> str:
    """Sideways into a gap; or a somersault."""
    from vehsim.sinusoids.manoeuvres.rigs import rigged

    try:
        rigged(vehicle, take_off=(0.0, 0.0, 1.0), landing=(1.0, 0.0, 1.0), heading=0.0)
    except InputError as error:
        raise InputError.of(error.problem.seen_from("--method", "sinusoid")) from None
    turn = round(course.heading)
    if _hops(vehicle):
        return f"""\
method = "sinusoid" # in closed form: the leg turns against the body

[[vehicle.motion.mark]]
frame = {FIRST} # take-off
position = {course.at(0, 0)} # m
heading = {_number(turn)} # deg
[[vehicle.motion.mark]]
frame = "free" # landing
position = {course.at(1, 0)}
heading = {_number(turn)}
pitch = 360 # deg: a whole somersault forward
joints = {{ {vehicle.joints[0]} = {-2 * math.pi} }} # rad: the leg turns once in the opposite direction
"""
    return f"""\
method = "sinusoid" # from rest to rest in closed form; vehsim manoeuvres shows the choice
clearance = 0.15 # m, from obstacles
limits = {{ speed = {_number(_round_up(0.3 * math.sqrt(GRAVITY * course.length)))} }} # m/s; steering and hitch in deg

[[vehicle.motion.mark]]
frame = {FIRST}
position = {course.at(1.4 / LENGTHS, 0)} # m
heading = {_number(turn)} # deg
[[vehicle.motion.mark]]
frame = "free" # as soon as speed and steering permit
position = {course.at(0, -0.55 / LENGTHS)}
heading = {_number(turn)}
"""


def _simulate(vehicle: Vehicle, course: Course) -> str:
    """Forward simulation with a pilot, if one suits the vehicle, or with commands."""
    if _drifts(vehicle):
        seconds, driven = course.seconds, _spun(vehicle)
    else:
        piloted = (found for make in (_flown, _driven, _swung) if (found := make(vehicle, course)))
        seconds, driven = next(piloted, None) or (course.seconds, _commanded(vehicle, course))
        driven = (
            f"start = {{ position = {course.at(0, 0)}, heading = {_number(round(course.heading))} }} # m, deg\n{driven}"
        )
    return f"""\
method = "simulate" # forward simulation from a start
duration = {_number(round(seconds, 1))} # s
{driven}
"""


def _takes(vehicle: Vehicle, pilot: str, **parameters: Any) -> bool:
    """Whether the pilot accepts the vehicle."""
    from vehsim.pilots.controllers import PILOTS

    try:
        PILOTS[pilot](vehicle, **parameters)
    except InputError:
        return False
    return True


def _flown(vehicle: Vehicle, course: Course) -> tuple[float, str] | None:
    goal, pace = course.at(1, 0.25, round(0.3 * course.length, 1)), _round_up(1.5 * course.reach / course.seconds)
    if not _takes(vehicle, "fly_to", position=json.loads(goal)):
        return None
    pilot = f'pilot = {{ name = "fly_to", position = {goal}, speed = {_number(pace)} }} # m, m/s; or "hover"'
    return 1.2 * course.reach / pace + SETTLING, pilot


def _driven(vehicle: Vehicle, course: Course) -> tuple[float, str] | None:
    points = [json.loads(course.at(a, b))[:2] for a, b in ((0, 0), (0.35, 0), (0.7, 0.15), (1.1, 0.15), (1.5, 0))]
    if not _takes(vehicle, "follow_path", points=points):
        return None
    pace = _round_up(1.5 * course.reach / course.seconds)
    pilot = f'pilot = {{ name = "follow_path", speed = {_number(pace)}, points = {points} }} # m/s, m'
    return 1.55 * course.reach / pace + SETTLING, pilot


def _swung(vehicle: Vehicle, course: Course) -> tuple[float, str] | None:
    if not _swims(vehicle):
        return None
    bounds = [min(abs(x) for x in vehicle.joint_limits[joint]) for joint in vehicle.joints]
    swings = [round(share * bound, 2) for share, bound in zip((0.75, -0.45), bounds, strict=False)]
    if not _takes(vehicle, "gait", period=1.2, amplitude=swings):
        return None
    pilot = f'pilot = {{ name = "gait", period = 1.2, amplitude = {swings} }} # s; rad of {", ".join(vehicle.joints)}'
    return course.seconds, pilot


def _commanded(vehicle: Vehicle, course: Course) -> str:
    """Push, steer from side to side, brake. Controls with the same effect, such as two wheels, push together; others
    that act in one direction only brake."""
    if _hops(vehicle):
        raise InputError(
            f"{vehicle.name} {_why(vehicle)}", f"choose {default_method(vehicle)}", key="--method", value="simulate"
        )
    first = vehicle.controls[0]
    alike = [c for c in vehicle.controls if (c.lower, c.upper, c.unit) == (first.lower, first.upper, first.unit)]
    brakes = [c for c in vehicle.controls if c not in alike and c.lower == 0]
    steers = [c for c in vehicle.controls if c not in alike and c not in brakes]
    rows = [(0.0, 0.3, 0.0, 0.0), (0.3, 0.3, 1.0, 0.0), (0.6, 0.15, -1.0, 0.0), (0.9, 0.0, 0.0, 0.1)]
    lines = []
    for share, push, turn, stop in rows:
        values = {c.name: push * _top(c) for c in alike} | {c.name: stop * _top(c) for c in brakes}
        values |= {c.name: turn * _top(c) * STEERS.get(c.unit, 0.02) for c in steers}
        if not steers:
            values[first.name] += 0.06 * turn * _top(first)
        assignments = ", ".join(f"{name} = {_number(float(f'{value:.3g}'))}" for name, value in values.items())
        lines.append(f"    {{ frame = {course.frame(share)}, {assignments} }},")
    units = ", ".join(f"{c.name} {'deg' if c.unit == 'rad' else c.unit}".strip() for c in vehicle.controls)
    return "\n".join([f"commands = [ # linear between them; {units}", *lines, "]"])


def _top(control: Any) -> float:
    """A control's upper bound in the units of a shot file, or its scale if it is unbounded."""
    top = control.upper if math.isfinite(control.upper) else control.scale
    return math.degrees(top) if control.unit.startswith("rad") else top


def _spun(vehicle: Vehicle) -> str:
    """Release with a spin about the middle axis, whose rotation is unstable."""
    spin = np.full(3, 30.0)
    if vehicle.group.dim == 3:
        return "start = { velocity = [2, 0, 0], spin = [0, 0, 60] } # m/s, deg/s"
    inertia = np.diag(np.asarray(getattr(vehicle, "inertia", np.eye(3))))[:3]
    spin[int(np.argsort(inertia)[1])] = 480.0
    return f"start = {{ spin = {_array(*spin)} }} # deg/s, body axes"


def _integrate(vehicle: Vehicle, course: Course) -> str:
    """The motion without controls, by one integrator."""
    if not _drifts(vehicle):
        raise InputError(
            f"{vehicle.name} has controls", f"choose {default_method(vehicle)}", key="--method", value="integrate"
        )
    return f"""\
method = "integrate" # motion without controls in empty space
integrator = "variational" # for comparison: "rk2", "rk4", "implicit_rk2", "lie_newmark"
duration = {_number(round(course.seconds, 1))} # s
step = {1 / FPS} # s
{_spun(vehicle)}
"""


METHODS: Mapping[str, Callable[[Vehicle, Course], str]] = {
    "plan": _plan,
    "simulate": _simulate,
    "sinusoid": _sinusoid,
    "integrate": _integrate,
}
"""Method -> text of ``[vehicle.motion]``; raises ``InputError`` if the method does not suit the vehicle."""


def _why(vehicle: Vehicle) -> str:
    return "has no controls" if _drifts(vehicle) else "is moved in the air by its joints alone"


# ---------------------------------------------------------------- TOML


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)


def _number(value: float) -> str:
    """A number in its usual notation."""
    return f"{value:.10g}"


def _array(*values: float) -> str:
    return f"[{', '.join(_number(round(float(value), 3) + 0.0) for value in values)}]"


def _round_up(value: float) -> float:
    """The next number of one digit and a half: 0.7, 1.5, 20."""
    step = 10 ** math.floor(math.log10(value)) / 2
    return math.ceil(value / step) * step


def _aligned(text: str) -> str:
    """Align comments behind values in one column; remove double empty lines."""
    lines = []
    for line in text.splitlines():
        match = re.fullmatch(r'((?:# )?(?:[^#"]|"[^"]*")+?) # (.*)', line)
        lines.append(f"{match[1]:<{WIDE - 2}}  # {match[2]}" if match else line)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)) + "\n"
