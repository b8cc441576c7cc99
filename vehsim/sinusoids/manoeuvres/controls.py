"""The controls that produce a known motion of a vehicle: rates directly, forces from the equations of motion."""

from __future__ import annotations

import casadi as ca
import numpy as np

from vehsim.integrators.continuous import equations_of_motion
from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.sinusoids.system import Array


def controls_of(mechanics: DiscreteMechanics, times: Array, g: Array, r: Array, u: Array, xi: Array) -> Array:
    """Controls (k, c): rates directly, forces from the equations of motion."""
    from scipy.interpolate import CubicSpline

    vehicle, law = mechanics.vehicle, equations_of_motion(mechanics.vehicle)
    controls = np.zeros((len(times), len(vehicle.controls)))
    for joint, control in vehicle.driven:
        controls[:, control] = u[:, joint]
    others = [i for i, name in enumerate(vehicle.control_names) if name not in vehicle.rate_controls]
    if not others:
        return controls
    free = np.asarray(
        mechanics.knot_velocity_guess.map(len(times))(
            r.T, np.asarray(mechanics.knot_momentum.map(len(times))(r.T, u.T, xi.T)), controls.T
        )
    ).T
    wanted, rates = CubicSpline(times, free).derivative()(times), CubicSpline(times, controls).derivative()(times)
    c = ca.SX.sym("c", controls.shape[1])
    symbols = [ca.SX.sym(name, size) for name, size in (("g", g.shape[1]), ("r", r.shape[1]), ("z", free.shape[1]))]
    c_rate = ca.SX.sym("c_rate", controls.shape[1])
    z_dot = law(*symbols, c, c_rate, ca.SX.zeros(3))[2]
    function = ca.Function(
        "z", [*symbols, c, c_rate], [ca.densify(z_dot), ca.densify(ca.jacobian(z_dot, c)[:, others])]
    )
    for k in range(len(times)):
        rest, gain = (np.asarray(x) for x in function(g[k], r[k], free[k], controls[k], rates[k]))
        controls[k, others] = np.linalg.lstsq(gain, wanted[k] - rest.ravel(), rcond=None)[0]
    return controls
