"""Contact compared with closed forms: restitution, friction, momentum, depth; a block, skids, two bodies."""

from dataclasses import replace

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdPhysics

import vehsim
from vehsim.errors import InputError
from vehsim.lie import SE3, SO3xR3
from vehsim.lie.quaternions import rotate as from_body
from vehsim.rig.parts import collision_hulls
from vehsim.simulation import Mover, simulate_together
from vehsim.vehicles import Holonomic, Rig, State
from vehsim.vehicles.definition.hydrodynamics import Hull
from vehsim.world.contact.bodies import MovingBody
from vehsim.world.contact.contact import DEPTH, Contact, ContactScene, damping_ratio
from vehsim.world.obstacles.obstacles import box, moving
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.water import Water, wave
from vehsim.world.world import World

FLOOR = box("floor", (0, 0, -1), (400, 400, 1))
SIZE = (1.0, 0.6, 0.4)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """Makes a uniform block with its body frame in its middle."""
    path = tmp_path_factory.mktemp("block") / "block.usda"
    slab(path, SIZE)

    def make(mass=100.0, gravity=9.81, group=SO3xR3):
        x, y, z = SIZE
        turning = mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
        inertia = [*turning, mass, mass, mass]
        return Holonomic(name="block", group=group, inertia=inertia, gravity=gravity, rig=Rig(path, ""))

    return make


