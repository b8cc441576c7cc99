"""Phases at knots written down as a clip: rig poses, twists, joints, channels and the energy ledger."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from vehsim.clip import Clip
from vehsim.integrators.discrete import DiscreteMechanics
from vehsim.vehicles import Vehicle
from vehsim.vehicles._base import Array
from vehsim.vehicles.mechanics import energy
from vehsim.vehicles.states import shift_twist


def build_clip(
    mechanics: DiscreteMechanics,
    times: Array,
    g: Array,
    r: Array,
    pi: Array,
    controls: Array,
    anchor: Any = (0.0, 0.0, 0.0),
    wind: Any = (0.0, 0.0, 0.0),
    **header: Any,
) -> Clip:
    """A clip from the phases at its knots: poses and twists of the rig's root, joints, controls, channels, energy."""
    columns = (g.T, r.T, pi.T, controls.T)
    pose, twist, joints, rates = (np.asarray(x).T for x in _mapped(mechanics.root_state, len(times))(*columns))
    orientations = continuous(pose[:, 3:7])
    return Clip(
        vehicle=mechanics.vehicle,
        times=times,
        positions=pose[:, 0:3] + np.asarray(anchor, float),
        orientations=orientations,
        twists=twist,
        joints=joints.reshape(len(times), -1),
        joint_rates=rates.reshape(len(times), -1),
        controls=controls,
        channels=_channels(mechanics.vehicle, times, joints, rates, twist, controls),
        energy=ledger(mechanics, times, g, r, pi, controls, wind),
        **header,
    )


def continuous(quaternions: Array) -> Array:
    """The same rotations (n, 4) with no sign flips from one to the next."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=1)
    signs = np.cumprod(np.concatenate([[1.0], np.where(dots < 0, -1.0, 1.0)]))
    return quaternions * signs[:, None]


def _channels(vehicle: Vehicle, times: Array, r: Array, u: Array, root: Array, c: Array) -> dict[str, Array]:
    n = len(times)
    symbols = [ca.SX.sym(k, size) for k, size in (("t", 1), ("r", r.shape[1]), ("u", u.shape[1]))]
    twist, control = ca.SX.sym("xi", vehicle.group.dim), ca.SX.sym("c", c.shape[1])
    body = shift_twist(twist, vehicle.origin) if vehicle.group.dim != 3 or vehicle.group.name == "SE2" else twist
    made: dict[str, Array] = {}
    for name, channel in vehicle.channels.items():
        law: Callable[..., Any] = channel.value or channel.rate  # type: ignore[assignment]
        expression = ca.SX(law(*symbols, body, control))
        function = ca.Function("channel", [*symbols, twist, control], [ca.densify(expression)])
        values = flat(_mapped(function, n)(times[None], r.T, u.T, root.T, c.T))
        if channel.rate is not None:
            values = _integral(times, values)
        made[name] = values
    return made


def ledger(
    mechanics: DiscreteMechanics, times: Array, g: Array, r: Array, pi: Array, controls: Array, wind: Any
) -> dict[str, Array]:
    """Kinetic and potential energy, work done by controls and wind, and what drag took out, each (n,) J.

    Work and dissipation are integrals of the power at the knots (cubic spline); ``kinetic + potential - work +
    dissipated`` stays constant up to the integrator's error, O(h^2).
    """
    n = len(times)
    winds = np.tile(np.asarray(wind, float)[:, None], n)
    columns = (g.T, r.T, pi.T, controls.T, winds)
    kinetic, potential, work, dissipated = (flat(x) for x in _mapped(_power(mechanics), n)(*columns))
    return {
        "kinetic": kinetic,
        "potential": potential,
        "work": _integral(times, work),
        "dissipated": _integral(times, dissipated),
    }


def _power(mechanics: DiscreteMechanics) -> ca.Function:
    """``(g, r, pi, c, wind) -> (kinetic, potential, power put in, power dissipated)`` at a knot."""

    def build() -> ca.Function:
        v, y = mechanics.vehicle, mechanics.symbols
        g, r, c, wind = y["g"], y["r"], y["c0"], y["wind"]
        u, xi = mechanics.knot_velocity(r, y["pi"], c)
        joint, body = v.force(g, r, u, xi, c, wind)
        lost = ca.SX(v.dissipation(g, r, u, xi, wind))
        work = ca.dot(joint, u) + ca.dot(body, xi) + lost
        return ca.Function("power", [g, r, y["pi"], c, wind], [*energy(v, g, r, u, xi), work, lost])

    return keep(mechanics, "power", build)


def _integral(times: Array, rate: Array) -> Array:
    """Integral (n,) of knot rates (n,) from the first knot."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(times, rate).antiderivative()(times)) if len(times) > 1 else np.zeros(len(times))


def keep(mechanics: DiscreteMechanics, key: str, build: Callable[[], ca.Function]) -> ca.Function:
    """A function built once and kept as long as the mechanics."""
    kept = mechanics.__dict__.setdefault("_kept", {})
    if key not in kept:
        kept[key] = build()
    return kept[key]


def _mapped(function: ca.Function, n: int) -> Callable[..., Any]:
    return function.map(n) if n > 1 else function


def flat(values: Any) -> Array:
    """A CasADi column, or anything like it, as (n,)."""
    return np.asarray(values, float).ravel()
