"""Hulls in water compared with closed forms and with independently clipped tetrahedra."""

import numpy as np
import pytest
from hulls import box, floating, join, sphere
from scipy.spatial.transform import Rotation

import vehsim
from vehsim.constants import GRAVITY
from vehsim.errors import InputError
from vehsim.vehicles import State
from vehsim.world.water import hull_repair
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.hull_mesh import HullMesh, wetted
from vehsim.world.water.hull_repair import repaired
from vehsim.world.water.sea import sea_state
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World

RHO = 1025.0
UP = np.array([0.0, 0.0, 1.0])


def afloat(body, water=None, **world):
    return Afloat(body, World(water=water or Water(), **world))


def at(z=0.0, rotation=None, twist=None, xy=(0.0, 0.0)):
    quaternion = np.array([1.0, 0, 0, 0]) if rotation is None else rotation.as_quat(scalar_first=True)
    return State(position=np.array([*xy, z]), orientation=quaternion, twist=twist)


def clipped(points, faces, rotation, height):
    """Volume and centroid (world, about the body's origin) of a hull below z = -height, from signed tetrahedra.

    It shares nothing with the tested code: volumes are cut, not surfaces integrated.
    """
    world = rotation.apply(points)
    apex = np.array([*world[:, :2].mean(axis=0), -height])  # on the surface, so that its side is never in doubt
    volume, moment = 0.0, np.zeros(3)
    for face in faces:
        a, b, c = world[face]
        tets = [np.array([apex, a, b, c])]
        sign = np.linalg.det(np.array([a - apex, b - apex, c - apex]))
        if sign == 0:
            continue
        below = np.array([a, b, c])[:, 2] < -height

        def cross(p, q):
            s = (-height - p[2]) / (q[2] - p[2])
            return p + s * (q - p)

        corner = [a, b, c]
        if below.sum() == 0:
            continue
        if below.sum() == 1:
            k = int(np.flatnonzero(below)[0])
            p, q, r = corner[k], corner[(k + 1) % 3], corner[(k + 2) % 3]
            tets = [np.array([apex, p, cross(p, q), cross(p, r)])]
        elif below.sum() == 2:
            k = int(np.flatnonzero(~below)[0])
            p, q, r = corner[k], corner[(k + 1) % 3], corner[(k + 2) % 3]
            tets = [np.array([apex, cross(p, q), q, r]), np.array([apex, cross(p, q), r, cross(p, r)])]
        for t in tets:
            v = np.linalg.det(t[1:] - t[0]) / 6
            volume += v
            moment += v * t.mean(axis=0)
    return volume, moment / volume


def hull_of(name):
    if name == "boat":
        mesh = Afloat(vehsim.load_vehicle("boat"), World(water=0.0)).mesh
        return mesh.points, mesh.faces
    rough = np.random.default_rng(4)
    points, faces = sphere(1.0, 2)
    return {
        "potato": (points * rough.uniform(0.6, 1.4, (len(points), 1)) * [2.0, 1.0, 0.6], faces),
        "catamaran": join(box(4, 0.5, 0.8, (0, 1, 0)), box(4, 0.5, 0.8, (0, -1, 0))),
    }[name]


@pytest.mark.parametrize(("name", "poses"), [("boat", 100), ("potato", 100), ("catamaran", 300)])
def test_volume_and_centroid_of_many_poses(name, poses):
    """500 poses compared with cut tetrahedra: 1e-10 relative volume, 1e-9 m centroid.

    The wrench is that of Archimedes, with the level found by MuJoCo's rays.
    """
    points, faces = hull_of(name)
    body = floating((points, faces), 1000.0)
    float_ = afloat(body, Water(0.37))
    random = np.random.default_rng(7)
    for _ in range(poses):
        rotation, height = Rotation.random(random_state=random), random.uniform(-0.3, 0.3)
        wet = wetted(np.column_stack([points, -height - rotation.apply(points)[:, 2]]), np.asarray(faces))
        volume, centroid = clipped(points, faces, rotation, height)
        up = rotation.inv().apply(UP)
        assert wet.volume(up) == pytest.approx(volume, rel=1e-10)
        np.testing.assert_allclose(rotation.apply(wet.centroid(up)), centroid, atol=1e-9)
        found = float_.forces(0.0, at(height + 0.37, rotation, xy=random.uniform(-300, 300, 2)), np.zeros(0))
        wrench, lift = found.wrench, RHO * GRAVITY * volume
        assert found.volume == pytest.approx(volume, rel=1e-10)
        np.testing.assert_allclose(rotation.apply(wrench[3:]), [0, 0, lift], atol=1e-9 * lift)
        np.testing.assert_allclose(rotation.apply(wrench[:3]), np.cross(centroid, [0, 0, lift]), atol=1e-8 * lift)


