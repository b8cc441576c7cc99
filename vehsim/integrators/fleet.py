"""Many vehicles of one kind in motion side by side, as arrays: crowds, samples, sweeps of starts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim.errors import InputError
from vehsim.integrators.guards import check_mass
from vehsim.integrators.loops import each_part
from vehsim.integrators.motion import FAST_TOLERANCE
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles._base import Array

if TYPE_CHECKING:
    from vehsim.integrators.integrator import Integrator


class Fleet:
    """Vehicles (m,) that move on together by ``advance``. Made by `Integrator.fleet`.

    ``g`` (m, size), ``r`` (m, s), ``pi`` (m, n_z): group elements, joints and knot momenta at the present knot;
    ``controls`` (m, c) there; ``anchors`` (m, 3): what positions have beyond the group's own coordinates. ``threads``
    share the vehicles out where the integrator is compiled: the interpreter keeps Python's lock.
    """

    def __init__(self, integrator: Integrator, states: Sequence[State], controls: Any, threads: int = 1):
        from vehsim.integrators.integrator import packed

        m = integrator.mechanics
        self.integrator, self.threads = integrator, threads
        self.controls = control_table(integrator.vehicle, controls, (len(states),)).copy()
        phases = [integrator.start(state, c) for state, c in zip(states, self.controls, strict=True)]
        if integrator.mechanics is not m:
            raise InputError(
                f"{integrator.vehicle.name}: starts so far apart need different columns of the constraints eliminated; "
                "roll them out one by one"
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
        from vehsim.integrators.integrator import unpacked

        m = self.integrator.mechanics
        rows = zip(self.x, self.controls, self.anchors, strict=True)
        return [self.integrator.state(unpacked(m, x), c, anchor) for x, c, anchor in rows]

    def advance(self, controls: Any) -> Array:
        """Through n steps; ``controls`` (m, n, c), or (n, c) for all, are those at the steps' ends, linear between.

        Returns the phases at all knots (m, n + 1, .): group elements, joints, momenta, and a last part to warm solves.
        """
        run, given = self.integrator, np.asarray(controls, float)
        shape = (len(self.x), given.shape[-2] if given.ndim > 1 else 0)
        knots = np.concatenate([self.controls[:, None], control_table(run.vehicle, given, shape)], axis=1)
        x, residual = np.empty((*knots.shape[:2], self.x.shape[1])), np.full((*shape, 1), np.inf)
        x[:, 0] = self.x
        size, s = run.mechanics.sizes[:2]

        def share(part: slice) -> None:
            if not run.guarded:
                run.steps()(x[part], knots[part], residual[part])
            for j in part.start + np.flatnonzero(~np.all(residual[part] <= FAST_TOLERANCE, axis=(1, 2))):
                x[j] = run.history(x[j, 0], knots[j])
            check_mass(run.mechanics, x[part, :, size : size + s], run.compiled)

        each_part(shape[0], self.threads if run.compiled else 1, share)
        self.x, self.controls = x[:, -1].copy(), knots[:, -1].copy()
        return x

    def _part(self, i: int) -> Array:
        return np.split(self.x, np.cumsum(self.integrator.mechanics.sizes[:3]), axis=1)[i]


def control_table(vehicle: Vehicle, controls: Any, lead: tuple[int, ...]) -> Array:
    """Controls as (*lead, c), those common to all vehicles repeated; ``InputError`` names what is wrong."""
    array, shape = np.asarray(controls, float), (*lead, len(vehicle.controls))
    if array.shape not in (shape, shape[1:]) or not np.all(np.isfinite(array)) or 0 in lead:
        names = ", ".join(vehicle.control_names) or "none"
        raise InputError(f"controls: shape {array.shape}; give {shape} or {shape[1:]} finite: {names}")
    return np.broadcast_to(array, shape)
