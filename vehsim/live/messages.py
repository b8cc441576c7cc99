"""What a browser may send: each message is checked before anything is done with it."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from vehsim.errors import InputError
from vehsim.shot.schema.tables import NOTE

Coordinate = Annotated[float, Field(ge=-1e7, le=1e7, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False)]
Point = Annotated[list[Coordinate], Field(min_length=2, max_length=4)]
Key = Annotated[str, Field(max_length=200)]
"""A dotted key of the shot file."""
Frame = Annotated[int, Field(ge=-1_000_000, le=1_000_000)]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Indexed(_Message):
    """About tables of the file by their index. ``tables``: those of the state that it refers to; None: the present."""

    tables: int | None = None


class Moved(Indexed):
    """A handle at another place.

    ``key``: that of the handle; ``heading`` and ``tilt`` in degrees, None if it was not turned; ``frame``: None if it
    was not retimed.
    """

    key: Key
    position: Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
    heading: Angle | None = None
    tilt: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] | None = None
    frame: Frame | None = None


class Drag(Moved):
    """While the button is down."""

    kind: Literal["drag"] = "drag"


class Place(Moved):
    """On release."""

    kind: Literal["place"] = "place"


class Step(_Message):
    """To another state of the file's history."""

    kind: Literal["undo", "redo"]


class Pressed(_Message):
    """A button without parameters that does not change the file."""

    kind: Literal["save", "export", "stop"]


class Change(Indexed):
    """A value of the shot file; None removes it."""

    kind: Literal["change"]
    key: Key
    value: bool | int | Coordinate | Annotated[str, Field(max_length=200)] | None


class Fix(_Message):
    """What a problem offers to set: keys and values, all in one step."""

    kind: Literal["fix"]
    fixes: Annotated[list[list[bool | int | Coordinate | Key | Point]], Field(min_length=1, max_length=1000)]


class AddMark(_Message):
    """A mark where a planned vehicle is at ``frame``."""

    kind: Literal["add_mark"]
    vehicle: str
    frame: Frame


class DeleteMark(Indexed):
    kind: Literal["delete_mark"]
    vehicle: str
    mark: Annotated[int, Field(ge=0)]


Note = Annotated[str, Field(min_length=1, max_length=NOTE)]


class AddNote(_Message):
    """A note that is shown from ``frame``."""

    kind: Literal["add_note"]
    frame: Frame
    text: Note


class EditNote(Indexed):
    """Another text of the note at an index, or another place that it points at, m; None leaves it."""

    kind: Literal["edit_note"]
    note: Annotated[int, Field(ge=0)]
    text: Note | None = None
    position: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] | None = None


class DeleteNote(Indexed):
    kind: Literal["delete_note"]
    note: Annotated[int, Field(ge=0)]


class KeepDragged(_Message):
    """Save the dragged motion of a vehicle, and start its plan from there."""

    kind: Literal["keep_dragged"]
    vehicle: str


class Restore(_Message):
    """Give a driven vehicle the motion back that it had before."""

    kind: Literal["restore"]
    vehicle: str


class UseRecording(_Message):
    """Make another recording of a driven vehicle its motion."""

    kind: Literal["use_recording"]
    file: Key


class TakeControls(_Message):
    """Take the controls of a vehicle: from its first frame, or after ``frame`` of its recording."""

    kind: Literal["drive"]
    vehicle: str
    frame: Frame | None = None


class Compare(_Message):
    """The recordings to draw beside the present motion, by name of their tables; an empty list draws none."""

    kind: Literal["compare"]
    files: Annotated[list[Key], Field(max_length=8)]


class MoveSticks(_Message):
    """Where the sticks are while a vehicle is driven, one for each control: -1 to 1, forward and left are positive."""

    kind: Literal["sticks"]
    values: Annotated[list[Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]], Field(max_length=64)]


Noted = AddNote | EditNote | DeleteNote
Edit = Place | Change | Fix | AddMark | DeleteMark | Noted | KeepDragged | Restore | UseRecording | Step
"""What changes the file; the session has a method of each kind's name."""
Message = Drag | Pressed | Edit | TakeControls | Compare | MoveSticks
_ADAPTER: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="kind")])


def kinds_of(messages: Any) -> list[str]:
    """The kinds of a union of messages."""
    return [kind for message in get_args(messages) for kind in get_args(message.model_fields["kind"].annotation)]


def parse(text: str | bytes) -> Message:
    """The message in a frame from the browser. Raises ``InputError``."""
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "message"
        raise InputError(first["msg"], "reload the page", key=where) from None