def test_closed_forms():
    """A half-sunk ball, a barge and a catamaran: volume, centre of buoyancy, righting moment."""
    ball = afloat(floating(sphere(1.0, 5), 2 / 3 * np.pi * RHO)).forces(0.0, at(), np.zeros(0))
    assert ball.volume == pytest.approx(2 / 3 * np.pi, rel=2e-3)
    barge, heel, draft, beam = box(10, 4, 2), 0.1, 0.5, 4.0
    found = afloat(floating(barge, 10 * 4 * draft * RHO)).forces(
        0.0, at(1 - draft, Rotation.from_rotvec([heel, 0, 0])), np.zeros(0)
    )
    # wall-sided: GZ = sin(heel) (GM + BM tan^2(heel) / 2), about the centre of mass in the middle of the box
    bm = beam**2 / 12 / draft
    gm = draft / 2 + bm - 1.0
    depth = 1 - (1 - draft) / np.cos(heel)  # immersed at this height, along the body's own Z
    bm, gm = beam**2 / 12 / depth, depth / 2 + beam**2 / 12 / depth - 1.0
    gz = np.sin(heel) * (gm + bm * np.tan(heel) ** 2 / 2)
    assert found.wrench[0] == pytest.approx(-RHO * GRAVITY * 40 * depth * gz, rel=1e-9)
    cat = join(box(10, 1, 2, (0, 3, 0)), box(10, 1, 2, (0, -3, 0)))
    found = afloat(floating(cat, 20 * 0.5 * RHO)).forces(0.0, at(0.5, Rotation.from_rotvec([1e-5, 0, 0])), np.zeros(0))
    stiffness = RHO * GRAVITY * (2 * 10 * (1 / 12 + 9) + 20 * 0.5 * -0.75)  # rho g (I + V (zB - zG))
    assert -found.wrench[0] / 1e-5 == pytest.approx(stiffness, rel=1e-6)


def test_draft_by_archimedes():
    """Released slightly off, a damped barge comes to rest where it displaces its weight."""
    mass = 10 * 4 * 0.6 * RHO
    barge = floating(box(10, 4, 2), mass, (4e4, 2.4e5, 2.8e5), damping=(2e4, 2e4, 1.5e5))
    clip = vehsim.simulate(barge, World(water=0.3), start=at(0.3 + 0.4 + 0.1), duration=12.0, step=1 / 48)
    assert clip.positions[-1, 2] == pytest.approx(0.3 + 1 - 0.6, abs=1e-4)
    np.testing.assert_allclose(clip.orientations[-1], [1, 0, 0, 0], atol=1e-9)


def period_of(values, times):
    crossings = np.flatnonzero((values[:-1] < 0) & (values[1:] >= 0))
    at_zero = times[crossings] - values[crossings] * np.diff(times)[crossings] / np.diff(values)[crossings]
    return float(np.mean(np.diff(at_zero)))