def slab(path, size, places=(0.0,)):
    """A box around its root, as USD; or several, side by side at ``places``."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/block").GetPrim())
    x, y, z = (float(side) / 2 for side in size)
    for k, place in enumerate(places):
        mesh = UsdGeom.Mesh.Define(stage, f"/block/hull{k or ''}")
        mesh.CreatePointsAttr([(a, b + place, c) for a in (-x, x) for b in (-y, y) for c in (-z, z)])
        mesh.CreateFaceVertexCountsAttr([4] * 6)
        mesh.CreateFaceVertexIndicesAttr([0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3])
        UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    stage.Save()


def thrown(vehicle, contact, position, twist, duration, world=None, step=1 / 60):
    world = world or World(obstacles=[FLOOR], contact=contact)
    start = State(position=position, twist=twist)
    return vehsim.simulate(vehicle, world, None, start, duration=duration, step=step, fps=60)


@pytest.mark.parametrize("restitution", [0.05, 0.1, 0.2, 0.5, 0.9])
@pytest.mark.parametrize("speed", [20.0, 2.0])
@pytest.mark.parametrize("group", [SE3, SO3xR3], ids=lambda group: group.name)
def test_restitution_at_any_speed(block, restitution, speed, group):
    clip = thrown(
        block(gravity=0.0, group=group),
        Contact(0.3, restitution, 20.0),
        (0, 0, 0.2 + 0.05 * speed),
        (0, 0, 0, 0, 0, -speed),
        0.1,
    )
    assert clip.twists[-1, 5] / speed == pytest.approx(restitution, rel=0.05)
    (event,) = clip.events
    assert event["speed"] == pytest.approx(speed, rel=1e-3)
    assert event["impulse"] == pytest.approx(100 * (speed + clip.twists[-1, 5]), rel=0.01)
    assert event["time"] == pytest.approx(0.05, abs=1e-3) and event["with"] == "floor"


@pytest.mark.parametrize("restitution", [0.1, 0.5])
def test_friction_slows_as_coulomb_says_and_then_holds(block, restitution):
    """mu g while it slides; v / (mu g) until rest; and no creep faster than the slip speed."""
    clip = thrown(block(), Contact(0.3, restitution, 1.0), (0, 0, 0.2), (0, 0, 0, 3.0, 0, 0), 1.3)
    slides = clip.times < 0.9
    slope = np.polyfit(clip.times[slides], clip.twists[slides, 3], 1)[0]
    assert slope == pytest.approx(-0.3 * 9.81, rel=0.05)
    assert clip.positions[-1, 0] == pytest.approx(3.0**2 / (2 * 0.3 * 9.81), rel=0.05)
    assert np.abs(clip.twists[-1, 3:]).max() < 0.01
    assert 0.2 - clip.positions[:, 2].min() < 2e-3  # g / frequency^2


def test_a_block_stays_on_a_slope_inside_the_friction_cone(block):
    """On a slope of 0.3 for a minute: after it has settled, not a single bit changes."""
    terrain = Terrain("slope", np.tile(-0.15 * np.arange(-20, 21), (41, 1)), (-10.0, -10.0), (0.5, 0.5))
    up = np.array([0.3, 0.0, 1.0]) / np.hypot(1, 0.3)
    tilt = np.arctan(0.3) / 2
    start = State(position=0.2 * up, orientation=(np.cos(tilt), 0, np.sin(tilt), 0))
    world = World(terrain=terrain, contact=Contact(0.4, 0.3, 1.0))
    clip = vehsim.simulate(block(), world, None, start, duration=60.0, step=1 / 24)
    assert np.linalg.norm(clip.positions[-1] - clip.positions[0]) < 3e-3  # g / frequency^2, and along
    settled = clip.times > 3.0
    assert np.ptp(clip.positions[settled], axis=0).max() == np.abs(clip.twists[settled]).max() == 0
    (event,) = clip.events
    assert event["impulse"] == pytest.approx(100 * 9.81 * 60.0, rel=1e-3)


@pytest.mark.parametrize(("slope", "friction"), [(0.75, 0.8), (0.97, 1.0)])
def test_a_block_stays_just_inside_the_friction_cone(block, slope, friction):
    """Its weight rests mostly on the lower edge: the upper one slid, and the block crept by 0.25 mm/s."""
    terrain = Terrain("slope", np.tile(-0.5 * slope * np.arange(-20, 21), (41, 1)), (-10.0, -10.0), (0.5, 0.5))
    up, tilt = np.array([slope, 0.0, 1.0]) / np.hypot(1, slope), np.arctan(slope) / 2
    start = State(position=0.2 * up, orientation=(np.cos(tilt), 0, np.sin(tilt), 0))
    clip = vehsim.simulate(
        block(), World(terrain=terrain, contact=Contact(friction, 0.3, 20.0)), None, start, duration=1.0, step=1 / 24
    )
    assert not np.ptp(clip.positions[clip.times > 0.7], axis=0).any()


def test_a_stack_stands(block):
    """Three blocks, each a little beside the one below."""
    world = World(obstacles=[FLOOR], contact=Contact(0.4, 0.3, 1.0))
    movers = {f"block {k}": Mover(block(), None, State(position=(0.03 * k, 0, 0.2 + 0.4 * k))) for k in range(3)}
    clips = simulate_together(movers, world, 1.2, step=1 / 24)
    for clip in clips.values():
        late = clip.positions[clip.times > 1.0]
        assert np.ptp(late, axis=0).max() < 2e-4 and np.abs(clip.positions[-1, :2] - clip.positions[0, :2]).max() < 1e-3
    # each contact yields by its load over its stiffness; two blocks have half the effective mass of one
    yielding = (3 + 2 * 2 + 2 * 1) * 9.81 / Contact(0.4, 0.3, 1.0).frequency ** 2
    assert 1.0 - clips["block 2"].positions[-1, 2] == pytest.approx(yielding, rel=0.05)


def test_a_wheel_rolls(tmp_path):
    """Grips do not hold back what rolls: a prism of 24 sides keeps its speed up to what its edges take."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "wheel.usda"))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/wheel").GetPrim())
    sides, radius = 24, 0.5
    angles = 2 * np.pi * np.arange(sides) / sides
    mesh = UsdGeom.Mesh.Define(stage, "/wheel/hull")
    rim = [(radius * np.cos(a), y, radius * np.sin(a)) for y in (-0.2, 0.2) for a in angles]
    mesh.CreatePointsAttr([tuple(map(float, point)) for point in rim])
    quads = [(k, (k + 1) % sides, sides + (k + 1) % sides, sides + k) for k in range(sides)]
    mesh.CreateFaceVertexCountsAttr([4] * sides + [sides, sides])
    ends = [*reversed(range(sides)), *range(sides, 2 * sides)]
    mesh.CreateFaceVertexIndicesAttr([*(i for quad in quads for i in quad), *ends])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    stage.Save()
    inertia = 50 * radius**2 / 2
    rig = Rig(tmp_path / "wheel.usda", "")
    wheel = Holonomic(name="wheel", group=SO3xR3, inertia=[30, inertia, 30, 50, 50, 50], gravity=9.81, rig=rig)
    world = World(obstacles=[FLOOR], contact=Contact(0.5, 0.05, 2.0))
    start = State(position=(0, 0, 0.5 * np.cos(np.pi / sides)), twist=(0, 4.0, 0, 2.0, 0, 0))
    clip = vehsim.simulate(wheel, world, None, start, duration=1.0, step=1 / 48, fps=48)
    speed = np.diff(clip.positions[-5:, 0]).mean() * 48  # 15 impacts on edges leave the share (1 + 2 cos) / 3 each
    assert 2.0 * ((1 + 2 * np.cos(2 * np.pi / sides)) / 3) ** 15 < speed < 2.0
    assert clip.twists[-1, 1] * radius == pytest.approx(speed, rel=0.1)


def test_a_body_at_rest_wakes_when_it_is_touched(block):
    """By an obstacle that begins to move after the block has come to rest."""
    contact = Contact(0.3, 0.1, 1.0)
    begin = State(position=(-1.6, 0, 0.25), twist=(0, 0, 0, 1.0, 0, 0))
    ram = vehsim.simulate(block(gravity=0.0), None, None, begin, duration=1.0, step=1 / 24)
    world = World(obstacles=[FLOOR, moving("ram", replace(ram, start_frame=1025))], contact=contact)
    clip = vehsim.simulate(block(), world, None, State(position=(0, 0, 0.2)), duration=1.8, step=1 / 24)
    assert (np.abs(clip.twists[clip.times < 1.0]).max(axis=1) == 0).sum() > 2
    event = next(event for event in clip.events if event["with"] == "ram")
    assert event["time"] == pytest.approx(1.0 + 0.6, abs=5e-3) and event["speed"] == pytest.approx(1.0, rel=1e-2)


