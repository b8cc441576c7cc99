"""Figures of the papers, drawn as the papers draw them: LIE Fig. 3, SIN Figs. 4 and 6.

``python -m benchmarks.papers [lie3 | sin4 | sin6 ...]`` writes them to ``docs/papers/``, in under a minute, and prints
the numbers that `docs/papers.md` cites. LIE Figs. 4 and 5 are drawn by ``make bench-integrators``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks._figures import panels
from benchmarks.bodies import Body, run
from vehsim.sinusoids.algebra.feedback import car_triangular
from vehsim.sinusoids.canonical.fourier import steer_triangular
from vehsim.sinusoids.manoeuvres.families import family, outline
from vehsim.sinusoids.manoeuvres.picture import paint, portraits

OUT = Path(__file__).resolve().parents[1] / "docs" / "papers"
STEP, MINUTES = 0.5, 4
BODY = Body(np.array([0.8, 1.4, 2.0]), 1.0, np.array([1.0, 2.5, 0.5, 0.5, 0.2, 0.1]))


def lie3() -> None:
    """LIE Fig. 3: position, orientation, linear and angular velocity over time: truth, RK4, and ours, at h = 0.5 s."""
    steps, fine = round(60 * MINUTES / STEP), 64
    tracks = {
        "truth": run(BODY, "order 4", STEP / fine, steps * fine),
        "RK4": run(BODY, "RK4", STEP, steps),
        "ours (tln)": run(BODY, "TLN", STEP, steps),
    }
    rows = {}
    for name, (position, quaternion, omega, _) in tracks.items():
        every = len(position) // steps
        x, q, w = (a[:: max(every, 1)][: steps + 1] for a in (position, quaternion, omega))
        turned, times = Rotation.from_quat(q[:, [1, 2, 3, 0]]), STEP * np.arange(len(x))
        speed = np.gradient(x, times, axis=0)
        axis = turned.apply([0.0, 0.0, 1.0])
        spin = turned.apply(BODY.inertia * w)
        energy = np.sum(BODY.inertia * w**2, axis=1)
        tilt = np.degrees(
            np.arccos(np.clip(spin @ spin[0] / np.linalg.norm(spin, axis=1) / np.linalg.norm(spin[0]), -1, 1))
        )
        print(
            f"{name}: rotational energy at the end {energy[-1] / energy[0]:.3f} of the start; angular momentum "
            f"{np.linalg.norm(spin[-1]) / np.linalg.norm(spin[0]):.3f}, turned by at most {tilt.max():.1g} deg"
        )
        rows[name] = {
            "x [m]": (times, x),
            "third axis of R": (times, axis),
            "v [m/s]": (times, speed),
            "w [rad/s]": (times, w),
        }
    panels(OUT / "lie_fig_3.svg", f"A free body at h = {STEP} s, over {MINUTES} minutes", rows)


def sin4() -> None:
    """SIN Fig. 4: the states of the car over x, stage by stage, and the inputs over time."""
    goal = [0.0, 0.5, 0.0, 0.0]
    steering = steer_triangular(car_triangular(4.0), [-5.0, 1.0, 0.05, 1.0], goal)
    portraits(steering, [("x", name) for name in ("y", "theta", "phi")], OUT / "sin_fig_4.png")
    print(f"end error {np.abs(steering.states[-1] - goal).max():.1e}; stages {[s.label for s in steering.stages]}")


def sin6() -> None:
    """SIN Fig. 6: three ways to park in parallel, with one net motion."""
    change, start, goal = car_triangular(1.0), [0.0, 0.0, 0.0, 0.0], [0.0, -3.368, 0.0, 0.0]
    parks = [
        *family(change, start, goal, amplitudes=(2.5,), cycles=(1,), phases=(0.0,)),
        *family(change, start, goal, amplitudes=(1.1,), cycles=(5,), phases=(0.0,)),
        *family(change, start, goal, amplitudes=(2.4,), cycles=(1,), phases=(np.pi / 2,)),
    ]
    paint(parks, OUT / "sin_fig_6.png", footprints=[outline(1.6, 0.8, 0.3)])
    for name, park in zip(("one wide cycle", "five narrow cycles", "cosines"), parks, strict=True):
        print(
            f"{name}: width {np.ptp(park.states[:, 0]):.2f} m, effort {park.effort:.2f}, end error {park.end_error:.1e}"
        )


FIGURES = {"lie3": lie3, "sin4": sin4, "sin6": sin6}


def main() -> None:
    unknown = set(sys.argv[1:]) - set(FIGURES)
    if unknown:
        raise SystemExit(f"no figure {', '.join(unknown)}; choose from: {', '.join(FIGURES)}")
    OUT.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or FIGURES:
        print(f"{name}:")
        FIGURES[name]()


if __name__ == "__main__":
    main()