@pytest.mark.parametrize("added", [0.0, 0.8])
def test_heave_roll_and_pitch_periods(added):
    """T = 2 pi sqrt((I + added) / stiffness) within 3 % (it comes out within 0.5 %)."""
    length, width, draft, height = 10.0, 4.0, 0.5, 1.2
    mass = length * width * draft * RHO
    inertia = mass / 12 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    extra = added * np.array([*inertia, mass, mass, mass])
    body = floating(box(length, width, height), mass, inertia, added_mass=extra)
    rest = height / 2 - draft
    below = -(height / 2 - draft / 2)  # centre of buoyancy under the centre of mass
    stiff = {
        "heave": RHO * GRAVITY * length * width,
        "roll": RHO * GRAVITY * (length * width**3 / 12 + length * width * draft * below),
        "pitch": RHO * GRAVITY * (width * length**3 / 12 + length * width * draft * below),
    }
    starts = {
        "heave": at(rest - 0.01),
        "roll": at(rest, Rotation.from_rotvec([-0.01, 0, 0])),
        "pitch": at(rest, Rotation.from_rotvec([0, -0.004, 0])),
    }
    for name, moved in (("heave", mass + extra[3]), ("roll", inertia[0] + extra[0]), ("pitch", inertia[1] + extra[1])):
        clip = vehsim.simulate(body, World(water=0.0), start=starts[name], duration=4.0, step=1 / 120, fps=120)
        angles = Rotation.from_quat(clip.orientations, scalar_first=True).as_rotvec()
        values = {"heave": clip.positions[:, 2] - rest, "roll": angles[:, 0], "pitch": angles[:, 1]}[name]
        assert period_of(values, clip.times) == pytest.approx(2 * np.pi * np.sqrt(moved / stiff[name]), rel=5e-3), name


def test_energy_never_grows_in_still_water():
    """Kinetic, including the added mass, plus gravity's, plus the work to push the hull down: it decreases or is
    constant."""
    length, width, height, mass = 2.0, 1.0, 0.5, 400.0
    inertia = mass / 12 * np.array([width**2 + height**2, length**2 + height**2, length**2 + width**2])
    extra = 0.3 * np.array([*inertia, mass, mass, mass])
    kept = {}
    for name, data in {
        "free": {},
        "damped": {"damping": (50.0, 200.0, 400.0), "impact": 1.0, "planing": 0.3, "added_mass": extra},
    }.items():
        body = floating(box(length, width, height), mass, inertia, **data)
        float_ = afloat(body)
        start = at(0.25, Rotation.from_rotvec([0.4, 0.2, 0.1]), twist=np.array([0.5, -0.3, 0.2, 0.4, 0.2, 0.0]))
        clip = vehsim.simulate(body, World(water=0.0), start=start, duration=3.0, step=1 / 240, fps=240)
        energy = clip.energy["kinetic"] + clip.energy["potential"]
        for k in range(len(clip.times)):
            rotation = Rotation.from_quat(clip.orientations[k], scalar_first=True)
            mesh, z = float_.mesh, clip.positions[k, 2]
            wet = wetted(np.column_stack([mesh.points, -z - rotation.apply(mesh.points)[:, 2]]), mesh.faces)
            volume = wet.volume(rotation.inv().apply(UP)) if len(wet.normals) else 0.0
            if volume > 0:
                depth = -(rotation.apply(wet.centroid(rotation.inv().apply(UP)))[2] + z)
                energy[k] += RHO * GRAVITY * volume * depth
            if "added_mass" in data:
                immersion = min(1.0, volume * RHO / mass)
                energy[k] += 0.5 * immersion * extra @ clip.twists[k] ** 2
        kept[name] = energy - energy[0]
        scale = mass * GRAVITY * 0.1
        assert np.diff(kept[name]).max() < 2e-3 * scale, name
        assert kept[name].max() < 2e-3 * scale, name
    assert abs(kept["free"][-1]) < 2e-3 * scale  # nothing takes energy, so none is lost
    assert kept["damped"][-1] < -0.3 * scale


def test_terminal_speed():
    """Thrust = (damping + quadratic v) v, on the shipped boat's own law and on a ball that sinks."""
    ball = floating(
        sphere(0.5, 3), 700.0, (70.0, 70.0, 70.0), damping=(0, 0, 100.0), quadratic=(0, 0, 300.0), reference_area=1.0
    )
    float_ = afloat(ball)
    area, volume = (
        float(
            np.linalg.norm(
                wetted(
                    np.column_stack([float_.mesh.points, np.ones(len(float_.mesh.points))]), float_.mesh.faces
                ).normals,
                axis=1,
            ).sum()
        ),
        float_.mesh.volume,
    )
    clip = vehsim.simulate(ball, World(water=0.0), start=at(-3.0), duration=6.0, step=1 / 48)
    weight = (700.0 - RHO * volume) * GRAVITY
    speed = (-100 + np.sqrt(100**2 + 4 * 300 * weight / area)) / (2 * 300)
    assert clip.twists[-1, 5] == pytest.approx(-speed, rel=1e-3)


