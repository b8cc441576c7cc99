"""What a browser may send: each message is checked before anything is done with it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from vehsim.errors import InputError

Coordinate = Annotated[float, Field(ge=-1e7, le=1e7, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-36_000, le=36_000, allow_inf_nan=False)]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Moved(_Message):
    """A mark at another place: ``drag`` while the button is down, ``place`` on release.

    ``mark``: its index among the marks of the vehicle; ``heading`` in degrees, None if it was not turned; ``frame``:
    None if it was not retimed.
    """

    kind: Literal["drag", "place"]
    vehicle: str
    mark: Annotated[int, Field(ge=0)]
    position: Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
    heading: Angle | None = None
    frame: Annotated[int, Field(ge=-1_000_000, le=1_000_000)] | None = None


class Pressed(_Message):
    """A button without parameters."""

    kind: Literal["undo", "redo", "save", "export"]


Message = Moved | Pressed
_ADAPTER: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="kind")])


def parse(text: str | bytes) -> Message:
    """The message in a frame from the browser. Raises ``InputError``."""
    try:
        return _ADAPTER.validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "message"
        raise InputError(first["msg"], "reload the page", key=where) from None
