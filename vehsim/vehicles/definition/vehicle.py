"""A vehicle: its definition, with energy, momentum and linearisation of a state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from vehsim.vehicles.definition.base import Array, Definition, State


@dataclass(frozen=True, eq=False, kw_only=True)
class Vehicle(Definition):
    """What simulation, planning and export need of a vehicle. Make one as `Holonomic` or `Nonholonomic`."""

    planar: Vehicle | None = None
    """The same vehicle on calm water, moving in the plane. Plans use it, and so does motion in a world without water.
    None: the vehicle itself."""
    floating: Vehicle | None = None
    """Of a planar form: the vehicle in the water that it stands for, with its hull."""

    def energy(self, state: State) -> tuple[float, float]:
        """Kinetic and potential energy of a state, J."""
        from vehsim.vehicles.definition.states import state_energy

        return state_energy(self, state)

    def momentum(self, state: State) -> Array:
        """Spatial momentum (d,), angular then linear, world axes; on SO3xR3 angular about the body's own origin."""
        from vehsim.vehicles.definition.states import state_momentum

        return state_momentum(self, state)

    def linearize(self, state: State, controls: Any, wind: Any = (0.0, 0.0, 0.0)) -> tuple[Array, Array]:
        """``A`` (n, n), ``B`` (n, c) of the motion about a state; see `vehsim.vehicles.definition.states.linearize`."""
        from vehsim.vehicles.definition.states import linearize

        return linearize(self, state, controls, wind)
