"""Direct collocation of the same vehicles, for comparison with DMOC as in SYM and NH. No plan uses it.

Everything but the dynamics is the same as in DMOC: marks, costs, limits, initial guess, elements and solver. The
discrete mechanics are replaced by the continuous equations of motion, discretised by the trapezoidal rule (order 2) or
by the Hermite-Simpson rule (order 4; Hargraves and Paris 1987), with controls linear between knots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from vehsim.integrators.continuous import equations_of_motion
from vehsim.planning import solve as planning
from vehsim.planning.certificates import Executed
from vehsim.planning.constraints.block import Block
from vehsim.planning.constraints.clearance import cover_for
from vehsim.planning.guesses.routes import find_paths
from vehsim.planning.iterate import Iterate, Run
from vehsim.planning.problem.elements import Element
from vehsim.planning.problem.solver import Solution
from vehsim.planning.problem.transcription import Array, Transcription
from vehsim.planning.request.marks import Mark
from vehsim.planning.request.request import make_request
from vehsim.planning.trajectory import Trajectory
from vehsim.vehicles import Vehicle
from vehsim.vehicles.definition.mechanics import free_velocity
from vehsim.world.world import World


class Collocation(Transcription):
    """A vehicle's elements with collocated dynamics; ``scheme``: a name of `SCHEMES`."""

    def __init__(self, vehicle: Vehicle, scheme: str):
        super().__init__(vehicle)
        self.rule = SCHEMES[scheme]

    @cached_property
    def variational(self) -> Element:
        """Defects of a segment, with the variables and parameters of DMOC; the velocity ``z`` does not occur in
        them."""
        v = self.symbols("x", "z", "c0", "c1", "x1", "h")
        wind = ca.SX.sym("wind", 3)
        flow = self._flow
        c_rate = (v["c1"] - v["c0"]) / v["h"]

        def slope(x: Any, s: float) -> Any:
            return flow(x, v["c0"] + s * (v["c1"] - v["c0"]), c_rate, wind)

        middle = ca.SX.sym("middle", v["x"].shape[0])
        at, defect = self.rule(slope, v["x"], v["x1"], v["h"], middle)
        y = ca.vertcat(*v.values())
        return Element("dynamics", y, {"wind": wind}, g=defect, inner=[] if at is None else [(middle, at)])

    @property
    def _flow(self) -> ca.Function:
        """``(x, c, c_rate, wind) -> dx/dt`` of a node state, scaled like the variables."""
        m, v = self.mechanics, self.symbols("x", "c0")
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


def _trapezoidal(slope: Any, x: Any, x1: Any, h: Any, middle: Any) -> tuple[Any, Any]:
    return None, x1 - x - h / 2 * (slope(x, 0.0) + slope(x1, 1.0))


def _hermite_simpson(slope: Any, x: Any, x1: Any, h: Any, middle: Any) -> tuple[Any, Any]:
    first, last = slope(x, 0.0), slope(x1, 1.0)
    return (x + x1) / 2 + h / 8 * (first - last), x1 - x - h / 6 * (first + 4 * slope(middle, 0.5) + last)


SCHEMES = {"trapezoidal": _trapezoidal, "hermite-simpson": _hermite_simpson}
"""Scheme -> the state at the middle of a segment, if it needs one, and the defect, from the slopes at its fractions,
the states at its ends, its duration, and symbols of the state at the middle."""


@dataclass(frozen=True, eq=False)
class Collocated:
    """The result of one solve: ``g`` (n, size) at the knots, ``controls`` (n, c), and where they lead when executed."""

    solution: Solution
    g: Array
    controls: Array
    executed: Executed


@dataclass(frozen=True, eq=False)
class Unused(Block):
    """The velocities of segments, which do not occur in collocated dynamics, keep the values of the guess."""

    def bound(self, trajectory: Trajectory, lower: Array, upper: Array) -> None:
        unused = trajectory.layout.velocity(np.arange(trajectory.layout.segments))
        lower[unused] = upper[unused] = trajectory.x[unused]


def begin(
    transcription: Transcription,
    marks: Sequence[Mark],
    segments: int,
    order: int = 2,
    world: World | None = None,
    **options: Any,
) -> tuple[Run, Iterate]:
    """DMOC's initial guess on ``segments``, with the arguments of `solve`."""
    t = transcription
    request = make_request(
        t.vehicle, world, marks, **({"fps": 24, "character": "stunt"} | options), segments=segments, refine=False
    )
    run = Run(request, None)
    quiet = run.deadline.watched(None)
    paths = find_paths(request, None, quiet)
    guess = planning.begin(run, request, t, cover_for(request, paths, quiet), paths, coarse=False)
    blocks = (*guess.blocks, Unused()) if isinstance(t, Collocation) else guess.blocks
    return run, replace(guess, layout=replace(guess.layout, order=order), blocks=blocks)


def solve(
    transcription: Transcription, marks: Sequence[Mark], segments: int, *given: Any, **options: Any
) -> Collocated:
    """One solve on ``segments`` from DMOC's initial guess, without coarser or finer levels.

    ``transcription``: a `Collocation`, or `transcribe(vehicle)` for DMOC of an ``order``; two marks at given frames;
    then ``order``, ``world``, and options of `vehsim.plan`, such as ``fps``, ``cost``, ``limits``, ``solver``.
    """
    solved = planning.solve(*begin(transcription, marks, segments, *given, **options))
    assert solved.solution is not None
    g, _, _, c, _ = solved.knots()
    return Collocated(solved.solution, g, c, solved.run_controls())
