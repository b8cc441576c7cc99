"""Cost of the water: all forces on the shipped boat, with MuJoCo's height field and rays, and with the waves' formula.

    python benchmarks/bench_buoyancy.py

CPU time of one core, both ways in turn in one process; set OMP_NUM_THREADS=1. Target: MuJoCo takes at most 1.35 times
as long.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

import vehsim
from vehsim.vehicles import State
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.sea import sea_state
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World

WATERS = {
    "calm": Water(),
    "one wave, 0.5 by 15 m": Water(surface=wave(0.5, 15.0)),
    "sharp wave, 0.5 by 8 m": Water(surface=wave(0.5, 8.0, choppiness=1.0)),
    "sea of 96 waves, 0.6 m": Water(surface=sea_state(0.6, 4.0)),
    "the same, choppy": Water(surface=sea_state(0.6, 4.0, choppiness=0.3)),
    "sea of 1 m": Water(surface=sea_state(1.0)),
    "sea of 4 m": Water(surface=sea_state(4.0)),
    "the same, choppy ": Water(surface=sea_state(4.0, choppiness=0.7)),
}


def milliseconds(asked: list[Callable[[int], object]], times: int = 300) -> list[float]:
    """Lower quartile of the CPU time of each call, made in turn."""
    spent = np.empty((times, len(asked)))
    for k in range(times):
        for j, question in enumerate(asked):
            begin = time.process_time_ns()
            question(k)
            spent[k, j] = time.process_time_ns() - begin
    return list(np.quantile(spent, 0.25, axis=0) / 1e6)


def sailing(water: Water) -> Callable[[int], object]:
    """All forces on a boat that is under way in ``water``."""
    afloat = Afloat(vehsim.load_vehicle("boat"), World(water=water))
    height = float(water.height([[0.0, 0.0]])[0])

    def forces(k: int) -> object:
        t = 0.01 * k
        state = State(
            position=np.array([5 * t, 0.0, height + 0.02]),
            orientation=np.array([0.999, 0.03, 0.03, 0.0]),
            twist=np.array([0.0, 0.0, 0.0, 5.0, 0.0, 0.0]),
        )
        return afloat.forces(t, state, np.zeros(2))

    return forces


def main() -> None:
    print("| water | MuJoCo | formula | ratio |\n|---|---|---|---|")
    for name, water in WATERS.items():
        rays, formula = milliseconds([sailing(water), sailing(replace(water, height_field=0))])
        print(f"| {name} | {rays:.2f} ms | {formula:.2f} ms | {rays / formula:.2f} |", flush=True)


if __name__ == "__main__":
    main()
