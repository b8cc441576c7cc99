"""A page that shows a review: per clip a table of quantities, each with its curve beside the envelope.

It is one file of HTML and SVG without scripts, which can be opened anywhere.
"""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from vehsim.exporters.checks.review import outside, shown
from vehsim.vehicles.definition.character import SHARES_OF_TIME

PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>
body {{ background: #18181a; color: #e1ded7; font: 15px/1.5 system-ui, sans-serif; margin: 2em; max-width: 72em; }}
h1 {{ font-size: 1.3em; }} h2 {{ font-size: 1.05em; margin: 2em 0 .4em; }} small, th {{ color: #9a968d; }}
table {{ border-collapse: collapse; width: 100%; }}
th {{ text-align: left; font-weight: normal; }}
td, th {{ padding: .35em 1em .35em 0; border-bottom: 1px solid #2c2c30; vertical-align: middle; }}
td.n {{ white-space: nowrap; font-variant-numeric: tabular-nums; }}
.out td {{ color: #ff6b5e; }} svg {{ display: block; }}
</style>
<h1>{title}</h1>
<p>{summary}</p>
{clips}
</html>
"""
CLIP = """<h2>{name} <small>{verdict}</small></h2>
<table><tr><th>quantity</th><th>worst</th><th>envelope</th><th>at frame</th><th>frames {first:g} to {last:g}</th></tr>
{rows}
</table>
"""
ROW = """<tr{outside}><td title="{source}">{name}</td><td class="n">{worst}</td><td class="n">{envelope}</td>
<td class="n">{frame:g}</td><td>{curve}</td></tr>"""
WIDTH, HEIGHT = 420, 46
"""Size of a curve, px."""
INSIDE, OUTSIDE, EDGE = "#8fb3d9", "#ff6b5e", "#7a766d"


def write_page(reviewed: Mapping[str, Any], character: str, path: Path) -> Path:
    """Write the page of a review, see `review.review_of`, to ``path``; returns it."""
    vehicles: Mapping[str, Sequence[Mapping[str, Any]]] = reviewed["vehicles"]
    wrong = sum(len(outside(rows)) for rows in vehicles.values())
    beyond = (
        f"{wrong} quantities are outside" if wrong > 1 else "One quantity is outside" if wrong else "All are inside"
    )
    title = f"{reviewed['shot']}: the motion beside a real machine"
    summary = f"{beyond} the envelope of the character “{character}”. {reviewed['fps']} frames per second."
    clips = "\n".join(_clip(name, rows) for name, rows in vehicles.items())
    path.parent.mkdir(parents=True, exist_ok=True)
    page = PAGE.format(title=html.escape(title), summary=html.escape(summary), clips=clips)
    path.write_text(page, encoding="utf-8")
    return path


def _clip(name: str, rows: Sequence[Mapping[str, Any]]) -> str:
    frames = [frame for row in rows for frame in row["curve"][0]] or [0.0]
    first, last, wrong = min(frames), max(frames), len(outside(rows))
    verdict = f"{wrong} outside" if wrong else "inside"
    text = "\n".join(_row(row, first, last) for row in rows)
    return CLIP.format(name=html.escape(name), verdict=verdict, rows=text, first=first, last=last)


def _row(row: Mapping[str, Any], first: float, last: float) -> str:
    bound = row["envelope"]
    return ROW.format(
        outside=' class="out"' if row["inside"] is False else "",
        name=html.escape(row["name"].replace("_", " ")),
        source=html.escape(row["source"]),
        worst=shown(row["worst"], row["unit"]),
        envelope="-" if bound is None else shown(bound, row["unit"]),
        frame=row["frame"],
        curve=_curve(row, first, last),
    )


def _curve(row: Mapping[str, Any], first: float, last: float) -> str:
    """The curve as SVG: blue inside the envelope, red outside, with the envelope as a dashed line."""
    # the envelope of a share of time is no level of the curve
    bound = None if row["name"] in SHARES_OF_TIME else row["envelope"]
    frames, values = row["curve"]
    top = 1.1 * max([*values, bound or 0.0, 1e-9])
    across, up = WIDTH / max(last - first, 1e-9), (HEIGHT - 2) / top
    points = [((f - first) * across, HEIGHT - 1 - v * up) for f, v in zip(frames, values, strict=True)]
    parts = [f'<svg width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="{html.escape(row["name"])}">']
    if bound is not None:
        y = HEIGHT - 1 - bound * up
        parts.append(f'<path d="M0 {y:.1f}H{WIDTH}" stroke="{EDGE}" stroke-dasharray="4 3"/>')
    for start, end, beyond in _runs(frames, values, math.inf if bound is None else bound):
        colour, some = OUTSIDE if beyond else INSIDE, points[start:end]
        if end - start == 1:  # a single instant, such as rest
            parts.append(f'<circle cx="{some[0][0]:.1f}" cy="{some[0][1]:.1f}" r="2.5" fill="{colour}"/>')
        else:
            line = " ".join(f"{x:.1f},{y:.1f}" for x, y in some)
            parts.append(f'<polyline points="{line}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
    return "".join([*parts, "</svg>"])


def _runs(frames: Sequence[float], values: Sequence[float], bound: float) -> list[tuple[int, int, bool]]:
    """Ranges of points that are connected and on one side of the bound; a range begins where the last one ends."""
    usual = sorted(b - a for a, b in pairwise(frames))
    gap = 4 * usual[len(usual) // 2] if usual else math.inf
    found, start = [], 0
    for k in range(1, len(frames) + 1):
        torn = k == len(frames) or frames[k] - frames[k - 1] > gap
        if torn or (values[k] > bound) != (values[start] > bound):
            found.append((start, k if torn else k + 1, values[start] > bound))
            start = k
    return found
