"""The helicopter's aerodynamics against momentum theory and the published trim of the Bo 105."""

import math
import shutil
import tomllib
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import scipy.optimize

import vehsim
from vehsim.constants import AIR, GRAVITY
from vehsim.errors import InputError
from vehsim.planning.trim import steady
from vehsim.rig.linkage import moved
from vehsim.rig.ops import frames_of
from vehsim.vehicles.models.rotor import Rotor

BO105 = Path(__file__).parents[2] / "benchmarks/bo105"
HOVER = {"pitch": 2.64, "roll": -2.97}
"""Degrees, at 2096 kg: Heffley et al., NASA CR-3144 (1979), Table III-3, case 29."""
FLIGHT = [
    (0.1, 2.71), (4.9, 2.86), (8.0, 2.43), (15.7, 2.58), (17.1, 3.15), (26.6, 3.23), (38.6, -0.21), (48.1, 0.12),
    (59.4, -0.66), (67.1, -1.88), (77.9, -2.27), (95.8, -4.34),
]  # fmt: skip
"""Speed in knots and pitch in degrees in flight tests: Padfield, Helicopter Flight Dynamics (1996), Fig. 4.6(a)."""
POWER = [
    (4.0, 393), (6.3, 380), (8.2, 345), (11.7, 333), (20.4, 308), (21.7, 283), (26.5, 271), (33.0, 247), (45.9, 217),
    (58.9, 230), (68.7, 236), (77.9, 265), (99.2, 352),
]  # fmt: skip
"""Speed in knots and power in kW in flight tests: the same, Fig. 4.11."""
MATRICES = [
    (0, 0.0392, 0.4445), (20, 0.0343, 0.3763), (40, 0.0223, 0.2856), (60, 0.0036, 0.2558), (80, -0.0204, 0.2705),
    (100, -0.0484, 0.3198), (120, -0.0794, 0.4027), (140, -0.1160, 0.5336),
]  # fmt: skip
"""Padfield's own calculation, from his system matrices, second edition (2007), pages 287 to 291: speed in knots, and
two elements, cos(roll) tan(pitch), which couples the yaw rate to roll, and -g sin(roll) cos(pitch), m/s^2."""
COLLECTIVE = [(50.1, 12.086), (60.3, 12.143), (70.5, 12.571), (80.7, 13.057), (100.2, 14.514)]
"""Speed in knots and collective pitch in degrees in flight tests: Padfield (1996), Fig. 4.10(c), from 50 knots on."""
AS_FLOWN = 0.90
"""Drag of hub and all else that the fuselage's 1.02 m^2 leave out, m^2, in those flight tests: from `COLLECTIVE`."""
KNOT = 0.514444


def trimmed(vehicle, speed):
    found = steady(vehicle, (speed, 0.0, 0.0))
    assert np.abs(found.residual).max() < 1e-2  # N and N m
    return found


@pytest.fixture(scope="module")
def bo105():
    """Loaded as in Heffley's hover: the centre of mass is 0.018 m behind the hub."""
    return vehsim.load_vehicle(BO105, {"mass": 2096.0, "hub_ahead": 0.018, "d_r": 5.99})


def body(found, speed, climb=0.0):
    """A horizontal and a vertical speed along the body's axes."""
    a, b = found.pitch, found.roll  # the body's axes in the world: nose up about -Y, then right side down about X
    nose = np.array([[np.cos(a), 0, -np.sin(a)], [0, 1, 0], [np.sin(a), 0, np.cos(a)]])
    side = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return (nose @ side).T @ [speed, 0, climb]


def shaft_power(vehicle, speed, climb=0.0):
    """Power in steady flight at a horizontal and a vertical speed, W."""
    found = steady(vehicle, (speed, 0.0, climb))
    assert np.abs(found.residual).max() < 1e-2  # N and N m
    air, c = ca.SX.sym("air", 6), ca.SX.sym("c", 4)
    law = ca.Function("power", [air, c], [vehicle.power(air, c, math.inf)])
    return float(law(np.concatenate([np.zeros(3), body(found, speed, climb)]), found.controls))


def test_hover_attitude_is_the_published_one(bo105):
    found = trimmed(bo105, 0.0)
    assert np.degrees(found.pitch) == pytest.approx(HOVER["pitch"], rel=0.05)
    assert np.degrees(found.roll) == pytest.approx(HOVER["roll"], rel=0.05)


