"""Many vehicles of one kind in motion, as arrays: for crowds, samples and sweeps of starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vehsim.errors import InputError
from vehsim.integrators.composition import FAST_TOLERANCE
from vehsim.integrators.fast.kernel import each_part
from vehsim.integrators.guards import check_mass
from vehsim.integrators.phase import joints_of, packed, unpacked
from vehsim.integrators.phase_integrator import PhaseIntegrator
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.definition.base import Array


class Fleet:
    """Vehicles (m,) that ``advance`` together. Made by `Integrator.fleet`.

    ``g`` (m, size), ``r`` (m, s), ``pi`` (m, n_z): group elements, joints and knot momenta at the current knot;
    ``controls`` (m, c) there; ``anchors`` (m, 3): the part of positions beyond the group's own coordinates. If the
    integrator is compiled, ``threads`` threads share the vehicles; the interpreter cannot, because it holds Python's
    lock.
    """

    def __init__(self, integrator: PhaseIntegrator, states: Sequence[State], controls: Any, threads: int = 1):
        m = integrator.mechanics
        self.integrator, self.threads = integrator, threads
        self.controls = control_table(integrator.vehicle, controls, (len(states),)).copy()
        phases = [integrator.start(state, c) for state, c in zip(states, self.controls, strict=True)]
        if integrator.mechanics is not m:
            raise InputError(
                "starts so far apart need different columns of the constraints eliminated",
                "roll them out one by one",
                subject=integrator.vehicle.name,
            )
        self.anchors = np.array([integrator.anchor(s, phase) for s, phase in zip(states, phases, strict=True)])
        self.x = np.array([packed(phase) for phase in phases])

    @property
    def g(self) -> Array:
        return self._part(0)

    @property
    def r(self) -> Array:
        return self._part(1)

    @property
    def pi(self) -> Array:
        return self._part(2)

    def states(self) -> list[State]:
        """The public states now."""
        m = self.integrator.mechanics
        rows = zip(self.x, self.controls, self.anchors, strict=True)
        return [self.integrator.state(unpacked(m, x), c, anchor) for x, c, anchor in rows]

    def advance(self, controls: Any) -> Array:
        """Advance by n steps; ``controls`` (m, n, c), or (n, c) for all, are those at the steps' ends, linear between.

        Returns the phases at all knots (m, n + 1, .): group elements, joints, momenta, and data for warm starts.
        """
        run, given = self.integrator, np.asarray(controls, float)
        shape = (len(self.x), given.shape[-2] if given.ndim > 1 else 0)
        knots = np.concatenate([self.controls[:, None], control_table(run.vehicle, given, shape)], axis=1)
        x, residual = np.empty((*knots.shape[:2], self.x.shape[1])), np.full((*shape, 1), np.inf)
        x[:, 0] = self.x

        def share(part: slice) -> None:
            if not run.guarded:
                run.steps()(x[part], knots[part], residual[part])
            for j in part.start + np.flatnonzero(~np.all(residual[part] <= FAST_TOLERANCE, axis=(1, 2))):
                x[j] = run.history(x[j, 0], knots[j])
            check_mass(run.mechanics, joints_of(run.mechanics, x[part]), run.compiled)

        each_part(shape[0], self.threads if run.compiled else 1, share)
        self.x, self.controls = x[:, -1].copy(), knots[:, -1].copy()
        return x

    def _part(self, i: int) -> Array:
        return np.split(self.x, np.cumsum(self.integrator.mechanics.sizes[:3]), axis=1)[i]


def control_table(vehicle: Vehicle, controls: Any, lead: tuple[int, ...]) -> Array:
    """Controls as (*lead, c); those common to all vehicles are repeated. Raises ``InputError``."""
    array, shape = np.asarray(controls, float), (*lead, len(vehicle.controls))
    if array.shape not in (shape, shape[1:]) or not np.all(np.isfinite(array)) or 0 in lead:
        names = ", ".join(vehicle.control_names) or "none"
        raise InputError(f"shape {array.shape}", f"give {shape} or {shape[1:]} finite: {names}", key="controls")
    return np.broadcast_to(array, shape)
