"""Mass, centre and inertia of a vehicle from the volume of its parts and a density."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError

Array = NDArray[np.float64]


def weigh(toml: Path, asset: Path, root: str | None, density: Any) -> tuple[float, Array, Array]:
    """``(mass kg, centre (3,) m, inertia (3, 3) kg m^2 about the centre)`` in the rig root's frame.

    Volumes are those of the collision hulls, or of the parts' convex hulls if the asset marks no collision meshes;
    overlaps count twice. ``density`` kg/m^3: one number, or part path -> number with ``""`` for all others.
    """
    from vehsim.rig.parts import moments, read_parts

    by_part = density if isinstance(density, Mapping) else {"": density}
    for name, value in by_part.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value < 1e5:
            raise InputError(
                "not a density",
                "give kg/m^3, above 0",
                key=f"physics.density{f'.{name}' if name else ''}",
                value=value,
                file=toml,
            )
    parts = read_parts(asset, root)
    if unknown := sorted(set(by_part) - {""} - {part.path for part in parts}):
        known = ", ".join(part.path for part in parts if part.path)
        raise InputError("no such part", f"choose one of {known}", key=f"physics.density.{unknown[0]!r}", file=toml)
    mass, moment, second = 0.0, np.zeros(3), np.zeros((3, 3))
    for part, volume, c, about_c in moments(parts):
        rho = float(by_part[part.path] if part.path in by_part else by_part.get("", 0.0))
        m = rho * volume
        if rho and not volume:
            message = f"{toml}: physics.density: {part.path or 'the root'} is flat: no mass; set mass to override"
            warnings.warn(message, stacklevel=6)
        mass, moment = mass + m, moment + m * c
        second = second + rho * about_c + m * (c @ c * np.eye(3) - np.outer(c, c))
    if not mass > 0:
        raise InputError(
            "the parts that have one enclose no volume", "give mass and inertia", key="physics.density", file=toml
        )
    centre = moment / mass
    inertia = second - mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return mass, centre, inertia


def fill_in(
    physics: Mapping[str, Any], wanted: set[str], weighed: tuple[float, Array, Array], origin: Array
) -> dict[str, Any]:
    """``physics`` without density, with ``mass``, ``inertia`` (principal) and ``yaw_inertia`` (about ``origin``)."""
    mass, centre, inertia = weighed
    given = {key: value for key, value in physics.items() if key != "density"}
    mass_given = float(given.get("mass", mass))
    ratio = mass_given / mass  # a given mass scales the inertia of the shape
    off = centre - origin
    computed = {
        "mass": mass,
        "inertia": [float(x) * ratio for x in np.diag(inertia)],
        "yaw_inertia": float(inertia[2, 2] + mass * (off[0] ** 2 + off[1] ** 2)) * ratio,
    }
    return {**{key: value for key, value in computed.items() if key in wanted}, **given}