def test_lie_16_has_its_totals_and_its_lift():
    """A submerged ball has the drag -E v for any tessellation; P lifts a half-sunk one by P/2."""
    for splits in (2, 4):
        points, faces = sphere(1.0, splits)
        body = floating((points, faces), 1000.0, damping=(10.0, 20.0, 30.0), reference_area=4 * np.pi)
        deep = afloat(body)
        twist = np.array([0.0, 0.0, 0.0, 1.0, -2.0, 0.5])
        drag = (
            deep.forces(0.0, at(-5.0, twist=twist), np.zeros(0)).wrench - deep.forces(0.0, at(-5.0), np.zeros(0)).wrench
        )
        np.testing.assert_allclose(drag[3:], [-10, 40, -15], rtol=0.2 / splits**2)
    body = floating(sphere(1.0, 5), 2 / 3 * np.pi * RHO, normal_force=500.0, reference_area=2 * np.pi)
    plain = floating(sphere(1.0, 5), 2 / 3 * np.pi * RHO)
    lift = afloat(body).forces(0.0, at(), np.zeros(0)).wrench - afloat(plain).forces(0.0, at(), np.zeros(0)).wrench
    np.testing.assert_allclose(lift[3:], [0, 0, 250.0], atol=1.0)


def test_turning_to_port_and_to_starboard_are_alike():
    """A catamaran of 24 triangles, with asymmetric diagonals, behaves the same in either direction."""
    hull = join(box(10, 0.9, 1.6, (0, 2.3, 0)), box(10, 0.9, 1.6, (0, -2.3, 0)))
    cat = afloat(floating(hull, 9e3, quadratic=(200.0, 3000.0, 0.0), damping=(400.0, 3000.0, 14e3), impact=1.0))
    port, starboard = (
        cat.forces(0.0, at(0.2, twist=np.array([0, 0, s * 0.4, 3.0, s * 0.5, 0.0])), np.zeros(0)).wrench
        for s in (1, -1)
    )
    np.testing.assert_allclose(port[[3, 4, 5, 2]], starboard[[3, 4, 5, 2]] * [1, -1, 1, -1], rtol=2e-3)


def test_a_planing_bottom_lifts_with_its_angle():
    """P rho U v_n A / 2 on a plate at a small angle to its path: twice the angle gives twice the lift, and it
    brakes."""
    speed, share = 9.0, 0.3
    plate = box(4.0, 2.0, 0.1)
    lifts = []
    for angle in (0.02, 0.04):
        twist = np.array([0, 0, 0, speed * np.cos(angle), 0, -speed * np.sin(angle)])
        with_lift, without = (
            afloat(floating(plate, 500.0, planing=planing)).forces(0.0, at(-1.0, twist=twist), np.zeros(0)).wrench
            for planing in (share, 0.0)
        )
        force = (with_lift - without)[3:]
        lifts.append(force[2])
        assert force[2] == pytest.approx(share * RHO * speed**2 * np.sin(angle) * 8.0 / 2, rel=1e-9)
        assert force @ twist[3:] < 0
    assert lifts[1] / lifts[0] == pytest.approx(2.0, rel=1e-3)


def test_waves_push_and_surf():
    """On a long slope the pressure pulls downhill with weight times slope, a little less because waves fade with
    depth."""
    body = floating(box(1, 1, 1), 500.0, (80.0, 80.0, 80.0))
    water = Water(surface=wave(1.0, 100.0))
    quarter = 25.0  # halfway down behind the crest
    height = water.height([[quarter, 0.0]])[0]
    forces = afloat(body, water).forces(0.0, at(height, xy=(quarter, 0.0)), np.zeros(0))
    k, draft = 2 * np.pi / 100, 0.5
    slope, fading = -0.5 * k, -np.expm1(-k * draft) / (k * draft)
    assert forces.wrench[3] == pytest.approx(-RHO * GRAVITY * forces.volume * slope * fading, rel=1e-3)


