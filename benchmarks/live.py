"""Latency of a live session: from a drag's or release's message to the motion received, without a browser.

``python -m benchmarks.live`` prints a table and writes ``RESULTS.live.md`` beside this file. A client of the protocol
drags the last mark, or an obstacle, along a circle and waits for each answer; every event moves it, so every one is
solved.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from websockets.asyncio.client import connect

from benchmarks.hostile_messages import fuzz
from benchmarks.machine import headed
from vehsim.live.server import Server

EVENTS = 40
"""Events of each drag."""
MESSAGES, SEED = 1000, 20
"""Hostile messages, and the seed of their choice."""
RADII = (0.1, 1.0, 5.0)
"""Radii of the circles, m."""
MARK, OBSTACLE = "vehicle[0].motion.mark[1].position", "world.obstacle[0].centre"
"""The handles that are dragged: the obstacle if there is one."""
PILLAR = ("ellipse", (15.0, 6.0), "radii = [1, 1]\nheight = 8")
BALL = ("sphere", (30.0, 6.0, 32.0), "radius = 3")
"""Obstacles beside the paths: shape, centre and size."""
CAR, PLACE = ("car", "", 1121, (30.0, 8.0, 0.0), 64), (60.0, 10.0, 30.0)
Obstacle = tuple[str, tuple[float, ...], str]
CASES: dict[str, tuple[Any, ...]] = {
    "car, 64 segments, empty world": (*CAR, 42),
    "helicopter, 16 segments, empty world, 8 s": ("helicopter", "", 1193, PLACE, 16, 42),
    "helicopter, 16 segments, empty world, 5.5 s": ("helicopter", "", 1133, PLACE, 16, 42),
    "car, 64 segments, flat": ("car", "flat", *CAR[2:], 100),
    "car, 64 segments, hills": ("car", "hills", *CAR[2:], 100),
    "helicopter, 16 segments, flat": ("helicopter", "flat", 1193, PLACE, 16, 100),
    "helicopter, 16 segments, hills": ("helicopter", "hills", 1193, PLACE, 16, 100),
    "helicopter, 64 segments, canyon": ("helicopter", "canyon", 1649, (180.0, 40.0, 28.0), 64, 150),
    "car, 64 segments, flat, an obstacle": ("car", "flat", *CAR[2:], 100, PILLAR),
    "car, 64 segments, hills, an obstacle": ("car", "hills", *CAR[2:], 100, PILLAR),
    "helicopter, 16 segments, hills, an obstacle": ("helicopter", "hills", 1193, PLACE, 16, 100, BALL),
}
"""Name -> vehicle, terrain, frame and place of the last mark, segments, target of the CPU time in ms; an obstacle."""


def shot(
    vehicle: str, terrain: str, frame: int, place: tuple[float, ...], segments: int, obstacle: Obstacle | None = None
) -> str:
    """A shot file from rest to rest."""
    start = (0.0, 0.0, place[2] and 30.0)
    marks = "".join(
        f"[[vehicle.motion.mark]]\nframe = {at}\nposition = {list(position)}\nheading = 0\nvelocity = [0, 0, 0]\n"
        for at, position in ((1001, start), (frame, place))
    )
    world = f'[world]\nterrain = "{terrain}"\n' if terrain else ""
    if obstacle is not None:
        shape, centre, size = obstacle
        world += f'[[world.obstacle]]\nshape = "{shape}"\ncentre = {list(centre)}\n{size}\n'
    limits = "limits = { speed = 30, ceiling = 36 }\n" if terrain == "canyon" else ""
    return (
        f'[shot]\nschema = 1\nname = "drag"\n{world}[[vehicle]]\nname = "one"\nasset = "{vehicle}"\n'
        f'[vehicle.motion]\nmethod = "plan"\nsegments = {segments}\n{limits}{marks}'
    )


Place = tuple[float, ...]
Event = tuple[float, bool]
"""CPU s, and whether a motion was drawn."""


async def measure(text: str, key: str, place: Place) -> tuple[float, dict[float, tuple[list[Event], Event]]]:
    """CPU seconds until a solved shot is shown; for each radius the drags of the handle ``key`` from ``place`` on, and
    the release after them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "drag.toml")
        path.write_text(text)
        shown, events = 0.0, dict[float, tuple[list[Event], Event]]()
        for solved in (False, True):  # the second time, the motion comes from the cache
            began = time.process_time()
            async with asyncio.timeout(600):
                address = asyncio.get_running_loop().create_future()
                serving = asyncio.create_task(Server(path, Path(folder)).run(address.set_result))
                url = (await address).replace("http", "ws") + "socket"
                async with connect(url, max_size=None, ping_timeout=None) as socket:
                    await _until(socket, "scene")
                    shown = time.process_time() - began
                    if solved:
                        for radius in RADII:
                            events[radius] = (
                                await _drag(socket, key, place, radius),
                                await _release(socket, key, place, radius),
                            )
                serving.cancel()
                await asyncio.gather(serving, return_exceptions=True)
        return shown, events


