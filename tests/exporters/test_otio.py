"""The cut list read back by OpenTimelineIO, and timelines of editors as cut lists of shots."""

from __future__ import annotations

import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera
from vehsim.exporters.pictures.passes import picture_path

otio = pytest.importorskip("opentimelineio", reason="needs OpenTimelineIO, which has no wheel for Python 3.14")


@pytest.mark.parametrize("fps", [Fraction(24), Fraction(24000, 1001)])
def test_a_cut_list_becomes_clips_with_their_frames(tmp_path, toys, make_take, fps):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    wide = solve_camera(CameraRig("wide", "static"), take.clips, take.world, take.frames, 16 / 9)
    take = replace(
        take, cameras=(*take.cameras, wide), cuts=((1001, "chase"), (1010, "wide"), (1020, "chase")), fps=fps
    )
    folder = take.export(tmp_path / "out", to=("otio",))
    timeline = otio.adapters.read_from_file(str(folder / "shot.otio"))
    (track,) = timeline.tracks
    found = [(c.name, c.source_range.start_time.value, c.source_range.duration.value) for c in track]
    assert found == [("chase", 1001, 9), ("wide", 1010, 10), ("chase", 1020, 5)]
    assert timeline.global_start_time.rate == pytest.approx(float(fps))
    assert track[1].media_reference.target_url_for_image_number(9) == "frames/wide/shot.wide.1010.png"


@pytest.mark.parametrize("frame", [-1028, -28, 0, 7, 1010, 12345])
def test_pictures_have_the_names_that_a_timeline_gives_them(tmp_path, toys, make_take, frame):
    """Also those of negative frames, whose sign comes before the four digits."""
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    folder = replace(take, frames=(frame, frame + 9)).export(tmp_path / "out", to=("otio",))
    ((clip,),) = otio.adapters.read_from_file(str(folder / "shot.otio")).tracks
    said = [clip.media_reference.target_url_for_image_number(k) for k in range(10)]
    assert said == [picture_path(Path("frames"), "shot", "chase", frame + k).as_posix() for k in range(10)]


def test_without_a_cut_list_every_camera_has_a_track(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    folder = take.export(tmp_path / "out", to=("otio",))
    timeline = otio.adapters.read_from_file(str(folder / "shot.otio"))
    assert [[clip.name for clip in track] for track in timeline.tracks] == [["chase"]]
    assert timeline.duration().value == 24


# ---------------------------------------------------------------- timelines as cut lists

SHOT = """
[shot]
schema = 1
name = "edit"
fps = {fps}
end_frame = 1048
[[vehicle]]
name = "handle"
asset = "tumbler"
[vehicle.motion]
method = "integrate"
duration = 2.0
step = 0.041666666666666664
start = {{ spin = [63, 5, 41] }}
[[camera]]
name = "wide"
rig = "static"
position = [9, 0, 3]
[[camera]]
name = "close"
[render]
cuts = "edit.otio"
"""


def edit(path, *pieces, rate=24, tracks=1, gap=False):
    """Save a timeline; ``pieces``: name, first source frame, number of frames."""
    timeline = otio.schema.Timeline("edit")
    for k in range(tracks):
        track = otio.schema.Track(kind=otio.schema.TrackKind.Video)
        for name, begin, count in pieces if k == 0 else [("no such camera", 5, 9)]:
            shown = otio.opentime.TimeRange(
                otio.opentime.RationalTime(begin, rate), otio.opentime.RationalTime(count, rate)
            )
            track.append(otio.schema.Clip(name, source_range=shown))
            if gap:
                track.append(otio.schema.Gap(duration=shown.duration))
        track.enabled = k == 0
        timeline.tracks.append(track)
    otio.adapters.write_to_file(timeline, str(path))


def shot_in(folder, fps="24"):
    from vehsim.shot import Shot

    (folder / "edit.toml").write_text(SHOT.format(fps=fps))
    return Shot.load(folder / "edit.toml")


def test_an_edited_timeline_is_the_cut_list(tmp_path):
    """A trimmed cut, a blade without a cut and a track that is switched off; in the stage, the camera follows it."""
    from pxr import Usd

    edit(
        tmp_path / "edit.otio",
        ("wide", 1001, 13),
        ("close", 1014, 6),
        ("close", 1020, 11),
        ("wide", 1031, 18),
        tracks=2,
    )
    shot = shot_in(tmp_path)
    assert shot.check() == []
    assert shot.cuts == ((1001, "wide"), (1014, "close"), (1031, "wide"))
    folder = shot.solve().export(tmp_path / "out", to=("usd", "otio"))
    stage = Usd.Stage.Open(str(folder / "edit.usda"))  # a prim is valid only while its stage is held
    camera = stage.GetPrimAtPath("/edit/cameras/cut")
    assert list(camera.GetAttribute("vehsim:cut:frames").Get()) == [1001, 1014, 1031]
    assert list(camera.GetAttribute("vehsim:cut:cameras").Get()) == ["wide", "close", "wide"]
    (folder / "edit.otio").replace(tmp_path / "edit.otio")
    assert shot_in(tmp_path).cuts == shot.cuts, "what is exported reads as the same cut list"


def test_rates_of_23_976_are_those_of_the_shot(tmp_path):
    edit(tmp_path / "edit.otio", ("wide", 1001, 13), ("close", 1014, 35), rate=23.976)
    assert shot_in(tmp_path, '"24000/1001"').cuts == ((1001, "wide"), (1014, "close"))


@pytest.mark.parametrize(
    ("pieces", "said"),
    [
        ([("wide", 1001, 13), ("close", 1020, 29)], "leaves out frames 1014 to 1019"),
        ([("wide", 1001, 13), ("close", 1010, 39)], "repeats frames 1010 to 1013"),
    ],
)
def test_frames_that_an_edit_repeats_or_leaves_out_are_named(tmp_path, pieces, said):
    edit(tmp_path / "edit.otio", *pieces)
    with pytest.warns(UserWarning, match=said):
        assert shot_in(tmp_path).cuts == ((1001, "wide"), (pieces[1][1], "close"))


@pytest.mark.parametrize(
    ("pieces", "how", "said"),
    [
        ([("wide", 1001, 13), ("clos", 1014, 35)], {}, "no such camera.*did you mean 'close'"),
        ([("wide", 1020, 13), ("close", 1010, 3)], {}, "not after the cut before it, at 1020"),
        ([("wide", 1001, 13)], {"gap": True}, "a gap, 13 frames after its start"),
        ([("wide", 1001, 13)], {"rate": 25}, r"starts at frame 960.96 .* of 24 fps"),
        ([], {}, "no video track"),
    ],
)
def test_a_timeline_that_is_no_cut_list_is_refused(tmp_path, recwarn, pieces, how, said):
    edit(tmp_path / "edit.otio", *pieces, **how)
    (problem,) = shot_in(tmp_path).check()
    assert problem.key == "render.cuts"
    assert re.search(said, str(problem))


def test_a_file_that_is_no_timeline_is_refused(tmp_path):
    (tmp_path / "edit.otio").write_text('{"a": 1')
    (problem,) = shot_in(tmp_path).check()
    assert problem.key == "render.cuts" and "cannot be read" in problem.message
