"""The html exporter: the block of bytes against the clips, the page on its own, and in a browser."""

import base64
import copy
import json
import re
import zlib
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from PIL import Image

import vehsim
from tests.browser import opened
from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera
from vehsim.delivery.take import RenderSettings, Take, UsdSettings
from vehsim.exporters.usd.stage import StageReader
from vehsim.exporters.web import scene as web
from vehsim.exporters.web.html import PAGE
from vehsim.lie.quaternions import matrices
from vehsim.shot import Shot
from vehsim.world.obstacles.obstacles import footprint
from vehsim.world.water.sea import sea_state
from vehsim.world.water.water import wave
from vehsim.world.world import Water, World


class Block:
    """A block of `scene_block`, decoded without vehsim."""

    def __init__(self, content: bytes) -> None:
        length = int.from_bytes(content[:4], "little")
        self.header = json.loads(content[4 : 4 + length])
        self.content = content[4 + length :]

    def array(self, ref):
        return np.frombuffer(self.content[ref["at"] : ref["at"] + ref["size"]], np.dtype(ref["kind"]))

    def poses(self, ref):
        """Matrices (n, 4, 4) of poses."""
        rows = self.array(ref).reshape(-1, 7).astype(float)
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = matrices(np.roll(rows[:, 3:], 1, axis=1)), rows[:, :3]
        return T


def in_page(text):
    return zlib.decompress(base64.b64decode(re.search(r'octet-stream">([^<]*)<', text)[1]))


@pytest.fixture(scope="module")
def delivered(toys, tmp_path_factory):
    """A toy's take, its page, and the page's block."""
    folder = tmp_path_factory.mktemp("html")
    clip = toys.clip(toys.asset(folder / "toy.usda"))
    clips = {"toy0": clip}
    marks = [{"frame": 1001, "position": [0.0, 0.0, 6.0]}, {"frame": "free", "position": clip.positions[17].tolist()}]
    marks[1]["gate"] = {"direction": [0.0, 2.0, 0.0], "size": [4.0, 2.0]}
    notes = [{"frame": 1005, "text": "</script>slow", "position": [1.0, 2.0, 3.0]}, {"frame": 1020, "text": "late"}]
    camera = solve_camera(CameraRig(), clips, World(), toys.frames, 160 / 90)
    take = Take(
        "shot", clips, World(), (camera,), Fraction(24), toys.frames, RenderSettings((160, 90)),
        report={"marks": {"toy0": marks}, "shot": {"note": notes}},
    )  # fmt: skip
    page = take.export(folder / "out", to=("html",)) / "shot.html"
    return take, page, Block(in_page(page.read_text()))


def test_moves_bodies_and_rotors_as_the_clip_does(delivered):
    take, _, block = delivered
    clip = take.clips["toy0"]
    by_name = {shape["name"].rpartition("/")[2]: shape for shape in block.header["shapes"]}
    spin = 40.0 * np.arange(24) / 24
    T_rotor = np.tile(np.eye(4), (24, 1, 1))
    T_rotor[:, 0, 0] = T_rotor[:, 1, 1] = np.cos(spin)
    T_rotor[:, 1, 0] = np.sin(spin)
    T_rotor[:, 0, 1] = -np.sin(spin)
    T_rotor[:, :3, 3] = [0.2, 0.0, 1.2]
    for name, part, half in (
        ("rotor", clip.matrices() @ T_rotor, [2.4, 0.2, 0.05]),
        ("body", clip.matrices(), [2.0, 1.0, 0.6]),
    ):
        shape = by_name[name]
        group = block.header["groups"][shape["group"]]
        points = block.array(shape["points"]).reshape(-1, 3)[block.array(shape["faces"])]
        shown = block.poses(group["poses"]) @ np.append(points.max(axis=0), 1.0)
        corner = np.array(half) + ([0.0, 0.0, 0.5] if name == "body" else 0.0)
        assert np.abs(shown - part @ np.append(corner, 1.0)).max() < 2e-5
        assert group["vehicle"] == "toy0"


def test_faces_look_outwards(delivered):
    _, _, block = delivered
    for shape in block.header["shapes"]:
        faces = block.array(shape["faces"]).reshape(-1, 3)
        points = block.array(shape["points"]).reshape(-1, 3)[faces]
        normals = block.array(shape["normals"]).reshape(-1, 4)[faces][..., :3] / 127.0
        across = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        assert ((across[:, None] * normals).sum(axis=2) > 0).all()
        assert ((points - points.mean(axis=(0, 1))) * normals).sum() > 0


