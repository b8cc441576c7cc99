"""Wheels on terrain compared with exact distances, the body with its transfer function, slopes with energy."""

import warnings
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import vehsim
from vehsim import Mark
from vehsim.errors import InputError, SolveError
from vehsim.planning.problem.elements import NonlinearProgram
from vehsim.planning.problem.simpson import simpson
from vehsim.planning.problem.transcription import Transcription, transcribe
from vehsim.planning.request.request import make_request
from vehsim.rig.parts import read_parts
from vehsim.world.ground.placing import can_stand, place_on_terrain
from vehsim.world.ground.slope import Relief, on_terrain, relief_of
from vehsim.world.ground.wheels import touch, wheels_of
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

CAR = vehsim.load_vehicle("car")


def hilly(name="hills", height=1.5, length=100.0, cell=1.0, size=120.0):
    x = np.arange(-size / 2, size / 2 + cell / 2, cell)
    X, Y = np.meshgrid(x, x)
    heights = height * np.sin(2 * np.pi * X / length) * np.cos(2 * np.pi * Y / (0.8 * length))
    return World(Terrain(name, heights, (x[0], x[0]), (cell, cell)))


def washboard(amplitude, length, cell=0.1):
    """Waves along X, as long as the test's drive."""
    x, y = np.arange(-20, 140 + cell / 2, cell), np.array([-10.0, 0.0, 10.0])
    heights = np.tile(amplitude * np.sin(2 * np.pi * x / length), (3, 1))
    return World(Terrain("washboard", heights, (x[0], y[0]), (cell, 10.0)))


def coasting(world, speed, duration, position=(0, 0, 0), heading=0.0, step=1 / 240):
    start = vehsim.State(
        position=(*position[:2], float(world.height([position[:2]])[0])),
        orientation=(np.cos(heading / 2), 0, 0, np.sin(heading / 2)),
        twist=(0, speed, 0),
    )
    return vehsim.simulate(CAR, world, None, start, duration=duration, step=step)


def gaps(clip, world, frames):
    """Smallest signed height (m) of each tyre's own mesh above the terrain, posed as USD poses it."""
    parts = {part.path: part for part in read_parts(CAR.rig.asset)}
    found = []
    for k in frames:
        T_wr = clip.matrices()[k]
        for wheel in ("rl", "rr", "fl", "fr"):
            path = f"wheel_{wheel}" if wheel[0] == "r" else f"steer_{wheel}/wheel_{wheel}"
            part = parts[path]
            turn = Rotation.from_euler("Y", clip.channels[f"roll_{wheel}"][k]).as_matrix()
            if wheel[0] == "f":
                turn = Rotation.from_euler("Z", clip.channels[f"steer_{wheel}"][k]).as_matrix() @ turn
            points = part.points @ turn.T + part.T_rp[:3, 3] + [0, 0, clip.channels[f"travel_{wheel}"][k]]
            points = points @ T_wr[:3, :3].T + T_wr[:3, 3]
            found.append((points[:, 2] - world.height(points[:, :2])).min())
    return np.array(found)


def test_tyres_touch_the_ground_they_roll_on():
    """Every tyre's mesh, not its model: within 2 mm of the terrain on every tenth frame of a drive over hills."""
    world = hilly()
    clip = coasting(world, 8.0, 4.0, (-30, -25), 0.8).resample()
    found = gaps(clip, world, range(0, len(clip), 10))
    assert np.abs(found).max() < 2e-3
    assert np.ptp(clip.positions[:, 2]) > 0.5 and np.ptp(clip.channels["pitch"]) > 0.05


def test_level_ground_is_ground():
    """Level terrain uses a faster computation with the same result, for any pose."""
    heights = np.full((41, 41), 1.5)
    level = Terrain("level", heights, (-20.0, -20.0), (1.0, 1.0))
    heights = heights.copy()
    heights[0, 0] += 1.0  # far away
    chance = np.random.default_rng(1)
    positions = chance.normal(scale=2.0, size=(50, 3))
    angles = chance.normal(size=(50, 3)) * (3.0, 0.1, 0.1)
    orientations = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
    for wheel in wheels_of(CAR.rig):
        here = touch(level, wheel, positions, orientations)
        there = touch(Terrain("corner", heights, (-20.0, -20.0), (1.0, 1.0)), wheel, positions, orientations)
        assert np.allclose(here, there, atol=1e-12)


