"""The boat afloat on the world's water, and its planar form, with which plans are made."""

import re
import shutil

import casadi as ca
import numpy as np
import pytest

import vehsim
from vehsim.constants import AIR
from vehsim.errors import InputError, ShotError
from vehsim.lie.quaternions import from_vectors
from vehsim.vehicles import State
from vehsim.vehicles.models.boat import boat
from vehsim.world.water.currents import Stream
from vehsim.world.wind import Gusts
from vehsim.world.world import Water, World

BOAT = vehsim.load_vehicle("boat")


def test_it_floats_at_its_waterline():
    """The asset's root is on the still waterline: there the boat displaces its weight, on an even keel."""
    clip = vehsim.simulate(BOAT, World(water=2.0), duration=3.0, step=1 / 60)
    assert np.abs(clip.positions[:, 2] - 2.0).max() < 2e-3
    assert clip.orientations[-1, 0] > 1 - 1e-6


def test_planar_and_floating_boats_drive_equally():
    """The same boat, with its hull and in closed form: speed on a straight course, drift and rate in a turn."""
    for controls, names in (((4500.0, 0.0), ("u",)), ((3000.0, 0.25), ("u", "r"))):
        wet = vehsim.simulate(BOAT, World(water=0.0), controls, duration=12.0, step=1 / 48).twists[-1]
        flat = vehsim.simulate(BOAT, World(), controls, duration=12.0, step=1 / 48).twists[-1]
        for name, i, j in (("u", 3, 1), ("v", 4, 2), ("r", 2, 0)):
            if name in names:
                assert flat[j] == pytest.approx(wet[i], rel=0.15), name


def test_damping_ahead_comes_on_top_of_the_running_hulls_resistance():
    """In water as in the plane: there it acts on the wetted surface, which shrinks as the boat planes. It had no effect
    in water, where the pressure on the bottom is fitted to the resistance."""
    thrust = 4500.0
    damped = vehsim.load_vehicle("boat", {"damping": [150.0, 500.0, 4500.0]})
    wet, flat, undamped = (
        vehsim.simulate(boat, world, (thrust, 0.0), duration=12.0, step=1 / 48).twists[-1][axis]
        for boat, world, axis in ((damped, World(water=0.0), 3), (damped, World(), 1), (BOAT, World(), 1))
    )
    assert flat < wet < 0.85 * undamped, (flat, wet, undamped)


def test_terminal_speed_of_the_planar_boat():
    """Thrust = resistance of the hull + the air's drag on the part above the water."""
    clip = vehsim.simulate(BOAT, None, (2000.0, 0.0), duration=60.0, step=1 / 24)
    u = clip.twists[-1, 1]
    running = BOAT.hull.running
    assert np.interp(u, running.speeds, running.resistance) + 0.5 * 1.225 * 2.4 * u * u == pytest.approx(
        2000.0, rel=0.02
    )
    assert np.ptp(clip.positions[:, 2]) == 0


def test_steering_turns_to_port_and_the_rudder_needs_flow():
    for thrust, turn in ((2000.0, 1), (-1500.0, -1)):
        clip = vehsim.simulate(BOAT, None, (thrust, 0.3), duration=2.0, step=1 / 48)
        assert np.sign(clip.twists[-1, 0]) == turn
    still = vehsim.simulate(BOAT, None, (0.0, 0.3), duration=1.0, step=1 / 48)
    np.testing.assert_allclose(still.twists, 0, atol=1e-12)
    assert still.channels["steer"][-1] == pytest.approx(-0.3)


def test_at_speed_it_rides_up_and_leans_into_a_turn():
    """Its bottom lifts it over the hump, and leans it into a hard turn, in which its weight would lean it outwards."""
    bend = vehsim.simulate(BOAT, World(water=0.0), (4500.0, 0.15), duration=10.0, step=1 / 48)
    assert 0.15 < bend.positions[-1, 2] < 0.4 and bend.twists[-1, 3] > 11.0
    assert bend.twists[-1, 2] > 0.1
    turn = vehsim.simulate(BOAT, World(water=0.0), (3000.0, 0.35), duration=8.0, step=1 / 48)
    lean = np.degrees(np.arcsin(turn.matrices()[-1, 2, 1]))  # to starboard, the outside of a turn to port
    assert turn.twists[-1, 2] > 0.3 and -8.0 < lean < -2.0


