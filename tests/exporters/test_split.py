"""Pictures side by side: each camera's own picture, complete, with its caption; and the film of them."""

from __future__ import annotations

import tomllib
from dataclasses import replace

import av
import numpy as np
import pytest
from PIL import Image

from vehsim import Shot
from vehsim.exporters.pictures.split import NAME, caption

SHOT = """
[shot]
schema = 1
name = "pair"
[[vehicle]]
name = "slow"
asset = "tumbler"
[vehicle.motion]
method = "integrate"
integrator = "rk4"
duration = 0.5
step = 0.25
start = { spin = [600, 60, 400] }
[[camera]]
name = "a"
rig = "static"
position = [-1, 0, 0]
[[camera]]
name = "b"
rig = "static"
position = [0, -1, 0]
[render]
size = [324, 120]
every = 6
samples = 0
layout = "side-by-side"
[render.captions]
a = "RK4: {slow} {unknown}"
"""


@pytest.fixture(scope="module")
def delivery(tmp_path_factory):
    place = tmp_path_factory.mktemp("split")
    (place / "pair.toml").write_text(SHOT)
    take = Shot.load(place / "pair.toml").solve()
    return take, take.export(place / "out", to=("png", "mp4"))


def test_each_panel_is_its_cameras_picture_above_the_caption(delivery):
    _, folder = delivery
    for frame in (1001, 1007, 1013):
        wide = np.asarray(Image.open(folder / "frames" / NAME / f"pair.{NAME}.{frame}.png"))
        assert wide.shape == (120, 324, 3)
        for k, camera in enumerate("ab"):
            alone = np.asarray(Image.open(folder / "frames" / camera / f"pair.{camera}.{frame}.png"))
            assert alone.shape == (120, 160, 3)
            panel = wide[:, 164 * k : 164 * k + 160]
            assert np.array_equal(panel[:98], alone[:98])
            assert np.array_equal(panel, alone) == (camera == "b")  # camera b has no caption
        assert not wide[:, 160:164].any()


def test_captions_show_the_remaining_energy(delivery):
    take, _ = delivery
    energy = take.clips["slow"].energy["kinetic"]
    assert caption(take, "a", 1001) == "RK4: 100% {unknown}"
    assert caption(take, "a", 1013) == f"RK4: {energy[-1] / energy[0]:.0%} {{unknown}}"
    assert energy[-1] < 0.97 * energy[0]
    assert caption(take, "b", 1001) == ""


def test_captions_of_a_vehicle_that_starts_with_no_energy_are_in_joules(delivery):
    take, _ = delivery
    clip = take.clips["slow"]
    for first, share in ((0.0, 0.5), (1e-30, 1.0)):
        rising = np.linspace(first, 50.0, len(clip))
        started = replace(clip, energy={"kinetic": rising, "potential": np.zeros(len(clip))})
        assert (
            caption(replace(take, clips={"slow": started}), "a", 1001 + 12 * share)
            == f"RK4: {50 * share:.0f} J {{unknown}}"
        )


def test_captions_that_a_cut_list_hides_are_warned_of():
    """With a cut list, only the cut is rendered unless cameras are named; the cut may have a caption too."""
    cut = '\n[[cut]]\nframe = 1001\ncamera = "b"\n'
    text = SHOT.replace("\n[render]", f"{cut}[render]") + 'cut = "all of it"\n'
    (problem,) = Shot.from_dict(tomllib.loads(text)).check()
    assert (problem.key, problem.severity) == ("render.captions.a", "warning")
    assert "not rendered" in problem.message
    text = text.replace("every = 6", 'every = 6\ncameras = ["a", "cut"]')
    assert Shot.from_dict(tomllib.loads(text)).check() == []


def test_film_of_the_pictures_side_by_side(delivery):
    _, folder = delivery
    with av.open(str(folder / f"pair.{NAME}.mp4")) as film:
        assert [(frame.width, frame.height) for frame in film.decode(video=0)] == [(324, 120)] * 3
    assert {path.name for path in folder.glob("*.mp4")} == {"pair.a.mp4", "pair.b.mp4", f"pair.{NAME}.mp4"}


@pytest.mark.parametrize(
    ("change", "key", "remedy"),
    [
        ('a = "RK4: {slow} {unknown}"', "render.captions.c", "choose one of a, b"),
        ('integrator = "rk4"', "vehicle[0].motion.integrator", "did you mean 'rk4'?"),
    ],
)
def test_wrong_camera_names_are_reported(tmp_path, change, key, remedy):
    text = SHOT.replace(change, {"a": 'c = "no such camera"', "i": 'integrator = "rk5"'}[change[0]])
    (tmp_path / "pair.toml").write_text(text)
    (problem,) = (p for p in Shot.load(tmp_path / "pair.toml").check() if p.severity == "error")
    assert (problem.key, problem.remedy) == (key, remedy)
