"""Contact between hulls, obstacles, ground and each other."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

if TYPE_CHECKING:
    from vehsim.world.contact.contact import Contact as Contact
    from vehsim.world.contact.contact import ContactScene as ContactScene

_PUBLIC = {
    "Contact": "vehsim.world.contact.contact",
    "ContactScene": "vehsim.world.contact.contact",
}
__all__ = ["Contact", "ContactScene"]

# at their first use: heavy libraries are loaded only when they are needed
__getattr__, __dir__ = attach(__name__, _PUBLIC)
