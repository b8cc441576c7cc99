"""Free rigid bodies: LIE Fig. 4 (errors and run times over steps), Fig. 3 (one large step), and a million steps.

Errors are means over runs and over one sample per second; a run whose state is not finite, or that strays a hundred
times too far, counts as a blow-up. Times are CPU times of one thread. All methods run in CasADi's interpreter and, for
one body, as machine code too: never one side compiled and the other not.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cache
from typing import Any

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from vehsim.errors import SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.fast.kernel import Kernel
from vehsim.integrators.phase import packed
from vehsim.integrators.references import reference_step
from vehsim.lie import SE3, SO3xR3
from vehsim.vehicles import Holonomic, State

STEPS = (0.5, 0.25, 0.125, 0.0625, 0.03125, 0.015625)
OURS = {
    "exp": (SE3, "exp", 2),
    "cay": (SE3, "cay", 2),
    "TLN": (SE3, "tln", 2),
    "order 4": (SE3, "exp", 4),
    "order 4 TLN": (SE3, "tln", 4),
    "SO(3)xR3 cay": (SO3xR3, "cay", 2),
    "SO(3)xR3 order 4": (SO3xR3, "cay", 4),
}
REFERENCES = {"RK2": "rk2", "implicit RK2": "implicit_rk2", "RK4": "rk4", "Lie-Newmark": "lie_newmark"}
MUJOCO = {f"MuJoCo {name}": name for name in ("Euler", "implicitfast", "RK4")}
METHODS = (*OURS, *REFERENCES, *MUJOCO)

Track = tuple[np.ndarray, np.ndarray, np.ndarray, float]
"""Positions (n + 1, 3), quaternions (n + 1, 4), body angular velocities (n + 1, 3), CPU seconds of the loop."""


@dataclass(eq=False)
class Body:
    """A free body: principal inertia (3,), mass, twist (6,) at the start, at the origin."""

    inertia: np.ndarray
    mass: float
    twist: np.ndarray

    @cache  # noqa: B019 twenty bodies live as long as the run; their expressions are built once
    def vehicle(self, group: Any) -> Holonomic:
        return Holonomic(name="body", group=group, inertia=(*self.inertia, *[self.mass] * 3), gravity=0.0)

    @cache  # noqa: B019 as `vehicle`
    def reference(self, name: str, compiled: bool) -> Kernel:
        return Kernel(reference_step(self.vehicle(SE3), REFERENCES[name]), compiled)

    def energy(self, states: np.ndarray) -> np.ndarray:
        """Energy, J, of states with momenta (6,) in columns 7 to 12."""
        kinetic: np.ndarray = np.sum(states[:, 7:13] ** 2 / np.array([*self.inertia, *[self.mass] * 3]), axis=1) / 2
        return kinetic

    def truth(self, times: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Straight line; Euler's equations by DOP853 to 1e-12."""

        def law(t: float, y: np.ndarray) -> np.ndarray:
            a, b, c, d, p, q, r = y
            I, J, K = self.inertia  # noqa: E741 the moments of inertia as in textbooks
            spin = (-b * p - c * q - d * r, a * p + c * r - d * q, a * q + d * p - b * r, a * r + b * q - c * p)
            return np.array([*(0.5 * s for s in spin), (J - K) / I * q * r, (K - I) / J * r * p, (I - J) / K * p * q])

        y0 = np.array([1.0, 0, 0, 0, *self.twist[:3]])
        y = solve_ivp(law, (0, times[-1]), y0, "DOP853", times, rtol=1e-12, atol=1e-12).y
        return times[:, None] * self.twist[3:], Rotation.from_quat(y[[1, 2, 3, 0]].T)


def random_bodies(count: int) -> list[Body]:
    rng, bodies = np.random.default_rng(2009), []
    while len(bodies) < count:
        inertia = rng.uniform(0.5, 2.0, 3)
        if 2 * inertia.max() < inertia.sum():  # a physically possible body
            twist = rng.standard_normal(6) * np.repeat([2.0, 1.0], 3)  # up to a turn per second
            bodies.append(Body(inertia, rng.uniform(0.5, 2.0), twist))
    return bodies