@pytest.mark.parametrize(("thrust", "degrees"), [(4500.0, 3.0), (4500.0, 12.0), (3000.0, 14.0)])
def test_it_leans_into_turns_steadily_and_its_plan_turns_alike(thrust, degrees):
    """Fast and slow: its roll comes to rest with the inner side lower; the planar boat has its speed and rate."""
    controls = (thrust, np.radians(degrees))
    twist = vehsim.simulate(BOAT, None, controls, duration=60.0, step=1 / 24).twists[-1]
    risen = np.array([0.0, 0.0, 0.25 if twist[1] > 10 else 0.0])
    start = State(position=risen, twist=np.array([0, 0, twist[0], twist[1], twist[2], 0]))
    turn = vehsim.simulate(BOAT, World(water=0.0), controls, start=start, duration=12.0, step=1 / 48)
    last = turn.times > 9.0
    lean = -np.degrees(np.arcsin(turn.matrices()[last, 2, 1]))
    assert lean.min() > (4.0 if degrees == 12.0 else 1.0) and lean.max() < 12.0 and np.ptp(lean) < 1.0
    assert turn.twists[-1, 2] == pytest.approx(twist[0], rel=0.12)
    assert turn.twists[-1, 3] == pytest.approx(twist[1], rel=0.12)


def test_the_keels_end_stands_still():
    """Half of the fin of an outboard turns with the helm, so it carries half the force and keeps a drift small; a
    rudder turns as a whole."""
    given = dict(mass=100.0, inertia=(10, 20, 30), thrusters=((-2, 0, 0),), rudder=(-2, 0, 0), rudder_area=0.1)
    ahead, helm = ca.DM([0, 0, 0, 10.0, 0, 0]), 0.2
    boats = boat(skeg=0.0, **given), boat(**given), boat(outboard=0, **given)
    whole, half, rudder = (float(b.hull.propulsion(ca.DM([0, helm]), ahead, ca.DM([1]))[4]) for b in boats)
    assert half == pytest.approx(whole / 2, rel=1e-6)
    assert rudder == pytest.approx(whole, rel=1e-6)


def test_a_roll_at_full_speed_decays():
    """Straight ahead at 18 m/s and heeled by 8 degrees; without the rise of the water it kept rolling."""
    start = State(
        position=np.array([0.0, 0.0, 0.27]),
        orientation=from_vectors(np.array([np.radians(8.0), 0.0, 0.0])),
        twist=np.array([0, 0, 0, 18.0, 0, 0]),
    )
    clip = vehsim.simulate(BOAT, World(water=0.0), (4000.0, 0.0), start=start, duration=4.0, step=1 / 48)
    roll = np.degrees(np.arcsin(clip.matrices()[:, 2, 1]))
    assert np.abs(roll[clip.times > 2.5]).max() < 0.8


def test_two_thrusters_match_the_paper_of_lie():
    """Each thruster at c pushing along X makes (c x e_x, e_x) = (0, c_z, -c_y, 1, 0, 0) (LIE 4.3.2)."""
    pair = boat(mass=100.0, inertia=(10, 20, 30), thrusters=((-2, -0.5, -0.2), (-2, 0.5, -0.2)), outboard=0)
    assert pair.control_names == ("right", "left")
    import casadi as ca

    wrench = pair.hull.propulsion(ca.DM([10, 4]), ca.DM.zeros(6), ca.DM([1, 0.5]))
    np.testing.assert_allclose(ca.DM(wrench).full().ravel(), [0, -0.2 * 12, 0.5 * 10 - 0.5 * 2, 12, 0, 0])
    with pytest.raises(InputError, match="an outboard is one thruster"):
        boat(mass=1.0, inertia=(1, 1, 1), thrusters=((-1, -1, 0), (-1, 1, 0)))


