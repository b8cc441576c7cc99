"""The four-wheel car against CommonRoad's multi-body model, below 0.7 g.

``python -m benchmarks.four_wheel_car`` runs both through the same manoeuvres with the parameters of vehicle 2 (BMW
320i) and prints the largest difference of yaw rate and lateral acceleration, as a share of the largest value; once
with tyres that are symmetric and do not feel camber, and once with the package's. Signals are compared as tests of
vehicles measure them, filtered as 49 CFR 571.126 S7.11 prescribes, and lateral acceleration also without the filter.
The multi-body model is the package's own code; install it first: ``pip install commonroad-vehicle-models==3.0.2``.

Five things make the comparison one of equal cars. The package's start is not at rest on its springs, so it first rolls
for three seconds, and starts from there without the weaving that the camber of its wheels gives it on a straight. It
balances moments about the centre of the sprung mass, so its axles are given the shares of their mass that leave the
centre of the whole car there. And it uses a tyre's camber coefficients, which hold for a y axis that points left, with
one that points right: ours have the other sign here. And it turns by the moments of the tyres' forces about a centre
that does not move when the body rolls and dives, although it moves the body sideways by the very roll: the moment about
the displaced centre is added, without which braking in a bend differs by 8 %. With the package's tyres a car that
stands upright is about to fall to either side, so both begin with the same small lean.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STEPS = 2400
"""Steps per second of our model."""
GRAVITY = 9.81


def ramp(times: Any, values: Any) -> Any:
    return lambda t: np.interp(t, times, values)


STILL = ramp([0], [0])


def step(rate: float) -> Any:
    """The steering wheel turned within 0.3 s, then held: a bend of constant radius."""
    return ramp([0.2, 0.21, 0.5, 0.51], [0, rate, rate, 0])


def slalom(rate: float) -> Any:
    return lambda t: rate * np.cos(3 * t)


def change(rate: float) -> Any:
    """A lane change: one period of a sine."""
    return lambda t: rate * np.cos(5 * t) * (t < 0.4 * np.pi)


LEAN = 0.002
"""Lean to the right at the start with tyres that push to the side to which they lean, rad."""
CUTOFF = 6.0
"""Of the filter of yaw rate and lateral acceleration, 12 poles without phase, Hz."""
SAMPLES = 400
"""Samples per second of what is compared."""

MANOEUVRES = {  # speed m/s, seconds, rate of the steering angle rad/s, acceleration wanted m/s^2
    **{f"bend, 15 m/s, {k}": (15.0, 3.0, step(0.22 * k), STILL) for k in (0.33, 0.67, 1)},
    **{f"bend, 25 m/s, {k}": (25.0, 3.0, step(0.08 * k), STILL) for k in (0.33, 0.67, 1)},
    **{f"slalom, 20 m/s, {k}": (20.0, 4.0, slalom(0.15 * k), STILL) for k in (0.33, 0.67, 1)},
    **{f"lane change, 30 m/s, {k}": (30.0, 4.0, change(0.16 * k), STILL) for k in (0.33, 0.67, 1)},
    "bend under power, 12 m/s": (12.0, 3.0, step(0.2), ramp([0], [2])),
    "bend under braking, 20 m/s": (20.0, 2.5, step(0.1), ramp([1, 1.2], [0, -3])),
    "bend to the right, 10 m/s": (10.0, 3.0, step(-0.35), STILL),
    "bend, 35 m/s": (35.0, 3.0, step(0.03), STILL),
    "quick slalom, 28 m/s": (28.0, 3.0, lambda t: 0.14 * np.cos(4.5 * t), STILL),
    "slow slalom, 12 m/s": (12.0, 5.0, lambda t: 0.14 * np.cos(2 * t), STILL),
    "lane change, 18 m/s": (18.0, 3.0, lambda t: 0.3 * np.cos(5 * t) * (t < 0.4 * np.pi), STILL),
    "bend to the right under braking, 28 m/s": (28.0, 2.5, step(-0.045), ramp([1, 1.2], [0, -2])),
    "bend under power, 18 m/s": (18.0, 3.0, step(0.07), ramp([0.5, 0.8], [0, 1.5])),
}


SHIFTS = ("hx1", "vx1", "hy1", "hy3", "vy1", "vy3", "dy3")
"""The coefficients of pure slip that make a tyre lopsided, or that its camber changes."""
COMBINED = ("hx1", "hy1", "by3", "vy1", "vy3")


def vehicle(symmetric: bool) -> Any:
    """Parameters of vehicle 2; its axles share their mass so that the whole car's centre is that of its body."""
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2

    p = parameters_vehicle2()
    axles = p.m - p.m_s
    p.m_uf, p.m_ur = axles * p.b / (p.a + p.b), axles * p.a / (p.a + p.b)
    if symmetric:
        for name in (*(f"p_{c}" for c in SHIFTS), *(f"r_{c}" for c in COMBINED)):
            setattr(p.tire, name, 0.0)
    return p


