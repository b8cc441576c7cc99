"""Read and check command-line values: shots with all their errors, exporters, folders, frames.

Functions here return values or raise ``InputError``; they print nothing. The commands are in `commands.py`.
"""

from __future__ import annotations

import gc
import math
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from vehsim.errors import InputError, Problem, ShotError, VehsimError
from vehsim.runtime.registry import whose_error

if TYPE_CHECKING:
    from vehsim.shot import Shot
    from vehsim.world.terrain.terrain import Terrain


Item = TypeVar("Item")
Made = TypeVar("Made")


@contextmanager
def _keeping() -> Iterator[None]:
    """Exempt the objects loaded in this block from garbage collection, which would take a sixth of a command's
    start."""
    looked = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if looked:
            gc.enable()


@_keeping()
def load_all(
    paths: Sequence[Path],
    overrides: Sequence[str],
    only: Sequence[str] = (),
    may: Callable[[Shot], None] = lambda shot: None,
) -> tuple[list[Shot], list[Problem]]:
    """The valid shots, with sweeps expanded, and everything that is wrong with the others.

    ``may``: raises ``InputError`` if a shot cannot be processed.
    """
    from vehsim.batch.sweep import load_shots

    loaded: dict[str, Shot] = {}
    problems: list[Problem] = []
    for path in paths:
        try:
            shots = [shot.only(only) if only else shot for shot in load_shots(path, overrides)]
        except Exception as error:
            problems += _problems_of(error, str(path))
            continue
        checked, faults = each(shots, lambda shot: (shot, shot.check()))
        problems += [problem for problem in faults if problem not in problems]
        for shot, found in checked:
            # Each shot gets its own folder, also on file systems that ignore case.
            if (key := shot.name.casefold()) in loaded:
                remedy = "give every shot of a batch a name of its own"
                found.append(Problem("shot.name", f"{loaded[key].source} has it too", remedy, shot.name, str(path)))
            try:
                may(shot)
            except InputError as error:
                found += [replace(problem.seen_from("export"), file=str(path)) for problem in error.problems]
            problems += [problem for problem in found if problem not in problems]
            if all(problem.severity == "warning" for problem in found):
                loaded[key] = shot
    return list(loaded.values()), problems


def each(
    items: Sequence[Item], do: Callable[[Item], Made], file: Callable[[Item], str] = attrgetter("source")
) -> tuple[list[Made], list[Problem]]:
    """Apply ``do`` to every shot, or to other items with a ``file``; return the results and the problems. An exception
    in one does not stop the others."""
    made: list[Made] = []
    problems: list[Problem] = []
    for item in items:
        try:
            made.append(do(item))
        except Exception as error:
            problems += _problems_of(error, file(item))
    return made, problems


def _problems_of(error: Exception, file: str) -> list[Problem]:
    """The problems that an exception means for a shot's file: wrong input, or an error of vehsim, named as such."""
    if isinstance(error, ShotError):
        return error.problems
    if isinstance(error, InputError):
        return [_seen_in(file, problem) for problem in error.problems]
    if isinstance(error, VehsimError):
        return [replace(_seen_in(file, problem), severity="fault") for problem in error.problems]
    # For example an asset without read permission, or a cache on a full disk.
    if isinstance(error, OSError) and error.filename:
        return [Problem(str(error.filename), str(error.strerror), "fix that", file=file)]
    if os.environ.get("VEHSIM_DEBUG"):
        raise error
    message = f"{type(error).__name__}: {error}; this is {whose_error(error)}"
    return [Problem("unexpected", message, "set VEHSIM_DEBUG=1 to see the traceback", file=file, severity="fault")]


def _seen_in(file: str, problem: Problem) -> Problem:
    """A problem of what ``file`` names, or of the file itself."""
    if problem.file.startswith(file):
        return problem
    return replace(problem if problem.key and not problem.file else problem.seen_from("shot"), file=file)


@_keeping()
def exporters_in(text: str) -> list[str]:
    """The exporter names in a list such as ``usd,png``. Raises ``InputError`` for unknown names."""
    from vehsim.delivery.exporters import exporter_names, in_order

    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise InputError("names no exporter", f"choose from {', '.join(exporter_names())}", key="--to", value=text)
    in_order(names)
    return names


def check_folder(out: Path) -> None:
    """Check that ``--out`` is a folder or can become one."""
    if taken := [path for path in (out, *out.parents) if os.path.exists(path) and not os.path.isdir(path)]:
        raise InputError(f"{taken[0]} is a file", "give a folder", key="--out", value=str(out))