def test_a_propeller_in_the_air_does_not_push():
    clip = vehsim.simulate(BOAT, World(water=0.0), (4000.0, 0.0), start=State(position=(0, 0, 4.0)), duration=0.5)
    assert abs(clip.twists[-1, 3]) < 1e-9


def test_currents_and_wind_carry_it_away():
    stream = World(water=Water(current=Stream((0.1, 0.8, 0.0))))  # abeam: along its keel it would take minutes
    clip = vehsim.simulate(BOAT, stream, duration=15.0, step=1 / 24)
    drift = np.diff(clip.positions[-2:], axis=0)[0] / np.diff(clip.times[-2:])
    np.testing.assert_allclose(drift, [0.1, 0.8, 0], atol=0.25)
    blown = vehsim.simulate(BOAT, World(water=0.0, wind=(0, 10, 0)), duration=6.0, step=1 / 24)
    assert blown.positions[-1, 1] > 1.0
    gusty = vehsim.simulate(
        BOAT, World(water=0.0, wind=(0, 10, 0), gusts=Gusts(0.4, seed=2)), duration=6.0, step=1 / 24
    )
    assert 1e-3 < abs(gusty.positions[-1, 1] - blown.positions[-1, 1]) < 1.0


@pytest.mark.parametrize("heading", [0.0, 40.0, 90.0, 200.0])
def test_in_the_plane_the_wind_pushes_where_it_blows(heading):
    """Half the density, speed times velocity along either axis, times the area in that direction; zero when adrift."""
    yaw, wind, still, none = np.deg2rad(heading), np.array([-6.0, 3.0, 0.0]), np.zeros(3), np.zeros(0)
    air = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) @ wind[:2]

    def push(twist, wind):
        given = (ca.SX(v) for v in ([yaw, 0.0, 0.0], none, none, twist, np.zeros(2), wind))
        return np.ravel(np.asarray(ca.evalf(BOAT.planar.force(*given)[1])))

    expected = 0.5 * AIR * np.linalg.norm(air) * air * [2.4, 5.2]
    np.testing.assert_allclose(push(still, wind)[1:], expected, rtol=1e-5, atol=0.01)
    adrift = np.array([0.0, *air])
    calm = push(adrift, still)[1:] + expected  # the drag in still air has the same size
    np.testing.assert_allclose(push(adrift, wind)[1:], calm, rtol=1e-4, atol=0.01)


def test_docking_in_the_wind_is_planned():
    """From rest to rest, with the wind abeam: plans use the planar boat (LIE Fig. 10)."""
    marks = [
        vehsim.Mark(1001, position=(0, 0, 0), heading=0, velocity=(0, 0, 0)),
        vehsim.Mark(1481, position=(30, 12, 0), heading=90, velocity=(0, 0, 0)),
    ]
    plan = vehsim.plan(BOAT, World(wind=(0, 6, 0)), marks=marks, segments=48)
    assert plan.success and plan.defect < 1e-6
    np.testing.assert_allclose(plan.clip.positions[-1], [30, 12, 0], atol=1e-6)
    thrust, steering = np.abs(np.diff(plan.clip.controls, axis=0) / np.diff(plan.clip.times)[:, None]).max(axis=0)
    assert thrust < 2000 and steering < 0.5  # N/s, rad/s: no bursts ahead and astern, which would be the least effort
    replay = vehsim.simulate(
        BOAT,
        World(wind=(0, 6, 0)),
        plan.clip.controls,
        start=State(),
        duration=plan.duration,
        step=1 / 24,
        actuators=False,
    )
    np.testing.assert_allclose(replay.positions[-1], [30, 12, 0], atol=0.1)


