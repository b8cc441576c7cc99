"""The four-wheel car against CommonRoad's multi-body model, below 0.7 g.

``python -m benchmarks.four_wheel_car`` runs both through the same manoeuvres with the parameters of vehicle 2 (BMW
320i) and prints the largest difference of yaw rate and lateral acceleration, as a share of the largest value; once
with tyres that are symmetric and do not feel camber, and once with the package's. The multi-body model is the package's
own code; install it first: ``pip install commonroad-vehicle-models==3.0.2``.

Four things make the comparison one of equal cars. The package's start is not at rest on its springs, so it first rolls
for three seconds, and starts from there without the weaving that the camber of its wheels gives it on a straight. It
balances moments about the centre of the sprung mass, so its axles are given the shares of their mass that leave the
centre of the whole car there. And it uses a tyre's camber coefficients, which hold for a y axis that points left, with
one that points right: ours have the other sign here. And it turns by the moments of the tyres' forces about a centre
that does not move when the body rolls and dives, although it moves the body sideways by the very roll: the moment about
the displaced centre is added, without which braking in a bend differs by 8 %.
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


MANOEUVRES = {  # speed m/s, seconds, rate of the steering angle rad/s, acceleration wanted m/s^2
    **{f"bend, 15 m/s, {k}": (15.0, 3.0, step(0.22 * k), STILL) for k in (0.33, 0.67, 1)},
    **{f"bend, 25 m/s, {k}": (25.0, 3.0, step(0.08 * k), STILL) for k in (0.33, 0.67, 1)},
    **{f"slalom, 20 m/s, {k}": (20.0, 4.0, slalom(0.15 * k), STILL) for k in (0.33, 0.67, 1)},
    **{f"lane change, 30 m/s, {k}": (30.0, 4.0, change(0.16 * k), STILL) for k in (0.33, 0.67, 1)},
    "bend under power, 12 m/s": (12.0, 3.0, step(0.2), ramp([0], [2])),
    "bend under braking, 20 m/s": (20.0, 2.5, step(0.1), ramp([1, 1.2], [0, -3])),
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


def our_car(p: Any) -> Any:
    """The four-wheel car with the parameters ``p`` of CommonRoad's vehicle; its springs include those of the tyres."""
    from vehsim.vehicles.models.four_wheel_car import four_wheel_car

    half, series = (p.T_f + p.T_r) / 4, lambda a, b: a * b / (a + b)
    springs = [series(k, p.K_zt) for k in (p.K_sf, p.K_sr)]
    tracks, torsion = (p.T_f, p.T_r), (-p.K_tsf, -p.K_tsr)
    bodies = [k * t**2 / 2 + bar for k, t, bar in zip((p.K_sf, p.K_sr), tracks, torsion, strict=True)]
    tyres = [p.K_zt * t**2 / 2 for t in tracks]
    above = [k / (k + body) for k, body in zip(tyres, bodies, strict=True)]  # share of roll above the axle
    t = p.tire
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
    )  # fmt: skip


def ours(p: Any, name: str) -> tuple[Array, Array, Array]:
    """Times, yaw rate and lateral acceleration of the centre of mass."""
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
    clip = Integrator(car, times[1]).rollout(State(twist=(0, speed, 0)), controls)
    heave, pitch, roll = (clip.joints[:, at[name]] for name in ("heave", "pitch", "roll"))
    rising, pitching, rolling = (clip.joint_rates[:, at[name]] for name in ("heave", "pitch", "roll"))
    height = (p.m_s * p.h_s + (p.m - p.m_s) * p.R_w) / p.m + heave
    turn, along, across = clip.twists.T
    sway = across + turn * height * pitch - height * rolling - rising * roll
    surge = along + turn * height * roll + height * pitching + rising * pitch
    return times, turn, np.gradient(sway, times) + turn * surge


def theirs(p: Any, name: str) -> tuple[Array, Array, Array]:
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

    times = np.linspace(0, seconds, 400)
    options = {"method": "LSODA", "rtol": 1e-6, "atol": 1e-8, "max_step": 0.01}
    start, coast = init_mb([0, 0, 0, speed, 0, 0, 0], p), lambda t, x: vehicle_dynamics_mb(list(x), [0.0, 0.0], p)
    settled = solve_ivp(coast, (0, 3), start, **options).y[:, -1]
    settled[[1, 4, 5, 6, 7, 10, 13, 14, 15, 18, 19, 20, 27, 28]] = 0.0  # sideways, turns, rolls
    x = solve_ivp(right, (0, seconds), settled, t_eval=times, **options).y
    sideways = [masses @ np.take(right(t, row), places) + row[5] * row[3] for t, row in zip(times, x.T, strict=True)]
    return times, x[5], np.array(sideways)


def main() -> None:
    print(
        "| tyres | manoeuvre | lateral acceleration, g | yaw rate, % | lateral acceleration, % |\n|---|---|---|---|---|"
    )
    for symmetric in (True, False):
        p = vehicle(symmetric)
        for name in MANOEUVRES:
            t, turn, sideways = theirs(p, name)
            own = ours(p, name)
            off = [
                100 * np.abs(np.interp(t, own[0], mine) - other).max() / np.abs(other).max()
                for mine, other in ((own[1], turn), (own[2], sideways))
            ]
            row = ("symmetric" if symmetric else "the package's", name, f"{np.abs(sideways).max() / GRAVITY:.2f}")
            print("| " + " | ".join((*row, *(f"{value:.1f}" for value in off))) + " |", flush=True)


if __name__ == "__main__":
    main()
