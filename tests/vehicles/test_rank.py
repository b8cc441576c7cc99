"""Constraints that lose rank, charts that become singular at full rank, and mass that becomes indefinite."""

import casadi as ca
import numpy as np
import pytest

from vehsim.errors import InputError, SolveError
from vehsim.integrators import Integrator
from vehsim.lie import SE2
from vehsim.vehicles import Control, Nonholonomic, State
from vehsim.vehicles.models.roller_racer import roller_racer
from vehsim.vehicles.models.snakeboard import snakeboard


def steerable_blade(a=0.0):
    """A sleigh whose blade, ``a`` ahead of the centre, can turn: two free directions for any blade angle."""

    def lagrangian(r, u, xi):
        return (3 * (xi[1] ** 2 + xi[2] ** 2) + 0.5 * xi[0] ** 2 + 0.2 * (xi[0] + u[0]) ** 2) / 2

    def constraints(r):
        return ca.SX(1, 1), ca.horzcat(a * ca.cos(r[0]), -ca.sin(r[0]), ca.cos(r[0]))

    return Nonholonomic(
        name="blade",
        group=SE2,
        joints=("phi",),
        lagrangian=lagrangian,
        constraints=constraints,
        forces=lambda r, u, xi, c: c,
        controls=(Control("torque"),),
    )


@pytest.mark.parametrize("a", [0.0, 0.4])
@pytest.mark.parametrize("h", [np.pi / 200, np.pi / 201, 0.01])
def test_motion_continues_where_the_first_choice_of_columns_is_singular(a, h):
    """The blade makes a full turn, through the angles where vy, then vx, cannot be eliminated: at a knot (pi / 200),
    in the middle of a substep (pi / 201), or near one.

    Energy and the constraint show that the motion is valid; a small step and another start give the same motion.
    """
    vehicle = steerable_blade(a)
    phi = 0.0
    start = State(twist=(0.3, 1.0, -a * 0.3), joints=(phi,), joint_rates=(1.0 if a == 0 else 2.0,))
    clip = Integrator(vehicle, h, order=4).rollout(start, np.zeros((round(2 * np.pi / h) + 1, 1)))
    assert clip.joints[-1, 0] > 4
    r, xi = clip.joints[:, 0], clip.twists
    np.testing.assert_allclose(a * np.cos(r) * xi[:, 0] - np.sin(r) * xi[:, 1] + np.cos(r) * xi[:, 2], 0, atol=1e-9)
    kinetic = clip.energy["kinetic"]
    assert np.ptp(kinetic) < (1e-12 if a == 0 else 1e-6) * kinetic[0]


def test_motion_does_not_depend_on_the_columns_eliminated():
    """One step in another chart is the same step; a start where the first choice is singular works too."""
    vehicle = steerable_blade(0.4)
    integrator, c = Integrator(vehicle, 0.02), np.ones(1)
    phase = integrator.start(State(twist=(0.3, 1.0, 0.8), joints=(1.1,), joint_rates=(1.0,)), c)
    here, other = integrator.advance(phase, c, c), integrator._other_chart(phase, c, c, 0.02)
    assert vehicle.chart_at(phase.r).pivots != vehicle.pivots
    for name in ("g", "r", "pi"):
        np.testing.assert_allclose(getattr(other, name), getattr(here, name), atol=1e-12)

    start = State(twist=(0.3, 0.0, 0.8), joints=(np.pi / 2,), joint_rates=(1.0,))
    clip = Integrator(vehicle, 0.02).rollout(start, np.ones((51, 1)))
    definition = {
        k: getattr(vehicle, k) for k in ("group", "joints", "lagrangian", "constraints", "forces", "controls")
    }
    sideways = Nonholonomic(name="sideways", sample=(np.pi / 2,), **definition)
    np.testing.assert_allclose(
        Integrator(sideways, 0.02).rollout(start, np.ones((51, 1))).positions, clip.positions, atol=1e-11
    )


def test_roller_racer_passes_where_both_axles_meet():
    """A bar shorter than the seat: eliminating vy and omega fails where cos(phi) = -c/d, though the rank holds."""
    vehicle = roller_racer(mass=40.0, yaw_inertia=2.0, pivot_ahead=0.5, bar_mass=3.0, bar_inertia=0.1, bar_length=0.3)
    start = State(twist=(0, 1.0, 0), joints=(1.2,), joint_rates=(6.0,))
    clip = Integrator(vehicle, 0.002).rollout(start, np.full((400, 1), 1.0))
    assert clip.joints.max() > np.arccos(-0.3 / 0.5) > clip.joints.min()
    balance = clip.energy["kinetic"] - clip.energy["work"] + clip.energy["dissipated"]
    assert np.ptp(balance) < 1e-3 * clip.energy["kinetic"].max()


