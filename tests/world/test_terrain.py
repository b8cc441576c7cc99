"""Terrains: the surface, the files from which it is read, and the promises of shipped terrains."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import trimesh
from PIL import Image, TiffImagePlugin

from vehsim.errors import InputError
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

RNG = np.random.default_rng(5)


def hills(rows=9, cols=13):
    return Terrain("hills", RNG.uniform(0, 4, (rows, cols)), origin=(-3.0, 2.0), cell=(0.5, 0.8))


# ---------------------------------------------------------------- the surface


def test_height_is_the_height_of_the_triangles():
    terrain = hills()
    mesh = trimesh.Trimesh(terrain.vertices, terrain.faces, process=False)
    samples, _ = trimesh.sample.sample_surface(mesh, 2000, seed=1)
    np.testing.assert_allclose(terrain.height(samples[:, :2]), samples[:, 2], atol=1e-9)
    np.testing.assert_allclose(terrain.height(terrain.vertices[:, :2]), terrain.vertices[:, 2], atol=1e-12)


def test_faces_look_up_and_split_along_the_diagonal_of_mujoco():
    terrain = hills()
    a, b, c = (terrain.vertices[terrain.faces[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert terrain.faces[:2].tolist() == [[0, 1, 14], [0, 14, 13]]


def test_height_beyond_the_border_is_that_of_the_border():
    terrain = hills()
    assert terrain.height([[-100, -100]])[0] == terrain.heights[0, 0]
    assert terrain.height([[100, 100]])[0] == terrain.heights[-1, -1]


@pytest.mark.parametrize("reach", [0.0, 0.6, 3.0, 40.0])
def test_no_height_within_reach_exceeds_the_bound(reach):
    """Also beyond the borders, and where the cells are not square. Near a place, the bound is one of the heights."""
    rng = np.random.default_rng(3)
    terrain = Terrain("rough", rng.uniform(-5, 5, (30, 41)), (-8.0, 3.0), (0.7, 1.1))
    xy = rng.uniform((-12, -1), (25, 40), (400, 2))
    way = rng.uniform(-1, 1, (400, 50, 2))
    way *= reach / np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1)
    bound = terrain.at_most(xy, reach)
    assert (terrain.height((xy[:, None] + way).reshape(-1, 2)).reshape(400, 50) <= bound[:, None]).all()
    assert np.abs(bound[:, None] - terrain.heights.ravel()).min(axis=1).max() < 1e-5
    assert reach or bound.std() > 1  # not simply the highest of all


def test_content_hash_follows_content_alone():
    heights = RNG.uniform(0, 4, (4, 5))
    assert Terrain("a", heights).content_hash == Terrain("b", heights.copy()).content_hash
    assert Terrain("a", heights).content_hash != Terrain("a", heights, origin=(1, 0)).content_hash
    assert Terrain("a", heights).content_hash != Terrain("a", heights + 1e-9).content_hash


def test_heights_cannot_be_changed_after_loading():
    heights = np.zeros((3, 3))
    terrain = Terrain("a", heights)
    heights[1, 1] = 5
    assert terrain.height([[1, 1]])[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        terrain.heights[0, 0] = 1


# ---------------------------------------------------------------- files


def write(tmp_path, name, heights, **scale):
    """A height map and its scale beside it."""
    file = tmp_path / name
    if name.endswith(".npy"):
        np.save(file, heights)
    else:
        Image.fromarray(heights).save(file)
    if scale:
        file.with_suffix(".toml").write_text("".join(f"{key} = {value}\n" for key, value in scale.items()))
    return file


def test_npz_carries_heights_cell_and_origin(tmp_path):
    np.savez(tmp_path / "t.npz", heights=np.arange(12.0).reshape(3, 4), cell=2.0, origin=[5, 6])
    terrain = Terrain.load(tmp_path / "t.npz")
    assert terrain.cell == (2, 2) and terrain.origin == (5, 6)
    assert terrain.height([[7, 8]])[0] == 5


def test_a_shot_with_the_name_of_its_terrain_does_not_describe_it(tmp_path):
    np.savez(tmp_path / "t.npz", heights=np.arange(12.0).reshape(3, 4), cell=2.0, origin=[5, 6])
    (tmp_path / "t.toml").write_text('[shot]\nschema = 1\n[world]\nterrain = "t.npz"\n')
    assert Terrain.load(tmp_path / "t.npz").cell == (2, 2)
    (tmp_path / "t.toml").write_text("[shott]\n")
    with pytest.raises(InputError, match="unknown key"):
        Terrain.load(tmp_path / "t.npz")


def test_npy_is_centred_and_warns_when_no_cell_is_given(tmp_path):
    with pytest.warns(UserWarning, match="no cell size"):
        terrain = Terrain.load(write(tmp_path, "t.npy", np.zeros((3, 5))))
    assert terrain.origin == (-2, -1)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 65535)])
def test_png_runs_from_black_to_white_with_up_as_y(tmp_path, dtype, white):
    grey = np.zeros((3, 4), dtype)
    grey[0, 0] = white  # top left: smallest x, largest y
    terrain = Terrain.load(write(tmp_path, "t.png", grey, range=[10, 60], cell=2, origin=[0, 0]))
    assert terrain.height([[0, 4]])[0] == 60
    assert terrain.height([[0, 0]])[0] == 10


def test_geotiff_has_its_own_origin_with_north_as_y(tmp_path):
    heights = np.zeros((3, 4), np.float32)
    heights[0, 0] = 7.0
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    for tag, value in ((33550, (10.0, 10.0, 0.0)), (33922, (0.0, 0.0, 0.0, 1000.0, 2000.0, 0.0))):
        tags[tag], tags.tagtype[tag] = value, 12
    Image.fromarray(heights).save(tmp_path / "t.tif", tiffinfo=tags)
    terrain = Terrain.load(tmp_path / "t.tif")
    assert terrain.cell == (10, 10) and terrain.origin == (1005, 1975)
    assert terrain.height([[1005, 1995]])[0] == 7


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply", "glb", "usda"])
def test_a_mesh_comes_back_as_the_heights_it_was_made_from(tmp_path, suffix):
    source = Terrain("s", RNG.uniform(0, 1, (6, 7)), origin=(-3, 1), cell=(0.5, 0.5))
    file = tmp_path / f"t.{suffix}"
    if suffix == "usda":
        write_usd(file, source)
    else:
        points = source.vertices @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) if suffix == "glb" else source.vertices
        trimesh.Trimesh(points, source.faces, process=False).export(file)
    file.with_suffix(".toml").write_text("cell = 0.5")
    terrain = Terrain.load(file)
    assert terrain.origin == pytest.approx((-3, 1), abs=1e-6)
    np.testing.assert_allclose(terrain.heights, source.heights, atol=1e-5)
    assert (terrain.look == file) == (suffix == "usda")


def write_usd(file, terrain):
    """A foreign stage: in centimetres and Y up, below a translated Xform."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    land = UsdGeom.Xform.Define(stage, "/land")
    land.AddTranslateOp().Set((0, 100, 0))
    stage.SetDefaultPrim(land.GetPrim())
    mesh = UsdGeom.Mesh.Define(stage, "/land/ground")
    x, y, z = 100 * terrain.vertices.T
    mesh.CreatePointsAttr(np.column_stack([x, z - 100, -y]).tolist())
    mesh.CreateFaceVertexCountsAttr([3] * len(terrain.faces))
    mesh.CreateFaceVertexIndicesAttr(terrain.faces.ravel().tolist())
    stage.Save()