def test_a_body_rests_until_a_moving_obstacle_is_near(block):
    """One comes from four metres away, moving all the time, and hits it at its full speed when it should."""
    begin = State(position=(-4.6, 0, 0.25), twist=(0, 0, 0, 3.0, 0, 0))
    ram = vehsim.simulate(block(gravity=0.0), None, None, begin, duration=1.4, step=1 / 24)
    world = World(obstacles=[FLOOR, moving("ram", ram)], contact=Contact(0.3, 0.1, 3.0))
    clip = vehsim.simulate(block(), world, None, State(position=(0, 0, 0.2)), duration=1.25, step=1 / 24)
    assert not clip.twists[(clip.times > 0.6) & (clip.times < 0.8)].any()
    (event,) = [event for event in clip.events if event["with"] == "ram"]
    assert event["time"] == pytest.approx(3.6 / 3, abs=2e-3) and event["speed"] == pytest.approx(3.0, rel=1e-2)
    assert clip.twists[-1, 3] == pytest.approx(3.0 * 1.1, rel=0.1)


def test_what_rests_is_not_looked_at_while_others_move(block, monkeypatch):
    """Two stacked blocks rest while a third slides past another one and hits them; they wake as it touches them."""
    contact, pushed = Contact(0.05, 0.1, 2.0), []
    push = ContactScene._push
    monkeypatch.setattr(ContactScene, "_push", lambda self, *given: (pushed.append(self._time), push(self, *given))[1])
    places = {"low": (0, 0, 0.2), "high": (0, 0, 0.6), "aside": (-1.5, 2, 0.2)}
    movers = {name: Mover(block(), None, State(position=place)) for name, place in places.items()}
    movers["slider"] = Mover(block(), None, State(position=(-3.5, 0, 0.2), twist=(0, 0, 0, 3.0, 0, 0)))
    clips = simulate_together(movers, World(obstacles=[FLOOR], contact=contact), 1.2, step=1 / 24)
    times = clips["low"].times
    (hit,) = [event for event in clips["low"].events if event["with"] == "slider"]
    expected = (3.0 - np.sqrt(9.0 - 2 * 0.05 * 9.81 * 2.5)) / (0.05 * 9.81)
    assert hit["time"] == pytest.approx(expected, abs=5e-3)
    for name in places:
        resting = (times > 0.6) & (times < (hit["time"] if name != "aside" else 2.0))
        assert resting.sum() > 4 and not clips[name].twists[resting].any()
    early, late = (np.sum([a < time < a + 0.1 for time in pushed]) for a in (0.1, 0.6))
    assert late < early / 3  # only the slider's
    assert clips["low"].twists[-1, 3] > 0.5 and clips["high"].twists[-1, 3] != 0


def test_a_boat_on_a_beach_rests_until_it_is_touched(block):
    """Its keel stops on the sand, its stern afloat; a ram wakes it and pushes it along."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.1 * (x - 10), (len(x), 1)), (-60, -60), (2, 2))
    contact, boat = Contact(0.6, 0.1, 1.5), vehsim.load_vehicle("boat")
    begin = State(position=(5.0, -2.4, 0.3), twist=(0, 0, 0, 0, 1.5, 0))
    ram = vehsim.simulate(block(gravity=0.0), None, None, begin, duration=1.3, step=1 / 24)
    world = World(beach, water=0.0, contact=contact, obstacles=[moving("ram", replace(ram, start_frame=1049))])
    start = State(position=(4.8, 0, 0), twist=(0, 0, 0, 0.5, 0, 0))
    clip = vehsim.simulate(boat, world, (0.0, 0.0), start, duration=2.75, step=1 / 24)
    touch = next(event["time"] for event in clip.events if event["with"] == "ram")
    resting = (clip.times > 1.6) & (clip.times < 2.0)  # until the ram begins to move
    assert touch > 2.0 and not clip.twists[resting].any()
    assert clip.positions[-1, 1] > 0.15 and clip.twists[-1, 4] > 1.0


def test_a_resting_boat_costs_nothing_on_still_water(monkeypatch):
    """Neither ground nor water is evaluated again, and its contact goes on: the impulse is its weight without its
    buoyancy, times the time."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.1 * (x - 10), (len(x), 1)), (-60, -60), (2, 2))
    boat, world = vehsim.load_vehicle("boat"), World(beach, water=0.0, contact=Contact(0.4, 0.1, 1.5))
    start = State(position=(5.4855, 0, 0.052), orientation=(1, 0, 9.1e-4, 0))
    evaluations = {"contact": 0, "water": 0}

    def count(kind, method):
        def counted(*given):
            evaluations[kind] += 1
            return method(*given)

        return counted

    monkeypatch.setattr(ContactScene, "_touching", count("contact", ContactScene._touching))
    monkeypatch.setattr(Afloat, "under", count("water", Afloat.under))
    needed, impulses = [], []
    for duration in (1.0, 6.0):
        evaluations.update(contact=0, water=0)
        clip = vehsim.simulate(boat, world, (0.0, 0.0), start, duration=duration, step=1 / 48)
        (event,) = clip.events
        needed.append(dict(evaluations))
        impulses.append(event["impulse"])
        assert event["time"] + event["duration"] == pytest.approx(duration, abs=0.02)
    assert needed[0] == needed[1] and not clip.twists[clip.times > 1.0].any()
    afloat = Afloat(boat, world)
    wrench = afloat.wrench(0.0, clip.state(-1), np.zeros(2))
    weight = boat.inertia[5, 5] * 9.81 - from_body(clip.orientations[-1], wrench[3:])[2]
    assert (impulses[1] - impulses[0]) / 5.0 == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize("friction", [0.0, 0.4])
