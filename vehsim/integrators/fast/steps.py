"""One step in one compiled call: of a phase, and of a public state."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.composition import FAST_TOLERANCE, whole_step
from vehsim.integrators.discrete import DiscreteMechanics, keep
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.phase import Phase
from vehsim.lie import SO3
from vehsim.vehicles import State
from vehsim.vehicles.definition.base import Array


class PhaseStep:
    """A step of a phase, or None when the fast solve does not finish it.

    ``order`` of the composition; ``step`` s; ``wind`` (3,) m/s; ``compiled``: by machine code.
    """

    def __init__(self, mechanics: DiscreteMechanics, order: int, step: float, wind: Array, compiled: bool):
        a, b, c, d = (int(k) for k in np.cumsum([*mechanics.sizes[:3], mechanics.sizes[2]]))
        self._cuts = (a, b, c)
        self._x, self._out, self._residual = np.empty(d), np.empty(d), np.zeros(1)
        self._c0, self._c1 = np.empty(mechanics.sizes[3]), np.empty(mechanics.sizes[3])
        inputs = [self._x, self._c0, self._c1, np.array([step]), wind.copy()]
        self._kernel = Kernel(whole_step(mechanics, order), compiled).bind(inputs, [self._out, self._residual])

    def __call__(self, phase: Phase, c0: Array, c1: Array) -> Phase | None:
        """The phase one step later, under controls (c,) linear from ``c0`` to ``c1``."""
        a, b, c = self._cuts
        self._x[:a], self._x[a:b], self._x[b:c], self._x[c:] = phase.g, phase.r, phase.pi, phase.z
        self._c0[:], self._c1[:] = c0, c1
        self._kernel.run()
        if not self._residual[0] <= FAST_TOLERANCE:
            return None
        out = self._out.copy()
        return Phase(out[:a], out[a:b], out[b:c], out[c:])


class PublicStep:
    """A step of a public state. Arguments as of `PhaseStep`."""

    def __init__(self, mechanics: DiscreteMechanics, order: int, step: float, wind: Array, compiled: bool):
        v = mechanics.vehicle
        s, d, c = len(v.joints), v.group.dim, len(v.controls)
        sizes = np.cumsum([3, 4, d, s, s, c, c])
        row, self._out, self._residual = np.empty(sizes[-1]), np.empty(sizes[4]), np.zeros(1)
        self._state, self._c0, self._c1 = np.split(row, sizes[4:6])
        self._parts = np.split(self._state, sizes[:4])
        self._cuts = tuple(map(int, sizes[1:5]))
        function = keep(mechanics, f"public{order}", lambda: _public_step(mechanics, order))
        inputs = [row, np.concatenate([[step], wind])]
        self._kernel = Kernel(function, compiled).bind(inputs, [self._out, self._residual])

    def __call__(self, state: State, c0: Any, c1: Any) -> State | None:
        """The state one step later; None when the input needs checks or the step a better solve."""
        known = state.__dict__
        try:
            row = known.get("_row")
            if row is not None and known["position"].base is row:  # made below, and not a copy
                self._state[:] = row
            else:
                position, orientation, twist, joints, rates = self._parts
                position[:], orientation[:], twist[:] = state.position, state.orientation, state.twist
                joints[:], rates[:] = state.joints, state.joint_rates
            self._c0[:] = c0
            self._c1[:] = c1
        except (TypeError, ValueError):
            return None
        self._kernel.run()
        if not self._residual[0] <= FAST_TOLERANCE:
            return None
        # the fields are views of one row, which the next step then reads at once
        row, after, (a, b, c, d) = self._out.copy(), object.__new__(State), self._cuts
        after.__dict__.update(
            position=row[:3], orientation=row[3:a], twist=row[a:b], joints=row[b:c], joint_rates=row[c:d], _row=row
        )
        return after


def _public_step(m: DiscreteMechanics, order: int) -> ca.Function:
    """``((position, orientation, twist, joints, rates, c0, c1), (h, wind)) -> (pose, twist, joints, rates), error``"""
    v, (size, s, n, c) = m.vehicle, m.sizes
    d = v.group.dim
    given, rest = ca.SX.sym("given", 7 + d + 2 * s + 2 * c), ca.SX.sym("rest", 4)
    position, orientation, twist, r, u, c0, c1 = ca.vertsplit(
        given, [0, *(int(k) for k in np.cumsum([3, 4, d, s, s, c, c]))]
    )
    length = ca.sqrt(ca.sumsqr(orientation))
    q = orientation / length
    g = v.group.from_pose(ca.vertcat(position + SO3.matrix(q) @ ca.DM(v.origin), q))
    for joint, control in v.driven:
        u[joint] = c0[control]
    xi = v.group.velocity_from_body(g, v.group.shift(twist, ca.DM(v.origin)))
    pi = m.knot_momentum(r, u, xi)
    before, _, _, _ = m.root_state(g, r, pi, c0)
    x = ca.vertcat(g, r, pi, m.knot_velocity_guess(r, pi, c0))
    x1, residual = whole_step(m, order)(x, c0, c1, rest[0], rest[1:4])
    b, e = size + s, size + s + n
    pose, twist1, r1, u1 = m.root_state(x1[:size], x1[size:b], x1[b:e], c1)
    here = pose[0:3] + position - before[0:3]
    odd = ca.logic_not(length > 1e-6)
    if v.group.planar:
        odd = ca.logic_or(odd, q[1] ** 2 + q[2] ** 2 > 1e-12)
    out = ca.vertcat(here, pose[3:7], twist1, r1, u1)
    return ca.Function("public", [given, rest], ca.cse([ca.densify(out), residual + odd]))
