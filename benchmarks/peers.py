"""Other optimal-control tools on the same problems: Drake with SNOPT and IPOPT, CasADi with IPOPT and fatrop.

``python -m benchmarks.peers [PROBLEM ...]`` prints tables, for all problems or those named; without names it writes
``RESULTS.peers.md`` beside this file. Drake is the extra ``benchmarks``. Every tool gets the vehicle's continuous
equations of motion, derived from its one definition, in coordinates that its users would choose: positions, roll, pitch
and yaw, and velocities. From rest to rest in a given time, at the least squared controls. *Executed* is where the
controls end when an adaptive integrator (DOP853, 1e-10) executes them, from the goal.
"""

from __future__ import annotations

import math
import operator
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import vehsim
from benchmarks.collocated import begin
from benchmarks.machine import headed
from benchmarks.staged import Staged
from vehsim import Mark
from vehsim.integrators.continuous import equations_of_motion
from vehsim.lie import SO3xR3
from vehsim.planning.constraints.block import assemble, parameter_values, variable_bounds
from vehsim.planning.iterate import Iterate
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.solver import Solver
from vehsim.planning.problem.transcription import Transcription
from vehsim.vehicles import Control, Holonomic, Vehicle

Array = NDArray[np.float64]
REST, FPS = (0.0, 0.0, 0.0), 24
TOP = [
    "# Planning beside other tools, measured",
    "",
    "CPU time of the fastest of the others over ours: more than 1 means that ours is faster. *Total* compares with",
    "`vehsim.plan`, which also refines, executes and audits; *one solve* and *prebuilt* with one solve of ours, by",
    "IPOPT, as in plans, or by fatrop.",
    "",
    "| problem | Drake, total | CasADi, total | CasADi, total, one solve | CasADi Hermite-Simpson, prebuilt "
    "| CasADi shooting, prebuilt | the same over our fatrop |",
    "|---|---|---|---|---|---|---|",
]
EQUAL = [
    "At equal executed error: the fewest segments, of multiples of 4, with which the controls of a tool end at most so",
    "far from the goal, and its prebuilt solve. Drake is left out: it takes longer for what CasADi's Hermite-Simpson",
    "finds. The fastest of the others over ours, by IPOPT as in plans, and by the faster of IPOPT and fatrop:",
    "",
    "| problem | executed, off by at most (m) | over ours, IPOPT | over ours, the faster |",
    "|---|---|---|---|",
]
EQUAL_HEAD = [
    "| problem | executed, off by at most (m) | tool | segments | executed, off by (m) | prebuilt (ms) | cost |",
    "|---|---|---|---|---|---|---|",
]
HEAD = [
    "CPU times, s. *Total*: building the problem and the first solve, without imports. *Prebuilt*: the least of three",
    "further solves of the built problem from the same guess; *warm*: from the solution itself, ours by IPOPT with its",
    "multipliers, as in `vehsim live`, the others' without, by their defaults. `vehsim.plan` includes refinement, the",
    "execution of its controls and the audit in all three. `vehsim, one solve` is a single solve on the given segments",
    "at order 4 and nothing else, as the others' are, by IPOPT or, by stages, by fatrop. Drake and CasADi deliver a",
    "solution that nothing else checked. What flies is in balance at both ends; the controls of shooting, constant",
    "in a segment, are free there, so its cost is lower.",
    "",
    "| problem | tool | segments | total | prebuilt | warm | iterations | cost | executed, off by (m) |",
    "|---|---|---|---|---|---|---|---|---|",
]
DROPPED = """
## What the executed error is made of

The quadrotor at 32 segments ended 49 mm off until 2026-11-27, six times as far as shooting at equal segments. Its
controls jump from balance to full torque within two segments. Carried to the end, the errors of single segments showed
where it came from: of 37 mm along y, the angular rates of the first three segments made 36, rotations 1, velocities and
places less than 1. A torque that rises within a segment makes rates quadratic, so the gyroscopic force
`ad(xi)^T mu` quartic, which Simpson's rule integrates wrongly; under constant torques, as of shooting, it is quadratic.
Since they are integrated exactly for rates quadratic in time (`vehsim/planning/problem/simpson.py`), it ends 4.4 mm off
(shooting 8.6), at 48 segments 0.7 mm (12.9 before, shooting 1.7), at 64 0.7 mm (4.2, 0.9). Other goals: 0.07 to 0.23
of the error before at 32 segments, 0.18 to 0.28 at 64. Rotations to sixth order change it by less than 5 %.

With free controls at both ends for all, as shooting has them: 16 mm at 32 segments and 2.1 at 64 (20.7 and 0.9 before,
shooting 8.6 and 0.9), at a lower cost (12.6194, shooting 12.6399). So there shooting is nearer. Torques then jump from
rest, and gyroscopic forces act on rates of higher degree; what that would take is in `RESULTS.collocation.md`. Shooting
in balance at both ends, as ours: 11.8 mm and 1.0, at a higher cost (12.784, ours 12.681).

The car's problems are so small that IPOPT itself takes most of the time: of 4.3 ms for 7 iterations on 8 segments, the
problem's functions take 0.6 (fatrop 1.4 ms in all, shooting by fatrop 2.3).

## Totals in turn

First plans on a busy machine (loads of 3 to 19), medians of 3 to 20 in forked processes, in turn with the other tools;
CasADi's total over that of `vehsim.plan`:

| date | what changed | quadrotor | car | helicopter |
|---|---|---|---|---|
| 2026-11-26 | before | 0.93 to 0.97 | 0.65 to 0.69 | 0.91 to 0.92 |
| 2026-11-26 | easy problems are solved at once at order 4 | 1.07 to 1.18 | 0.85 | 1.8 to 1.9 |
| 2026-11-27 | guesses, marks and clips in fewer steps | 1.17 | 0.75 to 0.79 | |
| 2026-11-27 | chain rule through the middle, controls executed in blocks | 1.26 | 0.99 to 1.01 | 2.2 |
| 2026-11-27 | no velocities at the middle of the quadrotor's segments | 1.19 | 1.01 | |

Of the car's first plan (115 ms then), about 30 ms built the problem, 20 solved it, 11 were its guess, 10 the clip and
its certificate, 6 the execution and 6 the audit; what is left are many parts of 1 to 5 ms.

## Tried and dropped

- acados: it does not install from PyPI.
- The first solve at order 4 wherever it is slow, or on 16 segments: see `RESULTS.planning.md`.
- fatrop on the problems of `vehsim.plan`, without a structure by stages: no faster than IPOPT. By stages
  (`benchmarks/staged.py`) it is in the table: 1.3 to 1.4 times as fast as IPOPT for car and quadrotor, half as fast
  for the helicopter, where it reaches the optimum in 17 iterations and cannot lower the dual residual to 1e-8. Since
  our equations are implicit, a stage needs copies of the next state, which cost as much as MUMPS saves. Plans stay
  with IPOPT, which also starts from multipliers.
- Machine code of all derivatives (C, -O1), prebuilt, IPOPT and fatrop, ms: car 11.7 and 7.3 (interpreted 12.9 and
  10.8), quadrotor 23.6 and 17.3 (35.9 and 28.2), helicopter 47.8 and 101 (89.3 and 189). Compiling takes seconds.
- Where IPOPT's time goes (quadrotor, 38 ms): derivatives 14, MUMPS and its BLAS 15, the rest IPOPT's own vectors. Other
  orderings and scalings of MUMPS, SPRAL (five times slower), no scaling of the problem, other oracles of the barrier:
  within 10 %, but for `mu_oracle=loqo` on the quadrotor (0.78), which is slower for the helicopter.
  `fast_step_computation` saves 5 to 8 % and gives up the check of each linear solve.""".splitlines()


