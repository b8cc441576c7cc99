"""Direct collocation of the same vehicles: what DMOC is compared with, as SYM and NH do. No plan is made by it.

Everything but the dynamics is DMOC's own: marks, costs, limits, first guess, elements and solver. In place of the
discrete mechanics stand the continuous equations of motion, discretised afterwards by the trapezoidal rule (order 2) or
by Hermite and Simpson's (order 4; Hargraves and Paris 1987), controls linear between knots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.continuous import equations_of_motion
from vehsim.planning.certify import Executed, executed
from vehsim.planning.elements import Element
from vehsim.planning.guess import along_paths
from vehsim.planning.layout import Layout
from vehsim.planning.legs import legs_between
from vehsim.planning.marks import Mark
from vehsim.planning.problem import build, hold_adrift, parameter_values, variable_bounds
from vehsim.planning.request import ask
from vehsim.planning.solver import Solution, Solver
from vehsim.planning.transcription import Array, Transcription
from vehsim.vehicles import Vehicle
from vehsim.vehicles.mechanics import free_velocity


class Collocation(Transcription):
    """A vehicle's elements with collocated dynamics; ``scheme``: a name of `SCHEMES`."""

    def __init__(self, vehicle: Vehicle, scheme: str):
        super().__init__(vehicle)
        self.rule = SCHEMES[scheme]

    @cached_property
    def substep(self) -> Element:
        """Defects of a segment, with the variables and parameters of DMOC's; the velocity ``z`` is in none of them."""
        v = self._symbols("x", "z", "c0", "c1", "x1", "h")
        wind, start, fraction = ca.SX.sym("wind", 3), ca.SX.sym("start"), ca.SX.sym("fraction")
        flow = self._flow
        c_rate = (v["c1"] - v["c0"]) / v["h"]

        def slope(x: Any, s: float) -> Any:
            return flow(x, v["c0"] + s * (v["c1"] - v["c0"]), c_rate, wind)

        defect = self.rule(slope, v["x"], v["x1"], v["h"])
        y = ca.vertcat(*v.values())
        return Element("dynamics", y, ca.vertcat(wind, start, fraction), g=defect)

    @property
    def _flow(self) -> ca.Function:
        """``(x, c, c_rate, wind) -> dx/dt`` of a node state, everything scaled as the variables are."""
        m, v = self.mechanics, self._symbols("x", "c0")
        c_rate, wind = ca.SX.sym("c_rate", self.sizes[3]), ca.SX.sym("wind", 3)
        g, r, pi = self.split(v["x"])
        c, c_dot = v["c0"] * self.control_scale, c_rate * self.control_scale
        z = m.knot_velocity_guess(r, pi, c)
        g_dot, r_dot, z_dot = equations_of_motion(self.vehicle)(g, r, z, c, c_dot, wind)
        given = r_, z_, c_ = [m.symbols[name] for name in ("r", "z", "c0")]
        momentum = m.knot_momentum(r_, *free_velocity(self.vehicle, r_, z_, m.driven(c_)))
        rate = ca.jtimes(momentum, ca.vertcat(*given), ca.vertcat(r_dot, z_dot, c_dot))
        pi_dot = ca.substitute([rate], given, [r, z, c])[0] / self.momentum_scale
        return ca.Function("flow", [v["x"], v["c0"], c_rate, wind], [ca.densify(ca.vertcat(g_dot, r_dot, pi_dot))])


def _trapezoidal(slope: Any, x: Any, x1: Any, h: Any) -> Any:
    return x1 - x - h / 2 * (slope(x, 0.0) + slope(x1, 1.0))


def _hermite_simpson(slope: Any, x: Any, x1: Any, h: Any) -> Any:
    first, last = slope(x, 0.0), slope(x1, 1.0)
    middle = slope((x + x1) / 2 + h / 8 * (first - last), 0.5)
    return x1 - x - h / 6 * (first + 4 * middle + last)


SCHEMES = {"trapezoidal": _trapezoidal, "hermite-simpson": _hermite_simpson}
"""Scheme -> the defect of a segment from the slope at its fractions, the states at its ends and its length."""


@dataclass(frozen=True, eq=False)
class Collocated:
    """What one solve came to: ``g`` (n, size) at the knots, ``controls`` (n, c), and where they really lead."""

    solution: Solution
    g: Array
    controls: Array
    executed: Executed


def solve(t: Transcription, marks: Sequence[Mark], segments: int, **options: Any) -> Collocated:
    """One solve on ``segments`` from DMOC's first guess: neither coarser before nor finer after, in free space.

    ``t``: a `Collocation`, or `transcription.transcription(vehicle)` for DMOC itself; two marks at given frames;
    ``options``: of `vehsim.plan`, such as ``fps``, ``cost``, ``limits``, ``solver``.
    """
    request = ask(t.vehicle, None, marks, **({"fps": 24} | options), segments=segments, refine=False)
    layout = Layout(t.sizes, (segments,))
    first, last = (mark.frame for mark in request.marks)
    lengths = np.array([float((last - first) / request.fps) / segments])  # type: ignore[operator]
    paths = [np.array(leg) for leg in legs_between(request.marks)]
    x = along_paths(t, layout, request.marks, paths, lengths, request.wind)
    lower, upper = variable_bounds(t, layout, [(lengths[0], lengths[0])], request.limits.joints)
    hold_adrift(t, layout, request, x, lower, upper)
    if isinstance(t, Collocation):
        unused = layout.velocity(np.arange(segments))
        lower[unused] = upper[unused] = x[unused]
    values = parameter_values(t, layout, request.marks, request.wind, request.clearance, request.weights)
    solver = Solver(build(t, layout, request, None), request.solver, request.max_iterations)
    solution = solver.solve(x, lower, upper, values)
    knots = np.arange(segments + 1)
    g, r, pi = (np.asarray(ca.DM(part)).T for part in t.split(ca.DM(solution.x[layout.knot(knots)])))
    c = (solution.x[layout.control(knots)] * t.control_scale[:, None]).T
    steps = np.repeat(lengths, segments)
    return Collocated(solution, g, c, executed(t.mechanics, g, r, pi, c, steps, request.wind))
