"""What a simulation carries from step to step, as plain data, so that it can be continued.

An object names its carried attributes in ``CARRIED``; everything else follows from what it was made of.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any


def carried(thing: Any) -> dict[str, Any]:
    """A copy of what ``thing`` carries: attribute -> value."""
    return {name: deepcopy(getattr(thing, name)) for name in thing.CARRIED}


def carry_on(thing: Any, values: Mapping[str, Any]) -> None:
    """Let ``thing`` carry ``values``, which `carried` gave."""
    for name, value in values.items():
        setattr(thing, name, deepcopy(value))
