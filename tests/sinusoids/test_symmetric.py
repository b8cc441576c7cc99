"""Symmetric products: SYM's argument for its helicopter, and bodies for which it fails (Lewis and Murray 1997)."""

import casadi as ca
import pytest

import vehsim
from tests.planning.test_lean import helicopter
from vehsim.errors import InputError
from vehsim.lie import SE2
from vehsim.sinusoids.algebra.classification import classify
from vehsim.sinusoids.canonical.symmetric import symmetric_closure
from vehsim.sinusoids.manoeuvres.rigs import rigged
from vehsim.vehicles import Control, Holonomic, Nonholonomic


def ranks(found):
    return [rank.value for rank in found.ranks]


def pushed(*forces):
    """A planar body, m = 2, J = 1, with body-fixed forces: (torque, fx, fy) per unit of each control."""
    controls = tuple(Control(f"f{i + 1}") for i in range(len(forces)))

    def wrench(c):
        return ca.mtimes(ca.DM(forces).T, c)

    return Holonomic(name="body", group=SE2, inertia=(1.0, 2.0, 2.0), controls=controls, wrench=wrench, gravity=0.0)


@pytest.mark.parametrize("asset", ["helicopter_lie", "helicopter", "leaning"])
def test_helicopter_reaches_what_its_four_controls_do_not_push(asset):
    """SYM: thrust and torques span four directions, products of two all six; hovering, weight does the rest.

    With rotors, the products of each tilt of the disc with itself are bad too.
    """
    found = symmetric_closure(helicopter(asset))
    assert ranks(found) == [4, 6] and found.accessible and found.certain
    assert (found.bad if asset == "helicopter_lie" else found.bad[:1]) == ("<yaw : yaw>",)
    assert found.linear and found.controllable


def test_hovercraft_is_controllable_by_a_force_ahead_and_one_abeam_off_its_centre():
    """<f2 : f2> is bad, but along f1, so it does not count; <f1 : f2> is the missing direction."""
    found = symmetric_closure(pushed((0.0, 1.0, 0.0), (-0.4, 0.0, 1.0)))
    assert ranks(found) == [2, 3] and found.bad == () and found.controllable and not found.linear


def test_one_force_off_the_centre_pushes_one_way_only():
    """Accessible, but its product with itself is bad: locally it cannot return."""
    found = symmetric_closure(pushed((-0.4, 0.0, 1.0)))
    assert found.bad[0] == "<f1 : f1>" and not found.controllable


def test_one_force_through_the_centre_turns_nothing():
    found = symmetric_closure(pushed((0.0, 1.0, 0.0)))
    assert ranks(found)[-1] == 1 and not found.accessible and not found.controllable


def test_a_boat_with_its_engine_idle_has_no_steering():
    """Its leg turns without a flow: only the thrust ahead is left, and at rest nothing resists that."""
    found = symmetric_closure(vehsim.load_vehicle("boat").planar, controls=[0.0, 0.0])
    assert ranks(found) == [1, 1, 1] and not found.accessible


def test_wheels_on_rails_reach_no_pose_beside_them():
    """Its single velocity is reached, but two directions of the pose are not."""
    rail = Nonholonomic(
        name="rail",
        group=SE2,
        lagrangian=lambda r, u, xi: (xi[0] ** 2 + 2 * xi[1] ** 2 + 2 * xi[2] ** 2) / 2,
        constraints=lambda r: (ca.SX(2, 0), ca.DM([[1, 0, 0], [0, 0, 1]])),
        forces=lambda r, u, xi, c: (ca.SX(0, 1), ca.vertcat(0, c[0], 0)),
        controls=(Control("push"),),
    )
    found = symmetric_closure(rail)
    assert ranks(found) == [1] and found.unreached == 2 and not found.accessible and not found.controllable
    free = symmetric_closure(vehsim.load_vehicle("snakeboard"))
    assert free.unreached == 0 and free.controllable


def test_unbalanced_states_are_refused():
    with pytest.raises(InputError, match="do not balance it"):
        symmetric_closure(vehsim.load_vehicle("helicopter"), controls=[0.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match=r"-9\.81\]; its equations .* the water .*: use `vehicle\.planar`"):
        symmetric_closure(vehsim.load_vehicle("boat"))
    with pytest.raises(InputError, match="no controls"):
        symmetric_closure(vehsim.load_vehicle("tumbler"))


def test_a_vehicle_moved_by_rates_alone_has_brackets_instead():
    """Rates set the hopper's leg: there is no force to multiply, and brackets apply (SIN: growth (2, 3))."""
    hopper = vehsim.load_vehicle("hopper")
    with pytest.raises(InputError, match="psi_rate, stretch_rate set rates and push nothing"):
        symmetric_closure(hopper)
    assert classify(rigged(hopper).system).growth == (2, 3)
