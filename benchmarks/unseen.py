"""Random problems: how many plans are certified in each family, and why the others are not.

``python -m benchmarks.unseen [--families docking,parking] [--seeds 0-19] [--seconds 20]`` prints a line per problem and
writes ``RESULTS.unseen.md`` beside this file if all families are run. A plan counts if it succeeds within ``--seconds``
of CPU time. Without ``--seeds``, all problems of `SIZES` are run, each family at the same pace; finished ones are kept
in ``--out``, so an interrupted run continues, and ``--summary`` reports those that are finished.

Failures are examined: an independent sampling planner looks for a path (`sampling.py`), and the frame that the message
suggests is tried.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import time
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

import vehsim
from benchmarks import sampling
from benchmarks.machine import headed
from tools.seeds import seeds_in
from vehsim import Mark
from vehsim.errors import VehsimError
from vehsim.lie.quaternions import from_yaw
from vehsim.world.obstacles.obstacles import box, ellipse, polygon
from vehsim.world.terrain.terrain import Terrain

REST = (0.0, 0.0, 0.0)
FPS = 24
HEAD = """# Unseen problems, measured

`python -m benchmarks.unseen` plans problems that a seed makes: helicopters above random hills and through
gaps, wheels among random obstacles and into parking gaps, snakeboards from rest to rest, boats that dock in wind. The
character is the default; what takes too little time for it is driven in a harder one. *Certified* counts the plans that
succeed within {seconds:g} s of CPU time, first loads and distances to a new terrain included. Of the others, *no path*
counts those where a sampling planner of OMPL finds none in {patience:g} s, and *remedy helps* those whose message names
a later frame or a smaller clearance with which the same problem is certified. {finished} of the {all} problems of a
whole run are finished; they were run in turn, at the same pace in each family.

