"""The water's surface: waves that obey their laws, seas with their statistics, grids, and MuJoCo's height field."""

from dataclasses import replace

import numpy as np
import pytest
from hulls import box, floating

import vehsim
from vehsim.constants import GRAVITY
from vehsim.errors import InputError, SolveError
from vehsim.vehicles import State
from vehsim.world.water.buoyancy import Afloat
from vehsim.world.water.currents import Currents, Sampled, Stream, Vortex
from vehsim.world.water.grids import WaterGrids
from vehsim.world.water.height_field import WaterField
from vehsim.world.water.sea import sea_state, spectrum
from vehsim.world.water.water import Waves, wave
from vehsim.world.wind import Gusts
from vehsim.world.world import Water, World

SEAS = {
    "linear": wave(1.0, 15.0, 0.4, 0.3),
    "gerstner": wave(2.0, 20.0, -0.7, 0.2, choppiness=1.0),
    "about to break": wave(6.2, 20.0, 2.0, 0.2, choppiness=1.0),
    "choppy sea": sea_state(1.5, 6.0, seed=3, choppiness=0.4),
}


@pytest.fixture(params=SEAS.values(), ids=SEAS.keys())
def water(request):
    return Water(level=0.7, surface=request.param)


def places(n=200, seed=0, reach=300.0):
    return np.random.default_rng(seed).uniform(-reach, reach, (n, 2))


def test_the_surface_is_where_its_particles_are(water):
    """Gerstner's horizontal map and its inverse cancel, far from the origin and near breaking too."""
    s, t = water.surface, 7.3
    rest = places()
    theta = rest @ s.number.T - s.omega * t + s.phase
    k = np.linalg.norm(s.number, axis=1)
    moved = rest - (np.sin(theta) * s.choppiness * s.amplitude) @ (s.number / k[:, None])
    np.testing.assert_allclose(water.height(moved, t), 0.7 + np.cos(theta) @ s.amplitude, atol=1e-10)


@pytest.mark.parametrize("name", ["gerstner", "about to break"])
def test_water_does_not_leave_the_surface(name):
    """Kinematic condition: d eta/dt + u . grad eta = w, exactly for one Gerstner wave."""
    water = Water(level=0.7, surface=SEAS[name])
    xy, t, h = places(), 3.0, 1e-5
    rate = (water.height(xy, t + h) - water.height(xy, t - h)) / (2 * h)
    normal = water.normal(xy, t)
    slope = -normal[:, :2] / normal[:, 2:]
    v = water.velocity(np.column_stack([xy, water.height(xy, t)]), t)
    steep = np.abs(slope).max(axis=1) > 4  # where differences are meaningless
    np.testing.assert_allclose((rate + (v[:, :2] * slope).sum(axis=1) - v[:, 2])[~steep], 0, atol=2e-4)


def test_normals_are_those_of_the_heights(water):
    xy, h = places(), 1e-6
    slope = np.column_stack(
        [(water.height(xy + h * e, 2.0) - water.height(xy - h * e, 2.0)) / (2 * h) for e in np.eye(2)]
    )
    flat = np.abs(slope).max(axis=1) < 3
    normal = water.normal(xy, 2.0)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
    np.testing.assert_allclose((-normal[:, :2] / normal[:, 2:])[flat], slope[flat], atol=1e-4)


def test_waves_run_as_deep_water_says():
    """omega^2 = g k: a crest advances by a wavelength in a period, sqrt(2 pi L / g)."""
    length, heading = 12.0, 0.6
    water = Water(surface=wave(0.5, length, heading))
    period = np.sqrt(2 * np.pi * length / GRAVITY)
    along = np.array([np.cos(heading), np.sin(heading)])
    xy = places(50)
    np.testing.assert_allclose(
        water.height(xy + 0.25 * length * along, 0.25 * period), water.height(xy, 0.0), atol=1e-12
    )


def test_orbits_fade_with_depth():
    """Airy's velocity: irrotational, divergence-free, e-fold less at 1/k; the crest runs with the wave."""
    a, length = 0.01, 10.0
    k = 2 * np.pi / length
    water = Water(surface=wave(2 * a, length))
    crest = np.array([[0.0, 0.0, a], [0.0, 0.0, a - 1 / k]])
    speed = water.velocity(crest, 0.0)
    np.testing.assert_allclose(speed[0], [a * np.sqrt(GRAVITY * k), 0, 0], atol=1e-12)
    np.testing.assert_allclose(speed[1] / np.e**-1, speed[0], atol=1e-12)