def quadrotor() -> Vehicle:
    """Drake's quadrotor: mass, arm, inertia and rotor constants of `pydrake.examples.QuadrotorPlant`."""
    arm, drag = 0.15, 0.0245

    def wrench(c: Any) -> Any:
        return ca.vertcat(
            arm * (c[1] - c[3]), arm * (c[2] - c[0]), drag * (c[0] - c[1] + c[2] - c[3]), 0, 0, ca.sum1(c)
        )

    rotors = tuple(Control(f"thrust {k}", 0.0, 5.0, scale=1.9, unit="N") for k in range(4))
    return Holonomic(
        name="quadrotor", group=SO3xR3, inertia=(1.5e-3, 2.5e-3, 3.5e-3, 0.775, 0.775, 0.775), controls=rotors,
        wrench=wrench,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Problem:
    """A vehicle from rest to rest: ``frame``, 1-based, start and goal in m, heading of the goal in deg."""

    vehicle: Vehicle
    frame: int
    start: tuple[float, float, float]
    goal: tuple[float, float, float]
    heading: float
    segments: int

    @property
    def seconds(self) -> float:
        return (self.frame - 1) / FPS

    @property
    def marks(self) -> list[Mark]:
        return [
            Mark(1, position=self.start, heading=0, velocity=REST),
            Mark(self.frame, position=self.goal, heading=self.heading, velocity=REST),
        ]

    @property
    def cost(self) -> dict[str, float]:
        """Effort alone, without what plans of the vehicle add."""
        return {"effort": 1.0, "smoothness": 0.0} | dict.fromkeys(self.vehicle.default_costs, 0.0)

    @property
    def scale(self) -> Array:
        return np.array([control.scale for control in self.vehicle.controls])

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Bounds of the controls over their scale."""
        ends = (np.array([getattr(c, end) for c in self.vehicle.controls]) for end in ("lower", "upper"))
        low, high = (end / self.scale for end in ends)
        return low, high

    @property
    def ends(self) -> tuple[Array, Array]:
        """States of start and goal."""
        root, yaw = self.vehicle.origin, np.radians(self.heading)
        if self.vehicle.group.planar:
            turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]) @ root[:2]
            tail = np.zeros(self.law.size1_in(0) - 3)
            return (
                np.concatenate([[0.0], np.array(self.start[:2]) + root[:2], tail]),
                np.concatenate([[yaw], np.array(self.goal[:2]) + turned, tail]),
            )
        rest = np.zeros(6)
        return np.concatenate([self.start, REST, rest]), np.concatenate([self.goal, [0, 0, yaw], rest])

    @property
    def joints(self) -> list[int]:
        """The joints of a vehicle in the plane that influence its motion, such as steering."""
        f = equations_of_motion(self.vehicle)
        given = [ca.SX.sym(f.name_in(k), f.size1_in(k)) for k in range(f.n_in())]
        g_dot, _, z_dot = f(*given)
        moved = ca.vertcat(g_dot, z_dot)
        return [i for i in range(given[1].numel()) if ca.depends_on(moved, given[1][i])]

    @property
    def state_bounds(self) -> tuple[Array, Array]:
        """Bounds of a state: those of the joints."""
        high = np.full(self.law.size1_in(0), np.inf)
        low = -high
        for k, joint in enumerate(self.joints if self.vehicle.group.planar else ()):
            low[3 + k], high[3 + k] = self.vehicle.joint_limits.get(self.vehicle.joints[joint], (-np.inf, np.inf))
        return low, high

    @property
    def fixed(self) -> Array:
        """Which state variables start and goal fix: all but joints."""
        joints = range(3, 3 + len(self.joints)) if self.vehicle.group.planar else range(0)
        return np.array([k not in joints for k in range(self.law.size1_in(0))])

    @property
    def balanced(self) -> bool:
        """Whether controls balance the vehicle at start and goal, as vehsim asks of what flies."""
        return not self.vehicle.group.planar

    @property
    def trim(self) -> Array:
        """Controls over their scale that keep the vehicle at rest at the start."""
        u = ca.SX.sym("u", len(self.scale))
        slope = ca.Function("slope", [u], [self.law(self.ends[0], u)])
        jacobian = ca.Function("jacobian", [u], [ca.jacobian(slope(u), u)])
        zero = np.zeros(len(self.scale))
        return np.linalg.lstsq(jacobian(zero).full(), -slope(zero).full().ravel(), rcond=None)[0]

    @property
    def law(self) -> ca.Function:
        """``(x, u) -> dx/dt``; ``u``: controls over their scale. In the plane, ``x`` holds yaw, place, the joints that
        matter and free velocities; in space position, roll, pitch and yaw, angular and linear velocity."""
        f = equations_of_motion(self.vehicle)
        u, still = ca.SX.sym("u", len(self.scale)), ca.SX.zeros(3)
        c, rates = u * self.scale, ca.SX.zeros(len(self.scale))
        if self.vehicle.group.planar:
            g, r, z = (ca.SX.sym(name, f.size1_in(k)) for k, name in enumerate(("g", "r", "z")))
            g_dot, r_dot, z_dot = f(g, r, z, c, rates, still)
            used = self.joints
            return ca.Function("law", [ca.vertcat(g, r[used], z), u], [ca.vertcat(g_dot, r_dot[used], z_dot)])
        x = ca.SX.sym("x", 12)
        angles, z = x[3:6], x[6:12]
        (cr, cp, cy), (sr, sp, sy) = (ca.vertsplit(of(angles / 2)) for of in (ca.cos, ca.sin))
        q = ca.vertcat(
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
        _, _, z_dot = f(ca.vertcat(q, x[:3]), ca.SX(0, 1), z, c, rates, still)
        roll, pitch = angles[0], angles[1]
        turning = ca.vertcat(
            z[0] + ca.tan(pitch) * (z[1] * ca.sin(roll) + z[2] * ca.cos(roll)),
            z[1] * ca.cos(roll) - z[2] * ca.sin(roll),
            (z[1] * ca.sin(roll) + z[2] * ca.cos(roll)) / ca.cos(pitch),
        )
        return ca.Function("law", [x, u], [ca.vertcat(z[3:6], turning, ca.simplify(z_dot))])

    def guess(self) -> tuple[Array, Array]:
        """States (n + 1, x) on the straight line, and trim controls (n + 1, u)."""
        first, last = self.ends
        share = np.linspace(0, 1, self.segments + 1)[:, None]
        return first + share * (last - first), np.tile(self.trim, (self.segments + 1, 1))

    def executed(self, x: Array, controls: Callable[[float], Array]) -> float:
        """Distance, m, from the goal at which the controls end, from a state ``x``."""
        last = self.ends[1]
        law, h = self.law, self.seconds / self.segments
        for k in range(self.segments):  # controls have kinks at knots
            span = (k * h, (k + 1) * h)
            run = solve_ivp(
                lambda t, x: law(x, controls(t)).full().ravel(), span, x, "DOP853", rtol=1e-10, atol=1e-10, max_step=h
            )
            x = run.y[:, -1]
        place = slice(1, 3) if self.vehicle.group.planar else slice(0, 3)
        return float(np.linalg.norm(x[place] - last[place]))


@dataclass(frozen=True)
class Result:
    """CPU times, s, and what was found."""

    total: float
    prebuilt: float
    warm: float
    iterations: int | str
    cost: float
    executed: float


def ours(problem: Problem) -> Result:
    """`vehsim.plan`, as users call it."""
    options: dict[str, Any] = {"fps": FPS, "segments": problem.segments, "cost": problem.cost, "character": "stunt"}

    def plan(**more: Any) -> Any:
        return vehsim.plan(problem.vehicle, None, problem.marks, **options, **more)

    made, total = timed(plan)
    prebuilt = min(timed(plan)[1] for _ in range(3))
    warm = min(timed(lambda: plan(guess=made.clip))[1] for _ in range(3))
    return Result(total, prebuilt, warm, made.iterations, made.cost, made.executed.final)


@dataclass(frozen=True, eq=False)
class Guess:
    """Our problem at order 4 on the given segments, with nothing built before, and its initial guess."""

    problem: Problem

    @cached_property
    def iterate(self) -> Iterate:
        transcription = Transcription(replace(self.problem.vehicle))  # a copy, for which nothing is built yet
        given = (self.problem.marks, self.problem.segments, 4)
        return begin(transcription, *given, fps=FPS, cost=self.problem.cost)[1]

    @cached_property
    def program(self) -> NonlinearProgram:
        return assemble(self.iterate.transcription, self.iterate.layout, self.iterate.blocks)

    @cached_property
    def arguments(self) -> tuple[Array, Array, Array, Array]:
        """Start, bounds and parameters of a solve."""
        bounds = variable_bounds(self.iterate, self.iterate.blocks)
        return self.iterate.x, *bounds, parameter_values(self.program, self.iterate, self.iterate.blocks)

    def executed(self, x: Array) -> float:
        """Distance, m, from the planned end at which the controls of a solution end."""
        return replace(self.iterate, x=x).run_controls().final


def ours_once(problem: Problem) -> Result:
    """One solve at order 4 on the given segments by IPOPT."""
    guess = Guess(problem)

    def build() -> Solver:
        solver = Solver(guess.program)
        solver.prepare("guess")
        return solver

    solver, built = timed(build)
    found, once = timed(lambda: solver.solve(*guess.arguments))
    prebuilt = min(timed(lambda: solver.solve(*guess.arguments))[1] for _ in range(3))
    again = (found.x, *guess.arguments[1:])
    warm = min(timed(lambda: solver.solve(*again, multipliers=found.multipliers))[1] for _ in range(3))
    return Result(built + once, prebuilt, warm, found.iterations, found.cost, guess.executed(found.x))


def ours_staged(problem: Problem) -> Result:
    """The same by fatrop, in its structure by stages (`benchmarks.staged`)."""
    guess = Guess(problem)

    def build() -> tuple[Staged, ca.Function]:
        staged = Staged(guess.program, guess.iterate.layout, guess.iterate.x)
        return staged, staged.solver()

    (staged, solver), built = timed(build)
    arguments = staged.given(*guess.arguments)
    found, once = timed(lambda: solver(**arguments))
    stats = solver.stats()
    prebuilt = min(timed(lambda: solver(**arguments))[1] for _ in range(3))
    again = arguments | {"x0": found["x"]}
    warm = min(timed(lambda: solver(**again))[1] for _ in range(3))
    verdict = stats["iter_count"] if stats["success"] else f"{stats['iter_count']}, not to 1e-8"
    executed = guess.executed(staged.back(found["x"].full().ravel()))
    return Result(built + once, prebuilt, warm, verdict, float(found["f"]), executed)


def casadi_simpson(problem: Problem) -> Result:
    """Hermite-Simpson in CasADi with IPOPT: states and controls at knots, controls linear between them."""
    n, h, law = problem.segments, problem.seconds / problem.segments, problem.law

    def build() -> Any:
        x0, x1, u0, u1 = (ca.SX.sym(name, law.size1_in(k)) for name, k in (("x0", 0), ("x1", 0), ("u0", 1), ("u1", 1)))
        f0, f1 = law(x0, u0), law(x1, u1)
        middle = law((x0 + x1) / 2 + h / 8 * (f0 - f1), (u0 + u1) / 2)
        defect = ca.Function("defect", [x0, x1, u0, u1], [x1 - x0 - h / 6 * (f0 + 4 * middle + f1)])
        x, u = ca.MX.sym("x", x0.numel(), n + 1), ca.MX.sym("u", u0.numel(), n + 1)
        rows = defect.map(n)(x[:, :-1], x[:, 1:], u[:, :-1], u[:, 1:])
        a, b = u[:, :-1], u[:, 1:]
        effort = h / 3 * (ca.sumsqr(a) + ca.dot(a, b) + ca.sumsqr(b))
        program = {"x": ca.veccat(x, u), "f": effort, "g": ca.vec(rows)}
        return ca.nlpsol("simpson", "ipopt", program, {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False})

    xs, us = problem.guess()
    low, high = _boxes(problem, n + 1, n + 1)
    start = np.concatenate([xs.ravel(), us.ravel()])
    return _measured(problem, build, start, low, high, 0.0, lambda v: v[xs.size :].reshape(n + 1, -1), linear=True)


def casadi_shooting(solver: str) -> Callable[[Problem], Result]:
    """RK4 multiple shooting in CasADi, variables stage by stage; controls are constant in a segment, free at ends."""

    def run(problem: Problem) -> Result:
        n, h, law = problem.segments, problem.seconds / problem.segments, problem.law
        size, count = law.size1_in(0), law.size1_in(1)

        def build() -> Any:
            x, u = ca.SX.sym("x", size), ca.SX.sym("u", count)
            a = law(x, u)
            b = law(x + h / 2 * a, u)
            c = law(x + h / 2 * b, u)
            d = law(x + h * c, u)
            step = ca.Function("step", [x, u], [x + h / 6 * (a + 2 * b + 2 * c + d)])
            xs = [ca.MX.sym(f"x{k}", size) for k in range(n + 1)]
            us = [ca.MX.sym(f"u{k}", count) for k in range(n)]
            first, last = problem.ends
            fixed = np.flatnonzero(problem.fixed)
            rows = [(xs[0] - first)[fixed]]
            variables = []
            for k in range(n):
                variables += [xs[k], us[k]]
                rows.insert(len(rows) - 1 if k == 0 else len(rows), xs[k + 1] - step(xs[k], us[k]))
            rows.append((xs[n] - last)[fixed])
            program = {"x": ca.veccat(*variables, xs[n]), "f": h * sum(map(ca.sumsqr, us)), "g": ca.veccat(*rows)}
            options: dict[str, Any] = {"print_time": False, "expand": True}
            if solver == "fatrop":
                options |= {"structure_detection": "auto", "equality": [True] * program["g"].numel()}
                options["fatrop"] = {"print_level": 0}
            else:
                options["ipopt"] = {"print_level": 0, "sb": "yes"}
            return ca.nlpsol("shooting", solver, program, options)

        xs, us = problem.guess()
        low, high = problem.bounds
        stages = [[state, control] for state, control in zip(problem.state_bounds, (low, high), strict=True)]
        lower, upper = (np.concatenate([*np.tile(np.concatenate(stage), (n, 1)), stage[0]]) for stage in stages)
        start = np.concatenate([np.hstack([xs[:-1], us[:-1]]).ravel(), xs[-1]])

        def controls(v: Array) -> Array:
            return v[:-size].reshape(n, size + count)[:, size:]

        return _measured(problem, build, start, lower, upper, 0.0, controls, linear=False)

    return run


def drake(solver: str) -> Callable[[Problem], Result]:
    """`DirectCollocation` of Drake: Hermite-Simpson, controls linear between knots."""

    def run(problem: Problem) -> Result:
        from pydrake.all import DirectCollocation, IpoptSolver, SnoptSolver, SymbolicVectorSystem, Variable

        law, (first, last), (low, high), trim = problem.law, problem.ends, problem.bounds, problem.trim
        h = problem.seconds / problem.segments
        xs, us = problem.guess()
        answer: dict[str, Any] = {}

        def build() -> Any:
            x = np.array([Variable(f"x{k}") for k in range(law.size1_in(0))])
            u = np.array([Variable(f"u{k}") for k in range(law.size1_in(1))])
            system = SymbolicVectorSystem(state=x, input=u, dynamics=evaluated(law, [*x], [*u]), output=x)
            made = DirectCollocation(system, system.CreateDefaultContext(), problem.segments + 1, h, h)
            program = made.prog()
            fixed = problem.fixed
            program.AddBoundingBoxConstraint(first[fixed], first[fixed], made.initial_state()[fixed])
            program.AddBoundingBoxConstraint(last[fixed], last[fixed], made.final_state()[fixed])
            for k in range(problem.segments + 1):
                at_end = problem.balanced and k in (0, problem.segments)
                program.AddBoundingBoxConstraint(*((trim, trim) if at_end else (low, high)), made.input(k))
                program.AddBoundingBoxConstraint(*problem.state_bounds, made.state(k))
            for k in range(problem.segments):
                a, b = made.input(k), made.input(k + 1)
                program.AddQuadraticCost(h / 3 * (a.dot(a) + a.dot(b) + b.dot(b)))
            for k in range(problem.segments + 1):
                program.SetInitialGuess(made.state(k), xs[k])
                program.SetInitialGuess(made.input(k), us[k])
            for k in range(problem.segments):
                program.SetInitialGuess(made.time_step(k), [h])
            answer["made"] = made
            return {"snopt": SnoptSolver, "ipopt": IpoptSolver}[solver]()

        def solve(tool: Any, start: Any) -> Any:
            program = answer["made"].prog()
            return tool.Solve(program, program.initial_guess() if start is None else start, None)

        tool, built = timed(build)
        found, once = timed(lambda: solve(tool, None))
        prebuilt = min(timed(lambda: solve(tool, None))[1] for _ in range(3))
        decided = found.GetSolution(answer["made"].prog().decision_variables())
        warm = min(timed(lambda: solve(tool, decided))[1] for _ in range(3))
        knots = np.array([found.GetSolution(answer["made"].input(k)) for k in range(problem.segments + 1)])
        verdict = "solved" if found.is_success() else str(found.get_solution_result()).rsplit(".", 1)[-1]
        executed = problem.executed(found.GetSolution(answer["made"].initial_state()), _linear(knots, h))
        return Result(built + once, prebuilt, warm, verdict, found.get_optimal_cost(), executed)

    return run


OPERATIONS: Mapping[int, Callable[..., Any]] = {
    ca.OP_ADD: operator.add,
    ca.OP_SUB: operator.sub,
    ca.OP_MUL: operator.mul,
    ca.OP_DIV: operator.truediv,
    ca.OP_NEG: operator.neg,
    ca.OP_SQ: lambda a: a * a,
    ca.OP_TWICE: lambda a: 2 * a,
    ca.OP_INV: lambda a: 1 / a,
    ca.OP_ASSIGN: lambda a: a,
}
"""CasADi's operations on Drake's expressions; its functions have the same names."""
FUNCTIONS = {ca.OP_SIN: "sin", ca.OP_COS: "cos", ca.OP_TAN: "tan", ca.OP_SQRT: "sqrt"}


def evaluated(function: ca.Function, *inputs: list[Any]) -> Array:
    """The first output of an SX function on Drake's expressions, instruction by instruction."""
    from pydrake import symbolic

    work: dict[int, Any] = {}
    out = np.full(function.numel_out(0), symbolic.Expression(0.0))
    for k in range(function.n_instructions()):
        code, into, given = function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_INPUT:
            work[into[0]] = symbolic.Expression(inputs[given[0]][given[1]])
        elif code == ca.OP_CONST:
            work[into[0]] = symbolic.Expression(function.instruction_constant(k))
        elif code == ca.OP_OUTPUT:
            out[into[1]] = work[given[0]]
        elif code in FUNCTIONS:
            work[into[0]] = getattr(symbolic, FUNCTIONS[code])(work[given[0]])
        else:
            work[into[0]] = OPERATIONS[code](*(work[i] for i in given))
    return out


def _boxes(problem: Problem, states: int, controls: int) -> tuple[Array, Array]:
    """Bounds of all states, then all controls, with both ends fixed."""
    first, last = problem.ends
    lower, upper = (np.tile(bound, (states, 1)) for bound in problem.state_bounds)
    for row, end in ((0, first), (-1, last)):
        lower[row, problem.fixed] = upper[row, problem.fixed] = end[problem.fixed]
    low, high = (np.tile(bound, (controls, 1)) for bound in problem.bounds)
    if problem.balanced:
        low[[0, -1]] = high[[0, -1]] = problem.trim
    return np.concatenate([lower.ravel(), low.ravel()]), np.concatenate([upper.ravel(), high.ravel()])


def _measured(
    problem: Problem,
    build: Callable[[], Any],
    start: Array,
    lower: Array,
    upper: Array,
    rows: float,
    controls: Callable[[Array], Array],
    linear: bool,
) -> Result:
    """The result of a CasADi solver on a built program."""
    solver, built = timed(build)

    def solve(x0: Array) -> Any:
        return solver(x0=x0, lbx=lower, ubx=upper, lbg=rows, ubg=rows)

    found, once = timed(lambda: solve(start))
    prebuilt = min(timed(lambda: solve(start))[1] for _ in range(3))
    x = found["x"].full().ravel()
    stats = solver.stats()
    warm = min(timed(lambda: solve(x))[1] for _ in range(3))
    h = problem.seconds / problem.segments
    knots = controls(x)
    law = _linear(knots, h) if linear else lambda t: knots[min(int(t / h + 1e-9), len(knots) - 1)]
    verdict = stats["iter_count"] if stats["success"] else stats["return_status"]
    return Result(
        built + once, prebuilt, warm, verdict, float(found["f"]), problem.executed(x[: problem.law.size1_in(0)], law)
    )


def _linear(knots: Array, h: float) -> Callable[[float], Array]:
    times = h * np.arange(len(knots))
    return lambda t: np.array([np.interp(t, times, column) for column in knots.T])


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """The result of ``work`` and its CPU time, s."""
    began = time.process_time()
    made = work()
    return made, time.process_time() - began


TOOLS: Mapping[str, Callable[[Problem], Result]] = {
    "vehsim.plan": ours,
    "vehsim, one solve": ours_once,
    "vehsim, one solve, fatrop": ours_staged,
    "CasADi Hermite-Simpson, IPOPT": casadi_simpson,
    "CasADi RK4 shooting, IPOPT": casadi_shooting("ipopt"),
    "CasADi RK4 shooting, fatrop": casadi_shooting("fatrop"),
    "Drake DirectCollocation, SNOPT": drake("snopt"),
    "Drake DirectCollocation, IPOPT": drake("ipopt"),
}
PROBLEMS: Mapping[str, Callable[[], Problem]] = {
    "quadrotor": lambda: Problem(quadrotor(), 73, (0, 0, 0), (4, 3, 2), 0, 32),
    "car": lambda: Problem(vehsim.load_vehicle("car_lie"), 145, (0, 0, 0), (25, 6, 0), 20, 64),
    "helicopter": lambda: Problem(vehsim.load_vehicle("helicopter_lie"), 121, (0, 0, 30), (40, 10, 35), 20, 32),
}


RULES = [tool for tool in TOOLS if tool.startswith(("vehsim, one", "CasADi"))]
"""The tools that are compared at equal executed error."""
WANTED: Mapping[str, tuple[float, ...]] = {"quadrotor": (1e-2, 1e-3), "car": (1e-5, 1e-6), "helicopter": (1e-2, 1e-3)}
"""Problem -> executed errors at most, m."""
GRID = range(16, 81, 4)
"""Numbers of segments that are tried for them."""


def main() -> None:
    named, lines, summary = sys.argv[1:], [], []
    equal: list[str] = []
    ratios: list[str] = []
    ours(Problem(vehsim.load_vehicle("two_wheeled"), 49, REST, (2, 0, 0), 0, 8))  # imports
    for name in named or PROBLEMS:
        problem, results = PROBLEMS[name](), dict[str, Result]()
        for tool, run in TOOLS.items():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made = results[tool] = run(problem)
            times = " | ".join(f"{value:.3f}" for value in (made.total, made.prebuilt, made.warm))
            lines.append(
                f"| {name} | {tool} | {problem.segments} | {times} | {made.iterations} | {made.cost:.4f} "
                f"| {made.executed:.1e} |"
            )
            print(lines[-1], flush=True)
        summary.append(compared(name, results))
        for error, found in reached(problem, WANTED[name]).items():
            equal += [
                f"| {name} | {error:g} | {tool} | {count} | {made.executed:.1e} | {made.prebuilt * 1e3:.1f} "
                f"| {made.cost:.4f} |"
                for tool, (count, made) in found.items()
            ]
            ratios.append(f"| {name} | {error:g} | {' | '.join(faster(found))} |")
    print("\n".join([*equal, *summary, *ratios]))
    if not named:
        page = [*TOP, *summary, "", *EQUAL, *ratios, "", *HEAD, *lines, "", *EQUAL_HEAD, *equal, *DROPPED]
        text = headed("\n".join(page) + "\n")
        Path(__file__).with_name("RESULTS.peers.md").write_text(text, encoding="utf-8")


def reached(problem: Problem, errors: Sequence[float]) -> dict[float, dict[str, tuple[int, Result]]]:
    """For every executed error, m, and every one of `RULES` that reaches it, the fewest segments and its result."""
    found: dict[float, dict[str, tuple[int, Result]]] = {error: {} for error in errors}
    for tool in RULES:
        for count in GRID:
            if all(tool in tools for tools in found.values()):
                break
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                made = TOOLS[tool](replace(problem, segments=count))
            for error, tools in found.items():
                if made.executed <= error:
                    tools.setdefault(tool, (count, made))
    return found


def faster(found: Mapping[str, tuple[int, Result]]) -> list[str]:
    """The prebuilt solve of the fastest of the others over ours by IPOPT, and over our faster one."""
    times = {tool: made.prebuilt for tool, (_, made) in found.items()}
    others = min((spent for tool, spent in times.items() if not tool.startswith("vehsim")), default=math.nan)
    ours = [times.get("vehsim, one solve", math.nan), min(v for k, v in times.items() if k.startswith("vehsim"))]
    return [f"{others / spent:.2f}" for spent in ours]


def compared(name: str, results: Mapping[str, Result]) -> str:
    """A line of the summary."""

    def least(words: str, what: str) -> float:
        return min(getattr(made, what) for tool, made in results.items() if tool.startswith(words))

    total, once = results["vehsim.plan"].total, results["vehsim, one solve"]
    ratios = [least("Drake", "total") / total, least("CasADi", "total") / total, least("CasADi", "total") / once.total]
    shooting, staged = least("CasADi RK4", "prebuilt"), results["vehsim, one solve, fatrop"]
    ratios += [least("CasADi Hermite", "prebuilt") / once.prebuilt, shooting / once.prebuilt]
    ratios.append(shooting / staged.prebuilt)
    return f"| {name} | {' | '.join(f'{ratio:.2f}' for ratio in ratios)} |"


if __name__ == "__main__":
    main()
