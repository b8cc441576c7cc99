"""The shipped boat on calm water: its resistance over speed, and its turning circles, as figures for docs/vehicles.md.

``python -m benchmarks.boat`` writes ``boat_resistance.svg`` and ``boat_turns.svg`` beside that page and prints the
numbers of its tables. Resistance is that of simulations and plans; circles are simulated with the hull's mesh, from a
straight course at the same thrust.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

import vehsim
from vehsim.vehicles.definition.resistance import SpeedSpline

Array = NDArray[np.float64]

DOCS = Path(__file__).resolve().parents[1] / "docs"
SPEEDS = np.arange(2.0, 19.0, 2.0)
"""Speeds of the table, m/s."""
TURNS = ((4500.0, 6.0), (4500.0, 12.0), (3000.0, 14.0), (4500.0, 29.0))
"""Thrust, N, and steering, degrees, of the circles."""
THRUST = 4500.0
"""Full thrust, N."""
STEP, STRAIGHT = 1 / 48, 15.0
"""Step, and time on a straight course before the helm is put over, s."""
LONGEST = 60.0
"""Time of a turn, s."""


def on_calm_water(speeds: Array) -> tuple[Array, Array, Array]:
    """Resistance of the hull and of the air (n,) N, and trim (n,) degrees, at ``speeds`` (n,) m/s."""
    hull = vehsim.load_vehicle("boat").hull
    assert hull is not None and hull.windage is not None
    assert hull.running is not None and hull.running.trim is not None
    rate, trim = hull.running.rate, SpeedSpline.through(hull.running.speeds, np.degrees(hull.running.trim))
    air = [abs(float(ca.evalf(hull.windage(ca.DM([0, 0, 0, speed, 0, 0])))[3])) for speed in speeds]
    return np.array([speed * rate(speed) for speed in speeds]), np.array(air), np.array([trim(v) for v in speeds])


def turn(thrust: float, steering: float) -> vehsim.Clip:
    """From rest straight ahead, then with the helm over."""
    n = round((STRAIGHT + LONGEST) / STEP)
    helm = np.where(np.arange(n) * STEP < STRAIGHT, 0.0, np.radians(steering))
    controls = np.column_stack([np.full(n, thrust), helm])
    boat = vehsim.load_vehicle("boat")
    return vehsim.simulate(boat, vehsim.World(water=0.0), controls, duration=n * STEP, step=STEP)


def steady(clip: vehsim.Clip) -> tuple[float, float, Array]:
    """Mean speed, m/s, and radius, m, and the least and greatest lean into the turn, degrees, in its second half."""
    last = clip.times > clip.times[-1] - LONGEST / 2
    matrices = clip.matrices()[last]
    heading = np.unwrap(np.arctan2(matrices[:, 1, 0], matrices[:, 0, 0]))
    speed = np.linalg.norm(np.gradient(clip.positions[last, :2], clip.times[last], axis=0), axis=1).mean()
    rate = np.polyfit(clip.times[last], heading, 1)[0]
    lean = -np.degrees(np.arcsin(matrices[:, 2, 1])) * np.sign(rate)
    return float(speed), float(speed / abs(rate)), np.array([lean.min(), lean.max()])


def draw_resistance(axes: Any) -> None:
    speeds = np.linspace(0.0, 20.0, 161)
    resistance, air, trim = on_calm_water(speeds)
    axes.plot(speeds, resistance, "#1f5fa8", label="hull (Savitsky, ITTC 1957)")
    axes.plot(speeds, resistance + air, "#1f5fa8", ls="--", lw=1, label="hull and air")
    axes.axhline(THRUST, color="#2b8a57", lw=1, label="full thrust")
    axes.set(xlabel="speed [m/s]", ylabel="resistance [N]", xlim=(0, 20), ylim=(0, 5000))
    other = axes.twinx()
    other.plot(speeds, trim, "#c8442c", label="trim")
    other.set(ylabel="trim [degrees]", ylim=(0, 10))
    lines = [*axes.get_lines(), *other.get_lines()]
    axes.legend(lines, [line.get_label() for line in lines], loc="lower right", fontsize=8)
    axes.grid(alpha=0.3)


def draw_turn(axes: Any, clip: vehsim.Clip, label: str, colour: str) -> None:
    """The path from where the helm is put over, which is the origin, and the heading every two seconds."""
    start = int(np.searchsorted(clip.times, STRAIGHT))
    path = clip.positions[:, :2] - clip.positions[start, :2]
    shown = slice(max(start - 2 * round(1 / STEP), 0), None)
    axes.plot(path[shown, 0], path[shown, 1], color=colour, lw=1, label=label)
    ends = clip.matrices()[:, :2, 0]
    for k in range(start, len(path), round(2 / STEP)):
        keel = np.stack([path[k], path[k] + 6.3 * ends[k]])
        axes.plot(keel[:, 0], keel[:, 1], color=colour, lw=2.5, alpha=0.6)


def main() -> None:
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "boat", "svg.fonttype": "none", "font.size": 9})
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    draw_resistance(axes)
    figure.savefig(DOCS / "boat_resistance.svg", metadata={"Date": None})
    for speed, resistance, _, trim in zip(SPEEDS, *on_calm_water(SPEEDS), strict=True):
        print(f"{speed:g} m/s: {resistance:.0f} N, {trim:.1f} deg")

    figure, (wide, tight) = plt.subplots(1, 2, figsize=(8, 3.8), layout="constrained")
    for (thrust, steering), colour in zip(TURNS, ("#1f5fa8", "#c8442c", "#2b8a57", "#8a4fb0"), strict=True):
        clip = turn(thrust, steering)
        speed, radius, lean = steady(clip)
        print(f"{thrust:g} N, {steering:g} deg: {speed:.1f} m/s, radius {radius:.0f} m, lean {np.round(lean)} deg")
        draw_turn(wide if radius > 30 else tight, clip, f"{thrust:g} N, {steering:g} degrees", colour)
    for axis in (wide, tight):
        axis.set_aspect("equal")
        axis.set(xlabel="ahead [m]", ylabel="to port [m]")
        axis.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
        axis.grid(alpha=0.3)
    figure.savefig(DOCS / "boat_turns.svg", metadata={"Date": None})


if __name__ == "__main__":
    main()