def test_folded_and_broken_waves_are_refused():
    with pytest.raises(InputError, match="folds over"):
        wave(7.0, 20.0, choppiness=1.0)
    with pytest.raises(InputError, match="without length"):
        Waves(np.ones(1), np.zeros((1, 2)), np.zeros(1))
    with pytest.raises(InputError, match="not a wave"):
        wave(1.0, -3.0)
    with pytest.raises(InputError, match="choppiness"):
        wave(0.1, 10.0, choppiness=2.0)
    with pytest.raises(InputError, match=r"water\.height_field"):
        Water(height_field=-0.1)
    with pytest.raises(InputError, match="give a wider cell"):
        Afloat(vehsim.load_vehicle("boat"), World(water=Water(height_field=0.002))).field  # noqa: B018
    with pytest.raises(InputError, match="not a sea"):
        sea_state(-1.0)
    with pytest.raises(InputError, match="not water"):
        World(water="salty")


@pytest.mark.parametrize(("height", "period", "peakedness"), [(0.6, 4.0, 3.3), (3.0, 9.0, 1.0), (6.0, 12.0, 3.3)])
def test_a_sea_has_its_height_and_its_peak(height, period, peakedness):
    """4 sigma of the sampled surface within 2 %, the peak of its spectrum within a bin."""
    water = Water(surface=sea_state(height, period, seed=5, peakedness=peakedness))
    step, n = period / 20, 16384
    series = np.array([water.height(np.zeros((1, 2)), step * k)[0] for k in range(n)])
    assert 4 * series.std() == pytest.approx(height, rel=0.02)
    power = np.abs(np.fft.rfft(series * np.hanning(n))) ** 2
    f = np.fft.rfftfreq(n, step)
    width = 0.08 / period  # a bin
    bins = np.array([power[np.abs(f - (k + 0.5) * width) <= width / 2].sum() for k in range(60)])
    assert abs((np.argmax(bins) + 0.5) * width - 1 / period) <= 1.5 * width


def test_a_seed_determines_the_sea_and_directions_have_the_requested_spread():
    one, same, other = (sea_state(1.0, 5.0, seed=s, heading=0.5, spread=0.4, components=512) for s in (1, 1, 2))
    assert one.content_hash == same.content_hash != other.content_hash
    angle = np.arctan2(*one.number.T[::-1])
    assert np.mean(angle) == pytest.approx(0.5, abs=0.03)
    assert np.std(angle) == pytest.approx(0.4, rel=0.06)
    omega = np.linspace(0.8, 4.9, 20001)
    assert np.trapezoid(spectrum(omega, 1.0, 5.0), omega) == pytest.approx(1 / 16, rel=1e-3)


def test_currents():
    whirl = Vortex((1.0, 2.0), 2.0, 3.0)
    points = np.column_stack([1 + np.linspace(0, 9, 91), np.full(91, 2.0), np.zeros(91)])
    speed = whirl.velocity(points, 0.0)
    assert np.argmax(speed[:, 1]) == 30 and speed[30, 1] == pytest.approx(2.0, rel=1e-6)
    assert np.allclose(speed[:, [0, 2]], 0) and speed[0, 1] == 0
    shear = Water(current=Stream((1.0, 0.0, 0.0), depth=4.0))
    np.testing.assert_allclose(shear.velocity([[0, 0, 0], [0, 0, -1], [0, 0, -9]])[:, 0], [1, 0.75, 0])
    y, x = np.mgrid[0:3, 0:4].astype(float)
    grid = Sampled(np.stack([2 * x + y, x - 3 * y], axis=-1), origin=(10.0, 20.0), cell=(0.5, 2.0))
    found = Currents((grid, Stream((0, 0, 1.0)))).velocity(np.array([[10.8, 21.0, 0.0]]), 0.0)
    np.testing.assert_allclose(found, [[2 * 1.6 + 0.5, 1.6 - 1.5, 1.0]])


def test_gusts_have_their_strength():
    gusts, wind = Gusts(strength=0.2, period=3.0, seed=1), np.array([0.0, 8.0, 0.0])
    speed = np.array([gusts.at(wind, t) for t in np.arange(0, 4000, 0.7)])
    np.testing.assert_allclose(speed.mean(axis=0), wind, atol=0.05)
    assert speed[:, 1].std() == pytest.approx(1.6, rel=0.03) and speed[:, 0].std() == pytest.approx(1.2, rel=0.03)