def test_contacts_balance_what_friction_and_weight_allow(block, friction):
    """A block on a floor, whose length is 2.5 times its height: pushed from any side, lifted, and tipped."""
    world = World(obstacles=[FLOOR], contact=Contact(friction, 0.1, 2.0))
    clip = vehsim.simulate(block(), world, None, State(position=(0, 0, 0.2)), duration=1.0)
    scene = ContactScene({"block": block()}, world, world.contact)
    scene.wrenches(0.0, [clip.state(-1)])
    weight = 100.0 * 9.81
    for angle in np.linspace(0, 2 * np.pi, 7):
        push = friction * weight * np.array([0, 0, 0, np.cos(angle), np.sin(angle), 0])
        assert all(scene.holds([0.87 * push]))
        assert friction == 0 or not all(scene.holds([0.96 * push]))
    assert friction > 0 or not all(scene.holds([np.array([0, 0, 0, 1.0, 0, 0])]))
    for change in ([0, 0, 0, 0, 0, 1.0], [0, SIZE[0] / 2, 0, 0, 0, 0], [-SIZE[1] / 2, 0, 0, 0, 0, 0]):
        assert all(scene.holds([0.99 * weight * np.array(change)])) and not all(
            scene.holds([1.01 * weight * np.array(change)])
        )


def test_one_of_two_stacked_blocks_cannot_be_pushed_away(block):
    """What acts on the upper one passes to the floor through the lower one."""
    world = World(obstacles=[FLOOR], contact=Contact(0.4, 0.1, 2.0))
    scene = ContactScene({"low": block(), "high": block()}, world, world.contact)
    low, high = (9.81 / (world.contact.stiff_for(0.0, leaning) / DEPTH) ** 2 for leaning in (False, True))
    places = (0, 0, 0.2 - 2 * low), (0, 0, 0.6 - 2 * low - 2 * high)  # as deep as their weights press the springs
    scene.wrenches(0.0, [State(position=place, twist=np.zeros(6)) for place in places])
    weight, push = 100.0 * 9.81, np.array([0, 0, 0, 1.0, 0, 0])
    high, low = (
        all(scene.holds([np.zeros(6), 0.3 * weight * push])),
        all(scene.holds([0.6 * weight * push, np.zeros(6)])),
    )
    assert high and low
    assert not all(scene.holds([np.zeros(6), 0.5 * weight * push])) and not all(
        scene.holds([weight * push, np.zeros(6)])
    )


def test_what_stands_on_a_slow_platform_goes_with_it(block):
    """At a fifth of a millimetre per second it rested most of the time, and went a tenth of the way."""
    start = State(position=(0, 0, -0.2), twist=(0, 0, 0, 2e-4, 0, 0))
    platform = vehsim.simulate(block(gravity=0.0), None, None, start, duration=5.0, step=1 / 24)
    world = World(obstacles=[moving("platform", platform)], contact=Contact(0.5, 0.3, 5.0))
    clip = vehsim.simulate(block(), world, None, State(position=(0, 0, 0.2)), duration=2.0, step=1 / 24)
    assert clip.positions[-1, 0] == pytest.approx(4e-4, rel=0.02)


@pytest.mark.parametrize("restitution", [0.02, 0.1, 0.3])
def test_a_helicopter_stands_still_on_its_skids(restitution):
    """Its skids are far below its centre of mass, about which it rolls easily: dampers for its whole mass were too
    strong for the step, and rolled it to and fro in every step without end."""
    clip = vehsim.simulate(
        vehsim.load_vehicle("helicopter"),
        World(obstacles=[FLOOR], contact=Contact(0.4, restitution)),
        None,
        State(position=(0, 0, 0.01)),
        duration=2.0,
    )
    assert not clip.twists[clip.times > 1.0].any() and abs(clip.positions[-1]).max() < 1e-3


