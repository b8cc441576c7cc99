"""The whole shot file as one model, and all errors of a file's shape as problems that a user can fix."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Any

from annotated_types import Len
from pydantic import BeforeValidator, Field, ValidationError

from vehsim.errors import Problem
from vehsim.intake.tables import Array, Table, Text, locate, problems_of
from vehsim.shot.motions.clip import ClipMotion
from vehsim.shot.motions.edit import EditTable
from vehsim.shot.motions.integrate import IntegrateMotion
from vehsim.shot.motions.plan import PlanMotion
from vehsim.shot.motions.simulate import SimulateMotion
from vehsim.shot.motions.sinusoid import SinusoidMotion
from vehsim.shot.motions.sticks import SticksMotion
from vehsim.shot.schema.tables import (
    MAX_CAMERAS,
    CameraTable,
    CutTable,
    ExportTable,
    Header,
    Name,
    NoteTable,
    RenderTable,
    shipped_or_path,
)
from vehsim.shot.schema.world import WorldTable

DIALECT = "http://json-schema.org/draft-07/schema#"
"""The dialect that TOML editors support most widely; later drafts are not needed."""
SCHEMA_FILE = "vehsim.schema.json"
SCHEMA_LINE = f"#:schema ./{SCHEMA_FILE}"
"""The first line of a shot file by which an editor finds the schema beside it."""
MAX_VEHICLES = 100
MAX_CUTS = 1000
MAX_NOTES = 1000
MAX_EDITS = 50


def _one_or_several(value: Any) -> Any:
    """``[camera]`` becomes a list of one ``[[camera]]``, and so does ``[vehicle.edit]``."""
    return [value] if isinstance(value, dict) else value


MotionTable = Annotated[
    PlanMotion | SimulateMotion | SticksMotion | IntegrateMotion | SinusoidMotion | ClipMotion,
    Field(discriminator="method"),
]


class VehicleTable(Table):
    """``[[vehicle]]``"""

    name: Name
    """a name of letters, digits and underscores, different for every vehicle"""
    asset: Annotated[Text, shipped_or_path("vehicle")]
    """a shipped vehicle's name, or the path of a vehicle's folder relative to the shot file"""
    variants: dict[str, Text] = Field(default={})
    """a table of variant sets of the asset and the variants to show, such as { livery = "red" }"""
    parameters: dict[str, Any] = Field(default={})
    """a table of numbers in place of those of its vehicle.toml, in SI units, such as { mass = 1500 }"""
    motion: MotionTable
    """a table [vehicle.motion] with method = "plan", "simulate", "sticks", "integrate", "sinusoid" or "clip\""""
    edit: Annotated[list[EditTable], BeforeValidator(_one_or_several), Array, Len(0, MAX_EDITS)] = Field(default=[])
    """a table [vehicle.edit], or several [[vehicle.edit]], each an edit of the motion that the earlier ones give:
    curves of the delivered motion that an animator changed"""

    @property
    def edits(self) -> dict[int, EditTable]:
        """The edits of its motion from either table, by their rounds."""
        marks = getattr(self.motion, "marks", None)
        edits = [EditTable(usd=marks.usd, prim=marks.prim)] if marks and marks.edit else []
        return {edit.round or place: edit for place, edit in enumerate([*edits, *self.edit], 1)}

    @property
    def without_last_edit(self) -> VehicleTable:
        """The same vehicle with the motion that was edited last."""
        motion = self.motion
        if self.edit:
            return self.model_copy(update={"edit": self.edit[:-1]})
        if (marks := getattr(motion, "marks", None)) and marks.edit:
            kept = None if getattr(motion, "mark", None) else marks.model_copy(update={"edit": False})
            motion = motion.model_copy(update={"marks": kept})
        return self.model_copy(update={"motion": motion})


class ShotFile(Table):
    """A shot file."""

    shot: Header
    """a table [shot] with schema and name"""
    world: WorldTable = WorldTable()
    """a table [world]"""
    vehicle: Annotated[list[VehicleTable], Array, Len(1, MAX_VEHICLES)]
    """one or more [[vehicle]] tables"""
    camera: Annotated[list[CameraTable], BeforeValidator(_one_or_several), Array, Len(0, MAX_CAMERAS)] = Field(
        default=[CameraTable()]
    )
    """a table [camera], or several [[camera]]"""
    cut: Annotated[list[CutTable], Array, Len(0, MAX_CUTS)] = Field(default=[])
    """[[cut]] tables with frame and camera: from which frame on which camera is used"""
    note: Annotated[list[NoteTable], Array, Len(0, MAX_NOTES)] = Field(default=[])
    """[[note]] tables with frame and text: notes that pages show"""
    render: RenderTable = RenderTable()
    """a table [render]"""
    export: ExportTable = ExportTable()
    """a table [export]"""
    sweep: dict[str, Any] | None = None
    """a table [sweep]: keys of this file and their values, one clip for each combination"""


def schema() -> dict[str, Any]:
    """The JSON schema of a shot file, for editors."""
    shape = _shape()
    vehicle = shape["$defs"]["VehicleTable"]
    vehicles = {**vehicle, "properties": _also_single(vehicle["properties"], "edit")}
    head = {"$schema": DIALECT, "$id": "urn:vehsim:shot:1", "title": "vehsim shot file"}
    shape = {**shape, "$defs": {**shape["$defs"], "VehicleTable": vehicles}}
    return {**head, **shape, "title": head["title"], "properties": _also_single(shape["properties"], "camera")}


def _also_single(properties: dict[str, Any], key: str) -> dict[str, Any]:
    """The properties of a table in which a list of tables may also be one table."""
    several = properties[key]
    return {**properties, key: {"anyOf": [several["items"], several], "description": several["description"]}}


@cache
def _shape() -> dict[str, Any]:
    """The schema for validation, in which ``[camera]`` and ``[vehicle.edit]`` are already lists."""
    return ShotFile.model_json_schema(by_alias=True)


def parse(data: Any) -> tuple[ShotFile | None, list[Problem]]:
    """The file as a model, and the errors of its shape.

    If there are errors, the model is that of the remaining data, so that it can be checked too, or None.
    """
    try:
        return ShotFile.model_validate(data), []
    except ValidationError as error:
        wrong = error.errors(include_url=False)
        problems = list(problems_of(wrong, _shape()))
    try:
        return ShotFile.model_validate(_without(data, wrong)), problems
    except ValidationError:
        return None, problems


def _without(data: Any, errors: Any) -> Any:
    """The data without its unknown keys, and without the top-level tables that have other errors."""
    bad = set()
    for error in errors:
        place, _, _ = locate(_shape(), error["loc"])
        bad.add(place if error["type"] == "extra_forbidden" else place[:1])

    def keep(value: Any, place: tuple[int | str, ...]) -> Any:
        if isinstance(value, dict):
            return {k: keep(v, (*place, k)) for k, v in value.items() if (*place, k) not in bad}
        if isinstance(value, list):
            return [keep(v, (*place, i)) for i, v in enumerate(value)]
        return value

    return keep(data, ())
