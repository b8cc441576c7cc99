"""Changes of coordinates and inputs as data: ``h = T(x)``, ``v = beta(x) u`` (SIN sec. 4).

This module holds the change itself, the test whether a system can be brought to chained form, the construction from two
functions of the state, and the changes for the paper's systems. A system in chained form is nilpotent: this is feedback
nilpotentisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vehsim.errors import InputError
from vehsim.sinusoids.algebra.brackets import lie_bracket, rank_of
from vehsim.sinusoids.algebra.classification import SAMPLES
from vehsim.sinusoids.system import Array, DriftlessSystem, Expr
from vehsim.vehicles.definition.mechanics import matrix, stacked


@dataclass(frozen=True, eq=False)
class Feedback:
    """``h = coordinates(x)`` (n,), ``x = inverse(h)``, ``v = inputs(x) u`` with ``inputs`` (m, m).

    ``target`` is the system in the new coordinates and inputs. ``check`` tests the inverse against the coordinates.
    """

    source: DriftlessSystem
    name: str
    states: tuple[str, ...]
    coordinates: Callable[[Expr], Any]
    inverse: Callable[[Expr], Any]
    inputs: Callable[[Expr], Any]
    domain: Any = None

    @cached_property
    def target(self) -> DriftlessSystem:
        """``h' = (dT/dx) G beta^-1 v`` at ``x = T^-1(h)``."""
        x = self.source.x
        jacobian = ca.jacobian(stacked(self.coordinates(x)), x)
        fields = jacobian @ self.source.G @ ca.inv(matrix(self.inputs(x)))

        def moved(h: Expr) -> Expr:
            return ca.simplify(ca.substitute(fields, x, stacked(self.inverse(h))))

        return DriftlessSystem(
            self.name, self.states, tuple(f"v{i + 1}" for i in range(self.source.m)), moved, self.domain or {}
        )

    @cached_property
    def driven(self) -> DriftlessSystem:
        """The source's states with the target's inputs: ``x' = G beta^-1 v``."""
        return replace(
            self.source,
            inputs=tuple(f"v{i + 1}" for i in range(self.source.m)),
            fields=lambda x: matrix(self.source.fields(x)) @ ca.inv(matrix(self.inputs(x))),
        )

    @cached_property
    def _functions(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        x, h, v = self.source.x, ca.SX.sym("h", self.source.n), ca.SX.sym("v", self.source.m)
        beta = matrix(self.inputs(x))
        return (
            ca.Function("to", [x], [ca.densify(stacked(self.coordinates(x)))]),
            ca.Function("back", [h], [ca.densify(stacked(self.inverse(h)))]),
            ca.Function("u", [x, v], [ca.densify(ca.solve(beta, v))]),
        )

    def to(self, x: Any) -> Array:
        """h (n,) of x."""
        return np.asarray(self._functions[0](np.asarray(x, float))).ravel()

    def back(self, h: Any) -> Array:
        """x (n,) of h."""
        return np.asarray(self._functions[1](np.asarray(h, float))).ravel()

    def source_inputs(self, x: Array, v: Array) -> Array:
        """Inputs (k, m) of the source at states (k, n) for inputs (k, m) of the target."""
        function = self._functions[2]
        mapped = function.map(len(x)) if len(x) > 1 else function
        return np.asarray(mapped(x.T, v.T)).T

    def check(self) -> Feedback:
        """This change. Raises ``InputError`` if, at random states, the inverse is wrong or the inputs lose rank."""
        for x in self.source.samples(SAMPLES):
            gap = float(np.abs(self.back(self.to(x)) - x).max())
            if not gap < 1e-8:
                raise InputError(
                    f"{np.round(x, 4).tolist()} comes back {gap:.2g} off",
                    "give the inverse of `coordinates` on the whole domain",
                    key="inverse",
                    subject=self.name,
                )
        return self


def chained_from_outputs(
    system: DriftlessSystem, first: Callable[[Expr], Expr], last: Callable[[Expr], Expr], inverse: Any = None
) -> Feedback:
    """Chained form of a two-input system from the functions that become ``z1`` and ``zn``.

    With inputs such that ``z1' = v1``, ``z(k-1)`` is the derivative of ``zk`` along the first; this is chained form if
    the second input affects only ``z2``. Raises ``InputError`` naming the coordinate for which this fails.
    """
    if system.m != 2:
        raise InputError(f"{system.m} inputs", "chained form from two functions needs two", subject=system.name)
    x, n = system.x, system.n
    z1, zn = first(x), last(x)
    along = ca.jacobian(z1, x) @ system.G
    lead = int(np.argmax([_generic_size(system, along[0, i]) for i in range(2)]))
    if _generic_size(system, along[0, lead]) == 0:
        raise InputError("no input moves it", "give another first function", key="z1", subject=system.name)
    other = 1 - lead
    drive = system.G[:, lead] / along[0, lead]  # z1' = 1 along it
    free = system.G[:, other] - drive * along[0, other]  # z1' = 0 along it
    zs = [zn]
    for k in range(n, 2, -1):
        moved = ca.jtimes(zs[0], x, free)
        if _generic_size(system, moved) > 1e-9:
            raise InputError(
                f"the second input moves it too (rate {_generic_size(system, moved):.2g} at a random state), so these "
                "functions give no chained form",
                "give others",
                key=f"z{k}",
                subject=system.name,
            )
        zs.insert(0, ca.jtimes(zs[0], x, drive))
    gains = ca.horzcat(ca.jtimes(zs[0], x, drive), ca.jtimes(zs[0], x, free))
    if _generic_size(system, gains[1]) < 1e-9:
        raise InputError("the second input does not reach it", "give other functions", key="z2", subject=system.name)
    forward = ca.Function("z", [x], [ca.vertcat(z1, *zs)])
    # v1 = along u, v2 = gains (v1, u_other)
    beta = ca.SX(2, 2)
    beta[0, lead], beta[0, other] = along[0, lead], along[0, other]
    beta[1, :] = gains[0] * beta[0, :]
    beta[1, other] += gains[1]
    inputs = ca.Function("beta", [x], [beta])
    return Feedback(
        system,
        f"{system.name} in chained form",
        tuple(f"z{i + 1}" for i in range(n)),
        coordinates=lambda q: forward(q),
        inverse=inverse or (lambda h: ca.SX.nan(n, 1)),
        inputs=lambda q: inputs(q),
    )


def chained_form_exists(system: DriftlessSystem) -> bool:
    """Whether a two-input system can be brought to chained form near generic states.

    The derived flags ``E_{i+1} = E_i + [E_i, E_i]`` and ``F_{i+1} = F_i + [F_i, F_0]`` must both grow by one a step
    (Murray's condition on a Goursat flag).
    """
    if system.m != 2:
        return False
    points = system.samples(SAMPLES)
    inputs = [system.G[:, i] for i in range(2)]
    derived, filtration = list(inputs), list(inputs)
    for size in range(3, system.n + 1):
        derived = _grown(system, derived, derived, points)
        filtration = _grown(system, filtration, inputs, points)
        if len(derived) != size or len(filtration) != size:
            return False
    return True


def _grown(system: DriftlessSystem, fields: list[Expr], others: list[Expr], points: Array) -> list[Expr]:
    kept = list(fields)
    for f in fields:
        for g in others:
            trial = [*kept, lie_bracket(f, g, system.x)]
            function = ca.Function("f", [system.x], [ca.densify(ca.horzcat(*trial))])
            if max(rank_of(np.array(function(p))).value for p in points) == len(trial):
                kept = trial
    return kept


def hopper_chained(leg: float = 0.5) -> Feedback:
    """The hopper in chained form, globally: ``(psi, f(l), theta)``, ``f`` its rate of turning, ``v2 = f'(l) u2``."""
    from vehsim.sinusoids.models import hopper

    def f(length: Expr) -> Expr:
        return -leg * (1 + length) ** 2 / (1 + leg * (1 + length) ** 2)

    def back(h: Expr) -> Expr:
        return ca.vertcat(h[0], ca.sqrt(-h[1] / (1 + h[1]) / leg) - 1, h[2])

    def inputs(x: Expr) -> Any:
        return [[1, 0], [0, -2 * leg * (1 + x[1]) / (1 + leg * (1 + x[1]) ** 2) ** 2]]

    return Feedback(
        hopper(leg), "hopper in chained form", ("z1", "z2", "z3"), lambda x: [x[0], f(x[1]), x[2]], back, inputs
    )


def car_triangular(wheelbase: float = 1.0, steering: float = 1.5) -> Feedback:
    """SIN sec. 3: ``v1 = cos theta cos phi u1``, ``alpha = sin theta``; then x, phi, alpha, y is triangular."""
    from vehsim.sinusoids.models import car

    return Feedback(
        car(wheelbase, steering),
        "car, triangular",
        ("x", "phi", "alpha", "y"),
        coordinates=lambda q: [q[0], q[3], ca.sin(q[2]), q[1]],
        inverse=lambda h: [h[0], h[3], ca.asin(h[2]), h[1]],
        inputs=lambda q: [[ca.cos(q[2]) * ca.cos(q[3]), 0], [0, 1]],
        domain={"x": (-1e4, 1e4), "phi": (-steering, steering), "alpha": (-0.9975, 0.9975), "y": (-1e4, 1e4)},
    )


def car_chained(wheelbase: float = 1.0, steering: float = 1.5) -> Feedback:
    """``z = (x, tan phi / (l cos^3 theta), tan theta, y)``."""
    from vehsim.sinusoids.models import car

    def back(z: Expr) -> Any:
        theta = ca.atan(z[2])
        return [z[0], z[3], theta, ca.atan(wheelbase * z[1] * ca.cos(theta) ** 3)]

    return chained_from_outputs(car(wheelbase, steering), lambda q: q[0], lambda q: q[1], back)


def _generic_size(system: DriftlessSystem, expression: Expr) -> float:
    function = ca.Function("e", [system.x], [ca.densify(expression)])
    return float(max(np.abs(np.asarray(function(p))).max() for p in system.samples(SAMPLES, seed=3)))
