"""A rider's legs: angles at ankle and knee that connect each turning foot to the turning hips.

This module is kinematics in closed form, for channels and for the assets that they drive.
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from vehsim.vehicles.definition.base import Expr


@dataclass(frozen=True)
class Legs:
    """Lengths in m: ``shin`` and ``thigh``; ``rise`` of the hip joints above the ankles; ``spread``, half the distance
    between the hip joints; ``stance``, half that between the ankles.

    The rider faces the board's Y, each foot its truck's; the pelvis turns about the vertical in the board's middle.
    """

    shin: float
    thigh: float
    rise: float
    spread: float
    stance: float

    def angles(self, end: float, pelvis: Expr, foot: Expr) -> tuple[Expr, Expr, Expr]:
        """(leg, shin, knee) [rad] of the front (``end`` = 1) or rear (-1) leg, for given rotations of pelvis and foot.

        In the foot's frame, ``leg`` rotates the leg's plane about Y; in that plane, ``shin`` rotates the shin about X,
        and ``knee`` the thigh about the shin's X, so that the thigh ends at the hip joint and the knee bends over the
        toes.
        """
        x = end * (self.spread * ca.cos(pelvis) - self.stance)
        y = end * self.spread * ca.sin(pelvis)
        across, ahead = ca.cos(foot) * x + ca.sin(foot) * y, ca.cos(foot) * y - ca.sin(foot) * x
        up = ca.sqrt(across**2 + self.rise**2)
        reach = ca.sqrt(ahead**2 + up**2)
        s, t = self.shin, self.thigh
        lean = ca.atan2(ahead, up) + ca.acos((reach**2 + s**2 - t**2) / (2 * s * reach))
        bend = ca.pi - ca.acos((s**2 + t**2 - reach**2) / (2 * s * t))
        return ca.atan2(across, self.rise), -lean, bend