def test_tyres_touch_between_a_coarse_clips_knots():
    world = hilly()
    clip = coasting(world, 8.0, 4.0, (-30, -25), 0.8, step=1 / 24)
    coarse = clip.at(clip.times[::12])
    bare = {name: values for name, values in coarse.channels.items() if name not in ("heave", "pitch", "roll")}
    placed = place_on_terrain(replace(coarse, channels=bare), world).resample()
    assert np.abs(gaps(placed, world, range(3, len(placed), 10))).max() < 2e-3


@pytest.mark.parametrize("length", [6.0, 20.0])
def test_heave_follows_the_oscillators_transfer_function(length):
    """Driven over waves at constant speed the body's acceleration is |G(i w)| A w^2, and so bounded by curvature."""
    amplitude, speed = 0.01, 10.0
    world = washboard(amplitude, length)
    clip = coasting(world, speed, 6.0)
    springs = CAR.rig.suspension
    omega0, omega = 2 * np.pi * springs.frequency, 2 * np.pi * speed / length
    damped = omega0**2 + 2j * springs.damping * omega0 * omega
    gain = abs(damped / (damped - omega**2))
    wheelbase = 2.6
    heard = abs(np.cos(np.pi * wheelbase / length))  # the mean of both axles' heights on the wave
    late = clip.times > 2.5
    acceleration = np.gradient(np.gradient(clip.positions[:, 2], clip.times), clip.times)[late]
    tone = np.exp(-1j * omega * clip.times[late])
    waves = np.linalg.lstsq(np.column_stack([tone.real, tone.imag, 0 * tone.real + 1]), acceleration, rcond=None)[0]
    assert np.hypot(*waves[:2]) == pytest.approx(gain * heard * amplitude * omega**2, rel=0.02)
    curvature = amplitude * (2 * np.pi / length) ** 2
    assert np.abs(acceleration).max() < 1.6 * curvature * speed**2


def test_slope_is_rolled_down_without_losing_energy():
    """Released on a hill, kinetic energy is weight times the descent: the spline is the terrain, the scheme
    symplectic."""
    world = hilly()
    clip = coasting(world, 0.0, 8.0, (12, 3), 0.0)
    total = clip.energy["kinetic"] + clip.energy["potential"]
    assert np.ptp(clip.energy["kinetic"]) > 1e3
    assert np.ptp(total) < 1e-4 * np.ptp(clip.energy["kinetic"])
    ground = world.height(clip.positions[:, :2])
    fall = 1350.0 * 9.81 * (ground[0] - ground)
    assert np.abs(clip.energy["kinetic"] - fall).max() < 0.02 * np.ptp(fall)


def test_constant_slope_accelerates_as_an_inclined_plane():
    """a = g sin, in horizontal lengths g tan: m + I / rho^2 is what is moved."""
    x = np.arange(-200.0, 201.0, 4.0)
    world = World(Terrain("ramp", np.tile(0.05 * x, (len(x), 1)), (-200, -200), (4, 4)))
    clip = coasting(world, 0.0, 2.0)
    effective = 1350.0 / (1350.0 + 2.4 / 0.32**2)
    assert clip.twists[-1, 1] == pytest.approx(-9.81 * 0.05 * effective * 2.0, rel=1e-3)
    assert clip.channels["pitch"][0] == pytest.approx(-np.arctan(0.05), abs=0.01)