def test_pitch_and_roll_against_speed_are_those_that_padfield_calculates():
    """With his numbers, so without drag of the hub. In pitch 2 % of its change up to 100 knots, 8 % at 140. Roll is 7
    to 13 % larger, because his induced velocity has no factor of 1.15."""
    vehicle = vehsim.load_vehicle(BO105, {"hub_drag": 0.0})
    speeds, coupling, side = np.array(MATRICES, float).T
    pitch = np.arctan(coupling)
    for _ in range(3):
        roll = -np.arcsin(side / (GRAVITY * np.cos(pitch)))
        pitch = np.arctan(coupling / np.cos(roll))
    found = [trimmed(vehicle, float(v) * KNOT) for v in speeds]
    off = np.abs([f.pitch for f in found] - pitch) / np.ptp(pitch)
    assert off.max() < 0.08 and off[speeds <= 100].max() < 0.02
    assert np.array([f.roll for f in found]) / roll == pytest.approx(1.10, abs=0.03)
    bare = vehsim.load_vehicle(BO105, {"hub_drag": 0.0, "induced_factor": 1.0})
    assert trimmed(bare, 0.0).roll == pytest.approx(roll[0], rel=0.02)


def test_the_centre_of_mass_is_where_padfields_hover_has_it():
    """More collective in hover pushes along the rotor's axis: its moment over its force is the place of the hub."""
    x, z, m = 3.6533 * 2200, 92.9573 * 2200, -5.6815 * 4973  # N and N m (nose up) per rad of collective
    hub_ahead = (m + 1.48 * x) / z
    assert hub_ahead == pytest.approx(-0.0163 * 4.91, abs=1e-4)
    numbers = tomllib.loads((BO105 / "vehicle.toml").read_text())["physics"]
    assert numbers["hub_ahead"] == pytest.approx(hub_ahead, abs=1e-4)


@pytest.mark.parametrize(
    ("knots", "n_v", "l_v", "y_pedal"),
    [(60, 0.1041, -0.2813, 5.6547), (80, 0.1283, -0.2812, 6.3678), (100, 0.1465, -0.2937, 6.9809),
     (120, 0.1612, -0.3148, 7.5485), (140, 0.1732, -0.3455, 8.1049)],
)  # fmt: skip
def test_the_fuselage_turns_as_padfields_matrices_say(knots, n_v, l_v, y_pedal):
    """His yaw moment per sideways speed, less those of tail rotor and fin. A tail rotor's thrust per speed along its
    axis over that per blade angle is 1/2 over 1/3 + mu^2 / 2, per tip speed (blade elements)."""
    numbers = tomllib.loads((BO105 / "vehicle.toml").read_text())["physics"]
    speed, tip = knots * KNOT, numbers["tail_radius"] * numbers["tail_rotor_speed"]
    tail = numbers["d_r"] * 2200 * y_pedal / tip * 0.5 / (1 / 3 + (speed / tip) ** 2 / 2)
    fin = numbers["fin_behind"] * AIR / 2 * numbers["fin_area"] * speed
    fuselage = 4099 * n_v - 660 * l_v - tail - fin
    assert numbers["fuselage_moments"][2] == pytest.approx(fuselage / (AIR / 2 * speed), rel=0.15)


def test_pitch_against_speed_follows_flight_tests():
    """Of its change from hover to cruise, 20 % off at worst; Padfield's own calculation is off by 25 %: see
    docs/derivations.md."""
    vehicle = vehsim.load_vehicle(BO105)
    speeds, measured = np.array(FLIGHT).T
    pitch = np.degrees([trimmed(vehicle, float(v) * KNOT).pitch for v in speeds])
    off = np.abs(pitch - measured) / np.ptp(measured)
    assert off.max() < 0.20 and off.mean() < 0.115
    assert (np.sort(off[speeds > 45]) < [0.09, 0.09, 0.105, 0.145, 0.175]).all()


