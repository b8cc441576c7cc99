"""Messages about wrong values: in the user's terms, once for each fault, for any key and value."""

from __future__ import annotations

import copy
import math
import re
import tomllib
from collections.abc import Iterator
from typing import Any

import pytest

from vehsim import Shot
from vehsim.errors import ShotError, SolveError
from vehsim.shot.schema.shot_file import parse, schema

SHOT = tomllib.loads("""
[shot]
schema = 1
name = "a"
fps = 24
start_frame = 1001
end_frame = 1100
handles = 0

[[note]]
frame = 1010
text = "brakes"

[world]
terrain = "flat"
wind = [0, 0, 0]
gusts = { strength = 0.1, period = 8, seed = 0 }
contact = { friction = 0.4, restitution = 0.3, speed = 20 }
[world.water]
level = 0
density = 1025
wave = [{ height = 1, length = 12, heading = 0, phase = 0 }]
sea = { height = 1, period = 5, heading = 0, spread = 28, peakedness = 3.3, seed = 0 }
choppiness = 0
grids = "a.npz"
current = [0, 0, 0]
current_depth = 1
vortex = [{ centre = [0, 0], speed = 1, radius = 1 }]
mole = [{ line = [[0, 0], [1, 0]] }]
height_field = 0.1
[[world.obstacle]]
shape = "polygon"
name = "p"
points = [[0, 0], [1, 0], [0, 1]]
height = 1
base = 0
finish = "facade"
colour = [0.2, 0.5, 0.8]
[[world.obstacle]]
shape = "cone"
centre = [0, 0, 0]
radius = 1
height = 1
tip = 1
[[world.obstacle]]
shape = "ellipse"
centre = [0, 0]
radii = [1, 1]
heading = 0
[[world.obstacle]]
shape = "box"
centre = [0, 0, 0]
size = [1, 1, 1]
[[world.obstacle]]
shape = "sphere"
centre = [0, 0, 0]
radius = 1
[[world.obstacle]]
shape = "mesh"
path = "a.obj"
position = [0, 0, 0]
scale = 1
[[world.obstacle]]
shape = "vehicle"
vehicle = "heli"

[[vehicle]]
name = "heli"
asset = "helicopter"
variants = { livery = "red" }
parameters = { mass = 1500 }
[vehicle.motion]
method = "plan"
character = "normal"
cost = { time = 1 }
segments = 8
clearance = 1
limits.speed = 1
limits.ceiling = 1
limits.climb = 1
limits.turn_rate = 1
limits.bank = 1
limits.acceleration = 1
limits.g_load = 1
limits.steering = 1
limits.steering_rate = 1
limits.grip = 1
limits.joints = { psi = [0, 1], phi = 1 }
limits.joint_rates = { psi = 1 }
loop = false
solver = "ipopt"
guess = "sinusoid"
time_limit = 1
look = [{ at = [0, 0, 0], frames = [1, 2], within = 5, axis = "x", level = true }]
stay = [{ frames = [1, 2], above = 1, below = 2, inside = [0, 0, 1, 1] }]
[[vehicle.motion.mark]]
frame = 1001
position = [0, 0, 0]
heading = 0
orientation = [1, 0, 0, 0]
velocity = [0, 0, 0]
speed = 1
joints = { psi = 1 }
tolerance = 0
hold = 0
ease = true
gate = { direction = [1, 0, 0], radius = 1 }
on_ground = false
[[vehicle.motion.mark]]
frame = "free"
gate = { direction = [1, 0, 0], size = [1, 1] }

[[vehicle]]
name = "blocked"
asset = "helicopter"
[vehicle.motion]
method = "plan"
cost = "time"
marks = { usd = "a.usda", prim = "/a", frames = [1, 2], use = ["position"], tolerance = 0, forward = "X", edit = false }
[vehicle.edit]
usd = "b.usda"
prim = "/a"
round = 1

[[vehicle]]
name = "simulated"
asset = "car"
[vehicle.motion]
method = "simulate"
duration = 1
step = 0.01
commands = [{ frame = 1001, torque = 1 }]
continues = "earlier.npz"
pilot = { name = "hover", position = [0, 0, 0] }
[vehicle.motion.start]
position = [0, 0, 0]
heading = 0
orientation = [1, 0, 0, 0]
velocity = [0, 0, 0]
spin = [0, 0, 0]
afloat = true

[[vehicle]]
name = "clipped"
asset = "car"
[vehicle.motion]
method = "clip"
path = "a.npz"

[[vehicle]]
name = "recorded"
asset = "car"
[vehicle.motion]
method = "sticks"
file = "a.csv"

[[vehicle]]
name = "integrated"
asset = "car"
[vehicle.motion]
method = "integrate"
integrator = "rk4"
duration = 1

[[vehicle]]
name = "steered"
asset = "car"
[vehicle.motion]
method = "sinusoid"
mark = [{ frame = 1001, position = [0, 0, 0], pitch = 0 }, { frame = "free", position = [0, 1, 0] }]
manoeuvre = 1
amplitude = 1
cycles = 1
phase = 0
limits = { speed = 1 }

[[camera]]
name = "c"
rig = "chase"
target = "heli"
lens_mm = 35
aperture_width_mm = 30
fill = 0.3
distance = 1
height = 1
azimuth = 1
position = [0, 0, 0]
to = [0, 0, 0]
look_at = [0, 0, 1]
turn = 1
rise = 1
eye = [0, 0, 0]
framing = [0, 0]
level = true
margin = 1
[[cut]]
frame = 1001
camera = "c"
[render]
size = [96, 64]
every = 1
samples = 4
shadows = true
cameras = ["c"]
cuts = "a.otio"
layout = "separate"
mood = "dusk"
passes = ["depth"]
burn_in = false
captions = { c = "a" }
[export]
up_axis = "Z"
meters_per_unit = 1
assets = "copy"
shutter = [-0.25, 0.25]
thin = 0.1
tyre_marks = false
curves = { tolerance = 0.01, angle = 0.1 }
clip_frames = 10
layer_only = false
versions = false
outside = "refuse"
""")
"""Every kind of table of a shot file, with nearly every key."""

