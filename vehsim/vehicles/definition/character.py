"""The characters in which a vehicle is driven: calm, normal, brisk, or as hard as its model allows.

They are data, each number with a source. A character is part of a vehicle's definition, and plans read it: see
`vehsim.planning.request.character`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, get_args

CharacterName = Literal["calm", "normal", "brisk", "stunt"]
CHARACTERS: tuple[CharacterName, ...] = get_args(CharacterName)
"""The characters of every vehicle, from the gentlest to the hardest."""
BRISK: Final = "brisk"
STUNT: Final = "stunt"
"""The character without numbers: as hard as the model allows."""
NORMAL: Final = "normal"
"""The character with whose envelope a review compares a motion."""
DEFAULT: Final = NORMAL
"""The default character of plans."""
Reviewed = Literal["jerk", "slip", "saturation", "reversals", "settling", "ease", "power", "slide"]
"""What a review compares in addition to the limits."""


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


RESPONSE = Trait(1.0, 0.5, 0.25, "our choice: a relaxed, an ordinary and a hurried driver")
"""The default response, s."""

REVIEWED: Mapping[str, Trait] = {
    "jerk": Trait(2.5, 5.0, 10.0, "ISO 11270: 5 m/s^3 sideways on average over half a second; the rest is our choice"),
    "saturation": Trait(0.02, 0.05, 0.2, "our choice: share of the time with a control at its bound"),
    "reversals": Trait(15.0, 30.0, 60.0, "our choice: turns of a control by a tenth of its range, per minute"),
    "settling": Trait(0.05, 0.1, 0.2, "our choice: a hand's breadth to and fro, within two seconds of rest"),
    "ease": Trait(0.01, 0.01, 0.01, "our choice: share of its largest rate that a control has where a motion rests"),
}
"""The default envelopes of a review, SI; `slip`, `power` and `slide` have none."""
REVIEW_UNITS: Mapping[str, str] = {
    "jerk": "m/s^3", "slip": "rad", "saturation": "share", "reversals": "1/min", "settling": "m", "ease": "share",
    "power": "W", "slide": "m/s",
}  # fmt: skip
"""The units of what a review compares."""
SHARES_OF_TIME: frozenset[str] = frozenset({"saturation"})
"""What a review compares as one number of the whole motion; every other quantity is worst at an instant."""


@dataclass(frozen=True)
class Character:
    """The characters of a vehicle.

    ``response``: response time of the controls, s. ``costs``: weights of a plan's costs by name, beside `effort`'s of
    one. ``limits``: soft limits by name of a plan's limits, SI, such as
    ``bank`` in rad. ``control_rates``: the largest rate by name of a control, in its unit per second. ``review``:
    quantities that plans do not limit, see `REVIEWED`.
    """

    response: Trait = RESPONSE
    costs: Mapping[str, Trait] = field(default_factory=dict)
    limits: Mapping[str, Trait] = field(default_factory=dict)
    control_rates: Mapping[str, Trait] = field(default_factory=dict)
    review: Mapping[str, Trait] = field(default_factory=lambda: REVIEWED)
    stunt_controls: tuple[str, ...] = ()
    """The controls that only a stunt uses, such as a handbrake at speed."""
