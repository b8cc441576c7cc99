"""`four_wheel_car` against closed forms: loads and attitude in steady motion, energy, differentials, and standstill."""

import math

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.lie.quaternions import tilt_of
from vehsim.vehicles import State
from vehsim.vehicles.models.four_wheel_car import four_wheel_car
from vehsim.vehicles.models.tyres import LATERAL, LONGITUDINAL, WEIGHTS_LATERAL, WEIGHTS_LONGITUDINAL, Tyre

G = 9.81
MASS, HEIGHT, HALF, AXLE = 1350, 0.5, 0.77, 1.3
SPRING, BARS = 26000.0, (18000.0, 14000.0)
WHEELS = ("fl", "fr", "rl", "rr")
STEPS = 2400


def driven(parameters, start, seconds, **controls):
    """A clip with controls linear between values evenly spaced over the time."""
    vehicle = vehsim.load_vehicle("rally_car", parameters)
    times = np.linspace(0, seconds, round(STEPS * seconds) + 1)
    rows = np.zeros((len(times), 4))
    for name, values in controls.items():
        rows[:, vehicle.control_names.index(name)] = np.interp(times, np.linspace(0, seconds, len(values)), values)
    return Integrator(vehicle, times[1]).rollout(start, rows)


def column(clip, name):
    return clip.joints[:, clip.vehicle.joints.index(name)]


def loads(clip, k=-1):
    return np.array([clip.channels[f"load_{wheel}"][k] for wheel in WHEELS])


def test_a_steady_bend_leans_the_body_and_shifts_loads():
    clip = driven(
        {}, State(twist=(0, 12, 0)), 4.0, steering_rate=[0.12, 0.12, 0, 0, 0, 0, 0, 0, 0], drive=[0, 400, 400]
    )
    turn, along, _ = clip.twists[-1]
    across = turn * along
    assert 3 < across < 7
    stiffness = 4 * SPRING * HALF**2 + sum(BARS)
    lean = MASS * HEIGHT * across / (stiffness - MASS * G * HEIGHT)
    assert column(clip, "roll")[-1] == pytest.approx(lean, rel=0.03)
    shift = [(2 * SPRING * HALF**2 + bar) * column(clip, "roll")[-1] / (2 * HALF) for bar in BARS]
    inner_front, outer_front, inner_rear, outer_rear = loads(clip)
    assert (outer_front - inner_front) / 2 == pytest.approx(shift[0], rel=1e-2)
    assert (outer_rear - inner_rear) / 2 == pytest.approx(shift[1], rel=1e-2)
    assert loads(clip).sum() == pytest.approx(MASS * G, rel=2e-3)


@pytest.mark.parametrize("controls, sign", [({"drive": [1500, 1500]}, -1), ({"brake": [2500, 2500]}, 1)])
def test_it_squats_and_dives(controls, sign):
    clip = driven({}, State(twist=(0, 25, 0)), 2.0, **controls)
    along = np.gradient(clip.twists[:, 1], clip.times)[-10]
    tilt = -MASS * HEIGHT * along / (4 * SPRING * AXLE**2 - MASS * G * HEIGHT)
    assert sign * tilt > 0.01
    assert column(clip, "pitch")[-10] == pytest.approx(tilt, rel=0.03)
    front, rear = loads(clip, -10)[:2].sum(), loads(clip, -10)[2:].sum()
    lever = MASS * along * HEIGHT + MASS * G * HEIGHT * column(clip, "pitch")[-10] * -1
    assert (rear - front) * AXLE == pytest.approx(lever, rel=0.03)


def test_the_clip_shows_the_attitude_on_level_ground_without_a_terrain():
    vehicle = vehsim.load_vehicle("rally_car")
    clip = vehsim.simulate(vehicle, None, [0, 4000, 0, 0.5], State(twist=(0, 15, 0)), 0.5)
    _, pitch, roll = tilt_of(clip.orientations)
    np.testing.assert_allclose(pitch, column(clip, "pitch"), atol=2e-3)
    np.testing.assert_allclose(roll, column(clip, "roll"), atol=2e-3)
    assert pitch.max() > 0.02 and roll.max() > 0.02
    from vehsim.world.ground.placing import place_on_terrain

    again = place_on_terrain(clip, None)
    np.testing.assert_allclose(again.positions, clip.positions, atol=1e-9)