def box_around(xy):
    """Lowest and highest x and y of points."""
    return xy.min(axis=0), xy.max(axis=0)


@pytest.mark.parametrize("centre", [(0.0, 0.0), (1234.5, -987.6)])
def test_mujocos_rays_find_the_same_surface(water, centre):
    """Rays on the height field compared with the formula: they differ at most by the curvature of a cell, at any
    time."""
    field = WaterField(water, cell=0.1, samples=161)
    sharp = 200 if water.curvature > 0.2 else 4  # the ratio of the crests' curvature to the mean: one is about to break
    for t in (0.0, 2.7):
        xy = np.asarray(centre) + places(200, reach=5.5)
        field.update(t, *box_around(xy))
        bend = water.curvature * field.cell[0] ** 2 / 8
        np.testing.assert_allclose(field.heights(xy), water.height(xy, t), rtol=0, atol=sharp * bend)


def test_rays_from_one_far_point_are_vertical(water):
    """One call for all rays, compared with a call for each vertical ray: MuJoCo 4.0 discards none of them."""
    import mujoco

    field, xy = WaterField(water, cell=0.25, samples=65), places(300, reach=7.0)
    field.update(1.3, *box_around(xy))
    down = np.array([0.0, 0.0, -1.0])
    for found, point in zip(field.heights(xy), xy, strict=True):
        fell = mujoco.mj_rayHfield(field.model, field.data, 0, np.array([*point, 50.0]), down, None)
        assert found == pytest.approx(50.0 - fell, abs=5e-4)


def test_the_fields_triangles_have_the_mean_height_of_the_surface():
    """Over all crests and troughs they are too low or too high by far less than the samples' own triangles, which miss
    by a twelfth of the second difference of the waves."""
    water = Water(surface=wave(1.0, 8.0, 0.4))
    field, xy = WaterField(water, cell=0.5, samples=65), places(20_000, reach=12.0)
    field.update(1.3, *box_around(xy))
    height = water.height(xy, 1.3)
    share = float(height @ (field.heights(xy) - height) / (height @ height))
    assert abs(share) < 0.1 * (2 * np.pi / 8 * 0.5) ** 2 / 12


@pytest.mark.parametrize("surface", [None, wave(0.5, 15.0), sea_state(1.0, choppiness=0.5)])
def test_dry_faces_are_not_asked_for(surface, monkeypatch):
    """The height field knows what is above it: fewer rays, and the same forces as with all of them."""
    asked, heights = [], WaterField.heights

    def counted(field, xy):
        asked.append(len(xy))
        return heights(field, xy)

    monkeypatch.setattr(WaterField, "heights", counted)
    points, faces = box(8.0, 2.5, 2.0)
    body = floating((points + np.array([0, 0, 0.5]), faces), 4000.0)
    afloat = Afloat(body, World(water=Water(surface=surface)))
    state = State(position=(3.0, 1.0, 0.2), orientation=(0.99, 0.1, 0.05, 0.0), twist=(0.1, 0.2, 0.1, 2.0, 0.0, 0.5))
    few = afloat.forces(0.3, state, np.zeros(0)).wrench
    monkeypatch.setattr(WaterField, "ceiling", lambda field, points: np.full(len(points), np.inf))
    every = Afloat(body, World(water=Water(surface=surface))).forces(0.3, state, np.zeros(0)).wrench
    np.testing.assert_allclose(few, every, rtol=1e-12, atol=1e-9 * np.abs(every).max())
    assert asked[0] < 0.8 * asked[1]


def test_a_grid_is_the_surface_at_its_samples(water):
    """Heights and rest positions, from sums shared by rows and columns, compared with each point by itself."""
    x, y = 300.0 + 0.3 * np.arange(23), -40.0 + 0.2 * np.arange(17)
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    heights, rest = water.grid(x, y, 3.1)
    steep = water.surface.choppiness == 1
    np.testing.assert_allclose(heights.ravel(), water.height(xy, 3.1), rtol=0, atol=2e-4 if steep else 1e-6)
    known = water.surface.rest(xy, 3.1)
    found = xy if rest is None else rest.reshape(-1, 2)
    np.testing.assert_allclose(found, known, rtol=0, atol=1e-3 if steep else 1e-5)