def in_roll(p: Any) -> tuple[list[float], list[float], list[float]]:
    """Stiffness in roll of the (front, rear) axle's springs and of its tyres, N m/rad, and how much of the body's roll
    is above the axle. The springs of our car hold its axles too, so they are stiffer by the axles' share."""
    tracks, torsion = (p.T_f, p.T_r), (-p.K_tsf, -p.K_tsr)
    sprung = p.m_s * p.h_s / (p.m_s * p.h_s + (p.m - p.m_s) * p.R_w)
    bodies = [(k * t**2 / 2 + bar) / sprung for k, t, bar in zip((p.K_sf, p.K_sr), tracks, torsion, strict=True)]
    tyres = [p.K_zt * t**2 / 2 for t in tracks]
    return bodies, tyres, [k / (k + body) for k, body in zip(tyres, bodies, strict=True)]


def our_car(p: Any) -> Any:
    """The four-wheel car with the parameters ``p`` of CommonRoad's vehicle; its springs include those of the tyres."""
    from vehsim.vehicles.models.four_wheel_car import four_wheel_car

    half, series = (p.T_f + p.T_r) / 4, lambda a, b: a * b / (a + b)
    springs = [series(k, p.K_zt) for k in (p.K_sf, p.K_sr)]
    (bodies, tyres, above), t = in_roll(p), p.tire
    return four_wheel_car(
        mass=p.m, yaw_inertia=p.I_z, roll_inertia=p.I_Phi_s, pitch_inertia=p.I_y_s, front=p.a, rear=p.b,
        half_track=half, mass_height=(p.m_s * p.h_s + (p.m - p.m_s) * p.R_w) / p.m, wheel_radius=p.R_w,
        wheel_inertia=p.I_y_w, engine_inertia=1e-3, springs=springs,
        dampers=[c * share**2 for c, share in zip((p.K_sdf, p.K_sdr), above, strict=True)],
        bars=[
            max(0.0, series(body, tyre) - 2 * k * half**2)
            for body, tyre, k in zip(bodies, tyres, springs, strict=True)
        ],
        drive_front=p.T_se, brake_front=p.T_sb, low_speed=0.5, scrub=0.0,
        camber_gains=[gain * share for gain, share in zip((p.D_f, p.D_r), above, strict=True)],
        tyre_camber=(-t.p_hy1, -t.p_hy3, -t.p_vy1, -t.p_vy3, t.p_dy3),
        tyre_slip_push=(-t.r_vy1, t.r_vy3),
    )  # fmt: skip


def ours(p: Any, name: str, lean: float) -> tuple[Array, Array, Array]:
    """Times, yaw rate and lateral acceleration of the centre of mass, from a ``lean`` to the right, rad."""
    from vehsim.integrators import Integrator
    from vehsim.vehicles import State

    speed, seconds, steer, wanted = MANOEUVRES[name]
    times = np.linspace(0, seconds, round(STEPS * seconds) + 1)
    car = our_car(p)
    at = {joint: k for k, joint in enumerate(car.joints)}
    rate = steer(times)
    delta = np.concatenate([[0], np.cumsum(np.diff(times) * (rate[1:] + rate[:-1]) / 2)])
    force = p.m * p.R_w * wanted(times)
    controls = np.column_stack([np.maximum(force, 0), np.maximum(-force, 0), 0 * times, rate / np.cos(delta) ** 2])
    joints = lean * (np.arange(len(car.joints)) == at["roll"])
    clip = Integrator(car, times[1]).rollout(State(twist=(0, speed, 0), joints=joints), controls)
    heave, pitch, roll = (clip.joints[:, at[name]] for name in ("heave", "pitch", "roll"))
    rising, pitching, rolling = (clip.joint_rates[:, at[name]] for name in ("heave", "pitch", "roll"))
    height = (p.m_s * p.h_s + (p.m - p.m_s) * p.R_w) / p.m + heave
    turn, along, across = clip.twists.T
    sway = across + turn * height * pitch - height * rolling - rising * roll
    surge = along + turn * height * roll + height * pitching + rising * pitch
    return times, turn, np.gradient(sway, times) + turn * surge


