"""Whether a vehicle can stand still at marks, against wind and slope, within its controls' bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.planning.constraints.mark_constraints import asks_balance, mark_element, mark_values
from vehsim.planning.problem.elements import Element
from vehsim.planning.problem.nlpsol import nlpsol
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.marks import Mark
from vehsim.planning.trim import trim, upright
from vehsim.vehicles import Vehicle

Array = NDArray[np.float64]

BALANCE = "velocity (balance)"
"""The rows of a mark's element that contain the residual acceleration along the vehicle's free velocities."""
STILL = 1e-5
"""Tolerance of the residual in balance, m/s^2 and rad/s^2."""
HEADINGS = (0.0, 90.0, 180.0, 270.0)
"""Headings from which the search for a balance starts if the mark leaves it free, deg."""


def out_of_balance(
    vehicle: Vehicle, transcription: Transcription, marks: Sequence[Mark], wind: Any
) -> list[tuple[Mark, str, str]]:
    """Marks at which ``vehicle`` should stand still and cannot, with message and remedy.

    ``transcription``: that of the vehicle with the force of gravity on slopes. Without wind and slope nothing is
    checked: the ground below rotors only makes it easier to hover.
    """
    windy = bool(np.any(wind)) and vehicle.feels_wind
    sloping = vehicle.group.planar and transcription.vehicle is not vehicle
    if not (windy or sloping):
        return []
    found = []
    for i, mark in enumerate(marks):
        if not asks_balance(vehicle, mark) or (i and marks[i - 1].hold):
            continue
        left, _ = least_push(transcription, mark, wind)
        if left > STILL:
            speed = float(np.linalg.norm(wind))
            cause = f"in {speed:.3g} m/s of wind" if windy else "on this slope"
            message = (
                f"{cause} the {vehicle.name} cannot stand still there: an acceleration of {left:.2g} m/s^2 remains"
            )
            found.append((mark, message, _remedy(transcription, mark, wind, windy)))
    return found


def _remedy(transcription: Transcription, mark: Mark, wind: Any, windy: bool) -> str:
    if mark.heading is not None:
        left, heading = least_push(transcription, replace(mark, heading=None), wind)
        if left <= STILL:
            return f"use heading = {heading:.0f}"
    return "weaken the wind, or do not stop there" if windy else "stop where it is flatter"


def least_push(transcription: Transcription, mark: Mark, wind: Any) -> tuple[float, float]:
    """The smallest residual, m/s^2 and rad/s^2, that any controls leave at a mark, and the heading for it, deg."""
    element = mark_element(transcription, mark, everywhere=True)
    assert element is not None
    solver, rows = _solver(transcription, element)
    kept = [i for i, label in enumerate(element.labels) if label != BALANCE]
    gauge = np.ones(len(_gauge(transcription, element)))
    lower, upper = (np.append(np.asarray(bound)[kept], gauge) for bound in (element.lower, element.upper))
    values = {"wind": np.asarray(wind, float), "depth": np.zeros(1), **mark_values(mark)}
    p = np.concatenate([values[name] for name in element.sizes])
    c_lower = np.array([c.lower for c in transcription.vehicle.controls]) / transcription.control_scale
    c_upper = np.array([c.upper for c in transcription.vehicle.controls]) / transcription.control_scale
    free = sum(transcription.sizes[:3])
    bounds = [np.append(np.full(free, value), c) for value, c in ((-np.inf, c_lower), (np.inf, c_upper))]
    for joint, (low, high) in transcription.vehicle.joint_limits.items():
        place = transcription.sizes[0] + transcription.vehicle.joints.index(joint)
        bounds[0][place], bounds[1][place] = low, high
    best = (math.inf, 0.0)
    for heading in HEADINGS if mark.heading is None and np.any(wind) else (mark.heading or 0.0,):
        answer = solver(
            x0=_start(transcription, mark, heading, wind), p=p, lbx=bounds[0], ubx=bounds[1], lbg=lower, ubg=upper
        )
        y = np.asarray(answer["x"]).ravel()
        missed = np.maximum(lower - np.asarray(answer["g"]).ravel(), np.asarray(answer["g"]).ravel() - upper)
        if missed.max(initial=0.0) < STILL:
            w, qx, qy, qz = np.asarray(transcription.vehicle.group.pose(y[: transcription.sizes[0]])).ravel()[3:7]
            yaw = math.degrees(math.atan2(2 * (w * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)))
            best = min(best, (float(np.linalg.norm(np.asarray(rows(y, p)))), yaw))
        if best[0] <= STILL:
            break
    return best


def _gauge(transcription: Transcription, element: Element) -> list[Any]:
    """The squared norm of the quaternion, if the state has one."""
    group = transcription.vehicle.group
    return [ca.sumsqr(element.y[:4])] if group.size > group.dim else []


def _solver(transcription: Transcription, element: Element) -> tuple[ca.Function, ca.Function]:
    """The solver of a mark's balance as least squares under its other constraints; and the rows of the balance."""
    balance = [i for i, label in enumerate(element.labels) if label == BALANCE]
    kept = [i for i, label in enumerate(element.labels) if label != BALANCE]
    g = ca.vertcat(*(element.g[i] for i in kept), *_gauge(transcription, element))
    nlp = {"x": element.y, "p": element.p, "f": ca.sumsqr(element.g[balance]), "g": g}
    quiet = {"print_level": 0, "sb": "yes", "tol": 1e-14, "max_iter": 100}
    options: Any = {"ipopt": quiet, "print_time": False, "error_on_fail": False, "show_eval_warnings": False}
    solver = nlpsol("balance", "ipopt", nlp, options)
    return solver, ca.Function("rows", [element.y, element.p], [element.g[balance]])


def _start(transcription: Transcription, mark: Mark, heading: float, wind: Any) -> Array:
    """A knot (x, c0) at rest at a mark, as near to balance as its controls allow."""
    pose = np.concatenate(
        [mark.position or (0.0, 0.0, 0.0), *upright(transcription.vehicle, [np.deg2rad(heading)], wind)]
    )
    g = np.asarray(transcription.vehicle.group.from_pose(pose)).ravel()
    rest = np.zeros(transcription.sizes[1] + transcription.sizes[2])
    return np.concatenate([g, rest, trim(transcription.vehicle, tuple(wind)) / transcription.control_scale])