@pytest.mark.parametrize(("height", "still"), [(0.08, True), (0.8, False)])
def test_a_boat_on_a_beach_rests_in_small_waves(height, still, monkeypatch):
    """Their pressure changes all the time, but its keel holds it; large waves lift it."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.1 * (x - 10), (len(x), 1)), (-60, -60), (2, 2))
    water = Water(surface=wave(height, 4.0 if still else 12.0))
    boat, world = vehsim.load_vehicle("boat"), World(beach, water=water, contact=Contact(0.4, 0.1, 1.5))
    start = State(position=(6.5104, 0, 0.1536), orientation=(1, 0, 9.13e-4, 0))
    evaluations, touching = [0], ContactScene._touching

    def counted(*given):
        evaluations[0] += 1
        return touching(*given)

    monkeypatch.setattr(ContactScene, "_touching", counted)
    clip = vehsim.simulate(boat, world, (0.0, 0.0), start, duration=1.0, step=1 / 48)
    assert clip.twists[clip.times > 0.5].any() != still
    assert (evaluations[0] < 600) == still


def test_a_block_settles_in_few_evaluations(block, monkeypatch):
    """Dropped on an edge, with a strong damper, it comes to rest to the bit, in steps as long as the damper permits."""
    evaluations, touching = [], ContactScene._touching
    monkeypatch.setattr(ContactScene, "_touching", lambda *given: (evaluations.append(0), touching(*given))[1])
    start = State(position=(0, 0, 0.21), orientation=(np.cos(0.01), np.sin(0.01), 0, 0))
    world = World(obstacles=[FLOOR], contact=Contact(0.4, 0.05, 2.0))
    clip = vehsim.simulate(block(), world, None, start, duration=1.5)
    assert not clip.twists[-5:].any() and len(evaluations) < 1000


def test_a_body_that_rocks_is_as_slow_as_its_points():
    """Not as a sphere around it: a boat on its keel has come to rest although its bow is far from its middle."""
    boat = vehsim.load_vehicle("boat")
    scene = ContactScene({"boat": boat}, World(obstacles=[FLOOR]), Contact())
    points = np.concatenate(collision_hulls(boat.rig.asset, boat.rig.root or None))
    for twist in np.random.default_rng(2).normal(size=(20, 6)) * [1, 1, 1, 0.1, 0.1, 0.1]:
        fastest = np.linalg.norm(twist[3:] + np.cross(twist[:3], points), axis=1).max()
        moving_body = MovingBody(scene.bodies[0], State(position=(1, 2, 3), orientation=(0.6, 0.8, 0, 0), twist=twist))
        assert fastest <= moving_body.speed < 1.5 * fastest
    rocking = MovingBody(scene.bodies[0], State(twist=(1.0, 0, 0, 0, 0, 0)))
    assert rocking.speed < 0.3 * (rocking.fastest - 0.5)


def test_depth_stays_below_two_centimetres_in_any_landing(block):
    """Corner, edge and face first at 20 m/s, a frame every sixtieth of a second: measured by MuJoCo's contacts."""
    from scipy.spatial.transform import Rotation

    corners = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.3, 0.3) for z in (-0.2, 0.2)])
    for k, turn in enumerate(Rotation.random(3, rng=7)):
        q = turn.as_quat(scalar_first=True)
        start = State(position=(0, 0, 2.0), orientation=q, twist=(3, -2, 1, *turn.inv().apply([4, 0, -20])))
        world = World(obstacles=[FLOOR], contact=Contact(0.4, 0.3, 20.0))
        clip = vehsim.simulate(block(), world, None, start, duration=0.25, step=1 / 60, fps=60)
        lowest = [(corners @ m[:3, :3].T + m[:3, 3])[:, 2].min() for m in clip.matrices()]
        assert min(lowest) > -0.02, k
        assert clip.events


def test_only_impacts_take_small_steps(block):
    """A body that slides or separates, with its damper stronger than its spring, needs no small steps."""
    contact = Contact(0.3, 0.1, 20.0)
    scene = ContactScene({"block": block()}, World(obstacles=[FLOOR], contact=contact), contact)

    def step(gap, rise, along=0.0):
        scene.wrenches(0.0, [State(position=(0, 0, 0.2 + gap), twist=(0, 0, 0, along, 0, rise))])
        return scene.next_step / contact.step

    assert step(-1e-3, 0.9) == step(1e-5, 0.9) == step(1e-5, 0.0, along=5.0) == pytest.approx(1.0)
    assert max(step(-1e-3, -0.9), step(1e-5, -2.0), step(-5e-3, 0.0)) < 0.35


def test_what_slides_or_rests_is_soft_until_it_is_hit(block, monkeypatch):
    """A sliding block brakes by friction alone, with long steps although its contacts could stop 20 m/s; one that rests
    and is then hit at 20 m/s does not sink into the floor."""
    evaluations, touching = [0], ContactScene._touching

    def counted(*given):
        evaluations[0] += 1
        return touching(*given)

    monkeypatch.setattr(ContactScene, "_touching", counted)
    world = World(obstacles=[FLOOR], contact=Contact(0.4, 0.3, 20.0))
    start = State(position=(0, 0, 0.2), twist=(0, 0, 0, 3.0, 0, 0))
    clip = vehsim.simulate(block(), world, None, start, duration=0.5, step=1 / 24)
    assert clip.twists[-1, 3] == pytest.approx(3.0 - 0.4 * 9.81 * 0.5, rel=5e-3)
    assert evaluations[0] < 1000  # 6,145 at the stiffness for 20 m/s
    movers = {
        "low": Mover(block(), None, State(position=(0, 0, 0.2))),
        "high": Mover(block(), None, State(position=(0.1, 0, 10.7), twist=(0, 0, 0, 0, 0, -15.0))),
    }
    low, high = simulate_together(movers, world, 0.62, step=1 / 600).values()
    assert abs(np.diff(high.twists[:, 5])).max() > 10  # they met
    assert low.positions[:, 2].min() > 0.2 - 0.02