SURFACES = {
    "swell": wave(3.0, 60.0, 0.3),
    "steep": wave(4.0, 20.0, 1.1),
    "sharp crests": wave(4.0, 30.0, 0.3, choppiness=0.7),
    "short": wave(0.5, 8.0, 0.3, choppiness=0.3),
    "chop": sea_state(0.3, 2.5, seed=5),
    "sea": sea_state(2.0, 7.0, seed=5, choppiness=0.3),
}
ROUND = sphere(1.0, 3)
HULLS = {
    "sphere": ((ROUND[0] * 1.5, ROUND[1]), 7.2e3),
    "tug": ((ROUND[0] * [9.0, 3.1, 2.3], ROUND[1]), 130e3),
    "barge": (box(30, 12, 3), 480e3),
    "catamaran": (join(box(10, 0.9, 1.6, (0, 2.3, 0)), box(10, 0.9, 1.6, (0, -2.3, 0))), 9e3),
}


@pytest.mark.parametrize("surface", SURFACES)
@pytest.mark.parametrize("name", [*HULLS, "boat"])
def test_waves_against_a_fine_hull(name, surface):
    """Volume, force and its point of action, compared with hundreds of times as many linear triangles.

    Tolerances: 0.35 %, and 0.5 % of length. Over 3942 poses of foreign hulls the error was within 0.27 %.
    """
    from scipy.optimize import brentq

    water, random = Water(surface=SURFACES[surface]), np.random.default_rng(1)
    body = vehsim.load_vehicle("boat") if name == "boat" else floating(*HULLS[name])
    calm = afloat(body)
    float_ = afloat(floating((calm.mesh.points, calm.mesh.faces), calm.mass), water)
    size = np.ptp(float_.mesh.points, axis=0)
    fine = float_.mesh.refined(np.sqrt(2 * (size[0] * size[1] + size[0] * size[2] + size[1] * size[2]) / 6000))
    for k in range(2):
        t, xy, height = 0.7 * k, random.uniform(-20, 20, 2), float(size[2])
        turn = Rotation.from_euler("ZYX", random.normal(size=3) * [2, 0.03, 0.06])

        def state(z, turn=turn, xy=xy):
            return at(z, turn, xy=xy)

        def excess(z, t=t, state=state):
            return float_.forces(t, state(z), np.zeros(0)).volume - float_.rest_volume

        middle = float(water.height(xy[None], t)[0])
        z = brentq(excess, middle - 3 * height, middle + 3 * height, xtol=1e-3)
        found = float_.forces(t, state(z), np.zeros(0))
        places = turn.apply(fine.points) + np.array([*xy, z])
        motion = water.at(places, t)
        depth = motion.height - places[:, 2]
        wet = wetted(np.column_stack([fine.points, depth, depth - motion.fade]), fine.faces)
        push = -RHO * GRAVITY / 3 * wet.middles[:, :, 4, None] * wet.normals[:, None]
        force, torque = push.sum(axis=(0, 1)), np.cross(wet.middles[:, :, :3], push).sum(axis=(0, 1))
        lift = np.linalg.norm(force)
        assert found.volume == pytest.approx(wet.volume(turn.inv().apply(UP)), rel=3.5e-3)
        assert np.linalg.norm(found.wrench[3:] - force) < 3.5e-3 * lift
        assert np.linalg.norm(found.wrench[:3] - torque) < 5e-3 * lift * size.max()


