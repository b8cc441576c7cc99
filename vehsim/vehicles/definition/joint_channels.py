"""Channels that depend only on joints, such as a steered wheel's angle: their values, and joints computed from them.

This module knows laws and arrays, but neither clips nor stages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from vehsim.vehicles.definition.vehicle import Vehicle

Array = NDArray[np.float64]

POINTS = 33
"""Number of samples of a law that is not linear."""
BEYOND = 0.1
"""How far samples extend beyond the needed range, as a share of it."""


def joint_channels(vehicle: Vehicle, joints: Array) -> dict[str, Array]:
    """Values (n,) of the channels whose laws depend only on the joints (n, s), rad or m."""
    names, function, _ = _kept_laws(vehicle)
    values = np.asarray(function(joints.T), float).reshape(len(names), len(joints)) if names else ()
    return dict(zip(names, values, strict=True))


def readings(vehicle: Vehicle, joints: Array) -> dict[str, tuple[str, Array, Array]]:
    """Tables from which the joints of a motion (n, s) can be read: joint -> (channel, values, joint's values).

    The channel rises or falls strictly with that joint and depends on no other. Values (k,) increase: linear laws need
    two samples, others are sampled over the joint's range. A joint without such a channel is left out.
    """
    if vehicle.rig is None:
        return {}
    names, _, depends = _kept_laws(vehicle)
    found: dict[str, tuple[str, Array, Array]] = {}
    for name, on in zip(names, depends, strict=True):
        if name not in vehicle.rig.drives or len(on) != 1 or vehicle.joints[on[0]] in found:
            continue
        low, high = joints[:, on[0]].min(), joints[:, on[0]].max()
        beyond = max(BEYOND * (high - low), 0.01)
        at = np.zeros((POINTS, len(vehicle.joints)))
        at[:, on[0]] = np.linspace(low - beyond, high + beyond, POINTS)
        shows, joint = joint_channels(vehicle, at)[name], at[:, on[0]]
        steps = np.diff(shows)
        if not (np.all(steps > 0) or np.all(steps < 0)):
            continue
        if np.ptp(steps) < 1e-9 * np.abs(steps).max():
            shows, joint = shows[[0, -1]], joint[[0, -1]]
        order = slice(None) if steps[0] > 0 else slice(None, None, -1)
        found[vehicle.joints[on[0]]] = (name, shows[order], joint[order])
    return found


def _kept_laws(vehicle: Vehicle) -> tuple[list[str], Any, list[list[int]]]:
    """`_laws`, built once and cached."""
    built = vehicle.__dict__.setdefault("_functions", {})
    if "joint channels" not in built:
        built["joint channels"] = _laws(vehicle)
    found: tuple[list[str], Any, list[list[int]]] = built["joint channels"]
    return found


def _laws(vehicle: Vehicle) -> tuple[list[str], Any, list[list[int]]]:
    """Names of the channels that follow joints, their laws as one function of the joints, and the joints in each
    law."""
    r = ca.SX.sym("r", len(vehicle.joints))
    t, u, xi = ca.SX.sym("t"), ca.SX.sym("u", len(vehicle.joints)), ca.SX.sym("xi", vehicle.group.dim)
    c = ca.SX.sym("c", len(vehicle.controls))
    names: list[str] = []
    laws: list[Any] = []
    depends: list[list[int]] = []
    for name, channel in vehicle.channels.items():
        law = None if channel.value is None else ca.SX(channel.value(t, r, u, xi, c))
        if law is None or not ca.depends_on(law, r) or ca.depends_on(law, ca.vertcat(t, u, xi, c)):
            continue
        names.append(name)
        laws.append(law)
        depends.append([i for i in range(r.shape[0]) if ca.depends_on(law, r[i])])
    return names, ca.Function("joint_channels", [r], [ca.densify(ca.vertcat(*laws))]) if laws else None, depends
