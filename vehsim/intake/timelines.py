"""Read the cut list of an editor's timeline (OpenTimelineIO, an optional dependency)."""

from __future__ import annotations

import warnings
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

from vehsim.intake.foreign import reading, refuse
from vehsim.intake.reader import Answer, read_in_process

Cuts = tuple[tuple[int, str], ...]

SAME = 5e-4
"""Rates that differ by less, relatively, are the same: editors write 24000/1001 as 23.976 or 23.98."""
WHOLE = 1e-3
"""How far from a whole frame a cut may be."""


def read_cuts(path: Path, key: str, fps: Fraction) -> Cuts:
    """The first frame of each piece of the cut, at ``fps``, and the name of its clip.

    All cameras of a shot see the same motion, so a piece starts where its clip's *source* does. Warns where the edit
    repeats frames or leaves some out. Raises ``InputError``.
    """
    facts, _ = read_in_process(cuts, path, key, key, str(fps))
    return tuple((frame, name) for frame, name in facts)


def cuts(path: Path, key: str, fps: str) -> Answer:
    """What `read_cuts` returns. It runs in the reader process."""
    try:
        import opentimelineio as otio
    except ImportError:
        raise refuse(path, key, "needs OpenTimelineIO", "pip install 'vehsim[otio]'") from None

    with reading(path, key, "export the timeline again as .otio"):
        timeline = otio.adapters.read_from_file(str(path))
        if not isinstance(timeline, otio.schema.Timeline):
            raise refuse(path, key, f"a {type(timeline).__name__}, not a timeline", "export the timeline")
        tracks = [track for track in timeline.video_tracks() if track.enabled and len(track)]
        if not tracks:
            raise refuse(path, key, "no video track that is switched on", "put the cut on a video track")
        pieces = _pieces(path, key, otio.algorithms.flatten_stack(tracks), float(Fraction(fps)))
    for (_, end, name), (begin, _, after) in pairwise(pieces):
        if begin != end:
            said = f"leaves out frames {end} to {begin - 1}" if begin > end else f"repeats frames {begin} to {end - 1}"
            warnings.warn(
                f"{path}: {key}: between {name!r} and {after!r} the edit {said}; the motion does not jump: the cut is "
                f"at frame {begin}",
                stacklevel=2,
            )
    return [[begin, name] for begin, _, name in pieces], []


def _pieces(path: Path, key: str, track: Any, rate: float) -> list[tuple[int, int, str]]:
    """First frame, frame after the last, and name of each clip. Raises ``InputError`` for gaps and part frames."""
    import opentimelineio as otio

    pieces: list[tuple[int, int, str]] = []
    for item in track:
        if isinstance(item, otio.schema.Transition):
            warnings.warn(f"{path}: {key}: the transition {item.name!r} becomes a cut", stacklevel=3)
            continue
        if not isinstance(item, otio.schema.Clip):
            at = _frame(track.range_of_child(item).start_time, rate)
            kind = type(item).__name__.lower()
            raise refuse(path, key, f"a {kind}, {at:g} frames after its start", "fill the track with clips of cameras")
        shown = item.trimmed_range()
        ends = [_frame(time, rate) for time in (shown.start_time, shown.end_time_exclusive())]
        begin, end = (round(value) for value in ends)
        if max(abs(begin - ends[0]), abs(end - ends[1])) > WHOLE:
            message = f"clip {item.name!r} starts at frame {ends[0]:g} and ends at {ends[1]:g} of {rate:g} fps"
            raise refuse(path, key, message, "cut on whole frames of the shot's rate", shown.start_time.rate)
        if pieces and pieces[-1][2] == item.name and pieces[-1][1] == begin:
            pieces[-1] = pieces[-1][0], end, item.name  # a blade without a cut
        else:
            pieces.append((begin, end, item.name))
    return pieces


def _frame(time: Any, rate: float) -> float:
    """A time in frames of ``rate``."""
    return float(time.value if abs(time.rate / rate - 1.0) < SAME else time.rescaled_to(rate).value)