def test_a_plan_includes_the_slope_and_agrees_with_its_executed_controls():
    """A plan over a hill, executed by the independent integrator with gravity on the slope; without it, it misses."""
    world = hilly(height=1.0)
    marks = [
        vehsim.Mark(1001, position=(-20, 0, 0), heading=0, velocity=(0, 0, 0)),
        vehsim.Mark(1145, position=(12, 0, 0), heading=0, velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(CAR, world, marks, segments=24)
    assert plan.success and plan.executed.final < 0.1
    frames = plan.clip.resample()
    assert np.abs(gaps(frames, world, range(0, len(frames), 24))).max() < 2e-3
    level = vehsim.plan(CAR, None, marks, segments=24)
    ends = []
    for knots in (plan.clip.controls, level.clip.controls):
        with pytest.warns(UserWarning, match="put on the ground"):
            played = vehsim.simulate(
                CAR, world, knots, vehsim.State(position=(-20, 0, 0)), duration=6.0, step=1 / 192, actuators=False
            )
        ends.append(np.linalg.norm(played.positions[-1, :2] - [12, 0]))
    assert ends[0] < 0.1 and ends[1] > 1.0


def test_braking_dives_and_a_bend_leans_outwards():
    world = World("flat")
    braking = vehsim.simulate(CAR, world, (-1500.0, 0.0), vehsim.State(twist=(0, 12.0, 0)), duration=1.5)
    assert braking.channels["pitch"][-1] > 0.005  # nose down
    left = vehsim.State(twist=(0.0, 8.0, 0), joints=(0, 0.2))
    turning = vehsim.simulate(CAR, world, (0.0, 0.0), left, duration=1.5)
    assert turning.channels["roll"][-1] > 0.01  # left side up
    assert np.abs(turning.positions[:, 2]).max() < 1e-6
    assert np.abs(turning.channels["travel_rl"] + turning.channels["travel_rr"]).max() < 2e-3


def test_placing_twice_changes_nothing_and_interpolation_stays_on_the_ground():
    world = hilly()
    clip = coasting(world, 8.0, 2.0, (-30, -25), 0.8)
    assert place_on_terrain(clip, world) is clip
    between = clip.at(clip.times[:-1] + 0.4 * np.diff(clip.times))
    again = place_on_terrain(replace(between, channels={**between.channels, "travel_rl": 0 * between.times}), world)
    assert np.abs(again.positions - between.positions)[50:].max() < 2e-3
    assert clip.state(5).orientation[1:3] == pytest.approx([0, 0], abs=1e-15)
    assert place_on_terrain(clip, World()) is clip and place_on_terrain(clip, None) is clip


@pytest.mark.parametrize("speed, held", [(15.0, False), (9.0, True)])
def test_bends_beyond_the_grip_of_tyres_warn(speed, held, recwarn):
    """On a circle the tyres need v^2 / R: 2.3 g at 15 m/s on 10 m, 0.8 g at 9 m/s."""
    start = vehsim.State(twist=(speed / 10, speed, 0.0), joints=(0.0, 2.6 / 10))
    vehsim.simulate(CAR, vehsim.World(terrain="flat"), [0.0, 0.0], start=start, duration=0.5)
    texts = [str(warning.message) for warning in recwarn]
    assert [text for text in texts if "tyre" in text] == ([] if held else [texts[0]])
    assert held or texts[0].startswith("car: 2.3 g at frame ")


def test_beyond_the_grip_of_tyres_the_body_leans_as_at_their_limit():
    """Tyres give 1.1 g at most: at 15 and 25 m/s on a circle of 10 m the body leans as where v^2 / R is 1.1 g."""

    def roll(speed):
        start = vehsim.State(twist=(speed / 10, speed, 0.0), joints=(0.0, 2.6 / 10))
        clip = vehsim.simulate(CAR, World("flat"), [0.0, 0.0], start=start, duration=2.0)
        assert np.abs([clip.channels[f"travel_{wheel}"] for wheel in ("rl", "rr", "fl", "fr")]).max() < 0.12
        return clip.channels["roll"][-1]

    limit = roll(np.sqrt(1.1 * 9.81 * 10))
    with pytest.warns(UserWarning, match="more than the grip of tyres"):
        assert [roll(15.0), roll(25.0)] == pytest.approx([limit] * 2, rel=0.03)
    assert limit > roll(9.0) > 0.05


def test_wheels_come_from_the_asset():
    wheels = {wheel.travel: wheel for wheel in wheels_of(CAR.rig)}
    assert set(wheels) == {"travel_rl", "travel_rr", "travel_fl", "travel_fr"}
    for wheel in wheels.values():
        assert wheel.rings[:, 1].max() == pytest.approx(0.32, abs=1e-3)
        assert wheel.centre[2] == pytest.approx(0.32, abs=1e-3)


ELSEWHERE = Path(__file__).parents[1] / "assets_elsewhere"


@pytest.mark.parametrize(
    ("name", "radius", "base"), [("pickup", 0.38, 3.0), ("kart", 0.14, 1.3), ("crawler", 0.35, 1.8)]
)
def test_wheels_of_foreign_cars_stand_on_uneven_ground(name, radius, base):
    """Their axles are their own X or Z, one asset has no pivots: all four wheels are found, and touch the ground."""
    car = vehsim.load_vehicle(ELSEWHERE / name)
    wheels = wheels_of(car.rig)
    assert {wheel.roll for wheel in wheels} == {"roll_rl", "roll_rr", "roll_fl", "roll_fr"}
    for wheel in wheels:
        assert wheel.rings[:, 1].max() == pytest.approx(radius, rel=0.02)
        assert wheel.centre[2] == pytest.approx(radius, rel=0.05)
    assert np.ptp([wheel.centre[0] for wheel in wheels]) == pytest.approx(base, rel=0.05)
    world = hilly(height=0.8, length=40.0)
    start = vehsim.State(position=(0, 0, float(world.height([(0.0, 0.0)])[0])), twist=(0.0, 5.0, 0.0))
    clip = vehsim.simulate(car, world, None, start, duration=1.0, step=1 / 240)
    assert np.ptp(clip.positions[:, 2]) > 0.05 and np.abs(clip.channels["pitch"]).max() > 0.01
    lowest = []
    for wheel in wheels:
        rim = np.einsum("nij,kj->nki", clip.matrices()[:, :3, :3], wheel.rim) + clip.positions[:, None]
        lowest.append((rim[..., 2] - world.height(rim[..., :2].reshape(-1, 2)).reshape(rim.shape[:2])).min(axis=1))
    # without suspension, a rigid body stands on three of its four wheels, and the fourth is near the ground
    assert np.abs(np.mean(lowest, axis=0)).max() < 0.03


def test_a_cell_of_the_relief_is_the_spline_with_its_derivatives():
    """Anywhere, on the cells' borders and beyond the box: height, gradient and Hessian, from 16 coefficients."""
    car = on_terrain(CAR, hilly(), [(-20, -10), (25, 14)])
    relief = car.potential_energy.relief
    xy, cell = ca.SX.sym("xy", 2), ca.SX.sym("cell", Relief.CELL)
    curves = [ca.vertcat(height, ca.vec(ca.hessian(height, xy)[0]), ca.gradient(height, xy))
              for height in (relief.height(xy), relief.height(xy, cell))]  # fmt: skip
    whole, within = ca.Function("whole", [xy], curves[:1]), ca.Function("within", [xy, cell], curves[1:])
    low, high = relief.lower, relief.lower + relief.spacing * (np.array(relief.coefficients.shape) - 3)
    chance = np.random.default_rng(2)
    places = chance.uniform(low - 5, high + 5, size=(300, 2))
    places[:40] = low + relief.spacing * np.round((places[:40] - low) / relief.spacing) + 1e-9
    cells = relief.cells(len(places))(places.T)
    assert np.allclose(whole.map(300)(places.T).full(), within.map(300)(places.T, cells).full(), rtol=0, atol=1e-9)


def test_slopes_of_the_relief_are_differences_of_its_heights():
    relief = relief_of(hilly().terrain, np.array([(-20.0, -10.0), (25.0, 14.0)]))
    xy = ca.SX.sym("xy", 2)
    height = ca.Function("height", [xy], [relief.height(xy)])
    places, step = np.random.default_rng(4).uniform((-19, -9), (24, 13), size=(50, 2)), 1e-4
    slopes = [
        (height(places.T + d) - height(places.T - d)).full().ravel() / 2 / step for d in step * np.eye(2)[:, :, None]
    ]
    assert np.ptp(slopes) > 0.1
    np.testing.assert_allclose(relief.followed(places, np.zeros_like(places))[0], np.transpose(slopes), atol=1e-6)
    np.testing.assert_allclose(relief.box, [(-20, -10), (25, 14)], atol=1e-12)


def test_the_equations_of_a_plan_are_those_of_the_whole_slope():
    """The discrete equations, with the terrain's cells at both ends, against the spline as one expression."""
    car = on_terrain(CAR, hilly(), [(-20, -10), (25, 14)])
    made = transcribe(car)
    problem = NonlinearProgram(made.variational.y.shape[0])
    problem.add(made.variational, np.arange(problem.size))
    step = made.mechanics
    inputs = [step.symbols[name] for name in ("g", "r", "z", "c0", "c1", "h", "wind")]
    segment = ca.Function("segment", inputs, [step.segment[name] for name in ("left", "right", "g1", "r1")])
    chance = np.random.default_rng(3)
    for _ in range(5):
        g, g1 = (chance.uniform((-3, -15, -8), (3, 20, 10)) for _ in range(2))
        r, r1, pi, pi1, z, c0, c1 = (chance.normal(size=n) for n in (2, 2, 1, 1, 1, 2, 2))
        h = 0.1
        z, c0, c1 = z * 20, c0 * 0.2, c1 * 0.2
        given = (g, r, z, c0 * made.control_scale, c1 * made.control_scale, h, np.zeros(3))
        left, right, to, joints = (x.full().ravel() for x in segment(*given))
        scale = made.momentum_scale
        wanted = np.concatenate([left / scale - pi, right / scale - pi1, to - g1, joints - r1])
        x = np.concatenate([g, r, pi, z, c0, c1, g1, r1, pi1, [h]])
        found = problem.functions()["nlp"](x, problem.vector({"wind": np.zeros(3)}))[1]
        assert np.allclose(found.full().ravel(), wanted, rtol=0, atol=1e-9)


def order_four(transcription, x):
    """Residuals at order 4 of one segment with variables ``x``."""
    element = simpson(transcription)
    problem = NonlinearProgram(element.y.shape[0])
    problem.add(element, np.arange(problem.size))
    return problem.functions()["nlp"](x, problem.vector({"wind": np.zeros(3)}))[1].full().ravel()


def test_order_four_on_a_slope_is_that_of_the_whole_slope():
    """With the terrain's cells at both ends and in the middle, against the spline as one expression."""
    car = on_terrain(CAR, hilly(), [(-20, -10), (25, 14)])
    cells, whole, level = Transcription(car), Transcription(car), Transcription(CAR)
    whole.__dict__["weight"] = None
    chance = np.random.default_rng(3)
    for _ in range(5):
        g, g1 = (chance.uniform((-3, -15, -8), (3, 20, 10)) for _ in range(2))
        x = np.concatenate([g, chance.normal(size=8), g1, chance.normal(size=3), [0.1]])
        np.testing.assert_allclose(order_four(cells, x), order_four(whole, x), rtol=0, atol=1e-9)
        assert np.abs(order_four(cells, x) - order_four(level, x)).max() > 1e-4


def test_coarse_wheels_touch_within_two_millimetres():
    world, chance = hilly(), np.random.default_rng(4)
    positions = np.column_stack([chance.uniform(-20, 20, size=(40, 2)), np.zeros(40)])
    orientations = Rotation.from_euler("Z", chance.uniform(-3, 3, size=(40, 1))).as_quat(scalar_first=True)
    for wheel in wheels_of(CAR.rig):
        exact, coarse = (touch(world.terrain, one, positions, orientations) for one in (wheel, wheel.coarse))
        assert (exact - coarse).min() > -1e-5 and (exact - coarse).max() < 2e-3


@pytest.mark.parametrize("grade", [0.5, 1.0, 2.0])
def test_a_car_stands_on_any_slope(grade):
    """On a plane the car has the plane's slope; its springs, which give way, change it by less than two degrees."""
    x = np.array([-40.0, 0.0, 40.0])
    world = World(Terrain("ramp", np.tile(grade * x, (3, 1)), (-40.0, -40.0), (40.0, 40.0)))
    assert can_stand(CAR, world, np.array([[0.0, 0.0], [5.0, 3.0]]), np.array([0.0, np.pi])).all()
    clip = coasting(world, 0.5, 0.2)
    assert np.degrees(-clip.channels["pitch"][0]) == pytest.approx(np.degrees(np.arctan(grade)), abs=2.1)


@pytest.mark.parametrize("box", [None, ((-3.0, -8.0), (9.0, 1.0)), ((4.0, 4.0), (4.0, 4.0))])
def test_slopes_of_a_relief_are_bounded(box):
    """By dense samples, the bends in nine directions; both bounds are of the right size."""
    relief = relief_of(hilly().terrain, np.array([(-20.0, -10.0), (25.0, 14.0)]))
    low, high = relief.box if box is None else np.array(box)
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 61).T), axis=-1).reshape(-1, 2)
    angle = np.linspace(0, np.pi, 9)
    ways = np.column_stack([np.cos(angle), np.sin(angle)])
    slopes = np.linalg.norm(relief.followed(grid, np.zeros_like(grid))[0], axis=1).max()
    bends = max(np.abs(relief.followed(grid, np.tile(way, (len(grid), 1)))[1]).max() for way in ways)
    slope, bend = relief.steepest() if box is None else relief.steepest(low, high)
    assert slopes <= slope <= 2 * slopes and bends <= bend <= 4 * bends


