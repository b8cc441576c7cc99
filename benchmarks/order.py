"""CPU time to a given error on rigid bodies, free and on a spring: methods that keep the structure, against RK4.

``python -m benchmarks.order [METHOD ...]`` prints one row for each method, or for those that are named; without names
it writes ``RESULTS.order.md`` beside this file. Each method runs on each body with the fewest whole steps per second
that reach the mean error (interpolated between `RATES`, then measured); all CPU times are of one thread.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from benchmarks.bodies import Body, random_bodies
from benchmarks.machine import heading
from benchmarks.splitting import BY_HAND
from vehsim.errors import SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.phase import packed
from vehsim.integrators.references import reference_step
from vehsim.lie import SE3, SO3, SO3xR3
from vehsim.vehicles import Nonholonomic, State

COUNT = 8
GRAVITY, STIFFNESS = 9.81, 20.0
"""m/s^2, and that of the spring, N/m."""
RATES = (1, 2, 3, 4, 6, 8, 11, 16, 23, 32, 45, 64, 91, 128, 181, 256)
"""Steps per second."""
METHODS: dict[str, tuple[Any, str, int]] = {
    "tln4, SO(3)xR3": (SO3xR3, "tln4", 2),
    "tln6, SO(3)xR3": (SO3xR3, "tln6", 2),
    "tln order 4 (Suzuki), SO(3)xR3": (SO3xR3, "tln", 4),
    "exp order 4 (Suzuki), SO(3)xR3": (SO3xR3, "exp", 4),
    "splitting (Blanes-Moan), SO(3)xR3": (SO3xR3, "splitting", 0),
    "RK4, SO(3)xR3": (SO3xR3, "rk4", 0),
    "RK4 by hand, SO(3)xR3": (SO3xR3, "rk4 by hand", 0),
    "tln4, SE(3)": (SE3, "tln4", 2),
    "tln order 4 (Suzuki), SE(3)": (SE3, "tln", 4),
    "RK4, SE(3)": (SE3, "rk4", 0),
}
"""Name -> group, difference map and order of composition; or an explicit method and 0."""
CODES = ("interpreted", "machine code")
GOALS = (("1e-3 rad", 1, 1e-3), ("1e-4 rad", 1, 1e-4), ("1e-3 m", 0, 1e-3))


@dataclass(eq=False)
class Hanging(Body):
    """A body on a spring of no length, from the world's origin to its point `END` in body axes, m; with weight."""

    END = np.array([0.3, -0.1, 0.5])

    @cache  # noqa: B019 eight bodies live as long as the run; their expressions are built once
    def vehicle(self, group: Any) -> Any:
        inertia = ca.DM([*self.inertia, *[self.mass] * 3])
        return Nonholonomic(
            name="body", group=group, lagrangian=lambda r, u, xi: ca.dot(xi, inertia * xi) / 2,
            potential_energy=lambda g, r: self._potential(SO3.matrix(g[:4]), g[4:7]),
        )  # fmt: skip

    def _potential(self, rotation: Any, position: Any) -> Any:
        return STIFFNESS / 2 * ca.sumsqr(position + rotation @ self.END) + GRAVITY * self.mass * position[2]

    def kick(self, q: Any, p: Any) -> Any:
        """Body torque and force in the world (6,)."""
        rotation = SO3.matrix(q)
        pull = -STIFFNESS * (p + rotation @ self.END)
        weight = ca.vertcat(0, 0, -GRAVITY * self.mass)
        return ca.vertcat(ca.cross(ca.SX(self.END), rotation.T @ pull), pull + weight)

    def energy(self, states: np.ndarray) -> np.ndarray:
        rotations = Rotation.from_quat(states[:, [1, 2, 3, 0]])
        stretch = states[:, 4:7] + rotations.apply(self.END)
        potential = STIFFNESS / 2 * np.sum(stretch**2, axis=1) + GRAVITY * self.mass * states[:, 6]
        return super().energy(states) + potential

    def truth(self, times: np.ndarray) -> tuple[np.ndarray, Rotation]:
        def law(t: float, y: np.ndarray) -> np.ndarray:
            q, p, w, v = y[:4], y[4:7], y[7:10], y[10:13]
            rotation = Rotation.from_quat(q[[1, 2, 3, 0]])
            pull = -STIFFNESS * (p + rotation.apply(self.END))
            torque = np.cross(self.END, rotation.inv().apply(pull)) - np.cross(w, self.inertia * w)
            spin = [-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))]
            return np.array([*(0.5 * s for s in spin), *v, *torque / self.inertia, *pull / self.mass - [0, 0, GRAVITY]])

        y0 = np.array([1.0, *[0.0] * 6, *self.twist])
        y = solve_ivp(law, (0, times[-1]), y0, "DOP853", times, rtol=1e-12, atol=1e-12).y
        return y[4:7].T, Rotation.from_quat(y[[1, 2, 3, 0]].T)


