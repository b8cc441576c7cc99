"""The keys of a ``vehicle.toml`` as strict tables; the docstring below a key says what to give.

This module checks what needs neither model nor asset: the names of controls, joints and channels are checked in
`library.py`, those of prims in `vehsim.rig.ops`. All numbers are in SI units.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, TypeVar

from annotated_types import Len
from pydantic import AfterValidator, BeforeValidator, Field

from vehsim.errors import InputError
from vehsim.intake.tables import Array, Metre, Number, Point, Positive, Table, Text, read_table
from vehsim.vehicles.definition.character import Reviewed

LARGEST = 1e12
"""Upper bound of every quantity of a vehicle, in SI units."""


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _bound(value: Any) -> float:
    if not _is_number(value) or math.isnan(value):
        raise ValueError("not a number")
    if LARGEST < abs(value) < math.inf:
        raise ValueError(f"beyond {LARGEST:g}")
    return float(value)


def _not_zero(value: float) -> float:
    if value == 0:
        raise ValueError("nothing would move")
    return value


def _pivot(value: Any) -> Any:
    place = isinstance(value, list | tuple) and len(value) == 3
    if value != "centre" and not (place and all(_is_number(x) and abs(x) <= 1e6 for x in value)):
        raise ValueError("neither a place nor the middle of the part")
    return value


def _quantity(value: Any) -> Any:
    """Numbers, lists of them, and tables of them by part."""
    for number in _flat(value):
        if not _is_number(number) or not math.isfinite(number):
            raise ValueError("not a finite number")
        if abs(number) > LARGEST:
            raise ValueError(f"beyond {LARGEST:g}")
    return value


def _flat(value: Any) -> list[Any]:
    rows = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else None
    return [value] if rows is None else [x for row in rows for x in _flat(row)]


Bound = Annotated[Any, BeforeValidator(_bound)]
IN_RANGE = AfterValidator(_quantity)
Quantity = Annotated[Any, IN_RANGE]
Op = Literal["rotateX", "rotateY", "rotateZ", "translateX", "translateY", "translateZ"]


class BoundsTable(Table):
    """``[joints.NAME]``, and what it shares with ``[controls.NAME]``"""

    lower: Bound = -math.inf
    """its least value, in SI units"""
    upper: Bound = math.inf
    """its greatest value, in SI units"""
    unit: str = ""
    """its unit, such as "N m", or "1" for a pure number"""


class ControlTable(BoundsTable):
    """``[controls.NAME]``"""

    scale: Annotated[Positive, Field(ge=1e-9)] = 1.0
    """the size of a typical value, above zero; default: of forces, what accelerates the vehicle by 1 m/s^2"""


class ActuatorTable(Table):
    """``[actuators.NAME]``"""

    rate: Annotated[Bound, Field(gt=0)] = math.inf
    """the largest rate of the control, in its unit per second"""
    lag: Annotated[Number, Field(ge=0, le=100)] = 0.0
    """the time constant with which the control follows its command, s"""
    source: str = ""
    """the source of the numbers"""


class ChannelTable(Table):
    """``[channels.NAME]``"""

    prim: Text | Annotated[list[Text], Len(1)]
    """a path below the rig root, or a list of them, which all move alike"""
    op: Op
    """"rotateX", "rotateY", "rotateZ", "translateX", "translateY" or "translateZ\""""
    pivot: Annotated[Any, AfterValidator(_pivot)] = None
    """"centre" or three numbers, m"""
    factor: Annotated[Number, AfterValidator(_not_zero)] = 1.0
    """a number such as -1"""
    disc: bool | str = False
    """true, or a pattern of meshes' names"""


class SuspensionTable(Table):
    """``[suspension]``"""

    frequency: Annotated[Positive, Field(le=100)] = 1.5
    """a positive number, in Hz"""
    damping: Annotated[Positive, Field(le=100)] = 0.5
    """a positive damping ratio, 1 for critical damping"""
    mass_height: Annotated[Number, Field(ge=0, le=100)] = 0.5
    """a height, in m"""


Row = TypeVar("Row")


class TraitTable(Table):
    """A quantity of ``[character]``."""

    calm: Positive
    """its value when driven calmly"""
    normal: Positive
    """its value when driven normally"""
    brisk: Positive
    """its value when driven briskly"""
    source: Text
    """the source of the numbers"""


class ReplacedTrait(Table):
    """Numbers in place of those of a quantity of ``[character]``."""

    calm: Positive | None = None
    """its value when driven calmly"""
    normal: Positive | None = None
    """its value when driven normally"""
    brisk: Positive | None = None
    """its value when driven briskly"""
    source: Text | None = None
    """the source of the numbers"""