def test_holes_are_filled_with_a_warning(tmp_path):
    source = Terrain("s", np.full((21, 21), 3.0))
    centre = source.vertices[source.faces].mean(axis=1)
    keep = np.abs(centre[:, :2] - 10).max(axis=1) > 2
    mesh = trimesh.Trimesh(source.vertices, source.faces[keep], process=False)
    mesh.export(tmp_path / "hole.ply")
    (tmp_path / "hole.toml").write_text("cell = 1")
    with pytest.warns(UserWarning, match="holes"):
        assert (Terrain.load(tmp_path / "hole.ply").heights == 3).all()


# ---------------------------------------------------------------- parts of rasters


def slope(rows=60, cols=60):
    """Heights of a plane, one number per place: 0.5 m per column and 2 m per row, +Y up."""
    return 0.5 * np.arange(cols) + 2.0 * np.arange(rows)[:, None]


def raster(tmp_path, suffix, heights, **scale):
    """The same heights, +Y up, as a file of any kind, with a cell of 10 m from (1000, 2000) m."""
    scale = {"cell": 10, "origin": [1000, 2000], **scale}
    if suffix == "npz":
        np.savez(tmp_path / "t.npz", heights=heights)
        (tmp_path / "t.toml").write_text("".join(f"{key} = {value}\n" for key, value in scale.items()))
        return tmp_path / "t.npz"
    if suffix == "png":  # a step of its 65,535 is 1/50 m
        scale["range"] = [0, 65535 / 50]
        return write(tmp_path, "t.png", np.round(50 * heights[::-1]).astype(np.uint16), **scale)
    return write(tmp_path, f"t.{suffix}", heights if suffix == "npy" else heights[::-1].astype(np.float32), **scale)