async def _drag(socket: Any, key: str, place: Place, radius: float) -> list[Event]:
    """Drags along a circle, back to where the handle was first."""
    events = []
    for k in range(EVENTS + 1):
        angle = 2 * math.pi * k / EVENTS
        at = [place[0] + radius * (math.cos(angle) - 1), place[1] + radius * math.sin(angle), place[2]]
        events.append(await _timed(socket, "drag", key, at, ("draft", "undrawn")))
    return events[1:]  # the first does not move it


async def _release(socket: Any, key: str, place: Place, radius: float) -> Event:
    """The release of a handle at ``radius`` from where it was first: solved as an export would, and audited."""
    at = [place[0], place[1] - radius, place[2]]
    await _timed(socket, "drag", key, at, ("draft", "undrawn"))
    return await _timed(socket, "place", key, at, ("motion", "scene", "state"))


async def _timed(socket: Any, kind: str, key: str, at: Sequence[float], answers: Sequence[str]) -> Event:
    """Send a handle's place, and wait for the first of the ``answers``, of which the last draws nothing."""
    began = time.process_time()
    await socket.send(json.dumps({"kind": kind, "key": key, "position": list(at)}))
    answer = await _until(socket, *answers)
    return time.process_time() - began, answer != answers[-1]


async def _until(socket: Any, *kinds: str) -> str:
    async for raw in socket:
        text = raw[4 : 4 + int.from_bytes(raw[:4], "little")] if isinstance(raw, bytes) else raw
        if (kind := json.loads(text)["kind"]) in kinds:
            return str(kind)
    raise AssertionError("the session ended")


def main() -> None:
    lines = [
        "# Live sessions, measured",
        "",
        "All times are CPU times of server and client together: other work on a machine lengthens wall times.",
        "*Shown*: a session starts and sends a shot whose motion is in the cache. *90th percentile*: from a drag's",
        "message to the motion received; the last mark is dragged, or the obstacle. *Drawn*: events for which a motion",
        "was found. Drafts of the helicopter have at most 48 segments. *Release*: after the drag, solved as an export",
        "would, certified and audited; *failed*: no motion was found. 60 m in 5.5 s are near what the helicopter's",
        "actuators allow, 5.2 s. An obstacle dragged 5 m passes through the path, which changes sides.",
        "",
        "| shot | shown, s | drag, m | drawn | 90th percentile, ms | target, ms | release, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, (vehicle, terrain, frame, place, segments, target, *obstacle) in CASES.items():
        key, start = (OBSTACLE, (*obstacle[0][1], 0.0)[:3]) if obstacle else (MARK, place)
        text = shot(vehicle, terrain, frame, place, segments, *obstacle)
        shown, drags = asyncio.run(measure(text, key, start))
        for radius, (events, release) in drags.items():
            cpu = 1e3 * np.percentile([seconds for seconds, _ in events], 90)
            drawn = sum(found for _, found in events)
            row = f"{name} | {shown:.1f} | {radius:g} | {drawn} of {EVENTS} | {cpu:.0f} | {target}"
            row += f" | {release[0]:.2f}" + " (failed)" * (not release[1])
            lines.append(f"| {row} |")
            print(lines[-1], flush=True)
    with tempfile.TemporaryDirectory() as folder:
        heard = asyncio.run(fuzz(Path(folder), MESSAGES, SEED))
    lines += [
        "",
        "## Hostile messages",
        "",
        f"{MESSAGES} messages (seed {SEED}) from two browsers, one of which edits: half are what a page sends, in any",
        "order; half have fields of any kind or a damaged character. Browsers close at any time, also in drags and",
        "drives. Then everything is undone, a mark is placed, and that is solved.",
        "",
        f"{heard['refused'] + heard['undrawn']} messages were refused with their error.",
        f"Together, the browsers received {heard['draft']} drafts, {heard['motion'] + heard['scene']} motions,",
        f"the ends of {heard['driven']} drives and {heard['said']} reports of saves and exports;",
        f"{heard['left']} browsers closed.",
        f"{heard['strangers']} files were written that a session does not write, in the shot's folder or beside it.",
        f"It took {heard['cpu'] / 1e3:.0f} s.",
        "",
    ]
    Path(__file__).with_name("RESULTS.live.md").write_text(headed("\n".join(lines)), encoding="utf-8")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as cache:  # releases are solved, not recalled from an earlier run
        os.environ["VEHSIM_CACHE"] = cache
        main()