def test_power_is_what_padfields_roll_stands_for():
    """The tail rotor that balances the torque causes the roll, which is linear in the power. From 0 to 140 knots, ours
    is 8 to 13 % more than that of his roll: his induced velocity has no factor of 1.15."""
    less, ours = (vehsim.load_vehicle(BO105, {"hub_drag": 0.0, "induced_factor": k}) for k in (0.4, 1.15))
    for knots, coupling, side in MATRICES:
        speed = knots * KNOT
        roll = -side / GRAVITY * np.hypot(1, coupling)  # to 1e-4: his pitch is small, and so is its sine
        rolls = [trimmed(v, speed).roll for v in (ours, less)]
        power = [shaft_power(v, speed) for v in (ours, less)]
        his = np.interp(roll, rolls, power)
        assert 1.06 < power[0] / his < 1.14


@pytest.mark.parametrize("knots", [0, 60, 100, 130])
def test_the_work_of_the_in_plane_drag_counts_once(knots):
    """The main rotor's power is that of its inflow, that of all other drag, and 1 + 4.65 mu^2 times the hover's profile
    power. Counted twice, the blades' drag in the plane of the disc is 3 % at 130 knots."""
    vehicle, speed = vehsim.load_vehicle(BO105), knots * KNOT
    found = trimmed(vehicle, speed)
    main, tail = Rotor(4.91, 44.4, 0.07, 0.0083, 1.15), Rotor(0.95, 232.7, 0.12, 0.0083, 1.15)
    thrust, push, tilt, _ = np.ravel(found.controls)
    v = body(found, speed)
    along, air = speed * np.sin(tilt + 0.0524 - found.pitch), ca.SX.sym("air", 6)
    force = np.ravel(ca.Function("drag", [air], [vehicle.drag(air)])([0, 0, 0, *v]))[3:]
    other = -force @ v - main.drag * (v[0] ** 2 + v[1] ** 2)
    inflow = float(ca.evalf(ca.SX(main.induced(thrust, along, speed**2 - along**2))))
    profile = main.profile_power * (1 + 4.65 * (speed / main.tip_speed) ** 2)
    aft = float(ca.evalf(ca.SX(tail.power(push, -v[1], v[0] ** 2 + v[2] ** 2))))
    expected = 1.15 * thrust * inflow + profile + other
    assert shaft_power(vehicle, speed) - aft == pytest.approx(expected, rel=0.004)


def blade_pitch(speed, drag):
    """Collective pitch (rad) of the Bo 105's main rotor in level flight, and its induced and profile power (W).

    Blade elements in the plane of the disc with Padfield's section and twist and even inflow, without lift on the outer
    3 % and without blades on the inner 20 %.
    """
    radius, chords, twist, slope, weight = 4.91, 4 * 0.27, -0.14, 6.113, 2200 * GRAVITY
    tip = 44.4 * radius
    x, psi = (0.2 + 0.8 * (np.arange(40) + 0.5) / 40)[:, None], (np.arange(72) + 0.5) / 72 * 2 * np.pi
    sin, cos = np.sin(psi), np.cos(psi)
    strip = AIR / 2 * chords * 0.8 * radius / (40 * 72) * tip**2
    in_plane = 0.0
    for _ in range(3):
        thrust, lean = np.hypot(weight, drag + in_plane), np.arctan2(drag + in_plane, weight)
        mu, along = speed * np.cos(lean) / tip, speed * np.sin(lean)
        rotor = Rotor(radius, 44.4, 0.07, 0.0083, 1.0)
        induced = float(ca.evalf(ca.SX(rotor.induced(thrust, along, (mu * tip) ** 2))))
        u, up = x + mu * sin, (along + induced) / tip + 0 * psi

        def loads(pitch, u=u, up=up, mu=mu):
            inflow = np.arctan2(up, np.abs(u))
            attack = pitch[0] + twist * x + pitch[1] * cos + pitch[2] * sin
            attack = np.clip(np.where(u > 0, attack - inflow, -attack - inflow), -0.25, 0.25)
            size, c_d = np.hypot(u, up), 0.0074 + 0.00961 * attack + 0.29395 * attack**2
            lift, c_d = strip * slope * attack * (x < 0.97), strip * c_d
            up_force = size * (lift * np.abs(u) - c_d * up)
            back = size * (lift * up + c_d * np.abs(u)) * np.sign(u)
            radial = c_d * np.sqrt(size**2 + (mu * cos) ** 2) * mu * cos
            return up_force, back, back * sin + radial * cos

        def balance(pitch, loads=loads, thrust=thrust):
            up_force = loads(pitch)[0]
            return np.array([up_force.sum() - thrust, (up_force * x * cos).sum(), (up_force * x * sin).sum()]) / thrust

        pitch = scipy.optimize.fsolve(balance, [0.2, 0.0, -0.05])
        _, back, force = loads(pitch)
        in_plane = force.sum()
    useful = (thrust * np.sin(lean) - in_plane * np.cos(lean)) * speed
    return pitch[0], (back * x).sum() * tip - useful