def cliff(height):
    """Level ground that ends at a wall at x = 10 m, half a metre thick."""
    x = np.arange(-20.0, 40.0, 0.5)
    return World(Terrain("cliff", np.tile(height * (x > 10), (3, 1)), (-20.0, -20.0), (0.5, 20.0)))


def test_a_car_does_not_stand_on_a_wall():
    """It was put kilometres above or below the ground, without a word."""
    world, rest = cliff(20.0), (0, 0, 0)
    with pytest.raises(SolveError, match=r"cannot stand on the ground at \(10.00, 0.00\) m, frame 1001"):
        coasting(world, 0.5, 0.2, position=(10, 0))
    ends = [Mark(1, position=(10, 0, 0), heading=0, velocity=rest), Mark(97, position=(5, 0, 0))]
    with pytest.raises(InputError, match=r"mark\[0\].position.*cannot stand there"):
        vehsim.plan(CAR, world, ends)
    with pytest.raises(InputError) as wrong:
        make_request(CAR, world, [ends[0], replace(ends[0], frame=97)], fps=24, segments=8)
    assert [problem.key for problem in wrong.value.problems] == ["mark[0].position", "mark[1].position"]
    near = [replace(ends[0], tolerance=3.0), ends[1]]  # but beside it
    make_request(CAR, world, near, fps=24, segments=8)


