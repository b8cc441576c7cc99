"""Physical constants that several rooms use."""

from __future__ import annotations

GRAVITY = 9.81
"""The acceleration of gravity, m/s^2 (LIE's value), and the unit of g-loads."""
STANDARD_GRAVITY = 9.80665
"""The unit of the force arrows in the guides, m/s^2 (ISO 80000-3)."""
SEA_WATER = 1025.0
"""The density of sea water, kg/m^3."""
AIR = 1.225
"""The density of air at sea level, kg/m^3."""