def run(body: Body, name: str, h: float, steps: int, compiled: bool = False) -> Track:
    """Run one method. Raises ``SolveError`` if one of our integrators cannot solve a step."""
    which = _ours if name in OURS else _reference if name in REFERENCES else _mujoco
    return which(body, name, h, steps, compiled)


def _ours(body: Body, name: str, h: float, steps: int, compiled: bool) -> Track:
    group, difference_map, order = OURS[name]
    integrator = Integrator(body.vehicle(group), h, difference_map, order, compiled=compiled)
    start, controls = packed(integrator.start(State(twist=body.twist), ())), np.zeros((steps + 1, 0))
    integrator.history(start, controls[:2000])  # build the expressions before measuring time
    begin = time.process_time()
    x = integrator.history(start, controls)
    return x[:, 4:7], x[:, 0:4], x[:, 7:10] / body.inertia, time.process_time() - begin


def _reference(body: Body, name: str, h: float, steps: int, compiled: bool) -> Track:
    kernel, x = body.reference(name, compiled), np.empty((steps + 1, 13))
    x[0] = [*SE3.identity, *body.twist]
    inputs = [x[:-1], *(np.broadcast_to(a, (steps, len(a))) for a in (np.array([h]), (), (), np.zeros(3)))]
    kernel.rows([a[: min(steps, 600)] for a in inputs], [x[1:][: min(steps, 600)]], carries=True)
    begin = time.process_time()
    kernel.rows(inputs, [x[1:]], carries=True)
    return x[:, 4:7], x[:, 0:4], x[:, 7:10], time.process_time() - begin


def mujoco_body(body: Body, integrator: str, h: float) -> tuple[Any, Any]:
    import mujoco

    inertia = " ".join(map(repr, body.inertia.tolist()))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{h}" integrator="{integrator}" gravity="0 0 0"/><worldbody><body><freejoint/>'
        f'<inertial pos="0 0 0" mass="{body.mass!r}" diaginertia="{inertia}"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[:] = [*body.twist[3:], *body.twist[:3]]
    return model, data


def _mujoco(body: Body, name: str, h: float, steps: int, compiled: bool) -> Track:
    import mujoco

    model, data = mujoco_body(body, MUJOCO[name], h)
    every, rows, clock = max(1, round(1 / h)), [], 0.0
    for k in range(steps + 1):
        if k % every == 0:
            rows.append([*data.qpos, *data.qvel[3:6]])
        if k % every == 0 and k + every <= steps:
            begin = time.process_time()
            mujoco.mj_step(model, data, every)
            clock += time.process_time() - begin
    q = np.repeat(np.array(rows), every, axis=0)[: steps + 1]  # only one sample per second is taken
    return q[:, 0:3], q[:, 3:7], q[:, 7:10], clock


def free_bodies(minutes: float, count: int) -> dict[str, Any]:
    """LIE Fig. 4: method -> step -> (position error m, rotation error rad, seconds per step, blow-ups)."""
    bodies, seconds = random_bodies(count), np.arange(1, int(minutes * 60) + 1, dtype=float)
    truths = [body.truth(seconds) for body in bodies]
    table: dict[str, Any] = {}
    for name in METHODS:
        table[name] = {}
        for h in STEPS:
            results = np.array([_errors(*pair, name, h, seconds) for pair in zip(bodies, truths, strict=True)])
            good = results[np.isfinite(results[:, 0])]
            mean = good.mean(axis=0).tolist() if len(good) else [None] * 3
            table[name][str(h)] = [*mean, len(results) - len(good)]
        print(
            name, {h: [f"{v:.2g}" if v is not None else "-" for v in row] for h, row in table[name].items()}, flush=True
        )
    return {"minutes": minutes, "count": count, "table": table, "steps": _step_times(bodies[0]), "newton": _newton()}


