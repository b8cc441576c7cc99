"""The four-wheel car against CommonRoad's multi-body model, below 0.7 g.

``python -m benchmarks.four_wheel_car`` runs both through the same manoeuvres with the parameters of vehicle 2 (BMW
320i) and prints the largest difference of yaw rate and lateral acceleration, as a share of the largest value. The
multi-body model is the package's own code; install it first: ``pip install commonroad-vehicle-models==3.0.2``.
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
STEP, DONE = [0.2, 0.21, 0.5, 0.51], [0, 1, 1, 0]
MANOEUVRES = {  # speed m/s, seconds, rate of the steering angle rad/s, acceleration wanted m/s^2
    "step of the steering wheel, 15 m/s": (15.0, 3.0, ramp(STEP, np.multiply(0.22, DONE)), STILL),
    "step of the steering wheel, 25 m/s": (25.0, 3.0, ramp(STEP, np.multiply(0.1, DONE)), STILL),
    "slalom, 20 m/s": (20.0, 4.0, lambda t: 0.16 * np.cos(3 * t), STILL),
    "lane change, 30 m/s": (30.0, 4.0, lambda t: 0.16 * np.cos(5 * t) * (t < 0.4 * np.pi), STILL),
    "bend under power, 12 m/s": (12.0, 3.0, ramp(STEP, np.multiply(0.2, DONE)), ramp([0], [2])),
    "bend under braking, 20 m/s": (20.0, 2.5, ramp(STEP, np.multiply(0.13, DONE)), ramp([1, 1.2], [0, -3])),
}  # fmt: skip


def our_car(p: Any) -> Any:
    """The four-wheel car with the parameters ``p`` of CommonRoad's vehicle; its springs include those of the tyres."""
    from vehsim.vehicles.models.four_wheel_car import four_wheel_car

    half, series = (p.T_f + p.T_r) / 4, lambda a, b: a * b / (a + b)
    springs = [series(k, p.K_zt) for k in (p.K_sf, p.K_sr)]
    tracks, torsion = (p.T_f, p.T_r), (-p.K_tsf, -p.K_tsr)
    rolls = [
        series(k * t**2 / 2 + bar, p.K_zt * t**2 / 2)
        for k, t, bar in zip((p.K_sf, p.K_sr), tracks, torsion, strict=True)
    ]
    return four_wheel_car(
        mass=p.m, yaw_inertia=p.I_z, roll_inertia=p.I_Phi_s, pitch_inertia=p.I_y_s, front=p.a, rear=p.b,
        half_track=half, mass_height=(p.m_s * p.h_s + (p.m - p.m_s) * p.R_w) / p.m, wheel_radius=p.R_w,
        wheel_inertia=p.I_y_w, engine_inertia=1e-3, springs=springs, dampers=[p.K_sdf, p.K_sdr],
        bars=[max(0.0, roll - 2 * k * half**2) for roll, k in zip(rolls, springs, strict=True)],
        drive_front=p.T_se, brake_front=p.T_sb, low_speed=0.5,
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
    height = (p.m_s * p.h_s + (p.m - p.m_s) * p.R_w) / p.m
    turn, along, across = clip.twists.T
    pitch, roll = clip.joints[:, at["pitch"]], clip.joints[:, at["roll"]]
    sway = across + turn * height * pitch - height * clip.joint_rates[:, at["roll"]]
    surge = along + turn * height * roll + height * clip.joint_rates[:, at["pitch"]]
    return times, turn, np.gradient(sway, times) + turn * surge


def theirs(p: Any, name: str) -> tuple[Array, Array, Array]:
    """The same of the multi-body model."""
    from scipy.integrate import solve_ivp
    from vehiclemodels.init_mb import init_mb
    from vehiclemodels.vehicle_dynamics_mb import vehicle_dynamics_mb

    speed, seconds, steer, wanted = MANOEUVRES[name]

    def right(t: float, x: Array) -> list[float]:
        return vehicle_dynamics_mb(list(x), [float(steer(t)), float(wanted(t))], p)

    times = np.linspace(0, seconds, 400)
    options = {"method": "LSODA", "rtol": 1e-6, "atol": 1e-8, "max_step": 0.01, "t_eval": times}
    x = solve_ivp(right, (0, seconds), init_mb([0, 0, 0, speed, 0, 0, 0], p), **options).y
    sideways = [right(t, row)[10] + row[5] * row[3] for t, row in zip(times, x.T, strict=True)]
    return times, x[5], np.array(sideways)


def main() -> None:
    from vehiclemodels.parameters_vehicle2 import parameters_vehicle2

    p = parameters_vehicle2()
    print("| manoeuvre | largest lateral acceleration, g | yaw rate, % | lateral acceleration, % |\n|---|---|---|---|")
    for name in MANOEUVRES:
        t, turn, sideways = theirs(p, name)
        own = ours(p, name)
        off = [
            100 * np.abs(np.interp(t, own[0], mine) - other).max() / np.abs(other).max()
            for mine, other in ((own[1], turn), (own[2], sideways))
        ]
        print(f"| {name} | {np.abs(sideways).max() / GRAVITY:.2f} | {off[0]:.1f} | {off[1]:.1f} |")


if __name__ == "__main__":
    main()
