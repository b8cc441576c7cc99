"""What covers standing obstacles, and the light of each mood."""

import io
from fractions import Fraction

import numpy as np
import pytest
import trimesh
from PIL import Image

import vehsim
from vehsim import Take, World
from vehsim.exporters.usd.scenery import finishes, obstacle_meshes
from vehsim.exporters.usd.scenery.lighting import MOODS, to_linear, write_sky
from vehsim.exporters.usd.scenery.obstacle_meshes import shading_normals
from vehsim.exporters.usd.scenery.shading import light_for
from vehsim.exporters.usd.stage import Sky, Sun
from vehsim.shot.schema.tables import RenderTable
from vehsim.shot.schema.world import BoxTable
from vehsim.world.obstacles import obstacles as ob

GREY = (0.4, 0.4, 0.4)


def pixels(finish):
    with Image.open(io.BytesIO(finishes.picture(finish, GREY))) as image:
        return np.asarray(image, float)[::-1].mean(axis=2)  # from the bottom


@pytest.mark.parametrize(("finish", "axis", "period"), [("facade", 0, 3.0), ("facade", 1, 2.0), ("stripes", 0, 0.5)])
def test_patterns_repeat_at_their_stated_size(finish, axis, period):
    """The picture agrees with itself when it is moved by a storey, a bay or a pair of stripes; not by half of that."""
    tile = finishes.FINISHES[finish].tile[1 - axis]
    dark = pixels(finish) < 100
    step = period / tile * finishes.TEXELS
    for share, agrees in ((1.0, True), (0.5, False)):
        same = (dark == np.roll(dark, round(share * step), axis)).mean()
        assert (same > 0.95) == agrees


