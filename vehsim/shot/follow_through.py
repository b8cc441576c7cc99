"""A vehicle before and after its motion: it rests at the start and end poses, while its rotors continue to turn."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vehsim.vehicles import Nonholonomic

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

_STILL = 1e-2
"""A twist below this counts as standing still, rad/s and m/s."""

_STEADY = 0.1
"""Where a vehicle at rest accelerates by less than this, its controls are in balance, rad/s^2 and m/s^2."""

SUDDEN = 1 / 1024
"""A motion that is cut off stops within this, in frames: over a whole frame, the interpolant would overshoot."""


def rests(clip: Clip, index: int) -> bool:
    """Whether the vehicle stands still at that sample."""
    return bool(np.abs(clip.twists[index]).max(initial=0.0) < _STILL)


def _released(clip: Clip, index: int) -> Array | None:
    """The controls (c,) in balance of a vehicle that stands still on wheels from that end of its clip on, if it still
    accelerates there, as at the end of a stunt; otherwise None: those that it has there keep it in balance."""
    from vehsim.planning.trim import trim

    vehicle, inner = clip.vehicle, (1, -2)[index]
    if not (vehicle.rolls and len(vehicle.controls) and len(clip) > 1 and rests(clip, index)):
        return None
    change = (clip.twists[index] - clip.twists[inner]) / (clip.times[index] - clip.times[inner])
    return None if np.abs(change).max() < _STEADY else trim(vehicle, (0.0, 0.0, 0.0))


def hold(clip: Clip, first: int, last: int) -> Clip:
    """The clip on frames ``first`` to ``last`` at least; it stands still in frames that it did not cover.

    Where the vehicle rests in the air or on water (a hovering helicopter), channels given by a rate continue at that
    rate; otherwise they stop, as do channels that follow joints and controls. Brakes and engines of
    wheels are released. The height of a body on springs is removed, so that `place_on_terrain` lets it settle.
    """
    before = np.arange(first, clip.start_frame, dtype=float)
    after = np.arange(clip.end_frame + 1, last + 1, dtype=float)
    if not len(before) and not len(after):
        return clip
    if len(before) and not rests(clip, 0):
        before = np.append(before, clip.frames[0] - SUDDEN)
    if len(after) and not rests(clip, -1):
        after = np.insert(after, 0, clip.frames[-1] + SUDDEN)
    start = min(first, clip.start_frame)
    seconds = 1 / float(clip.fps)
    shift = (clip.start_frame - start) * seconds
    times = np.concatenate([(before - start) * seconds, clip.times + shift, (after - start) * seconds])

    def same(values: Array) -> Array:
        return np.concatenate([np.repeat(values[:1], len(before), 0), values, np.repeat(values[-1:], len(after), 0)])

    ends = ((0, slice(0, len(before))), (-1, slice(len(times) - len(after), None)))
    released = [(_released(clip, index), beyond) for index, beyond in ends]

    def controlled(values: Array, which: int | slice = slice(None)) -> Array:
        held = same(values)
        for controls, beyond in released:
            if controls is not None:
                held[beyond] = controls[which]
        return held

    def zero(values: Array) -> Array:
        width = values.shape[1:]
        return np.concatenate([np.zeros((len(before), *width)), values, np.zeros((len(after), *width))])

    def onwards(values: Array) -> tuple[Array, Array]:
        held, rates = same(values), np.zeros(len(times))
        for index, beyond in ends:
            if len(clip) > 1 and not isinstance(clip.vehicle, Nonholonomic) and rests(clip, index):
                a, b = (0, 1) if index == 0 else (-2, -1)
                rates[beyond] = (values[b] - values[a]) / (clip.times[b] - clip.times[a])
                held[beyond] += rates[beyond] * (times[beyond] - (clip.times[index] + shift))
        return held, rates

    sprung = ("heave", "pitch", "roll") if "heave" in clip.channels else ()
    laws = clip.vehicle.channels
    follows = {name for name in clip.channels if name in laws and laws[name].rate is None}
    channels = {
        name: same(values) if name in follows else onwards(values)[0]
        for name, values in clip.channels.items()
        if name not in sprung
    }
    return replace(
        clip,
        times=times,
        positions=same(clip.positions),
        orientations=same(clip.orientations),
        twists=zero(clip.twists),
        joints=same(clip.joints),
        joint_rates=zero(clip.joint_rates),
        controls=controlled(clip.controls),
        channels=channels,
        channel_rates={
            name: zero(rates) + onwards(clip.channels[name])[1] for name, rates in clip.channel_rates.items()
        },
        energy={name: same(values) for name, values in clip.energy.items()},
        commands={
            name: controlled(values, clip.vehicle.control_names.index(name)) for name, values in clip.commands.items()
        },
        start_frame=start,
    )
