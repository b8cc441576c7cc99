"""Pictures of manoeuvres: trajectories seen from above, and phase portraits (SIN's Lissajous figures)."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vehsim.sinusoids.manoeuvres.families import bodies
from vehsim.sinusoids.steering import Steering
from vehsim.sinusoids.system import Array

PAPER, INK, FAINT, GRID = (250, 249, 246), (38, 42, 50), (186, 184, 178), (229, 227, 221)
STAGES = ((42, 98, 163), (201, 94, 30), (45, 133, 84), (142, 68, 149), (176, 141, 22), (196, 58, 88))
"""One colour per stage, repeating."""
FINE = 2
"""Factor by which pictures are drawn larger and then reduced, for smooth lines."""


def paint(
    steerings: Sequence[Steering],
    path: str | Path,
    *,
    footprints: Sequence[Array] = (),
    obstacles: Sequence[tuple[float, float, float, float, float] | Array] = (),
    columns: int = 0,
    size: tuple[int, int] = (640, 400),
) -> Path:
    """Every steering from above, one panel each: the axles' paths with one colour per stage, and outlines of bodies at
    intervals.

    ``footprints``: corner points (k, 2) m of each body, in order around it; ``obstacles`` (x, y, heading rad, length,
    width) m, or corners (k, 2); ``size`` of a panel in pixels.
    """
    panels = []
    for steering in steerings:
        poses = bodies(steering)
        bounds = _bounds(np.concatenate([_outlines(poses[::20], footprints), *(_corners(o) for o in obstacles)]))
        panel = _Panel(size, bounds, equal=True, title=steering.label or steering.system.name, names=("x [m]", "y [m]"))
        for box in obstacles:
            panel.polygon(_corners(box), fill=FAINT)
        _paint_bodies(panel, steering, poses, footprints)
        panels.append(panel)
    return _save(panels, path, columns or min(3, len(panels)))


def portraits(
    steering: Steering, pairs: Sequence[tuple[str, str]], path: str | Path, columns: int = 2, inputs: bool = True
) -> Path:
    """States against states, one colour per stage, and the inputs over time: SIN Fig. 4 for any steering."""
    panels = []
    names = list(steering.system.states)
    for across, up in pairs:
        line = steering.states[:, [names.index(across), names.index(up)]]
        panel = _Panel((480, 360), _bounds(line), equal=False, title=f"{up} over {across}", names=(across, up))
        for k, part in _parts(steering):
            panel.line(line[part], STAGES[k % len(STAGES)], 2)
        panels.append(panel)
    if inputs:
        panels.append(_inputs(steering))
    return _save(panels, path, columns)


def _inputs(steering: Steering) -> _Panel:
    """Inputs over time, named in their colours; stage by stage, because they may jump between stages."""
    parts = []
    for begin, stage in zip(steering.knots, steering.stages, strict=False):
        t = np.linspace(0, stage.duration, 200 * stage.cycles + 1)
        parts.append(np.column_stack([begin + t, stage.inputs(t)]))
    rows = np.concatenate(parts)
    bounds = _bounds(np.column_stack([np.tile(rows[:, 0], steering.system.m), rows[:, 1:].T.ravel()]))
    panel = _Panel((480, 360), bounds, equal=False, title="inputs", names=("t [s]", ""))
    for j, name in enumerate(steering.system.inputs):
        colour = STAGES[j % len(STAGES)]
        for part in parts:
            panel.line(part[:, [0, j + 1]], colour, 2)
        panel.label(name, j, colour)
    return panel


@dataclass(eq=False)
class _Panel:
    """A drawing area with axes; world coordinates in, pixels out."""

    size: tuple[int, int]
    bounds: tuple[Array, Array]
    equal: bool
    title: str
    names: tuple[str, str]

    def __post_init__(self) -> None:
        from PIL import Image, ImageDraw, ImageFont

        w, h = (FINE * s for s in self.size)
        self.image = Image.new("RGB", (w, h), PAPER)
        self.draw = ImageDraw.Draw(self.image)
        self.font = ImageFont.load_default(12 * FINE)
        left, right, top, bottom = (FINE * p for p in (46, 12, 28, 34))
        low, high = self.bounds
        room = np.array([w - left - right, h - top - bottom], float)
        scale = room / (high - low)
        if self.equal:
            scale[:] = scale.min()
        middle = np.array([left, top]) + room / 2
        self._scale, self._middle, self._centre = scale * [1, -1], middle, (low + high) / 2
        self._frame = (left, top, w - right, h - bottom)
        self._axes()

    def pixels(self, points: Array) -> list[tuple[float, float]]:
        return [tuple(p) for p in (np.asarray(points) - self._centre) * self._scale + self._middle]

    def line(self, points: Array, colour: tuple[int, int, int], width: float) -> None:
        self.draw.line(self.pixels(points), fill=colour, width=int(width * FINE), joint="curve")

    def polygon(self, points: Array, fill: Any = None, outline: Any = None, width: int = 1) -> None:
        self.draw.polygon(self.pixels(points), fill=fill, outline=outline, width=width * FINE)

    def dot(self, point: Array, colour: tuple[int, int, int], radius: float = 3.5) -> None:
        ((x, y),) = self.pixels(point[None])
        r = radius * FINE
        self.draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)

    def label(self, text: str, row: int, colour: tuple[int, int, int]) -> None:
        left, top = self._frame[:2]
        self.draw.text((left + 4 * FINE, top + (4 + 15 * row) * FINE), text, colour, self.font, anchor="lt")

    def _axes(self) -> None:
        left, top, right, bottom = self._frame
        low = (np.array([left, bottom]) - self._middle) / self._scale + self._centre
        high = (np.array([right, top]) - self._middle) / self._scale + self._centre
        for axis in (0, 1):
            for tick in _ticks(low[axis], high[axis]):
                at = np.array([self._centre, self._centre])
                at[:, axis] = tick
                (px, py), _ = self.pixels(at)
                if axis == 0:
                    self.draw.line((px, top, px, bottom), fill=GRID, width=FINE)
                    self.draw.text((px, bottom + 4 * FINE), f"{tick:g}", INK, self.font, anchor="mt")
                else:
                    self.draw.line((left, py, right, py), fill=GRID, width=FINE)
                    self.draw.text((left - 5 * FINE, py), f"{tick:g}", INK, self.font, anchor="rm")
        self.draw.rectangle(self._frame, outline=FAINT, width=FINE)
        self.draw.text((left, top - 8 * FINE), self.title, INK, self.font, anchor="ls")
        self.draw.text((right, bottom + 31 * FINE), self.names[0], INK, self.font, anchor="rs")
        self.label(self.names[1], 0, INK)


def _paint_bodies(panel: _Panel, steering: Steering, poses: Array, footprints: Sequence[Array]) -> None:
    for body in range(poses.shape[1]):
        for k, part in _parts(steering):
            colour = STAGES[k % len(STAGES)]
            panel.line(poses[part, body, :2], colour if body == 0 else _faded(colour, 0.45), 2 if body == 0 else 1.5)
    stops = [0, *(part.stop - 1 for _, part in _parts(steering))]
    for row in np.unique(np.concatenate([np.linspace(0, len(poses) - 1, 9).astype(int), stops])):
        for body, points in enumerate(footprints):
            strong = row in (0, len(poses) - 1)
            corners = _placed(points, poses[row, body])
            panel.polygon(corners, outline=INK if strong else FAINT, width=2 if strong else 1)
    panel.dot(poses[0, 0, :2], INK)
    panel.dot(poses[-1, 0, :2], STAGES[1])


def _parts(steering: Steering) -> list[tuple[int, slice]]:
    """The samples of every stage, with shared ends."""
    cuts = np.searchsorted(steering.times, steering.knots - 1e-12)
    return [(k, slice(int(a), int(b) + 1)) for k, (a, b) in enumerate(itertools.pairwise(cuts))]


def _outlines(poses: Array, footprints: Sequence[Array]) -> Array:
    if not len(footprints):
        return poses[:, :, :2].reshape(-1, 2)
    rows = [_placed(points, pose) for row in poses for points, pose in zip(footprints, row, strict=True)]
    return np.concatenate(rows)


def _placed(points: Array, pose: Array) -> Array:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(points) @ np.array([[c, s], [-s, c]]) + pose[:2]


def _corners(box: tuple[float, float, float, float, float] | Array) -> Array:
    if isinstance(box, np.ndarray):
        return box
    x, y, heading, length, width = box
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length / 2, width / 2]
    return _placed(corners, np.array([x, y, heading]))


def _bounds(points: Array) -> tuple[Array, Array]:
    low, high = points.min(axis=0), points.max(axis=0)
    slack = 0.06 * np.maximum(high - low, 1e-3 + 0.02 * (high - low).max())
    return low - slack, high + slack


def _ticks(low: float, high: float) -> Array:
    step = 10.0 ** np.floor(np.log10(high - low))
    step *= next(f for f in (1.0, 0.5, 0.2) if (high - low) / (f * step) >= 3 or f == 0.2)
    return np.round(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step, 10) + 0.0  # no -0


def _faded(colour: tuple[int, int, int], share: float) -> tuple[int, int, int]:
    r, g, b = (int(c * share + p * (1 - share)) for c, p in zip(colour, PAPER, strict=True))
    return r, g, b


def _save(panels: Sequence[_Panel], path: str | Path, columns: int) -> Path:
    from PIL import Image

    path = Path(path)
    rows = -(-len(panels) // columns)
    w, h = panels[0].image.size
    sheet = Image.new("RGB", (w * min(columns, len(panels)), h * rows), PAPER)
    for i, panel in enumerate(panels):
        sheet.paste(panel.image, (w * (i % columns), h * (i // columns)))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.resize((sheet.width // FINE, sheet.height // FINE), Image.Resampling.LANCZOS).save(path)
    return path