@pytest.mark.parametrize("suffix", ["npy", "npz", "png", "tif"])
def test_a_crop_is_the_same_heights_at_the_same_places(tmp_path, suffix):
    whole = Terrain.load(raster(tmp_path, suffix, slope()))
    part = Terrain.load(raster(tmp_path, suffix, slope(), crop=[1055, 2080, 1120, 2200]))
    assert part.origin == (1050, 2080) and part.heights.shape == (13, 8)
    np.testing.assert_allclose(part.heights, whole.heights[8:21, 5:13], atol=1e-9)
    np.testing.assert_allclose(whole.heights, slope(), atol=1e-6)


@pytest.mark.parametrize(("first_row", "rows"), [("north", slice(None, None, -1)), ("south", slice(None))])
def test_an_array_of_others_names_its_heights_and_its_first_row(tmp_path, first_row, rows):
    np.savez(tmp_path / "t.npz", elevation=slope()[rows], cell=10.0, origin=[1000.0, 2000.0])
    beside = f'array = "elevation"\nfirst_row = "{first_row}"\n'
    (tmp_path / "t.toml").write_text(beside)
    whole = Terrain.load(tmp_path / "t.npz")
    np.testing.assert_array_equal(whole.heights, slope())
    (tmp_path / "t.toml").write_text(f"{beside}crop = [1055, 2080, 1120, 2200]\n")
    part = Terrain.load(tmp_path / "t.npz")
    assert part.origin == (1050, 2080)
    np.testing.assert_array_equal(part.heights, whole.heights[8:21, 5:13])


def test_heights_may_be_in_an_installed_package_which_is_not_imported(tmp_path, monkeypatch):
    package = tmp_path / "site" / "heights_of_others"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("raise SystemExit('imported')")
    np.save(package / "t.npy", slope())
    monkeypatch.syspath_prepend(str(package.parent))
    toml = tmp_path / "terrain.toml"
    toml.write_text('heights = "package:heights_of_others/t.npy"\ncell = 10\norigin = [1000, 2000]\n')
    np.testing.assert_array_equal(Terrain.load(toml).heights, slope())
    for missing in ("not_there", "json.decoder", "", "math"):
        toml.write_text(f'heights = "package:{missing}/t.npy"\ncell = 10\n')
        refused(toml, f"the Python package '{missing}' is not installed", "install it", "terrain.toml:1: ")


@pytest.mark.parametrize(
    ("suffix", "key", "value"),
    [("npy", "range", [0, 1]), ("npy", "array", '"a"'), ("png", "first_row", '"south"'), ("tif", "range", [0, 1])],
)
def test_a_key_without_effect_on_the_file_is_named(tmp_path, suffix, key, value):
    path = raster(tmp_path, suffix, slope())
    with (tmp_path / "t.toml").open("a") as file:
        file.write(f"\n{key} = {value}\n")
    with pytest.warns(UserWarning, match=rf"t.toml: {key} has no effect on a .{suffix} file; it uses cell, "):
        Terrain.load(path)


def test_a_crop_outside_names_what_there_is(tmp_path):
    refused(raster(tmp_path, "npy", slope(), crop=[0, 0, 10, 10]), "crop", "1000", "2590")


@pytest.mark.parametrize("spacing", [5.0, 20.0, 25.0])
def test_resampled_heights_lie_on_the_same_plane(tmp_path, spacing):
    """To the edges of the map: smoothing there must not flatten the slope."""
    terrain = Terrain.load(raster(tmp_path, "npy", slope(), resample=spacing))
    assert terrain.cell == (spacing, spacing) and terrain.origin == (1000, 2000)
    x, y, z = terrain.vertices.T
    np.testing.assert_allclose(z, 0.05 * (x - 1000) + 0.2 * (y - 2000), atol=1e-9)


