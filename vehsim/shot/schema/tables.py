"""The shape of a shot file: one model per table; the docstring below a key says what to give.

This module checks what needs neither world nor vehicle; `checks.py` and `motions` do the rest.
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

from vehsim.assets import REGISTRIES
from vehsim.cameras.camera import CameraRig
from vehsim.intake.tables import (
    TOWARDS,
    Array,
    InSchema,
    Metre,
    Name,
    NotNegative,
    Number,
    Place,
    Point,
    Positive,
    Table,
    Text,
)
from vehsim.requests.mark_frame import FREE, Timed
from vehsim.world.world import MAX_WIND

MAX_FRAMES = 100_000
"""Largest number of frames in a shot: more than an hour at 24 fps."""
MAX_PIXELS = 8192
"""Largest width and height of a picture: software rendering refuses 16384 x 16384."""
MAX_CAMERAS = 20
NOTE = 1000
"""Largest length of a note, characters."""
MAX_FPS = 1000
_NTSC = Fraction(1000, 1001)


def names_in(place: str) -> list[str]:
    """The keys of a table ``module:table`` of vehsim, imported on demand."""
    module, _, table = place.partition(":")
    return list(getattr(importlib.import_module(module), table))


def one_of(place: str) -> InSchema:
    """A text that is a key of the table at ``place``."""
    return InSchema(lambda own: {"enum": names_in(place)})


def shipped_or_path(kind: str) -> InSchema:
    """A text that is the name of a shipped "vehicle" or "terrain", or a path."""
    return InSchema(lambda own: {"anyOf": [{"enum": list(REGISTRIES[kind])}, own]})


def parse_fps(value: Any) -> Fraction:
    """An exact rate: 24, "24000/1001", or the usual short forms of NTSC rates ("23.976" is 24000/1001)."""
    if isinstance(value, Fraction):
        rate = value
    elif isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError("not a frame rate")
    elif re.fullmatch(r"\d{1,7}/\d{1,7}", text := str(value).strip()):
        over, under = (int(part) for part in text.split("/"))
        if under == 0:
            raise ValueError("a frame rate with a denominator of zero")
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
    if value == FREE or (isinstance(value, int) and not isinstance(value, bool) and abs(value) <= 10_000_000):
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
    """a name of letters, digits and underscores; the folder, the stage and its root prim get this name"""
    fps: Fps = Fraction(24)
    """a frame rate such as 24, "24000/1001" or "23.976\""""
    start_frame: Frame = 1001
    """the first frame of the cut, a whole number"""
    end_frame: Frame | None = None
    """the last frame of the cut, a whole number; default: the end of the longest motion"""
    handles: Annotated[int, Field(ge=0, le=1000)] = 0
    """the number of frames to add before and after the cut, 0 to 1000; needs end_frame"""

    @property
    def first(self) -> int:
        """First frame, handle included."""
        return self.start_frame - self.handles

    @property
    def last(self) -> int | None:
        """Last frame, handle included; None if the motion determines it."""
        return None if self.end_frame is None else self.end_frame + self.handles


class GateTable(Table):
    """``gate = { direction = [1, 0, 0], radius = 4 }``: an opening about a mark's position."""

    direction: Annotated[Velocity, TOWARDS]
    """the direction of passage, [x, y, z] of any length; without velocity and speed, at least 0.05 m/s in it"""
    radius: Positive | None = None
    """the radius of a ring in m"""
    size: Annotated[list[Positive], Array, Len(2, 2)] | None = None
    """the [width, height] of a rectangle in m, instead of radius; its width is horizontal"""

    @model_validator(mode="after")
    def _has_one_size(self) -> GateTable:
        if (self.radius is None) == (self.size is None):
            raise ValueError("neither radius nor size" if self.radius is None else "both radius and size")
        if not any(self.direction):
            raise ValueError("no direction")
        return self