| family | problems | certified | no path | remedy helps | CPU, median s | 90 % | slowest |
|---|---|---|---|---|---|---|---|
"""


@dataclass
class Problem:
    """The arguments of `vehsim.plan`."""

    vehicle: str
    marks: list[Mark]
    world: Any = None
    asked: dict[str, Any] = field(default_factory=dict)

    def plan(self) -> Any:
        return vehsim.plan(vehsim.load_vehicle(self.vehicle), self.world, self.marks, **self.asked)


def docking(seed: int) -> Problem:
    """A boat comes alongside a jetty in wind, with its port or starboard side, from any side and heading."""
    rng = np.random.default_rng(seed)
    yaw, side, gap = rng.uniform(-np.pi, np.pi), rng.choice([-1, 1]), rng.uniform(0.6, 1.5)
    berth = rng.uniform(-10, 10, 2)
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    jetty = berth + side * (1.2 + gap + 1.2) * left + rng.uniform(-3, 3) * ahead
    bearing = yaw + side * -np.pi / 2 + rng.uniform(-1.2, 1.2)  # from the open water
    distance = rng.uniform(20, 60)
    start = berth + distance * np.array([np.cos(bearing), np.sin(bearing)])
    blowing, wind = rng.uniform(-np.pi, np.pi), rng.uniform(0, 8)
    first = rng.uniform(-np.pi, np.pi)
    seconds = distance / rng.uniform(1.2, 2.5) + rng.uniform(8, 16)
    world = vehsim.World(
        wind=(wind * np.cos(blowing), wind * np.sin(blowing), 0.0),
        obstacles=[box("jetty", (*jetty, -0.9), (16, 2.4, 1.5), heading=math.degrees(yaw))],
        water=0.0,
    )
    marks = [_posed(rng, 1, start, first), _posed(rng, 1 + round(FPS * seconds), berth, yaw)]
    return Problem("boat", marks, world, {"clearance": 0.5})


def _posed(rng: Any, frame: Any, place: Any, yaw: float) -> Mark:
    """A mark at rest that gives its attitude as a heading or as an orientation."""
    if rng.random() < 0.5:
        return Mark(frame, position=(*place, 0.0), heading=math.degrees(yaw), velocity=REST)
    return Mark(frame, position=(*place, 0.0), orientation=tuple(from_yaw(np.array([yaw]))[0]), velocity=REST)


def hills(seed: int) -> Problem:
    """A helicopter from rest to rest, low above random hills."""
    number = seed % TERRAINS
    terrain = _hills(np.random.default_rng(number), number)
    rng = np.random.default_rng([seed, 1])
    while True:
        a, b = rng.uniform(-85, 85, (2, 2))
        if np.linalg.norm(b - a) > 40:
            break
    places = [np.append(p, terrain.height(p[None])[0] + rng.uniform(7, 20)) for p in (a, b)]
    bearing = math.degrees(math.atan2(*(b - a)[::-1]))
    seconds = np.linalg.norm(places[1] - places[0]) / rng.uniform(5, 9) + rng.uniform(4, 8)
    end: Any = "free" if rng.random() < 0.3 else 1 + round(FPS * seconds)
    heading = [None if rng.random() < 0.5 else bearing + rng.uniform(-90, 90) for _ in range(2)]
    marks = [Mark(f, position=p, heading=h, velocity=REST) for f, p, h in zip((1, end), places, heading, strict=True)]
    return Problem("helicopter", marks, vehsim.World(terrain), {"clearance": float(rng.uniform(0.5, 2.0))})


def _hills(rng: Any, number: int) -> Terrain:
    """Heights over 240 x 240 m whose spectrum falls with the wave number, 20 to 60 m between lowest and highest."""
    n, cell = 81, 3.0
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(n), np.fft.fftfreq(n)))
    k[0, 0] = np.inf
    noise = np.fft.fft2(rng.standard_normal((n, n))) * k ** -rng.uniform(1.6, 2.2)
    heights = np.real(np.fft.ifft2(noise * np.exp(-((k / 0.12) ** 2))))
    heights = (heights - heights.min()) / np.ptp(heights) * rng.uniform(20, 60)
    return Terrain(f"hills {number}", heights, (-120.0, -120.0), (cell, cell))


def wheels(seed: int) -> Problem:
    """A car, a truck or a two-wheeled robot among random obstacles."""
    rng = np.random.default_rng(seed)
    name = str(rng.choice(["car", "simple_car", "two_wheeled", "truck"], p=[0.4, 0.2, 0.3, 0.1]))
    size = {"car": 1.0, "simple_car": 1.0, "two_wheeled": 0.15, "truck": 1.5}[name]
    length = size * rng.uniform(30, 70)
    yaw = rng.uniform(-1, 1, 2) * (np.pi if name == "two_wheeled" else 0.8)
    goal = np.array([length, rng.uniform(-0.3, 0.3) * length])
    found: list[Any] = []
    for i in range(int(rng.integers(4, 13))):
        centre, radius = rng.uniform([0.1 * length, -0.35 * length], [0.9 * length, 0.35 * length]), size
        radius = size * rng.uniform(0.8, 3.0)
        if min(np.linalg.norm(centre), np.linalg.norm(centre - goal)) < radius + 7 * size:
            continue
        if rng.random() < 0.5:
            found.append(ellipse(f"e{i}", centre, (radius, 0.6 * radius), heading=rng.uniform(0, 180)))
        else:
            angles = np.sort(rng.uniform(0, 2 * np.pi, 5))
            ring = centre + radius * np.column_stack([np.cos(angles), np.sin(angles)])
            found.append(polygon(f"p{i}", ring))
    pace = {"car": 6.0, "simple_car": 6.0, "two_wheeled": 0.7, "truck": 4.0}[name]
    end: Any = "free" if rng.random() < 0.3 else 1 + round(FPS * (1.4 * length / pace + 4))
    marks = [
        Mark(1, position=REST, heading=math.degrees(yaw[0]), velocity=REST),
        Mark(end, position=(*goal, 0.0), heading=math.degrees(yaw[1]), velocity=REST),
    ]
    return Problem(name, marks, vehsim.World(obstacles=found), {"clearance": 0.4 * size})


def parking(seed: int) -> Problem:
    """A car into a gap between two others, along the street or across it, nose or tail first, or out of it."""
    rng = np.random.default_rng(seed)
    along, out, turned = rng.random() < 0.6, rng.random() < 0.25, rng.random() < 0.3
    if along:
        ahead = 2.15 + 2.15 + rng.uniform(0.9, 2.0)
        boxes = [box(name, (x, -2.4, 0), (4.3, 1.8, 1.2)) for name, x in (("behind", -ahead), ("ahead", ahead))]
        boxes.append(box("kerb", (0, -4.2, 0), (30, 0.4, 0.3)))
        yaw = np.pi if turned and rng.random() < 0.3 else 0.0
        slot = np.array([0.0, -2.4])
    else:
        aside = 0.9 + 0.9 + rng.uniform(0.6, 1.2)
        boxes = [box(name, (x, -5.5, 0), (1.8, 4.3, 1.2)) for name, x in (("left", -aside), ("right", aside))]
        boxes.append(box("wall", (0, -9.0, 0), (30, 0.4, 2)))
        yaw = np.pi / 2 if turned else -np.pi / 2
        slot = np.array([0.0, -5.5])
    street = np.array([rng.choice([-1, 1]) * rng.uniform(7, 14), rng.uniform(0.0, 1.5)])
    way = 0.0 if rng.random() < 0.8 else np.pi
    ends = [(slot, yaw), (street, way)] if out else [(street, way), (slot, yaw)]
    boxes.append(box("houses", (0, 8.5, 0), (60, 1.0, 4)))
    seconds = rng.uniform(18, 30)
    end: Any = "free" if rng.random() < 0.3 else 1 + round(FPS * seconds)
    marks = [
        Mark(frame, position=(*place, 0.0), heading=math.degrees(angle), velocity=REST)
        for frame, (place, angle) in zip((1, end), ends, strict=True)
    ]
    return Problem("car", marks, vehsim.World(obstacles=boxes), {"clearance": 0.15})


def snakeboard(seed: int) -> Problem:
    """A snakeboard from rest to rest: ahead and sideways, with small and large turns."""
    rng = np.random.default_rng(seed)
    distance, bearing, turn = rng.uniform(1, 6), rng.uniform(-0.6, 0.6), rng.uniform(-90, 90)
    place = (distance * math.cos(bearing), distance * math.sin(bearing), 0.0)
    seconds = 3 + 2.2 * math.sqrt(distance) * rng.uniform(1.0, 1.6) + abs(turn) / 30
    marks = [Mark(1, position=REST, heading=0, velocity=REST)]
    marks.append(Mark(1 + round(FPS * seconds), position=place, heading=turn, velocity=REST))
    return Problem("snakeboard", marks)


def gaps(seed: int) -> Problem:
    """A helicopter, 10.8 m wide, through a gap of 13.5 to 18 m between walls, off-centre and turned."""
    rng = np.random.default_rng(seed)
    width, thick, yaw = rng.uniform(13.5, 18), rng.uniform(2, 20), rng.uniform(-0.5, 0.5)
    middle = np.array([60.0, rng.uniform(-15, 15)])
    ahead, left = np.array([np.cos(yaw), np.sin(yaw)]), np.array([-np.sin(yaw), np.cos(yaw)])
    if rng.random() < 0.5:
        walls = [
            box(name, (*(middle + side * (width / 2 + 100) * left), 0), (thick, 200, 90), heading=math.degrees(yaw))
            for name, side in (("left wall", 1), ("right wall", -1))
        ]
        world = vehsim.World("flat" if rng.random() < 0.6 else None, obstacles=walls)
    else:  # a ridge with a notch
        x = np.arange(-30.0, 151.0)
        places = np.stack(np.meshgrid(x, x - 60), axis=-1) - middle
        across, along = places @ ahead, places @ left
        heights = np.where((np.abs(across) < thick / 2 + 2) & (np.abs(along) > width / 2), 60.0, 0.0)
        world = vehsim.World(Terrain(f"notch {seed}", heights, (-30.0, -90.0), (1.0, 1.0)))
    z = rng.uniform(8, 30)
    marks = [Mark(1, position=(0, 0, z), heading=0.0, velocity=REST)]
    marks.append(Mark(1 + round(FPS * rng.uniform(14, 22)), position=(120, 0, z), velocity=REST))
    return Problem("helicopter", marks, world, {"limits": {"ceiling": 45.0}})


TERRAINS = 20
"""Number of random hills."""
FAMILIES: dict[str, Callable[[int], Problem]] = {
    "docking": docking, "hills": hills, "gaps": gaps, "wheels": wheels, "parking": parking, "snakeboard": snakeboard,
}  # fmt: skip
SIZES = {"docking": 100, "hills": 50 * TERRAINS, "gaps": 100, "wheels": 200, "parking": 100, "snakeboard": 100}
"""Number of problems of each family in a whole run."""


@dataclass(frozen=True)
class Outcome:
    """The result of one problem: CPU time s, and the message if it has no certified plan.

    ``path``: whether an independent sampling planner found one, None if it was not asked; ``helps``: whether the frame
    or the clearance that the message names helps, None if it names none.
    """

    family: str
    seed: int
    seconds: float
    success: bool
    message: str
    iterations: int = 0
    path: bool | None = None
    helps: bool | None = None

    def line(self) -> str:
        verdict = "certified" if self.success else f"FAILED: {self.message}"
        verdict += {None: "", True: "; sampling finds a path", False: "; sampling finds no path"}[self.path]
        verdict += {None: "", True: "; with this remedy: certified", False: "; with this remedy: FAILED"}[self.helps]
        return f"{self.family} {self.seed}: {self.seconds:.1f} s, {self.iterations} iterations, {verdict}"


def attempt(family: str, seed: int) -> Outcome:
    """Plan one problem; an error that vehsim raises becomes the message. Failures are examined."""
    problem, begun = FAMILIES[family](seed), time.process_time()
    try:
        plan = problem.plan()
    except VehsimError as error:
        outcome = Outcome(family, seed, time.process_time() - begun, False, str(error))
    else:
        outcome = Outcome(family, seed, time.process_time() - begun, plan.success, plan.message, plan.iterations)
    if outcome.success:
        return outcome
    return replace(outcome, path=sampling.find_path(problem), helps=_remedy_helps(problem, outcome.message))


def _remedy_helps(problem: Problem, message: str) -> bool | None:
    """Whether the later frame, or the clearance, that a message names is enough; None if it names none."""
    late = re.search(
        r"mark\[(\d+)\]\.frame = \d+ is too early; (?:use|the fastest motion found takes until) (\d+)", message
    )
    near = re.search(r"a motion was found with clearance = ([\d.e-]+)", message)
    if late is not None:
        marks = list(problem.marks)
        marks[int(late[1])] = replace(marks[int(late[1])], frame=int(late[2]))
        problem = replace(problem, marks=marks)
    elif near is not None:
        problem = replace(problem, asked={**problem.asked, "clearance": float(near[1])})
    else:
        return None
    try:
        return bool(problem.plan().success)
    except VehsimError:
        return False


def in_turn(families: list[str]) -> list[tuple[str, int]]:
    """All problems of the families, at the same pace in each, so that any first part of a run is a fair sample."""
    every = [(family, seed) for family in families for seed in range(SIZES[family])]
    return sorted(every, key=lambda one: (one[1] / SIZES[one[0]], families.index(one[0])))


def finished(path: Path) -> dict[tuple[str, int], Outcome]:
    """The outcomes in a file of results."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    outcomes = [Outcome(**json.loads(line)) for line in lines]
    return {(one.family, one.seed): one for one in outcomes}


