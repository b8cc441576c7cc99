"""A vehicle stepped in place: the fast way to step from Python, as `mj_step` steps its data."""

from __future__ import annotations

from typing import Any

import numpy as np

from vehsim.integrators.composition import FAST_TOLERANCE, whole_step
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.phase import Phase, packed
from vehsim.integrators.phase_integrator import PhaseIntegrator
from vehsim.vehicles import State


class Stepper:
    """A vehicle's phase that advances by ``step()``. Made by `Integrator.stepper`.

    ``g`` (size,), ``r`` (s,), ``pi`` (n_z,) are live views of group element, joints and knot momentum; set
    ``controls[:]`` (c,) to what holds at the *end* of the next step (they are linear between knots). ``state()`` gives
    the public state. A step that the fast solve does not finish is made again by `PhaseIntegrator.advance`.
    """

    def __init__(self, integrator: PhaseIntegrator, state: State, controls: Any):
        phase = integrator.start(state, controls)
        m = integrator.mechanics
        self._integrator, self._count = integrator, 0
        self._anchor = integrator.anchor(state, phase)
        a, b, c, d = (int(k) for k in np.cumsum([*m.sizes[:3], m.sizes[2]]))
        self._x, self._next = packed(phase), np.empty(d)
        self.g, self.r, self.pi, self._z = self._x[:a], self._x[a:b], self._x[b:c], self._x[c:d]
        self.controls = np.array(controls, float).reshape(-1)
        self._before, self._residual = self.controls.copy(), np.zeros(1)
        inputs = [self._x, self._before, self.controls, np.array([integrator.step_size]), integrator.wind.copy()]
        kernel = Kernel(whole_step(m, integrator.order), integrator.compiled)
        self._kernel = kernel.bind(inputs, [self._next, self._residual])

    @property
    def time(self) -> float:
        """Time since the start, s."""
        return self._count * self._integrator.step_size

    def step(self) -> None:
        """Advance by one step. ``SolveError`` names step, state and residual when it cannot."""
        self._kernel.run()
        if self._residual[0] <= FAST_TOLERANCE:
            self._x[:] = self._next
        else:
            self._slow_step()
        self._before[:] = self.controls
        self._count += 1

    def state(self) -> State:
        """The public state now."""
        phase = Phase(self.g, self.r, self.pi, self._z)
        return self._integrator.state(phase, self.controls, self._anchor)

    def _slow_step(self) -> None:
        phase = Phase(*(part.copy() for part in (self.g, self.r, self.pi, self._z)))
        self._x[:] = packed(self._integrator.advance(phase, self._before, self.controls, self._count))
