"""The character of a plan: the prices of exceeding a vehicle's traits, and the marks at which controls ease.

A character never makes a plan fail. Its limits are soft: a motion exceeds them if its marks leave little alternative,
and the audit reports the excess. The user's own limits replace them and are strict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.planning.request.marks import Mark
from vehsim.planning.terms import COSTS, LIMITS, Limits, heaviest
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.character import CHARACTERS, STUNT


@dataclass(frozen=True)
class Traits:
    """The traits of one character, SI: see `vehsim.vehicles.definition.character.Character`; a stunt has none.

    ``costs``: weights of costs by name, unless the user gives them: those of the character, and those that make the
    response time of the controls ``response``, because with effort they act as a low-pass filter of that time.
    ``price``: the largest weight that the user gives; all costs of the character are multiples of it.
    """

    name: str = STUNT
    limits: Mapping[str, float] = field(default_factory=dict)
    control_rates: Mapping[str, float] = field(default_factory=dict)
    costs: Mapping[str, float] = field(default_factory=dict)
    price: float = 1.0
    unused: tuple[str, ...] = ()
    """The controls that only a stunt uses."""
    harder: Traits | None = None
    """Those of the next harder character; a stunt has none."""

    def without(self, limits: Limits) -> Mapping[str, float]:
        """The limits of the character that the user does not set."""
        return {name: value for name, value in self.limits.items() if name not in limits.values}

    def weights(self, weights: Mapping[str, float]) -> dict[str, float]:
        """The weights of costs, raised to those of the character."""
        return {**weights, **{name: max(weight, weights.get(name, 0.0)) for name, weight in self.costs.items()}}

    def eases(self, mark: Mark) -> bool:
        """Whether the controls start and end gently at a mark."""
        return mark.at_rest and (self.name != STUNT if mark.ease is None else mark.ease)


NO_TRAITS = Traits()
"""The traits of a stunt."""


def traits_of(vehicle: Vehicle, name: str, cost: str | Mapping[str, float]) -> Traits:
    """The traits of a character for a vehicle, with the ``cost`` of the user; raises ``InputError`` for an unknown
    name."""
    if name not in CHARACTERS:
        close = get_close_matches(str(name), CHARACTERS, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"choose one of {', '.join(CHARACTERS)}"
        raise InputError("unknown", hint, key="character", value=name)
    price = heaviest(cost)
    if name == STUNT:
        return Traits(price=price)
    harder = traits_of(vehicle, CHARACTERS[CHARACTERS.index(name) + 1], cost)
    character = vehicle.character
    time = character.response.of(name)
    costs = {"smoothness": price * time**2, "easing": price * time**4}
    costs |= {key: price * trait.of(name) for key, trait in character.costs.items()}
    for key, given, known in (("limits", character.limits, LIMITS), ("costs", character.costs, COSTS)):
        for unknown in (key for key in given if key not in known):
            remedy = f"choose one of {', '.join(known)}"
            raise InputError("unknown", remedy, key=f"character.{key}.{unknown}", subject=vehicle.name)
    return Traits(
        name,
        {key: trait.of(name) for key, trait in character.limits.items()},
        {key: trait.of(name) for key, trait in character.control_rates.items()},
        {key: weight for key, weight in costs.items() if isinstance(cost, str) or key not in cost},
        price,
        character.stunt_controls,
        harder,
    )


def control_rates(traits: Traits, vehicle: Vehicle) -> NDArray[np.float64]:
    """The largest rates of the controls (c,), SI; by default, their scale per second."""
    return np.array([traits.control_rates.get(control.name, control.scale) for control in vehicle.controls])


def eased(traits: Traits, marks: Sequence[Mark]) -> list[tuple[int, bool, bool]]:
    """The marks at which controls start or end gently: index, whether the motion arrives there, and whether it
    departs."""
    found = []
    for i, mark in enumerate(marks):
        comes, leaves = i > 0 and not marks[i - 1].hold, i + 1 < len(marks) and not mark.hold
        if traits.eases(mark) and (comes or leaves):
            found.append((i, comes, leaves))
    return found