def test_cameras_keep_pose_and_lens(delivered):
    take, _, block = delivered
    (camera,), (given,) = take.cameras, block.header["cameras"]
    T_wc = block.poses(given["poses"])
    assert np.allclose(T_wc[:, :3, 3], camera.positions, atol=1e-5)
    assert np.allclose(T_wc[:, :3, :3], matrices(camera.orientations), atol=1e-6)
    half, right, up = block.array(given["lens"]).reshape(-1, 3).T
    assert np.allclose(half, camera.aperture_mm[0] / (2 * camera.lens_mm)) and not right.any() and not up.any()


def test_marks_know_their_frame_and_heading(delivered):
    _, _, block = delivered
    first, free = block.header["marks"]
    assert (first["frame"], first["heading"]) == (1001, pytest.approx(0.0, abs=1e-6))
    assert free["frame"] == 1018
    assert free["heading"] == pytest.approx(np.degrees(17 / 24), abs=1e-3)


def test_a_gate_is_drawn_around_its_mark(delivered):
    _, _, block = delivered
    first, second = (mark["gate"] for mark in block.header["marks"])
    assert first is None
    corners = second["points"]  # along the direction, the width, the height
    assert sorted(map(tuple, corners[:4])) == [(0, -2, -1), (0, -2, 1), (0, 2, -1), (0, 2, 1)]
    assert corners[4] == corners[0] and (second["heading"], second["tilt"]) == (pytest.approx(90), 0)


def test_curves_show_the_speed(delivered):
    _, _, block = delivered
    curve = next(curve for curve in block.header["curves"] if curve["name"] == "speed")
    speed = block.array(curve["values"])
    assert len(speed) == 24 and speed[12] == pytest.approx(np.hypot(12.0, 2.0), rel=1e-3)
    load = block.array(next(curve for curve in block.header["curves"] if curve["name"] == "g_load")["values"])
    assert load[12] == pytest.approx(np.hypot(9.81, 12.0) / 9.81, rel=1e-2)  # on a circle at 1 rad/s
    assert {curve["name"] for curve in block.header["curves"]} == {"speed", "g_load", "lift"}


def test_clearance_is_the_distance_to_what_can_be_hit():
    """Cars side by side and past a wall: the gap between their footprints and it. In an empty world there is none."""
    cars = [
        {
            "name": name,
            "asset": "car",
            "motion": {
                "method": "simulate",
                "duration": 1.0,
                "start": {"position": [-5, y, 0]},
                "commands": [{"frame": 1001, "torque": 1000}],
            },
        }
        for name, y in (("near", 0.0), ("far", -6.0))
    ]
    wall = {"name": "wall", "shape": "box", "centre": [0.0, 5.0, 0.0], "size": [60.0, 2.0, 3.0]}
    shot = {"shot": {"schema": 1, "name": "s"}, "vehicle": cars}
    half = float(footprint(vehsim.load_vehicle("car"))[:, 1].max())
    for obstacles, wanted in (
        ([], {}),
        ([wall], {"near": 4 - half, "far": 10 - half}),
        ([wall, {"shape": "vehicle", "vehicle": "far"}], {"near": min(4 - half, 6 - 2 * half), "far": 10 - half}),
    ):
        take = Shot.from_dict({**shot, "world": {"obstacle": obstacles}}).solve()
        pack, found = web.Packing(), {}
        for name, clip in take.clips.items():
            for curve in web._curves(pack, take, name, clip):
                if curve["name"] == "clearance":
                    found[name] = Block(pack.block({})).array(curve["values"])
        assert found.keys() == wanted.keys()
        for name, values in found.items():
            assert np.allclose(values, wanted[name], atol=2e-3), (name, values, wanted)


def test_a_released_brake_is_not_at_a_limit():
    """The bound of zero limits the lift of a helicopter, but not a brake, which is zero while it is not used."""
    bounds = {}
    for name, table in (("rally_car", {}), ("helicopter", {"start": {"position": [0, 0, 30]}})):
        vehicle = {"name": name, "asset": name, "motion": {"method": "simulate", "duration": 0.25, **table}}
        take = Shot.from_dict({"shot": {"schema": 1, "name": "s"}, "vehicle": [vehicle]}).solve()
        for curve in web._curves(web.Packing(), take, name, take.clips[name]):
            bounds[curve["name"]] = curve["low"], curve["high"]
    assert bounds["brake"] == bounds["handbrake"] == (None, 8000)
    assert bounds["drive"] == (-1000, 3500) and bounds["collective"] == (0, 33000)


