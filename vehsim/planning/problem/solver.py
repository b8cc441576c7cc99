"""The interface to NLP solvers: options, interrupts, and results."""

from __future__ import annotations

import math
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.planning.problem import interrupts
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.nlpsol import nlpsol

Array = NDArray[np.float64]

HURRIED = "time limit reached"
"""Status of a solve that was stopped by its deadline."""
LONGER = "give it a longer time_limit"
"""Remedies for a failed plan: the general one, and the one for a short time limit."""


@dataclass(frozen=True)
class Multipliers:
    """Lagrange multipliers of the variables' bounds ``x`` (size,) and of the constraints ``g`` (rows,).

    Their sign is CasADi's: positive at an upper bound.
    """

    x: Array
    g: Array
    cost: float
    """The cost of the motion they belong to."""


@dataclass(frozen=True)
class Solution:
    """The result of a solve: ``x`` (size,), its cost, largest constraint violation, and whether it met tolerances."""

    x: Array
    cost: float
    violation: float
    success: bool
    message: str
    iterations: int
    violations: Array
    multipliers: Multipliers | None = None
    out_of_time: bool = False
    """Whether its deadline stopped it."""
    unfinished: bool = False
    """Whether its `Patience` stopped it at a motion that counts as solved."""


Start = Literal["guess", "open", "plane", "space", "again", "motion", "multipliers", "draft"]
"""What a solve starts from: an initial guess; one in free space, in a character; such a one with given durations of a
body that no contact guides, in the plane or in space, begun again if it fails; the same guess with a larger active set;
a solved motion of another discretisation; such a motion with its multipliers; that of a draft with its multipliers,
when its marks moved."""

MET = 1e-6
"""Largest violation of a constraint that is met, in the problem's scaled units."""
DRAWN = 1e-4
"""The same for a draft, in which less cannot be seen."""
LEAST = 1e-3
"""Smallest magnitude of a cost by which it is divided."""
End = Literal["optimal", "content", "stiff", "near", "draft"]
"""When a solve ends: at the least cost; when all constraints are met and the cost hardly changes; so with stiff forces;
when they are met and the cost is nearly the least; or soon after that, within what can be seen."""
_CONTENT = {
    "acceptable_tol": 1e6,
    "acceptable_dual_inf_tol": 1e6,
    "acceptable_constr_viol_tol": MET,
    "acceptable_compl_inf_tol": 1e-4,
    "acceptable_obj_change_tol": 1e-4,
    "acceptable_iter": 15,
}
_SETTLED = {**_CONTENT, "acceptable_tol": 1e30, "acceptable_dual_inf_tol": 1e30, "acceptable_obj_change_tol": 1e-7}
"""A solve also ends where all constraints are met and the cost stays the same: if they depend on each other there,
their multipliers grow without end."""
_UNSCALED = {"mumps_scaling": 0, "mumps_permuting_scaling": 0}
"""No scaling of the linear systems."""
_NEAR = {
    "tol": 1e-4,
    "constr_viol_tol": MET,
    "dual_inf_tol": 1e3,
    "compl_inf_tol": 1e-3,
    # the first derivatives, by which it scales, take as long as half an iteration
    "nlp_scaling_method": "none",
    **_UNSCALED,
}
_CONVEX = {
    "first_hessian_perturbation": 1e-2,
    "perturb_inc_fact_first": 4.0,
    "perturb_inc_fact": 4.0,
    "perturb_dec_fact": 0.1,
}
"""Which multiples of the identity make a Hessian convex: IPOPT's own steps of a hundred go far beyond what is needed,
and its thirds take ten short steps to come down again."""
_ENDS: dict[End, dict[str, Any]] = {
    "optimal": {"tol": 1e-8, "constr_viol_tol": 1e-9, **_SETTLED},
    # near the earliest possible frame, the costs of a character fall slowly, and hardly any of it can be seen
    # and constraints may depend on each other: a boat that is held at rest balances three forces by one thrust
    "content": {
        "tol": 1e-8,
        "constr_viol_tol": 1e-9,
        "perturb_always_cd": "yes",
        # by minimum fill, a tenth faster than by minimum degree; so, a stunt on gravel was not refined
        "mumps_pivot_order": 2,
        **_CONVEX,
        **_CONTENT,
    },
    # perturbed constraints of stiff forces are missed by only 2 % less after each iteration
    "stiff": {"tol": 1e-8, "constr_viol_tol": 1e-9, **_CONVEX, **_CONTENT},
    "near": _NEAR,
    "draft": {**_NEAR, "constr_viol_tol": DRAWN, **_CONTENT},
}


EARLY = 8
"""Iterations after which it shows whether a solve goes well."""