def report(outcomes: list[Outcome], seconds: float) -> str:
    """The table by family, and the problems that are not certified within ``seconds``, slowest first."""
    rows, failures = [], []
    for family in dict.fromkeys(one.family for one in outcomes):
        found = sorted((one for one in outcomes if one.family == family), key=lambda one: -one.seconds)
        missed = [one for one in found if not one.success or one.seconds > seconds]
        times = [one.seconds for one in found]
        cells = [
            family, len(found), len(found) - len(missed), sum(one.path is False for one in missed),
            sum(one.path is not False and one.helps is True for one in missed), f"{np.median(times):.1f}",
            f"{np.quantile(times, 0.9):.1f}", f"seed {found[0].seed}: {times[0]:.1f} s",
        ]  # fmt: skip
        rows.append(f"| {' | '.join(map(str, cells))} |")
        failures += [f"- {one.line()}" for one in missed]
    counts = {"finished": len(outcomes), "all": sum(SIZES.values())}
    return headed(
        HEAD.format(seconds=seconds, patience=sampling.SECONDS, **counts) + "\n".join([*rows, "", *failures]) + "\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", default=",".join(FAMILIES), help="some of: %(default)s")
    parser.add_argument("--seeds", help="such as 0-19 or 3,5,8 [default: all]")
    parser.add_argument("--seconds", type=float, default=20.0, help="CPU time a plan may take [default: 20]")
    parser.add_argument("--out", type=Path, default=Path("out/unseen.jsonl"), help="file of results [%(default)s]")
    parser.add_argument("--summary", action="store_true", help="run nothing, report what is finished")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    families = options.families.split(",")
    problems = in_turn(families)
    if options.seeds:
        problems = [(family, seed) for family in families for seed in seeds_in(options.seeds)]
    done = finished(options.out)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    with options.out.open("a", encoding="utf-8") as file:
        for one in [] if options.summary else [one for one in problems if one not in done]:
            done[one] = attempt(*one)
            file.write(json.dumps(asdict(done[one])) + "\n")
            file.flush()
            print(done[one].line(), flush=True)
    text = report([done[one] for one in problems if one in done], options.seconds)
    print(text)
    if set(families) == set(FAMILIES):
        Path(__file__).with_name("RESULTS.unseen.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
