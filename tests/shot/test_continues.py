"""The key ``continues``: a shot that continues an earlier motion has the same bytes as one run through."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehsim import Shot
from vehsim.clip import Clip
from vehsim.errors import ShotError

SWELL: dict[str, Any] = {"water": {"wave": [{"height": 0.6, "length": 12, "heading": 150}]}}
WALL: dict[str, Any] = {
    "water": {},
    "contact": {},
    "obstacle": [{"name": "wall", "shape": "box", "centre": [6.5, 0, 0], "size": [1, 20, 4]}],
}
BEACH: dict[str, Any] = {"terrain": "beach.toml", "water": {}, "contact": {"restitution": 0.1, "speed": 1.5}}
AGROUND = {"position": [5.4855, 0, 0.052], "orientation": [1, 0, 0.00091, 0]}


def boat(name: str, start: dict[str, Any], force: float = 3000.0, steering: float = 20.0) -> dict[str, Any]:
    commands = [{"frame": f, "thrust": force, "steering": angle} for f, angle in ((1001, 0.0), (1024, steering))]
    motion = {"method": "simulate", "step": 1 / 48, "commands": commands, "start": start}
    return {"name": name, "asset": "boat", "motion": motion}


CASES: dict[str, tuple[dict[str, Any], list[dict[str, Any]], tuple[int, int]]] = {
    "waves": (SWELL, [boat("one", {"velocity": [6, 0, 0]})], (1015, 1027)),
    "wall": (WALL, [boat("one", {"velocity": [6, 0, 0], "position": [0, 0, -0.1]})], (1016, 1020)),
    "wall, together": (
        WALL,
        [
            boat("one", {"velocity": [6, 0, 0], "position": [0, 0, -0.1]}),
            boat("two", {"velocity": [6, 0, 0], "position": [-9, 0, -0.1]}),
        ],
        (1015, 1016),
    ),
    "beach": (BEACH, [boat("one", AGROUND, 0.0, 0.0)], (1011, 1013)),
}


def made(folder: Path, world: dict[str, Any], vehicles: list[dict[str, Any]], end: int) -> dict[str, bytes]:
    """The files of the shot's motions, in ``folder``."""
    shot = {"schema": 1, "name": folder.name, "end_frame": end}
    take = Shot.from_dict({"shot": shot, "world": world, "vehicle": vehicles}, folder.parent).solve()
    return {name: clip.save(folder / name).read_bytes() for name, clip in take.clips.items()}


@pytest.mark.parametrize("case", CASES)
def test_the_same_bytes_as_one_run_through(case: str, tmp_path: Path) -> None:
    world, vehicles, (middle, end) = copy.deepcopy(CASES[case])
    x = np.arange(-60.0, 61.0, 2.0)
    np.save(tmp_path / "beach.npy", np.tile(0.1 * (x - 10), (len(x), 1)))
    (tmp_path / "beach.toml").write_text('heights = "beach.npy"\norigin = [-60, -60]\ncell = [2, 2]\n')
    through = made(tmp_path / "through", world, vehicles, end)
    clip = Clip.load(tmp_path / "through" / "one.npz")
    touches = [event["time"] for event in clip.events]
    assert ("contact" in world) == any(t < (middle - 1001) / 24 for t in touches)
    first = made(tmp_path / "first", world, vehicles, middle)
    assert made(tmp_path / "again", world, vehicles, middle) == first  # from the cache
    for vehicle in vehicles:
        vehicle["motion"]["continues"] = f"first/{vehicle['name']}.npz"
    assert made(tmp_path / "second", world, vehicles, end) == through


def test_what_cannot_be_continued_is_refused(tmp_path: Path) -> None:
    world, vehicles, (middle, end) = copy.deepcopy(CASES["waves"])
    made(tmp_path / "first", world, vehicles, middle)
    (motion,) = (vehicle["motion"] for vehicle in vehicles)
    motion["continues"] = "first/one.npz"

    def refused(
        message: str, key: str = "vehicle[0].motion.continues", last: int = end, around: Any = world, **header: Any
    ) -> None:
        shot = {"schema": 1, "name": "second", "end_frame": last, **header}
        with pytest.raises(ShotError, match=message) as error:
            Shot.from_dict({"shot": shot, "world": around, "vehicle": vehicles}, tmp_path).solve()
        assert [problem.key for problem in error.value.problems] == [key]

    refused("beyond the end", last=middle - 1)
    refused("starts at frame 1001, this motion at 1005", start_frame=1005)
    refused("the shot at 25", fps=25)
    for key, change in {"water": {"level": 0.5}, "wind": [3, 0, 0], "obstacle": WALL["obstacle"]}.items():
        refused(f"had world.{key}", around={**world, key: change})
    clip = Clip.load(tmp_path / "first" / "one.npz")
    (tmp_path / "first" / "one.npz").write_bytes(replace(clip, positions=clip.positions + 1).to_bytes(ending=True))
    refused("as by vehsim retouch.*then retouch the longer motion")
    (tmp_path / "first" / "one.npz").write_bytes(clip.to_bytes())
    refused("was not simulated")
    motion["continues"] = "none.npz"
    refused("no such file")