@pytest.mark.parametrize("steps", [3, 700])
def test_rank_loss_at_a_step_is_named(steps):
    """Trucks across the board: LIE's snakeboard at phi = pi/2, met between knots and at the start."""
    vehicle = snakeboard(mass=70.0, half_length=0.35, rotor_inertia=2.0, steering_inertia=0.1)
    start = State(twist=(0, 1.0, 0), joints=(0, np.pi / 2 - 0.02), joint_rates=(0.0, 1.0))
    with pytest.raises(SolveError, match=r"snakeboard: step \d+: constraints lose rank between joints"):
        Integrator(vehicle, 0.015).rollout(start, np.zeros((steps, 2)))
    with pytest.raises(SolveError, match="step 0: constraints lose rank"):
        Integrator(vehicle, 0.015).rollout(State(joints=(0, np.pi / 2)), np.zeros((3, 2)))


def test_constraints_on_joints_alone_tie_them():
    """Two wheels geared together: the second follows the first, and adds its inertia."""
    geared = Nonholonomic(
        name="geared",
        group=SE2,
        joints=("a", "b"),
        lagrangian=lambda r, u, xi: (u[0] ** 2 + 2 * u[1] ** 2 + xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2) / 2,
        constraints=lambda r: ([[1, -3]], [[0, 0, 0]]),
        forces=lambda r, u, xi, c: ca.vertcat(c, 0),
        controls=(Control("torque"),),
    )
    assert len(geared.tied) == 1
    clip = Integrator(geared, 0.05).rollout(State(), np.ones((41, 1)))
    np.testing.assert_allclose(clip.joints[:, 0], 3 * clip.joints[:, 1], atol=1e-12)
    np.testing.assert_allclose(clip.joints[:, 0], clip.times**2 / 2 / (1 + 2 / 9), atol=1e-12)


def test_mass_that_becomes_indefinite_during_motion_is_named():
    vehicle = Nonholonomic(
        name="odd",
        group=SE2,
        joints=("x",),
        lagrangian=lambda r, u, xi: ((1 - r[0]) * u[0] ** 2 + xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2) / 2,
    )
    with pytest.raises(SolveError, match=r"odd: step \d+.*(positive definite|did not converge)"):
        Integrator(vehicle, 0.1).rollout(State(joint_rates=(1.0,)), np.zeros((40, 0)))


def test_rank_loss_at_the_sample_and_a_better_sample():
    vehicle = snakeboard(mass=70.0, half_length=0.35, rotor_inertia=2.0, steering_inertia=0.1)
    definition = {k: getattr(vehicle, k) for k in ("group", "joints", "lagrangian", "constraints")}
    with pytest.raises(InputError, match=r"lose rank at joints = \[0.0, 1.57.*give a `sample`"):
        Nonholonomic(name="across", sample=(0.0, np.pi / 2), **definition)
    Nonholonomic(name="fine", sample=(0.0, 0.3), **definition)
    with pytest.raises(InputError, match="give 2 finite numbers"):
        Nonholonomic(name="short", sample=(0.0,), **definition)


def test_a_start_where_the_first_choice_of_columns_is_exactly_singular():
    """``-x vx + (1 - x) vy = 0`` from x = 1, where vy drops out: an ordinary start."""

    def lagrangian(r, u, xi):
        return (xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2 + u[0] ** 2) / 2

    vehicle = Nonholonomic(
        name="slot",
        group=SE2,
        joints=("x",),
        lagrangian=lagrangian,
        constraints=lambda r: (ca.SX(1, 1), ca.horzcat(0, -r[0], 1 - r[0])),
    )
    start = State(twist=(0.5, 0.0, 1.0), joints=(1.0,), joint_rates=(0.3,))
    clip = Integrator(vehicle, 0.02).rollout(start, np.zeros((51, 0)))
    x, xi = clip.joints[:, 0], clip.twists
    np.testing.assert_allclose(-x * xi[:, 1] + (1 - x) * xi[:, 2], 0, atol=1e-12)
    assert np.ptp(clip.energy["kinetic"]) < 1e-3
    stepped = Integrator(vehicle, 0.02).step(start, [])
    np.testing.assert_allclose(stepped.position, clip.positions[1], atol=1e-13)
