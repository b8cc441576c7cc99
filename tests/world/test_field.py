"""The distance field compared with MuJoCo's distances; its derivatives, borders and cache."""

from __future__ import annotations

import threading

import casadi
import igl
import mujoco
import numpy as np
import pytest

from vehsim.errors import InputError
from vehsim.world import Terrain, World, cache_folder
from vehsim.world.distance.field import NEAR, distance_field
from vehsim.world.distance.scene import add_terrain, write_heights


@pytest.fixture(scope="module")
def canyon():
    return World("canyon")


@pytest.fixture(scope="module")
def field(canyon):
    return canyon.distance_field()


def valley():
    x = np.arange(40.0)
    return Terrain("valley", np.tile(0.05 * (x - 20) ** 2, (30, 1)))


def test_the_field_agrees_with_mujoco(canyon, field):
    """Distances of a tiny sphere: 99 % within 0.35 m beyond 1 m from the rock, at 2 m spacing."""
    spec = mujoco.MjSpec()
    add_terrain(spec, canyon.terrain)
    body = spec.worldbody.add_body(name="ball")
    body.add_freejoint()
    radius = 1e-3
    body.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0])
    model = spec.compile()
    write_heights(model, canyon.terrain)
    data = mujoco.MjData(model)
    ball, ground = model.geom("ball").id, model.geom("terrain").id
    rng = np.random.default_rng(2)
    points = rng.uniform([-60, -40, 0], [230, 90, 65], (1500, 3))
    points = points[points[:, 2] > canyon.height(points[:, :2]) + 0.01]
    exact = np.empty(len(points))
    for k, point in enumerate(points):
        data.qpos[:3] = point
        mujoco.mj_kinematics(model, data)
        cap, answer = 100.0, 0.0
        while (answer := mujoco.mj_geomDistance(model, data, ball, ground, cap, None)) < cap - 1e-9:
            cap = answer
        exact[k] = cap + radius
    error = np.abs(field.value(points) - exact)[exact > 1]
    assert len(error) > 500
    assert np.percentile(error, 99) < 0.35
    assert error.max() < 0.8


def test_function_and_value_are_the_same_everywhere(field):
    points = np.random.default_rng(0).uniform(field.lower - 30, field.upper + 30, (500, 3))
    np.testing.assert_allclose(np.array(field.function.map(500)(points.T)).ravel(), field.value(points), atol=1e-9)


def test_the_spline_passes_through_the_grid(field):
    index = np.random.default_rng(1).integers(0, field.distances.shape, (300, 3))
    points = field.lower + field.spacing * index
    np.testing.assert_allclose(field.value(points), field.distances[tuple(index.T)], atol=1e-6)


def test_derivatives_are_those_of_the_values(field):
    point = casadi.MX.sym("p", 3)
    value = field.function(point)
    hessian, gradient = casadi.hessian(value, point)
    derivative = casadi.Function("d", [point], [gradient, hessian])
    rng = np.random.default_rng(3)
    for at in rng.uniform(field.lower + 5, field.upper - 5, (20, 3)):
        slope, curvature = (np.array(x) for x in derivative(at))
        step = 1e-4 * np.eye(3)
        expected = (field.value(at + step) - field.value(at - step)) / 2e-4
        np.testing.assert_allclose(slope.ravel(), expected, atol=1e-6)
        ahead, behind = (np.array([derivative(at + s * d)[0] for d in step]).reshape(3, 3) for s in (1, -1))
        np.testing.assert_allclose(curvature, (ahead - behind) / 2e-4, atol=1e-3)


def test_models_are_the_values_without_a_copy_of_the_table(field):
    """A copy at each call would take as long as the rest; other solvers than IPOPT differentiate the models."""
    points = np.random.default_rng(5).uniform(field.lower - 5, field.upper + 5, (40, 3))
    models = field.models(40)
    assert models is field.models(40)
    assert models.sz_w() < field._coefficients.size / 10
    found = np.array(models(points.T))
    np.testing.assert_allclose(found[0], field.value(points), atol=1e-9)
    place = casadi.MX.sym("p", 3, 40)
    slopes = casadi.Function("slopes", [place], [casadi.gradient(casadi.sum2(models(place)[0, :]), place)])
    np.testing.assert_allclose(np.array(slopes(points.T)), found[1:4], atol=1e-9)


def crags():
    rng = np.random.default_rng(4)
    x, y = np.meshgrid(np.arange(0, 61, 3.0), np.arange(0, 41, 3.0))
    return Terrain("crags", 25 * np.sin(x / 7) * np.cos(y / 5) + rng.uniform(0, 4, x.shape), (0.0, 0.0), (3.0, 3.0))