def test_a_plan_across_a_wall_fails():
    """Both marks are on level ground, the wall is between them."""
    rest = (0, 0, 0)
    ends = [Mark(1, position=rest, heading=0, velocity=rest), Mark(241, position=(25, 0, 20), velocity=rest)]
    with pytest.warns(UserWarning, match="plan failed"):
        plan = vehsim.plan(CAR, cliff(20.0), ends, segments=16)
    assert not plan.success


@pytest.mark.parametrize(("z", "warned"), [(0.0, False), (1.0, False), (-9.0, True), (9.0, True)])
def test_heights_of_marks_far_from_the_ground_are_named(z, warned):
    """A vehicle on wheels stands on the ground at its marks; 0 is what one writes where the height does not matter."""
    world = World(Terrain("raised", np.full((2, 2), 3.0), (-50.0, -50.0), (100.0, 100.0)))
    marks = [Mark(1, position=(0, 0, 3 * bool(z)), heading=0), Mark(49, position=(10, 0, z and z + 3), heading=0)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        plan = vehsim.plan(vehsim.load_vehicle("car"), world, marks, segments=8, refine=False)
    assert plan.success and plan.clip.positions[-1, 2] == pytest.approx(3.0, abs=0.05)
    texts = [str(one.message) for one in caught if "stands on the ground" in str(one.message)]
    assert (
        texts
        == [f"mark[1].position: {z + 3:.2f} m: car stands on the ground, at 3.00 m; give that height, or 0"] * warned
    )
