"""The tyres of `drift_car`: an independent model, closed forms, and standstill.

The independent model is CommonRoad's single-track drift model (M. Althoff and G. Wuersching, CommonRoad: Vehicle
Models, 2020, section 8), written from its published equations and parameters (vehicle 2, BMW 320i; tyre: table 7), in
its own coordinates: speed and slip angle of the centre of mass.
"""

import math

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import vehsim
from vehsim.errors import InputError
from vehsim.integrators import Integrator
from vehsim.integrators.continuous import execute
from vehsim.lie.quaternions import tilt_of
from vehsim.planning.planner import _calmer
from vehsim.planning.request.request import make_request
from vehsim.vehicles import State
from vehsim.vehicles.definition.surfaces import SURFACES
from vehsim.vehicles.models.drift_car import drift_car
from vehsim.vehicles.models.tyres import Tyre
from vehsim.world.terrain.terrain import Terrain

G = 9.81
M, IZ, LF, LR, H = 1093.2952334674046, 1791.5995300122856, 1.1561957064, 1.4227170936, 0.61373004
IW, RW, BRAKE_FRONT = 1.7, 0.344, 0.66
STEPS = 2400
SHIFTS = (0.0012297, -8.8098e-06, 0.0050722, 5.7448e-06, -0.027856, -0.027825)
"""p_hx1, p_vx1, r_hx1, r_hy1, r_by3 and r_vy1 of its tyre."""


def tyre_forces(slip, angle, load, shifts):
    """Pacejka's forces of one tyre, with CommonRoad's signs and names; ``shifts``: those that make it asymmetric."""

    def magic(c, d, e, k, x, shift=0.0):
        b = k / (c * d)
        return d * math.sin(c * math.atan(b * x - e * (b * x - math.atan(b * x))) + shift)

    def weight(b, c, e, x):
        return math.cos(c * math.atan(b * x - e * (b * x - math.atan(b * x))))

    hx1, vx1, rhx1, rhy1, rby3, rvy1 = SHIFTS if shifts else np.zeros(6)
    pure_x = load * magic(1.6411, 1.1739, 0.46403, 22.303, hx1 - slip, load * vx1)
    pure_y = load * magic(1.3507, 1.0489, -0.0074722, -21.92, angle)
    narrow = 13.276 * math.cos(math.atan(-13.778 * slip))
    along = pure_x * weight(narrow, 1.2568, 0.65225, angle + rhx1) / weight(narrow, 1.2568, 0.65225, rhx1)
    narrow = 7.1433 * math.cos(math.atan(9.1916 * (angle - rby3)))
    across = pure_y * weight(narrow, 1.0719, -0.27572, slip + rhy1) / weight(narrow, 1.0719, -0.27572, rhy1)
    pushed = 1.0489 * load * rvy1 * math.cos(math.atan(12.12 * angle)) * math.sin(1.9 * math.atan(-10.704 * slip))
    return along, across + pushed


def peer(t, x, steer, wanted, follow):
    """CommonRoad's right-hand side, or, with ``follow``, that of symmetric tyres with loads that follow the forces
    instead of the acceleration wanted."""
    delta, v, psi, turn, beta, front, rear = x[2:]
    u1, u2 = steer(t), wanted(t)
    ahead, aside = v * math.cos(beta), v * math.sin(beta)
    alpha_f = math.atan((aside + turn * LF) / ahead) - delta
    alpha_r = math.atan((aside - turn * LR) / ahead)
    slip_f = 1 - RW * front / (ahead * math.cos(delta) + (aside + LF * turn) * math.sin(delta))
    slip_r = 1 - RW * rear / ahead
    push = u2
    for _ in range(40 if follow else 1):
        fx_f, fy_f = tyre_forces(slip_f, alpha_f, M * (G * LR - push * H) / (LF + LR), not follow)
        fx_r, fy_r = tyre_forces(slip_r, alpha_r, M * (G * LF + push * H) / (LF + LR), not follow)
        if follow:
            push = (fx_f * math.cos(delta) - fy_f * math.sin(delta) + fx_r) / M
    braking, driving = M * RW * min(u2, 0), M * RW * max(u2, 0)
    return [
        v * math.cos(beta + psi),
        v * math.sin(beta + psi),
        u1,
        (-fy_f * math.sin(delta - beta) + fy_r * math.sin(beta) + fx_r * math.cos(beta) + fx_f * math.cos(delta - beta))
        / M,
        turn,
        (fy_f * math.cos(delta) * LF - fy_r * LR + fx_f * math.sin(delta) * LF) / IZ,
        -turn
        + (
            fy_f * math.cos(delta - beta)
            + fy_r * math.cos(beta)
            - fx_r * math.sin(beta)
            + fx_f * math.sin(delta - beta)
        )
        / (M * v),
        (-RW * fx_f + BRAKE_FRONT * braking) / IW,
        (-RW * fx_r + (1 - BRAKE_FRONT) * braking + driving) / IW,
    ]