class MarkTable(Timed, Table):
    """``[[vehicle.motion.mark]]``: values that are not given are free."""

    frame: MarkFrame
    """a whole frame, or "free": the planner chooses"""
    position: Place | None = None
    """the position of the rig's root, [x, y, z] in m"""
    heading: Heading | None = None
    """the yaw of the vehicle's nose from world X in degrees, counter-clockwise"""
    orientation: Quaternion | None = None
    """instead of heading, a unit quaternion [w, x, y, z], body to world"""
    velocity: Velocity | None = None
    """the velocity [x, y, z] in m/s, world axes; [0, 0, 0] means at rest"""
    speed: Annotated[NotNegative, Field(le=1000)] | None = None
    """instead of velocity, the speed in m/s, in any direction"""
    joints: dict[str, Number] | None = None
    """a table of joint values, in the vehicle's own units; joints that are not in it are free"""
    tolerance: Annotated[NotNegative, Field(le=1e6)] = 0.0
    """the permitted distance from the position along each of x, y and z, in m"""
    hold: Annotated[int, Field(ge=0, le=MAX_FRAMES)] = 0
    """the number of frames to stay there; needs velocity = [0, 0, 0] or on_ground, and no orientation"""
    gate: GateTable | None = None
    """a table { direction, radius or size }: an opening around the position to pass through"""
    on_ground: bool = False
    """true: a flying vehicle stands level and at rest on the ground or obstacle below the position"""
    ease: bool | None = None
    """true: at a mark at rest, the controls start and end gently; default: depends on the character of the motion"""


class StartTable(Table):
    """``[vehicle.motion.start]``"""

    position: Place = Field(default=[0.0, 0.0, 0.0])
    """the position of the rig's root, [x, y, z] in m"""
    heading: Heading | None = None
    """the yaw of the vehicle's nose from world X in degrees, counter-clockwise; default: 0. A vehicle that flies and
    starts at rest leans as in balance"""
    orientation: Quaternion | None = None
    """instead of heading, a unit quaternion [w, x, y, z], body to world"""
    velocity: Velocity = Field(default=[0.0, 0.0, 0.0])
    """the velocity [x, y, z] in m/s, world axes"""
    spin: Annotated[list[Annotated[Number, Field(ge=-36_000, le=36_000)]], Array, Len(3, 3)] = Field(
        default=[0.0, 0.0, 0.0]
    )
    """the angular velocity [x, y, z] in deg/s, in body axes; a planar vehicle uses only z"""
    joints: dict[str, Number] = Field(default={})
    """a table of joint values, in the vehicle's own units; default: 0"""


class CameraTable(Table):
    """``[camera]`` or several ``[[camera]]``: a `vehsim.cameras.CameraRig`, which chooses omitted values."""

    name: Name = "chase"
    """a name of letters, digits and underscores, different for every camera"""
    rig: Annotated[Text, one_of("vehsim.cameras:RIGS")] = "chase"
    """how the camera moves: "chase", "follow", "orbit", "static", "dolly", "crane", "fly_by" or "first_person\""""
    target: Text | None = None
    """the name of the vehicle that the camera looks at; default: the first"""
    lens_mm: Annotated[Number, Field(ge=4, le=2000)] = CameraRig.lens_mm
    """the focal length in mm, 4 to 2000"""
    aperture_width_mm: Annotated[Number, Field(ge=1, le=200)] = CameraRig.aperture_width_mm
    """the width of the film back in mm, 1 to 200"""
    fill: Annotated[Number, Field(ge=0.005, le=1)] = CameraRig.fill
    """the height of the upright target as a share of the picture's height, 0.005 to 1; determines the distance"""
    distance: Annotated[Positive, Field(le=1e5)] | None = None
    """the distance to the target in m, instead of fill; default: computed from fill"""
    height: Metre | None = None
    """the height above the target, in m; default: depends on the rig"""
    azimuth: Heading | None = None
    """degrees counter-clockwise from straight behind (chase), straight ahead (first_person), or looking along +X (the
    others); default: depends on the rig"""
    position: Place | None = None
    """the place of a static, fly_by or crane camera, or the start of a dolly's rail, [x, y, z] in m; default: chosen
    automatically"""
    to: Place | None = None
    """the end of a dolly's rail, [x, y, z] in m; default: chosen automatically"""
    look_at: Place | None = None
    """the point at which a static camera looks without panning, [x, y, z] in m; default: pans with the target"""
    turn: Annotated[Number, Field(ge=-3600, le=3600)] = CameraRig.turn
    """the rate of an orbit in degrees per second"""
    rise: Metre | None = None
    """the rise of a crane, in m; default: chosen automatically"""
    eye: Point | None = None
    """the place of a first_person camera, [x, y, z] in m in the vehicle's root frame; default: in front of its nose"""
    framing: Annotated[list[Annotated[Number, Field(ge=-0.9, le=0.9)]], Array, Len(2, 2)] | None = None
    """the target's place in the picture, [x, y], from 0 in the centre to 1 at the right and upper edges; default: the
    centre"""
    level: bool | None = None
    """true for a level horizon, false for one that banks with the vehicle; default: level, except for first_person"""
    margin: Annotated[NotNegative, Field(le=1000)] = CameraRig.margin
    """the least height of the camera above the ground, in m"""