class CharacterTable(Table, Generic[Row]):
    """``[character]``; a ``Row`` is a `TraitTable`, or a `ReplacedTrait` where it replaces numbers."""

    response: Row | None = None
    """the response time of the controls, s"""
    costs: dict[str, Row] = Field(default={})
    """weights of costs of plans by name, beside 1 for effort"""
    limits: dict[str, Row] = Field(default={})
    """limits of plans by name, in SI units"""
    control_rates: dict[str, Row] = Field(default={})
    """the greatest rates of controls by name, in their units per second"""
    review: dict[Reviewed, Row] = Field(default={})
    """what else a review compares: jerk, slip, saturation, reversals, settling, ease, power and slide, in SI units"""
    stunt_controls: list[str] | None = None
    """the names of controls that only a stunt uses; all others leave them at zero"""


class VehicleFile(Table):
    """A ``vehicle.toml``."""

    version: Annotated[int, Field(alias="schema", ge=1, le=1)] = 1
    """1, the version of this file format"""
    name: Text | None = None
    """a name"""
    base: Text | None = None
    """the folder of another vehicle, relative to this file: it gives every key that this file does not"""
    model: Text | None = None
    """the name of a model, which a base may give"""
    asset: Text | None = None
    """a USD, GLB or OBJ file, relative to this one"""
    root: str = ""
    """the path of the asset's prim that is the vehicle"""
    origin: Point = Field(default=[0.0, 0.0, 0.0])
    """three numbers, m, in the rig root's frame"""
    hull: Text | None = None
    """the closed mesh that displaces water, a path below the root"""
    hull_form: Literal["planing", "displacement"] | None = None
    """"planing" or "displacement": how it resists; particulars that physics lacks are measured on the hull"""
    hydrodynamics: Text | None = None
    """a file written by vehsim hydro, relative to this one"""
    top_speed: Annotated[Bound, Field(gt=0)] = math.inf
    """a speed above zero, in m/s"""
    top_turn_rate: Annotated[Bound, Field(gt=0)] = math.inf
    """an angular speed above zero, in rad/s"""
    physics: dict[str, Quantity] = Field(default={})
    """SI units"""
    controls: dict[str, ControlTable] = Field(default={})
    """tables of controls with lower, upper, scale and unit"""
    actuators: dict[str, ActuatorTable] = Field(default={})
    """tables of controls with rate, lag and source"""
    joints: dict[str, BoundsTable] = Field(default={})
    """tables of joints with lower and upper"""
    channels: dict[str, ChannelTable] = Field(default={})
    """tables of channels with prim, op, pivot, factor and disc"""
    character: CharacterTable[TraitTable] = CharacterTable()
    """how it is driven: a table with response, costs, limits, control_rates and review"""
    suspension: SuspensionTable = SuspensionTable()
    """a table with frequency, damping and mass_height"""
    up_axis: Literal["Y", "Z"] | None = None
    """"Y" or "Z\""""
    meters_per_unit: Annotated[Positive, Field(ge=1e-6, le=1e6)] | None = None
    """metres, such as 0.01 for centimetres"""
    forward: Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"] | None = None
    """the axis that the asset's nose points along"""
    offset: Annotated[list[Metre], Array, Len(3, 3)] = Field(default=[0.0, 0.0, 0.0])
    """three numbers, m, along the nose, to the left and up"""
    variants: dict[str, Text] = Field(default={})
    """a table of variant set = variant"""


def read_vehicle(path: Path) -> dict[str, Any]:
    """The data of a ``vehicle.toml``, with what its base gives. Raises ``ShotError`` with everything that is wrong."""
    data = read_table(path, VehicleFile)
    if (base := _base(path, data)) is None:
        if "model" not in data:
            remedy = 'name a model, such as model = "car", or the folder of a vehicle that has one, base = "../car"'
            raise InputError("missing", remedy, key="model", file=path)
        return data
    below = read_table(base, VehicleFile)
    if "base" in below:
        remedy = "name a vehicle without a base"
        raise InputError("the base has a base itself", remedy, key="base", value=data["base"], file=path)
    for key in ("asset", "hydrodynamics"):
        if key in below:
            below[key] = (Path(data["base"]) / below[key]).as_posix()
    found = merged(below, data)
    if "model" not in found:
        remedy = f'add one, such as model = "car", to this file or to {base}'
        raise InputError("missing, also in the base", remedy, key="model", file=path)
    return found


def vehicle_files(path: Path) -> list[Path]:
    """A ``vehicle.toml``, that of its base, and the coefficients of its hull."""
    base, hydro = _base(path, read_table(path, VehicleFile)), read_vehicle(path).get("hydrodynamics")
    return [path, *([] if base is None else [base]), *([] if hydro is None else [path.parent / hydro])]


def _base(path: Path, data: Mapping[str, Any]) -> Path | None:
    return (path.parent / data["base"] / "vehicle.toml").resolve() if "base" in data else None


def merged(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    """Tables with the values of ``new`` in place of those of ``old``, key by key."""
    both = {key: merged(old[key], value) for key, value in new.items() if isinstance(value, Mapping) and key in old}
    return {**old, **new, **both}