@pytest.mark.parametrize("suffix", ["npy", "npz", "png", "tif"])
def test_missing_heights_are_filled_from_their_neighbours(tmp_path, suffix):
    heights = np.full((12, 14), 30.0)
    heights[4:7, 5:8] = 0.0
    with pytest.warns(UserWarning, match="9 of 168 heights are missing"):
        terrain = Terrain.load(raster(tmp_path, suffix, heights, nodata=0))
    np.testing.assert_allclose(terrain.heights, 30.0, atol=1e-6)


def test_a_geotiff_names_its_missing_heights_itself(tmp_path):
    heights = np.full((6, 7), 12.0, np.float32)
    heights[2, 3], heights[1, 1] = -9999.0, np.nan
    tags = TiffImagePlugin.ImageFileDirectory_v2()
    tags[42113], tags.tagtype[42113] = "-9999", 2
    Image.fromarray(heights).save(tmp_path / "t.tif", tiffinfo=tags)
    (tmp_path / "t.toml").write_text("cell = 2")
    with pytest.warns(UserWarning, match="2 of 42 heights are missing"):
        assert np.ptp(Terrain.load(tmp_path / "t.tif").heights) == 0


@pytest.mark.parametrize("order", ["C", "F"])
def test_only_the_window_of_a_large_raster_is_read(tmp_path, order):
    """A file of 14.4 GB without blocks on the disk, but for one height: beyond the memory, cropped to 21 x 21."""
    file = tmp_path / "t.npy"
    with file.open("wb") as out:
        head = {"descr": "<f4", "fortran_order": order == "F", "shape": (50_000, 72_000)}
        np.lib.format.write_array_header_1_0(out, head)
        start = out.tell()
        out.seek(start + 4 * (8001 * 72_000 + 8002 if order == "C" else 8001 + 8002 * 50_000))
        out.write(np.float32(9.0).tobytes())
        out.truncate(start + 4 * 50_000 * 72_000)
    file.with_suffix(".toml").write_text("cell = 1\norigin = [0, 0]\n")
    refused(file, "t.npy", "crop")
    file.with_suffix(".toml").write_text("cell = 1\norigin = [0, 0]\ncrop = [8000, 8000, 8020, 8020]\n")
    terrain = Terrain.load(file)
    assert terrain.heights.shape == (21, 21) and terrain.origin == (8000, 8000)
    assert terrain.heights[1, 2] == terrain.heights.sum() == 9


# ---------------------------------------------------------------- what is refused


def refused(source, *words):
    with pytest.raises(InputError) as caught:
        Terrain.load(source)
    message = str(caught.value)
    assert all(word in message for word in words), message


def test_unknown_names_list_the_shipped_terrains():
    refused("canjon", "canjon", "canyon", "flat")


@pytest.mark.broken_stages
def test_invalid_terrain_files_are_named(tmp_path):
    for name in ("t.obj", "t.stl", "t.glb", "t.png", "t.npy", "t.npz", "t.tif", "t.usda"):
        (tmp_path / name).write_bytes(b"nonsense")
        refused(tmp_path / name, name)
    (tmp_path / "t.doc").write_bytes(b"")
    refused(tmp_path / "t.doc", ".doc", ".obj")


def test_pickled_arrays_are_not_opened(tmp_path):
    np.save(tmp_path / "t.npy", np.array([object()]), allow_pickle=True)
    refused(tmp_path / "t.npy", "t.npy")


def test_bad_heights_name_the_place(tmp_path):
    heights = np.zeros((4, 4))
    heights[2, 1] = np.inf
    refused(write(tmp_path, "t.npy", heights, cell=1), "t.npy", "heights[2, 1]", "fill the holes")
    heights[2, 1] = -32768
    refused(write(tmp_path, "u.npy", heights, cell=1), "u.npy", "heights[2, 1]", "nodata = ")
    refused(write(tmp_path, "v.npy", np.zeros((1, 4)), cell=1), "v.npy", "grid")
    refused(write(tmp_path, "w.npy", np.zeros(4), cell=1), "w.npy", "grid")


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        ({"cell": 0}, [".toml:1: cell = 0", "greater than 0"]),
        ({"cell": "nan"}, ["cell"]),
        ({"cell": "'wide'"}, ["cell", "wide"]),
        ({"cel": 1}, ["cel", "unknown key"]),
        ({"cell": 1, "origin": "[1, 'a']"}, ["origin"]),
        ({"cell": 1, "schema": 9}, ["schema", "9"]),
        ({"cell": 1, "look": "'none.usda'"}, ["look", "none.usda"]),
        ({"cell": "= 2"}, ["TOML"]),
    ],
)
def test_bad_scales_name_file_and_key(tmp_path, scale, words):
    refused(write(tmp_path, "t.npy", np.zeros((4, 4)), **scale), "t.", *words)


