"""A page that shows changes: before, after, difference, and the two flickering in one place.

One folder contains ``index.html`` and its pictures; it can be opened anywhere or archived by a build server.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehsim.exporters.compare.compare import Comparison

PAGE = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>{title}</title>
<style>
body {{ background: #18181a; color: #e1ded7; font: 15px/1.5 system-ui, sans-serif; margin: 2em; }}
h1 {{ font-size: 1.3em; }} h2 {{ font-size: 1em; margin: 2em 0 .4em; }} small {{ color: #9a968d; }}
.row {{ display: grid; grid-template-columns: repeat(4, 1fr); gap: 8px; }}
figure {{ margin: 0; }} figcaption {{ color: #9a968d; }} img {{ width: 100%; display: block; }}
.flicker {{ position: relative; }}
.flicker img + img {{ position: absolute; top: 0; animation: flick 1s steps(1) infinite; }}
@keyframes flick {{ 50% {{ opacity: 0; }} }}
</style>
<h1>{title}</h1>
<p>{summary}</p>
{rows}
</html>
"""
ROW = """<h2>{name} <small>{what}</small></h2>
<div class="row">
<figure><a href="{before}"><img src="{before}" alt="before"></a><figcaption>before</figcaption></figure>
<figure><a href="{after}"><img src="{after}" alt="after"></a><figcaption>after</figcaption></figure>
<figure><a href="{changed}"><img src="{changed}" alt="difference"></a><figcaption>difference</figcaption></figure>
<figure><div class="flicker"><img src="{before}" alt=""><img src="{after}" alt=""></div><figcaption>flicker</figcaption>
</figure>
</div>
"""


def write_report(changed: Sequence[Comparison], folder: str | Path, title: str, count: int) -> Path:
    """Write ``folder/index.html`` with the ``changed`` of ``count`` pictures, the worst first; returns its path."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    worst_first = sorted(changed, key=lambda comparison: -comparison.changed / comparison.allowed)
    rows = [_row(comparison, folder, k) for k, comparison in enumerate(worst_first)]
    summary = f"{len(changed)} of {count} pictures changed."
    path = folder / "index.html"
    path.write_text(PAGE.format(title=html.escape(title), summary=summary, rows="\n".join(rows)), encoding="utf-8")
    return path


def _row(comparison: Comparison, folder: Path, k: int) -> str:
    from vehsim.exporters.compare.compare import difference, views

    after, before = views(comparison)
    images: dict[str, Any] = {"before": before, "after": after, "changed": difference(comparison)}
    names = {which: f"{k:03d}.{comparison.reference.stem}.{which}.png" for which in images}
    for which, pixels in images.items():
        _save(pixels, folder / names[which])
    counted = f"{100 * comparison.changed:.3g} % of its pixels changed, {100 * comparison.allowed:.3g} % may"
    what = f"{comparison.kind}: {comparison.reason or counted}{comparison.most}"
    return ROW.format(name=html.escape(comparison.reference.name), what=html.escape(what), **names)


def _save(pixels: Any, path: Path) -> None:
    from PIL import Image

    Image.fromarray(pixels).save(path, compress_level=6)