SCALARS = (-3, 1e12, 10**400, math.nan, "word", "", True, None)
TABLES: tuple[Any, ...] = ([], [-1, "a"], [math.nan] * 3, {}, {"a": {"b": -1}}, {"psi": [3, "x"]})
INTERNALS = re.compile(r"pydantic|functools|function|dict\[|list\[|union|tagged|nullable|literal|[Ii]nput should|\n")


def places(value: Any, place: tuple[int | str, ...] = ()) -> Iterator[tuple[int | str, ...]]:
    if place:
        yield place
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from places(inner, (*place, key))


def said_of(place: tuple[int | str, ...], value: Any) -> list[str]:
    data = copy.deepcopy(SHOT)
    table: Any = data
    for step in place[:-1]:
        table = table[step]
    table[place[-1]] = value
    return [str(problem) for problem in parse(data)[1]]


def test_the_shot_has_the_keys_of_the_schema() -> None:
    keys = {step for place in places(SHOT) for step in place if isinstance(step, str)}
    assert {key for table in schema()["$defs"].values() for key in table["properties"]} - keys == set()


@pytest.mark.parametrize("key", SHOT)
def test_messages_use_the_users_terms_once_per_fault(key: str) -> None:
    assert said_of((key,), SHOT[key]) == []
    for place in places(SHOT[key], (key,)):
        for value in (*SCALARS, *TABLES):
            texts = said_of(place, value)
            assert not [text for text in texts if INTERNALS.search(text)], (place, value)
            wheres = [re.split(r" = |: ", text)[0] for text in texts]
            assert len(set(wheres)) == len(wheres), (place, value, texts)
            assert len(texts) <= 1 or isinstance(value, dict | list), (place, value, texts)


def test_a_joint_outside_its_range_is_named_with_its_value() -> None:
    marks = [{"frame": 1001, "position": [0, 0, 0]}, {"frame": 1100, "position": [4, 0, 0], "joints": {"phi": 1.5}}]
    motion = {"method": "plan", "mark": marks}
    data = {"shot": {"schema": 1, "name": "a"}, "vehicle": [{"name": "s", "asset": "snakeboard", "motion": motion}]}
    (problem,) = Shot.from_dict(data).check()
    assert str(problem) == (
        "vehicle[0].motion.mark[1].joints.phi = 1.5: outside -0.7 to 0.7 rad; keep it inside, or leave it free"
    )


