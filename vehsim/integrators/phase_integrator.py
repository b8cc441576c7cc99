"""Advance phases by fixed steps: the common part of `Integrator`, steppers and fleets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any

import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.integrators.composition import COMPOSITIONS, FAST_TOLERANCE, SOLVES, whole_step
from vehsim.integrators.discrete import keep, mechanics_of
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.fast.steps import PhaseStep
from vehsim.integrators.guards import changes_rank, check_constraints, check_mass
from vehsim.integrators.phase import Phase, joints_of, packed, unpacked
from vehsim.lie.maps import DEFAULT_MAP
from vehsim.vehicles import State, Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.states import flat, internal

TOLERANCE = 1e-9
"""Largest accepted Newton residual, relative to the momentum."""

REST = 1e-8
"""Change of places, angles and velocities (SI units) in half a block of steps, at which what slows down is at rest; and
of its controls, as a share of them."""
GROWTH = 1.01
"""Of these changes from half a block to the next: what leaves an unstable balance grows faster."""

_RETRIES = 8
BLOCK = 1024
"""Number of steps between checks of the residual, and of rest."""


class PhaseIntegrator:
    """Advances phases (`vehsim.integrators.phase`) by fixed steps. Arguments as of `Integrator`."""

    def __init__(
        self,
        vehicle: Vehicle,
        step: float,
        difference_map: str = DEFAULT_MAP,
        order: int = 2,
        *,
        quadrature: str = "galerkin",
        wind: Any = (0.0, 0.0, 0.0),
        compiled: bool = False,
    ):
        if not (np.isfinite(step) and step > 0):
            raise InputError("must be a positive number of seconds", key="step", value=step)
        if order not in COMPOSITIONS:
            raise InputError("unknown", f"choose one of {', '.join(map(str, COMPOSITIONS))}", key="order", value=order)
        self.vehicle, self.step_size, self.order = vehicle, float(step), order
        self.wind = np.asarray(wind, float)
        if self.wind.shape != (3,) or not np.all(np.isfinite(self.wind)):
            raise InputError("not a wind", "give three finite numbers, m/s in world axes", key="wind", value=wind)
        self.mechanics = mechanics_of(vehicle, difference_map, quadrature)
        self.guarded = changes_rank(self.mechanics)
        self.compiled = compiled and Kernel(whole_step(self.mechanics, order), compiled=True).compiled
        if order > 2 and not _symmetric(difference_map, vehicle):
            raise InputError(
                f"{difference_map!r} makes no symmetric step to compose",
                "take order 2 or another map",
                key="order",
                value=order,
            )

    @cached_property
    def _quick(self) -> PhaseStep:
        return PhaseStep(self.mechanics, self.order, self.step_size, self.wind, self.compiled)

    def start(self, state: State, controls: Any) -> Phase:
        """The phase of a public state; rates that contradict the constraints are projected onto them."""
        g, r, u, xi = internal(self.vehicle, state)
        self._choose_chart(r)
        m = self.mechanics
        c = np.asarray(controls, float)
        for joint, control in self.vehicle.driven:
            u[joint] = c[control]
        pi = flat(m.knot_momentum(r, u, xi))
        return Phase(g, r, pi, flat(m.knot_velocity_guess(r, pi, c)))

    def state(self, phase: Phase, controls: Any, anchor: Any = (0.0, 0.0, 0.0)) -> State:
        """The public state of a phase. ``anchor`` (3,): the part of the position that the group does not contain."""
        kernel = keep(self.mechanics, "root_state kernel", lambda: Kernel(self.mechanics.root_state))
        pose, twist, r, u = kernel(phase.g, phase.r, phase.pi, controls)
        return State(position=pose[0:3] + anchor, orientation=pose[3:7], twist=twist, joints=r, joint_rates=u)

    def anchor(self, state: State, phase: Phase) -> Array:
        """The part of a start position beyond the group's own coordinates (the height of a vehicle on SE(2))."""
        pose = flat(self.mechanics.root_state(phase.g, phase.r, phase.pi, np.zeros(self.mechanics.sizes[3]))[0])
        return np.asarray(state.position, float) - pose[0:3]

    def advance(self, phase: Phase, c0: Array, c1: Array, index: int = 0) -> Phase:
        """One step; ``c0, c1`` (c,) are the controls at its ends. ``SolveError`` names step, state and residual."""
        quick = self._quick(phase, c0, c1)
        if quick is not None:
            if self.guarded:
                check_constraints(self.mechanics, np.array([phase.r, quick.r]), index)
            return quick
        done = 0.0
        for fraction in COMPOSITIONS[self.order]:
            a, b = c0 + done * (c1 - c0), c0 + (done + fraction) * (c1 - c0)
            after = self._substep(phase, a, b, fraction * self.step_size, index)
            if self.guarded:
                check_constraints(self.mechanics, np.array([phase.r, after.r]), index)
            phase = after
            done += fraction
        return phase

    def _substep(self, phase: Phase, c0: Array, c1: Array, h: float, index: int) -> Phase:
        guess = phase.z
        for _ in range(_RETRIES):
            g, r, pi, z, residual = self.mechanics.advance(phase.g, phase.r, phase.pi, guess, c0, c1, h, self.wind)
            if residual <= TOLERANCE:
                return Phase(flat(g), flat(r), flat(pi), flat(z))
            guess = flat(z)
        other = self._other_chart(phase, c0, c1, h)
        if other is not None:
            return other
        check_constraints(self.mechanics, np.array([phase.r, phase.r]), index)
        raise _diverged(self.vehicle, index, phase, float(residual), h)

    def _choose_chart(self, r: Array) -> None:
        """Choose columns to eliminate that are regular at joints ``r``, if the current choice is not."""
        vehicle = self.mechanics.vehicle
        if not self.guarded or vehicle.soundness(r) > 0.1:  # type: ignore[attr-defined]  # guarded vehicles are nonholonomic
            return
        chart = vehicle.chart_at(r)  # type: ignore[attr-defined]  # the same
        if chart is not None:
            self.mechanics = mechanics_of(chart, self.mechanics.map_name, self.mechanics.quadrature)
            self.__dict__.pop("_quick", None)

    def _other_chart(self, phase: Phase, c0: Array, c1: Array, h: float) -> Phase | None:
        """The same step with other columns of the constraints eliminated, if the current choice becomes singular."""
        m = self.mechanics
        chart = getattr(m.vehicle, "chart_at", None)
        vehicle = chart(phase.r) if chart else None
        if vehicle is None:
            return None
        other = mechanics_of(vehicle, m.map_name, m.quadrature)
        pi = other.knot_momentum(phase.r, *m.knot_velocity(phase.r, phase.pi, c0))
        z = other.knot_velocity_guess(phase.r, pi, c0)
        for _ in range(_RETRIES):
            g, r, pi1, z, residual = other.advance(phase.g, phase.r, pi, z, c0, c1, h, self.wind)
            if residual <= TOLERANCE:
                u, xi = other.knot_velocity(r, pi1, c1)
                pi1 = flat(m.knot_momentum(r, u, xi))
                return Phase(flat(g), flat(r), pi1, flat(m.knot_velocity_guess(r, pi1, c1)))
        return None

    def steps(self, solve: str = SOLVES[0]) -> Callable[[Array, Array, Array], None]:
        """``run(x (..., n + 1, d), controls (..., n + 1, c), residual (..., n, 1))`` fills in ``x[1:]``."""
        function = whole_step(self.mechanics, self.order, solve)
        key = f"steps{self.order}{solve}{self.compiled}"
        kernel = keep(self.mechanics, key, lambda: Kernel(function, self.compiled))

        def run(x: Array, controls: Array, residual: Array) -> None:
            h, wind = (
                np.broadcast_to(a, (*residual.shape[:-1], a.size)) for a in (np.array(self.step_size), self.wind)
            )
            before, after = controls[..., :-1, :], controls[..., 1:, :]
            kernel.rows([x[..., :-1, :], before, after, h, wind], [x[..., 1:, :], residual], carries=True)

        return run

    def _accumulate(self, phase: Phase, controls: Array) -> tuple[Array, Array, Array]:
        """Group elements, joints and momenta at every knot."""
        g, r, pi, _ = np.split(self.history(packed(phase), controls), np.cumsum(self.mechanics.sizes[:3]), axis=1)
        return g, r, pi

    def history(self, start: Array, controls: Array, rests: bool = False) -> Array:
        """Packed phases (n, .) at every knot of ``controls`` (n, c), without a Python loop. ``rests``: a vehicle that
        has come to rest stays as it is, at no cost, until its controls change."""
        m, controls = self.mechanics, np.ascontiguousarray(controls)
        x, residual = np.empty((len(controls), len(start))), np.zeros((len(controls) - 1, 1))
        x[0] = start
        held: Array | None = None
        for first in range(0, len(residual), BLOCK):
            steps = slice(first, first + BLOCK)
            block, knots, left = x[first : first + BLOCK + 1], controls[first : first + BLOCK + 1], residual[steps]
            if constant(knots, held):
                block[1:] = block[0]
                continue
            for solve in SOLVES:
                self.steps(solve)(block, knots, left)
                if np.all(left <= FAST_TOLERANCE):
                    break
            if not np.all(left <= TOLERANCE):  # one by one: retries, or an error that names the step
                block[1:] = [packed(after) for after in self._loop(unpacked(m, block[0]), knots, first)]
            elif self.guarded:
                check_constraints(m, joints_of(m, block), first)
            held = self.held(block, knots) if rests else None
        check_mass(m, joints_of(m, x), self.compiled)
        return x

    def held(self, block: Array, controls: Array) -> Array | None:
        """The controls (c,) under which a vehicle has come to rest: during packed phases ``block`` (n, .) and
        ``controls`` (n, c), both hardly change, and ever less. None: it has not."""
        first, middle, last = block[[0, len(block) // 2, -1]]
        momentum = slice(sum(self.mechanics.sizes[:2]), sum(self.mechanics.sizes[:3]))  # in any unit; see velocities
        early, late = (np.abs(np.delete(change, momentum)).max() for change in (middle - first, last - middle))
        rests = late <= min(REST, GROWTH * early) and constant(controls, controls[-1])
        return controls[-1] if rests else None

    def _loop(self, phase: Phase, controls: Array, first: int) -> Iterator[Phase]:
        for k in range(len(controls) - 1):
            phase = self.advance(phase, controls[k], controls[k + 1], first + k)
            yield phase


def constant(controls: Array, held: Array | None) -> bool:
    """Whether ``controls`` (n, c) are those that are ``held`` (c,), but for the rest of a lag."""
    return held is not None and bool((np.abs(controls - held) <= REST * np.maximum(np.abs(held), 1.0)).all())


def _symmetric(name: str, vehicle: Vehicle) -> bool:
    from vehsim.lie import difference_map

    return difference_map(name, vehicle.group).symmetric


def _diverged(vehicle: Vehicle, index: int, phase: Phase, residual: float, h: float) -> SolveError:
    state = ", ".join(f"{name} = {np.round(getattr(phase, name), 6).tolist()}" for name in ("g", "r", "pi"))
    return SolveError(
        f"step {index} of {h:.6g} s did not converge: residual {residual:.3g} at {state}",
        "take a smaller step, or check the controls and the start",
        subject=vehicle.name,
    )
