"""The html exporter: the shot as one self-contained page, to play and orbit in any browser, offline."""

from __future__ import annotations

import base64
import html
import zlib
from collections.abc import Sequence
from pathlib import Path

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.runtime.progress import Progress

PAGE = Path(__file__).parent / "page"
"""The page's own files; ``make page`` bundles ``three.min.js`` from three.js."""


def write_html(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """Write ``<shot>.html``, which needs no other file and no network; returns the files written."""
    from vehsim.exporters.usd.stage import StageReader
    from vehsim.exporters.web.scene import scene_block

    progress("html: reading the stage", 0.0)
    block = scene_block(take, StageReader(folder / f"{take.name}.usda"))
    progress("html: compressing", 0.5)
    scene = base64.b64encode(zlib.compress(block, 6)).decode()
    path = folder / f"{take.name}.html"
    path.write_text(page(take.name, scene), encoding="utf-8", newline="\n")
    return [path]


def page(title: str, scene: str = "", scripts: Sequence[Path] = (PAGE / "three.min.js", PAGE / "viewer.js")) -> str:
    """The page with its styles and ``scripts``, and a ``scene``: base64 of zlib of a `scene_block`."""
    text = (PAGE / "page.html").read_text(encoding="utf-8")
    parts = {
        "{title}": html.escape(title),
        "{style}": (PAGE / "style.css").read_text(encoding="utf-8"),
        "{scripts}": "\n".join(f"<script>{path.read_text(encoding='utf-8')}</script>" for path in scripts),
        "{scene}": scene,
    }
    before = ""
    for mark, part in parts.items():  # in the page's order: a part may contain a later mark
        head, _, text = text.partition(mark)
        before += head + part
    return before + text


exporter = Exporter(
    name="html",
    suffixes=(".html",),
    write=write_html,
    needs=("usd",),
    makes="the animated shot in one page for a browser",
)
