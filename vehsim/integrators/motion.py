"""A vehicle in motion, stepped in place: the fast way to step from Python, as `mj_step` steps its data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from vehsim.integrators import machine
from vehsim.integrators.record import keep
from vehsim.lie import SO3
from vehsim.vehicles import State
from vehsim.vehicles._base import Array

if TYPE_CHECKING:
    from vehsim.integrators.discrete import DiscreteMechanics
    from vehsim.integrators.integrator import Integrator


class Motion:
    """A vehicle's phase that moves on by ``step()``. Made by `Integrator.motion`.

    ``g`` (size,), ``r`` (s,), ``pi`` (n_z,) are live views of group element, joints and knot momentum; set
    ``controls[:]`` (c,) to what holds at the *end* of the next step (they are linear between knots). ``state()`` gives
    the public state. A step that the fast solve does not finish is made again by `Integrator.advance`.
    """

    def __init__(self, integrator: Integrator, state: State, controls: Any):
        m = integrator.mechanics
        self._integrator, self._count = integrator, 0
        phase = integrator.start(state, controls)
        self._anchor = integrator.anchor(state, phase)
        a, b, c, d = (int(k) for k in np.cumsum([*m.sizes[:3], m.sizes[2]]))
        self._x, self._next = np.concatenate([phase.g, phase.r, phase.pi, phase.z]), np.empty(d)
        self.g, self.r, self.pi, self._z = self._x[:a], self._x[a:b], self._x[b:c], self._x[c:d]
        self.controls = np.array(controls, float).reshape(-1)
        self._before, self._residual = self.controls.copy(), np.zeros(1)
        self._step, wind = np.array([integrator.step_size]), integrator.wind.copy()
        self._buffer: Any
        self._buffer, self._evaluate = _made(integrator, whole_step(m, integrator.order)).buffer()
        self._held = (self._x, self._before, self.controls, self._step, wind)  # the buffer points into them
        for i, array in enumerate(self._held):
            if array.size:
                self._buffer.set_arg(i, _memory(array))
        self._buffer.set_res(0, _memory(self._next))
        self._buffer.set_res(1, _memory(self._residual))

    @property
    def time(self) -> float:
        """s since the start."""
        return self._count * self._integrator.step_size

    def step(self) -> None:
        """Move on by one step. ``SolveError`` names step, state and residual when it cannot."""
        self._evaluate()
        if self._residual[0] <= FAST_TOLERANCE:
            self._x[:] = self._next
        else:
            self._slow_step()
        self._before[:] = self.controls
        self._count += 1

    def state(self) -> State:
        """The public state now."""
        from vehsim.integrators.integrator import Phase

        phase = Phase(self.g, self.r, self.pi, self._z)
        return self._integrator.state(phase, self.controls, self._anchor)

    def _slow_step(self) -> None:
        from vehsim.integrators.integrator import Phase

        phase = Phase(*(part.copy() for part in (self.g, self.r, self.pi, self._z)))
        after = self._integrator.advance(phase, self._before, self.controls, self._count)
        self._x[:] = np.concatenate([after.g, after.r, after.pi, after.z])


FAST_TOLERANCE = 1e-12
"""Largest residual, relative to what the step balances, that the fast solve may leave: momentum stays exact."""


class PhaseStep:
    """`Integrator.advance` in one compiled call, or None when the fast solve does not finish the step."""

    def __init__(self, integrator: Integrator):
        m = integrator.mechanics
        a, b, c, d = (int(k) for k in np.cumsum([*m.sizes[:3], m.sizes[2]]))
        self._x, self._out, self._residual = np.empty(d), np.empty(d), np.zeros(1)
        self._cuts = (a, b, c)
        self._c0, self._c1 = np.empty(m.sizes[3]), np.empty(m.sizes[3])
        self._fixed = (np.array([integrator.step_size]), integrator.wind.copy())
        self._buffer: Any
        self._buffer, self._evaluate = _made(integrator, whole_step(m, integrator.order)).buffer()
        for i, array in enumerate((self._x, self._c0, self._c1, *self._fixed)):
            if array.size:
                self._buffer.set_arg(i, _memory(array))
        self._buffer.set_res(0, _memory(self._out))
        self._buffer.set_res(1, _memory(self._residual))

    def __call__(self, phase: Any, c0: Array, c1: Array) -> list[Array] | None:
        """``[g, r, pi, z]`` one step later."""
        a, b, c = self._cuts
        self._x[:a], self._x[a:b], self._x[b:c], self._x[c:] = phase.g, phase.r, phase.pi, phase.z
        self._c0[:], self._c1[:] = c0, c1
        self._evaluate()
        if not self._residual[0] <= FAST_TOLERANCE:
            return None
        out = self._out.copy()
        return [out[:a], out[a:b], out[b:c], out[c:]]


class PublicStep:
    """`Integrator.step` in one compiled call: public state and controls in, public state out."""

    def __init__(self, integrator: Integrator):
        m, v = integrator.mechanics, integrator.vehicle
        s, d, c = len(v.joints), v.group.dim, len(v.controls)
        function = keep(m, f"public{integrator.order}", lambda: _public_step(m, integrator.order))
        sizes = np.cumsum([3, 4, d, s, s, c, c])
        self._in, self._out = np.empty(sizes[-1]), np.empty(sizes[4])
        self._residual = np.zeros(1)
        self._state, self._c0, self._c1 = np.split(self._in, sizes[4:6])
        self._parts = np.split(self._state, sizes[:4])
        self._cuts = tuple(map(int, sizes[1:5]))
        self._rest = np.concatenate([[integrator.step_size], integrator.wind])
        self._buffer: Any
        self._buffer, self._evaluate = _made(integrator, function).buffer()
        self._buffer.set_arg(0, _memory(self._in))
        self._buffer.set_arg(1, _memory(self._rest))
        self._buffer.set_res(0, _memory(self._out))
        self._buffer.set_res(1, _memory(self._residual))

    def __call__(self, state: State, c0: Any, c1: Any) -> State | None:
        """The state one step later, or None when something needs the careful way."""
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
        self._evaluate()
        if not self._residual[0] <= FAST_TOLERANCE:
            return None
        # the fields are views of one row, which the next step then reads at once
        row, after, (a, b, c, d) = self._out.copy(), object.__new__(State), self._cuts
        after.__dict__.update(
            position=row[:3], orientation=row[3:a], twist=row[a:b], joints=row[b:c], joint_rates=row[c:d], _row=row
        )
        return after


def _memory(array: Array) -> Any:
    """What a CasADi buffer reads and writes: the array's own memory, which must outlive it."""
    return memoryview(array)  # type: ignore[arg-type]