@dataclass(frozen=True)
class Patience:
    """How long a solve is given: at ``most`` so many iterations, and after `EARLY` of them no constraint may be missed
    by more than ``early``, in the problem's scaled units. Where none is missed by more than ``near`` after the most, it
    is given half as many again: a few more iterations cost less than another solve.

    ``unfinished``: the largest such miss with which a motion counts as solved after these iterations. If it is not
    zero, the solve goes on until then.
    """

    most: float = math.inf
    early: float = math.inf
    near: float = 0.0
    unfinished: float = 0.0

    def ends(self, count: int, violation: float) -> bool:
        """Whether it ends with iteration ``count``, at which constraints are missed by ``violation``."""
        if count > self.most:
            if self.unfinished:
                return violation <= self.unfinished
            return count > 1.5 * self.most or violation > self.near
        return count == EARLY and violation > self.early


FIRST, FAR = 6, 3e-2
"""Iterations after which the curvature of constraints counts in full in the Hessian of a start in the "plane" or in
"space", and the largest violation with which it does before."""


def curvature(count: int, violation: float) -> float:
    """The share of the curvature of constraints in the Hessian at iteration ``count``, from 0, which misses them by
    ``violation``.

    Far from a motion, multipliers say little, and with them the Hessian is not convex: steps are short, and each is
    computed several times. Without them it is that of the costs, nearly a sum of squares if durations are given: a step
    of Gauss and Newton.
    """
    return FAR / violation if count < FIRST and violation > FAR else 1.0


ENDLESS = Patience()
NEARBY = 60
"""Maximum number of iterations from multipliers: if these mislead, the motion alone is the better start."""


def _warm(barrier: float, push: float) -> dict[str, Any]:
    """Options of a start from multipliers; ``push``: the smallest distance from bounds, which other ones that become
    active need."""
    pushes = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")
    return {
        "mu_strategy": "monotone",
        "mu_init": barrier,
        "warm_start_init_point": "yes",
        **{f"warm_start_{name}": push for name in pushes},
    }


# where the cost hardly depends on the pace, steps go far along a leg: they must reduce it, not only violations
# they are not refined, and their residuals not measured, which takes 6 % less; among obstacles it took a fifth more
# iterations
_OPEN = {
    "mu_strategy": "adaptive",
    "theta_min_fact": 1.0,
    "max_soc": 1,
    "fast_step_computation": "yes",
    **_UNSCALED,
}
# steps reduce a merit function, the cost and weighed violations, where IPOPT's filter takes those that reduce either:
# flights take a fifth less, boats a fifth more; without a restoration phase some solves fail
_MERIT = {**_OPEN, "line_search_method": "penalty"}
_BARRIERS: dict[Start, dict[str, Any]] = {
    "guess": {"mu_strategy": "adaptive"},
    "open": _OPEN,
    "plane": _OPEN,
    "space": _MERIT,
    "again": {"mu_strategy": "monotone", "mu_init": 3e-3},
    "motion": {"mu_strategy": "monotone", "mu_init": 1e-5},
    "multipliers": _warm(1e-6, 1e-9),
    "draft": _warm(1e-6, 1e-4),
}


def ipopt_options(
    max_iterations: int = 400, start: Start = "guess", end: End = "optimal", magnitude: float = 1.0
) -> dict[str, Any]:
    """Options of IPOPT with exact Hessians and MUMPS, without output; it divides the cost by its ``magnitude``."""
    return {
        "ipopt": {
            "max_iter": min(max_iterations, NEARBY) if start == "multipliers" else max_iterations,
            "mumps_pivot_order": 0,
            "print_level": 0,
            "sb": "yes",
            **_ENDS[end],
            **_BARRIERS[start],
            "obj_scaling_factor": 1 / magnitude,
        },
        "no_nlp_grad": True,  # not used; to make it takes longer than all the rest
    }


def sqp_options(
    max_iterations: int = 400, start: Start = "guess", end: End = "optimal", magnitude: float = 1.0
) -> dict[str, Any]:
    """Options of CasADi's own SQP method over the sparse QP solver it ships, convexified, without output."""
    quiet = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}
    return {
        "max_iter": max_iterations,
        "tol_pr": 1e-9,
        "tol_du": 1e-6,
        "convexify_strategy": "regularize",
        "qpsol": "qrqp",
        "qpsol_options": quiet | {"print_time": False},
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
    }


SOLVERS: dict[str, Callable[[int, Start, End, float], dict[str, Any]]] = {
    "ipopt": ipopt_options,
    "sqpmethod": sqp_options,
    "fatrop": lambda iterations, start, end, magnitude: {
        "fatrop": {"max_iter": iterations, "print_level": 0, "tol": 1e-8}
    },
}
"""NLP solver -> its options, as a function of the maximum number of iterations, the kind of start, the end, and the
magnitude of the cost."""

