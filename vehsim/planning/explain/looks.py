"""Where a heading that follows a place turns faster than a character lets the vehicle turn."""

from __future__ import annotations

import math

import numpy as np

from vehsim.clip.clip import Clip
from vehsim.planning.request.request import Request


def fastest_look(clip: Clip, request: Request) -> str:
    """The look that turns the heading fastest on a finished motion, if it exceeds the turn rate of the request's
    character, as a clause of a message; else nothing."""
    allowed = request.traits.without(request.limits).get("turn_rate", math.inf)
    frames, fps = np.arange(clip.start_frame, math.floor(clip.end_frame) + 1), float(clip.fps)
    where = clip.at(np.minimum((frames - clip.start_frame) / fps, clip.times[-1])).positions
    fastest, found = allowed, ""
    for term in request.constraints:
        if term.aim is None:
            continue
        first, last = term.frames or (frames[0], frames[-1])
        looks = np.flatnonzero((frames >= first) & (frames <= last))
        if len(looks) < 2:
            continue
        x, y = (np.asarray(term.aim[0])[:2] - where[looks, :2]).T
        rates = np.abs(np.gradient(np.unwrap(np.arctan2(y, x)))) * fps
        if rates.max() > fastest:
            fastest, at = float(rates.max()), frames[looks[rates.argmax()]]
            point = ", ".join(f"{value:g}" for value in term.aim[0])
            found = (
                f"{term.title} ({point}) turns the heading by {math.degrees(fastest):.3g} deg/s at frame {at:.0f}, "
                f"{math.degrees(allowed):.3g} allowed"
            )
    return found