@pytest.mark.parametrize(
    ("surface", "most"),
    [(wave(0.5, 8.0, 0.3), 2000), (sea_state(0.3, 2.5, seed=5), 8000), (sea_state(2.0, 7.0, seed=5), 2000)],
    ids=["wave", "chop", "sea"],
)
def test_foreign_hulls_are_refined_as_waves_require(surface, most):
    """A barge with a moon pool and a catamaran: within 0.5 % of finer ones, closed, and with few faces even in a
    chop."""
    import trimesh

    ring = trimesh.creation.annulus(2.0, 6.0, 3.0)
    barge = np.array(ring.vertices) * [2.0, 1.0, 1.0], np.array(ring.faces)
    cat = join(box(10, 0.9, 1.6, (0, 2.3, 0)), box(10, 0.9, 1.6, (0, -2.3, 0)))
    for hull, mass in ((barge, 300e3), (cat, 9e3)):
        ours, fine = (afloat(floating(hull, mass), Water(surface=surface)) for _ in range(2))
        mesh = ours.mesh
        assert mesh.volume == pytest.approx(HullMesh(*hull).volume, rel=1e-10) and len(mesh.faces) < most
        edges = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, 1, axis=1)], axis=2).reshape(-1, 2), axis=1)
        assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
        longest = np.linalg.norm(np.diff(mesh.points[edges], axis=1), axis=2).max()
        fine.mesh = mesh.refined(longest / 2.1)
        random = np.random.default_rng(3)
        for k in range(3):
            turn = Rotation.from_euler("ZYX", random.normal(size=3) * [2, 0.03, 0.05])
            state = at(ours.floating()[0] + random.uniform(-0.1, 0.1), turn, xy=random.uniform(-20, 20, 2))
            a, b = (x.forces(0.7 * k, state, np.zeros(0)) for x in (ours, fine))
            assert a.volume == pytest.approx(b.volume, rel=5e-3)
            assert np.linalg.norm(a.wrench[3:] - b.wrench[3:]) < 5e-3 * np.linalg.norm(b.wrench[3:])


def righting(body, heel):
    """Moment about the body's X at a heel, at the height where it displaces its weight."""
    from scipy.optimize import brentq

    float_, turn = afloat(body), Rotation.from_rotvec([heel, 0, 0])
    z = brentq(lambda z: float_.forces(0.0, at(z, turn), np.zeros(0)).volume - float_.rest_volume, -3, 3)
    return z, float_.forces(0.0, at(z, turn), np.zeros(0)).wrench[0]


@pytest.mark.parametrize(("width", "ballast"), [(1.6, 0.0), (1.2, -0.45)])
def test_a_capsized_hull_rights_itself_as_its_gz_curve_says(width, ballast):
    """Released almost upside down: with low ballast its righting arm brings it back, otherwise it stays."""
    mass, size = 1500.0, (4.0, width, 1.2)
    hull = box(*size, at=(0, 0, -ballast))
    inertia = (
        mass / 12 * np.array([size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2])
    )
    body = floating(hull, mass, inertia, damping=(500.0, 1500.0, 6000.0))
    heel = np.pi - 0.3
    height, moment = righting(body, heel)
    clip = vehsim.simulate(
        body, World(water=0.0), start=at(height, Rotation.from_rotvec([heel, 0, 0])), duration=12.0, step=1 / 24
    )
    up = Rotation.from_quat(clip.orientations[-1], scalar_first=True).as_matrix()[2, 2]
    assert (up > 0.99) == (moment < 0) == (ballast < 0)
    assert ballast < 0 or up < -0.99


def test_added_mass_counts_in_water_alone():
    """In the air a dropped hull falls with g; submerged it resists like mass plus added mass."""
    body = floating(box(1, 1, 1), 1025.0, (100.0, 100.0, 100.0), added_mass=(0, 0, 0, 500.0, 500.0, 500.0))
    clip = vehsim.simulate(body, World(water=0.0), start=at(9.0), duration=1.0)
    np.testing.assert_allclose(clip.positions[-1, 2], 9 - GRAVITY / 2, atol=1e-9)
    pushed = floating(box(1, 1, 1), 1025.0, (100.0, 100.0, 100.0), added_mass=(0, 0, 0, 500.0, 500.0, 500.0))
    clip = vehsim.simulate(pushed, World(water=Water(density=2050.0)), start=at(-3.0), duration=0.1)
    np.testing.assert_allclose(clip.twists[-1, 5], 0.1 * GRAVITY * 1025 / 1525, rtol=1e-9)