@pytest.mark.parametrize("knots", [0, 40, 80, 120, 140])
def test_induced_and_profile_power_are_those_of_blade_elements(knots):
    """With the published section: 6 % less in hover, at most 7 % more in cruise."""
    speed, main = knots * KNOT, Rotor(4.91, 44.4, 0.07, 0.0083, 1.15)
    drag = AIR / 2 * 1.246 * speed**2
    lean = np.arctan2(drag, 2200 * GRAVITY)
    thrust, along = np.hypot(drag, 2200 * GRAVITY), speed * np.sin(lean)
    across = speed**2 - along**2
    ours = float(ca.evalf(ca.SX(main.power(thrust, along, across)))) - thrust * along + main.drag * across
    assert blade_pitch(speed, drag)[1] / ours == pytest.approx(1.0, abs=0.07)


def test_the_measured_collective_asks_for_the_drag_as_flown():
    """From 50 to 100 knots, its rise is that of a total drag of 1.9 m^2, whatever its zero is. Power is not used."""
    speeds, measured = np.array(COLLECTIVE).T
    pitch = [[blade_pitch(v * KNOT, AIR / 2 * f * (v * KNOT) ** 2)[0] for v in speeds] for f in (1.7, 2.1)]
    low, high = np.degrees(pitch)
    columns = np.stack([high - low, np.ones_like(low)], 1)
    (share, _), residual, *_ = np.linalg.lstsq(columns, measured - low, rcond=None)
    assert 1.7 + 0.4 * share == pytest.approx(1.02 + AS_FLOWN, abs=0.03)
    assert np.sqrt(residual[0] / len(speeds)) < 0.06  # degrees; 0.3 with the 1.25 m^2 of the vehicle's data
    short = measured - np.degrees([blade_pitch(v * KNOT, AIR / 2 * 1.246 * (v * KNOT) ** 2)[0] for v in speeds])
    assert np.std(short) > 0.25


def test_power_against_speed_follows_flight_tests():
    """Without losses in gears, as flown: at most 12 % off. With the drag of the data as published, from 60 knots on
    flight tests need 14 to 28 % more: see docs/derivations.md."""
    speeds, measured = np.array(POWER, float).T
    published, flown = (
        np.array([shaft_power(vehicle, float(v) * KNOT) for v in speeds]) / 1e3 / measured - 1
        for vehicle in (vehsim.load_vehicle(BO105), vehsim.load_vehicle(BO105, {"hub_drag": AS_FLOWN}))
    )
    assert np.abs(flown).max() < 0.12
    assert np.abs(published[speeds < 50]).max() < 0.09 and published.min() > -0.285


def test_pitch_as_flown_follows_flight_tests_once_the_wake_has_left_the_tail():
    vehicle = vehsim.load_vehicle(BO105, {"hub_drag": AS_FLOWN})
    speeds, measured = np.array(FLIGHT).T
    pitch = np.degrees([trimmed(vehicle, float(v) * KNOT).pitch for v in speeds])
    off = np.abs(pitch - measured) / np.ptp(measured)
    assert off[speeds > 30].max() < 0.155 and off[speeds > 30].mean() < 0.08 and off.max() < 0.225


def test_power_has_its_bucket(bo105):
    """Light helicopters need least power at 55 to 70 knots; a hover a third to two thirds more than momentum theory."""
    speeds = np.arange(0.0, 140.0, 5.0) * KNOT
    power = np.array([shaft_power(bo105, float(v)) for v in speeds])
    assert 55 <= speeds[power.argmin()] / KNOT <= 70
    ideal = 2096 * GRAVITY * np.sqrt(2096 * GRAVITY / (2 * AIR * np.pi * 4.91**2))
    assert 1.33 < power[0] / ideal < 1.67
    assert power.min() < 0.6 * power[0]


@pytest.fixture(scope="module")
def loaded():
    return vehsim.load_vehicle(BO105, {"mass": 2400.0})


