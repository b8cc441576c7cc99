"""The shape of a shot file: one model per table, the docstring below a key says what to give.

What belongs here needs neither world nor vehicle to be judged; the rest is in `checks.py` and `motions.py`.
"""

from __future__ import annotations

import importlib
import re
from fractions import Fraction
from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import (
    AfterValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    WithJsonSchema,
    model_validator,
)

from vehsim.assets import shipped
from vehsim.cameras import CameraRig
from vehsim.intake.tables import Array, InSchema, Metre, NotNegative, Number, Point, Positive, Table, Text
from vehsim.world import MAX_WIND

MAX_FRAMES = 100_000
"""More frames than any shot has: an hour at 24 fps."""
MAX_PIXELS = 8192
"""The widest and highest picture: software rendering refuses 16384 x 16384."""
MAX_CAMERAS = 20
MAX_FPS = 1000
_NTSC = Fraction(1000, 1001)


def names_in(place: str) -> list[str]:
    """The keys of a table of vehsim's, ``module:table``, imported now."""
    module, _, table = place.partition(":")
    return list(getattr(importlib.import_module(module), table))


def one_of(place: str) -> InSchema:
    """A text that is a key of the table at ``place``."""
    return InSchema(lambda own: {"enum": names_in(place)})


def shipped_or_path(kind: str) -> InSchema:
    """A text that is the name of a shipped "vehicle" or "terrain", or a path."""
    return InSchema(lambda own: {"anyOf": [{"enum": list(shipped(kind))}, own]})


def parse_fps(value: Any) -> Fraction:
    """An exact rate: 24, "24000/1001", or the usual short forms of NTSC rates ("23.976" is 24000/1001)."""
    if isinstance(value, Fraction):
        rate = value
    elif isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError("not a frame rate")
    elif re.fullmatch(r"\d{1,7}/\d{1,7}", text := str(value).strip()):
        over, under = (int(part) for part in text.split("/"))
        if under == 0:
            raise ValueError("a rate over zero")
        rate = Fraction(over, under)
    elif re.fullmatch(r"\d{1,7}(\.\d{1,6})?", text):
        rate = Fraction(text)
        ntsc = round(rate) * _NTSC
        if rate.denominator != 1 and abs(rate - ntsc) < Fraction(5, 1000):
            rate = ntsc
    else:
        raise ValueError("not a frame rate")
    if not 0 < rate <= MAX_FPS:
        raise ValueError(f"not between 0 and {MAX_FPS} frames per second")
    return rate


def parse_mark_frame(value: Any) -> Any:
    """A whole frame, or ``"free"``."""
    if value == "free" or (isinstance(value, int) and not isinstance(value, bool) and abs(value) <= 10_000_000):
        return value
    raise ValueError("neither a whole frame nor 'free'")


def _unit(value: list[float]) -> list[float]:
    if abs(sum(x * x for x in value) - 1) > 1e-3:
        raise ValueError("its length is not 1")
    return value


def _opens(shutter: list[float]) -> list[float]:
    if not 0 < shutter[1] - shutter[0] <= 1:
        raise ValueError("it opens after it closes, or for more than a frame")
    return shutter


def _believable(wind: list[float]) -> list[float]:
    if sum(x * x for x in wind) > MAX_WIND**2:
        raise ValueError(f"more than {MAX_WIND:g} m/s")
    return wind


Plane = Annotated[list[Metre], Array, Len(2, 2)]
Velocity = Annotated[list[Annotated[Number, Field(ge=-1000, le=1000)]], Array, Len(3, 3)]
Wind = Annotated[list[Number], Array, Len(3, 3), AfterValidator(_believable)]
Quaternion = Annotated[list[Number], Array, Len(4, 4), AfterValidator(_unit)]
Shutter = Annotated[list[Annotated[Number, Field(ge=-1, le=1)]], Array, Len(2, 2), AfterValidator(_opens)]
Size = Annotated[list[Annotated[int, Field(ge=16, le=MAX_PIXELS, multiple_of=2)]], Array, Len(2, 2)]
Heading = Annotated[Number, Field(ge=-36_000, le=36_000)]
Frame = Annotated[int, Field(ge=-10_000_000, le=10_000_000)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,99}$")]
_RATE = {"anyOf": [{"type": "number", "exclusiveMinimum": 0, "maximum": MAX_FPS}, {"type": "string"}]}
Fps = Annotated[Fraction, PlainValidator(parse_fps), PlainSerializer(str), WithJsonSchema(_RATE)]
MarkFrame = Annotated[
    int | Literal["free"],
    PlainValidator(parse_mark_frame),
    WithJsonSchema({"anyOf": [{"type": "integer"}, {"const": "free"}]}),
]