def check_delivery(names: Sequence[str], out: Path, shot: Shot) -> None:
    """Check that the exporters ``names`` can deliver ``shot`` to ``out``."""
    from vehsim.delivery.exporters import check_ready
    from vehsim.delivery.folders import may_hold_versions, may_replace

    check_ready(names, shot.usd.layer_only)
    (may_hold_versions if shot.usd.versions else may_replace)(out / shot.name)
    home = out / shot.name if shot.usd.versions else out
    there = next(path for path in (home, *home.parents) if os.path.exists(path))
    if not os.access(there, os.W_OK):  # Report this now, not after a thousand clips were solved.
        raise InputError("no permission to write there", "export elsewhere, or fix its permissions", file=there)


def stages_in(paths: Sequence[Path]) -> list[Path]:
    """The files, and those of USD in the folders, at any depth. Raises ``ShotError`` for a folder without any."""
    from vehsim.intake.usd import SUFFIXES

    found, problems = [], []
    for path in paths:
        inside = sorted(file for file in path.rglob("*") if file.suffix in SUFFIXES) if path.is_dir() else [path]
        if not inside:
            problems.append(
                Problem("STAGE", "a folder without USD files", "give a folder that export wrote", str(path))
            )
        found += inside
    if problems:
        raise ShotError(problems)
    return found


def check_stages(paths: Sequence[Path]) -> None:
    """Check that the files have names that USD can open; their content is not read."""
    from vehsim.intake.usd import SUFFIXES

    problems = []
    for path in paths:
        if not path.is_file():
            message = "a folder" if path.is_dir() else "no such file"
            problems.append(Problem("STAGE", message, "give a USD file: .usd, .usda, .usdc or .usdz", str(path)))
        elif path.suffix not in SUFFIXES or path.stat().st_size == 0:
            problems.append(Problem("STAGE", "not USD", "give a .usd, .usda, .usdc or .usdz file", str(path)))
    if problems:
        raise ShotError(problems)


def summary(shot: Shot) -> str:
    moved = ", ".join(f"{vehicle.name} ({vehicle.asset}, {vehicle.motion.method})" for vehicle in shot.file.vehicle)
    world = shot.file.world
    near = f"among {len(world.obstacle)} obstacles" if world.obstacle else "in empty space"
    place = f"in {world.terrain}" if world.terrain else "on water" if world.water else near
    return f"{moved} {place} at {shot.fps} fps"


def chosen_frames(shot: Shot) -> Iterator[str]:
    """The frames of an animator's blocking that become marks, one line per vehicle."""
    marks: dict[str, Any] = {table.name: getattr(table.motion, "marks", None) for table in shot.file.vehicle}
    for name, blocking in shot.blockings().items():
        chosen = marks[name].frames
        keys = list(blocking.keys) if chosen is None else [(frame, 0) for frame in chosen]
        frames = (f"{frame} to {frame + hold}" if hold else str(frame) for frame, hold in keys)
        yield f"{name}: marks from {blocking.prim} at frames {', '.join(frames)}"


def bounds(control: Any) -> str:
    unit = f" {control.unit}" if control.unit else ""
    return f"{control.name} ({control.lower:g} to {control.upper:g}{unit})"


def frames_in(text: str | None) -> list[int] | None:
    """The frames of ``1001-1100x10``, or ``-40--10``; None means all."""
    if text is None:
        return None
    found = re.fullmatch(r"(-?\d{1,8})(?:-(-?\d{1,8}))?(?:x(\d{1,8}))?", text.strip())
    wanted = range(0)
    if found and int(found[3] or 1) > 0:
        wanted = range(int(found[1]), int(found[2] or found[1]) + 1, int(found[3] or 1))
    if not 0 < len(wanted) <= 100_000:
        raise InputError("not a range of frames", "give it as 1001-1100x10", key="--frames", value=text)
    return list(wanted)


def size_in(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d{1,6})x(\d{1,6})", text.strip())
    if not found or not all(16 <= int(side) <= 8192 for side in found.groups()):
        raise InputError("not a picture size", "give it as 960x540, each side 16 to 8192", key="--size", value=text)
    return int(found[1]), int(found[2])


