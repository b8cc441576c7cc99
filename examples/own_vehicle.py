"""A vehicle defined from scratch: a pushed cart on two free wheels, from its Lagrangian to a rigged, animated clip."""

import sys
from pathlib import Path

import numpy as np

import vehsim
from vehsim.lie import SE2
from vehsim.vehicles import Channel, Control, Nonholonomic, State
from vehsim.vehicles.primitives import Box, Wheel, with_primitives

MASS, YAW, SPIN, RADIUS, TRACK = 80.0, 12.0, 0.2, 0.25, 0.4  # kg, kg m^2, kg m^2, m, half the track m


def lagrangian(r, u, xi):
    """Kinetic energy, J: r and u are the wheels' angles and rates, xi = (yaw rate, speed along, speed across)."""
    return (YAW * xi[0] ** 2 + MASS * (xi[1] ** 2 + xi[2] ** 2) + SPIN * (u[0] ** 2 + u[1] ** 2)) / 2


def constraints(r):
    """W_r u + W_xi xi = 0: both wheels roll, and neither slips sideways."""
    return [[-RADIUS, 0], [0, -RADIUS], [0, 0]], [[-TRACK, 1, 0], [TRACK, 1, 0], [0, 0, 1]]


def forces(r, u, xi, c):
    """Friction in the bearings, and the push: a body wrench (torque, force along, force across)."""
    return [-0.5 * u[0], -0.5 * u[1]], [c[1], c[0], 0]


cart = Nonholonomic(
    name="cart",
    group=SE2,
    joints=("left", "right"),
    lagrangian=lagrangian,
    constraints=constraints,
    forces=forces,
    controls=(Control("push", unit="N"), Control("turn", unit="N m")),
    channels={
        "roll_left": Channel(value=lambda t, r, u, xi, c: r[0]),
        "roll_right": Channel(value=lambda t, r, u, xi, c: r[1]),
    },
)


def push(t, state):
    """Controls at a time [s] and `State`: push, then steer from side to side."""
    return [60.0 if t < 2 else 15.0, 12.0 * np.sin(2 * t)]


if __name__ == "__main__":
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    parts = {
        "bed": Box((1.2, 0.7, 0.3), at=(0.2, 0, 0.45)),
        "wheel_left": Wheel(RADIUS, at=(0, TRACK, RADIUS), channel="roll_left"),
        "wheel_right": Wheel(RADIUS, at=(0, -TRACK, RADIUS), channel="roll_right"),
    }
    clip = vehsim.simulate(with_primitives(cart, out / "assets", parts), None, push, State(), duration=6.0)
    print(clip.export(out / "cart.usda"))