def test_the_power_of_the_fastest_cruise_climbs_as_published(loaded):
    """440 m/min at the power of 240 km/h: both are at the same, continuous power, so its amount does not matter."""
    climb = 440 / 60
    assert shaft_power(loaded, 60 * KNOT, climb) == pytest.approx(shaft_power(loaded, 240 / 3.6), rel=0.05)
    lower, upper = (shaft_power(loaded, 60 * KNOT, share * climb) for share in (0.85, 1.15))
    assert lower < shaft_power(loaded, 240 / 3.6) < upper


def test_hub_drag_is_what_the_published_climb_asks_for():
    """Without it, the power of the fastest cruise climbs 24 % too slowly."""
    bare = vehsim.load_vehicle(BO105, {"mass": 2400.0, "hub_drag": 0.0})
    assert shaft_power(bare, 60 * KNOT, 0.85 * 440 / 60) > shaft_power(bare, 240 / 3.6)


def test_best_climb_and_best_range_are_flown_at_the_published_speeds(loaded):
    """60 and 110 knots (204 km/h). Idle fuel is worth 98 kW per engine: see docs/derivations.md."""
    speeds = np.arange(45.0, 130.0, 2.5)
    power = np.array([shaft_power(loaded, float(v) * KNOT) for v in speeds])
    assert speeds[power.argmin()] == pytest.approx(60, rel=0.15)
    assert speeds[((power + 196e3) / speeds).argmin()] == pytest.approx(204 / 1.852, rel=0.07)


def test_fuel_flow_in_cruise_is_the_published_one(loaded):
    """About 200 l/h at 210 km/h. Two engines of 62.3 lb/h and 0.4745 lb/h per horsepower, and 0.8 kg/l."""
    pounds = 2 * 62.3 + 0.4745 * shaft_power(loaded, 210 / 3.6) / 745.7
    assert pounds * 0.4536 / 0.8 == pytest.approx(200, rel=0.15)


def test_drag_of_the_hub_acts_at_the_hub():
    with_hub, without = (vehsim.load_vehicle(BO105, {"hub_drag": area}) for area in (0.5, 0.0))
    air = ca.SX.sym("air", 6)
    more = ca.Function("more", [air], [with_hub.drag(air) - without.drag(air)])
    force = AIR / 2 * 0.5 * 50.0**2
    assert np.ravel(more([0, 0, 0, 50, 0, 0])) == pytest.approx([0, -force * 1.48, 0, -force, 0, 0], rel=1e-6)
    assert np.ravel(more([0, 0, 0, 0, -50, 0])) == pytest.approx(
        [-force * 1.48, 0, -force * 0.08, 0, force, 0], rel=1e-6
    )


@pytest.mark.parametrize("across", [0.0, 5.0, 10.0, 30.0, 60.0])
@pytest.mark.parametrize("along", [-8.0, -3.0, 0.0, 6.0, 15.0])
def test_induced_velocity_is_glauerts(across, along):
    rotor = Rotor(5.0, 40.0, 0.06, 0.01, 1.15)
    thrust = 2 * AIR * rotor.area * 100.0  # 10 m/s in hover
    v = float(ca.evalf(ca.SX(rotor.induced(thrust, along, across**2))))
    assert v * np.hypot(across, along + v) == pytest.approx(100.0, rel=0.05 if along == -8.0 else 0.02)


def cushion(rotor, height, across, free):
    return float(ca.evalf(ca.SX(rotor.cushion(height, across, free))))


@pytest.mark.parametrize(("radii", "hayden"), [(0.57, 0.6853), (1.0, 0.8740), (1.5, 0.9434), (2.0, 0.9704)])
def test_a_hover_near_the_ground_needs_haydens_share_of_induced_power(radii, hayden):
    """Values of 1 / (0.9926 + 0.0379 (2 R / z)^2) by hand."""
    assert cushion(Rotor(5.0, 40.0, 0.06, 0.01, 1.15), 5.0 * radii, 0.0, 10.0) == pytest.approx(hayden, abs=2e-4)


def test_the_cushion_ends_above_the_ground_and_is_bounded_below_the_rotor():
    rotor = Rotor(5.0, 40.0, 0.06, 0.01, 1.15)
    assert cushion(rotor, 25.0, 0.0, 10.0) == cushion(rotor, math.inf, 0.0, 10.0) == 1.0
    assert cushion(rotor, 0.0, 0.0, 10.0) == cushion(rotor, 2.5, 0.0, 10.0) == pytest.approx(0.6254, abs=2e-4)