def _errors(body: Body, truth: Any, name: str, h: float, seconds: np.ndarray) -> tuple[float, float, float]:
    """Mean position error m and rotation error rad at whole seconds, and seconds per step; inf after a blow-up."""
    steps = round(seconds[-1] / h)
    try:
        position, quaternion, _, clock = run(body, name, h, steps)
    except SolveError:  # our integrators raise this instead of blowing up: it counts the same
        return np.inf, np.inf, np.nan
    at = np.minimum(np.round(seconds / h).astype(int), steps)
    p, q = position[at], quaternion[at]
    travelled = np.abs(p).max() if np.all(np.isfinite(p)) else np.inf
    if not np.all(np.isfinite(q)) or travelled > 100 * (1 + np.abs(truth[0]).max()):
        return np.inf, np.inf, clock / steps
    apart = (truth[1].inv() * Rotation.from_quat(q[:, [1, 2, 3, 0]])).magnitude()
    return float(np.linalg.norm(p - truth[0], axis=1).mean()), float(apart.mean()), clock / steps


def _step_times(body: Body) -> dict[str, list[float]]:
    """Seconds per step at h = 1/64: interpreted and as machine code, the best of five runs of 4096 steps."""

    def best(name: str, compiled: bool) -> float:
        return min(run(body, name, 1 / 64, 4096, compiled)[3] for _ in range(5)) / 4096

    return {name: [best(name, False), best(name, True)] for name in (*OURS, *REFERENCES)}


def _newton() -> dict[str, float]:
    """Step -> relative residual after one Newton iteration, TLN, the worst of ten bodies."""
    worst: dict[str, float] = {}
    for h in (1 / 24, 1 / 240, 1 / 1000):
        left = []
        for body in random_bodies(10):
            integrator = Integrator(body.vehicle(SE3), h, "tln")
            m = integrator.mechanics
            residual = m.segment["left"] - m.symbols["pi"]
            given = [m.symbols[n] for n in ("g", "pi", "z", "h")]
            newton = ca.solve(ca.jacobian(residual, m.symbols["z"]), residual)
            once = ca.substitute(residual, m.symbols["z"], m.symbols["z"] - newton)
            phase = integrator.advance(integrator.start(State(twist=body.twist), ()), np.zeros(0), np.zeros(0))
            gap = ca.Function("gap", given, [once])(phase.g, phase.pi, phase.z, h)
            left.append(float(ca.norm_2(gap)) / float(np.linalg.norm(phase.pi)))
        worst[f"{h:.4f}"] = max(left)
    return worst


def orbits(minutes: float) -> dict[str, Any]:
    """LIE Fig. 3, as numbers: one body at h = 0.5 s, final energy and angular momentum over the initial ones."""
    body = Body(np.array([0.8, 1.4, 2.0]), 1.0, np.array([1.0, 2.5, 0.5, 0.5, 0.2, 0.1]))
    ends: dict[str, Any] = {}
    for name in METHODS:
        w, start = run(body, name, 0.5, round(minutes * 120))[2][-1], body.twist[:3]
        energy = (body.inertia @ w**2) / (body.inertia @ start**2)
        spin = np.linalg.norm(body.inertia * w) / np.linalg.norm(body.inertia * start)
        ends[name] = [float(energy), float(spin)] if np.isfinite(energy) and energy < 1e3 else None
    return {"minutes": minutes, "ends": ends}


def long_runs(steps: int) -> dict[str, Any]:
    """Method -> relative oscillation and trend of energy, drift of angular momentum, over steps of 0.02 s."""
    body, rows = random_bodies(1)[0], {}
    for name, (group, difference_map, order) in OURS.items():
        integrator = Integrator(body.vehicle(group), 0.02, difference_map, order)
        x = integrator.history(packed(integrator.start(State(twist=body.twist), ())), np.zeros((steps + 1, 0)))
        g, pi = x[:, :7], x[:, 7:13]
        energy = np.sum(pi * pi / np.array([*body.inertia, *[body.mass] * 3]), axis=1) / 2
        R = Rotation.from_quat(g[:, [1, 2, 3, 0]])
        spin = R.apply(pi[:, :3])
        if group is SE3:  # on SE3 the whole momentum, about the world's origin, is conserved
            spin = spin + np.cross(g[:, 4:7], R.apply(pi[:, 3:]))
        trend = np.polyfit(np.arange(steps + 1), energy / energy[0], 1)[0] * steps
        drift = np.abs(spin - spin[0]).max() / np.linalg.norm(spin[0])
        rows[name] = [float(np.ptp(energy) / energy[0]), float(trend), float(drift)]
        print(name, rows[name], flush=True)
    return {"steps": steps, "rows": rows}