class CutTable(Table):
    """One of several ``[[cut]]``."""

    frame: Frame
    """the first frame of this piece"""
    camera: Text
    """the name of the camera that shows it"""


class NoteTable(Table):
    """One of several ``[[note]]``: it changes no motion."""

    frame: Frame
    """the frame from which it is shown"""
    text: Annotated[Text, Field(max_length=NOTE)]
    """the text, up to 1000 characters"""
    position: Place | None = None
    """the place that it points at, [x, y, z] in m; default: above the picture"""


class CurvesTable(Table):
    """``curves = { tolerance = 0.001 }``."""

    tolerance: Annotated[Positive, Field(ge=1e-5, le=10)] = 0.001
    """the greatest distance from the motion, in m"""
    angle: Annotated[Positive, Field(ge=1e-3, le=45)] | None = None
    """the greatest angle from the motion, in degrees; default: 0.05, and for parts as much as moves their outermost
    point by ``tolerance``, if that is more"""


class ExportTable(Table):
    """``[export]``: the form of the USD"""

    up_axis: Literal["Y", "Z"] = "Z"
    """"Z" or "Y": the up axis of everything that is written"""
    meters_per_unit: Annotated[Positive, Field(ge=1e-6, le=1e6)] = 1.0
    """the length of a unit in metres: 0.01 for centimetres"""
    assets: Literal["copy", "keep"] = "copy"
    """"copy" to copy the vehicles' assets into the delivery, or "keep" to reference them by their given path"""
    outside: Literal["refuse", "copy"] = "refuse"
    """"copy" to also copy files that an asset refers to outside its own folder, or "refuse" to report an error"""
    shutter: Shutter | None = None
    """[open, close] in frames around each frame, such as [-0.25, 0.25]: written to the cameras, with enough samples for
    motion blur (chords within a millimetre, at most 16 samples per opening); default: closed"""
    thin: Annotated[Positive, Field(ge=1e-6, le=10)] | None = None
    """a tolerance in m: adds a variant "thinned" with the fewest keys within this tolerance; default: all keys"""
    curves: CurvesTable | None = None
    """a table { tolerance, angle }: adds a variant "curves" with few keys on splines, within these tolerances at 64
    instants of every frame; default: no curves"""
    clip_frames: Annotated[int, Field(ge=2, le=MAX_FRAMES)] | None = None
    """the greatest number of frames in a value clip, for long takes; default: one layer"""
    layer_only: bool = False
    """true to write only the vehicles' animation layers, which reference the assets where they are; without a report"""
    tyre_marks: bool = True
    """true or false: whether sliding tyres leave marks on the ground"""
    versions: bool = False
    """true to write v001, v002, ... and a latest.usda that sublayers the newest; no version is ever overwritten"""


class RenderTable(Table):
    """``[render]``"""

    size: Size = Field(default=[960, 540])
    """the picture's [width, height] in pixels: even numbers, as films require, from 16 to 8192"""
    every: Annotated[int, Field(ge=1, le=MAX_FRAMES)] = 1
    """1 to render every frame, 2 for every second frame, and so on"""
    samples: Annotated[int, Field(ge=0, le=16)] = 4
    """samples per pixel for anti-aliasing, 0 to 16"""
    shadows: bool = True
    """true or false: whether the sun casts shadows"""
    cameras: Annotated[list[Text], Array, Len(1, MAX_CAMERAS + 1)] | None = None
    """names of the cameras to render; default: all, or only "cut" if there is a cut list"""
    cuts: Text | None = None
    """the path of an OpenTimelineIO file (.otio) with the cut list, instead of [[cut]] tables; its clips have the names
    of cameras"""
    layout: Literal["separate", "side-by-side"] = "separate"
    """"side-by-side" for an additional film with the cameras' pictures beside each other, or "separate\""""
    mood: Literal["afternoon", "noon", "overcast", "dusk", "night"] = "afternoon"
    """the light: "afternoon", "noon", "overcast", "dusk" or "night" (moon, stars and lamps)"""
    passes: Annotated[list[Literal["depth", "segmentation", "flow", "normals"]], Array, Len(0, 4)] = Field(default=[])
    """"depth" (metres, 32-bit TIFF), "segmentation" (a colour for each prim), "flow" (pixels to the next and to the
    previous frame, EXR) and "normals" (world axes, EXR), in addition to every picture"""
    burn_in: bool = False
    """true or false: whether to write shot, camera and frame on the pictures"""
    captions: dict[str, Text] = Field(default={})
    """for side-by-side: camera name = caption; {NAME} is replaced by the remaining energy of that vehicle, in % or,
    if it starts with none, in J"""