class Header(Table):
    """``[shot]``"""

    version: Annotated[int, Field(alias="schema", ge=1, le=1)]
    """1, the version of this file format"""
    name: Name
    """a name of letters, digits and underscores: it names the folder, the stage and its root prim"""
    fps: Fps = Fraction(24)
    """a frame rate such as 24, "24000/1001" or "23.976\""""
    start_frame: Frame = 1001
    """the first frame of the cut, a whole number"""
    end_frame: Frame | None = None
    """the last frame of the cut, a whole number; where the longest motion ends unless given"""
    handles: Annotated[int, Field(ge=0, le=1000)] = 0
    """how many frames to add before and after the cut, 0 to 1000; needs end_frame"""

    @property
    def first(self) -> int:
        """First frame, handle included."""
        return self.start_frame - self.handles

    @property
    def last(self) -> int | None:
        """Last frame, handle included; None where the motion decides."""
        return None if self.end_frame is None else self.end_frame + self.handles


class GateTable(Table):
    """``gate = { direction = [1, 0, 0], radius = 4 }``: an opening about a mark's position."""

    direction: Velocity
    """which way through, [x, y, z] of any length"""
    radius: Positive | None = None
    """a ring's radius in m"""
    size: Annotated[list[Positive], Array, Len(2, 2)] | None = None
    """instead of it, a rectangle's [width, height] in m; its width is level"""

    @model_validator(mode="after")
    def _has_one_size(self) -> GateTable:
        if (self.radius is None) == (self.size is None):
            raise ValueError("neither radius nor size" if self.radius is None else "both radius and size")
        if not any(self.direction):
            raise ValueError("no direction")
        return self


class MarkTable(Table):
    """``[[vehicle.motion.mark]]``: what is not given is free."""

    frame: MarkFrame
    """a whole frame, or "free": the planner chooses"""
    position: Point | None = None
    """where the rig's root stands, [x, y, z] in m"""
    heading: Heading | None = None
    """the yaw of the vehicle's nose from world X in degrees, counter-clockwise"""
    orientation: Quaternion | None = None
    """instead of heading, a unit quaternion [w, x, y, z], body to world"""
    velocity: Velocity | None = None
    """the velocity [x, y, z] in m/s, world axes; [0, 0, 0] is standing still"""
    speed: Annotated[NotNegative, Field(le=1000)] | None = None
    """instead of velocity, the speed in m/s, in any direction"""
    joints: dict[str, Number] | None = None
    """a table of joint values, in the vehicle's own units; joints it leaves out are free"""
    tolerance: Annotated[NotNegative, Field(le=1e6)] = 0.0
    """how far from the position, in x, y and z, is good enough, in m"""
    hold: Annotated[int, Field(ge=0, le=MAX_FRAMES)] = 0
    """how many frames to stay there, with velocity = [0, 0, 0] or on_ground"""
    gate: GateTable | None = None
    """a table { direction, radius or size }: an opening about the position to pass through"""
    on_ground: bool = False
    """true: what flies stands there, level and at rest, put down from the position on the ground or obstacle below"""


class StartTable(Table):
    """``[vehicle.motion.start]``"""

    position: Point = Field(default=[0.0, 0.0, 0.0])
    """where the rig's root starts, [x, y, z] in m"""
    heading: Heading | None = None
    """the yaw of the vehicle's nose from world X in degrees, counter-clockwise; 0 unless given"""
    orientation: Quaternion | None = None
    """instead of heading, a unit quaternion [w, x, y, z], body to world"""
    velocity: Velocity = Field(default=[0.0, 0.0, 0.0])
    """the velocity [x, y, z] in m/s, world axes"""
    spin: Annotated[list[Annotated[Number, Field(ge=-36_000, le=36_000)]], Array, Len(3, 3)] = Field(
        default=[0.0, 0.0, 0.0]
    )
    """the angular velocity [x, y, z] in deg/s, the vehicle's own axes; in the plane only z counts"""
    joints: dict[str, Number] = Field(default={})
    """a table of joint values, in the vehicle's own units; 0 unless given"""


