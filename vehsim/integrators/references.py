"""Reference methods as data: the integrators that LIE section 3.3 and common practice use for rigid bodies and cars.

Explicit Runge-Kutta methods integrate group coordinates and free velocities of any vehicle; the coordinates are
normalised after every internal and external step, as in LIE with quaternions. Implicit RK2 (the midpoint rule) updates
the velocities, then the pose explicitly. Lie-Newmark is the explicit scheme of Krysl and Endres on the vehicle's group.
They exist for comparison only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError, SolveError
from vehsim.integrators.continuous import equations_of_motion
from vehsim.integrators.integrator import Integrator
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.base import Array
from vehsim.vehicles.definition.mechanics import coefficients, driven_rates, free_velocity
from vehsim.vehicles.definition.states import internal

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.vehicles import State

Step = Callable[["StepSymbols"], Any]


@dataclass(frozen=True)
class StepSymbols:
    """One step of a vehicle: state ``x = (g, r, z)``, step ``h``, controls ``c0`` to ``c1``, wind; all symbols."""

    vehicle: Vehicle
    x: Any
    h: Any
    c0: Any
    c1: Any
    wind: Any

    @property
    def sizes(self) -> tuple[int, int]:
        return self.vehicle.group.size, len(self.vehicle.joints)

    def slope(self, x: Any, fraction: float) -> Any:
        """``dx/dt`` at ``x`` with the controls at a fraction of the step."""
        g, r, z = self.split(x)
        law = equations_of_motion(self.vehicle)
        c, rate = self.c0 + fraction * (self.c1 - self.c0), (self.c1 - self.c0) / self.h
        return ca.vertcat(*law(g, r, z, c, rate, self.wind))

    def split(self, x: Any) -> tuple[Any, Any, Any]:
        size, s = self.sizes
        return x[:size], x[size : size + s], x[size + s :]

    def plain(self, x: Any) -> Any:
        """``x`` with its group coordinates re-projected."""
        g, r, z = self.split(x)
        return ca.vertcat(self.vehicle.group.normalize(g), r, z)


@dataclass(frozen=True)
class Tableau:
    """An explicit Runge-Kutta method: stage weights ``a`` (lower triangle), end weights ``b``, stage times ``c``."""

    a: tuple[tuple[float, ...], ...]
    b: tuple[float, ...]
    c: tuple[float, ...]

    def __call__(self, step: StepSymbols) -> Any:
        slopes: list[Any] = []
        for row, time in zip(self.a, self.c, strict=True):
            moved = step.x + step.h * sum((w * k for w, k in zip(row, slopes, strict=True)), ca.SX(0))
            slopes.append(step.slope(step.plain(moved), time))
        return step.plain(step.x + step.h * sum(w * k for w, k in zip(self.b, slopes, strict=True)))


def implicit_rk2(step: StepSymbols) -> Any:
    """Midpoint rule on the velocities (Newton, unrolled), then the pose by explicit RK2 with the mid-step velocity."""
    h, (g, r, z) = step.h, step.split(step.x)
    size, s = step.sizes
    half = step.plain(step.x + h / 2 * step.slope(ca.vertcat(g, r, z), 0.0))
    unknown = ca.SX.sym("z1", z.shape[0])
    gap = unknown - z - h * step.slope(ca.vertcat(half[: size + s], (z + unknown) / 2), 0.5)[size + s :]
    update = ca.solve(ca.jacobian(gap, unknown), gap)
    given = [unknown, step.x, step.h, step.c0, step.c1, step.wind]
    newton = ca.Function("newton", given, [unknown - update])
    z1 = z
    for _ in range(4):
        z1 = newton(z1, *given[1:])
    rate = step.slope(ca.vertcat(half[: size + s], (z + z1) / 2), 0.5)
    return step.plain(ca.vertcat(step.x[: size + s] + h * rate[: size + s], z1))


def lie_newmark(step: StepSymbols) -> Any:
    """Explicit Lie-Newmark: half a kick, a pose update with exp, half a kick with the force at the new pose."""
    h, group = step.h, step.vehicle.group
    size, s = step.sizes
    g, r, z = step.split(step.x)
    first = step.slope(step.x, 0.0)
    half = z + h / 2 * first[size + s :]
    turning = step.slope(ca.vertcat(g, r, half), 0.5)[size : size + s]
    g1 = group.compose(g, group.exp(h * _velocity(step, r + h / 2 * turning, half)))
    r1 = r + h * turning
    # the acceleration at the end depends on the velocity there: two fixed-point passes from the half-step velocity
    z1 = half
    for _ in range(2):
        z1 = half + h / 2 * step.slope(ca.vertcat(g1, r1, z1), 1.0)[size + s :]
    return step.plain(ca.vertcat(g1, r1, z1))


def _velocity(step: StepSymbols, r: Any, z: Any) -> Any:
    return free_velocity(step.vehicle, r, z, driven_rates(step.vehicle, (step.c0 + step.c1) / 2))[1]


METHODS: dict[str, Step] = {
    "rk2": Tableau(a=((), (0.5,)), b=(0.0, 1.0), c=(0.0, 0.5)),
    "rk4": Tableau(a=((), (0.5,), (0.0, 0.5), (0.0, 0.0, 1.0)), b=(1 / 6, 1 / 3, 1 / 3, 1 / 6), c=(0.0, 0.5, 0.5, 1.0)),
    "implicit_rk2": implicit_rk2,
    "lie_newmark": lie_newmark,
}


def reference_step(vehicle: Vehicle, method: str) -> ca.Function:
    """``(x, h, c0, c1, wind) -> x1`` with ``x = (g, r, z)``: group coordinates, joints, free velocity at the knot."""
    if method not in METHODS:
        raise InputError("unknown", f"choose one of {', '.join(METHODS)}", key="method", value=method)
    law = equations_of_motion(vehicle)
    x = ca.SX.sym("x", sum(law.size1_in(i) for i in range(3)))
    c0, c1 = ca.SX.sym("c0", law.size1_in(3)), ca.SX.sym("c1", law.size1_in(3))
    h, wind = ca.SX.sym("h"), ca.SX.sym("wind", 3)
    end = METHODS[method](StepSymbols(vehicle, x, h, c0, c1, wind))
    return ca.Function(method, [x, h, c0, c1, wind], ca.cse([ca.densify(end)]))


def reference_rollout(
    vehicle: Vehicle, method: str, x: Array, controls: Array, step: float, wind: Any = (0.0, 0.0, 0.0)
) -> Array:
    """States (n + 1, len(x)) from ``x`` with knot controls (n + 1, c); NaN after a method diverges."""
    n = len(controls) - 1
    loop = reference_step(vehicle, method).mapaccum(n)
    winds = np.tile(np.asarray(wind, float)[:, None], n)
    states = loop(x, np.full((1, n), step), controls[:-1].T, controls[1:].T, winds)
    return np.vstack([x, np.asarray(states, float).T])


def reference_clip(
    vehicle: Vehicle, method: str, state: State, controls: Array, step: float, *, fps: Any = 24, start_frame: int = 1001
) -> Clip:
    """The clip of a method from a start with knot controls (n + 1, c), as `Integrator.rollout` makes it.

    Raises ``SolveError`` with the time at which the method diverges.
    """
    integrator = Integrator(vehicle, step)
    m, (g, r, u, xi) = integrator.mechanics, internal(vehicle, state)
    start = np.concatenate([g, r, np.array(ca.evalf(coefficients(vehicle, *map(ca.SX, (r, u, xi))))).ravel()])
    x = reference_rollout(vehicle, method, start, controls, step)
    lost = ~np.isfinite(x).all(axis=1)
    if lost.any():
        raise SolveError(
            f"{method} blows up after {lost.argmax() * step:g} s at a step of {step:g} s",
            "shorten it",
            subject=vehicle.name,
        )
    sizes = (len(r), len(start) - len(g) - len(r), controls.shape[1])
    rest, free, c = given = [ca.SX.sym(name, size) for name, size in zip("rzc", sizes, strict=True)]
    momentum = m.knot_momentum(rest, *free_velocity(vehicle, rest, free, driven_rates(vehicle, c)))
    joints, speeds = np.split(x[:, len(g) :], [len(r)], axis=1)
    pi = ca.Function("pi", given, [momentum]).map(len(x))(joints.T, speeds.T, controls.T)
    phases = np.ascontiguousarray(np.hstack([x[:, : len(g)], joints, np.asarray(pi).T, speeds]))
    anchor = integrator.anchor(state, integrator.start(state, controls[0]))
    return integrator._clips(phases[None], controls[None], anchor[None], fps, start_frame)[0]