def _made(integrator: Integrator, function: ca.Function) -> ca.Function:
    """The function as the integrator runs it: interpreted, or machine code."""
    return machine.external(function) if integrator.compiled else function


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


def whole_step(mechanics: DiscreteMechanics, order: int, solve: str = "advance_fast") -> ca.Function:
    """``(x, c0, c1, h, wind) -> (x1, residual)`` with ``x = (g, r, pi, z)``: all substeps of a composed step.

    ``solve``: which of `DiscreteMechanics`' ways to advance.
    """
    from vehsim.integrators.integrator import COMPOSITIONS

    def build() -> ca.Function:
        part = _part_of_a_step(mechanics, solve)
        # composed steps call the same code again, which a processor's cache holds, rather than write it out each time
        kind: Any = ca.SX if order == 2 else ca.MX
        x, *given = (kind.sym(part.name_in(i), part.size1_in(i)) for i in range(5))
        x1, done, worst, last = x, 0.0, kind(0), COMPOSITIONS[order][-1]
        for fraction in COMPOSITIONS[order]:
            x1, residual = part(x1, *given, done, fraction, fraction / last)
            worst = ca.if_else(residual <= worst, worst, residual)  # NaN wins
            done, last = done + fraction, fraction
        return ca.Function("step", [x, *given], [x1, worst])

    return keep(mechanics, f"step{order}{solve}", build)


def _part_of_a_step(mechanics: DiscreteMechanics, solve: str) -> ca.Function:
    """``(x, c0, c1, h, wind, done, fraction, ratio) -> (x1, residual)``: a fraction of a step, after what is done.

    ``ratio``: how much longer it is than the fraction before, which the warm start wants to know.
    """

    def build() -> ca.Function:
        y, sizes = mechanics.symbols, mechanics.sizes[:3]
        x = ca.SX.sym("x", sum(sizes) + sizes[2])
        g, r, pi, z = ca.vertsplit(x, [0, *(int(k) for k in np.cumsum([*sizes, sizes[2]]))])
        c0, c1, h, wind = y["c0"], y["c1"], y["h"], y["wind"]
        done, fraction, ratio = (ca.SX.sym(name) for name in ("done", "fraction", "ratio"))
        a, b = c0 + done * (c1 - c0), c0 + (done + fraction) * (c1 - c0)
        knot = mechanics.knot_velocity_guess(r, pi, a)
        before = knot + ratio * (z - knot)  # half a segment back, were that segment as long as this one
        *after, residual = getattr(mechanics, solve)(g, r, pi, before, a, b, fraction * h, wind)
        outputs = ca.cse([ca.densify(ca.vertcat(*after)), residual])
        return ca.Function("part", [x, c0, c1, h, wind, done, fraction, ratio], outputs)

    return keep(mechanics, f"part{solve}", build)