def points_in(texts: Sequence[str]) -> list[tuple[float, float]]:
    """The points (x, y) in m of ``0 0 10 -5`` or ``0,0 10,-5``."""
    try:
        numbers = [float(number) for text in texts for number in text.split(",") if number.strip()]
    except ValueError as error:
        raise InputError(str(error), "give numbers in m, such as 12.5 -3", key="X Y") from None
    if len(numbers) % 2:
        raise InputError(f"{len(numbers)} numbers", "give x and y of each point in m", key="X Y", value=numbers)
    if not all(math.isfinite(number) for number in numbers):
        raise InputError("not finite", "give numbers in m, such as 12.5 -3", key="X Y", value=numbers)
    return list(zip(numbers[::2], numbers[1::2], strict=True))


def heights(terrain: Terrain, points: Sequence[tuple[float, float]], water: float | None = None) -> list[str]:
    """One line per point: the ground's height, its slope and the direction of the rise. ``water``: level of still
    water, m.

    Raises ``ShotError`` if a point lies outside the terrain.
    """
    import numpy as np

    (x0, y0, _), (x1, y1, _) = terrain.lower, terrain.upper
    near = 1e-3  # m; extents are printed rounded
    outside = [(x, y) for x, y in points if not (x0 - near <= x <= x1 + near and y0 - near <= y <= y1 + near)]
    extent = f"x {x0:g} to {x1:g}, y {y0:g} to {y1:g} m"
    if outside:
        raise ShotError(
            [Problem("X Y", f"outside the terrain {terrain.name!r}", f"it covers {extent}", list(p)) for p in outside]
        )
    lines = []
    for (x, y), z in zip(points, terrain.height(points), strict=True):
        dx, dy = _gradient(terrain, x, y)
        slope, uphill = np.degrees(np.arctan(np.hypot(dx, dy))), np.degrees(np.arctan2(dy, dx))
        rise = f"slope {slope:.1f} deg, rising towards heading {uphill:.0f} deg" if slope >= 0.05 else "level"
        below = "" if water is None else f", {water - z:.2f} m of water" if water > z else ", above the water"
        lines.append(f"{x:g} {y:g}: {z:.3f} m, {rise}{below}")
    return lines


def _gradient(terrain: Terrain, x: float, y: float) -> tuple[float, float]:
    """Slope of the ground along x and y, over one cell about the point and inside the terrain."""
    (x0, y0, _), (x1, y1, _), (dx, dy) = terrain.lower, terrain.upper, terrain.cell
    west, east, south, north = max(x - dx / 2, x0), min(x + dx / 2, x1), max(y - dy / 2, y0), min(y + dy / 2, y1)
    a, b, c, d = terrain.height([(west, y), (east, y), (x, south), (x, north)])
    return (b - a) / (east - west), (d - c) / (north - south)


SECONDS_PER_MEGAPIXEL = 0.6
"""CPU seconds per million pixels without a GPU: 128 pictures of 960 x 540 took 34."""
LONG = 60.0
"""Estimated seconds of rendering above which a hint is printed."""
FREE = 10.0
"""Assumed duration of a leg to a mark without a frame, s."""


def film_hint(shots: Sequence[Shot], names: Sequence[str], draft: bool) -> str | None:
    """A hint for renders that would take minutes; None if there are few pictures."""
    from vehsim.delivery.exporters import in_order

    slow = [exporter.name for exporter in in_order(names) if exporter.every_frame]
    pictures, seconds = 0, 0.0
    for shot in shots if slow else ():
        render = shot.render.draft() if draft else shot.render
        count = _frames(shot) // render.every * (len(render.cameras or shot.file.camera))
        pictures += count
        seconds += count * render.size[0] * render.size[1] / 1e6 * SECONDS_PER_MEGAPIXEL
    if seconds < LONG:
        return None
    films = ", ".join(name for name in names if slow[0] in (one.name for one in in_order([name])))
    quicker = "" if draft else ", or --quality draft"
    return (
        f"{films}: about {pictures} pictures, about {math.ceil(seconds / 60)} minutes without a GPU; "
        f"for a quick look: --to strobe,figures{quicker}"
    )


def _frames(shot: Shot) -> int:
    """The number of frames of a shot, as far as its file determines it."""
    header, fps = shot.file.shot, float(shot.fps)
    if header.last is not None:
        return header.last - header.first + 1
    ends = []
    for table in shot.file.vehicle:
        marks = getattr(table.motion, "mark", None) or []
        known = [mark.given_frame for mark in marks if mark.given_frame is not None]
        free = (len(marks) - len(known)) * FREE
        seconds = getattr(table.motion, "duration", None) or 0.0
        ends.append(max([header.first, *known]) + (free + seconds) * fps)
    return round(max(ends) - header.first) + 1