@pytest.mark.parametrize("speed", [20.0, 2.0])
def test_hulls_of_several_parts_are_detected_before_contact(tmp_path, speed):
    """Two floats side by side, bows towards a quay: monitored before they touch, they bounce as one block does."""
    path = tmp_path / "floats.usda"
    slab(path, (4.0, 0.5, 0.6), places=(-1.0, 1.0))
    inertia = (100.0, 150.0, 200.0, 300.0, 300.0, 300.0)
    floats = Holonomic(name="floats", group=SE3, inertia=inertia, gravity=0.0, rig=Rig(path, ""))
    contact = Contact(0.3, 0.1, 20.0)
    world = World(obstacles=[box("quay", (12.5, 0, 0), (20, 300, 10))], contact=contact)  # its face is at 2.5
    start = State(position=(-speed * 0.05, 0, 2.0), twist=(0, 0, 0, speed, 0, 0))
    clip = vehsim.simulate(floats, world, None, start, duration=0.4, step=1 / 60, fps=60)
    assert clip.positions[:, 0].max() < 0.5 + 0.02
    assert clip.twists[-1, 3] / speed == pytest.approx(-0.1, rel=0.05)
    (event,) = clip.events
    assert event["impulse"] == pytest.approx(300 * speed * 1.1, rel=0.01)
    scene = ContactScene({"floats": floats}, world, contact)
    scene.wrenches(0.0, [replace(start, position=(0.499, 0, 2.0))])
    assert len(scene.data.contact.dist) > 0  # a millimetre away


def test_two_vehicles_exchange_momentum_and_nothing_else(block):
    world = World(contact=Contact(0.3, 0.5, 5.0))
    movers = {
        "a": Mover(block(gravity=0.0), None, State(twist=(0, 0, 0, 3.0, 0, 0))),
        "b": Mover(block(50.0, 0.0), None, State(position=(2, 0.2, 0.05), twist=(0, 0, 0, -1.0, 0, 0))),
    }
    clips = simulate_together(movers, world, 0.5, step=1 / 60)
    before, after = (momenta(clips.values(), k) for k in (0, -1))
    assert after == pytest.approx(before, abs=1e-9)
    assert clips["a"].events[0]["with"] == "b" and clips["b"].events[0]["with"] == "a"
    assert clips["a"].events[0]["impulse"] == clips["b"].events[0]["impulse"] > 0
    kinetic = [sum(clip.energy["kinetic"][k] for clip in clips.values()) for k in (0, -1)]
    assert kinetic[1] < kinetic[0]


def momenta(clips, k):
    total = np.zeros(6)
    for clip in clips:
        rotation, inertia = clip.matrices()[k, :3, :3], clip.vehicle.inertia
        linear = inertia[5, 5] * rotation @ clip.twists[k, 3:]
        angular = rotation @ inertia[:3, :3] @ clip.twists[k, :3] + np.cross(clip.positions[k], linear)
        total += np.concatenate([angular, linear])
    return total


def test_a_vehicle_alone_moves_as_in_a_group(block):
    contact = Contact(0.3, 0.4, 5.0)
    world = World(obstacles=[FLOOR], contact=contact)
    start = State(position=(0, 0, 0.5), twist=(0.5, 0.2, 0, 1.0, 0, -3.0))
    alone = vehsim.simulate(block(), world, None, start, duration=0.25, step=1 / 60)
    together = simulate_together({"block": Mover(block(), None, start)}, world, 0.25, step=1 / 60)["block"]
    assert together.positions == pytest.approx(alone.positions, abs=1e-12)
    assert together.events == alone.events


def test_contact_with_terrain_works_too(block):
    """On a slope steeper than its friction it slides with g (sin - mu cos); on a flatter one it stays."""
    x = np.arange(-60.0, 61.0, 2.0)
    beach = Terrain("beach", np.tile(0.4 * x, (len(x), 1)), (-60, -60), (2, 2))
    angle = np.arctan(0.4)
    q = (np.cos(angle / 2), 0, -np.sin(angle / 2), 0)
    normal = np.array([-np.sin(angle), 0, np.cos(angle)])
    start = State(position=0.2 * normal, orientation=q)
    for friction, moves in ((0.2, True), (0.8, False)):
        world = World(beach, contact=Contact(friction, 0.1, 1.0))
        clip = vehsim.simulate(block(), world, None, start, duration=0.5, step=1 / 60, fps=60)
        slid = -clip.twists[-1, 3]
        expected = 9.81 * (np.sin(angle) - friction * np.cos(angle)) * 0.5
        assert slid == pytest.approx(expected, rel=0.05) if moves else abs(slid) < 0.03