def test_the_page_needs_nothing_else(delivered):
    _, page, _ = delivered
    own = "".join((PAGE / name).read_text() for name in ("page.html", "style.css", "viewer.js"))
    assert not re.search(r"https?:|src=|href=|@import|\bimport\(|fetch\(|XMLHttpRequest|WebSocket", own)
    text = page.read_text()
    assert not re.findall(r"<(?:script|link|img)[^>]*\b(?:src|href)=", text)
    assert "The MIT License" in (PAGE / "three.LICENSE.txt").read_text()
    assert "Three.js Authors" in text and "SPDX-License-Identifier: MIT" in text


def test_the_same_shot_gives_the_same_page(delivered, tmp_path):
    take, page, _ = delivered
    again = take.export(tmp_path, to=("html",)) / "shot.html"
    assert again.read_bytes() == page.read_bytes()


def test_a_name_cannot_end_the_page(delivered):
    from vehsim.exporters.web.html import page

    text = page("</title><script>{scene}", "QUJD")
    assert "<title>&lt;/title&gt;&lt;script&gt;{scene}</title>" in text
    assert text.count("QUJD") == 1


def test_large_textures_are_reduced(tmp_path):
    colours = np.zeros((30, 4000, 3), np.uint8)
    colours[..., 1] = 200
    Image.fromarray(colours).save(tmp_path / "wide.png")
    pack = web.Packing()
    ref = web._texture(pack, tmp_path / "wide.png")
    block = Block(pack.block({}))
    (tmp_path / "read.jpg").write_bytes(block.content[ref["at"] : ref["at"] + ref["size"]])
    with Image.open(tmp_path / "read.jpg") as image:
        assert (ref["type"], image.size) == ("image/jpeg", (2048, 15))
        assert image.getpixel((700, 7)) == pytest.approx((0, 200, 0), abs=3)


