"""Time of a step against MuJoCo's `mj_step`, in one run: called from Python, in a loop, and a thousand side by side."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import vehsim
from vehsim.integrators import Integrator

from vehsim.vehicles import State

INERTIA, MASS, TWIST = (1300.0, 4700.0, 4200.0), 1900.0, (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)


def speed(report: list[str]) -> None:
    """Against mj_step in the same run."""
    import mujoco

    rows = []
    for name in ("Euler", "RK4"):
        model, data = _mujoco_body(name)
        call = _best(lambda m=model, d=data: [mujoco.mj_step(m, d) for _ in range(2000)]) / 2000
        loop = _best(lambda m=model, d=data: mujoco.mj_step(m, d, 10_000)) / 10_000
        rows.append([f"MuJoCo {name}, free body", f"{call * 1e6:.2f}", "", f"{loop * 1e6:.2f}", ""])
    for name, controls, start in (
        ("helicopter", (18639.0, 0.0, 0.01, 0.0), State(twist=(0.1, 0.2, 0.3, 1, 2, 3))),
        ("car", (300.0, 0.01), State(twist=(0, 5.0, 0))),
    ):
        integrator = Integrator(vehsim.load_vehicle(name), 1 / 240)
        c = np.array(controls)
        motion = integrator.motion(start, c)
        in_place = _best(lambda m=motion: [m.step() for _ in range(2000)]) / 2000
        state = integrator.step(start, c)
        call = _best(lambda i=integrator, s=state, c=c: [i.step(s, c) for _ in range(2000)]) / 2000
        phase = integrator.start(state, c)
        table = np.tile(c, (10_241, 1))
        loop = _best(lambda i=integrator, p=phase, t=table: i._accumulate(p, t)) / 10_240
        rows.append(
            [
                name,
                f"{in_place * 1e6:.2f}",
                f"{call * 1e6:.2f}",
                f"{loop * 1e6:.2f}",
                f"{_side_by_side(integrator, phase, c):.2f}",
            ]
        )
        print(rows[-1], flush=True)
    report += [
        "",
        "### Microseconds a step (best of 5); the last column is the gain of two threads over one, 1,000 vehicles",
        "",
    ]
    report += table_of(["", "call in place", "call from state to state", "in a loop of 10,000", "two threads"], rows)


def _side_by_side(integrator: Integrator, phase: Any, c: np.ndarray) -> float:
    """Gain of two threads over one on 1,000 vehicles side by side, 256 steps each."""
    chunk = _chunk(integrator.mechanics, 2, "advance_fast")
    n, steps = 1000, 256
    x = np.tile(_pack(phase)[:, None], n)
    inputs = (
        x,
        np.tile(c[:, None], n * steps),
        np.tile(c[:, None], n * steps),
        np.full((1, n * steps), 1 / 240),
        np.zeros((3, n * steps)),
    )
    serial, threads = chunk.map(n), chunk.map(n, "thread", 2)
    return _best(lambda: serial(*inputs), 3) / _best(lambda: threads(*inputs), 3)


def _best(call: Callable[[], Any], times: int = 5) -> float:
    clocks = []
    for _ in range(times):
        begin = time.perf_counter()
        call()
        clocks.append(time.perf_counter() - begin)
    return min(clocks)


def _mujoco_body(integrator: str) -> tuple[Any, Any]:
    import mujoco

    inertia = " ".join(map(repr, INERTIA))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{1 / 240}" integrator="{integrator}" gravity="0 0 0"/><worldbody><body><freejoint/>'
        f'<inertial pos="0 0 0" mass="{MASS}" diaginertia="{inertia}"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    data.qvel[:] = [*TWIST[3:], *TWIST[:3]]
    return model, data


def table_of(header: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return ["| " + " | ".join(line) + " |" for line in lines]