def test_a_picture_needs_a_range_of_heights(tmp_path):
    refused(write(tmp_path, "t.png", np.zeros((4, 4), np.uint8), cell=1), "range")


def test_an_absurdly_large_terrain_is_refused_before_any_work(tmp_path):
    file = write(tmp_path, "t.npy", np.zeros((4, 4)), cell=1)
    header = file.read_bytes().replace(b"(4, 4)", b"(9999999, 99999)")
    file.write_bytes(header)
    refused(file, "t.npy")
    trimesh.creation.box((100, 100, 1)).export(tmp_path / "b.stl")
    (tmp_path / "b.toml").write_text("cell = 0.001")
    refused(tmp_path / "b.stl", "cell")


@pytest.mark.parametrize("wind", [(1, 2), (0, np.nan, 0), "windy", (0, 0, 1000)])
def test_bad_wind_is_named(wind):
    with pytest.raises(InputError, match=r"world\.wind"):
        World(wind=wind)


# ---------------------------------------------------------------- shipped terrains


@pytest.mark.parametrize("name", ["canyon", "flat"])
def test_the_look_is_the_surface(name):
    from pxr import Usd, UsdGeom

    terrain = Terrain.load(name)
    stage = Usd.Stage.Open(str(terrain.look))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(f"/{name}/ground"))
    np.testing.assert_allclose(np.array(mesh.GetPointsAttr().Get()), terrain.vertices, atol=1e-5)
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    np.testing.assert_array_equal(faces, terrain.faces)


@pytest.mark.parametrize("name", ["canyon", "flat"])
def test_the_look_passes_every_validator_of_usd(name):
    from pxr import Usd, UsdValidation

    stage = Usd.Stage.Open(str(Terrain.load(name).look))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    assert len(validators) > 10


def test_every_texture_coordinate_of_the_canyon_is_used_once():
    """No triangle of the unwrapped canyon is flipped or collapsed in the picture."""
    from pxr import Usd, UsdGeom

    terrain = Terrain.load("canyon")
    stage = Usd.Stage.Open(str(terrain.look))
    st = np.array(UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/canyon/ground")).GetPrimvar("st").Get(), dtype=float)
    assert st.min() >= 0 and st.max() <= 1
    a, b, c = (st[terrain.faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    assert area.min() > 0


def test_the_canyon_suits_a_flight():
    """About 1e5 triangles; free ends, a floor near z = 0 below them, and rock on the straight line between them."""
    terrain = Terrain.load("canyon")
    assert 9e4 < len(terrain.faces) < 1.1e5
    start, goal = np.array([0, 0, 30.0]), np.array([180, 40, 28.0])
    assert (np.abs(terrain.height([start[:2], goal[:2]])) < 5).all()
    line = start + np.linspace(0, 1, 500)[:, None] * (goal - start)
    assert np.mean(terrain.height(line[:, :2]) > line[:, 2]) > 0.2
    assert terrain.heights.max() - terrain.heights.min() > 60


def test_shipped_terrain_files_are_complete():
    for name in ("canyon", "flat"):
        terrain = Terrain.load(name)
        table = tomllib.loads((terrain.look.parent / "terrain.toml").read_text())
        assert table["name"] == name


def test_heights_are_queried_at_points_of_the_plane():
    """Points in space would be read as 1.5 times as many points of the plane."""
    for world in (World(), World("flat")):
        assert world.height((1.0, 2.0)).shape == (1,) and world.height(np.zeros((4, 2))).shape == (4,)
        for wrong in (np.zeros((2, 3)), np.zeros((2, 2, 2)), 3.0):
            with pytest.raises(InputError, match=r"give .n, 2. m"):
                world.height(wrong)