SHOT = {
    "shot": {"schema": 1, "name": "float", "end_frame": 1013},
    "world": {
        "wind": [0, 5, 0],
        "gusts": {"seed": 3},
        "water": {
            "level": 1.0,
            "choppiness": 0.2,
            "current": [0.3, 0, 0],
            "wave": [{"height": 0.2, "length": 12, "heading": 30}],
            "vortex": [{"centre": [20, 0], "speed": 1, "radius": 3}],
        },
    },
    "vehicle": [{"name": "boat", "asset": "boat", "motion": {"method": "simulate", "step": 1 / 48}}],
}


def test_a_shot_file_has_water():
    shot = vehsim.Shot.from_dict(SHOT)
    assert not [problem for problem in shot.check() if problem.severity == "error"]
    water = shot.world.water
    assert water.level == 1.0 and water.surface.choppiness == 0.2 and len(water.current.parts) == 2
    clip = shot.solve().clips["boat"]
    assert np.abs(clip.positions[:, 2] - 1.0).max() < 0.3 and np.isfinite(clip.twists).all()


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"wave": [{"height": 9, "length": 10}], "choppiness": 1.0}, "folds over"),
        ({"grids": "none.npz"}, "no such file"),
        ({"grids": "none.npz", "sea": {"height": 1.0}}, "waves are given too"),
        ({"sea": {"height": -1.0}}, "world.water.sea.height"),
    ],
)
def test_invalid_water_is_reported(table, message):
    data = SHOT | {"world": {"water": table}}
    with pytest.raises(ShotError, match=message):
        vehsim.Shot.from_dict(data).solve()


def test_a_broken_hull_is_reported_before_simulating(tmp_path):
    """A boat whose hull is an open mesh: `check` names vehicle, file, prim and the remedy."""
    folder = tmp_path / "boat"
    shutil.copytree(BOAT.rig.asset.parent, folder)
    toml = folder / "vehicle.toml"
    toml.write_text(toml.read_text().replace('hull = "hull/hull" ', 'hull = "hull/hull_deck" '))
    vehicle = SHOT["vehicle"][0] | {"asset": str(folder)}
    problems = vehsim.Shot.from_dict(SHOT | {"vehicle": [vehicle]}).check()
    found = [problem for problem in problems if problem.severity == "error"]
    assert [problem.key for problem in found] == ["vehicle[0].asset"]
    assert re.search(r"boat.usdc: hull/hull_deck: not a hull: open: \d+ edges", str(found[0]))


def test_a_boat_without_resistance_has_the_usual_one(tmp_path):
    """Dropped from a metre it is at rest on its waterline 15 s later, with a warning; or none if so given."""
    folder = tmp_path / "boat"
    shutil.copytree(BOAT.rig.asset.parent, folder)
    toml = folder / "vehicle.toml"
    laws = "damping|damping_quadratic|impact|added_mass|impact_drag|hull_form|wetted_length|chine_beam|transom"
    laws += "|wetted_area|deadrise|running_centre|running_radius"
    bare = re.sub(rf"^({laws}) = .*\n", "", toml.read_text(), flags=re.MULTILINE)
    toml.write_text(bare)
    with pytest.warns(UserWarning, match=r"physics.damping: missing: .* damping = \[84.8, 509, 1.7e\+03\]"):
        usual = vehsim.load_vehicle(folder)
    assert usual.hull.damping == pytest.approx([84.8, 508.8, 1696.0])
    assert usual.hull.added_mass == pytest.approx([165.5, 3837.6, 2350.0, 101.76, 1017.6, 1696.0])
    with pytest.warns(UserWarning, match="none: without it a boat never comes to rest"):
        assert not np.any(vehsim.load_vehicle(folder, {"damping": [0.0, 0.0, 0.0]}).hull.added_mass)
    clip = vehsim.simulate(usual, World(water=0.0), start=State(position=(0, 0, 1.0)), duration=15.0, step=1 / 24)
    assert np.abs(clip.positions[-1, 2]) < 0.02 and np.abs(clip.twists[-1]).max() < 0.05
