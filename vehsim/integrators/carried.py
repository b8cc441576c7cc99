"""What a simulation carries from step to step, as plain data, so that it can be continued.

An object names its carried attributes in ``CARRIED``; everything else follows from what it was made of.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

from vehsim.errors import InputError


def carried(thing: Any) -> dict[str, Any]:
    """A copy of what ``thing`` carries: attribute -> value."""
    return {name: deepcopy(getattr(thing, name)) for name in getattr(thing, "CARRIED", ())}


def carry_on(thing: Any, values: Mapping[str, Any]) -> None:
    """Let ``thing`` carry ``values``, which `carried` gave. Raises ``InputError`` if other code did."""
    for name in getattr(thing, "CARRIED", ()):
        if name not in values:
            message = f"{name} is missing: another version of vehsim simulated it"
            raise InputError(message, "simulate the first part again", key="after")
        setattr(thing, name, deepcopy(values[name]))