def test_the_flow_at_a_hull_equals_the_waters(water):
    """Queried with the height field's guess of the rest positions, and without."""
    points = np.column_stack([places(200, reach=4.0), np.linspace(-3.0, 1.0, 200)])
    height, flow, *_ = WaterField(water, cell=0.1, samples=161).at(points, 2.2)
    known, exact, *_ = water.at(points, 2.2)
    np.testing.assert_allclose(flow, exact, rtol=0, atol=2e-3 * np.abs(exact).max())
    np.testing.assert_allclose(height, known, rtol=0, atol=0.02)


def test_calm_water_is_exact_and_written_once():
    field, points = (
        WaterField(Water(0.7), cell=4.0, samples=9),
        np.column_stack([places(100, reach=7.0), np.zeros(100)]),
    )
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        update = WaterField.update
        patch.setattr(WaterField, "update", lambda self, *args: (calls.append(args), update(self, *args)))
        for t in range(5):
            np.testing.assert_allclose(field.at(points + 0.01 * t, float(t))[0], 0.7, rtol=0, atol=2e-10)
    assert len(calls) == 1


def test_a_boat_floats_equally_on_mujocos_height_field():
    """LIE's method: rays on a field in MuJoCo, which follows the boat far from its start and always contains it."""
    boat, waves = vehsim.load_vehicle("boat"), wave(0.4, 9.0, 0.4, choppiness=0.5)
    start = State(twist=[0, 0, 0, 8.0, 0, 0])
    updates = []
    update = WaterField.update

    def watched(self, t, low, high):
        update(self, t, low, high)
        updates.append((t, *self.low))
        assert (self.high - self.low).max() < 9

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WaterField, "update", watched)
        seen, known = (
            vehsim.simulate(boat, World(water=water), (3000.0, 0.0), start, duration=1.0, step=1 / 48)
            for water in (Water(0.3, waves), Water(0.3, waves, height_field=0))
        )
    assert 0 < np.abs(seen.positions - known.positions).max() < 2e-3
    assert np.ptp([x for _, x, _ in updates]) > 6 and updates[-1][0] == pytest.approx(1.0, abs=2e-3)


def test_a_shot_selects_the_height_field_with_one_key():
    """The same boat in the same swell, by rays and by the formula; an invalid cell is named."""

    def shot(**water):
        data = {
            "shot": {"schema": 1, "name": "swell"},
            "world": {"water": {"level": 0.2, "wave": [{"height": 0.4, "length": 9.0}], **water}},
            "vehicle": [{"name": "boat", "asset": "boat", "motion": {"method": "simulate", "duration": 0.5}}],
        }
        return vehsim.Shot.from_dict(data)

    known, *seen = (shot(**given).solve() for given in ({"height_field": 0}, {}, {"height_field": 0.2}))
    assert [take.world.water.height_field for take in (known, *seen)] == [0, None, 0.2]
    for take in seen:
        apart = np.abs(take.clips["boat"].positions - known.clips["boat"].positions).max()
        assert 0 < apart < 2e-3
    with pytest.raises(InputError, match=r"world\.water\.height_field"):
        shot(height_field=-0.1)


def test_mujoco_and_a_solvers_grid_agree_exactly():
    """Cells are split the same way, and are the same: only single precision is between them, to the very border."""
    random = np.random.default_rng(2)
    grids = WaterGrids([0.0, 1.0], random.uniform(-0.3, 0.3, (2, 13, 9)), None, (-6.3, -6.0), (1.5, 1.0))
    water = Water(0.2, grids)
    field = WaterField(water, cell=1.0, samples=17)
    points = np.column_stack([places(300, reach=1.0) * 5.99 + [-0.3, 0.0], np.zeros(300)])
    points[:2, :2] = grids.lower, grids.upper
    np.testing.assert_allclose(field.at(points, 0.25)[0], water.height(points[:, :2], 0.25), rtol=0, atol=5e-6)


def test_queries_outside_a_grid_are_refused():
    grids = WaterGrids([0.0, 1.0], np.zeros((2, 4, 4)), np.ones((2, 4, 4, 3)), (0.0, 0.0), (1.0, 1.0))
    water = Water(surface=grids)
    np.testing.assert_allclose(water.velocity([[1.5, 1.2, 0.0]], 0.5), 1)
    with pytest.raises(SolveError, match=r"outside the grid, \[0.0, 0.0\] to \[3.0, 3.0\]"):
        water.height([[1.0, 3.5]], 0.5)
    with pytest.raises(SolveError, match=r"queried at 2.000 s, but they cover 0.000 to 1.000 s"):
        water.height([[1.0, 1.0]], 2.0)
    field = WaterField(Water(), cell=0.5, samples=9)
    field.update(0.0, (10.0, 0.0), (11.0, 1.0))
    with pytest.raises(SolveError, match=r"outside its \[9.5, -0.5\] to \[11.5, 1.5\]"):
        field.heights([[0.0, 0.0]])
    with pytest.raises(SolveError, match="13 samples per side, at most 9 are possible"):
        field.update(0.0, (10.0, 0.0), (15.0, 1.0))