def theirs(p: Any, name: str, lean: float) -> tuple[Array, Array, Array]:
    """The same of the multi-body model: of the centre of its body and two axles."""
    from scipy.integrate import solve_ivp
    from vehiclemodels.init_mb import init_mb
    from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

    speed, seconds, steer, wanted = MANOEUVRES[name]

    masses, places = np.array([p.m_s, p.m_uf, p.m_ur]) / p.m, [10, 15, 20]

    def right(t: float, x: Array) -> list[float]:
        rates = vehicle_dynamics_mb(list(x), [float(steer(t)), float(wanted(t))], p)
        along, across = rates[3] - x[5] * x[10], masses @ np.take(rates, places) + x[5] * x[3]  # forces over mass
        aside, ahead = (x[27] + x[28]) / 2, -p.h_s * x[8]  # of the body's centre, from the axles
        rates[5] += p.m_s * (aside * along - ahead * across) / p.I_z
        return rates

    times = np.linspace(0, seconds, round(SAMPLES * seconds) + 1)
    options = {"method": "LSODA", "rtol": 1e-6, "atol": 1e-8, "max_step": 0.002}
    start, coast = init_mb([0, 0, 0, speed, 0, 0, 0], p), lambda t, x: vehicle_dynamics_mb(list(x), [0.0, 0.0], p)
    settled = solve_ivp(coast, (0, 3), start, **options).y[:, -1]
    settled[[1, 4, 5, 6, 7, 10, 13, 14, 15, 18, 19, 20, 27, 28]] = 0.0  # sideways, turns, rolls
    settled[6] = -lean  # rolls to its right, as z points down
    for above, roll, aside, height, axis in zip(
        in_roll(p)[2], (13, 18), (27, 28), (16, 21), (p.h_raf, p.h_rar), strict=True
    ):
        settled[roll] = -lean * (1 - above)
        settled[aside] = -lean * (p.h_s - p.R_w + settled[height] - settled[11] - (axis - p.R_w) * above)
    x = solve_ivp(right, (0, seconds), settled, t_eval=times, **options).y
    sideways = [masses @ np.take(right(t, row), places) + row[5] * row[3] for t, row in zip(times, x.T, strict=True)]
    return times, x[5], np.array(sideways)


def filtered(signal: Array) -> Array:
    """A signal of `SAMPLES` per second without what is quicker than `CUTOFF`."""
    from scipy.signal import butter, sosfiltfilt

    return np.asarray(sosfiltfilt(butter(6, CUTOFF, fs=SAMPLES, output="sos"), signal, padtype="even", padlen=120))


def off(mine: Array, other: Array) -> float:
    """Largest difference in percent of the largest value."""
    return float(100 * np.abs(mine - other).max() / np.abs(other).max())


def main() -> None:
    print(
        "| tyres | manoeuvre | lateral acceleration, g | yaw rate, % | lateral acceleration, % | not filtered, % |\n"
        "|---|---|---|---|---|---|"
    )
    for symmetric in (True, False):
        p, lean = vehicle(symmetric), 0.0 if symmetric else LEAN
        for name in MANOEUVRES:
            times, turn, sideways = theirs(p, name, lean)
            own, mine, aside = ours(p, name, lean)
            mine, aside = np.interp(times, own, mine), np.interp(times, own, aside)
            row = ("symmetric" if symmetric else "the package's", name, f"{np.abs(sideways).max() / GRAVITY:.2f}")
            yaw, side = (off(filtered(a), filtered(b)) for a, b in ((mine, turn), (aside, sideways)))
            print(
                "| " + " | ".join((*row, f"{yaw:.1f}", f"{side:.1f}", f"{off(aside, sideways):.1f}")) + " |", flush=True
            )


if __name__ == "__main__":
    main()
