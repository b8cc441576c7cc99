"""The motion that a problem's variables describe: at its knots, as a clip, and as its controls execute it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.clip.clip import Clip
from vehsim.integrators.record import build_clip, measured_along
from vehsim.planning.certificates import Executed, executed
from vehsim.planning.problem.layout import Layout
from vehsim.planning.problem.transcription import Transcription
from vehsim.planning.request.request import Request
from vehsim.world.placing import placed

Array = NDArray[np.float64]

CARRIED = 1e-9
"""Duration for which controls are executed in each segment of a hold on the ground, s."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A discretised motion: variables ``x`` (size,) of a ``layout``."""

    request: Request
    transcription: Transcription
    layout: Layout
    x: Array

    @property
    def lengths(self) -> Array:
        """Duration of a segment, s, per leg (legs,)."""
        return self.x[self.layout.lengths]

    def knots(self) -> tuple[Array, Array, Array, Array, Array]:
        """Configurations, joints, momenta and controls (n, ...), SI, at the knots, and the durations of the segments,
        s."""
        layout, every = self.layout, np.arange(self.layout.segments + 1)
        cuts = np.cumsum([0, *self.transcription.sizes[:3]])
        state = self.x[layout.knot(every)]
        g, r, pi = (np.ascontiguousarray(state[a:b].T) for a, b in pairwise(cuts))
        c = np.ascontiguousarray((self.x[layout.control(every)] * self.transcription.control_scale[:, None]).T)
        return g, r, pi * self.transcription.momentum_scale, c, np.repeat(self.lengths, layout.legs)

    def poses(self) -> tuple[Array, Array]:
        """Position (n, 2) m and heading (n,) rad at the knots of a driving vehicle's root."""
        g = self.knots()[0]
        c, s = np.cos(g[:, 0]), np.sin(g[:, 0])
        x, y = self.request.vehicle.origin[:2]
        return g[:, 1:3] - np.column_stack([c * x - s * y, s * x + c * y]), g[:, 0]

    def seconds(self) -> Array:
        """Times of the knots (n,), s since frame 0."""
        steps = np.repeat(self.lengths, self.layout.legs)
        start = float(self.request.marks[0].frame) / float(self.request.fps)
        return np.asarray(start + np.concatenate([[0.0], np.cumsum(steps)]))

    def mark_frames(self) -> list[float]:
        """The frame of every mark, with holds as two marks; whole once free marks are moved to frames."""
        frames = self.seconds()[self.layout.mark_knots] * float(self.request.fps)
        return [float(round(frame)) if abs(frame - round(frame)) < 1e-6 else float(frame) for frame in frames]

    def stretched(self, lengths: Array) -> Array:
        """Variables (size,) of the same motion with other segment ``lengths`` (legs,) s.

        Velocities and momenta scale inversely with the lengths.
        """
        x, layout, ratio = self.x.copy(), self.layout, self.lengths / lengths
        per_segment = np.repeat(ratio, layout.legs)
        momenta = layout.knot(np.arange(layout.knots))[sum(self.transcription.sizes[:2]) :]
        x[momenta] *= np.append(per_segment, per_segment[-1])
        x[layout.velocity(np.arange(layout.segments))] *= per_segment
        x[layout.lengths] = lengths
        return x

    def run_controls(self) -> Executed:
        """How far the executed controls lead from the plan."""
        g, r, pi, c, steps = self.knots()
        marks = self.request.marks
        carried = np.array([mark.hold > 0 and mark.on_ground for mark in marks[:-1]])
        # the ground carries what stands on it, so its controls would lead elsewhere
        steps = np.where(np.repeat(carried, self.layout.legs), CARRIED, steps)
        return executed(self.transcription.mechanics, g, r, pi, c, steps, self.request.wind)

    @cached_property
    def clip(self) -> Clip:
        """The clip of the planned vehicle, starting at 0 s, or within its first frame."""
        g, r, pi, c, steps = self.knots()
        start = math.floor(frame := float(self.request.marks[0].frame))
        times = (frame - start) / float(self.request.fps) + np.concatenate([[0.0], np.cumsum(steps)])
        anchor = np.zeros(3)
        if self.request.vehicle.group.dim == 3:
            anchor[2] = float(np.asarray(self.request.marks[0].position)[2])
        mechanics, first = self.transcription.mechanics, {"fps": self.request.fps, "start_frame": start}
        return measured_along(mechanics, build_clip(mechanics, times, g, r, pi, c, anchor, **first))


def drawn(trajectory: Trajectory, world: Any) -> Clip:
    """The motion on whole frames of the given vehicle, with wheels on the ground or its hull on the water of ``world``,
    within a millimetre or two."""
    clip = replace(trajectory.clip, vehicle=trajectory.request.vehicle)
    count = int(np.floor((clip.times[-1] - clip.times[0]) * float(clip.fps) + 1e-6)) + 1
    whole = np.minimum(clip.times[0] + np.arange(count) / float(clip.fps), clip.times[-1])
    return placed(clip.at(whole), world, samples=1, coarse=True)


def exported(clip: Clip, request: Request) -> Clip:
    """A clip of the given vehicle, with its wheels on the terrain or its hull on the water."""
    return placed(replace(clip, vehicle=request.vehicle), request.world, loop=request.loop)
