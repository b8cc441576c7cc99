"""The integrators against their peers, in one run: LIE Figs. 3, 4 and 5, long runs, and speed against MuJoCo.

``python -m benchmarks.integrators`` writes ``RESULTS.md`` and figures beside this file. ``--quick`` takes a tenth of
everything. Errors are means over runs and over one sample a second; a run whose state is not finite, or whose kinetic
energy grew a hundredfold, counts as a blow-up.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from benchmarks._figures import loglog
from benchmarks.speed import speed, table_of
from vehsim.errors import SolveError
from vehsim.integrators import Integrator
from vehsim.integrators.references import reference_step
from vehsim.lie import SE3, SO3xR3
from vehsim.vehicles import Holonomic, State
from vehsim.vehicles.car import car

HERE = Path(__file__).parent
QUICK = "--quick" in sys.argv
MINUTES, BODIES, RUNS, LONG = (0.4, 3, 5, 100_000) if QUICK else (4.0, 20, 50, 1_000_000)
BODY_STEPS = (0.5, 0.25, 0.125, 0.0625, 0.03125, 0.015625)
CAR_STEPS = (0.2, 0.1, 0.05, 0.025, 0.0125)
CAR = {"mass": 1350.0, "wheel_inertia": 2.4, "yaw_inertia": 4100.0, "wheel_radius": 0.32, "wheelbase": 2.6}
OURS = {
    "exp": (SE3, "exp", 2),
    "cay": (SE3, "cay", 2),
    "TLN": (SE3, "tln", 2),
    "order 4": (SE3, "exp", 4),
    "SO(3)xR3 cay": (SO3xR3, "cay", 2),
    "SO(3)xR3 order 4": (SO3xR3, "cay", 4),
}
REFERENCES = {"RK2": "rk2", "implicit RK2": "implicit_rk2", "RK4": "rk4", "Lie-Newmark": "lie_newmark"}
MUJOCO = ("Euler", "implicitfast", "RK4")


@dataclass(eq=False)
class Body:
    """A random free body: principal inertia (3,), mass, twist (6,) at the start, at the origin."""

    inertia: np.ndarray
    mass: float
    twist: np.ndarray

    @cache  # noqa: B019 twenty bodies live as long as the run; their expressions are built once
    def vehicle(self, group: Any) -> Holonomic:
        return Holonomic(name="body", group=group, inertia=(*self.inertia, *[self.mass] * 3), gravity=0.0)

    def truth(self, times: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """Straight line; Euler's equations by DOP853 to 1e-12."""

        def law(t: float, y: np.ndarray) -> np.ndarray:
            q, w = y[:4], y[4:]
            spin = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
            return np.concatenate([spin, np.cross(self.inertia * w, w) / self.inertia])

        y0 = np.array([1.0, 0, 0, 0, *self.twist[:3]])
        y = solve_ivp(law, (0, times[-1]), y0, "DOP853", times, rtol=1e-12, atol=1e-12).y
        return times[:, None] * self.twist[3:], Rotation.from_quat(y[[1, 2, 3, 0]].T)


def random_bodies(count: int) -> list[Body]:
    rng, bodies = np.random.default_rng(2009), []
    while len(bodies) < count:
        inertia = rng.uniform(0.5, 2.0, 3)
        if 2 * inertia.max() < inertia.sum():  # a body that can exist
            twist = rng.standard_normal(6) * np.repeat([2.0, 1.0], 3)  # up to a turn a second
            bodies.append(Body(inertia, rng.uniform(0.5, 2.0), twist))
    return bodies


def run_ours(body: Body, name: str, h: float, steps: int) -> tuple[np.ndarray, np.ndarray, float]:
    group, difference_map, order = OURS[name]
    integrator = Integrator(body.vehicle(group), h, difference_map, order)
    phase = integrator.start(State(twist=body.twist), ())
    controls = np.zeros((steps + 1, 0))
    integrator._accumulate(phase, controls[:300])  # expressions are built outside the clock
    begin = time.perf_counter()
    g, _, _ = integrator._accumulate(phase, controls)
    return g[:, 4:7], g[:, 0:4], time.perf_counter() - begin


