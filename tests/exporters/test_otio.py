"""The cut list read back by OpenTimelineIO."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import pytest

from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera

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


def test_without_a_cut_list_every_camera_has_a_track(tmp_path, toys, make_take):
    take = make_take(toys.clip(toys.asset(tmp_path / "in" / "toy.usda")))
    folder = take.export(tmp_path / "out", to=("otio",))
    timeline = otio.adapters.read_from_file(str(folder / "shot.otio"))
    assert [[clip.name for clip in track] for track in timeline.tracks] == [["chase"]]
    assert timeline.duration().value == 24