def ramp(times, values):
    return lambda t: np.interp(t, times, values)


MANOEUVRES = {  # speed, seconds, rate of the steering angle, acceleration wanted
    "slalom": (15.0, 2.5, lambda t: 0.3 * np.cos(3 * t), lambda t: 0.0 * t),
    "bend under power": (10.0, 2.5, ramp([0, 0.4, 0.41], [0.3, 0.3, 0]), lambda t: 2.0 + 0 * t),
    "bend under braking": (20.0, 1.5, ramp([0, 0.3, 0.31], [0.2, 0.2, 0]), ramp([0, 0.3], [0, -5.0])),
    "right bend under braking": (16.0, 2.0, ramp([0, 0.4, 0.41], [-0.2, -0.2, 0]), ramp([0, 0.5], [0, -2.0])),
    "power slide": (12.0, 1.5, ramp([0, 0.4, 0.41], [0.4, 0.4, 0]), ramp([0, 0.4, 0.8], [0, 0, 5.0])),
    "drift": (10.0, 1.3, ramp([0, 0.5, 0.51, 0.9, 0.91], [0.5, 0.5, 0, 0, -0.6]), ramp([0, 0.5, 0.9], [0, 0, 6.2])),
}  # fmt: skip


def both(name, follow, low_speed):
    """Positions, yaw, slip angle at the same times: of `drift_car` and of the independent model."""
    speed, seconds, steer, wanted = MANOEUVRES[name]
    count = round(STEPS * seconds)
    times, spin = np.linspace(0, seconds, count + 1), speed / RW
    vehicle = drift_car(
        mass=M, yaw_inertia=IZ, front=LF, rear=LR, mass_height=H, wheel_radius=RW, half_track=0.7, front_inertia=IW,
        rear_inertia=IW, drive_front=0.0, brake_front=BRAKE_FRONT, low_speed=low_speed,
        **({} if follow else {"demanded_transfer": 1.0, "tyre_slip_push": 0.027825}),
    )  # fmt: skip
    rate = steer(times)
    delta = np.concatenate([[0], np.cumsum(np.diff(times) * (rate[1:] + rate[:-1]) / 2)])
    force = M * RW * wanted(times)
    controls = np.column_stack([np.maximum(force, 0), np.maximum(-force, 0), 0 * times, rate / np.cos(delta) ** 2])
    start = State(twist=(0, speed, 0), joint_rates=(spin, 0, spin))
    clip = Integrator(vehicle, seconds / count).rollout(start, controls)
    shown = slice(None, None, 48)
    begin = [0, 0, 0, speed, 0, 0, 0, spin, spin]
    options = {"method": "LSODA", "rtol": 1e-7, "atol": 1e-7, "max_step": 0.02, "t_eval": times[shown]}
    x = solve_ivp(peer, (0, seconds), begin, args=(steer, wanted, follow), **options).y
    yaw = np.unwrap(tilt_of(clip.orientations[shown])[0])
    _, vx, vy = clip.twists[shown].T
    own = np.column_stack([clip.positions[shown, :2], yaw, np.arctan2(vy, vx)])
    return own, x[[0, 1, 4, 6]].T


@pytest.mark.filterwarnings("ignore:.*is too fast for steps")
@pytest.mark.parametrize("follow", [True, False])
@pytest.mark.parametrize("name", MANOEUVRES)
def test_single_track_drift_model(name, follow):
    own, other = both(name, follow, 0.1)
    travelled = np.linalg.norm(np.diff(other[:, :2], axis=0), axis=1).sum()
    assert np.linalg.norm((own - other)[:, :2], axis=1).max() < 0.002 * travelled
    assert np.abs(own - other)[:, 2].max() < 0.01 * np.ptp(other[:, 2])
    assert np.abs(own - other)[:, 3].max() < (0.01 if follow else 0.015)


TYRE = Tyre(
    (1.6411, 1.1739, 0.46403, 22.303), (1.3507, 1.0489, -0.0074722, 21.92), (13.276, 13.778, 1.2568, 0.65225),
    (7.1433, 9.1916, 1.0719, -0.27572), 1.0, 3.0,
)  # fmt: skip