@pytest.mark.parametrize("radii", [0.5, 0.57, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0])
def test_thrust_near_the_ground_is_cheeseman_and_bennetts(radii):
    """At the power of a free hover, the rotor of a Bo 105 lifts 1 / (1 - (R / 4 z)^2) times as much near the ground."""
    rotor, weight = Rotor(4.91, 44.4, 0.07, 0.0083, 1.15), 2200 * GRAVITY
    t, z = ca.SX.sym("t"), 4.91 * radii
    power = ca.Function("power", [t], [rotor.power(t, 0.0, 1e-6, z)])
    free = float(ca.evalf(ca.SX(rotor.power(weight, 0.0, 1e-6))))
    lifts = np.linspace(1.0, 1.4, 4001)
    ratio = np.interp(free, np.asarray(power.map(4001)(weight * lifts[None])).ravel(), lifts)
    assert ratio == pytest.approx(1 / (1 - (1 / (4 * radii)) ** 2), rel=0.05)


def test_the_cushion_fades_with_speed_as_cheeseman_and_bennett_say():
    rotor = Rotor(5.0, 40.0, 0.06, 0.01, 1.15)
    saved = [1 - cushion(rotor, 5.0, speed**2, 10.0) for speed in (0.0, 10.0, 30.0)]
    assert np.array(saved[1:]) / saved[0] == pytest.approx([1 / 2, 1 / 10], rel=1e-3)


@pytest.mark.parametrize("g", [0.6, 1.0, 1.4])
def test_blades_cone_as_their_elements_balance(g):
    """Blades without twist in uniform inflow: their pitch from the thrust, their coning from moments about the hinge,
    both summed over elements."""
    radius, speed, solidity, lock, thrust = 5.35, 40.8, 0.0625, 6.7, g * 18639.0
    rotor = Rotor(radius, speed, solidity, 0.01, 1.15)
    inflow, chords, slope = math.sqrt(thrust / (2 * AIR * rotor.area)), solidity * math.pi * radius, 5.7
    r = (np.arange(20000) + 0.5) / 20000 * radius
    per_pitch = AIR / 2 * slope * chords * (speed * r) ** 2  # lift per length and pitch, N/m
    lost = AIR / 2 * slope * chords * speed * r * inflow
    pitch = (thrust / radius + lost.mean()) / per_pitch.mean()
    moment = ((pitch * per_pitch - lost) * r).mean() * radius
    inertia = AIR * slope * chords * radius**4 / lock
    assert float(rotor.coning(thrust, lock)) == pytest.approx(moment / (inertia * speed**2), rel=1e-6)


def test_blades_of_the_rig_rise_with_thrust():
    """In hover they stand as they were modelled; with 1.2 instead of 0.8 g their tips are 11 cm higher."""
    heli = vehsim.load_vehicle("helicopter")
    c = ca.SX.sym("c", 4)
    names = [f"coning_{k}" for k in (1, 2, 3)]
    law = ca.Function("law", [c], [ca.vertcat(*(heli.channels[name].value(0, c, c, c, c) for name in names))])
    weight = GRAVITY * 1900.0
    raised = np.array([np.ravel(law([g * weight, 0, 0, 0])) for g in (0.8, 1.0, 1.2)])
    assert np.degrees(raised[1]) == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    assert len(set(np.round(raised[0], 12))) == 1
    for k in (1, 2, 3):
        path = f"main_rotor/blade_{k}"
        outward = frames_of(heli.rig)[path] @ [0.0, 5.24, 5.24 * math.tan(math.radians(3.2)), 1.0]
        R, p = moved(heli.rig, path, dict(zip(names, raised.T, strict=True)), 3)
        tips = R @ outward[:3] + p
        assert tips[1] == pytest.approx(outward[:3], abs=2e-3)
        assert tips[2, 2] - tips[0, 2] == pytest.approx(0.11, abs=0.01)


