"""Cost of one evaluation of the water: the boat's hull (286 triangles) on calm water and on waves.

The height of the water comes from MuJoCo's rays or from the waves' own formula.

    python benchmarks/bench_buoyancy.py

CPU time of one core, median of many evaluations; set OMP_NUM_THREADS=1. Target: 200 us at 272 faces with only the
wheels installed.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import vehsim
from vehsim.vehicles import State
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.hull_mesh import wetted
from vehsim.world.water.sea import sea_state
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World

UP = np.array([0.0, 0.0, 1.0])


def microseconds(question: Callable[[], object], times: int = 400) -> float:
    """Median CPU time of a call."""
    spent = []
    for _ in range(times):
        begin = time.process_time_ns()
        question()
        spent.append(time.process_time_ns() - begin)
    return statistics.median(spent) / 1000


def main() -> None:
    boat = vehsim.load_vehicle("boat")
    state = State(position=np.array([0.0, 0.0, 0.02]), orientation=np.array([0.999, 0.03, 0.03, 0.0]))
    controls = np.zeros(2)
    waters = {
        "calm": Water(),
        "one wave": Water(surface=wave(0.5, 15.0)),
        "sea of 96 waves": Water(surface=sea_state(0.6, 4.0)),
        "sharp wave": Water(surface=wave(0.5, 8.0, choppiness=1.0)),
        "choppy sea": Water(surface=sea_state(0.6, 4.0, choppiness=0.3)),
    }
    for name, water in waters.items():
        for how, variant in (("MuJoCo", water), ("formula", replace(water, height_field=0))):
            afloat = Afloat(boat, World(water=variant))
            points, faces = afloat.mesh.points, afloat.mesh.faces

            def buoyancy(afloat: Afloat = afloat, points: np.ndarray = points, faces: np.ndarray = faces) -> None:
                height, _ = (afloat.field or afloat.water).at(points, 0.0)
                wet = wetted(np.column_stack([points, height - points[:, 2]]), faces)
                force = wet.middles[:, :, 3].reshape(-1, 1) * -np.repeat(wet.normals, 3, axis=0)
                wet.middles[:, :, :3].reshape(-1, 3).T @ force, force.sum(axis=0), wet.volume(UP)

            def everything(afloat: Afloat = afloat) -> object:
                return afloat.forces(0.0, state, controls)

            print(
                f"{name:16s} {how:8s} {len(faces):5d} faces: buoyancy {microseconds(buoyancy):5.0f} us, "
                f"all forces {microseconds(everything):5.0f} us"
            )


if __name__ == "__main__":
    main()
