"""The figures exporter: a motion as SVG for a paper or a review: from above, from the side, and as curves.

The style is that of SYM Figs. 2-5 and LIE Figs. 10 and 12. This module selects and draws data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.cameras.framing import vehicle_outline
from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.exporters.pictures.strobe import strobe_frames
from vehsim.lie.quaternions import tilt_of
from vehsim.runtime.progress import Progress
from vehsim.world.obstacles.plane import convex_hull

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]

COLOURS = ("#1f5fa8", "#c8442c", "#2b8a57", "#8a4fb0", "#c98a1b", "#3aa0a8")
INK, GRID, ROCK, BODY = "#222", "#d8dce0", "#b9a58c", "#8d99a6"
WIDTH, MOST, LEFT, RIGHT, TOP, BOTTOM = 900, 700, 66, 120, 40, 48
"""px: a figure's width, greatest height, and margins."""
LEVELS = 12
"""Contour lines of a terrain."""
WINDS = 8
"""Wind arrows along a path."""


def write_figures(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``figures/<vehicle>.{top,side,pose,controls}.svg``; returns every file written."""
    written = []
    for k, (name, clip) in enumerate(take.clips.items()):
        progress(f"figures: {name}", k / len(take.clips))
        pages = {
            "top": _top(take, name, clip),
            "side": _side(take, name, clip),
            "pose": _pose(name, clip),
            "controls": _controls(name, clip),
        }
        for kind, svg in pages.items():
            if svg is not None:
                path = folder / "figures" / f"{name}.{kind}.svg"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(svg, encoding="utf-8")
                written.append(path)
    return written


# ------------------------------------------------------------ views


def _top(take: Take, name: str, clip: Clip) -> str:
    """From above: contours, obstacles, the path, poses, marks and the wind."""
    shown = _poses(take, clip, (0, 1))
    parts = [part for obstacle in take.world.obstacles for part in getattr(obstacle, "parts", ())]
    outlines = [part.outline() if hasattr(part, "outline") else part for part in parts]
    data = np.vstack([*shown, clip.positions[:, :2], *outlines])
    canvas = _Canvas(f"{name} from above", "x [m]", "y [m]", data, equal=True)
    _contours(canvas, take)
    for outline in outlines:
        canvas.polygon(outline, ROCK, ROCK)  # an edge in the obstacle's colour hides the seams between its parts
    for other, motion in take.clips.items():
        if other != name:
            for outline in _poses(take, motion, (0, 1)):
                canvas.polygon(outline, ROCK, INK, 0.6 if np.ptp(motion.positions, axis=0).max() < 0.01 else 0.12)
    return _view(canvas, take, name, clip, (0, 1), shown)


def _side(take: Take, name: str, clip: Clip) -> str | None:
    """From the side, along the horizontal axis of greatest motion; none for motion on level ground."""
    if np.ptp(clip.positions[:, 2]) < 0.05:
        return None
    axis = int(np.argmax(np.ptp(clip.positions[:, :2], axis=0)))
    shown = _poses(take, clip, (axis, 2))
    data = np.vstack([*shown, clip.positions[:, [axis, 2]]])
    if take.world.terrain is not None:
        below = np.column_stack([clip.positions[:, axis], take.world.height(clip.positions[:, :2])])
        data = np.vstack([data, below])
    hulls = [hull[:, [axis, 2]] for obstacle in take.world.standing for hull in obstacle.hulls]
    data = np.vstack([data, *hulls])
    canvas = _Canvas(f"{name} from the side", f"{'xy'[axis]} [m]", "z [m]", data, equal=True)
    for hull in hulls:
        canvas.polygon(convex_hull(hull), ROCK, "none")
    if take.world.terrain is not None:
        canvas.line(below, ROCK, 2)
        canvas.note("ground below", ROCK)
    return _view(canvas, take, name, clip, (axis, 2), shown)


def _view(canvas: _Canvas, take: Take, name: str, clip: Clip, axes: tuple[int, int], shown: Sequence[Array]) -> str:
    for outline in shown:
        canvas.polygon(outline, BODY, INK, 0.35)
    canvas.line(clip.positions[:, axes], COLOURS[0], 2)
    canvas.note("path of the root", COLOURS[0])
    marks = [mark["position"] for mark in take.report.get("marks", {}).get(name, []) if mark.get("position")]
    for mark in marks:
        canvas.cross(np.array(mark)[list(axes)], COLOURS[1])
    if marks:
        canvas.note("marks", COLOURS[1])
    wind = take.world.wind[list(axes)]
    if np.linalg.norm(wind) > 0 and clip.vehicle.feels_wind:
        for k in np.linspace(0, len(clip) - 1, WINDS).astype(int):
            canvas.arrow(clip.positions[k, axes], wind, COLOURS[5])
        canvas.note(f"wind, {np.linalg.norm(take.world.wind):.3g} m/s", COLOURS[5])
    return canvas.finish()


def _poses(take: Take, clip: Clip, axes: tuple[int, int]) -> list[Array]:
    """Outlines (k, 2) of the vehicle, projected along the third axis, at the strobe's frames."""
    from scipy.spatial import ConvexHull

    frames = np.array(strobe_frames(clip, take.frames), float)
    motion = clip.at((frames - clip.start_frame) / float(clip.fps))
    outline = vehicle_outline(clip.vehicle)
    out = []
    for T in motion.matrices():
        flat = (outline @ T[:3, :3].T + T[:3, 3])[:, list(axes)]
        out.append(flat[ConvexHull(flat).vertices])
    return out


def _contours(canvas: _Canvas, take: Take) -> None:
    """Contour lines, by marching over a grid's triangles."""
    if take.world.terrain is None:
        return
    low, high = canvas.window
    x, y = (np.linspace(low[k], high[k], 90) for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
    z = take.world.height(grid.reshape(-1, 2)).reshape(len(x), len(y))
    if np.ptp(z) < 0.1:
        return
    corners = np.concatenate([
        np.stack([part[:-1, :-1], part[1:, :-1], part[1:, 1:]], axis=2).reshape(-1, 3, part.shape[-1])
        for part in (np.dstack([grid, z]), np.dstack([grid, z]).transpose(1, 0, 2))
    ])  # fmt: skip
    for level in np.linspace(z.min(), z.max(), LEVELS + 2)[1:-1]:
        for triangle in corners[(corners[..., 2].min(axis=1) < level) & (corners[..., 2].max(axis=1) >= level)]:
            cut = []
            for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
                if (a[2] < level) != (b[2] < level):
                    cut.append(a[:2] + (level - a[2]) / (b[2] - a[2]) * (b[:2] - a[:2]))
            canvas.line(np.array(cut), ROCK, 0.7)
    canvas.note(f"contours {np.ptp(z) / (LEVELS + 1):.2g} m apart", ROCK)


# ------------------------------------------------------------ curves


def _pose(name: str, clip: Clip) -> str:
    """Position, attitude and speed over time, as in SYM Fig. 4."""
    yaw, pitch, roll = np.unwrap(tilt_of(clip.orientations), axis=1)
    x, y, z = (clip.positions - clip.positions[0]).T
    planar = clip.twists.shape[1] == 3
    turns = {"heading": yaw} if planar else {"heading": yaw, "pitch": pitch, "roll": roll}
    places = {"x": x, "y": y} if planar else {"x": x, "y": y, "z": z}
    speed = np.linalg.norm(clip.twists[:, 1:3] if planar else clip.twists[:, 3:6], axis=1)
    panels = [
        ("position from the start [m]", places),
        ("attitude [deg]", _degrees(turns)),
        ("speed [m/s]", {"": speed}),
    ]
    if clip.vehicle.joints:
        joints = dict(zip(clip.vehicle.joints, clip.joints.T, strict=True))
        bounded = {joint: values for joint, values in joints.items() if joint in clip.vehicle.joint_limits}
        panels.append(("joints", bounded or joints))
    return _panels(f"{name}: pose", clip.times, panels)


def _degrees(angles: Mapping[str, Array]) -> dict[str, Array]:
    return {key: np.degrees(value) for key, value in angles.items()}


def _controls(name: str, clip: Clip) -> str | None:
    """One panel per control, with its unit and its bounds."""
    panels = []
    for control, values in zip(clip.vehicle.controls, clip.controls.T, strict=True):
        curves = {"": values}
        reach = 0.98 * np.abs(values).max(initial=0.0)
        for bound in (control.lower, control.upper):
            if np.isfinite(bound) and reach >= 0.8 * abs(bound) > 0 and bound * values[np.abs(values).argmax()] > 0:
                curves["bound"] = np.full(len(values), bound)
        panels.append((f"{control.name} [{control.unit}]" if control.unit else control.name, curves))
    return _panels(f"{name}: controls", clip.times, panels) if panels else None


def _panels(title: str, times: Array, panels: Sequence[tuple[str, Mapping[str, Array]]]) -> str:
    """Graphs over time, one below the other."""
    height, apart = 150, 34
    out, total = [], TOP + len(panels) * (height + apart) + 24
    for k, (label, curves) in enumerate(panels):
        data = np.vstack([np.column_stack([times, values]) for values in curves.values()])
        canvas = _Canvas(label, "t [s]" if k == len(panels) - 1 else "", "", data, height=height + TOP + 10, small=True)
        for i, (curve, values) in enumerate(curves.items()):
            canvas.line(np.column_stack([times, values]), COLOURS[i % len(COLOURS)], 1.8)
            if curve:
                canvas.note(curve, COLOURS[i % len(COLOURS)])
        out.append(f'<g transform="translate(0 {k * (height + apart) + 10})">{canvas.body()}</g>')
    return _page(WIDTH, total, [_text(LEFT, 24, title, 16), *out])


# ------------------------------------------------------------ drawing


class _Canvas:
    """A graph: data (n, 2) to pixels, a grid with round numbers, and a legend at the right."""

    def __init__(
        self, title: str, x: str, y: str, data: Array, equal: bool = False, height: int = 420, small: bool = False
    ) -> None:
        low, high = data.min(axis=0), data.max(axis=0)
        room = np.maximum(0.06 * (high - low), 1e-9)
        if equal:
            room = np.full(2, max(1.0, 0.05 * float((high - low).max())))
        elif not small:
            room[0] = 0.0
        if small:
            room = np.array([0.0, max(0.08 * float(high[1] - low[1]), 1e-6)])
        self.low, self.high = low - room, high + room
        wide = WIDTH - LEFT - RIGHT
        if equal:
            height = (
                int(np.clip(wide * (self.high - self.low)[1] / (self.high - self.low)[0], 120, MOST)) + TOP + BOTTOM
            )
            scale = min(wide / (self.high - self.low)[0], (height - TOP - BOTTOM) / (self.high - self.low)[1])
            slack = np.array([wide, height - TOP - BOTTOM]) / scale - (self.high - self.low)
            self.low, self.high = self.low - slack / 2, self.high + slack / 2
        self.height = height
        self.title, self.names = title, (x, y)
        self.shapes: list[str] = []
        self.notes: list[tuple[str, str]] = []

    @property
    def window(self) -> tuple[Array, Array]:
        """The corners (2,), (2,) of the shown region."""
        return self.low, self.high

    def place(self, points: Array) -> Array:
        share = (np.asarray(points, float) - self.low) / (self.high - self.low)
        wide, tall = WIDTH - LEFT - RIGHT, self.height - TOP - BOTTOM
        return np.stack([LEFT + share[..., 0] * wide, TOP + (1 - share[..., 1]) * tall], axis=-1)

    def line(self, points: Array, colour: str, width: float) -> None:
        self.shapes.append(
            f'<polyline points="{_points(self.place(points))}" fill="none" stroke="{colour}" stroke-width="{width}"/>'
        )

    def polygon(self, points: Array, fill: str, stroke: str, opacity: float = 1.0) -> None:
        self.shapes.append(
            f'<polygon points="{_points(self.place(points))}" fill="{fill}" fill-opacity="{opacity}" stroke="{stroke}" '
            'stroke-width="0.8"/>'
        )

    def cross(self, point: Array, colour: str) -> None:
        x, y = self.place(point)
        for s in (1, -1):
            self.shapes.append(_stroke(x - 6, y - 6 * s, x + 6, y + 6 * s, colour, 2.2))

    def arrow(self, point: Array, direction: Array, colour: str, length: float = 34.0) -> None:
        x, y = self.place(point)
        dx, dy = length * direction / np.linalg.norm(direction) * (1, -1)
        self.shapes.append(_stroke(x, y, x + dx, y + dy, colour, 1.8))
        for turn in (2.6, -2.6):
            c, s = np.cos(turn), np.sin(turn)
            ax, ay = 0.28 * (c * dx - s * dy), 0.28 * (s * dx + c * dy)
            self.shapes.append(_stroke(x + dx, y + dy, x + dx + ax, y + dy + ay, colour, 1.8))

    def note(self, text: str, colour: str) -> None:
        self.notes.append((text, colour))

    def body(self) -> str:
        tall = self.height - BOTTOM
        clip = f"clip-{_slug(self.title)}"
        out = [
            f'<clipPath id="{clip}"><rect x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" '
            f'height="{tall - TOP}"/></clipPath>',
            _text(LEFT, TOP - 10, self.title, 13),
        ]
        for value in _round_numbers(self.low[0], self.high[0], 8):
            x = self.place(np.array([value, self.low[1]]))[0]
            out.append(_stroke(x, TOP, x, tall, GRID, 1))
            if self.names[0]:
                out.append(_text(x, tall + 16, f"{value:g}", 11, anchor="middle"))
        for value in _round_numbers(self.low[1], self.high[1], max(4, self.height // 60)):
            y = self.place(np.array([self.low[0], value]))[1]
            out += [_stroke(LEFT, y, WIDTH - RIGHT, y, GRID, 1), _text(LEFT - 6, y + 4, f"{value:g}", 11, anchor="end")]
        out.append(_text((LEFT + WIDTH - RIGHT) / 2, tall + 34, self.names[0], 12, anchor="middle"))
        out.append(_text(LEFT - 44, (TOP + tall) / 2, self.names[1], 12, anchor="middle", turned=True))
        out.append(f'<g clip-path="url(#{clip})">{"".join(self.shapes)}</g>')
        for i, (text, colour) in enumerate(self.notes):
            out.append(_text(WIDTH - RIGHT + 8, TOP + 12 + 17 * i, text, 11, colour))
        return "".join(out)

    def finish(self) -> str:
        return _page(WIDTH, self.height, [self.body()])


def _page(width: int, height: int, parts: Sequence[str]) -> str:
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif">'
    return "\n".join([head, '<rect width="100%" height="100%" fill="white"/>', *parts, "</svg>"]) + "\n"


def _points(places: Array) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in places)


def _stroke(x0: float, y0: float, x1: float, y1: float, colour: str, width: float) -> str:
    ends = f'x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"'
    return f'<line {ends} stroke="{colour}" stroke-width="{width}"/>'


def _text(
    x: float, y: float, words: str, size: int, colour: str = INK, anchor: str = "start", turned: bool = False
) -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}"'
    place += f' transform="rotate(-90 {x:.1f} {y:.1f})"' if turned else ""
    return f"<text {place}>{escape(words)}</text>"


def _round_numbers(low: float, high: float, count: int) -> Any:
    """Round numbers within a range, about ``count`` of them."""
    power = 10.0 ** np.floor(np.log10(max(high - low, 1e-12) / count))
    step = next(factor * power for factor in (1, 2, 5, 10) if (high - low) / (factor * power) <= count)
    return np.round(np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step, 12) + 0.0


def _slug(words: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in words)


exporter = Exporter(
    name="figures",
    suffixes=(".svg",),
    write=write_figures,
    makes="plots of paths, controls and other quantities, as SVG",
)