class Unfading(Waves):
    def at(self, points, level, t, guess=None):
        return super().at(points, level, t, guess)._replace(fade=np.zeros(len(points)))


def test_a_boat_rides_a_solvers_grids_over_all_frames():
    """Grids at every frame with oblong cells give the same motion as waves that do not fade with depth; beyond their
    border there is a clear error."""
    boat, waves = vehsim.load_vehicle("boat"), wave(0.4, 12.0, 0.3)
    waves = Unfading(waves.amplitude, waves.number, waves.phase)
    times, (low, cell) = np.arange(13) / 24, ((-9.0, -6.0), (0.25, 0.4))
    x, y = np.meshgrid(low[0] + cell[0] * np.arange(80), low[1] + cell[1] * np.arange(31))
    places = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, np.inf)])
    heights, flow, *_ = zip(*(waves.at(places, 0.0, t) for t in times), strict=True)
    shape = (len(times), *x.shape)
    water = Water(surface=WaterGrids(times, np.reshape(heights, shape), np.reshape(flow, (*shape, 3)), low, cell))
    start = State(twist=[0, 0, 0, 5.0, 0, 0])
    seen, known = (
        vehsim.simulate(boat, World(water=w), (2000.0, 0.0), start, duration=0.5) for w in (water, Water(surface=waves))
    )
    assert np.abs(seen.positions - known.positions).max() < 0.01
    for cell in (None, 0.0):
        with pytest.raises(SolveError, match=r"outside the grid, \[-9.0, -6.0\] to \[10.75, 6.0\]; enlarge it"):
            edge = State(position=(9.0, 0.0, 0.0))
            vehsim.simulate(boat, World(water=replace(water, height_field=cell)), None, edge, duration=0.1)


def test_a_shot_on_a_solvers_grid_has_its_water_to_the_horizon(tmp_path):
    """Inside the grid it has the grid's height; far beyond it is level."""
    from pxr import Usd, UsdGeom

    heights = np.full((3, 30, 40), 0.3)
    np.savez(tmp_path / "w.npz", times=np.arange(3) / 24, heights=heights, origin=(-10.0, -8.0), cell=(0.5, 0.6))
    motion = {"method": "simulate", "start": {"position": [0, 0, 0.3]}}
    data = {
        "shot": {"schema": 1, "name": "liquid", "end_frame": 1003},
        "world": {"water": {"level": 0.1, "grids": str(tmp_path / "w.npz")}},
        "vehicle": [{"name": "boat", "asset": "boat", "motion": motion}],
    }
    folder = vehsim.Shot.from_dict(data).solve().export(tmp_path / "out", to=("usd",))
    stage = Usd.Stage.Open(str(next(folder.rglob("water.usdc"))))
    (mesh,) = (UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    points = np.array(mesh.GetPointsAttr().Get(1001))
    far = np.abs(points[:, :2]).max(axis=1)
    assert far.max() > 1000 and np.abs(points[far > 100, 2] - 0.1).max() < 1e-3
    assert np.median(points[(far > 5) & (far < 7), 2]) == pytest.approx(0.4, abs=0.05)


def test_grids_are_read_and_invalid_ones_refused(tmp_path):
    path = tmp_path / "w.npz"
    np.savez(path, times=[0.0, 1.0], heights=np.zeros((2, 3, 3)), origin=(1.0, 2.0), cell=(0.5, 0.5))
    assert WaterGrids.load(path).upper.tolist() == [2.0, 3.0]
    np.savez(path, times=[0.0, 1.0], heights=np.full((2, 3, 3), np.nan), origin=(1.0, 2.0), cell=(0.5, 0.5))
    with pytest.raises(InputError, match=r"w.npz: world.water.grids.heights: not finite"):
        WaterGrids.load(path)
    np.savez(path, times=[0.0, 1.0])
    with pytest.raises(InputError, match="without heights, origin, cell"):
        WaterGrids.load(path)
    with pytest.raises(InputError, match="no such file"):
        WaterGrids.load(tmp_path / "none.npz")