ACCEPTABLE, MAXIMUM = "Solved_To_Acceptable_Level", "Maximum_Iterations_Exceeded"
NO_NUMBER = "Invalid_Number_Detected"
PLAIN = {
    "Solve_Succeeded": "solved",
    ACCEPTABLE: "solved, nearly to the tolerance",
    MAXIMUM: "no solution within the iterations allowed",
    "Infeasible_Problem_Detected": "no motion nearby meets all constraints",
    "Restoration_Failed": "stuck: no step reduces the violations",
    "Search_Direction_Becomes_Too_Small": "stuck: no step reduces the violations",
    "Error_In_Step_Computation": "stuck: the equations became singular",
    NO_NUMBER: "a cost or constraint gave no number",
}
"""Solver status -> its explanation."""
STOPPED = {"User_Requested_Stop", "NonIpopt_Exception_Thrown"}
"""The solver's status when its callback stops it; the callback does so only at the time limit."""


def check_solver(name: str) -> str:
    """The name of a solver that this CasADi build has; raises ``InputError`` for others."""
    known = [solver for solver in SOLVERS if ca.has_nlpsol(solver)]
    if name not in known:
        raise InputError(
            "not available in this build of CasADi", f"choose one of {', '.join(known)}", key="solver", value=name
        )
    return name


class Solver:
    """A built problem that can be solved repeatedly from different starts, bounds and parameters.

    ``watch``: called with the number of completed iterations and the variables (size,); it may be changed between
    solves.
    """

    def __init__(
        self, problem: NonlinearProgram, plugin: str = "ipopt", max_iterations: int = 400, end: End = "optimal"
    ):
        self.problem, self.plugin, self.max_iterations, self.end = problem, plugin, max_iterations, end
        self.watch: Callable[[int, Array], None] | None = None
        self._bounds, self._lacked = problem.bounds, problem.lacked
        functions = problem.functions(differentiable=plugin != "ipopt")
        self._nlp = functions.pop("nlp")
        self._callback = _Callback(self, problem.size, len(self._bounds[0]), problem.parameters)
        self._own = {}  # the other plugins differentiate themselves
        if plugin == "ipopt":
            self._own = functions
        elif plugin == "sqpmethod":
            self._own = {"hess_lag": _whole(functions["hess_lag"])}
        self._solvers: dict[tuple[Start, float], ca.Function] = {}
        self._share = _Share(self._callback)

    def prepare(self, start: Start, magnitude: float = 1.0) -> ca.Function:
        """CasADi's solver for this kind of start and this ``magnitude`` of the cost, created on first use in
        milliseconds, since functions are shared."""
        if (start, magnitude) not in self._solvers:
            own = self._own
            if start in ("plane", "space") and self.plugin == "ipopt" and self.end == "content":
                own = {**own, "hess_lag": _shared(own["hess_lag"], self._share)}
            settings: dict[str, Any] = {
                **own,
                **SOLVERS[self.plugin](self.max_iterations, start, self.end, magnitude),
                "iteration_callback": self._callback,
                "print_time": False,
                "error_on_fail": False,
                "calc_lam_p": False,
                "show_eval_warnings": False,
            }
            self._solvers[start, magnitude] = nlpsol("plan", self.plugin, self._nlp, settings)
        return self._solvers[start, magnitude]

    def violations(self, g: Array) -> Array:
        """By how much constraints with values ``g`` (rows,) are missed, (rows,)."""
        lower, upper = self._bounds
        return np.asarray(np.maximum.reduce([lower - g, g - upper, np.zeros_like(g)]))

    def solve(
        self,
        x0: Array,
        lower: Array,
        upper: Array,
        parameters: Array,
        deadline: float = math.inf,
        start: Start = "guess",
        multipliers: Multipliers | None = None,
        patience: Patience = ENDLESS,
    ) -> Solution:
        """Solve from ``x0`` and optional ``multipliers`` until ``deadline`` s on the clock of `time.monotonic`."""
        g_lower, g_upper = self._bounds
        lower, upper, lacked = lower.copy(), upper.copy(), self._lacked
        lower[lacked] = upper[lacked] = x0[lacked]
        given, magnitude = {}, 1.0
        if multipliers is not None:
            given = {"lam_x0": multipliers.x, "lam_g0": multipliers.g}
            start = "multipliers"
            if self.end == "draft":  # the barrier is chosen for costs of about one
                start, magnitude = "draft", 10.0 ** round(math.log10(max(multipliers.cost, LEAST)))
        solver = self.prepare(start, magnitude)
        self._callback.begin(deadline, patience)
        with interrupts.silent():
            answer = solver(x0=x0, lbx=lower, ubx=upper, lbg=g_lower, ubg=g_upper, p=parameters, **given)
        stats = solver.stats()
        x, g = np.asarray(answer["x"]).ravel(), np.asarray(answer["g"]).ravel()
        if lacked.size:
            x[lacked] = np.asarray(self.problem.missing(x, parameters)).ravel()
        violations = self.violations(g)
        cost, status = float(answer["f"]), str(stats["return_status"])
        if status == NO_NUMBER:  # its constraints are reported as zero
            violations = np.full_like(g, math.inf)
        violation = float(violations.max(initial=0.0))
        if self.end != "optimal" and status == MAXIMUM and violation <= MET:
            status = ACCEPTABLE
        solved = bool(stats["success"]) or status == ACCEPTABLE
        unfinished = not solved and self._callback.tried and violation <= patience.unfinished
        if status in STOPPED and self._callback.tried and not self._callback.out_of_time:
            status = MAXIMUM
        return Solution(
            x=x,
            cost=cost,
            violation=violation,
            success=solved or unfinished,
            message=_plainly(status),
            iterations=int(stats.get("iter_count", 0)),
            violations=violations,
            multipliers=Multipliers(np.asarray(answer["lam_x"]).ravel(), np.asarray(answer["lam_g"]).ravel(), cost),
            out_of_time=self._callback.out_of_time,
            unfinished=unfinished,
        )


