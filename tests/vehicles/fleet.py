"""Wheeled vehicles with ordinary numbers, with a start and smooth controls for each; shared by several tests."""

import numpy as np

from vehsim.vehicles import State
from vehsim.vehicles.models.car import car
from vehsim.vehicles.models.car_trailer import car_trailer
from vehsim.vehicles.models.chaplygin_sleigh import chaplygin_sleigh
from vehsim.vehicles.models.roller_racer import roller_racer
from vehsim.vehicles.models.simple_car import simple_car
from vehsim.vehicles.models.snakeboard import snakeboard
from vehsim.vehicles.models.suslov import suslov
from vehsim.vehicles.models.two_wheeled import two_wheeled

CAR = {"mass": 1350.0, "wheel_inertia": 2.4, "yaw_inertia": 4100.0, "wheel_radius": 0.32, "wheelbase": 2.6}
SLOPE = (0.1, -0.05)
SUSLOV = [[1.0, 0.1, 0.3], [0.1, 1.5, 0.2], [0.3, 0.2, 2.0]]

FLEET = {
    "car": car(**CAR, half_track=0.77, slope=SLOPE, rolling_damping=3.0),
    "simple_car": simple_car(**CAR, steering_inertia=3.0, slope=SLOPE, rolling_damping=3.0, steering_damping=4.0),
    "two_wheeled": two_wheeled(
        mass=10.0, yaw_inertia=0.4, wheel_inertia=0.02, wheel_radius=0.1, half_track=0.2, slope=SLOPE
    ),
    "snakeboard": snakeboard(
        mass=70.0, half_length=0.35, rotor_inertia=2.0, steering_inertia=0.1, slope=SLOPE, damping=0.3
    ),
    "chaplygin_sleigh": chaplygin_sleigh(mass=3.0, yaw_inertia=0.5, ahead=0.3, slope=SLOPE, runner_damping=0.2),
    "roller_racer": roller_racer(
        mass=40.0, yaw_inertia=2.0, pivot_ahead=0.5, bar_mass=3.0, bar_inertia=0.1, bar_length=0.15, damping=0.4
    ),
    "car_trailer": car_trailer(
        **CAR,
        hitch_behind=0.9,
        trailer_mass=600.0,
        trailer_inertia=700.0,
        trailer_length=2.5,
        slope=SLOPE,
        hitch_damping=50.0,
    ),
    "suslov": suslov(inertia=SUSLOV),
}

STARTS = {
    "car": State(twist=(0.0, 4.0, 0.0), joints=(0.0, 0.2)),
    "simple_car": State(twist=(0.0, 4.0, 0.0), joints=(0.0, 0.2)),
    "two_wheeled": State(joint_rates=(6.0, 5.0)),
    "snakeboard": State(twist=(0.0, 1.0, 0.0), joints=(0.1, 0.3), joint_rates=(0.5, -0.4)),
    "chaplygin_sleigh": State(twist=(1.5, 2.0, 0.0)),
    "roller_racer": State(twist=(0.0, 1.0, 0.0), joints=(0.4,), joint_rates=(0.3,)),
    "car_trailer": State(twist=(0.0, 4.0, 0.0), joints=(0.0, 0.1, 0.3)),
    "suslov": State(twist=(1.0, 0.5, 0.0)),
}

CONTROLS = {
    "car": lambda t: np.column_stack([1500 * np.sin(2 * t), 0.6 * np.cos(1.5 * t)]),
    "simple_car": lambda t: np.column_stack([1500 * np.sin(2 * t), 6 * np.cos(1.5 * t)]),
    "two_wheeled": lambda t: np.column_stack([np.sin(3 * t), 0.6 * np.cos(2 * t)]),
    "snakeboard": lambda t: np.column_stack([8 * np.sin(3 * t), 0.4 * np.cos(4 * t)]),
    "chaplygin_sleigh": lambda t: np.column_stack([2 * np.sin(2 * t), 0.5 * np.cos(3 * t)]),
    "roller_racer": lambda t: np.column_stack([2 * np.sin(4 * t)]),
    "car_trailer": lambda t: np.column_stack([1500 * np.sin(2 * t), 0.5 * np.cos(1.5 * t)]),
    "suslov": lambda t: np.column_stack([0.3 * np.sin(2 * t), 0.2 * np.cos(t), 0.1 * np.sin(t)]),
}