def test_nothing_but_drive_adds_energy():
    """With locked wheels, released springs and no drive, the energy falls at every step."""
    clip = driven(
        {}, State(twist=(2.0, 12, 3.0), joints=(0, 0, 0, 0.2, 0.03, 0.02, -0.05)), 1.5, handbrake=[4000, 4000]
    )
    vehicle, u = clip.vehicle, clip.joint_rates
    heave, pitch, roll = (column(clip, name) for name in ("heave", "pitch", "roll"))
    at = [vehicle.joints.index(name) for name in ("psi_fl", "psi_fr", "psi_r", "heave", "pitch", "roll")]
    turn, along, across = clip.twists.T
    height = HEIGHT + heave
    surge = along + turn * height * roll + height * u[:, at[4]] + pitch * u[:, at[3]]
    sway = across + turn * height * pitch - height * u[:, at[5]] - roll * u[:, at[3]]
    upright = 1 - (pitch**2 + roll**2) / 2
    up = upright * u[:, at[3]] - height * (pitch * u[:, at[4]] + roll * u[:, at[5]])
    engine = 0.5 * (u[:, at[0]] + u[:, at[1]]) / 2 + 0.5 * u[:, at[2]]
    kinetic = MASS * (surge**2 + sway**2 + up**2) + 1820 * turn**2 + 1700 * u[:, at[4]] ** 2
    kinetic += (
        480 * u[:, at[5]] ** 2 + 1.2 * (u[:, at[0]] ** 2 + u[:, at[1]] ** 2 + 2 * u[:, at[2]] ** 2) + 7.6 * engine**2
    )
    travel = [heave - x * pitch + y * roll for x in (AXLE, -AXLE) for y in (HALF, -HALF)]
    springs = sum(SPRING * z**2 for z in travel) + sum(BARS) * roll**2
    # the springs carry the weight at rest
    energy = (kinetic + springs) / 2 + MASS * G * (height * upright - HEIGHT - heave)
    assert np.diff(energy).max() < 1e-4 * energy[0]
    assert energy[-1] < 0.5 * energy[0]