@pytest.mark.parametrize("box", [None, [[10, 8, 5], [30, 28, 60]]], ids=["whole", "part"])
def test_the_field_is_exact_near_the_ground_and_never_too_small_farther_away(box):
    """By libigl, at every grid point: exact within `NEAR`; beyond, too large by at most a few centimetres on
    average. What is nearest may be beyond the border of a box."""
    terrain = crags()
    field = distance_field(terrain, spacing=1.5, box=box)
    points = np.stack(np.meshgrid(*(field.lower[k] + 1.5 * np.arange(n) for k, n in enumerate(field.distances.shape)),
                                  indexing="ij"), axis=-1).reshape(-1, 3)  # fmt: skip
    true = np.sqrt(igl.point_mesh_squared_distance(points, terrain.vertices, terrain.faces)[0])
    above = points[:, 2] > terrain.height(points[:, :2])
    found = field.distances.ravel()
    assert (np.sign(found) == np.where(above, 1, -1)).all()
    near = true < np.where(above, NEAR[1], -NEAR[0]) - 0.5
    assert near.any() and not near.all()
    assert np.abs(np.abs(found) - true)[near].max() < 1e-4
    far = (np.abs(found) - true)[~near]
    assert far.min() > -1e-4 and far.mean() < 0.04 and far.max() < 0.75


def hills():
    x, y = np.meshgrid(np.arange(0, 301, 3.0), np.arange(0, 241, 3.0))
    return Terrain("hills", 15 * np.sin(x / 40) * np.cos(y / 30) + 4 * np.sin(x / 17 + y / 23), (0.0, 0.0), (3.0, 3.0))


@pytest.mark.parametrize(("terrain", "typical"), [(hills(), 1e-3), (crags(), 0.03)], ids=["hills", "crags"])
def test_a_quick_field_is_never_too_small_and_asks_for_few_nearest_points(monkeypatch, terrain, typical):
    """Compared with the exact field, which asks for nearest points at all grid points near the ground."""
    asked, nearest = [], type(terrain).nearest
    monkeypatch.setattr(type(terrain), "nearest", lambda own, at: asked.append(len(at)) or nearest(own, at))
    monkeypatch.setattr("vehsim.world.distance.field.kept", lambda kind, content, make, most: make())
    quick = distance_field(terrain, spacing=2.0, quick=True)
    few = sum(asked)
    exact = distance_field(terrain, spacing=2.0)
    assert few < 0.2 * (sum(asked) - few)
    assert (np.sign(quick.distances) == np.sign(exact.distances)).all()
    error, near = np.abs(quick.distances) - np.abs(exact.distances), (exact.distances > -4) & (exact.distances < 8)
    assert error[near].min() > -1e-4 and error[near].mean() < typical and error[near].max() < 1.0


@pytest.mark.parametrize("quick", [True, False], ids=["quick", "exact"])
@pytest.mark.parametrize("terrain", [hills(), crags()], ids=["hills", "crags"])
def test_a_part_of_a_field_is_a_part_of_the_same_grid(terrain, quick):
    """Its distances are those of the whole, except where two places of the rock are almost equally close, and at its
    sides, where the nearest one may be outside."""
    whole = distance_field(terrain, quick=quick)
    part = distance_field(terrain, box=[[11.3, 8.1, -100], [47.9, 39.2, 100]], quick=quick)
    assert part.spacing == whole.spacing and part.distances.size < 0.6 * whole.distances.size
    first = np.rint((part.lower - whole.lower) / whole.spacing).astype(int)
    there = whole.distances[tuple(slice(a, a + n) for a, n in zip(first, part.distances.shape, strict=True))]
    np.testing.assert_allclose(part.lower, whole.lower + whole.spacing * first)
    inner = int(np.ceil(8 / whole.spacing))
    own, same = (each[inner:-inner, inner:-inner] for each in (part.distances, there))
    near = np.abs(same) < 6
    error = np.abs(own - same)[near]
    assert len(error) > 1000 and np.quantile(error, 0.95) < 1e-4 and np.quantile(error, 0.99) < 0.1


