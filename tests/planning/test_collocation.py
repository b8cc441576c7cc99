"""DMOC compared with direct collocation of the same vehicle: two discretisations with the same optimum."""

import numpy as np
import pytest

import vehsim
from tests.audit_random.test_verifier import ROOT, load
from vehsim import Mark
from vehsim.planning.problem.transcription import transcribe

collocated = load(ROOT / "benchmarks" / "collocated.py")
SCHEMES, Collocation, solve = collocated.SCHEMES, collocated.Collocation, collocated.solve
REST = (0.0, 0.0, 0.0)
ORDER = {"dmoc": 2, "trapezoidal": 2, "hermite-simpson": 4}


def _solved(name, marks, counts, **options):
    vehicle = vehsim.load_vehicle(name)
    vehicle = vehicle.planar or vehicle
    ways = {"dmoc": transcribe(vehicle)} | {scheme: Collocation(vehicle, scheme) for scheme in SCHEMES}
    return {way: [solve(t, marks, n, **options) for n in counts] for way, t in ways.items()}


@pytest.mark.parametrize(
    ("name", "cost", "frame", "start", "goal", "counts", "near"),
    [
        ("car", "effort", 145, (0, 0, 0), (25, 6, 0), (32, 64), 2e-5),
        ("helicopter", "smoothness", 121, (0, 0, 30), (40, 10, 35), (32, 64), 1e-3),
    ],
)
def test_collocation_and_dmoc_find_the_same_optimum(name, cost, frame, start, goal, counts, near):
    marks = [
        Mark(1, position=start, heading=0, velocity=REST),
        Mark(frame, position=goal, heading=20, velocity=REST),
    ]
    solved = _solved(name, marks, counts, cost=cost)
    limits = {}
    for way, (coarse, fine) in solved.items():
        assert coarse.solution.success and fine.solution.success
        # the end of the executed controls converges at the order of the rule
        measured = np.log2(coarse.executed.final / fine.executed.final)
        assert measured > ORDER[way] - 0.3, (way, measured)
        assert np.isclose(measured, ORDER[way], atol=0.3) or way == "hermite-simpson"
        # controls linear between knots make every cost second order (Richardson)
        limits[way] = fine.solution.cost + (fine.solution.cost - coarse.solution.cost) / 3
    for way in SCHEMES:
        assert np.isclose(limits[way], limits["dmoc"], rtol=near), limits


def test_collocation_lets_quaternions_drift_and_dmoc_does_not():
    marks = [
        Mark(1, position=(0, 0, 30), heading=0, velocity=REST),
        Mark(121, position=(40, 10, 35), heading=20, velocity=REST),
    ]
    drift = {
        way: np.abs(np.linalg.norm(runs[0].g[:, :4], axis=1) - 1).max()
        for way, runs in _solved("helicopter", marks, (16,), cost="smoothness").items()
    }
    assert drift["dmoc"] < 1e-8
    assert drift["trapezoidal"] > 1e-4 and drift["hermite-simpson"] > 1e-7, drift


def test_a_program_written_by_hand_has_the_same_optimum():
    """Hermite-Simpson in CasADi alone, from the continuous equations, in other coordinates and from another guess."""
    peers = load(ROOT / "benchmarks" / "peers.py")
    for problem in (peers.PROBLEMS["car"](), peers.PROBLEMS["quadrotor"]()):
        ours, theirs, staged = (run(problem) for run in (peers.ours_once, peers.casadi_simpson, peers.ours_staged))
        assert np.isclose(ours.cost, theirs.cost, rtol=1e-5)
        assert ours.executed < 1.1 * theirs.executed
        # the same problem by another solver, with its variables and constraints in another order
        assert np.isclose(staged.cost, ours.cost, rtol=1e-9)
        assert np.isclose(staged.executed, ours.executed, rtol=1e-4, atol=1e-9)
