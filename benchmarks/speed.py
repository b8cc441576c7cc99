"""Time of a step compared with MuJoCo's `mj_step` of a free body, in one run: called from Python, and 10,000 at
once."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

import vehsim
from vehsim.integrators import Integrator
from vehsim.vehicles import State

INERTIA, MASS, TWIST = (1300.0, 4700.0, 4200.0), 1900.0, (0.1, 0.2, 0.3, 1.0, 2.0, 3.0)
VEHICLES = {
    "helicopter": ((18639.0, 0.0, 0.01, 0.0), State(twist=TWIST)),
    "car": ((300.0, 0.01), State(twist=(0, 5.0, 0))),
}


def speed() -> dict[str, Any]:
    """Rows of CPU seconds per step: called in place, from state to state, in rollouts (including a clip), in its
    loop."""
    import mujoco

    rows: dict[str, Any] = {}
    for name in ("Euler", "RK4"):
        model, data = _mujoco_body(name)
        call = best(lambda m=model, d=data: [mujoco.mj_step(m, d) for _ in range(2000)]) / 2000
        loop = best(lambda m=model, d=data: mujoco.mj_step(m, d, 10_000)) / 10_000
        rows[f"MuJoCo {name}"] = [call, None, None, loop]
    gains: dict[str, Any] = {}
    for name, (controls, start) in VEHICLES.items():
        for compiled in (False, True):
            integrator = Integrator(vehsim.load_vehicle(name), 1 / 240, compiled=compiled)
            c = np.array(controls)
            label = f"{name}, machine code" if integrator.compiled else name
            rows[label] = _times(integrator, start, c)
            if integrator.compiled:
                gains[name] = _two_threads(integrator, start, c)
    print(rows, gains, flush=True)
    return {"rows": rows, "gains": gains}


def _times(integrator: Integrator, start: State, c: np.ndarray) -> list[float]:
    motion, state, table = integrator.stepper(start, c), integrator.step(start, c), np.tile(c, (10_001, 1))
    integrator.rollout(start, table)

    def from_state_to_state() -> None:
        after = state
        for _ in range(2000):
            after = integrator.step(after, c)

    phase = integrator.start(start, c)
    return [
        best(lambda: [motion.step() for _ in range(2000)]) / 2000,
        best(from_state_to_state) / 2000,
        best(lambda: integrator.rollout(start, table)) / 10_000,
        best(lambda: integrator._accumulate(phase, table)) / 10_000,
    ]


def _two_threads(integrator: Integrator, start: State, c: np.ndarray) -> list[float]:
    """Wall seconds per step of 1,000 vehicles side by side, 240 steps each, on one thread and on two."""
    fleets = [integrator.fleet([start] * 1000, c, threads=threads) for threads in (1, 2)]
    controls, walls = np.tile(c, (240, 1)), [np.inf, np.inf]
    for _ in range(15):  # in turns: on a shared machine, take the best of each
        for i, fleet in enumerate(fleets):
            begin = time.perf_counter()
            fleet.advance(controls)
            walls[i] = min(walls[i], time.perf_counter() - begin)
    return [wall / 240_000 for wall in walls]


def best(call: Callable[[], Any], times: int = 15) -> float:
    clocks = []
    for _ in range(times):
        begin = time.process_time()
        call()
        clocks.append(time.process_time() - begin)
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