@pytest.mark.parametrize("terrain", [hills(), crags()], ids=["hills", "crags"])
def test_along_a_path_the_field_is_exact_near_the_ground(terrain):
    path = np.array([[5.0, 5, 30], [30, 20, 28], [55, 35, 30]])
    field = World(terrain).distance_field_along(path, reach=10.0)
    axes = [field.lower[k] + field.spacing * np.arange(n) for k, n in enumerate(field.distances.shape)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    true = np.sqrt(igl.point_mesh_squared_distance(points, terrain.vertices, terrain.faces)[0])
    along = np.linspace(path[:-1, :2], path[1:, :2], 400).reshape(-1, 2)
    beside = np.sqrt(((points[:, None, :2] - along) ** 2).sum(axis=-1).min(axis=1))
    found = field.distances.ravel()
    near = (beside < 10 - field.spacing) & (found > NEAR[0]) & (found < NEAR[1])
    assert near.any() and not near.all()
    assert np.abs(np.abs(found) - true)[near].max() < 1e-4


def test_nothing_is_gained_by_leaving_through_sides_or_bottom(field):
    centre = 0.5 * (field.lower + field.upper)
    for axis, sign in ((0, -1), (0, 1), (1, -1), (1, 1), (2, -1)):
        border = centre.copy()
        border[axis] = field.upper[axis] if sign > 0 else field.lower[axis]
        outside = border[None] + sign * np.eye(3)[axis] * np.array([[0], [1], [10], [300]])
        assert (np.diff(field.value(outside)) < -0.9).all()


def test_above_the_box_the_value_is_a_safe_bound(canyon, field):
    top = np.array([[0, 0, field.upper[2]], [0, 0, field.upper[2] + 50]])
    value = field.value(top)
    assert value[1] == pytest.approx(value[0])


def test_the_sign_is_that_of_the_side(canyon, field):
    points = np.random.default_rng(4).uniform(field.lower, field.upper, (3000, 3))
    over = points[:, 2] - canyon.height(points[:, :2])
    value = field.value(points)
    # Near the surface the spline may be off by part of its spacing: only clear cases count.
    assert (value[(over > 0) & (np.abs(value) > 1)] > 0).all()
    assert (value[(over < 0) & (np.abs(value) > 1)] < 0).all()


def test_no_terrain_has_no_field():
    assert World().distance_field() is None


# ---------------------------------------------------------------- the cache


def test_a_field_comes_from_the_cache_bit_for_bit(monkeypatch):
    first = distance_field(valley())
    monkeypatch.setattr("vehsim.world.distance.field._measure", lambda *_: pytest.fail("measured again"))
    np.testing.assert_array_equal(distance_field(valley()).distances, first.distances)


def test_another_terrain_or_spacing_gives_another_field():
    before = set(cache_folder().iterdir())
    distance_field(valley(), spacing=1.5)
    distance_field(valley(), spacing=1.25)
    distance_field(valley(), spacing=1.25, box=[[5, 5, -10], [15, 15, 30]])
    heights = valley().heights.copy()
    heights[10, 10] += 1e-9
    distance_field(Terrain("other", heights), spacing=1.25)
    assert len(set(cache_folder().iterdir()) - before) == 4


@pytest.mark.parametrize("damage", [b"", b"nonsense", None])
def test_a_damaged_entry_is_measured_again_with_a_warning(tmp_path, monkeypatch, damage):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    first = distance_field(valley())
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-40] if damage is None else damage)
    with pytest.warns(UserWarning, match="damaged"):
        again = distance_field(valley())
    np.testing.assert_array_equal(again.distances, first.distances)
    np.testing.assert_array_equal(np.load(file), first.distances)


def test_an_entry_with_holes_is_damaged(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    first = distance_field(valley())
    (file,) = tmp_path.iterdir()
    with file.open("wb") as entry:
        np.save(entry, np.where(first.distances > 5, np.nan, first.distances))
    with pytest.warns(UserWarning, match="damaged"):
        np.testing.assert_array_equal(distance_field(valley()).distances, first.distances)


def test_writers_at_once_leave_one_whole_entry(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    results = []
    threads = [threading.Thread(target=lambda: results.append(distance_field(valley()))) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (file,) = tmp_path.iterdir()
    assert len(results) == 6
    for result in results:
        np.testing.assert_array_equal(result.distances, np.load(file))


def test_a_cache_that_cannot_be_written_is_no_failure(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path / "file" / "below"))
    with pytest.warns(UserWarning, match="could not be kept"):
        assert distance_field(valley()).value([[20, 15, 5]])[0] > 0


@pytest.mark.parametrize("wrong", [{"spacing": 0}, {"spacing": np.nan}, {"spacing": 1e-3}, {"box": [[0, 0], [1, 1]]}])
def test_wrong_fields_are_refused(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        distance_field(valley(), **wrong)


def test_progress_runs_to_one():
    shares = []
    distance_field(valley(), spacing=2.5, progress=lambda what, done: shares.append(done))
    assert shares == sorted(shares) and shares[-1] == 1