def test_bands_are_as_high_as_the_cone():
    cone = ob.cone("c", (3, 2, 1), radius=0.3, height=0.9)
    corners = cone.points[cone.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    st = finishes.coordinates(corners, normals, cone.finish)
    assert st[..., 1] == pytest.approx((corners[..., 2] - 1.0) / 0.9, abs=0.003)
    rows = pixels("bands").mean(axis=1)
    assert rows[int(0.5 * finishes.TEXELS)] > rows[int(0.2 * finishes.TEXELS)] + 30


def test_every_finish_and_colour_reaches_the_stage(tmp_path):
    """Obstacles without a colour take turns; others have a material of their own, with the colour that was given."""
    from dataclasses import replace

    from pxr import Usd, UsdShade

    crate = ob.box("plain", (4, 0, 0), (1, 1, 1))
    made = [crate, replace(crate, name="blue", finish="paint", colour=(0.2, 0.5, 0.8)), ob.cone("cone", (9, 0, 0))]
    made += [replace(crate, name="next"), *(replace(crate, name=f"b_{f}", finish=f) for f in ob.FINISHES)]
    clip = vehsim.simulate(vehsim.load_vehicle("car"), duration=0.1)
    folder = Take("t", {"car": clip}, World(obstacles=made), (), Fraction(24), (1001, 1003)).export(tmp_path)
    stage = Usd.Stage.Open(str(folder / "t.usda"))

    def texture(name):
        prim = stage.GetPrimAtPath(f"/t/env/obstacles/{name}/{name}")
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        shader = UsdShade.Shader(stage.GetPrimAtPath(f"{material.GetPath()}/picture"))
        return shader.GetInput("file").Get().resolvedPath

    with Image.open(texture("blue")) as image:
        assert np.asarray(image, float).mean(axis=(0, 1)) == pytest.approx(255 * np.array([0.2, 0.5, 0.8]), abs=2.5)
    assert texture("plain").endswith("/concrete.png") and texture("next").endswith("/terracotta.png")
    assert len({texture(f"b_{finish}") for finish in ob.FINISHES}) == len(ob.FINISHES)
    assert texture("cone") == texture("b_bands")


def test_roofs_have_no_windows(tmp_path):
    """Walls of a facade have windows; what lies, a roof and a floor, has concrete in panels of a metre."""
    from dataclasses import replace

    from pxr import Usd, UsdGeom, UsdShade

    house = replace(ob.box("house", (9, 0, 0), (6, 4, 9), heading=30), finish="facade")
    clip = vehsim.simulate(vehsim.load_vehicle("car"), duration=0.1)
    folder = Take("t", {"car": clip}, World(obstacles=[house]), (), Fraction(24), (1001, 1003)).export(tmp_path)
    stage = Usd.Stage.Open(str(folder / "t.usda"))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/t/env/obstacles/house/house"))
    (subset,) = UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets()
    level = np.asarray(subset.GetIndicesAttr().Get())
    points, faces = np.asarray(mesh.GetPointsAttr().Get()), np.asarray(mesh.GetFaceVertexIndicesAttr().Get())
    corners = points[faces.reshape(-1, 3)]
    assert set(level) == set(np.flatnonzero(np.ptp(corners[..., 2], axis=1) < 1e-6)) and len(level) == 4
    material, _ = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()
    assert material.GetPath().name == "concrete"
    st = np.asarray(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()).reshape(-1, 3, 2)
    tile = np.array(finishes.FINISHES["concrete"].tile)
    edges = np.linalg.norm((st[level] - np.roll(st[level], 1, axis=1)) * tile, axis=2)
    assert edges == pytest.approx(np.linalg.norm(corners[level] - np.roll(corners[level], 1, axis=1), axis=2), abs=1e-4)


def wall_places(obstacle):
    """The corners (m, 3, 3) m of an obstacle's upright faces, their normals, and where on a facade (m, 3, 2) m they
    are."""
    corners = obstacle.points[obstacle.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    standing = np.abs(normals[:, 2]) < 0.01
    places = finishes.coordinates(corners, normals, "facade") * finishes.FINISHES["facade"].tile
    return corners[standing], normals[standing], places[standing]


def test_no_window_is_cut_at_a_corner_or_under_the_roof():
    """Each wall of a turned house has a whole number of bays, hardly stretched, and of storeys from its own bottom."""
    _, normals, places = wall_places(ob.box("house", (500_009.3, 7.7, 1.4), (11.1, 4.6, 7.0), heading=33))
    for normal, bays in zip(np.unique(normals.round(3), axis=0), (2, 6, 6, 2), strict=True):
        wall = places[np.abs(normals - normal).max(axis=1) < 0.01]
        assert np.ptp(wall[..., 0]) == pytest.approx(finishes.BAY * bays)
        assert wall[..., 1].min() == 0 and wall[..., 1].max() == pytest.approx(2 * finishes.STOREY, rel=0.02)


def test_the_facade_of_a_round_tower_goes_all_around():
    """Its flat parts are one wall: whole bays around it, and the same place on both sides of all edges but one."""
    tower = ob.ellipse("tower", (3.0, 4.0), (5.0, 5.0), height=9.0)
    corners, _, places = wall_places(tower)
    assert np.ptp(places[..., 0]) == pytest.approx(finishes.BAY * round(2 * np.pi * 5 / finishes.BAY))
    _, of_place = np.unique(corners.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    spread = [np.ptp(places.reshape(-1, 2)[of_place.ravel() == k, 0]) for k in range(of_place.max() + 1)]
    assert sum(each > 0.01 for each in spread) == 2


def test_lists_of_names_agree():
    """The shot file, the obstacles and the exporter name the same finishes and moods."""
    finish, mood = BoxTable.model_fields["finish"], RenderTable.model_fields["mood"]
    assert set(finish.annotation.__args__[0].__args__) == set(ob.FINISHES) == set(finishes.FINISHES)
    assert set(mood.annotation.__args__) == set(MOODS)


def test_moods_differ_as_their_names_say(tmp_path):
    def light(name):
        mood = MOODS[name]
        write_sky(tmp_path / "sky.png", 40.0, mood.elevations[0], mood)
        sky = Sky(np.full(3, mood.dome_intensity), tmp_path / "sky.png", np.eye(3)[[0, 2, 1]] * [1, -1, 1])
        slope = np.radians(mood.elevations[0])
        direction = np.array([np.cos(slope), 0, -np.sin(slope)])
        return light_for(Sun(direction, mood.sun_intensity * np.array(mood.sun_colour), mood.sun_angle), sky)

    found = {name: light(name) for name in MOODS}
    white = {name: to_linear(np.minimum(one.sun + one.ambient + one.sky, 1.0)).mean() for name, one in found.items()}
    assert white["night"] < 0.3 * min(white[name] for name in MOODS if name != "night")
    shade = {name: ((one.ambient + one.sky) / one.sun).mean() for name, one in found.items()}
    assert shade["overcast"] > 1.5 * max(shade["noon"], shade["afternoon"])  # its shadows are faint
    level = {name: (one.ambient + one.sky - one.sun * one.direction[2]).mean() for name, one in found.items()}
    assert level["noon"] > level["overcast"] > level["afternoon"]  # paving
    assert [name for name, one in found.items() if not one.sharp] == ["overcast"]
    assert found["night"].sun[2] > found["night"].sun[0] and found["dusk"].sun[0] > 1.5 * found["dusk"].sun[2]


def test_a_colour_makes_pictures_again_but_solves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("VEHSIM_CACHE", str(tmp_path))
    monkeypatch.setenv("VEHSIM_CACHE_GB", "1")
    shot = {
        "shot": {"schema": 1, "name": "t"},
        "vehicle": [{"name": "car", "asset": "car", "motion": {"method": "simulate", "duration": 0.1}}],
        "world": {"obstacle": [{"shape": "box", "centre": [4, 0, 0], "size": [1, 1, 1]}]},
    }
    first = vehsim.Shot.from_dict(shot).solve()
    shot["world"]["obstacle"][0] |= {"finish": "stripes", "colour": [1, 0, 0]}
    second = vehsim.Shot.from_dict(shot).solve()
    assert second.recalled and second.content_hash != first.content_hash
    shot["world"]["obstacle"][0]["size"] = [1, 1, 2]
    assert not vehsim.Shot.from_dict(shot).solve().recalled


def off_by(normals, wanted):
    """The largest angle between normals, degrees."""
    wanted = wanted / np.linalg.norm(wanted, axis=-1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((normals * wanted).sum(axis=-1), -1, 1))).max())


def test_round_obstacles_are_shaded_round_and_edges_stay_sharp():
    """The normals of a ball, of a cylinder's side and caps, and of a box are theirs."""
    ball, box = trimesh.creation.icosphere(3, 2.0), trimesh.creation.box((1, 2, 3))
    assert off_by(shading_normals(ball.vertices, ball.faces), ball.vertices[ball.faces]) < 0.5
    cylinder = trimesh.creation.cylinder(1.0, 2.0, sections=32)
    wanted, side = np.repeat(cylinder.face_normals[:, None], 3, axis=1), np.abs(cylinder.face_normals[:, 2]) < 0.5
    wanted[side] = cylinder.vertices[cylinder.faces[side]] * (1, 1, 0)
    assert off_by(shading_normals(cylinder.vertices, cylinder.faces), wanted) < 1e-5
    flat = np.repeat(box.face_normals[:, None], 3, axis=1)
    assert off_by(shading_normals(box.vertices, box.faces), flat) < 1e-5


def test_many_faces_at_one_point_are_shaded_flat(monkeypatch):
    cone = trimesh.creation.cone(1.0, 2.0, sections=64)
    assert off_by(shading_normals(cone.vertices, cone.faces), np.repeat(cone.face_normals[:, None], 3, axis=1)) > 2
    monkeypatch.setattr(obstacle_meshes, "MOST", 1000)
    assert off_by(shading_normals(cone.vertices, cone.faces), np.repeat(cone.face_normals[:, None], 3, axis=1)) < 1e-5
