"""Log-log line plots as SVG, so that the benchmark needs no plotting library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

_COLOURS = [
    "#1f5fa8",
    "#c8442c",
    "#2b8a57",
    "#8a4fb0",
    "#c98a1b",
    "#3aa0a8",
    "#7a5a43",
    "#d0609a",
    "#5a6470",
    "#93a82b",
    "#111111",
    "#e08f8f",
    "#3fbf3f",
    "#3a3ad8",
]
_WIDTH, _HEIGHT, _LEFT, _BOTTOM, _RIGHT, _TOP = 640, 420, 70, 50, 170, 40


def loglog(
    path: Path, title: str, x_name: str, y_name: str, lines: Mapping[str, Sequence[tuple[float, float]]]
) -> None:
    """Write ``lines`` name -> [(x, y)] as an SVG; points that are not finite and positive break a line."""
    points = [(x, y) for line in lines.values() for x, y in line if np.isfinite(y) and y > 0]
    x0, x1 = _decades([x for x, _ in points])
    y0, y1 = _decades([y for _, y in points])

    def place(x: float, y: float) -> tuple[float, float]:
        across = (np.log10(x) - x0) / (x1 - x0) * (_WIDTH - _LEFT - _RIGHT) + _LEFT
        up = (np.log10(y) - y0) / (y1 - y0) * (_HEIGHT - _TOP - _BOTTOM) + _BOTTOM
        return float(across), float(_HEIGHT - up)

    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{_WIDTH}" height="{_HEIGHT}" font-family="sans-serif">']
    out += ['<rect width="100%" height="100%" fill="white"/>', _text(_LEFT, 24, title, 15)]
    for power in range(int(x0), int(x1) + 1):
        x, _ = place(10.0**power, 10.0**y0)
        out += [_line(x, _TOP, x, _HEIGHT - _BOTTOM), _text(x - 12, _HEIGHT - _BOTTOM + 18, f"1e{power}", 11)]
    for power in range(int(y0), int(y1) + 1):
        _, y = place(10.0**x0, 10.0**power)
        out += [_line(_LEFT, y, _WIDTH - _RIGHT, y), _text(_LEFT - 42, y + 4, f"1e{power}", 11)]
    out += [_text(_LEFT + 120, _HEIGHT - 10, x_name, 12), _text(6, _TOP - 8, y_name, 12)]
    for i, (name, line) in enumerate(lines.items()):
        colour = _COLOURS[i % len(_COLOURS)]
        drawn = [place(x, y) for x, y in line if np.isfinite(y) and y > 0]
        corners = " ".join(f"{x:.1f},{y:.1f}" for x, y in drawn)
        out.append(f'<polyline points="{corners}" fill="none" stroke="{colour}" stroke-width="2"/>')
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in drawn]
        out.append(_text(_WIDTH - _RIGHT + 14, _TOP + 14 + 18 * i, name, 12, colour))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([*out, "</svg>"]) + "\n", encoding="utf-8")


def _decades(values: Sequence[float]) -> tuple[float, float]:
    logs = np.log10(values) if len(values) else np.array([0.0, 1.0])
    low, high = float(np.floor(logs.min())), float(np.ceil(logs.max()))
    return low, high if high > low else low + 1


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="#d8dce0"/>'


def _text(x: float, y: float, words: str, size: int, colour: str = "#222") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}">{words}</text>'


Panel = tuple[np.ndarray, np.ndarray]
"""Abscissa (n,) and lines (n, k)."""


def panels(path: Path, title: str, rows: Mapping[str, Mapping[str, Panel]]) -> None:
    """Write a grid of plots with linear axes as an SVG: row name -> column name -> `Panel`.

    The plots of a column share their axes, those of the first row, so that rows can be compared.
    """
    width, height, gap, left, top = 210, 120, 44, 80, 56
    count = max(len(row) for row in rows.values())
    size = (left + count * (width + gap), top + len(rows) * (height + gap))
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{size[0]}" height="{size[1]}" font-family="sans-serif" '
        'font-size="10">',
        '<rect width="100%" height="100%" fill="white"/>',
        f'<text x="{left}" y="20" font-size="13">{title}</text>',
    ]
    first = next(iter(rows.values()))
    for i, (row, columns) in enumerate(rows.items()):
        y0 = top + i * (height + gap)
        out.append(f'<text x="6" y="{y0 + height / 2}" font-size="11">{row}</text>')
        for j, (name, (across, lines)) in enumerate(columns.items()):
            x0 = left + j * (width + gap)
            a, b = _range(first[name][0]), _range(first[name][1])
            out.append(f'<rect x="{x0}" y="{y0}" width="{width}" height="{height}" fill="none" stroke="#999"/>')
            out.append(f'<text x="{x0}" y="{y0 - 5}">{name}</text>')
            for text, at in ((a[0], x0), (a[1], x0 + width)):
                out.append(f'<text x="{at}" y="{y0 + height + 12}" text-anchor="middle">{text:.3g}</text>')
            for text, at in ((b[0], y0 + height), (b[1], y0 + 8)):
                out.append(f'<text x="{x0 - 4}" y="{at}" text-anchor="end">{text:.3g}</text>')
            for k, line in enumerate(np.asarray(lines).T):
                x = x0 + (across - a[0]) / (a[1] - a[0]) * width
                y = y0 + height - np.clip((line - b[0]) / (b[1] - b[0]), -0.03, 1.03) * height
                points = " ".join(
                    f"{p:.1f},{q:.1f}" for p, q in zip(x, y, strict=True) if np.isfinite(p) and np.isfinite(q)
                )
                out.append(f'<polyline points="{points}" fill="none" stroke="{_COLOURS[k]}" stroke-width="0.8"/>')
    path.write_text("\n".join([*out, "</svg>"]) + "\n", encoding="utf-8")


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = 0.05 * (high - low) or 1.0
    return low - margin, high + margin