@pytest.mark.parametrize("locked", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_differentials(locked):
    clip = driven({"locked": locked}, State(twist=(0, 8, 0)), 1.0, steering_rate=[0.6, 0.6, 0])
    front, rear = (clip.channels[f"roll_{axle}r"] - clip.channels[f"roll_{axle}l"] for axle in "fr")
    assert (np.abs(front).max() < 1e-12) == bool(locked[0])
    assert (np.abs(rear).max() < 1e-12) == bool(locked[1])
    if not locked[1]:
        turned = tilt_of(clip.orientations)[0][-1]
        assert rear[-1] * 0.32 == pytest.approx(2 * HALF * turned, rel=0.03)


def test_an_open_differential_gives_equal_torques():
    """Also where the wheels turn and are loaded differently: both accelerate by half the torque over their inertia and
    half the engine's."""
    vehicle = vehsim.load_vehicle("rally_car", {"drive_front": 0.0, "locked": (0, 0)})
    rates = (25.0, 25.0, 24.0, 26.0, 0.0, 0.0, 0.0, 0.0)
    start, step = State(twist=(0, 8, 0), joints=(0, 0, 0, 0, 0, 0, 0, 0.03), joint_rates=rates), 1e-6
    idle, driven = (
        Integrator(vehicle, step).rollout(start, np.tile([drive, 0, 0, 0], (3, 1))).joint_rates[-1, :4]
        for drive in (0, 2000)
    )
    gained = 2 * step * 1000 / (1.2 + 7.6 / 2)
    np.testing.assert_allclose(driven - idle, [0, 0, gained, gained], rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize("drive_front", [0.0, 0.5, 1.0])
def test_drive_layouts(drive_front):
    clip = driven({"drive_front": drive_front, "locked": (0, 0)}, State(), 0.6, drive=[3000, 3000])
    spins = [clip.channels[f"slip_{wheel}"][-1] > 0.05 for wheel in ("fl", "rl")]
    assert spins == [drive_front > 0, drive_front < 1]
    assert 3 < clip.twists[-1, 1] / 0.6 < 7


# CommonRoad's multi-body model, run by `benchmarks/four_wheel_car.py` with symmetric tyres: yaw rate rad/s and lateral
# acceleration m/s^2 of the whole car's centre, every quarter of a second
MULTI_BODY = {
    "lane change, 30 m/s, 1": (
        [0.1998, 0.2885, 0.0472, -0.27, -0.2025, -0.0476, -0.0093, -0.0018],
        [4.149, 6.338, 3.441, -4.157, -4.942, -3.304, -1.043, -0.279],
    ),
    "bend, 15 m/s, 0.67": (
        [0.0097, 0.1888, 0.255, 0.2571, 0.2572, 0.2568, 0.2565, 0.2562],
        [0.588, 3.196, 3.653, 3.849, 3.838, 3.837, 3.827, 3.818],
    ),
    "bend under braking, 20 m/s": (
        [0.0069, 0.1552, 0.2253, 0.2316, 0.2568, 0.3158, 0.3049, 0.2871],
        [0.432, 2.981, 4.113, 4.546, 4.69, 5.542, 5.699, 5.25],
    ),
}
SPEED = {"lane change, 30 m/s, 1": 30.0, "bend, 15 m/s, 0.67": 15.0, "bend under braking, 20 m/s": 20.0}
# the same with the package's own tyres, from a lean of 2 mrad
LOPSIDED = {
    "bend, 25 m/s, 0.33": (
        [0.0021, 0.0479, 0.0754, 0.08, 0.0809, 0.0811, 0.0811, 0.0811],
        [0.141, 1.043, 1.684, 1.943, 2.009, 2.023, 2.026, 2.027],
    ),
    "slalom, 20 m/s, 0.67": (
        [0.1176, 0.2352, 0.2405, 0.1154, -0.0762, -0.2194, -0.249, -0.1471],
        [2.333, 4.278, 4.471, 2.38, -1.563, -3.919, -4.573, -2.93],
    ),
    "right bend under braking, 28 m/s": (
        [-0.003, -0.0862, -0.1411, -0.1529, -0.1723, -0.2207, -0.2294, -0.2376],
        [-0.181, -1.999, -3.365, -4.052, -4.35, -5.359, -5.949, -6.132],
    ),
}
SPEED |= {"bend, 25 m/s, 0.33": 25.0, "slalom, 20 m/s, 0.67": 20.0, "right bend under braking, 28 m/s": 28.0}
PACKAGE = {
    "camber_gains": (-0.324112, -0.785685),
    "tyre_camber": (-0.002675, -0.031415, -0.037318, 0.32931, -2.8821),
    "tyre_slip_push": (0.027825, -0.27568),
}
BRAKES = {"bend under braking, 20 m/s": 3.0, "right bend under braking, 28 m/s": 2.0}
"""Braking force over mass, m/s^2, from 1.2 s on."""
BEND = {
    "bend, 15 m/s, 0.67": 0.22 * 0.67,
    "bend, 25 m/s, 0.33": 0.08 * 0.33,
    "bend under braking, 20 m/s": 0.1,
    "right bend under braking, 28 m/s": -0.045,
}
"""Rate of the steering angle from 0.2 to 0.5 s, rad/s."""


def turned(name, t):
    """Rate of the steering angle, rad/s, as in the benchmark."""
    if name.startswith("lane change"):
        return 0.16 * np.cos(5 * t) * (t < 0.4 * np.pi)
    if name.startswith("slalom"):
        return 0.15 * 0.67 * np.cos(3 * t)
    rate = BEND[name]
    return np.interp(t, [0.2, 0.21, 0.5, 0.51], [0, rate, rate, 0])


@pytest.mark.parametrize("name", MULTI_BODY | LOPSIDED)
def test_a_multi_body_model_turns_and_sways_alike(name):
    """Vehicle 2 (BMW 320i); springs, dampers and bars in series with the tyres', on the mean track."""
    lean, lopsided = (0.002, PACKAGE) if name in LOPSIDED else (0.0, {})
    height = 0.582253
    car = four_wheel_car(
        mass=1093.2952334674046, yaw_inertia=1791.5995300122856, roll_inertia=207.26524557936952,
        pitch_inertia=1565.8178787125541, front=1.1561957064, rear=1.4227170936, half_track=0.68771,
        mass_height=height, wheel_radius=0.344, wheel_inertia=1.7, engine_inertia=1e-3, springs=(21181.1, 17468.6),
        dampers=(1210.59, 1241.51), bars=(6872.16, 2962.34), brake_front=0.66, low_speed=0.5, scrub=0.0, **lopsided,
    )  # fmt: skip
    times = np.linspace(0, 2, 2 * STEPS + 1)
    rate = turned(name, times)
    delta = np.concatenate([[0], np.cumsum(np.diff(times) * (rate[1:] + rate[:-1]) / 2)])
    controls = np.zeros((len(times), 4))
    controls[:, 1] = 1093.2952334674046 * 0.344 * np.interp(times, [1, 1.2], [0, BRAKES.get(name, 0.0)])
    controls[:, 3] = rate / np.cos(delta) ** 2
    at = {joint: k for k, joint in enumerate(car.joints)}
    joints = lean * (np.arange(len(at)) == at["roll"])
    clip = Integrator(car, times[1]).rollout(State(twist=(0, SPEED[name], 0), joints=joints), controls)
    heave, pitch, roll = (clip.joints[:, at[joint]] for joint in ("heave", "pitch", "roll"))
    rising, pitching, rolling = (clip.joint_rates[:, at[joint]] for joint in ("heave", "pitch", "roll"))
    turn, along, across = clip.twists.T
    sway = across + turn * (height + heave) * pitch - (height + heave) * rolling - rising * roll
    surge = along + turn * (height + heave) * roll + (height + heave) * pitching + rising * pitch
    sideways = np.gradient(sway, times) + turn * surge
    every = np.arange(1, 9) * STEPS // 4
    for ours, theirs in zip((turn, sideways), (MULTI_BODY | LOPSIDED)[name], strict=True):
        assert np.abs(ours[every] - theirs).max() < 0.03 * np.abs(theirs).max()


@pytest.mark.parametrize("lean", [-0.08, 0.05])
def test_a_tyre_that_leans_pushes_to_that_side(lean):
    """Pacejka's eq. 4.E19 to 4.E29 without the constants of a lopsided tyre: shift of slip angle and force."""
    tyre = Tyre(
        LONGITUDINAL, LATERAL, WEIGHTS_LONGITUDINAL, WEIGHTS_LATERAL, 1.0, 1.0, camber=(0, 0.0314, 0, -0.329, 0)
    )
    shape, peak, curvature, stiffness = LATERAL

    def pure(angle):
        x = stiffness / (shape * peak) * angle
        return peak * math.sin(shape * math.atan(x - curvature * (x - math.atan(x))))

    for angle in (-0.05, 0.0, 0.1):
        along, aside = np.array(ca.DM(tyre.force(0.0, angle, lean))).ravel()
        assert aside == pytest.approx(-pure(angle + 0.0314 * lean) - 0.329 * lean, rel=2e-3, abs=1e-4)
        assert along == pytest.approx(0, abs=1e-9)
    assert np.sign(aside_of(tyre, lean)) == -np.sign(lean)


@pytest.mark.parametrize(("slip", "angle", "lean"), [(-0.05, 0.02, 0.03), (0.1, -0.04, -0.02), (0.02, 0.0, 0.0)])
def test_longitudinal_slip_pushes_sideways(slip, angle, lean):
    """Pacejka's eq. 4.E65 and 4.E66, at slips over the friction as his section 4.2 has it; nothing without slip."""
    numbers = (LONGITUDINAL, LATERAL, WEIGHTS_LONGITUDINAL, WEIGHTS_LATERAL, 0.7, 1.0)
    plain, pushed = Tyre(*numbers), Tyre(*numbers, slip_push=(0.028, -0.28))
    expected = 0.7 * LATERAL[1] * (0.028 - 0.28 * lean) * math.cos(math.atan(12.12 * angle / 0.7))
    expected *= math.sin(1.9 * math.atan(-10.704 * slip / 0.7))
    along, aside = np.ravel(ca.DM(pushed.force(slip, angle, lean) - plain.force(slip, angle, lean)))
    assert along == 0 and aside == pytest.approx(expected, rel=1e-9)
    assert np.ravel(ca.DM(pushed.force(0.0, angle, lean) - plain.force(0.0, angle, lean)))[1] == pytest.approx(
        0, abs=1e-15
    )


def aside_of(tyre, lean):
    """Force to the left over load of a wheel that rolls straight and leans to its right."""
    return float(tyre.force(0.0, 0.0, lean)[1])


def test_it_rests_without_controls():
    vehicle = vehsim.load_vehicle("rally_car")
    clip = Integrator(vehicle, 1 / STEPS).rollout(State(joints=(0, 0, 0, 0.3, 0, 0, 0)), np.zeros((240, 4)))
    assert np.abs(clip.twists).max() < 1e-12 and np.abs(clip.joint_rates).max() < 1e-12


def test_wheels_roll_where_their_rates_are_not_given():
    clip = driven({}, State(twist=(0.2, 10, 0), joints=(0, 0, 0, 0.2, 0, 0, 0)), 2 / STEPS)
    left = math.atan2(0.2, 1 - HALF / 2.6 * 0.2)
    expected = ((10 - HALF * 0.2) * math.cos(left) + AXLE * 0.2 * math.sin(left)) / 0.32
    assert clip.joint_rates[0, 0] == pytest.approx(expected)
    assert clip.joint_rates[0, 2] == pytest.approx(10 / 0.32)


@pytest.mark.parametrize("wrong, message", [({"mass_height": 0.8}, "tip over"), ({"locked": [0, 0.5]}, "locked")])
def test_cars_that_cannot_be_are_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        vehsim.load_vehicle("rally_car", wrong)
