"""What one question to the water costs: the boat's hull (286 triangles) on calm water, on waves, and MuJoCo's rays.

    python benchmarks/bench_buoyancy.py

CPU time of one core, median of many questions; set OMP_NUM_THREADS=1. Issue 4 asks for 200 us at 272 faces with
nothing but wheels installed.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

import vehsim
from vehsim.vehicles import State
from vehsim.world import Water, World
from vehsim.world.buoyancy import Afloat
from vehsim.world.hull_mesh import wetted
from vehsim.world.sea import sea_state
from vehsim.world.water import wave
from vehsim.world.water_field import WaterField

UP = np.array([0.0, 0.0, 1.0])


def microseconds(question: Callable[[], object], times: int = 400) -> float:
    """Median CPU time of a question."""
    spent = []
    for _ in range(times):
        began = time.process_time_ns()
        question()
        spent.append(time.process_time_ns() - began)
    return statistics.median(spent) / 1000


def main() -> None:
    boat = vehsim.load_vehicle("boat")
    state = State(position=np.array([0.0, 0.0, 0.02]), orientation=np.array([0.999, 0.03, 0.03, 0.0]))
    controls = np.zeros(2)
    waters = {
        "calm": Water(),
        "one wave": Water(surface=wave(0.5, 15.0)),
        "sea of 96 waves": Water(surface=sea_state(0.6, 4.0)),
        "choppy sea": Water(surface=sea_state(0.6, 4.0, choppiness=0.3)),
    }
    for name, water in waters.items():
        afloat = Afloat(boat, World(water=water))
        points, faces = afloat.mesh.points, afloat.mesh.faces

        def buoyancy(afloat: Afloat = afloat, points: np.ndarray = points, faces: np.ndarray = faces) -> None:
            height, _ = afloat.water.at(points, 0.0)
            wet = wetted(np.column_stack([points, height - points[:, 2]]), faces)
            pressure = -wet.middles[:, :, 3, None] * wet.normals[:, None]
            (np.cross(wet.middles[:, :, :3], pressure).sum(axis=(0, 1)), pressure.sum(axis=(0, 1)), wet.volume(UP))

        def everything(afloat: Afloat = afloat) -> object:
            return afloat.forces(0.0, state, controls)

        print(
            f"{name:16s} {len(faces):5d} faces: buoyancy {microseconds(buoyancy):7.0f} us, "
            f"all forces {microseconds(everything):7.0f} us"
        )
    field = WaterField(waters["sea of 96 waves"], size=12.0, samples=97)
    field.update(1.0, (0, 0))
    xy = np.random.default_rng(0).uniform(-5, 5, (145, 2))
    print(f"MuJoCo: {microseconds(lambda: field.heights(xy), 100):.0f} us for 145 rays")
    print(f"MuJoCo: {microseconds(lambda: field.update(1.0, (0, 0)), 20):.0f} us to write 97 x 97 heights of 96 waves")


if __name__ == "__main__":
    main()
