"""Random shots: a seed gives a shot file with a combination that was not designed beforehand.

This module chooses requests such that most shots can be solved: distances, times and bends suit the vehicle. It uses
the standard library and numpy only. Units are those of the shot file: metres, frames, degrees.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

Table = dict[str, Any]
FPS: tuple[Any, ...] = (24, 24, 24, 25, 30, "23.976", "30000/1001", 48, 60, 120)


@dataclass(frozen=True)
class Kind:
    """Numbers that suit a vehicle: legs in m, a comfortable acceleration in m/s^2, its tightest bend in m, half its
    width."""

    legs: tuple[float, float]
    acceleration: float
    radius: float
    half_width: float
    limits: tuple[str, ...]
    flies: bool = False
    joints: Mapping[str, float] = field(default_factory=dict)


WHEELED = ("speed", "acceleration", "turn_rate", "steering", "steering_rate", "joints", "joint_rates")
PLANNED: dict[str, Kind] = {
    "helicopter": Kind(
        (6, 25), 2.0, 0.0, 5.5, ("speed", "climb", "turn_rate", "bank", "ceiling", "acceleration", "g_load"), flies=True
    ),
    "car": Kind((6, 18), 1.6, 9.0, 0.95, WHEELED, joints={"sigma": 0.7}),
    "simple_car": Kind((6, 18), 1.5, 10.0, 0.95, WHEELED, joints={"sigma": 0.7}),
    "truck": Kind((6, 14), 0.5, 16.0, 1.3, WHEELED, joints={"sigma": 0.75, "hitch_1": 1.1}),
    "boat": Kind((8, 20), 0.45, 14.0, 1.2, ("speed", "acceleration", "turn_rate")),
    "two_wheeled": Kind((1, 4), 0.5, 1.0, 0.3, ("speed", "acceleration", "turn_rate")),
    "snakeboard": Kind((1.5, 4), 0.22, 4.0, 0.4, ("speed", "joints"), joints={"psi": 1.2, "phi": 0.7}),
}
WEIGHTS = {"helicopter": 9, "car": 6, "boat": 4, "two_wheeled": 4, "simple_car": 3, "truck": 2, "snakeboard": 1}


@dataclass
class Draft:
    """A shot under construction: its file as a table, its vehicles' tracks, additional files, and descriptive words."""

    rng: random.Random
    table: Table
    words: list[str] = field(default_factory=list)
    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    height: Callable[[float, float], float] = lambda x, y: 0.0
    has_ground: bool = False

    @property
    def fps(self) -> float:
        given = self.table["shot"].get("fps", 24)
        return 24000 / 1001 if given == "23.976" else 30000 / 1001 if given == "30000/1001" else float(given)

    def chance(self, share: float) -> bool:
        return self.rng.random() < share

    def between(self, low: float, high: float, digits: int = 3) -> float:
        return round(self.rng.uniform(low, high), digits)


def make_shot(seed: int) -> Draft:
    """The shot of a seed; the same seed gives the same shot."""
    rng = random.Random(seed)
    draft = Draft(
        rng, {"shot": {"schema": 1, "name": f"random_{seed}", "start_frame": rng.choice([1001, 1, 0, -20, 101])}}
    )
    fps = rng.choice(FPS)
    if fps != 24:
        draft.table["shot"]["fps"] = fps
        draft.words.append("other fps")
    method = rng.choices(("plan", "two plans", "sinusoid", "simulate", "integrate"), (70, 6, 9, 12, 3))[0]
    {
        "plan": _plan,
        "two plans": _two_plans,
        "sinusoid": _sinusoid,
        "simulate": _simulate,
        "integrate": _integrate,
    }[method](draft)
    draft.words.insert(0, method)
    _delivery(draft)
    return draft