def law(tyre):
    velocity, rim = ca.SX.sym("velocity", 2), ca.SX.sym("rim")
    force = tyre.force(*tyre.slip(velocity, rim))
    slope = ca.jacobian(force, ca.vertcat(velocity, rim))
    return ca.Function("tyre", [velocity, rim], [force, slope])


def test_a_tyre_at_rest_is_a_damper():
    force, slope = law(TYRE)([0, 0], 0)
    assert np.allclose(force, 0)
    expected = np.array([[-22.303, 0, 22.303], [0, -21.92, 0]]) / 3.0
    assert np.allclose(slope, expected * (1 + math.sqrt(1 + 0.05**2)) / 2)


@pytest.mark.parametrize("name", SURFACES)
def test_no_tyre_pushes_along_its_own_slip_or_beyond_its_peak(name):
    tyre = TYRE.on(name)
    random = np.random.default_rng(1)
    speed, angle = random.uniform(0, 30, 4000), random.uniform(-np.pi, np.pi, 4000)
    velocity, rim = speed * np.array([np.cos(angle), np.sin(angle)]), random.uniform(-40, 40, 4000)
    force = np.array(law(tyre).map(4000)(velocity, rim)[0])
    assert (force[0] * (rim - velocity[0])).min() >= 0
    assert (force[1] * -velocity[1]).min() >= 0
    assert np.linalg.norm(force, axis=0).max() < 1.06 * tyre.peak


def start_and_stop(drive_front):
    """From rest under full power for a second, then the brakes."""
    vehicle = vehsim.load_vehicle("drift_car", {"drive_front": drive_front, "front_inertia": 2.4, "rear_inertia": 2.4})
    times = np.linspace(0, 3.5, 4201)
    drive = np.interp(times, [0, 0.1, 1, 1.1], [0, 1800, 1800, 0])
    brake = np.interp(times, [1.1, 1.3], [0, 2500])
    controls = np.column_stack([drive, brake, 0 * times, 0 * times])
    return Integrator(vehicle, times[1]).rollout(State(), controls)


@pytest.mark.filterwarnings("ignore:.*is too fast for steps")
@pytest.mark.parametrize("drive_front", [0.0, 0.5, 1.0])
def test_loads_balance_the_acceleration(drive_front):
    clip = start_and_stop(drive_front)
    acceleration = np.gradient(clip.twists[:, 1], clip.times)
    front, rear = 2 * clip.channels["load_fl"], 2 * clip.channels["load_rl"]
    assert np.allclose(front + rear, 1350 * G)
    calm = slice(150, -5)  # differences of velocities blur the first milliseconds
    assert np.allclose((rear - front)[calm] * 1.3, 1350 * 0.5 * acceleration[calm], atol=60)
    assert np.abs(acceleration[150:1100]).min() > 3.5 and acceleration.min() < -5
    assert np.abs(clip.twists[-1]).max() < 1e-3 and np.abs(clip.joint_rates[-1]).max() < 0.01
    assert clip.twists[:, 1].min() > -1e-3
    spins = clip.joint_rates[600, [0, 2]] * 0.32 - clip.twists[600, 1]
    assert (spins > 0.03).tolist() == [drive_front < 1, drive_front > 0]


def test_it_rests_without_controls():
    vehicle = vehsim.load_vehicle("drift_car")
    clip = Integrator(vehicle, 1 / 1200).rollout(State(joints=(0, 0.3, 0)), np.zeros((120, 4)))
    assert np.abs(clip.twists).max() == 0 and np.ptp(clip.positions, axis=0).max() == 0


def test_wheels_roll_where_their_rates_are_not_given():
    vehicle = vehsim.load_vehicle("drift_car")
    start = State(twist=(0.2, 10, 0), joints=(0, 0.2, 0))
    clip = Integrator(vehicle, 1 / 1200).rollout(start, np.zeros((3, 4)))
    assert clip.joint_rates[0, 0] == pytest.approx(10 / 0.32)
    delta = math.atan(0.2)
    assert clip.joint_rates[0, 2] == pytest.approx((10 * math.cos(delta) + 0.2 * 1.3 * math.sin(delta)) / 0.32)


def test_a_car_that_would_tip_over_is_refused():
    with pytest.raises(InputError, match="lift an axle"):
        vehsim.load_vehicle("drift_car", {"mass_height": 1.2})


