"""Film a drag in the live page, in headless Chromium: ``python -m tools.drag_film docs/drag.webp``."""

from __future__ import annotations

import asyncio
import base64
import io
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.browser import Page, at
from tests.live.test_browser import PLACE, SOLVED
from tests.live.test_server import served

SHOT = """\
[shot]
schema = 1
name = "drive"

[world]
terrain = "hills"

[[vehicle]]
name = "car"
asset = "car"

[vehicle.motion]
method = "plan"

[[vehicle.motion.mark]]
frame = 1001
position = [-14, 0, 0]
heading = 0
velocity = [0, 0, 0]

[[vehicle.motion.mark]]
frame = 1193
position = [14, 0, 0]
heading = 0
velocity = [0, 0, 0]
"""
VIEW, SHOWN = (1120, 630), (800, 450)  # px, of the page and of the film
STEPS, PAUSE = 48, 12  # of the drag, and pictures of the solved motion after it


async def picture(page: Page, x: float, y: float) -> Image.Image:
    """What the page shows, with the pointer at ``x``, ``y``, which screenshots leave out."""
    await page.value(f"document.getElementById('pointer').style.transform = 'translate({x}px, {y}px)'")
    data = (await page.call("Page.captureScreenshot", format="png"))["data"]
    return Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB").resize(SHOWN, Image.Resampling.LANCZOS)


async def film(folder: Path) -> list[Image.Image]:
    """Pictures of a drag of the last mark around its place, and of the motion solved after it."""
    path = folder / "drive.toml"
    path.write_text(SHOT)
    pictures: list[Image.Image] = []
    async with served(path) as address, at(f"http://{address}", folder / "profile") as page:
        size: dict[str, Any] = {"width": VIEW[0], "height": VIEW[1], "deviceScaleFactor": 1, "mobile": False}
        await page.call("Emulation.setDeviceMetricsOverride", **size)
        await page.until(f"typeof vehsim !== 'undefined' && vehsim.viewer && {SOLVED}", 120)
        await page.value(
            "vehsim.viewer.follow = null; vehsim.viewer.seek(1085);"
            "vehsim.viewer.orbit.target.set(1, 0, 0); vehsim.viewer.camera.position.set(-10, -20, 13);"
            "vehsim.viewer.orbit.update(); vehsim.viewer.draw()"
        )
        await asyncio.sleep(1.0)  # the frame that was sought is drawn
        await page.value(
            "document.body.insertAdjacentHTML('beforeend', '<svg id=pointer width=20 height=26 style=\"position:fixed;"
            'left:0;top:0;z-index:99;pointer-events:none"><path d="M1 1v19l5-5 4 9 3-1-4-9h7z" fill=white '
            "stroke=black /></svg>')"
        )
        x, y = await page.value(PLACE)
        await page.mouse("Moved", x, y)
        await page.until("document.getElementById('view').style.cursor === 'grab'", 20)
        await page.mouse("Pressed", x, y)
        for angle in np.linspace(0.0, 2.0 * np.pi, STEPS + 1)[1 : STEPS * 3 // 4]:
            to = (x - 90.0 * (1.0 - np.cos(angle)), y - 70.0 * np.sin(angle))
            await page.mouse("Moved", *to)
            await page.until("document.getElementById('status').textContent.startsWith('dragging')", 20)
            await asyncio.sleep(0.3)  # the draft on its way
            pictures.append(await picture(page, *to))
        await page.mouse("Released", *to)
        await page.until("!document.getElementById('do-undo').disabled", 20)
        await page.until(SOLVED)
        pictures += [await picture(page, *to)] * PAUSE
    return pictures


def main(target: Path) -> None:
    """Film the drag and write it."""
    with tempfile.TemporaryDirectory() as folder:
        first, *others = asyncio.run(film(Path(folder)))
    first.save(target, save_all=True, append_images=others, duration=80, loop=0, quality=70, method=6)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