class CameraTable(Table):
    """``[camera]`` or several ``[[camera]]``: a `vehsim.cameras.CameraRig`, which knows what is left out."""

    name: Name = "chase"
    """a name of letters, digits and underscores, one of its own for every camera"""
    rig: Annotated[Text, one_of("vehsim.cameras:RIGS")] = "chase"
    """how the camera moves: "chase", "follow", "orbit", "static", "dolly", "crane", "fly_by" or "first_person\""""
    target: Text | None = None
    """the name of the vehicle it looks at; the first unless given"""
    lens_mm: Annotated[Number, Field(ge=4, le=2000)] = CameraRig.lens_mm
    """the focal length in mm, 4 to 2000"""
    aperture_width_mm: Annotated[Number, Field(ge=1, le=200)] = CameraRig.aperture_width_mm
    """the width of the film back in mm, 1 to 200"""
    fill: Annotated[Number, Field(ge=0.005, le=1)] = CameraRig.fill
    """the share of the picture's height the target takes upright, 0.005 to 1; it sets the distance"""
    distance: Annotated[Positive, Field(le=1e5)] | None = None
    """the distance to the target in m, instead of fill; from fill unless given"""
    height: Metre | None = None
    """how far above the target, in m; the rig's own unless given"""
    azimuth: Heading | None = None
    """degrees counter-clockwise from straight behind (chase), straight ahead (first_person), or looking along +X (the
    others); the rig's own unless given"""
    position: Point | None = None
    """where a static, fly_by or crane camera stands or a dolly's rail begins, [x, y, z] in m; chosen unless given"""
    to: Point | None = None
    """where a dolly's rail ends, [x, y, z] in m; chosen unless given"""
    look_at: Point | None = None
    """where a static camera looks without panning, [x, y, z] in m; it pans with the target unless given"""
    turn: Annotated[Number, Field(ge=-3600, le=3600)] = CameraRig.turn
    """degrees a second that an orbit turns"""
    rise: Metre | None = None
    """how far a crane rises, in m; chosen unless given"""
    eye: Point | None = None
    """where a first_person camera is, [x, y, z] in m in the vehicle's root frame; before its nose unless given"""
    framing: Annotated[list[Annotated[Number, Field(ge=-0.9, le=0.9)]], Array, Len(2, 2)] | None = None
    """where the target stands in the picture, [x, y] from the centre to 1 at the right and upper edges; the centre
    unless given"""
    level: bool | None = None
    """true or false: whether the horizon is level or banks with the vehicle; level but for first_person unless given"""
    margin: Annotated[NotNegative, Field(le=1000)] = CameraRig.margin
    """how far above the ground the camera stays, in m"""


class CutTable(Table):
    """One of several ``[[cut]]``."""

    frame: Frame
    """the first frame of this piece"""
    camera: Text
    """the name of the camera it is seen by"""


class ExportTable(Table):
    """``[export]``: how the USD is delivered"""

    up_axis: Literal["Y", "Z"] = "Z"
    """"Z" or "Y": the up axis of everything that is written"""
    meters_per_unit: Annotated[Positive, Field(ge=1e-6, le=1e6)] = 1.0
    """the length of a unit in metres: 0.01 for centimetres"""
    assets: Literal["copy", "keep"] = "copy"
    """"copy" the vehicles' assets along, or "keep" them where they are, referenced by their path as it is given"""
    outside: Literal["refuse", "copy"] = "refuse"
    """"copy" files that an asset refers to outside its own folder along too, or "refuse" them"""
    shutter: Shutter | None = None
    """[open, close] in frames about each frame, such as [-0.25, 0.25]: authored on the cameras, with the samples motion
    blur needs (a millimetre of chord, at most 16 an opening); closed unless given"""
    thin: Annotated[Positive, Field(ge=1e-6, le=10)] | None = None
    """a tolerance in m: adds a variant "thinned" with the fewest keys that stay within it; all keys unless given"""
    clip_frames: Annotated[int, Field(ge=2, le=MAX_FRAMES)] | None = None
    """for long takes: value clips of at most so many frames each; one layer unless given"""
    layer_only: bool = False
    """true to write the vehicles' animation layers and nothing else"""
    versions: bool = False
    """true to write v001, v002, ... and a latest.usda that sublayers the newest; none is ever overwritten"""


class RenderTable(Table):
    """``[render]``"""

    size: Size = Field(default=[960, 540])
    """the picture's [width, height] in pixels: even numbers, as films want them, from 16 to 8192"""
    every: Annotated[int, Field(ge=1, le=MAX_FRAMES)] = 1
    """1 to render every frame, 2 every second one, and so on"""
    samples: Annotated[int, Field(ge=0, le=16)] = 4
    """samples per pixel against jagged edges, 0 to 16"""
    shadows: bool = True
    """true or false: whether the sun casts shadows"""
    cameras: Annotated[list[Text], Array, Len(1, MAX_CAMERAS + 1)] | None = None
    """names of the cameras to render; all of them, or just "cut" where there is a [[cut]], unless given"""
    layout: Literal["separate", "side-by-side"] = "separate"
    """"side-by-side" puts the cameras' pictures beside each other in one more film; "separate" does not"""
    mood: Literal["afternoon", "dusk"] = "afternoon"
    """the time of day, "afternoon" or "dusk": where the sun stands and what colours it has"""
    passes: Annotated[list[Literal["depth", "segmentation"]], Array, Len(0, 2)] = Field(default=[])
    """"depth" (metres, 32-bit TIFF) and "segmentation" (a colour for each prim), beside every picture"""
    burn_in: bool = False
    """true or false: whether shot, camera and frame are written on the pictures"""
    captions: dict[str, Text] = Field(default={})
    """side-by-side: camera name = what to write below it; {NAME} is the energy left to the vehicle of that name"""