def _plainly(status: str) -> str:
    if status in STOPPED:
        return HURRIED
    return PLAIN.get(status, f"the solver ended with {status}")


def _whole(hessian: ca.Function) -> ca.Function:
    """The Hessian with both triangles."""
    arguments = [ca.MX.sym(name, *hessian.size_in(i)) for i, name in enumerate(hessian.name_in())]
    full = ca.triu2symm(hessian(*arguments))
    return ca.Function("hess_lag", arguments, [full], hessian.name_in(), ["hess_gamma_x_x"])


def _shared(hessian: ca.Function, share: ca.Function) -> ca.Function:
    """The Hessian with that ``share`` of the curvature of constraints."""
    x, p, cost, g = (ca.MX.sym(name, *hessian.size_in(i)) for i, name in enumerate(hessian.name_in()))
    values = [hessian(x, p, cost, share(cost) * g)]
    return ca.Function("hess_lag", [x, p, cost, g], values, hessian.name_in(), hessian.name_out())


class _Share(ca.Callback):
    """`curvature` at the current iterate of a solve, of which ``callback`` is told; its argument is not used."""

    def __init__(self, callback: _Callback):
        super().__init__()
        self._callback = callback  # it keeps no reference to the solver
        self.construct("share", {})

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        np.frombuffer(results[0])[:] = self._callback.curvature
        return 0


class _Callback(ca.Callback):
    """IPOPT's iteration callback: it reports the number of completed iterations and the variables."""

    def __init__(self, solver: Solver, x: int, g: int, p: int):
        super().__init__()
        self._sizes = {"x": x, "f": 1, "g": g, "lam_x": x, "lam_g": g, "lam_p": p}
        self._solver = weakref.ref(solver)
        self.begin(math.inf)
        self.construct("watch", {})

    def begin(self, deadline: float, patience: Patience = ENDLESS) -> None:
        """Reset the counter; stop when another iteration as long as the last would end after ``deadline``, or when
        ``patience`` ends."""
        self.patience, self.count, self.deadline = patience, 0, deadline
        self.before, self.out_of_time, self.tried = time.monotonic(), False, False
        self.curvature = 1.0

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_name_out(self, i: int) -> str:
        return "ret"

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        return ca.Sparsity.dense(self._sizes.get(ca.nlpsol_out(i), 0), 1)

    def has_eval_buffer(self) -> bool:
        return True  # a tenth of the time of arguments that CasADi converts

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        x, g = (np.frombuffer(arguments[i]) if arguments[i] else np.zeros(0) for i in (0, 2))
        self.count += 1
        solver = self._solver()
        try:
            if solver is not None and solver.watch is not None and not interrupts.interrupted():
                solver.watch(self.count, x.copy())
        except BaseException as error:
            interrupts.keep(error)
        now = time.monotonic()
        another, self.before = now - self.before, now
        self.out_of_time = now + another > self.deadline
        if solver is not None:
            violation = float(solver.violations(g).max(initial=0.0))
            self.tried = self.patience.ends(self.count, violation)
            self.curvature = curvature(self.count - 1, violation)
        np.frombuffer(results[0])[:] = interrupts.interrupted() or self.out_of_time or self.tried
        return 0