BROKEN = {
    "empty": (lambda p, f: (p, f[:0]), "empty"),
    "open": (lambda p, f: (p, f[1:]), r"open: 3 edges without a neighbour"),
    "a face turned": (lambda p, f: (p, np.vstack([f[1:], f[:1, ::-1]])), "open"),
    "inside out": (lambda p, f: (p, f[:, ::-1]), "inside out"),
    "in a hull": (lambda p, f: join((p, f), (0.5 * p, f)), "a hull inside a hull"),
    "with a cavity": (lambda p, f: join((p, f), (0.5 * p, f[:, ::-1])), "a cavity in it"),
    "flat": (lambda p, f: (p * [1, 1, 0], f), "no volume|more than two|open"),
    "nan": (lambda p, f: (np.where(p == p.max(), np.nan, p), f), "not finite"),
    "through itself": (lambda p, f: join((p, f), (0.7 * p + [0.5, 0.11, 0.07], f)), "intersects itself at"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_invalid_hulls_are_refused(name):
    break_it, message = BROKEN[name]
    points, faces = break_it(*box(2.0, 1.0, 0.5))
    with pytest.raises(InputError, match=message):
        HullMesh(points, faces, "boat.usda: hull")


def test_a_cockpit_is_closed_at_the_gunwale():
    """An open boat with walls of 4 cm and a raised stern: it floats by its outer volume, up to its lowest rim."""
    import trimesh

    outside, inside, notch = (trimesh.creation.box(size) for size in ((6, 2, 1), (5.92, 1.92, 1), (1, 9, 0.4)))
    inside.apply_translation([0, 0, 0.04])
    notch.apply_translation([2, 0, 0.4])  # the lowest rim is 0.2 m above the middle
    shell = trimesh.boolean.difference([outside, inside, notch])
    with pytest.warns(UserWarning, match="an open hull: the space of 7.5 m.3 below its rim, 0.2 m high"):
        boat = afloat(floating((np.array(shell.vertices), np.array(shell.faces)), 1000.0))
        height = boat.floating()[0]
    assert 0.5 - height == pytest.approx(1000 / RHO / 12, rel=1e-6)
    walls = 0.3 * (6 * 2 - 5.92 * 1.92 - 2 * 0.04)
    assert boat.hull.volume == pytest.approx(6 * 2 * 0.7 + walls, rel=0.01)


def test_cockpits_are_closed_beside_a_moon_pool():
    """A passage is a hole of the hull's sections too, but holds no water."""
    import trimesh

    barge, pool, *cockpits = (trimesh.creation.box(size) for size in ((9, 3, 1), (1, 1, 3), (2, 2, 1), (1, 2, 1)))
    for cockpit, x, z in zip(cockpits, (-2.5, 3.0), (0.2, 0.4), strict=True):
        cockpit.apply_translation([x, 0, z])
    notch = trimesh.creation.box((0.4, 9, 0.4))
    notch.apply_translation([3, 0, 0.5])  # the rim of the second cockpit is 0.3 m above the middle
    shell = trimesh.boolean.difference([barge, pool, *cockpits, notch])
    with pytest.warns(UserWarning, match="an open hull: the space of 4 m.3 below its rim, 0.3 m high"):
        hull = hull_repair.filled(HullMesh(np.array(shell.vertices), np.array(shell.faces)))
    assert hull.volume == pytest.approx(9 * 3 - 1 - 0.4 * 3 * 0.2 - 0.6 * 2 * 0.2, rel=1e-3)


def test_large_meshes_are_repaired_with_few_operations(monkeypatch):
    """Once a dinghy of 100,000 faces was cut with 33 boxes, and its edges were collapsed one by one: 2 s, 0.3 s now."""
    points, faces = sphere(1.0, 6)
    below, thinner = [], []
    spaces, simplified = hull_repair._Spaces.below, HullMesh.simplified
    monkeypatch.setattr(hull_repair._Spaces, "below", lambda *given: (below.append(0), spaces(*given))[1])
    monkeypatch.setattr(
        HullMesh, "simplified", lambda hull, n: (thinner.append(len(hull.faces)), simplified(hull, n))[1]
    )
    bowl = np.where(points[:, 2:] > 0, points * [2.8, 0.9, -0.85], points * [3.0, 1.0, 1.0])  # its upper half within
    dinghy = HullMesh(bowl, faces)
    with pytest.warns(UserWarning, match="open hull|simplified to 2,000"):
        repaired(dinghy)
    assert len(below) <= 2 and max(thinner) < 40_000


def test_a_hull_in_other_units_than_its_mass_is_warned_of():
    points, faces = box(6.0, 2.0, 1.0)
    with pytest.warns(UserWarning, match="displaces 2.93 of its 1.2e.10 m.3 and hardly touches .* metersPerUnit"):
        Afloat(floating((1000 * points, faces), 3000.0), World(water=0.0)).floating()


def test_a_large_mesh_is_simplified():
    fine = sphere(1.0, 6)
    points = fine[0] * [9.0, 3.0, 2.0]
    with pytest.warns(UserWarning, match=r"81,920 faces, simplified to 2,000: displaced volume within"):
        light = afloat(floating((points, fine[1]), 60e3))
        height = light.floating()[0]
    assert len(light.hull.faces) <= 2000 and light.hull.volume == pytest.approx(
        HullMesh(points, fine[1]).volume, rel=1e-9
    )
    volume = 60e3 / RHO  # that of the lower cap of an ellipsoid
    z = np.roots([-1 / 12, 0, 1, 4 / 3 - volume / (np.pi * 27)])
    exact = float(next(r.real for r in z if abs(r.imag) < 1e-9 and abs(r) <= 2))
    assert -height == pytest.approx(exact, abs=0.004)


def test_a_repaired_hull_is_cached_with_its_warnings(tmp_path, monkeypatch):
    """A hull of 100,000 faces was repaired twice in every simulation, 2.2 s each."""
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    hull = HullMesh(*sphere(1.0, 5), "ship: hull")
    with pytest.warns(UserWarning, match="^ship: hull: 20,480 faces, simplified"):
        first = repaired(hull)
    monkeypatch.setattr(hull_repair, "filled", None)  # not made again
    with pytest.warns(UserWarning, match="^other: 20,480 faces, simplified"):
        second = repaired(HullMesh(*sphere(1.0, 5), "other"))
    assert second.name == "other" and len(second.faces) <= 2000
    assert np.array_equal(first.points, second.points) and np.array_equal(first.faces, second.faces)


def test_a_boat_that_sinks_is_reported():
    with pytest.raises(InputError, match=r"displaces at most 1 m\^3, and needs 1.951 m\^3 to float"):
        afloat(floating(box(1, 1, 1), 2000.0)).floating()
    with pytest.raises(InputError, match="displaces at most 1 m"):
        vehsim.simulate(floating(box(1, 1, 1), 2000.0), World(water=0.0), duration=0.1)


def test_split_corners_are_welded():
    """A flat-shaded mesh has separate corners for every face: it is still one closed hull."""
    points, faces = box(2.0, 1.0, 0.5)
    mesh = HullMesh(points[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    assert len(mesh.points) == 8 and mesh.volume == pytest.approx(1.0)


def test_moving_water_drags_its_mass_along():
    """Added mass resists the acceleration through the water: a fixed body in a wave is pushed by A du/dt."""
    extra, a, length, t = 300.0, 0.003, 20.0, 0.8
    hull, mass = box(0.5, 0.5, 0.5), 100.0
    water = Water(surface=wave(2 * a, length))
    k = 2 * np.pi / length
    omega, z = np.sqrt(GRAVITY * k), -2.0
    state, still = at(z), np.zeros(0)
    plain = afloat(floating(hull, mass), water).forces(t, state, still)
    heavy = afloat(floating(hull, mass, added_mass=(0, 0, 0, extra, extra, extra)), water).forces(t, state, still)
    height = water.height([[0.0, 0.0]], t)[0]
    size = a * omega**2 * np.exp(k * (z - height))
    wanted = extra * size * np.array([np.sin(-omega * t), 0.0, -np.cos(-omega * t)])
    found = (heavy.wrench - plain.wrench)[3:]
    np.testing.assert_allclose(found, wanted, atol=0.06 * extra * size)  # over the hull, and not at its centre