def test_a_channel_moves_several_prims_by_a_list_or_by_numbered_tables(tmp_path):
    """The shipped list of blades, and the same in tables of their own, drive the same prims with the same law."""
    shipped = vehsim.load_vehicle("helicopter")
    text = (shipped.rig.folder / "vehicle.toml").read_text()
    listed = text[text.index("[channels.coning]") : text.index("[channels.tail_rotor]")]
    tables = "".join(
        f'[channels.coning_{k}]\nprim = "main_rotor/blade_{k}"\nop = "rotateX"\n' for k in (1, 2, 3)
    )  # fmt: skip
    shutil.copy(shipped.rig.asset, tmp_path / "helicopter.usdc")
    (tmp_path / "vehicle.toml").write_text(text.replace(listed, tables))
    own = vehsim.load_vehicle(tmp_path)
    assert own.rig.drives == shipped.rig.drives and list(own.channels) == list(shipped.channels)
    for wrong in ("[channels.coned_1]", "[channels.coning_x]", "[channels.yaw_1]"):
        (tmp_path / "vehicle.toml").write_text(text.replace(listed, tables.replace("[channels.coning_1]", wrong)))
        with pytest.raises(InputError, match="channels"):
            vehsim.load_vehicle(tmp_path)


def test_the_papers_blades_do_not_cone():
    bare = vehsim.load_vehicle("helicopter_lie")
    c = ca.SX.sym("c", 4)
    law = ca.Function("law", [c], [bare.channels["coning_1"].value(0, c, c, c, c)])
    assert float(law([18e3, 0, 0, 0])) == 0


def test_torque_turns_the_nose_to_the_right_and_the_tail_rotor_holds_it(bo105):
    air, c = ca.SX.sym("air", 6), ca.SX.sym("c", 4)
    torque = ca.Function("torque", [air, c], [bo105.rotors(air, c, math.inf)])
    found = trimmed(bo105, 0.0)
    turning = np.asarray(torque(np.zeros(6), found.controls)).ravel()
    assert turning[2] < 0 and found.controls[1] == pytest.approx(-turning[2] / 6.0, rel=0.02)
    assert found.roll < 0  # it leans to the left against the tail rotor's push


def test_cruise_needs_less_tail_rotor_and_a_nose_that_is_lower(bo105):
    hover, cruise = trimmed(bo105, 0.0), trimmed(bo105, 40.0)
    assert cruise.pitch < hover.pitch - np.radians(3) and abs(cruise.roll) < abs(hover.roll)
    assert cruise.controls[1] < 0.6 * hover.controls[1]


def test_the_pilot_holds_a_helicopter_whose_rotor_reacts():
    """Torque, tail rotor, hub and mast of the Bo 105: it hovers on its place at its banked attitude."""
    vehicle = vehsim.load_vehicle(BO105)
    pilot = vehsim.pilots.Hover(vehicle, (0.0, 0.0, 30.0))
    start = vehsim.State(position=(0.0, 0.0, 30.0))
    clip = vehsim.simulate(vehicle, vehsim.World(), pilot, start=start, duration=25.0, step=1 / 120)
    assert np.linalg.norm(clip.positions[-1] - [0, 0, 30]) < 0.1 and np.abs(clip.twists[-1]).max() < 0.02
    w, x = clip.orientations[-1, :2]
    assert np.degrees(2 * x * w) == pytest.approx(np.degrees(steady(vehicle, (0.0, 0.0, 0.0)).roll), abs=0.1)


def test_the_page_of_vehicles_tells_the_shipped_trim():
    """docs/vehicles.md: bank to the left and nose down, degrees, thrust of the tail rotor, N, and power, kW."""
    text = (Path(__file__).parents[2] / "docs/vehicles.md").read_text(encoding="utf-8")
    table = text[text.index("| speed, m/s | 0 | 10 | 20 |") :].split("\n\n")[0].splitlines()
    rows = [[float(cell.replace(",", "")) for cell in table[k].split("|")[2:-1]] for k in (0, 2, 3, 4, 5)]
    vehicle = vehsim.load_vehicle("helicopter")
    for speed, bank, down, tail, power in zip(*rows, strict=True):
        found = trimmed(vehicle, speed)
        assert np.degrees([-found.roll, -found.pitch]) == pytest.approx([bank, down], abs=0.06), speed
        assert found.controls[1] == pytest.approx(tail, abs=1), speed
        assert shaft_power(vehicle, speed) / 1e3 == pytest.approx(power, abs=0.6), speed