def write_shot(draft: Draft, folder: Path) -> Path:
    """Write the shot file to a folder, with the files that it names beside it; returns its path."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, arrays in draft.files.items():
        np.savez(folder / name, **arrays)
    path = folder / "shot.toml"
    path.write_text(f"# {', '.join(draft.words)}\n{to_toml(draft.table)}", encoding="utf-8")
    return path


# ---------------------------------------------------------------- plans


@dataclass
class Track:
    """The course of a vehicle: places and headings that it can drive or fly through, and the seconds for every leg."""

    places: list[list[float]]
    headings: list[float]
    seconds: list[float]


def _plan(draft: Draft) -> None:
    name = draft.rng.choices(list(WEIGHTS), list(WEIGHTS.values()))[0]
    draft.words.append(name)
    world = _world(draft, name)
    legs = draft.rng.choices((1, 2, 3), (5, 4, 1))[0]
    loop = name in ("helicopter", "two_wheeled", "boat") and draft.chance(0.07)
    track = _track(draft, name, 2 if loop else legs)
    motion = _planned(draft, name, track, loop)
    draft.table["vehicle"] = [{"name": "mover", "asset": name, "motion": motion}]
    if PLANNED[name].legs[0] > 5 and draft.chance(0.35):
        world.setdefault("obstacle", []).extend(_obstacles(draft, name, track))
        draft.words.append("obstacles")
    if world:
        draft.table["world"] = world


def _two_plans(draft: Draft) -> None:
    """One planned vehicle, and another that avoids it."""
    name = draft.rng.choice(("helicopter", "car", "boat"))
    draft.words += [name, "moving obstacle"]
    world = {} if name == "boat" else {"terrain": "flat"}
    track = _track(draft, name, 1)
    first = _planned(draft, name, track, False, plain=True)
    (x0, y0, z0), (x1, y1, z1) = track.places
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    across = math.atan2(y1 - y0, x1 - x0) + math.pi / 2
    reach = math.dist((x0, y0), (x1, y1)) / 2 + PLANNED[name].half_width + 3
    shift = draft.between(0.0, 6.0)  # it passes the crossing a little later, or not exactly there
    ends = [
        [
            round(middle[0] + s * reach * math.cos(across) + shift, 3),
            round(middle[1] + s * reach * math.sin(across), 3),
            z,
        ]
        for s, z in ((-1, z0), (1, z1))
    ]
    seconds = max(track.seconds[0], math.sqrt(6 * 2 * reach / PLANNED[name].acceleration))
    heading = round(math.degrees(across), 3)
    second = _planned(draft, name, Track(ends, [heading, heading], [seconds]), False, plain=True)
    second["clearance"] = draft.between(0.3, 2.0)
    draft.table["vehicle"] = [
        {"name": "goes", "asset": name, "motion": first},
        {"name": "yields", "asset": name, "motion": second},
    ]
    draft.table["world"] = {**world, "obstacle": [{"shape": "vehicle", "vehicle": "goes"}]}


def _track(draft: Draft, name: str, legs: int) -> Track:
    kind, rng = PLANNED[name], draft.rng
    canyon = "canyon" in draft.words
    yaw = 0.0 if canyon else rng.uniform(-180, 180)
    x, y = (0.0, 0.0) if canyon else (rng.uniform(-20, 20), rng.uniform(-20, 20))
    z = 30.0 if canyon else 0.0
    if kind.flies and not canyon:
        z = (75.0 if "hills" in draft.words else draft.height(x, y)) + rng.uniform(8, 16)
    places, headings, seconds = [[round(x, 3), round(y, 3), round(z, 3)]], [round(yaw, 3)], []
    for _ in range(legs):
        length = rng.uniform(*kind.legs)
        if canyon:
            length = min(length, 12.0)
        bend = math.degrees(min(1.2, length / kind.radius)) if kind.radius else 60.0
        turn = 0.0 if canyon or rng.random() < 0.25 else rng.uniform(-bend, bend)
        back = kind.radius and name not in ("boat", "truck", "snakeboard") and rng.random() < 0.12
        course = math.radians(yaw + turn / 2) + (math.pi if back else 0.0)
        half = math.radians(turn) / 2
        chord = length * (math.sin(half) / half if abs(half) > 1e-6 else 1.0)
        x, y = x + chord * math.cos(course), y + chord * math.sin(course)
        yaw += -turn if back else turn
        if kind.flies:
            z += rng.uniform(-2.5, 2.5)
            if not canyon and "hills" not in draft.words:
                z = max(z, draft.height(x, y) + 6.0)
        places.append([round(x, 3), round(y, 3), round(z, 3)])
        headings.append(round(yaw, 3))
        seconds.append(max(1.2, math.sqrt(6 * length / kind.acceleration) * rng.uniform(1.0, 1.5)))
    return Track(places, headings, seconds)


def _planned(draft: Draft, name: str, track: Track, loop: bool, plain: bool = False) -> Table:
    kind, rng = PLANNED[name], draft.rng
    legs = len(track.seconds)
    per_leg = rng.choice((8, 12, 12, 16, 24))
    motion: Table = {"method": "plan", "segments": per_leg * (legs + loop)}
    if draft.chance(0.3):
        costs: list[Any] = ["time", "energy", "smoothness", {"effort": 1, "time": 0.5}, {"effort": 1, "distance": 0.2}]
        motion["cost"] = rng.choice(costs)
    clearance = draft.between(0.2, 1.5, 2)
    motion["clearance"] = clearance
    frame, marks = draft.table["shot"]["start_frame"], []
    looks = kind.flies and not plain and not loop and draft.chance(0.12)
    free_from = legs + 1
    if not plain and not loop and draft.chance(0.2):
        free_from = rng.choice(range(1, legs + 1)) if draft.chance(0.3) else legs
    for i, place in enumerate(track.places):
        frame += math.ceil(track.seconds[i - 1] * draft.fps) if i else 0
        mark = _mark(draft, name, track, i, frame, plain, looks, clearance)
        if i >= free_from:
            mark["frame"] = "free"
            _word(draft, "free frame")
        elif mark.get("hold"):
            frame += mark["hold"]
        mark.setdefault("position", list(place))
        marks.append(mark)
    if loop:
        reach = max(math.dist(a, b) for a in track.places for b in track.places)
        frame += math.ceil(1.3 * math.sqrt(6 * reach / kind.acceleration) * draft.fps)
        for mark in marks:
            for key in ("hold", "on_ground", "velocity", "orientation", "gate", "joints", "speed"):
                mark.pop(key, None)
            if name != "helicopter":
                mark.pop("heading", None)
        marks.append({"frame": frame})
        motion["loop"] = True
        _word(draft, "loop")
    motion["mark"] = marks
    if not plain:
        _limits(draft, name, track, motion)
    if looks:
        _look(draft, track, marks, motion)
    if not plain and not loop and draft.chance(0.1):
        _stay(draft, kind, track, marks, motion)
    return motion


def _mark(
    draft: Draft, name: str, track: Track, i: int, frame: int, plain: bool, looks: bool, clearance: float
) -> Table:
    kind, rng, last = PLANNED[name], draft.rng, i == len(track.seconds)
    mark: Table = {"frame": frame}
    heading = None if looks else track.headings[i]
    rest = plain or draft.chance(0.85 if i == 0 or last else 0.3)
    if heading is not None and (i == 0 or not kind.flies or draft.chance(0.5)) and (not last or draft.chance(0.8)):
        if draft.chance(0.1) and rest and name != "boat" and not kind.flies:
            half = math.radians(heading) / 2
            mark["orientation"] = [math.cos(half), 0.0, 0.0, math.sin(half)]
            _word(draft, "orientation")
        else:
            mark["heading"] = heading + (draft.between(-90, 90) if kind.flies and draft.chance(0.4) else 0)
    if rest:
        mark["velocity"] = [0, 0, 0]
    elif i and not plain and draft.chance(0.5):
        mean = math.dist(track.places[i], track.places[i - 1]) / track.seconds[i - 1]
        yaw = math.radians(track.headings[i])
        if kind.flies and draft.chance(0.6):
            mark["velocity"] = [round(mean * math.cos(yaw), 3), round(mean * math.sin(yaw), 3), draft.between(-1, 1)]
            _word(draft, "velocity")
        else:
            mark["speed"] = round(mean, 3)
            _word(draft, "speed")
    if plain:
        return mark
    if rest and "orientation" not in mark and draft.chance(0.3):
        mark["hold"] = rng.choice((3, 8, 12, 24, 30))
        _word(draft, "hold")
    if kind.flies and rest and draft.has_ground and draft.chance(0.25) and not looks and "canyon" not in draft.words:
        x, y, _ = track.places[i]
        mark["position"] = [x, y, round(draft.height(x, y) + rng.uniform(0.0, 3.0), 3)]
        mark["on_ground"] = True
        mark.setdefault("heading", track.headings[i])
        if not mark.get("hold") and draft.chance(0.5):
            mark.pop("velocity")
        _word(draft, "on_ground")
    elif not rest and i and draft.chance(0.35):
        yaw = math.radians((track.headings[i] + track.headings[i - 1]) / 2 if kind.flies else track.headings[i])
        gate: Table = {"direction": [round(math.cos(yaw), 4), round(math.sin(yaw), 4), 0]}
        gate |= (
            {"radius": draft.between(0.5, 2)}
            if draft.chance(0.5)
            else {"size": [draft.between(1, 3), draft.between(1, 3)]}
        )
        mark["gate"] = gate
        _word(draft, "gate")
    elif i and draft.chance(0.2):
        mark["tolerance"] = draft.between(0.02, 0.5)
        _word(draft, "tolerance")
    if kind.joints and draft.chance(0.25):
        joint = rng.choice(list(kind.joints))
        mark["joints"] = {joint: 0.0 if rest else draft.between(-0.1, 0.1)}
        _word(draft, "joints")
    return mark


def _limits(draft: Draft, name: str, track: Track, motion: Table) -> None:
    """Limits about as tight as a comfortable motion needs."""
    kind, rng = PLANNED[name], draft.rng
    if draft.chance(0.45):
        return
    lengths = [math.dist(a, b) for a, b in zip(track.places, track.places[1:], strict=False)]
    speed = max(1.5 * d / t for d, t in zip(lengths, track.seconds, strict=True))
    push = max(6 * d / t**2 for d, t in zip(lengths, track.seconds, strict=True))
    climb = max(
        1.5 * abs(b[2] - a[2]) / t for a, b, t in zip(track.places, track.places[1:], track.seconds, strict=False)
    )
    turning = max(
        math.radians(abs(b - a)) / t for a, b, t in zip(track.headings, track.headings[1:], track.seconds, strict=False)
    )
    usual: dict[str, Any] = {
        "speed": speed * rng.uniform(0.9, 1.5),
        "climb": max(0.6, climb * rng.uniform(0.95, 1.6)),
        "turn_rate": math.degrees(max(0.6, 2.2 * turning)) * rng.uniform(0.9, 1.8),
        "bank": max(8.0, math.degrees(math.atan(push / 9.81)) * rng.uniform(0.95, 1.6)),
        "ceiling": max(p[2] for p in track.places) + rng.uniform(0.1, 2.0),
        "acceleration": push * rng.uniform(0.85, 1.6),
        "g_load": 1 + max(0.03, 0.5 * (push / 9.81) ** 2) + rng.uniform(0.0, 0.25),
        "steering": rng.uniform(18, 34),
        "steering_rate": rng.uniform(10, 40),
        "joints": {joint: draft.between(0.5 * most, 0.95 * most) for joint, most in kind.joints.items()},
        "joint_rates": {"sigma": draft.between(0.15, 0.6)},
    }
    chosen = rng.sample(kind.limits, min(len(kind.limits), rng.choice((1, 1, 2, 3))))
    motion["limits"] = {key: round(usual[key], 3) if isinstance(usual[key], float) else usual[key] for key in chosen}
    for key in chosen:
        _word(draft, f"limit {key}")


def _known(marks: list[Table]) -> tuple[int, int] | None:
    frames = [mark["frame"] + mark.get("hold", 0) for mark in marks if mark["frame"] != "free"]
    return (frames[0], frames[-1]) if len(frames) > 1 else None


def _look(draft: Draft, track: Track, marks: list[Table], motion: Table) -> None:
    x, y, z = track.places[-1]
    yaw = math.radians(track.headings[-1]) + draft.between(-0.5, 0.5)
    look: Table = {"at": [round(x + 30 * math.cos(yaw), 2), round(y + 30 * math.sin(yaw), 2), round(z, 2)]}
    look["within"] = draft.between(4, 30, 1)
    known = _known(marks)
    if known and draft.chance(0.5):
        a, b = known
        look["frames"] = [a + (b - a) // 2, b]
    if draft.chance(0.25):
        look["axis"] = "x"
        look["level"] = False
        look["within"] = draft.between(20, 40, 1)
    motion["look"] = [look]
    _word(draft, "look")


def _stay(draft: Draft, kind: Kind, track: Track, marks: list[Table], motion: Table) -> None:
    xs, ys, zs = zip(*track.places, strict=True)
    stay: Table = {}
    if kind.flies and draft.chance(0.7):
        stay |= {"above": round(min(zs) - draft.between(0.2, 2), 3), "below": round(max(zs) + draft.between(0.2, 2), 3)}
        if any(mark.get("on_ground") for mark in marks):
            stay.pop("above")
    if not stay or draft.chance(0.5):
        room = draft.between(1.0, 4.0)
        stay["inside"] = [round(v, 3) for v in (min(xs) - room, min(ys) - room, max(xs) + room, max(ys) + room)]
    known = _known(marks)
    if known and draft.chance(0.5):
        a, b = known
        stay["frames"] = [a + (b - a) // 4, b - (b - a) // 4]
    motion["stay"] = [stay]
    _word(draft, "stay")


# ---------------------------------------------------------------- worlds


def _world(draft: Draft, name: str) -> Table:
    kind, rng, world = PLANNED[name], draft.rng, {}
    if name == "boat":
        if draft.chance(0.5):
            world["wind"] = [draft.between(-4, 4), draft.between(-4, 4), 0]
            draft.words.append("wind")
        return world
    choices = ("none", "flat", "map", "hills", "canyon") if kind.flies else ("none", "flat", "map", "hills")
    weights = (3, 3, 4, 1, 2) if kind.flies else (2, 5, 3, 1)
    terrain = rng.choices(choices, weights)[0]
    if terrain == "map" and name in ("two_wheeled", "snakeboard"):
        terrain = "flat"
    if terrain == "hills" and not kind.flies:
        terrain = "map"
    if terrain != "none":
        draft.words.append(terrain)
        world["terrain"] = terrain
    draft.has_ground = terrain in ("flat", "map")
    if terrain == "map":
        world["terrain"] = _height_map(draft, steep=0.35 if kind.flies else 0.12)
    if kind.flies and draft.chance(0.3):
        world["wind"] = [draft.between(-6, 6), draft.between(-6, 6), 0]  # which it leans into
        draft.words.append("wind")
    return world


def _height_map(draft: Draft, steep: float) -> str:
    """Waves of hills on a grid of a metre, as an archive beside the shot; slopes of about ``steep``."""
    rng, waves = draft.rng, []
    for _ in range(3):
        length, course = rng.uniform(25, 70), rng.uniform(0, 2 * math.pi)
        height = steep / 2 * length / (2 * math.pi)
        k = 2 * math.pi / length
        waves.append((height, k * math.cos(course), k * math.sin(course), rng.uniform(0, 2 * math.pi)))

    def height(x: Any, y: Any) -> Any:
        return sum(h * np.sin(a * x + b * y + c) for h, a, b, c in waves)

    reach = np.arange(-130.0, 131.0, 1.5)
    x, y = np.meshgrid(reach, reach)
    draft.files["hills.npz"] = {"heights": height(x, y), "cell": [1.5, 1.5], "origin": [-130.0, -130.0]}
    draft.height = lambda x, y: float(height(x, y))
    return "hills.npz"


def _obstacles(draft: Draft, name: str, track: Track) -> list[Table]:
    """Obstacles beside the path, close enough to matter; for flying vehicles also on it."""
    kind, rng, made = PLANNED[name], draft.rng, []
    for _ in range(rng.choice((1, 1, 2, 3))):
        leg = rng.randrange(len(track.seconds))
        a, b = track.places[leg], track.places[leg + 1]
        share = rng.uniform(0.3, 0.7)
        x, y = (a[k] + share * (b[k] - a[k]) for k in (0, 1))
        across = math.atan2(b[1] - a[1], b[0] - a[0]) + math.pi / 2
        size = rng.uniform(0.5, 2.0)
        near = kind.half_width + size + rng.uniform(0.8, 5.0)
        aside = rng.choice((-1, 1)) * near if not kind.flies or rng.random() < 0.7 else 0.0
        centre = [round(x + aside * math.cos(across), 3), round(y + aside * math.sin(across), 3)]
        if any(math.dist(centre, p[:2]) < kind.half_width + size + 4.5 for p in track.places):
            continue
        ground = draft.height(*centre) - 1
        top = max(a[2], b[2]) + 3 if kind.flies else ground + 4
        shape = rng.choice(("ellipse", "box", "polygon", "sphere") if kind.flies else ("ellipse", "box", "polygon"))
        tall = {"base": round(ground, 3), "height": round(top - ground, 3)}
        if shape == "ellipse":
            made.append({"shape": shape, "centre": centre, "radii": [round(size, 3), draft.between(0.5, 2)], **tall})
        elif shape == "polygon":
            ring = [(2 * math.pi * (k + rng.uniform(0, 0.7)) / 5, size * rng.uniform(0.6, 1)) for k in range(5)]
            points = [[round(centre[0] + r * math.cos(w), 3), round(centre[1] + r * math.sin(w), 3)] for w, r in ring]
            made.append({"shape": shape, "points": points, **tall})
        elif shape == "sphere":
            made.append({"shape": shape, "centre": [*centre, round((a[2] + b[2]) / 2, 3)], "radius": round(size, 3)})
        else:
            sides = [round(1.4 * size, 3), round(1.4 * size, 3), tall["height"]]
            made.append(
                {"shape": shape, "centre": [*centre, tall["base"]], "size": sides, "heading": draft.between(0, 90)}
            )
    return made


# ---------------------------------------------------------------- other methods


def _sinusoid(draft: Draft) -> None:
    rng, first = draft.rng, draft.table["shot"]["start_frame"]
    name = rng.choices(("car", "simple_car", "truck", "hopper"), (4, 1, 2, 3))[0]
    draft.words.append(name)
    draft.table["world"] = {"terrain": "flat"}
    last: Table = {"frame": "free"}
    if name == "hopper":
        start = [draft.between(-3, 3), draft.between(-3, 3), 0.9]
        yaw = draft.between(-180, 180)
        reach = draft.between(1.5, 4)
        heading = {"heading": yaw} if draft.chance(0.5) else {}
        yaw = yaw if heading else 0.0
        goal = [round(start[k] + reach * f(math.radians(yaw)), 3) for k, f in ((0, math.cos), (1, math.sin))]
        marks = [{"frame": first, "position": start, **heading}, {**last, "position": [*goal, 0.9], **heading}]
        if draft.chance(0.5):
            marks[1] |= {"pitch": 360, "joints": {"psi": -6.283185307179586}}
    else:
        track = _track(draft, name, 1)
        side = draft.between(-3, 3)
        yaw = math.radians(track.headings[0])
        x, y, _ = track.places[0]
        reach = draft.between(4, 14) * rng.choice((-1, 1))
        goal = [
            round(x + reach * math.cos(yaw) - side * math.sin(yaw), 3),
            round(y + reach * math.sin(yaw) + side * math.cos(yaw), 3),
            0,
        ]
        heading = round(track.headings[0] + draft.between(-30, 30), 3)
        marks = [{"frame": first, "position": [x, y, 0], "heading": track.headings[0]}]
        marks.append({**last, "position": goal, "heading": heading})
        for mark in marks:
            if draft.chance(0.25):
                mark["hold"] = rng.choice((5, 12, 24))
                _word(draft, "hold")
    motion: Table = {"method": "sinusoid", "mark": marks}
    if name != "hopper" and draft.chance(0.5):
        chosen = rng.sample(("speed", "steering", "steering_rate"), rng.choice((1, 2)))
        usual = {
            "speed": draft.between(1, 4),
            "steering": draft.between(18, 30),
            "steering_rate": draft.between(10, 40),
        }
        motion["limits"] = {key: usual[key] for key in chosen}
        draft.words += [f"limit {key}" for key in chosen]
    draft.table["vehicle"] = [{"name": "mover", "asset": name, "motion": motion}]


def _simulate(draft: Draft) -> None:
    rng, first = draft.rng, draft.table["shot"]["start_frame"]
    case = rng.choice(("hover", "fly_to", "follow_path", "gait", "car", "boat", "helicopter", "two_wheeled"))
    draft.words.append(case)
    start: Table = {"position": [draft.between(-5, 5), draft.between(-5, 5), 0], "heading": draft.between(-180, 180)}
    motion: Table = {"method": "simulate", "start": start, "duration": draft.between(2, 6, 2)}
    world: Table = {"terrain": "flat"} if draft.chance(0.6) and case != "boat" else {}
    asset = case
    x, y, _ = start["position"]
    yaw = math.radians(start["heading"])
    if case in ("hover", "fly_to", "helicopter"):
        asset, start["position"][2] = "helicopter", draft.between(20, 30)
        start["velocity"] = [draft.between(-2, 2), draft.between(-2, 2), 0]
    if case == "hover":
        goal = [round(v + rng.uniform(-2, 2), 3) for v in start["position"]]
        motion |= {"pilot": {"name": "hover", "position": goal, "heading": draft.between(-60, 60)}, "duration": 8.0}
    elif case == "fly_to":
        goal = [round(x + rng.uniform(-20, 20), 3), round(y + rng.uniform(-20, 20), 3), draft.between(18, 30)]
        motion |= {"pilot": {"name": "fly_to", "position": goal, "speed": draft.between(3, 10)}}
        motion["duration"] = draft.between(4, 24, 1)
    elif case == "follow_path":
        asset, points = "car", [[x, y]]
        for _ in range(3):
            yaw += rng.uniform(-0.4, 0.4)
            last = points[-1]
            points.append([round(last[0] + 9 * math.cos(yaw), 3), round(last[1] + 9 * math.sin(yaw), 3)])
        motion |= {"pilot": {"name": "follow_path", "points": points, "speed": draft.between(3, 8)}}
        motion["duration"] = draft.between(3, 16, 1)
    elif case == "gait":
        asset = "snakeboard"
        amplitude = [draft.between(0.2, 0.9), draft.between(0.1, 0.5)]
        motion["pilot"] = {
            "name": "gait",
            "amplitude": amplitude,
            "period": draft.between(0.6, 2),
            "phase": [0.0, 1.57],
        }
    else:
        controls: dict[str, dict[str, tuple[float, float]]] = {
            "car": {"torque": (-300, 1500), "steering_rate": (-0.2, 0.2)},
            "boat": {"thrust": (-500, 3000), "steering": (-20, 20)},
            "helicopter": {"collective": (16000, 21000), "pitch": (-1, 1), "roll": (-1, 1)},
            "two_wheeled": {"torque_right": (-1, 1), "torque_left": (-1, 1)},
        }
        rows = [{"frame": first + 12 * k} for k in range(3)]
        for row in rows:
            row |= {control: draft.between(*bounds) for control, bounds in controls[case].items()}
        motion["commands"] = rows
    if case == "boat":
        motion.pop("start")
        if draft.chance(0.6):
            world["water"] = {"sea": {"height": draft.between(0.2, 0.8), "seed": rng.randrange(100)}}
    if asset in ("helicopter", "boat") and draft.chance(0.3):
        world["wind"] = [draft.between(-4, 4), draft.between(-4, 4), 0]
    draft.table["vehicle"] = [{"name": "mover", "asset": asset, "motion": motion}]
    if world:
        draft.table["world"] = world


def _integrate(draft: Draft) -> None:
    draft.words.append("tumbler")
    start: Table = {"position": [draft.between(-5, 5) for _ in range(3)], "heading": draft.between(-180, 180)}
    start["velocity"] = [draft.between(-1, 1) for _ in range(3)]
    start["spin"] = [draft.between(-200, 200) for _ in range(3)]
    integrator = draft.rng.choice(("variational", "variational", "rk4", "lie_newmark"))
    motion = {"method": "integrate", "start": start, "duration": draft.between(1, 4, 1), "integrator": integrator}
    motion["step"] = draft.rng.choice((0.01, 0.02, 1 / 24))
    draft.table["vehicle"] = [{"name": "mover", "asset": "tumbler", "motion": motion}]


# ---------------------------------------------------------------- deliveries, words, TOML


def _delivery(draft: Draft) -> None:
    rng, shot = draft.rng, draft.table["shot"]
    ends = []
    for vehicle in draft.table["vehicle"]:
        motion = vehicle["motion"]
        if "duration" in motion:
            ends.append(shot["start_frame"] + math.ceil(motion["duration"] * draft.fps))
        elif motion["mark"][-1]["frame"] != "free":
            ends.append(motion["mark"][-1]["frame"] + motion["mark"][-1].get("hold", 0))
    if len(ends) == len(draft.table["vehicle"]) and draft.chance(0.25):
        shot["end_frame"] = max(ends) + rng.choice((0, 0, 3))
        if draft.chance(0.5):
            shot["handles"] = rng.choice((2, 8))
            draft.words.append("handles")
            for vehicle in draft.table["vehicle"]:
                if vehicle["motion"]["method"] == "simulate":  # continue to the last frame of the shot
                    del vehicle["motion"]["duration"]
    export: Table = {}
    if draft.chance(0.15):
        export["up_axis"] = "Y"
    if draft.chance(0.15):
        export["meters_per_unit"] = rng.choice((0.01, 0.3048, 0.001))
    if draft.chance(0.15):
        export["shutter"] = rng.choice(([-0.25, 0.25], [0.0, 0.5], [-0.5, 0.5]))
    if draft.chance(0.05):
        export["clip_frames"] = 20
    if export:
        draft.table["export"] = export
        draft.words.append("export")


def _word(draft: Draft, word: str) -> None:
    if word not in draft.words:
        draft.words.append(word)


def to_toml(table: Table) -> str:
    """A table as TOML, with nested tables inline."""
    lines = []
    for key, value in table.items():
        for row in value if key == "vehicle" else [value]:
            lines.append(f"[[{key}]]" if key == "vehicle" else f"[{key}]")
            lines += [f"{name} = {_inline(item)}" for name, item in row.items() if name != "motion"]
            if "motion" in row:
                lines += ["[vehicle.motion]"]
                lines += [f"{n} = {_inline(v)}" for n, v in row["motion"].items() if n not in ("mark", "look", "stay")]
                for name in ("mark", "look", "stay"):
                    for item in row["motion"].get(name, []):
                        lines += [f"[[vehicle.motion.{name}]]", *(f"{n} = {_inline(v)}" for n, v in item.items())]
    return "\n".join(lines) + "\n"


def _inline(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_inline(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inline(item) for item in value) + "]"
    return repr(value)
