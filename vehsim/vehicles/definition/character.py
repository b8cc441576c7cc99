"""The characters in which a vehicle is driven: calm, normal, brisk, or as hard as its model allows.

They are data, each number with a source. A character is part of a vehicle's definition, and plans read it: see
`vehsim.planning.request.character`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

STUNT = "stunt"
"""The character without numbers: as hard as the model allows."""
CHARACTERS = ("calm", "normal", "brisk", STUNT)
"""The characters of every vehicle."""


@dataclass(frozen=True)
class Trait:
    """One quantity for each character, SI, and the source of the numbers."""

    calm: float
    normal: float
    brisk: float
    source: str

    def of(self, character: str) -> float:
        """The quantity of one character."""
        return {"calm": self.calm, "normal": self.normal, "brisk": self.brisk}[character]


RESPONSE = Trait(1.0, 0.5, 0.25, "our choice: a driver who takes his time, who drives, who hurries")
"""The default response, s."""


@dataclass(frozen=True)
class Character:
    """The characters of a vehicle.

    ``response``: response time of the controls, s. ``limits``: soft limits by name of a plan's limits, SI, such as
    ``bank`` in rad. ``control_rates``: the largest rate by name of a control, in its unit per second.
    """

    response: Trait = RESPONSE
    limits: Mapping[str, Trait] = field(default_factory=dict)
    control_rates: Mapping[str, Trait] = field(default_factory=dict)