@dataclass(frozen=True)
class Problem:
    """Bodies that move for ``seconds``, and the methods compared on them."""

    title: str
    bodies: Sequence[Body]
    seconds: int
    methods: Sequence[str]

    @cached_property
    def truths(self) -> list[tuple[np.ndarray, Rotation]]:
        """Positions (n, 3) m and rotations of every body at whole seconds."""
        return [body.truth(np.arange(1, self.seconds + 1, dtype=float)) for body in self.bodies]


class Run:
    """One method on one body, interpreted or as machine code."""

    def __init__(self, body: Body, name: str, compiled: bool, seconds: int):
        group, self.map, self.order = METHODS[name]
        self.body, self.group, self.compiled, self.seconds = body, group, compiled, seconds
        self.vehicle = body.vehicle(group)
        self.by_hand = BY_HAND.get(self.map)
        if self.by_hand:
            kick = body.kick if isinstance(body, Hanging) else None
            self.kernel = Kernel(self.by_hand(body.inertia.tolist(), body.mass, kick), compiled)
        elif not self.order:
            self.kernel = Kernel(reference_step(self.vehicle, self.map), compiled)

    def __call__(self, rate: int) -> tuple[np.ndarray, float]:
        """States (n + 1, .) with the group element first and the body's momentum in columns 7 to 12; CPU seconds."""
        steps, h, inertia = rate * self.seconds, 1 / rate, np.array([*self.body.inertia, *[self.body.mass] * 3])
        if self.order:
            integrator = Integrator(self.vehicle, h, self.map, self.order, compiled=self.compiled)
            start, controls = packed(integrator.start(State(twist=self.body.twist), ())), np.zeros((steps + 1, 0))
            integrator.history(start, controls[:50])  # build the expressions before measuring time
            begin = time.process_time()
            return integrator.history(start, controls), time.process_time() - begin
        x = np.empty((steps + 1, 13))
        x[0] = [*self.group.identity, *(inertia if self.by_hand else 1.0) * self.body.twist]
        inputs = [x[:-1], *(np.broadcast_to(a, (steps, len(a))) for a in (np.array([h]), (), (), np.zeros(3)))]
        begin = time.process_time()
        self.kernel.rows(inputs, [x[1:]], carries=True)
        took = time.process_time() - begin
        x[:, 7:] *= 1.0 if self.by_hand else inertia
        return x, took


def measure(name: str, problem: Problem) -> Iterator[tuple[str, str, list[float]]]:
    """(goal, kind of code, [step s, CPU ms, error, largest relative change of energy]), means over the bodies."""
    bodies, truths = problem.bodies, problem.truths
    runs = {compiled: [Run(body, name, compiled, problem.seconds) for body in bodies] for compiled in (False, True)}
    curves = np.array([_curve(run, truth) for run, truth in zip(runs[True], truths, strict=True)])
    for goal, column, target in GOALS:
        for compiled in (False, True):
            rows = []
            for run, truth, curve in zip(runs[compiled], truths, curves, strict=True):
                rate = _rate_for(curve[:, column], target)
                states, took = run(rate)
                took = min(took, *(run(rate)[1] for _ in range(4)))
                energy = run.body.energy(states)
                change = float(np.abs(energy - energy[0]).max() / np.abs(energy).max())
                rows.append([1 / rate, took * 1e3, _errors(states, truth)[column], change])
            yield goal, CODES[compiled], np.mean(rows, axis=0).tolist()