@pytest.mark.parametrize(
    ("most", "form"),
    [(4_000_000, UsdSettings()), (30_000, UsdSettings()), (30_000, UsdSettings(up_axis="Y", meters_per_unit=0.01))],
)
def test_water_moves_as_on_the_stage(toys, tmp_path, monkeypatch, most, form):
    monkeypatch.setattr(web, "WATER_SAMPLES", most)
    monkeypatch.setattr("vehsim.exporters.usd.scenery.water_grid.MOST_POINTS", 3000)
    clip = toys.clip(toys.asset(tmp_path / "toy.usda"))
    clips = {"toy0": clip}
    world = World(water=Water(surface=wave(0.6, 25.0)))
    camera = solve_camera(CameraRig(), clips, world, toys.frames)
    take = Take("shot", clips, world, (camera,), Fraction(24), toys.frames, usd=form)
    stage = StageReader(take.export(tmp_path, to=("usd",)) / "shot.usda")
    block = Block(web.scene_block(take, stage))
    water = block.header["water"]
    rows, cols = water["shape"]
    shown = _moved(block, water)
    assert 24 * rows * cols <= most
    for k in (0, 11, 23):
        points = stage.water_at(1001.0 + k)[0].reshape(*stage.water_net.shape, 3)
        every = -(-points.shape[0] // rows)
        assert np.abs(shown[k] - points[::every, ::every].reshape(-1, 3)).max() <= 0.51 * water["step"] + 1e-4
    assert np.ptp(shown[:, :, 2]) > 0.5

    drawn = web.draw_water(take, stage, lambda share: None)
    alone = Block(drawn.block)
    assert alone.header["shape"] == water["shape"]
    np.testing.assert_allclose(_moved(alone, alone.header), shown, atol=1.01 * water["step"] + 1e-4)
    np.testing.assert_allclose(alone.array(alone.header["foam"]), block.array(water["foam"]), atol=2)
    for each, frames in ((block, water), (alone, alone.header)):
        kx, ky, phase, turn, height, only = frames["waves"][0]  # a single wave, at rest places
        places = each.array(frames["places"]).reshape(-1, 4)
        swing = height * np.cos(places[:, :2] @ [kx, ky] + phase - 5 * turn)
        fine = places[:, 2] < 4.0  # in cells of a sixth of the wave
        assert not only and fine.sum() > 50
        np.testing.assert_allclose(swing[fine], shown[5][fine, 2], atol=0.02)

    def with_clip(clip):
        return replace(take, clips={"toy0": clip})

    near, far = (replace(clip, positions=clip.positions + np.array([0.0, y, 0.0])) for y in (0.5, 80.0))
    assert drawn.shows(take, stage)
    assert drawn.shows(with_clip(near), stage) and not drawn.shows(with_clip(far), stage)  # nothing floats
    higher = World(water=Water(surface=wave(0.7, 25.0)))
    assert not drawn.shows(replace(take, world=higher), stage)
    boat = copy.copy(clip.vehicle)
    boat.hull = "any"
    boats = [replace(one, vehicle=boat) for one in (clip, near)]
    assert web._stirred(with_clip(boats[0])) != web._stirred(with_clip(boats[1]))


def _moved(block, water):
    """Places (24, n, 3) m of the water's points."""
    start = block.array(water["start"]).reshape(-1, 3)
    bends = block.array(water["bends"]).reshape(24, len(start), 3).astype(np.int64)
    return start + water["step"] * bends.cumsum(axis=0).cumsum(axis=0)


def test_a_browser_shows_it(delivered, tmp_path):
    _, page, _ = delivered
    document = opened(page, tmp_path, "--virtual-time-budget=20000")
    assert '<div id="message" hidden="">' in document, re.findall(r'<div id="message"[^<]*', document)
    assert re.search(r'<div id="title"><b>shot</b>\s+1001</div>', document)
    assert re.findall(r'title="toy0: mark at ([^"]*)"', document) == ["1001", "1018"]
    assert re.findall(r'class="note"[^>]* title="([^"]*)"', document) == ["1005: &lt;/script&gt;slow", "1020: late"]


def test_a_browser_shows_waves(toys, tmp_path, monkeypatch):
    monkeypatch.setattr("vehsim.exporters.usd.scenery.water_grid.MOST_POINTS", 3000)
    clips = {"toy0": toys.clip(toys.asset(tmp_path / "toy.usda"))}
    world = World(water=Water(surface=sea_state(0.6)))
    camera = solve_camera(CameraRig(), clips, world, toys.frames)
    take = Take("shot", clips, world, (camera,), Fraction(24), toys.frames)
    document = opened(take.export(tmp_path, to=("html",)) / "shot.html", tmp_path, "--virtual-time-budget=20000")
    assert '<div id="message" hidden="">' in document, re.findall(r'<div id="message"[^<]*', document)


def test_is_near_its_origin_at_utm_coordinates(delivered, tmp_path):
    take, _, near = delivered
    by = np.array([500_000.0, 4_212_000.0, 0.0])
    clips = {"toy0": replace(take.clips["toy0"], positions=take.clips["toy0"].positions + by)}
    camera = replace(take.cameras[0], positions=take.cameras[0].positions + by)
    marks = [mark | {"position": np.add(mark["position"], by).tolist()} for mark in take.report["marks"]["toy0"]]
    first, second = take.report["shot"]["note"]
    shot = {"note": [first | {"position": np.add(first["position"], by).tolist()}, second]}
    far = replace(take, clips=clips, cameras=(camera,), report=take.report | {"marks": {"toy0": marks}, "shot": shot})
    block = Block(in_page((far.export(tmp_path, to=("html",)) / "shot.html").read_text()))
    for path, other in zip(block.header["paths"], near.header["paths"], strict=True):
        np.testing.assert_allclose(block.array(path["points"]), near.array(other["points"]), atol=1e-5)
    for group, other in zip(block.header["groups"], near.header["groups"], strict=True):
        np.testing.assert_allclose(block.poses(group["poses"]), near.poses(other["poses"]), atol=1e-5)
    for mark, other in zip(block.header["marks"], near.header["marks"], strict=True):
        np.testing.assert_allclose(mark["position"], other["position"], atol=1e-5)
    assert near.header["notes"] == take.report["shot"]["note"]
    assert block.header["notes"] == [first | {"position": pytest.approx([1, 2, 3], abs=1e-5)}, second]
