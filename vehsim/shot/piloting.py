"""``pilot = { ... }`` in ``[vehicle.motion]``: which feedback controller flies or drives, and its parameters.

What belongs here names a pilot and judges what it is given; pilots themselves are in `vehsim.pilots`.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from vehsim.errors import InputError, Problem
from vehsim.shot.checks import check_names, choose
from vehsim.shot.model import Table, Text, one_of

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle


class PilotTable(Table):
    """``pilot = { name = "hover", ... }``: a feedback controller and its parameters."""

    model_config = Table.model_config | {"extra": "allow"}
    name: Annotated[Text, one_of("vehsim.pilots:PILOTS")]
    """a pilot's name: "hover", "fly_to" or "follow_path\""""

    def parameters(self) -> dict[str, Any]:
        """As Python takes them: arrays, and ``heading`` in radians."""
        given = {key: _array(value) for key, value in (self.model_extra or {}).items()}
        return {key: np.deg2rad(value) if key == "heading" else value for key, value in given.items()}

    def check(self, vehicle: Vehicle) -> Iterator[Problem]:
        from vehsim.pilots import PILOTS

        if self.name not in PILOTS:
            mend = choose(self.name, PILOTS)
            yield Problem("pilot.name", "no such pilot", mend, self.name)
            return
        signature = inspect.signature(PILOTS[self.name])
        known = [name for name in signature.parameters if name != "vehicle"]
        given = self.model_extra or {}
        yield from check_names("pilot", given, known, "parameter")
        for key, value in given.items():
            if not is_numeric(value):
                yield Problem(f"pilot.{key}", "not finite numbers", "give a number, or arrays of numbers", value)
        for name in known:
            if signature.parameters[name].default is inspect.Parameter.empty and name not in given:
                yield Problem(f"pilot.{name}", "missing", f"the pilot {self.name!r} needs it")

    def refusal(self, vehicle: Vehicle) -> Problem | None:
        """What the pilot itself refuses of parameters that are otherwise right."""
        from vehsim.pilots import PILOTS

        try:
            PILOTS[self.name](vehicle, **self.parameters())
        except (InputError, ValueError) as error:
            given = self.model_extra or {}
            text = str(error) if isinstance(error, InputError) else "not a table of numbers; give rows of one length"
            key = next((key for key in given if text.startswith((f"{key}:", f"{key} ="))), None)
            if key is None:
                return Problem("pilot", text, "see the pilots in docs/shot-file.md", self.name)
            message, _, mend = text.partition(": ")[2].rpartition("; ")
            return Problem(f"pilot.{key}", message or f"not what {self.name} takes", mend, given[key])
        return None


def is_numeric(value: Any, depth: int = 3) -> bool:
    """A finite number, or arrays of them."""
    if isinstance(value, list | tuple):
        return depth > 0 and 0 < len(value) <= 100_000 and all(is_numeric(item, depth - 1) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e9


def _array(value: Any) -> Any:
    return np.array(value, float) if isinstance(value, list | tuple) else value