def test_a_moving_obstacle_hits_like_a_moving_wall(block):
    """v (1 + e) for a body at rest, although the obstacle's clip starts at another frame."""
    for restitution in (0.1, 0.5):
        contact = Contact(0.3, restitution, 10.0)
        start = State(position=(-2, 0, 0), twist=(0, 0, 0, 3.0, 0, 0))
        ram = vehsim.simulate(block(gravity=0.0), None, None, start, duration=0.6, step=1 / 60, fps=60)
        ram = replace(ram, start_frame=1007)  # it stands still for a tenth of a second
        world = World(obstacles=[moving("ram", ram)], contact=contact)
        clip = vehsim.simulate(block(gravity=0.0), world, None, duration=0.6, step=1 / 60, fps=60, start_frame=1001)
        (event,) = clip.events
        assert event["with"] == "ram" and event["speed"] == pytest.approx(3.0, rel=1e-3)
        assert event["time"] == pytest.approx(0.1 + (2 - SIZE[0]) / 3.0, abs=1e-3)
        assert clip.twists[-1, 3] == pytest.approx(3.0 * (1 + restitution), rel=0.02)
        assert np.abs(clip.twists[-1, [0, 1, 2, 4, 5]]).max() < 1e-9


def test_a_helicopter_that_falls_sinks_in_by_less_than_two_centimetres():
    """At 20 m/s on a dock and on the ground, a frame every sixtieth of a second: measured on its hulls' corners."""
    from scipy.spatial.transform import Rotation

    helicopter = vehsim.load_vehicle("helicopter")
    corners = np.vstack(collision_hulls(helicopter.rig.asset, helicopter.rig.root or None))
    for world in (
        World(obstacles=[box("pad", (0, 0, -2.0), (60, 60, 2.0))], contact=Contact()),
        World("flat", contact=Contact()),
    ):
        turn = Rotation.from_euler("xyz", (0.3, -0.2, 0.5))
        twist = (0.5, 1.0, 0, *turn.inv().apply([3.0, 1.0, -20.0]))
        start = State(position=(0, 0, 2.5), orientation=turn.as_quat(scalar_first=True), twist=twist)
        clip = vehsim.simulate(helicopter, world, None, start, duration=0.3, step=1 / 60, fps=60)
        lowest = [(corners @ m[:3, :3].T + m[:3, 3])[:, 2].min() for m in clip.matrices()]
        assert -0.02 < min(lowest) < 0.02
        assert clip.events and clip.twists[-1, 5] > -19


def test_a_boat_pushes_an_ice_floe_away(floe):
    """Ice floats with a tenth above the water; rammed, it receives the boat's impulse, and neither penetrates the
    other."""
    ice, thickness = floe
    contact, boat = Contact(0.05, 0.1, 2.5), vehsim.load_vehicle("boat")
    world = World(water=0.0, contact=contact)
    movers = {
        "boat": Mover(boat, (0.0, 0.0), State(position=(0, 0, 0), twist=(0, 0, 0, 2.0, 0, 0))),
        "floe": Mover(ice, None, State(position=(5.0, 0.3, (0.5 - 917 / 1025) * thickness))),
    }
    clips = simulate_together(movers, world, 0.6, step=1 / 60)
    event, back = clips["boat"].events[0], clips["floe"].events[0]
    assert event["with"] == "floe" and back["with"] == "boat" and event["impulse"] == back["impulse"]
    pushed = clips["floe"]
    assert pushed.twists[-1, 3] > 0.1 and clips["boat"].twists[-1, 3] < 1.8
    momentum = ice.inertia[5, 5] * pushed.twists[:, 3].max()
    assert momentum < sum(e["impulse"] for e in pushed.events) < 3 * momentum  # water and lift took the rest
    before = pushed.times < event["time"]
    assert np.abs(pushed.positions[before, 2] - pushed.positions[0, 2]).max() < 1e-3  # Archimedes
    depth = []
    scene = ContactScene({"boat": boat, "floe": ice}, world, contact)
    for k in range(len(pushed.times)):
        bodies = [_at(clips[name], k) for name in ("boat", "floe")]
        pairs = scene._touching([MovingBody(body, state) for body, state in zip(scene.bodies, bodies, strict=True)])
        depth += [depth for points in pairs.values() for depth in points.depths]
    assert 0 < max(depth) < 0.02


def _at(clip, k):
    return State(position=clip.positions[k], orientation=clip.orientations[k], twist=clip.twists[k])


@pytest.fixture(scope="module")
def floe(tmp_path_factory):
    """A slab of ice, three metres square, and how thick it is, m."""
    size = np.array([3.0, 3.0, 0.5])
    path = tmp_path_factory.mktemp("floe") / "floe.usda"
    slab(path, size)
    mass = 917.0 * size.prod()
    inertia = [*(mass / 12 * (size @ size - size**2)), mass, mass, mass]
    hull = Hull(prim="hull", damping=(400.0, 400.0, 4000.0), added_mass=(800.0, 800.0, 100.0, 500.0, 500.0, 3000.0))
    return Holonomic(name="floe", group=SE3, inertia=inertia, hull=hull, rig=Rig(path, "")), size[2]


def test_without_contact_things_pass(block):
    clip = thrown(block(), None, (0, 0, 0.5), (0, 0, 0, 0, 0, -5.0), 0.3, World(obstacles=[FLOOR]))
    assert clip.positions[-1, 2] < -1 and not clip.events


