"""``pilot = { ... }`` in ``[vehicle.motion]``: the name of a feedback controller, and its parameters.

This module checks the parameters; pilots themselves are in `vehsim.pilots`.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from vehsim.errors import InputError, Problem
from vehsim.shot.checks import check_names, did_you_mean
from vehsim.shot.schema.tables import Table, Text, one_of

if TYPE_CHECKING:
    from vehsim.vehicles import Vehicle


class PilotTable(Table):
    """``pilot = { name = "hover", ... }``: a feedback controller and its parameters."""

    model_config = Table.model_config | {"extra": "allow"}
    name: Annotated[Text, one_of("vehsim.pilots:PILOTS")]
    """a pilot's name: "hover", "fly_to", "follow_path" or "gait\""""

    def parameters(self) -> dict[str, Any]:
        """The parameters for Python: arrays, and ``heading`` in radians."""
        given = {key: _array(value) for key, value in (self.model_extra or {}).items()}
        return {key: np.deg2rad(value) if key == "heading" else value for key, value in given.items()}

    def check(self, vehicle: Vehicle) -> Iterator[Problem]:
        from vehsim.pilots.controllers import PILOTS

        if self.name not in PILOTS:
            remedy = did_you_mean(self.name, PILOTS)
            yield Problem("pilot.name", "no such pilot", remedy, self.name)
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
        """The pilot's own objection to valid parameters."""
        from vehsim.pilots.controllers import PILOTS

        try:
            PILOTS[self.name](vehicle, **self.parameters())
        except InputError as error:
            given = self.model_extra or {}
            if error.key in given:
                return error.problem.below("pilot", value=given[error.key])
            return error.problem.seen_from("pilot", self.name, "see the pilots in docs/shot-file.md")
        except ValueError:
            return Problem("pilot", "not a table of numbers", "give rows of one length", self.name)
        return None


def is_numeric(value: Any, depth: int = 3) -> bool:
    """A finite number, or arrays of them."""
    if isinstance(value, list | tuple):
        return depth > 0 and 0 < len(value) <= 100_000 and all(is_numeric(item, depth - 1) for item in value)
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= 1e9


def _array(value: Any) -> Any:
    return np.array(value, float) if isinstance(value, list | tuple) else value
