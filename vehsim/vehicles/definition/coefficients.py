"""Hydrodynamic coefficients of a hull as data: added mass, radiation with its memory, and excitation by waves.

`vehsim hydro` computes them with Capytaine (`vehsim.world.water.boundary_elements`); `vehsim.world.water.seakeeping`
applies them in simulation. The hull is at rest at its floating position on deep water.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.intake.arrays import read_arrays
from vehsim.vehicles.definition.base import Array

Complex = NDArray[np.complex128]

LEVEL = [2, 3, 4]
"""Yaw, surge and sway in a twist: the motions in the waterplane."""


@dataclass(frozen=True, eq=False)
class Memory:
    """The waves that a hull has radiated act on it later, with the force ``-integral K(t - s) v(s) ds`` of its twist
    ``v`` (Cummins 1962); here with ``K(t) = Re(outputs @ diag(exp(poles t)) @ inputs)``.

    ``poles`` (n,) 1/s, complex, with negative real parts; ``inputs`` (n, 6), ``outputs`` (6, n). It is the state-space
    model ``x' = poles x + inputs v`` with the force ``-Re(outputs x)``. `vehsim.world.water.memory` fits it.
    """

    poles: Complex
    inputs: Complex
    outputs: Complex

    def kernel(self, times: Array) -> Array:
        """``K`` (m, 6, 6) at ``times`` (m,) s, not negative."""
        return np.einsum("in,mn,nj->mij", self.outputs, np.exp(np.multiply.outer(times, self.poles)), self.inputs).real

    def transfer(self, omega: Array) -> Complex:
        """Fourier transform (m, 6, 6) of ``K`` at ``omega`` (m,) rad/s: damping ``B``, plus ``i omega`` times the added
        mass beyond that at infinite frequency, for motions that vary with ``exp(i omega t)``."""
        residues = self.outputs.T[:, :, None] * self.inputs[:, None, :]
        s = 1j * np.asarray(omega, float)[:, None]
        found = np.einsum("mn,nij->mij", 1 / (s - self.poles), residues)
        found += np.einsum("mn,nij->mij", 1 / (s - self.poles.conj()), residues.conj())
        return np.asarray(found / 2)


@dataclass(frozen=True, eq=False, kw_only=True)
class Coefficients:
    """Of a hull at ``omega`` (n,) rad/s, increasing, and ``headings`` (m,) rad, evenly spaced over a full turn: where
    waves travel, from the bow to port. Twists and wrenches are about the body frame's origin, in body axes.

    ``added`` (n, 6, 6) and ``damping`` (n, 6, 6) of its motions; ``infinite`` (6, 6), the added mass at infinite
    frequency. ``pressure`` and ``diffraction`` (n, m, 6), complex: in waves of amplitude 1 m with crests at the origin
    at time 0, the wrench is the real part of their sum times ``exp(-i omega t)``; ``pressure`` is that of the
    undisturbed wave (Froude and Krylov). For water of ``density`` kg/m^3. ``height`` m of the origin above the water.
    ``memory``: None if damping is given by hand.
    """

    omega: Array
    headings: Array
    added: Array
    damping: Array
    infinite: Array
    pressure: Complex
    diffraction: Complex
    density: float
    height: float
    memory: Memory | None = None

    @property
    def slow(self) -> Array:
        """Added mass (6, 6) at the lowest frequency: that of slow manoeuvres."""
        return np.asarray(self.added[0])

    def overridden(self, added: Any = None, damping: Any = None) -> Coefficients:
        """With an ``added`` mass (6,) given by hand on the diagonal, and without memory where ``damping`` (3,) is."""
        made = self
        if added is not None and np.any(added):
            size = np.sqrt(np.asarray(added, float) / np.maximum(np.diag(self.infinite), 1e-12))
            scale = size[:, None] * size
            made = replace(made, infinite=scale * self.infinite, added=scale * self.added)
        return replace(made, memory=None) if damping is not None and np.any(damping) else made

    def save(self, path: str | Path) -> None:
        """Write an ``.npz`` that `load` reads: the same content gives the same bytes."""
        from vehsim.runtime.files import write_file

        write_file(Path(path), self.content)

    @property
    def content(self) -> bytes:
        """The bytes of that file."""
        own = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self) if f.name != "memory"}
        kept = {f"memory_{f.name}": getattr(self.memory, f.name) for f in fields(Memory)} if self.memory else {}
        buffer = BytesIO()
        np.savez(buffer, **own, **kept)  # type: ignore[arg-type]  # arrays, not options
        return buffer.getvalue()

    @classmethod
    def load(cls, path: str | Path, key: str = "hydrodynamics") -> Coefficients:
        """Read a file of `save`. Raises ``InputError``, also if its numbers cannot be those of a hull."""
        names = [f.name for f in fields(cls) if f.name != "memory"]
        memory = [f"memory_{f.name}" for f in fields(Memory)]
        given: dict[str, Any] = read_arrays(Path(path), key, [*names, *memory], "iufc")
        return cls.of(given, str(path), key)

    @classmethod
    def of(cls, given: dict[str, Any], path: str, key: str = "hydrodynamics") -> Coefficients:
        """From the arrays of a file."""
        shapes = {
            "omega": "n", "headings": "m", "added": "n66", "damping": "n66", "infinite": "66", "pressure": "nm6",
            "diffraction": "nm6", "density": "", "height": "",
            "memory_poles": "p", "memory_inputs": "p6", "memory_outputs": "6p",
        }  # fmt: skip
        sizes: dict[str, int] = {"6": 6}

        def wrong(message: str) -> InputError:
            return InputError(message, "write it with vehsim hydro", key=key, value=path)

        if not any(name.startswith("memory_") for name in given):
            shapes = {name: shape for name, shape in shapes.items() if not name.startswith("memory_")}
        missing = [name for name in shapes if name not in given]
        if missing:
            raise wrong(f"without {', '.join(missing)}")
        for name, shape in shapes.items():
            array = np.asarray(given[name])
            fits = array.ndim == len(shape) and all(
                sizes.setdefault(axis, n) == n for axis, n in zip(shape, array.shape, strict=True)
            )
            if not (fits and array.size and np.isfinite(array).all()):
                raise wrong(f"{name} is not an array of {' by '.join(shape) or 'one'} finite numbers")
            if np.iscomplexobj(array) and name not in COMPLEX:
                raise wrong(f"{name} is complex")
        number = {name: np.asarray(given[name], complex if name in COMPLEX else float) for name in shapes}
        omega, headings = number["omega"], number["headings"]
        even = len(headings) * (np.diff(headings, append=headings[0] + 2 * np.pi)) / (2 * np.pi)
        if not (len(omega) > 3 and omega[0] > 0 and (np.diff(omega) > 0).all()):
            raise wrong("omega does not rise from above zero")
        if not np.allclose(even, 1.0, atol=1e-6):
            raise wrong("headings are not evenly spaced over a full turn")
        parts = [number.pop(name) for name in shapes if name.startswith("memory_")]
        memory = Memory(*parts) if parts else None
        if memory is not None and (memory.poles.real >= 0).any():
            raise wrong("memory_poles are not stable")
        infinite = number["infinite"]
        if np.linalg.eigvalsh(infinite + infinite.T)[0] < -1e-6 * np.abs(infinite).max():
            raise wrong("infinite is not an added mass: not positive")
        density, height = float(number.pop("density")), float(number.pop("height"))
        if not 1 <= density <= 20_000:
            raise wrong("density is not that of a liquid")
        return cls(**number, density=density, height=height, memory=memory)


COMPLEX = {"pressure", "diffraction", "memory_poles", "memory_inputs", "memory_outputs"}
