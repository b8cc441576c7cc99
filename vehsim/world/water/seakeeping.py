"""A hull with `Coefficients` in waves: the diffraction of every wave of the sea, and the memory of its own waves.

The pressure of the undisturbed waves is exact over the wetted surface (`buoyancy.py`); diffraction is linear.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import GRAVITY
from vehsim.vehicles.definition.coefficients import Coefficients
from vehsim.world.water.memory import Remembered
from vehsim.world.water.water import Water, Waves

Array = NDArray[np.float64]

SHORTER = 1.02
"""Waves whose frequency is up to this multiple of the highest computed one have its diffraction: hulls are hardly ever
as long as their waterline, over which the waves were chosen."""


@dataclass(eq=False)
class Seakeeping:
    """Of one hull in ``water``, while it moves."""

    coefficients: Coefficients
    water: Water

    @property
    def scale(self) -> float:
        """Forces grow with the density of the water."""
        return self.water.density / self.coefficients.density

    @cached_property
    def added(self) -> Array:
        """Added mass (6, 6) at infinite frequency: that of the equations of motion."""
        return np.asarray(self.scale * self.coefficients.infinite)

    @cached_property
    def slow(self) -> Array:
        """Added mass (6, 6) of slow manoeuvres."""
        return np.asarray(self.scale * self.coefficients.slow)

    @property
    def complete(self) -> bool:
        """Whether the diffraction of all waves is known: those of grids have no components."""
        return self.water.surface is None or isinstance(self.water.surface, Waves)

    @cached_property
    def remembered(self) -> Remembered | None:
        memory = self.coefficients.memory
        return None if memory is None else Remembered(memory)

    def wrench(self, t: float, R_wb: Array, place: Array, twist: Array, through: Array) -> Array:
        """The wrench (6,) at ``t`` s on a hull at ``place`` (3,) m with its ``twist`` (6,): of diffracted waves, and of
        those that its motion radiated. If the diffraction is not known, the motion ``through`` (6,) the water
        radiates."""
        found = np.zeros(6)
        if isinstance(self.water.surface, Waves):
            found += self.diffraction(self.water.surface, t, place[:2], float(np.arctan2(R_wb[1, 0], R_wb[0, 0])))
        if self.remembered is not None:
            if self.complete and self.water.current is not None:
                flow = self.water.current.velocity(np.array([[*place[:2], 0.0]]), t)[0]
                twist = twist - np.concatenate([np.zeros(3), flow @ R_wb])
            found += self.remembered.wrench(t, twist if self.complete else through)
        return self.scale * found

    @cached_property
    def _orders(self) -> Array:
        """Orders (h,) of the Fourier series in the heading."""
        most = len(self.coefficients.headings) // 2
        return np.arange(-most, most + 1).astype(float)

    @cached_property
    def _series(self) -> NDArray[np.complex128]:
        """(k, 6 h): amplitude of each wave times the Fourier coefficients of its diffraction, for a hull that heads
        along X."""
        data, waves = self.coefficients, self.water.surface
        assert isinstance(waves, Waves)
        turned = np.exp(-1j * np.multiply.outer(self._orders, data.headings)) / len(data.headings)
        if len(data.headings) % 2 == 0:
            turned[[0, -1]] /= 2  # the highest order is known only as the sum of both
        angle = np.arctan2(waves.number[:, 1], waves.number[:, 0])
        series = np.einsum("hm,kmi->kih", turned, between(data.omega, data.diffraction, waves.omega))
        series *= np.exp(1j * np.multiply.outer(angle, self._orders))[:, None] * waves.amplitude[:, None, None]
        return np.asarray(series.reshape(len(angle), -1))

    def diffraction(self, waves: Waves, t: float, place: Array, heading: float) -> Array:
        """The wrench (6,) at ``t`` s on a hull at ``place`` (2,) m with its bow at ``heading`` rad from X."""
        phase = waves.rest(place[None], t)[0] @ waves.number.T + waves.phase - waves.omega * t
        found = waves.share(place[None])[0, 0] * (np.exp(1j * phase) @ self._series).reshape(6, -1)
        return np.asarray((found @ np.exp(-1j * heading * self._orders)).real)


def between(omega: Array, forces: NDArray[np.complex128], wanted: Array) -> NDArray[np.complex128]:
    """Diffraction forces (n, ...) at ``omega`` (n,) rad/s, at ``wanted`` (k,) rad/s: cubic in the wave number, zero in
    endless waves, and zero in waves shorter than the shortest computed ones."""
    from scipy.interpolate import CubicSpline

    number = np.concatenate([[0.0], omega**2 / GRAVITY])
    forces = np.concatenate([np.zeros((1, *forces.shape[1:]), complex), forces])
    found = np.asarray(CubicSpline(number, forces)(np.minimum(wanted, omega[-1]) ** 2 / GRAVITY))
    found[wanted > SHORTER * omega[-1]] = 0.0
    return found