@pytest.mark.parametrize("name", SURFACES)
def test_a_surface_changes_peak_and_slope_of_the_tyre_force(name):
    """The greatest braking force is the surface's share of the tyre's own; so is the slope at small slips."""
    force = ca.Function("force", [s := ca.SX.sym("s")], [TYRE.on(name).force(s, 0.0)[0]])
    slips = np.linspace(0, 2, 4001)
    along = np.ravel(np.array(force.map(len(slips))(slips)))
    weight = (1 + math.sqrt(1 + 0.05**2)) / 2  # of combined slip, rounded
    assert along.max() == pytest.approx(weight * SURFACES[name].friction * 1.1739, rel=1e-3)
    slope = float(force(1e-6)) / 1e-6
    assert slope == pytest.approx(weight * SURFACES[name].stiffness * 22.303, rel=1e-4)


@pytest.mark.parametrize("name", SURFACES)
def test_surfaces_are_similar(name):
    """The greatest force in every direction, and how it falls with slip in the other, are those of asphalt times the
    friction."""
    surface, tyre = SURFACES[name], TYRE.on(name)
    for slip, angle in np.random.default_rng(3).uniform(-0.3, 0.3, (40, 2)):
        along, aside = tyre_forces(-slip, angle, surface.friction, False)
        stretch = surface.friction / surface.stiffness
        force = np.ravel(ca.DM(tyre.force(slip * stretch, angle * stretch)))
        assert force == pytest.approx([along, aside], abs=0.004 * surface.friction)


BURCKHARDT = {"asphalt": (1.2801, 23.99, 0.52), "wet asphalt": (0.857, 33.822, 0.347), "snow": (0.1946, 94.129, 0.0646),
              "ice": (0.05, 306.39, 0.0)}  # fmt: skip
"""The coefficients of the friction curve c1 (1 - exp(-c2 s)) - c3 s, as given by Kiencke and Nielsen (2005)."""


@pytest.mark.parametrize("name", BURCKHARDT)
def test_the_stiffness_of_a_surface_is_that_of_burckhardt(name):
    (a, b, c), (a0, b0, c0) = BURCKHARDT[name], BURCKHARDT["asphalt"]
    assert SURFACES[name].stiffness == pytest.approx((a * b - c) / (a0 * b0 - c0), abs=0.01)


def test_a_car_needs_more_way_to_stop_on_gravel():
    """The handbrake from 10 m/s: on gravel about 1 / 0.54 times the way, locked wheels at both."""
    ways = []
    for surface in ("asphalt", "gravel"):
        car = vehsim.load_vehicle("drift_car", {"surface": surface})
        controls = np.tile([0.0, 0.0, 8000.0, 0.0], (6000, 1))
        clip = Integrator(car, 1 / 1200).rollout(State(twist=(0, 10, 0)), controls)
        assert abs(clip.twists[-1, 1]) < 0.5
        ways.append(clip.positions[-1, 0])
    assert 1.5 < ways[1] / ways[0] < 2.1


def test_an_unknown_surface_is_refused():
    with pytest.raises(InputError, match="give one of"):
        vehsim.load_vehicle("drift_car", {"surface": "grvel"})


def test_controls_are_executed_in_steps_that_tyres_need():
    """A wheel follows the road within milliseconds at low speed: sixteen steps of 4 ms would be unstable."""
    vehicle = vehsim.load_vehicle("drift_car")
    controls = np.column_stack([np.linspace(0, 1500, 26), np.zeros((26, 3))])
    start = np.zeros(3), np.zeros(3), np.zeros(5)
    coarse, fine = (
        execute(vehicle, *start, controls, np.full(25, 0.0625), np.zeros(3), steps)[0] for steps in (16, 256)
    )
    assert coarse == pytest.approx(fine, abs=1e-5) and fine[-1, 1] > 1


def test_the_remedy_of_a_slide_at_the_limit_of_grip_is_time():
    """A slide on snow whose controls lead astray in 150 frames is repeated by them in 159, so a tenth is enough."""
    marks = [vehsim.Mark(1001, position=(0, 0, 0), heading=0), vehsim.Mark(1151, position=(30, 0, 0), heading=0)]
    slipping, rolling = (
        make_request(vehsim.load_vehicle(name), None, marks, fps=24, segments=16) for name in ("drift_car", "car")
    )
    assert "mark[1].frame = 1166" in _calmer(slipping)
    assert "frame" not in _calmer(rolling) and "more segments" in _calmer(rolling)


def plane(ahead, aside):
    """Ground that rises by ``ahead`` m per metre along x and by ``aside`` along y."""
    x = np.arange(-40.0, 41.0)
    heights = ahead * x[None, :] + aside * x[:, None]
    return vehsim.World(terrain=Terrain("plane", heights, (-40.0, -40.0), (1.0, 1.0)))