def run_reference(body: Body, name: str, h: float, steps: int) -> tuple[np.ndarray, np.ndarray, float]:
    loop = reference_step(body.vehicle(SE3), REFERENCES[name]).mapaccum(steps)
    x = np.concatenate([SE3.identity, body.twist])
    inputs = (x, np.full((1, steps), h), np.zeros((0, steps)), np.zeros((0, steps)), np.zeros((3, steps)))
    begin = time.perf_counter()
    states = np.vstack([x, np.asarray(loop(*inputs), float).T])
    return states[:, 4:7], states[:, 0:4], time.perf_counter() - begin


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


def run_mujoco(body: Body, name: str, h: float, steps: int) -> tuple[np.ndarray, np.ndarray, float]:
    import mujoco

    model, data = mujoco_body(body, name, h)
    # MuJoCo may order principal axes its own way: give the inertia's frame back
    assert np.allclose(model.body_iquat[1], [1, 0, 0, 0]) or np.allclose(
        np.sort(body.inertia), np.sort(model.body_inertia[1])
    )
    every = max(1, round(1 / h))
    rows, clock = [data.qpos.copy()], 0.0
    for _ in range(steps // every):
        begin = time.perf_counter()
        mujoco.mj_step(model, data, every)
        clock += time.perf_counter() - begin
        rows.append(data.qpos.copy())
    q = np.repeat(np.array(rows), every, axis=0)[: steps + 1]  # samples are taken once a second only
    return q[:, 0:3], q[:, 3:7], clock * steps / max(1, steps // every * every)


def errors_of(body: Body, run: Callable[..., Any], name: str, h: float, truth: Any) -> tuple[float, float, float]:
    """Mean position error m and rotation error rad at whole seconds, and seconds per step; infinite after a blow-up."""
    seconds, steps = int(MINUTES * 60), round(MINUTES * 60 / h)
    try:
        position, quaternion, clock = run(body, name, h, steps)
    except SolveError:  # ours says so instead of blowing up: counted alike
        return np.inf, np.inf, np.nan
    at = np.minimum(np.round(np.arange(1, seconds + 1) / h).astype(int), steps)
    p, q = position[at], quaternion[at]
    travelled = np.abs(p).max() if np.all(np.isfinite(p)) else np.inf
    if not np.all(np.isfinite(q)) or travelled > 100 * (1 + np.abs(truth[0]).max()):
        return np.inf, np.inf, clock / steps
    apart = (truth[1].inv() * Rotation.from_quat(q[:, [1, 2, 3, 0]])).magnitude()
    return float(np.linalg.norm(p - truth[0], axis=1).mean()), float(apart.mean()), clock / steps


def free_bodies(report: list[str]) -> dict[str, dict[float, tuple[float, float, float, int]]]:
    """LIE Fig. 4."""
    bodies = random_bodies(BODIES)
    seconds = np.arange(1, int(MINUTES * 60) + 1, dtype=float)
    truths = [body.truth(seconds) for body in bodies]
    methods: dict[str, tuple[Callable[..., Any], str]] = {name: (run_ours, name) for name in OURS}
    methods |= {name: (run_reference, name) for name in REFERENCES}
    methods |= {f"MuJoCo {name}": (run_mujoco, name) for name in MUJOCO}
    table: dict[str, dict[float, tuple[float, float, float, int]]] = {}
    for label, (run, name) in methods.items():
        table[label] = {}
        for h in BODY_STEPS:
            results = [errors_of(b, run, name, h, truth) for b, truth in zip(bodies, truths, strict=True)]
            good = np.array([r for r in results if np.isfinite(r[0])]).reshape(-1, 3)
            mean = good.mean(axis=0) if len(good) else np.array([np.nan] * 3)
            table[label][h] = (*map(float, mean), len(results) - len(good))  # type: ignore[assignment]
        print(
            label, {h: f"{v[0]:.1e} {v[1]:.1e} {v[2] * 1e6:.1f}us {v[3]}" for h, v in table[label].items()}, flush=True
        )
    for i, (what, unit) in enumerate((("position error", "m"), ("rotation error", "rad"))):
        report += ["", f"### {what} [{unit}], mean; in brackets blow-ups of {BODIES}", ""]
        report += table_of(
            ["method", *(f"h = {h}" for h in BODY_STEPS)],
            [[m, *(_cell(v[i], v[3]) for v in row.values())] for m, row in table.items()],
        )
        steps = {m: [(h, v[i]) for h, v in row.items()] for m, row in table.items()}
        loglog(
            HERE / "figures" / f"body_{what.split()[0]}.svg",
            f"Free body, {MINUTES:g} min: {what}",
            "step [s]",
            unit,
            steps,
        )
        cost = {m: [(v[2] * MINUTES * 60 / h * 1e3, v[i]) for h, v in row.items()] for m, row in table.items()}
        loglog(
            HERE / "figures" / f"body_{what.split()[0]}_cost.svg",
            f"Free body: {what} against run time",
            "run time [ms]",
            unit,
            cost,
        )
    return table


def cars(report: list[str]) -> dict[str, dict[float, tuple[float, float]]]:
    """LIE Fig. 5."""
    vehicle, rng = car(**CAR, half_track=0.77), np.random.default_rng(521)
    runs = []
    for _ in range(RUNS):
        a, b, w1, w2, p = rng.uniform((200, 0.05, 0.3, 0.3, 0), (1500, 0.5, 1.5, 1.5, 6.28))
        runs.append(
            (
                rng.uniform(1, 8),
                lambda t, a=a, b=b, w1=w1, w2=w2, p=p: np.column_stack([a * np.sin(w1 * t + p), b * np.cos(w2 * t)]),
            )
        )
    fine, coarsest = 0.0015625, CAR_STEPS[0]
    knots = np.arange(round(60 / coarsest) + 1) * coarsest

    def linear(law: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
        """The same controls for every step: knots at the coarsest, linear between."""
        table = law(knots)
        return lambda t: np.column_stack([np.interp(t, knots, column) for column in table.T])

    runs = [(speed, linear(law)) for speed, law in runs]
    seconds = np.arange(1, 61)

    def reference(method: str, h: float, speed: float, law: Callable[..., np.ndarray]) -> tuple[np.ndarray, float]:
        n = round(60 / h)
        t = np.arange(n + 1) * h
        c = law(t)
        loop = loops.setdefault((method, n), reference_step(vehicle, method).mapaccum(n))
        x = np.array([0, 0, 0, 0, 0, speed / CAR["wheel_radius"]])
        begin = time.perf_counter()
        states = np.asarray(loop(x, np.full((1, n), h), c[:-1].T, c[1:].T, np.zeros((3, n))), float).T
        clock = time.perf_counter() - begin
        return states[np.round(seconds / h).astype(int) - 1, :3], clock / n

    def ours(name: str, order: int, h: float, speed: float, law: Callable[..., np.ndarray]) -> tuple[np.ndarray, float]:
        integrator = Integrator(vehicle, h, name, order)
        c = law(np.arange(round(60 / h) + 1) * h)
        phase = integrator.start(State(twist=(0, speed, 0)), c[0])
        begin = time.perf_counter()
        g, _, _ = integrator._accumulate(phase, c)
        return g[np.round(seconds / h).astype(int), :3], (time.perf_counter() - begin) / (len(c) - 1)

    loops: dict[tuple[str, int], Any] = {}
    methods: dict[str, Callable[..., Any]] = {
        "exp": lambda h, v, f: ours("exp", 2, h, v, f),
        "TLN": lambda h, v, f: ours("tln", 2, h, v, f),
        "order 4": lambda h, v, f: ours("exp", 4, h, v, f),
        "RK2": lambda h, v, f: reference("rk2", h, v, f),
        "RK4": lambda h, v, f: reference("rk4", h, v, f),
    }
    truths = [reference("rk4", fine, v, f)[0] for v, f in runs]
    table: dict[str, dict[float, tuple[float, float]]] = {}
    for name, run in methods.items():
        run(CAR_STEPS[0], *runs[0])
        table[name] = {}
        for h in CAR_STEPS:
            results = [run(h, *one) for one in runs]
            error = np.mean(
                [np.linalg.norm((r[0] - t)[:, 1:], axis=1).mean() for r, t in zip(results, truths, strict=True)]
            )
            table[name][h] = float(error), float(np.median([r[1] for r in results]))
        print(name, {h: f"{v[0]:.1e} {v[1] * 1e6:.1f}us" for h, v in table[name].items()}, flush=True)
    rows = [[m, *(f"{v[0]:.1e}, {v[1] * 1e6:.1f}" for v in row.values())] for m, row in table.items()]
    report += ["", f"### Position error [m], mean of {RUNS} runs over one minute, and microseconds a step", ""]
    report += table_of(["method", *(f"h = {h}" for h in CAR_STEPS)], rows)
    lines = {m: [(h, v[0]) for h, v in row.items()] for m, row in table.items()}
    loglog(HERE / "figures" / "car_position.svg", "Car, one minute: position error", "step [s]", "m", lines)
    return table


def orbits(report: list[str]) -> None:
    """LIE Fig. 3, as numbers: one body at a large step, energy and angular momentum after four minutes."""
    body = Body(np.array([0.8, 1.4, 2.0]), 1.0, np.array([1.0, 2.5, 0.5, 0.5, 0.2, 0.1]))
    h, steps = 0.5, round(MINUTES * 60 / 0.5)
    ends = {name: _end_of_ours(body, name, h, steps) for name in OURS}
    ends |= {name: _end_of_reference(body, name, h, steps) for name in REFERENCES}
    ends |= {f"MuJoCo {name}": _end_of_mujoco(body, name, h, steps) for name in MUJOCO}
    start, rows = body.twist[:3], []
    for label, w in ends.items():
        if not np.all(np.isfinite(w)) or np.abs(w).max() > 1e3:
            rows.append([label, "blow-up", "blow-up"])
            continue
        energy = (body.inertia @ w**2) / (body.inertia @ start**2)
        spin = np.linalg.norm(body.inertia * w) / np.linalg.norm(body.inertia * start)
        rows.append([label, f"{energy:.3f}", f"{spin:.3f}"])
    title = f"### One body at h = {h} s for {MINUTES:g} minutes: energy and size of angular momentum, end over start"
    report += ["", title, "", *table_of(["method", "energy", "angular momentum"], rows)]


def _end_of_ours(body: Body, name: str, h: float, steps: int) -> np.ndarray:
    """Body angular velocity (3,) at the last knot."""
    group, difference_map, order = OURS[name]
    integrator = Integrator(body.vehicle(group), h, difference_map, order)
    phase = integrator.start(State(twist=body.twist), ())
    return integrator._accumulate(phase, np.zeros((steps + 1, 0)))[2][-1, :3] / body.inertia


def _end_of_reference(body: Body, name: str, h: float, steps: int) -> np.ndarray:
    step = reference_step(body.vehicle(SE3), REFERENCES[name])
    x = np.concatenate([SE3.identity, body.twist])
    for _ in range(steps):
        x = np.asarray(step(x, h, [], [], np.zeros(3)), float).ravel()
    return x[7:10]


def _end_of_mujoco(body: Body, name: str, h: float, steps: int) -> np.ndarray:
    import mujoco

    model, data = mujoco_body(body, name, h)
    mujoco.mj_step(model, data, steps)
    return data.qvel[3:6].copy()


def long_runs(report: list[str]) -> None:
    """Energy and momentum over a million steps."""
    body, rows = random_bodies(1)[0], []
    for name in OURS:
        group, difference_map, order = OURS[name]
        integrator = Integrator(body.vehicle(group), 0.02, difference_map, order)
        phase = integrator.start(State(twist=body.twist), ())
        g, _, pi = integrator._accumulate(phase, np.zeros((LONG + 1, 0)))
        xi = pi / np.array([*body.inertia, *[body.mass] * 3])
        energy = np.sum(pi * xi, axis=1) / 2
        R = Rotation.from_quat(g[:, [1, 2, 3, 0]])
        spin = R.apply(pi[:, :3])
        if group is SE3:  # there the whole of it, about the world's origin, is what is conserved
            spin = spin + np.cross(g[:, 4:7], R.apply(pi[:, 3:]))
        trend = np.polyfit(np.arange(LONG + 1), energy / energy[0], 1)[0] * LONG
        drift = np.abs(spin - spin[0]).max() / np.linalg.norm(spin[0])
        rows.append([name, f"{np.ptp(energy) / energy[0]:.1e}", f"{trend:.1e}", f"{drift:.1e}"])
        print(rows[-1], flush=True)
    report += [
        "",
        f"### {LONG:,} steps of 0.02 s: relative swing and trend of energy, drift of angular momentum at knots",
        "",
    ]
    report += table_of(["method", "energy swing", "energy trend", "momentum drift"], rows)


def claims(bodies: dict[str, Any], car_table: dict[str, Any]) -> list[list[str]]:
    """Every claim of LIE 3.3: yes or no, by how much."""
    coarse, fine = BODY_STEPS[0], BODY_STEPS[-1]
    lost = {name: sum(v[3] for v in row.values()) for name, row in bodies.items()}
    same = _time_at_error(bodies["SO(3)xR3 order 4"], 1), _time_at_error(bodies["RK4"], 1)
    newmark, ours = bodies["Lie-Newmark"][0.125][0], bodies["TLN"][0.125][0]
    h = CAR_STEPS[-1]
    rows = [
        [
            "no blow-up where RK4 fails",
            f"{lost['cay']} of ours (cay), {lost['RK4']} of RK4 over all steps",
            lost["cay"] == 0 < lost["RK4"],
        ],
        [
            "at a large step rotations stay near where RK4's do not",
            f"h = {coarse}: cay {bodies['cay'][coarse][1]:.2g} rad, RK4 {bodies['RK4'][coarse][1]:.2g} rad "
            f"({bodies['RK4'][coarse][3]} lost)",
            bodies["cay"][coarse][1] < bodies["RK4"][coarse][1],
        ],
        [
            "about twice RK4's efficiency: a step's time, small steps",
            f"cay {bodies['cay'][fine][2] * 1e6:.2f} us, RK4 {bodies['RK4'][fine][2] * 1e6:.2f} us a step",
            bodies["cay"][fine][2] * 1.5 < bodies["RK4"][fine][2],
        ],
        [
            "Newmark's position error is larger",
            f"h = 0.125: Lie-Newmark {newmark:.2g} m, TLN {ours:.2g} m",
            newmark > ours,
        ],
        [
            "the car at RK2's accuracy",
            f"h = {h}: exp {car_table['exp'][h][0]:.2g} m, RK2 {car_table['RK2'][h][0]:.2g} m",
            car_table["exp"][h][0] <= 1.2 * car_table["RK2"][h][0],
        ],
        [
            "... for half its time",
            f"exp {car_table['exp'][h][1] * 1e6:.2f} us, RK2 {car_table['RK2'][h][1] * 1e6:.2f} us a step",
            car_table["exp"][h][1] <= 0.6 * car_table["RK2"][h][1],
        ],
        [
            "(ours) order 4 beats RK4 at equal run time",
            f"rotation error 1e-3 in {same[0] * 1e3:.1f} ms, RK4 {same[1] * 1e3:.1f} ms",
            same[0] < same[1],
        ],
    ]
    return [[claim, "yes" if held else "no", measured] for claim, measured, held in rows]


def _time_at_error(row: dict[float, Any], i: int, error: float = 1e-3) -> float:
    """Run time s at which a method reaches an error, read off its log-log line."""
    points = sorted((v[i], v[2] * MINUTES * 60 / h) for h, v in row.items() if np.isfinite(v[i]))
    return float(np.exp(np.interp(np.log(error), *np.log(np.array(points).T)))) if points else np.inf


def _cell(value: float, lost: int) -> str:
    words = f"{value:.1e}" if np.isfinite(value) else "-"
    return f"{words} ({lost})" if lost else words


def main() -> None:
    bodies_part: list[str] = []
    car_part: list[str] = []
    rest: list[str] = []
    begin = time.perf_counter()
    bodies = free_bodies(bodies_part)
    car_table = cars(car_part)
    orbits(rest)
    long_runs(rest)
    speed(rest)
    seconds = time.perf_counter() - begin
    pictures = ["![](figures/body_position.svg) ![](figures/body_rotation.svg)"]
    pictures += ["![](figures/body_position_cost.svg) ![](figures/body_rotation_cost.svg)"]
    report = [
        "# Integrators, measured",
        "",
        f"`python -m benchmarks.integrators`, {seconds:.0f} s, one process, one machine; run times vary by a third.",
        "",
        "## The claims of LIE 3.3",
        "",
        *table_of(["claim", "held", "measured"], claims(bodies, car_table)),
        "",
        f"## Free rigid body, {MINUTES:g} minutes, {BODIES} random bodies (LIE Fig. 4)",
        *bodies_part,
        "",
        *pictures,
        "",
        "## Car (LIE Fig. 5)",
        *car_part,
        "",
        "![](figures/car_position.svg)",
        "",
        "## Orbits (LIE Fig. 3), long runs, speed",
        *rest,
    ]
    (HERE / "RESULTS.md").write_text("\n".join(report) + "\n", encoding="utf-8")
    print(f"wrote {HERE / 'RESULTS.md'}")


if __name__ == "__main__":
    main()
