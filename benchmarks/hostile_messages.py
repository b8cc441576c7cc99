"""Random, hostile and interleaved messages to the server of a live session; `fuzz` counts what comes of them."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter
from pathlib import Path
from typing import Any, get_args

import numpy as np
from websockets.asyncio.client import connect

from vehsim.live.messages import Message
from vehsim.live.server import Server

MARK = "vehicle[0].motion.mark[1].position"
SHOT = """\
[shot]
schema = 1
name = "drive"
[[vehicle]]
name = "car"
asset = "car"
[vehicle.motion]
method = "plan"
segments = 8
[[vehicle.motion.mark]]
frame = 1001
position = [0, 0, 0]
heading = 0
velocity = [0, 0, 0]
[[vehicle.motion.mark]] # the garage
frame = 1073
position = [8, 1, 0]
heading = 0
velocity = [0, 0, 0]
"""
HOSTILE = [
    None, True, 0, -1, 7, 10**30, 1e308, 0.5, "", "car", "../../shot", "/etc/passwd", MARK, "x" * 201, "\x00", [], [[]],
    [8.0, 1.2, 0.0], [1e300] * 3, ["../drive.car.001.csv"], {}, {"kind": "drag"},
]  # fmt: skip
"""Values of any kind for the fields of messages."""
LEAVES = 0.02
"""Share of the messages after which their browser closes, and another comes."""
PAUSE = 0.03
"""Mean time between messages, s: some solves end, others are superseded."""


def hostile(rng: np.random.Generator) -> str:
    """A message of a known kind whose fields have values of any kind, or such a text with a character changed."""
    model = get_args(Message)[rng.integers(len(get_args(Message)))]
    kinds = get_args(model.model_fields["kind"].annotation)
    fields = {name: HOSTILE[rng.integers(len(HOSTILE))] for name in model.model_fields if rng.random() < 0.9}
    text = json.dumps(fields | {"kind": kinds[rng.integers(len(kinds))]})
    at = rng.integers(len(text))
    return text if rng.random() < 0.8 else text[:at] + chr(rng.integers(32, 0xD7FF)) + text[at + 1 :]


def sensible(rng: np.random.Generator) -> str:
    """A message that a page sends: drags above all."""
    place = {"key": MARK, "position": [8 + float(rng.normal()), 1 + float(rng.normal()), 0.0], "heading": None}
    chosen: list[dict[str, Any]] = [
        {"kind": "drag", **place}, {"kind": "drag", **place}, {"kind": "drag", **place}, {"kind": "place", **place},
        {"kind": "undo"}, {"kind": "redo"}, {"kind": "save"}, {"kind": "drive", "vehicle": "car"},
        {"kind": "add_mark", "vehicle": "car", "frame": int(rng.integers(1005, 1090))},
        {"kind": "delete_mark", "vehicle": "car", "mark": int(rng.integers(3))},
        {"kind": "add_note", "frame": int(rng.integers(1001, 1073)), "text": "note"},
        {"kind": "sticks", "values": rng.uniform(-1, 1, 2).tolist()},
    ]  # fmt: skip
    return json.dumps(chosen[rng.integers(len(chosen))])


class _Browser:
    """A client that counts the kinds of what it receives, and remembers the last state."""

    def __init__(self, url: str, heard: Counter[str]) -> None:
        self._url, self._heard = url, heard
        self.state: dict[str, Any] = {}

    async def open(self) -> _Browser:
        self.socket = await connect(self._url, max_size=None, ping_timeout=None)
        self._reading = asyncio.create_task(self._read())
        return self

    async def _read(self) -> None:
        async for raw in self.socket:
            text = raw[4 : 4 + int.from_bytes(raw[:4], "little")] if isinstance(raw, bytes) else raw
            message = json.loads(text)
            self._heard[message["kind"]] += 1
            if message["kind"] == "state":
                self.state = message

    async def close(self) -> None:
        await self.socket.close()
        await asyncio.gather(self._reading, return_exceptions=True)

    async def until(self, key: str, value: Any) -> None:
        while self.state.get(key) != value:
            await asyncio.sleep(0.05)


async def fuzz(folder: Path, count: int, seed: int) -> Counter[str]:
    """Send ``count`` messages from two browsers to a session in ``folder``, half of them hostile.

    Then undo everything, place a mark, and wait until that is solved: a session that has ended or hangs raises
    ``TimeoutError`` or ``ConnectionClosed``. Returns how many messages of each kind came back, ``left``: browsers that
    closed, ``strangers``: files that a session does not write, ``cpu``: ms.
    """
    rng, heard, began = np.random.default_rng(seed), Counter[str](), time.process_time()
    home = folder / "shots"
    home.mkdir()
    path = home / "drive.toml"
    path.write_text(SHOT)
    address = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(Server(path, home / "out").run(address.set_result))
    url = (await address).replace("http", "ws") + "socket"
    async with asyncio.timeout(3600):
        browsers = [await _Browser(url, heard).open() for _ in range(2)]
        await browsers[0].until("solved", True)
        for _ in range(count):
            k = int(rng.random() < 0.2)
            await browsers[k].socket.send(hostile(rng) if rng.random() < 0.5 else sensible(rng))
            await asyncio.sleep(rng.exponential(PAUSE))
            if rng.random() < LEAVES:
                heard["left"] += 1
                await browsers.pop(k).close()
                browsers.append(await _Browser(url, heard).open())
        await browsers.pop().close()
        await browsers[0].socket.send('{"kind": "stop"}')
        while browsers[0].state.get("undo", True):
            browsers[0].state["undo"] = None
            await browsers[0].socket.send('{"kind": "undo"}')
            while browsers[0].state.get("undo") is None:
                await asyncio.sleep(0.02)
        place = {"kind": "place", "key": MARK, "position": [8.0, 1.2, 0.0], "heading": None}
        await browsers[0].socket.send(json.dumps(place))
        while not (browsers[0].state["solved"] and browsers[0].state["handles"][1]["place"] == [8, 1.2, 0]):
            await asyncio.sleep(0.05)
        await browsers[0].close()
    serving.cancel()
    await asyncio.gather(serving, return_exceptions=True)
    known = {"drive.toml", "drive.toml.autosave", "out"}
    files = [*home.iterdir(), *(each for each in folder.iterdir() if each != home)]
    heard["strangers"] = sum(each.name not in known and not each.name.startswith("drive.car.") for each in files)
    heard["cpu"] = round(1e3 * (time.process_time() - began))
    return heard


if __name__ == "__main__":
    import sys
    import tempfile

    with tempfile.TemporaryDirectory() as home:
        print(dict(asyncio.run(fuzz(Path(home), int(sys.argv[1]), int(sys.argv[2])))))
