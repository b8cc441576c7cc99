"""Hydrodynamic coefficients of a hull: where it is read from, and the table that is printed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.constants import GRAVITY, SEA_WATER
from vehsim.errors import InputError

if TYPE_CHECKING:
    from vehsim.runtime.progress import Progress
    from vehsim.vehicles.definition.coefficients import Coefficients

MODES = ("roll", "pitch", "yaw", "surge", "sway", "heave")
SEAS = {"head": 180.0, "bow": 135.0, "beam": 90.0}
"""Where waves travel, degrees from the bow."""
ROWS = 12
FAR = 10.0
"""Largest distance of a centre of mass from the middle of a mesh, in its diagonals."""


def of_hull(hull: str, mass: float | None, origin: tuple[float, float, float], progress: Progress) -> Coefficients:
    """Those of a vehicle, or of a closed mesh in a file that floats with its ``mass`` kg, about ``origin`` (3,) m in
    its own axes. Raises ``InputError``."""
    from vehsim.world.water.boundary_elements import coefficients
    from vehsim.world.water.buoyancy import Afloat
    from vehsim.world.world import World

    vehicle = _mesh(Path(hull), mass, origin) if Path(hull).is_file() else _vehicle(hull, mass)
    afloat = Afloat(vehicle, World(water=0.0))
    return coefficients(afloat.hull, afloat.floating()[0], progress)


def _vehicle(name: str, mass: float | None) -> Any:
    from vehsim.vehicles import load_vehicle

    vehicle: Any = load_vehicle(name, None if mass is None else {"mass": mass})
    if getattr(vehicle, "hull", None) is None:
        raise InputError("it has no hull", "name a boat, or a closed mesh", key="HULL", value=name)
    return vehicle


def _mesh(path: Path, mass: float | None, origin: tuple[float, float, float]) -> Any:
    from vehsim.intake.meshes import read_triangles
    from vehsim.lie import SE3
    from vehsim.vehicles.definition.holonomic import Holonomic
    from vehsim.vehicles.definition.hydrodynamics import Hull

    if mass is None:
        raise InputError("missing", "say what the hull weighs, in kg", key="--mass", subject=str(path))
    points, faces = read_triangles(path, "HULL")
    lower, upper = points.min(axis=0), points.max(axis=0)
    if not np.linalg.norm(origin - (lower + upper) / 2) <= FAR * np.linalg.norm(upper - lower):
        box = f"{lower.round(3).tolist()} to {upper.round(3).tolist()}"
        raise InputError(f"far from the hull, {box}", "give the centre of mass in m", key="--origin", value=origin)
    hull = Hull(points=points - np.array(origin), faces=faces)
    return Holonomic(name=path.stem, group=SE3, inertia=(mass,) * 6, mass=mass, hull=hull)


def table(found: Coefficients) -> Iterator[str]:
    """Lines for a person: added mass and damping by wave, and the excitation in three seas."""
    chosen = np.unique(np.linspace(0, len(found.omega) - 1, ROWS).astype(int))
    waves = [f"{2 * np.pi * GRAVITY / found.omega[k] ** 2:11.4g}{2 * np.pi / found.omega[k]:9.3g}" for k in chosen]
    head = f"{'wave [m]':>11}{'T [s]':>9}"
    for what, values in (("added mass [kg m^2, kg]", found.added), ("damping [N m s, N s/m]", found.damping)):
        yield f"{what}, about the centre of mass"
        yield head + "".join(f"{mode:>11}" for mode in MODES)
        for k, wave in zip(chosen, waves, strict=True):
            yield wave + "".join(f"{x:11.4g}" for x in np.diag(values[k]))
        if values is found.added:
            yield f"{0:11}{0:9}" + "".join(f"{x:11.4g}" for x in np.diag(found.infinite))
    whole = np.abs(found.pressure + found.diffraction)
    for name, angle in SEAS.items():
        at = int(np.argmin(np.abs(found.headings - np.radians(angle))))
        yield f"wave forces in {name} seas [N m and N per m of amplitude]"
        yield head + "".join(f"{mode:>11}" for mode in MODES)
        for k, wave in zip(chosen, waves, strict=True):
            yield wave + "".join(f"{x:11.4g}" for x in whole[k, at])
    if found.memory is not None:
        error = np.linalg.norm(found.memory.transfer(found.omega).real - found.damping, axis=0)
        share = np.diag(error) / np.maximum(np.linalg.norm(np.einsum("nii->ni", found.damping), axis=0), 1e-300)
        parts = ", ".join(f"{mode} {x:.1%}" for mode, x in zip(MODES, share, strict=True) if x < 1)
        yield f"memory: {len(found.memory.poles)} poles; error of the damping: {parts}"
    yield f"water of {SEA_WATER:g} kg/m^3; the centre of mass is {found.height:.4g} m above its surface"
