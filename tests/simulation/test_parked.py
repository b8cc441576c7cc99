"""A vehicle in the plane that has come to rest costs no steps until its controls change."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from vehsim import World, load_vehicle, simulate
from vehsim.integrators.phase_integrator import PhaseIntegrator
from vehsim.vehicles import State
from vehsim.world.terrain.terrain import Terrain

GROUND = World(Terrain("flat", np.zeros((3, 3)), (-100, -100), (100, 100)))
HALT = np.array([0.0, 0.0, 0.0, 0.0])
STOPS = np.array([[400.0, 0, 0, 0.1], *[[0, 4000.0, 0, 0]] * 36])
"""Accelerates into a turn, and brakes until it stands: a row every quarter of a second."""


@pytest.fixture
def solved(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of steps that are solved."""
    counts: list[int] = []
    steps, advance = PhaseIntegrator.steps, PhaseIntegrator.advance

    def counted(self: Any, *solve: str) -> Any:
        run = steps(self, *solve)

        def count(x: Any, controls: Any, residual: Any) -> None:
            counts.append(len(residual))
            run(x, controls, residual)

        return count

    def one(self: Any, *arguments: Any) -> Any:
        counts.append(1)
        return advance(self, *arguments)

    monkeypatch.setattr(PhaseIntegrator, "steps", counted)
    monkeypatch.setattr(PhaseIntegrator, "advance", one)
    return counts


def test_car_that_stands_costs_no_steps(solved: list[int]) -> None:
    clip = simulate(load_vehicle("rally_car"), GROUND, duration=4)
    assert sum(solved) < 0.5 * len(clip)  # a block, by up to three solvers
    assert np.ptp(clip.positions, axis=0).max() < 1e-12


def test_car_under_a_pilot_that_stands_costs_no_steps(solved: list[int]) -> None:
    clip = simulate(load_vehicle("rally_car"), GROUND, lambda t, state: HALT, duration=2)
    assert sum(solved) < 2 * 0.3 * len(clip)  # every step is predicted first


@pytest.mark.parametrize("form", ["numbers", "function"])
def test_car_that_has_stopped_rests_until_its_throttle_opens(solved: list[int], form: str) -> None:
    car, duration = load_vehicle("rally_car"), 10.25
    table = np.concatenate([STOPS, [[600.0, 0, 0, 0]] * 5])
    at = np.linspace(0, duration, len(table))

    def law(t: float, state: State) -> np.ndarray:
        return np.array([np.interp(t, at, column) for column in table.T])

    clip = simulate(car, GROUND, table if form == "numbers" else law, duration=duration, start_frame=0)
    total = sum(solved)
    assert total < (1 if form == "numbers" else 2) * 0.85 * len(clip)
    woken = np.searchsorted(clip.times, at[-6])
    assert np.ptp(clip.positions[woken - 1000 : woken], axis=0).max() < 1e-7
    assert np.linalg.norm(clip.positions[-1] - clip.positions[woken]) > 0.3
    with pytest.MonkeyPatch.context() as patch:  # the same motion where no step is left out
        patch.setattr(PhaseIntegrator, "held", lambda *_: None)
        whole = simulate(car, GROUND, table if form == "numbers" else law, duration=duration, start_frame=0)
    np.testing.assert_allclose(clip.positions, whole.positions, atol=1e-6)


def test_motion_under_a_pilot_is_continued_across_a_rest() -> None:
    car = load_vehicle("rally_car")

    def law(t: float, state: State) -> np.ndarray:
        return np.array([600.0, 0, 0, 0]) if t > 1.5 else HALT

    once = simulate(car, GROUND, law, duration=2)
    for seconds in (0.5, 1.25):
        first = simulate(car, GROUND, law, duration=seconds)
        both = simulate(car, GROUND, law, duration=2, after=first)
        assert both.positions.tobytes() == once.positions.tobytes()
        assert both.joints.tobytes() == once.joints.tobytes()


def test_unstable_balance_does_not_rest() -> None:
    from vehsim.integrators.integrator import Integrator

    integrator = Integrator(load_vehicle("rally_car"), 1 / 240)
    size = sum(integrator.mechanics.sizes[:3]) + integrator.mechanics.sizes[2]
    shape = np.arange(size) % 2
    rates = {"grows": np.linspace(0, 3, 1025), "decays": -np.linspace(0, 3, 1025), "drifts": np.zeros(1025)}
    controls = np.zeros((1025, 4))
    held = {name: integrator.held(1e-10 * np.exp(rate)[:, None] * shape, controls) for name, rate in rates.items()}
    assert held["grows"] is None
    assert held["decays"] is not None and held["drifts"] is not None
    assert integrator.held(np.zeros((1025, size)), np.linspace(0, 1, 1025)[:, None] * np.ones(4)) is None
