"""Shared by several methods: a start table as a state, and control values in SI."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from vehsim.lie.quaternions import conjugate, rotate
from vehsim.shot.checks import orientation_of
from vehsim.shot.schema.tables import StartTable

if TYPE_CHECKING:
    from vehsim.vehicles import State, Vehicle


def as_state(start: StartTable, vehicle: Vehicle, wind: ArrayLike | None = None) -> State:
    """The state of a start table. With ``wind`` (3,) m/s, a vehicle that flies and starts at rest leans as in balance
    unless the table gives its orientation."""
    from vehsim.vehicles import State

    orientation = orientation_of(start)
    if orientation is None:
        orientation = np.array([1.0, 0.0, 0.0, 0.0])
    if wind is not None and start.orientation is None and not np.any([start.velocity, start.spin]):
        from vehsim.planning.trim import upright

        orientation = upright(vehicle, [np.deg2rad(start.heading or 0.0)], wind)[0]
    velocity = rotate(conjugate(orientation), np.array(start.velocity, float))
    spin = np.deg2rad(start.spin)
    twist = np.array([spin[2], *velocity[:2]]) if is_planar(vehicle) else np.concatenate([spin, velocity])
    joints = [start.joints.get(name, 0.0) for name in vehicle.joints]
    return State(position=np.array(start.position), orientation=orientation, twist=twist, joints=np.array(joints))


def is_planar(vehicle: Vehicle) -> bool:
    return vehicle.group.dim == 3


def to_si(values: Mapping[str, float], vehicle: Vehicle) -> dict[str, float]:
    """Control values of a shot file in SI; controls in radians are given in degrees there."""
    units = {control.name: control.unit for control in vehicle.controls}
    return {
        name: np.deg2rad(value) if units[name].startswith("rad") else value
        for name, value in values.items()
        if name in units
    }