@pytest.mark.parametrize("inside", ["terrain", "floor", "other"])
def test_a_start_inside_something_is_refused(block, inside):
    """From a metre's depth it would be shot out at a thousand metres per second; two centimetres are tolerated."""
    ground = Terrain("flat", np.zeros((3, 3)), (-50, -50), (50, 50)) if inside == "terrain" else None
    world = World(ground, obstacles=[FLOOR] if inside == "floor" else [], contact=Contact())

    def start(height):
        return {
            "block": Mover(block(), None, State(position=(0, 0, height))),
            "other": Mover(block(), None, State(position=(0, 0, -0.2 if inside == "other" else 9.0))),
        }

    simulate_together(start(0.19), world, 1 / 60, step=1 / 60)
    with pytest.raises(InputError, match=rf"block: start: 0.0[45] m deep in {inside} at \(.*\) m; start elsewhere"):
        simulate_together(start(0.15), world, 1 / 60, step=1 / 60)


def test_damping_ratio_gives_the_restitution():
    """Bounce of the spring and damper, integrated finely."""
    for wanted in (0.1, 0.3, 0.7):
        zeta, depth, rate, h = damping_ratio(wanted), 0.0, 1.0, 1e-5
        while depth >= 0 and depth + 2 * zeta * rate >= 0:
            rate -= h * (depth + 2 * zeta * rate)
            depth += h * rate
        assert -rate == pytest.approx(wanted, rel=2e-3)


@pytest.mark.parametrize("wrong", [{"friction": -1.0}, {"restitution": 1.5}, {"speed": 0.0}, {"friction": "ice"}])
def test_invalid_contact_settings_are_reported(wrong):
    with pytest.raises(InputError, match=f"world.contact.{next(iter(wrong))}"):
        Contact(**wrong)


def test_a_vehicle_in_the_plane_is_refused_among_things_that_it_would_drive_through():
    car, wall = vehsim.load_vehicle("car"), box("wall", (12, 0, 0), (1, 8, 2))
    world = World(obstacles=[wall], contact=Contact())
    with pytest.raises(InputError, match=r"car moves in the plane, where contact does not act.* through wall; plan"):
        vehsim.simulate(car, world, duration=2.0)
    with pytest.raises(InputError, match=r"would drive through other, wall"):
        simulate_together({"car": Mover(car), "other": Mover(vehsim.load_vehicle("helicopter"))}, world, 0.5)
    assert len(vehsim.simulate(car, World(contact=Contact()), duration=0.5)) > 1
    assert len(vehsim.simulate(car, World(obstacles=[wall]), duration=0.5)) > 1


def test_the_other_end_of_a_hull_in_contact_lands_in_small_steps(tmp_path):
    """A plank that stands on one end falls over: its other end, which closes at 2 m/s, gains no energy."""
    long = tmp_path / "plank.usda"
    slab(long, (5.0, 0.6, 0.1))
    mass = 100.0
    inertia = [mass * 0.37 / 12, mass * 25.01 / 12, mass * 25.36 / 12, mass, mass, mass]
    plank = Holonomic(name="plank", group=SO3xR3, inertia=inertia, gravity=9.81, rig=Rig(long, ""))
    ground = Terrain("flat", np.zeros((5, 5)), (-40.0, -40.0), (20.0, 20.0))
    lean = 0.15
    start = State(position=(0, 0, 2.5 * np.sin(lean) + 0.06), orientation=(np.cos(lean / 2), 0, -np.sin(lean / 2), 0))
    clip = vehsim.simulate(plank, World(ground, contact=Contact(0.4, 0.3, 20.0)), None, start, duration=3.0)
    energy = clip.energy["kinetic"] + clip.energy["potential"]
    assert clip.twists[:, 1].max() > 0.6  # the other end closed at more than 3 m/s
    assert np.maximum.accumulate(energy[::-1])[::-1][60:].max() <= energy[0]
    ends = np.array([[x, y, -0.05] for x in (-2.5, 2.5) for y in (-0.3, 0.3)])
    lowest = min((ends @ m[:3, :3].T + m[:3, 3])[:, 2].min() for m in clip.matrices())
    assert lowest > -DEPTH
    assert clip.positions[:, 2].max() < start.position[2] + 0.01


def test_a_boat_that_rocks_on_its_keel_takes_steps_of_a_240th_of_a_second():
    """Neither its springs nor its dampers, those along the ground included, need shorter ones."""
    ground = Terrain("flat", np.zeros((5, 5)), (-40.0, -40.0), (20.0, 20.0))
    boat = vehsim.load_vehicle("boat")
    scene = ContactScene({"boat": boat}, World(ground, contact=Contact()), Contact())
    points = np.concatenate(collision_hulls(boat.rig.asset, boat.rig.root or None))
    for tilt in (-0.05, 0.0, 0.05):
        q = np.array([np.cos(tilt / 2), np.sin(tilt / 2), 0.02, 0])
        height = -from_body(q, points)[:, 2].min() - 5e-4
        scene.wrenches(0.0, [State(position=(0, 0, height), orientation=q, twist=(0.02, 0.05, 0, 0, 0, 0))])
        assert scene.settled == [False] and scene.next_step > 1 / 240