@pytest.mark.parametrize(
    "limits, says",
    [
        ({"speed": -3}, "limits.speed = -3: it should be greater than 0; give a number above zero"),
        ({"speed": "fast"}, "limits.speed = 'fast': not a number; give a number above zero"),
        ({"speed": {"a": 1}}, "limits.speed = {'a': 1}: not a number; give a number above zero"),
        ({"ceiling": "high"}, "limits.ceiling = 'high': not a number; give the greatest height"),
        ({"joints": 3}, "limits.joints = 3: not a table; give a table of joints"),
        ({"joints": {"psi": 0}}, "limits.joints.psi = 0: it should be greater than 0; give a number above zero, for"),
        ({"joints": {"psi": [0]}}, "limits.joints.psi = [0]: 1 given, at least 2 wanted"),
        ({"joints": {"psi": [2, 1]}}, "limits.joints.psi = [2, 1]: the first is above the second"),
        ({"joints": {"psx": 1}}, "limits.joints.psx = 1.0: no such joint; did you mean 'psi'?"),
        ({"sped": 3}, "limits.sped = 3.0: no such limit; did you mean 'speed'?"),
    ],
)
def test_a_wrong_limit_is_one_plain_message(limits: dict[str, Any], says: str) -> None:
    marks = [{"frame": 1001, "position": [0, 0, 0]}, {"frame": 1100, "position": [20, 0, 0]}]
    motion = {"method": "plan", "limits": limits, "mark": marks}
    data = {"shot": {"schema": 1, "name": "a"}, "vehicle": [{"name": "car", "asset": "car", "motion": motion}]}
    try:
        problems = Shot.from_dict(data).check()
    except ShotError as error:
        problems = error.problems
    (problem,) = problems
    assert str(problem).startswith(f"vehicle[0].motion.{says}")


def test_a_choice_is_listed_once() -> None:
    """Where the description of a key has its names, and where it has not."""
    motion = {"method": "plan", "mark": [{"frame": 1, "position": [0, 0, 0]}, {"frame": 9, "position": [1, 0, 0]}]}
    car = {"name": "car", "asset": "car", "parameters": {"surface": "mud"}, "motion": motion}
    (problem,) = Shot.from_dict({"shot": {"schema": 1, "name": "a"}, "vehicle": [car]}).check()
    assert problem.said == "unknown; give one of 'asphalt', 'wet asphalt', 'gravel', 'snow', 'ice'"
    car = {"name": "car", "asset": "car", "motion": {**motion, "look": [{"at": [0, 0, 0], "axis": "q"}]}}
    with pytest.raises(ShotError) as caught:
        Shot.from_dict({"shot": {"schema": 1, "name": "a"}, "vehicle": [car]})
    assert str(caught.value).count("'-y'") == 1


def test_valid_limits_are_kept() -> None:
    limits = {"speed": 3, "joints": {"psi": [-0.5, 1], "phi": 1}}
    motion = {"method": "plan", "limits": limits, "mark": [{"frame": 1001}, {"frame": 1100}]}
    vehicle = {"name": "car", "asset": "car", "motion": motion}
    shot, problems = parse({"shot": {"schema": 1, "name": "a"}, "vehicle": [vehicle]})
    assert shot is not None and problems == []
    assert shot.vehicle[0].motion.limits.given() == limits  # type: ignore[union-attr]
    assert shot.model_dump(by_alias=True, exclude_unset=True)["vehicle"][0]["motion"]["limits"] == limits


def test_a_car_in_a_world_with_contact_is_refused_among_obstacles():
    """Contact does not act in the plane: it would drive through them."""
    data = {
        "shot": {"schema": 1, "name": "wall", "end_frame": 1010},
        "world": {
            "contact": {},
            "obstacle": [{"shape": "box", "name": "wall", "centre": [9, 0, 1], "size": [1, 8, 2]}],
        },
        "vehicle": [{"name": "car", "asset": "car", "motion": {"method": "simulate"}}],
    }
    (problem,) = Shot.from_dict(data).check()
    assert problem.key == "vehicle[0].asset" and "it would drive through wall" in problem.message
    data["world"]["obstacle"] = []
    assert not Shot.from_dict(data).check()


def test_a_mark_whose_frame_is_free_must_be_reached_before_the_shot_ends():
    """The motion would be cut off before it; the message names the end that works, which is tried."""
    ends = [
        {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [0, 0, 0]},
        {"frame": "free", "position": [20, 3, 0], "velocity": [0, 0, 0]},
    ]
    ends.insert(1, {"frame": 1010, "heading": 0})
    motion = {"method": "plan", "segments": 16, "character": "brisk", "mark": ends}
    header = {"schema": 1, "name": "late", "end_frame": 1030, "handles": 4}
    data = {"shot": header, "vehicle": [{"name": "one", "asset": "car", "motion": motion}]}
    with pytest.raises(
        SolveError, match=r"shot.end_frame = 1030: one reaches mark\[2\] only at frame \d+; use"
    ) as late:
        Shot.from_dict(data).solve()
    ((key, needed),) = late.value.problem.fixes
    assert key == "shot.end_frame"
    header["end_frame"] = needed
    take = Shot.from_dict(data).solve()
    assert take.frames == (997, needed + 4) and take.clips["one"].end_frame == needed + 4