def driven(name, world, controls, seconds=3.0, speed=0.0, **parameters):
    """Positions (n, 3) m at every frame of a car with constant ``controls`` by name, that starts with ``speed`` m/s."""
    car = vehsim.load_vehicle(name, parameters)
    row = np.array([controls.get(control, 0.0) for control in car.control_names])
    positions = vehsim.simulate(car, world, row, State(twist=(0, speed, 0)), duration=seconds).positions
    return positions[:: (len(positions) - 1) // round(24 * seconds)]


@pytest.mark.parametrize("name", ["drift_car", "rally_car"])
@pytest.mark.parametrize(
    ("slope", "controls"),
    [((0.0, 0.2), {}), ((0.2, 0.0), {"handbrake": 3000}), ((-0.12, 0.12), {"brake": 3000})],
    ids=["across", "up", "down and across"],
)
def test_a_parked_car_stands_on_a_slope(name, slope, controls):
    """A tyre that only slips crept by 28 mm/s across the slope, and brakes let it roll down at 0.35 m/s."""
    positions = driven(name, plane(*slope), controls)
    assert np.linalg.norm(np.ptp(positions[:, :2], axis=0)) < 2e-4


def test_without_brakes_it_rolls_down():
    moved = -driven("drift_car", plane(0.1, 0.0), {}, 2.0)[-1, 0]
    wheels = (2.4 + 10.0) / 0.32**2  # kg: what their inertia adds to that of the car
    assert moved == pytest.approx(G * 0.1 * 1350 / (1350 + wheels) * 2.0**2 / 2, rel=0.01)


@pytest.mark.parametrize("ahead", [0.2, -0.2])
def test_brakes_stop_it_on_a_slope_and_hold_it(ahead):
    positions = driven("drift_car", plane(ahead, 0.1), {"brake": 3000}, 4.0, speed=4.0)
    assert 1.0 < positions[-1, 0] < 2.5
    assert np.abs(positions[72:] - positions[-1]).max() < 1e-3


@pytest.mark.parametrize("slope", [(0.0, 0.3), (0.3, 0.0)], ids=["across", "along"])
def test_on_ice_a_steep_slope_is_too_much(slope):
    """It slides down as its weight along the slope, less the friction of ice, accelerates it."""
    positions = driven("drift_car", plane(*slope), {"brake": 5000, "handbrake": 5000}, 3.0, surface="ice")
    first, second, third = np.linalg.norm(np.diff(positions[::24, :2], axis=0), axis=1)  # in each second
    friction = [1.1739, 1.0489][slope[1] > 0] * SURFACES["ice"].friction
    assert G * (0.3 - friction) < third - second < G * (0.3 - 0.6 * friction)  # beyond their peak, tyres hold less
    assert first > 0.2


def test_standing_tyres_bear_a_pull_up_to_their_grip_and_brakes():
    pull, brakes, speed, slide = ca.SX.sym("pull", 2), ca.SX.sym("b"), ca.SX.sym("v"), ca.SX.sym("s")
    borne = ca.Function("borne", [pull, brakes, speed, slide], [TYRE.standing(pull, brakes, speed, slide)])
    assert np.allclose(np.ravel(borne([0.2, 0.3], 0.6, 0, 0)), [0.2, 0.3], rtol=1e-3)
    assert np.allclose(np.ravel(borne([0.2, 0.3], 0.0, 0, 0)), [0.0, 0.3], atol=2e-4)
    assert np.ravel(borne([0.4, 0.0], 0.1, 0, 0))[0] == pytest.approx(0.1, rel=1e-3)
    assert np.linalg.norm(np.ravel(borne([3.0, 4.0], 9.0, 0, 0))) == pytest.approx(TYRE.peak, rel=1e-3)
    random = np.random.default_rng(2)
    rim = random.uniform(-2, 2, 2000)
    velocity = random.uniform(-2, 2, (2, 2000))
    towards, size = random.uniform(0, 2 * np.pi, 2000), random.uniform(0, 2, 2000)
    pulls = size * np.array([np.cos(towards), np.sin(towards)])
    held = np.array(borne.map(2000)(pulls, 9.0, (velocity**2).sum(axis=0), (rim - velocity[0]) ** 2))
    slip = np.array(law(TYRE).map(2000)(velocity, rim)[0])
    assert np.linalg.norm(held - slip, axis=0).max() < 1.5 * TYRE.peak  # slip takes over as what it bore fades