def _curve(run: Run, truth: Any) -> list[tuple[float, float]]:
    curve = []
    for rate in RATES:
        try:
            curve.append(_errors(run(rate)[0], truth))
        except SolveError:
            curve.append((np.inf, np.inf))
    return curve


def _rate_for(errors: np.ndarray, target: float) -> int:
    """The fewest steps per second that reach the target, between the last of `RATES` that misses it and the next."""
    missed = np.flatnonzero(~(errors <= target))
    if not missed.size:
        return RATES[0]
    k = int(missed[-1])
    if k + 1 == len(RATES):
        return RATES[-1]
    share = np.log(errors[k] / target) / np.log(errors[k] / errors[k + 1]) if np.isfinite(errors[k]) else 1.0
    return int(np.ceil(RATES[k] * (RATES[k + 1] / RATES[k]) ** share))


def _errors(states: np.ndarray, truth: Any) -> tuple[float, float]:
    """Mean error of the position, m, and of the rotation, rad, at whole seconds."""
    x = states[:: (len(states) - 1) // len(truth[0])][1:]
    if not np.all(np.isfinite(x)):
        return np.inf, np.inf
    apart = (truth[1].inv() * Rotation.from_quat(x[:, [1, 2, 3, 0]])).magnitude()
    return float(np.linalg.norm(x[:, 4:7] - truth[0], axis=1).mean()), float(apart.mean())


def problems() -> list[Problem]:
    free = random_bodies(COUNT)
    hanging = [Hanging(body.inertia, body.mass, body.twist) for body in free]
    return [
        Problem("Free bodies", free, 60, tuple(METHODS)),
        Problem("Bodies on a spring", hanging, 20, [name for name in METHODS if name != "tln4, SE(3)"]),
    ]


def main() -> None:
    named = sys.argv[1:]
    unknown = [name for name in named if name not in METHODS]
    if unknown:
        raise SystemExit(f"no method {', '.join(unknown)}; choose from: {'; '.join(METHODS)}")
    head, lines, summaries = heading(), [], []
    for problem in problems():
        table = {name: list(measure(name, problem)) for name in problem.methods if not named or name in named}
        lines += [f"## {problem.title}", ""]
        for goal, _, _ in GOALS:
            lines += [
                f"### To a mean error of {goal}",
                "",
                "| method | step | CPU, interpreted | CPU, machine code | error reached | energy off by |",
                "|" + "---|" * 6,
            ]
            for name, rows in table.items():
                plain, built = (row for at, _, row in rows if at == goal)
                numbers = [f"{plain[0]:.3f} s", f"{plain[1]:.2f} ms", f"{built[1]:.2f} ms", f"{plain[2]:.1e}"]
                lines.append("| " + " | ".join([name, *numbers, f"{plain[3]:.0e}"]) + " |")
            lines.append("")
        if not named:
            summaries += summary(problem.title, table)
    print("\n".join([*head, *summaries, "", *lines]))
    if not named:
        heads = ["| bodies | goal | best implicit | splitting | RK4, SE(3), as in LIE | RK4, SO(3)xR3 | RK4 by hand |"]
        heads.append("|" + "---|" * 7)
        top = ["# Rigid bodies: CPU time to a given error", "", *head, *heads, *summaries, READING]
        path = Path(__file__).with_name("RESULTS.order.md")
        path.write_text("\n".join([*top, NOTE, "", *lines, DROPPED]), encoding="utf-8")


NOTE = f"""`make bench-order`. {COUNT} rigid bodies, up to a turn a second: free for 60 s, and hanging for 20 s with
their weight on a spring at a point of the body, whose pull turns and moves them. The error is the mean over whole
seconds; for each body the step is the largest that reaches it, at most {1 / RATES[0]:g} s. Every method runs in
CasADi's interpreter and as machine code. A row whose error exceeds its goal did not reach it with {RATES[-1]} steps per
second."""
READING = """
CPU time in ms, interpreted; as machine code; "-": not reached. *Splitting* is explicit: rotations about body axes,
whose flows are exact, composed to fourth order with the coefficients of Blanes and Moan; forces are kicks
(`benchmarks/splitting.py`). It conserves momentum exactly, and its error of energy does not grow, while that of RK4
does. *RK4, SE(3)* and *RK4, SO(3)xR3* integrate the general equations of motion, as `method = "integrate"` does;
*RK4 by hand* is written for such a body alone, as the splitting is. `tln4` and `tln6` keep the energy of free bodies to
round-off; with forces they are of second order. The splitting needs an inertia without coupling of rotation and
translation, and forces that depend on pose and time only: drag would need kicks of its own. It is a prototype, not an
integrator of vehsim. Free bodies: it takes a quarter of the time of RK4 to 1e-3 rad, interpreted, and as machine code
1.3 (by hand) to 2 times less. On a spring: interpreted 1.6 to 3 times less; as machine code 1.3 times less than the
general RK4, but 1.2 to 1.3 times more than RK4 by hand.
"""
DROPPED = """## Tried and dropped

- The exact Jacobian of the corrected increment, in place of that of `tln`: 918 instead of 759 instructions per step of
  `tln6` with three iterations, and slower at every step measured.
- Three iterations per step of `tln6` instead of five: 759 instead of 1,023 instructions, but the residual exceeds 1e-12
  from 0.06 s on, so that the steps are repeated.
- The formula for any group (`fourth`) on SO(3): 690 instead of 546 instructions per step.
- `tln6` as the flow between kicks: seven kicks and six solves of 1,023 instructions, where the whole step of the
  splitting has 1,440.
- Rotations of the splitting by rational functions (half-angles by a Pade approximant of the tangent, one division
  instead of a sine and a cosine): as machine code no faster (on a spring 0.19 ms to 1e-3 rad as before), interpreted
  1.4 times slower, and free bodies need shorter steps.
- Fewer kicks. A step has seven kicks, 18 rotations and six drifts; the kicks of a spring are a third of its
  instructions, so that to share one between neighbouring steps saves 5 %. Runge-Kutta-Nystrom coefficients of Blanes
  and Moan save stages only where the free motion between kicks is exact, and that of an asymmetric body takes elliptic
  functions or the rotations themselves. So as machine code RK4 written by hand stays ahead on a spring, by 1.2 to 1.3
  times; it does not keep the energy.
- The splitting as an integrator of vehsim: it has no drag, joints, constraints or added mass, and every shipped
  vehicle has some of them. `integrate` and the variational integrators take them all by one definition.
"""


def summary(title: str, table: dict[str, Any]) -> list[str]:
    """CPU time in ms, interpreted and as machine code, of ours and of RK4 in both coordinates."""
    goals = {goal: (goal,) for goal, _, _ in GOALS} | {"1e-3 rad and 1e-3 m": ("1e-3 rad", "1e-3 m")}
    splitting, *rivals = "splitting (Blanes-Moan), SO(3)xR3", "RK4, SE(3)", "RK4, SO(3)xR3", "RK4 by hand, SO(3)xR3"
    lines = []
    for name, parts in goals.items():
        cost = {
            method: [min(row[:2] for at, kind, row in rows if at in parts and kind == code)[1] for code in CODES]
            for method, rows in table.items()
            if all(
                row[2] <= 1.01 * target
                for at, _, row in rows
                for goal, _, target in GOALS
                if at == goal and at in parts
            )
        }
        implicit = [method for method in cost if method not in (splitting, *rivals)]
        best = min(implicit, key=lambda method: cost[method][1])
        cells = ["; ".join(f"{ms:.2f}" for ms in cost[m]) if m in cost else "-" for m in (best, splitting, *rivals)]
        lines.append(f"| {title.lower()} | {name} | {best}: {' | '.join(cells)} |")
    return lines


if __name__ == "__main__":
    main()
