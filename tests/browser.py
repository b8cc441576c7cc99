"""A headless browser, if this machine has one, that opens pages from files or from a server, as users do."""

from __future__ import annotations

import asyncio
import json
import shutil
import subprocess
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

PATIENCE = 600.0  # s, on a busy machine
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = ("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars")


def browser() -> str:
    """The path of a browser; skips the test without one."""
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser on this machine: install one of {', '.join(NAMES)}")
    return found


def opened(page: Path, profile: Path, *flags: str) -> str:
    """The document of a page after its scripts ran, without any network."""
    how = [*FLAGS, f"--user-data-dir={profile}", "--host-resolver-rules=MAP * ~NOTFOUND", *flags]
    done = subprocess.run(
        [browser(), *how, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=PATIENCE
    )
    return done.stdout


class Page:
    """A page in a headless browser, driven through its debugging protocol."""

    def __init__(self, socket: Any, process: subprocess.Popen[bytes]) -> None:
        self._socket, self._process, self._count = socket, process, 0

    def kill(self) -> None:
        """End the browser as a crash does: it sends nothing any more."""
        self._process.kill()

    async def call(self, method: str, **parameters: Any) -> Any:
        """One command of the protocol; returns its result."""
        self._count += 1
        await self._socket.send(json.dumps({"id": self._count, "method": method, "params": parameters}))
        while True:
            answer = json.loads(await asyncio.wait_for(self._socket.recv(), PATIENCE))
            if answer.get("id") == self._count:
                assert "error" not in answer, answer
                return answer["result"]

    async def value(self, script: str) -> Any:
        """The value of an expression in the page."""
        answer = await self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    async def until(self, script: str, seconds: float = PATIENCE) -> None:
        """Wait until an expression in the page is true."""
        for _ in range(int(seconds / 0.1)):
            if await self.value(script):
                return
            await asyncio.sleep(0.1)
        raise AssertionError(f"never true: {script}")

    async def mouse(self, kind: str, x: float, y: float, modifiers: int = 0) -> None:
        """``kind``: Pressed, Moved or Released; ``modifiers``: 8 is Shift."""
        held = 0 if kind == "Released" else 1
        parameters = {"x": x, "y": y, "button": "left", "buttons": held, "clickCount": 1, "modifiers": modifiers}
        await self.call("Input.dispatchMouseEvent", type=f"mouse{kind}", **parameters)

    async def hold(self, key: str, code: str, down: bool) -> None:
        """Press a key, or release it."""
        kind = "rawKeyDown" if down else "keyUp"
        await self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code)

    async def key(self, key: str, code: str, modifiers: int = 0) -> None:
        for kind in ("rawKeyDown", "keyUp"):
            await self.call("Input.dispatchKeyEvent", type=kind, key=key, code=code, modifiers=modifiers)


@asynccontextmanager
async def at(url: str, profile: Path) -> AsyncIterator[Page]:
    """The page at ``url``, opened in a new browser."""
    from websockets.asyncio.client import connect

    flags = [*FLAGS, "--window-size=900,700", f"--user-data-dir={profile}", "--remote-debugging-port=0"]
    process = subprocess.Popen([browser(), *flags, url], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        known = profile / "DevToolsActivePort"
        for _ in range(int(PATIENCE / 0.1)):
            if known.is_file() and known.read_text().count("\n"):
                break
            await asyncio.sleep(0.1)
        port = known.read_text().split("\n")[0]

        def pages() -> Any:
            return json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=PATIENCE))

        page = next(page for page in await asyncio.to_thread(pages) if page["type"] == "page")
        async with connect(page["webSocketDebuggerUrl"], max_size=None, ping_timeout=None) as socket:
            yield Page(socket, process)
    finally:
        process.terminate()
        process.wait(30)
