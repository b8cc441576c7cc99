"""Every snippet of every page runs alone, in an empty folder, and does what its text says.

Pages are README.md and docs/*.md. A fence names its language: ``toml`` (a whole shot, a piece of one, or a
vehicle.toml), ``python``, ``sh``, or ``text`` for anything that is not code. A piece of a shot is put into the
cookbook's first shot, as its reader would do, solved and exported; ``tools/audit_random/verify.py``, which reads only
the stage and the shot file, and ``vehsim audit`` then measure the delivery. Python runs in a separate interpreter,
followed by assertions; commands run in a shell. `TOML`, `PYTHON` and `SHELL` contain the other promises of each text:
an entry without a snippet fails.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
import typer

import vehsim
from vehsim.batch import load_shots
from vehsim.cli.commands import app
from vehsim.exporters.checks.audit import audit_delivery

ROOT = Path(vehsim.__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = ROOT / "tests" / "assets_elsewhere"
PATIENCE = 600.0
"""Time limit on a busy machine, s: only a failing test waits that long."""
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)

SMALL = """
[shot]
schema = 1
name = "small"
[[vehicle]]
name = "heli"
asset = "helicopter"
[vehicle.motion]
method = "simulate"
duration = 0.25
pilot = { name = "hover", position = [0, 0, 20] }
start = { position = [0, 0, 20] }
[render]
size = [96, 64]
samples = 0
shadows = false
"""
"""The shot that commands and scripts call shot.toml; they need one to load."""


class Snippet(NamedTuple):
    page: Path
    line: int
    language: str
    text: str
    title: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def snippets(page: Path) -> Iterator[Snippet]:
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        above = text[: match.start()]
        yield Snippet(page, above.count("\n") + 1, match[1], match[2], HEADING.findall(above)[-1])


EVERY = [snippet for page in PAGES for snippet in snippets(page)]
BASE = next(snippet.text for snippet in EVERY if snippet.page.name == "cookbook.md" and snippet.language == "toml")


def written(language: str) -> list[Any]:
    return [pytest.param(snippet, id=str(snippet)) for snippet in EVERY if snippet.language == language]


def test_every_fence_says_its_language() -> None:
    unknown = [str(snippet) for snippet in EVERY if snippet.language not in ("toml", "python", "sh", "text")]
    assert not unknown, "give ```toml, ```python, ```sh, or ```text for what is no code"


# ---------------------------------------------------------------- shots


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


verify = load(ROOT / "tools" / "audit_random" / "verify.py")


def whole(piece: str) -> str:
    """A piece put into the cookbook's first shot, in place of the values that it gives."""
    given = tomllib.loads(piece)
    if "shot" in given:
        return piece
    head, motion = BASE.split("[vehicle.motion]")
    if "world" in given:
        head = re.sub(r"\[world\]\n(?:\w.*\n)*", "", head)
    method = given.get("vehicle", {}).get("motion", {}) if isinstance(given.get("vehicle"), dict) else {}
    if "method" not in method:
        return f"{head}[vehicle.motion]{motion}\n{piece}"
    return (head.replace('"helicopter"', '"car"') if method["method"] == "sinusoid" else head) + piece


def examine(delivery: Path, shot: Path) -> None:
    """Measure a delivery against everything that was requested, from its files alone."""
    (stage,) = delivery.glob("*.usda")
    assert [row.text for row in verify.verify(tomllib.loads(shot.read_text()), stage).rows] == []
    if not list(delivery.glob("v*")):
        missed = [str(row) for rows in audit_delivery(delivery).values() for row in rows if row.met is False]
        assert missed == []


def clip_of(take: Any) -> Any:
    (clip,) = take.clips.values()
    return clip.resample()


def cameras_and_cut(take: Any, delivery: Path) -> None:
    assert [camera.name for camera in take.cameras] == ["wide", "close", "cut"]
    (cut,) = [camera for camera in take.cameras if camera.name == "cut"]
    for name, seen in (("wide", cut.frames < 1060), ("close", cut.frames > 1060)):
        (camera,) = [camera for camera in take.cameras if camera.name == name]
        seen &= np.isin(cut.frames, camera.frames)
        rows = np.searchsorted(camera.frames, cut.frames[seen])
        assert seen.sum() > 50 and np.allclose(cut.positions[seen], camera.positions[rows])


def for_maya(take: Any, delivery: Path) -> None:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(delivery.parent / "latest.usda"))
    assert delivery.name == "v001" and (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (993, 1108)
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 0.01)
    cameras = [UsdGeom.Camera(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Camera)]
    assert cameras and all(camera.GetShutterOpenAttr().Get() == -0.25 for camera in cameras)


def heavy(take: Any, delivery: Path) -> None:
    """At the same torque the acceleration is F / (m + I / r^2)."""
    reached = float(take.clips["car"].positions[-1, 0])
    assert reached == pytest.approx(1800 / 0.32 / (1500 + 2.4 / 0.32**2) * 3.0**2 / 2, rel=1e-3)


def slides(take: Any, delivery: Path) -> None:
    """It rolls at first; the handbrake locks the rear wheels, and the car slides sideways until it stands."""
    clip = take.clips["car"]
    aside = np.degrees(np.abs(np.arctan2(clip.twists[:, 2], clip.twists[:, 1])))
    rolling = clip.frames < 1007
    assert aside[rolling].max() < 0.1 and np.abs(clip.channels["slip_rl"][rolling]).max() < 0.1
    assert aside.max() > 45 and np.abs(clip.channels["slip_rl"]).max() > 5


def red(take: Any, delivery: Path) -> None:
    from pxr import Usd

    stage = Usd.Stage.Open(str(delivery / "fast_car.usda"))
    assert stage.GetPrimAtPath("/fast_car/vehicles/car").GetVariantSet("livery").GetVariantSelection() == "red"


def third_manoeuvre(take: Any, delivery: Path) -> None:
    """``vehsim manoeuvres`` lists at least three, and the third can be chosen."""
    third = (delivery.parents[1] / "shot.toml").read_text().replace('"sinusoid"', '"sinusoid"\nmanoeuvre = 3')
    third_shot = vehsim.Shot.from_dict(tomllib.loads(third))
    assert [str(problem) for problem in third_shot.check() if problem.severity == "error"] == []


def turns(take: Any, delivery: Path) -> None:
    forward = clip_of(take).matrices()[:, :3, 0]
    headings = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    assert abs(headings[-1] - headings[0]) > np.radians(20) and np.ptp(clip_of(take).positions[:, 2]) > 0.1


def drifts(take: Any, delivery: Path) -> None:
    assert clip_of(take).positions[-1, 1] > 0.5  # the wind blows to +Y


def bumps(take: Any, delivery: Path) -> None:
    assert any(event["kind"] == "contact" for event in clip_of(take).events)


def clips(count: int) -> Callable[[Any, Path], None]:
    def counted(take: Any, delivery: Path) -> None:
        shots = load_shots(delivery.parents[1] / "shot.toml")
        assert len({shot.name for shot in shots}) == count

    return counted


def eases(take: Any, delivery: Path) -> None:
    """The torque is zero on the first and the last frame."""
    clip = clip_of(take)
    assert np.abs(clip.controls[[0, -1], 0]).max() < 0.01 * np.abs(clip.controls[:, 0]).max()


def nothing_more(take: Any, delivery: Path) -> None:
    """The request is all that the text promises."""


def few_keys(take: Any, delivery: Path) -> None:
    report = json.loads((delivery / "report.json").read_text())
    (vehicle,) = report["vehicles"].values()
    assert (delivery / "layers" / "heli.curves.usda").is_file() and vehicle["curves"]["share_of_samples"][
        "others"
    ] < 0.3


TOML: dict[str, Callable[[Any, Path], None]] = {
    "Parameters": heavy,
    "Curves to edit": few_keys,
    "A car that slips": slides,
    "Cookbook": nothing_more,
    "Let the planner choose the arrival, then stay for two seconds": nothing_more,
    "Fly through a ring": nothing_more,
    "Keep the nose on the subject, below the clouds": nothing_more,
    "Make a cycle for the background": nothing_more,
    "Drive as fast as the tyres grip": red,
    "Park in a gap": third_manoeuvre,
    "Turn a boat in a swell": turns,
    "Drift in gusts": drifts,
    "Bump into things": bumps,
    "Use two cameras and a cut": cameras_and_cut,
    "Deliver for Maya: centimetres, Y up, motion blur, handles": for_maya,
    "Export forty variations on every core, and resume after a crash": clips(40),
    "A shot": nothing_more,
    "Sweeps": clips(200),
    '`method = "plan"`: through marks at the least cost': nothing_more,
    "For animators": nothing_more,
    "The character of a motion": eases,
}
"""Heading -> what the text promises in addition to its shot's requests."""


@pytest.mark.parametrize("snippet", [s for s in written("toml") if "model" not in tomllib.loads(s.values[0].text)])
def test_shots_do_what_they_say(snippet: Snippet, tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    path = tmp_path / "shot.toml"
    path.write_text(whole(snippet.text), encoding="utf-8")
    swept = "[sweep]" in snippet.text
    shots = [vehsim.Shot.from_dict(shot.file.model_dump(by_alias=True, exclude_unset=True), tmp_path)
             for shot in load_shots(path)[:: 20 if swept else 1]][:2]  # fmt: skip
    for shot in shots:
        assert [str(problem) for problem in shot.check()] == []
        take = shot.solve()
        delivery = take.export(tmp_path / "out", to=("usd", "npz"))
        if not swept:
            examine(delivery, path)
            TOML[snippet.title](take, delivery)
    if swept:
        TOML[snippet.title](None, tmp_path / "out" / "swept")
    assert [str(warning.message) for warning in recwarn if warning.category is UserWarning] == []


@pytest.mark.parametrize("snippet", [s for s in written("toml") if "model" in tomllib.loads(s.values[0].text)])
def test_vehicle_tomls_move_their_rigs(snippet: Snippet, tmp_path: Path) -> None:
    """Use this vehicle.toml for the vehicle of that name, shipped or foreign."""
    name = tomllib.loads(snippet.text)["name"]
    homes = [ROOT / "assets" / "vehicles" / name, ROOT / "tests" / "assets_elsewhere" / name]
    shutil.copytree(next(home for home in homes if home.is_dir()), tmp_path / name)
    (tmp_path / name / "vehicle.toml").write_text(snippet.text, encoding="utf-8")
    vehicle = vehsim.load_vehicle(str(tmp_path / name))
    assert vehicle.name == name
    motion = {"method": "simulate", "duration": 0.25, "start": {"position": [0, 0, 20 * (vehicle.group.dim == 6)]}}
    data = {"shot": {"schema": 1, "name": "rigged"}, "vehicle": [{"name": "it", "asset": name, "motion": motion}]}
    shot = vehsim.Shot.from_dict(data, tmp_path)
    assert [str(problem) for problem in shot.check() if problem.severity == "error"] == []
    assert (shot.solve().export(tmp_path / "out") / "rigged.usda").is_file()


# ---------------------------------------------------------------- scripts

PYTHON = {
    "README.md: A shot": """
from pathlib import Path
assert Path("out/small/small.usda").is_file() and list(Path("out/small").glob("*.mp4"))
assert clip.positions.shape[1] == 3 and clip.orientations.shape[1] == 4
""",
    "getting-started.md: From Python": """
from pathlib import Path
assert plan.success and plan.clearance >= 1 - 1e-3
assert abs(plan.clip.positions[-1] - (180, 40, 28)).max() < 1e-3
assert Path("out/canyon.usda").is_file()
""",
    "cookbook.md: Take marks from an animator's blocking": """
from pathlib import Path
frames = take.clips["heli"].resample()
for frame, place in {1001: (0, 0, 20), 1049: (15, 0, 22), 1097: (30, 10, 20)}.items():
    assert abs(frames.positions[frame - 1001] - place).max() < 0.5 + 1e-3
out = take.export("out")
assert take.report["vehicles"]["heli"]["blocking"]["keys"] == [1001, 1049, 1097]
moved = Usd.Stage.Open(str(out / "layers" / "heli.blocking.usdc"))
assert max(one.GetNumTimeSamples() for one in moved.GetPrimAtPath("/World/heli").GetAttributes()) == 97
""",
    "cookbook.md: Get the motion as arrays": """
assert abs(clip.positions - (0, 0, 30)).max() < 0.3  # it hovers, and finds its lean
assert between.times.tolist() == np.linspace(0.0, 1.0, 101).tolist()
assert (vehsim.Clip.load("hover.npz").positions == clip.positions).all()
""",
    "cookbook.md: Write your own pilot": """
from pathlib import Path
assert Path("weave/weave.usda").is_file() and clip.positions[-1, 0] > 1
assert (np.diff(np.sign(np.diff(clip.positions[:, 1]))) != 0).any()  # to and fro
""",
    "cookbook.md: Move a mark and plan again from the last plan": """
assert plan.success and again.success and again.executed.final < 0.1
assert abs(again.clip.positions[-1] - (30, 12, 0)).max() < 1e-3
""",
    "cookbook.md: Keep clear of obstacles, and measure the clearance": """
assert plan.success and plan.clearance >= 0.5 - 1e-3
assert abs(plan.clip.positions[-1] - (45, 0, 0)).max() < 1e-3
""",
    "cookbook.md: Fly through an arch": """
from pathlib import Path
assert plan.success and plan.clearance >= 1.5 - 0.01 and Path("arch/arch.usda").is_file()
at = abs(plan.clip.positions[:, 0]).argmin()
assert abs(plan.clip.positions[at, 1]) < 20 and plan.clip.positions[at, 2] < 20  # below the ring, whose radius is 20 m
""",
    "cookbook.md: Define a vehicle in fifteen lines": """
assert abs(clip.twists[1:, 2]).max() < 1e-6  # never sideways
assert abs(clip.energy["kinetic"] / clip.energy["kinetic"][0] - 1).max() < 1e-6
assert abs(clip.positions[-1, :2]).max() > 1
""",
    "audit.md: In Python": """
assert {row.key for row in plan.audit} >= {"mark[1].position", "mark[1].hold"} and all(row.met for row in plan.audit)
""",
    "audit.md: A clip of your own": """
assert [row.key for row in rows] == ["hover.position"]
""",
    "batch.md: From Python": """
    from pathlib import Path
    assert [path.name for path in Path("out").glob("*/*.usda")] == ["small.usda"] and shots
""",
    'shot-file.md: `method = "plan"`: through marks at the least cost': """
import numpy as np
whole = plan.clip.resample()
assert plan.success and (whole.positions[:, 0] <= 8 + 2 * whole.times + 1e-3).all()
forward, there = whole.matrices()[:, :2, 0], np.array([10, 30]) - whole.positions[:, :2]
cosines = (forward * there).sum(axis=1) / np.linalg.norm(forward, axis=1) / np.linalg.norm(there, axis=1)
assert (np.degrees(np.arccos(cosines))[120:241] <= 30 * 1.01).all()
""",
    "sinusoids.md: In Python": """
assert found.growth == (2, 3, 4) and found.brackets == 2 and found.levels == 3
""",
}
"""Page and heading -> assertions after the script, in Python."""


@pytest.mark.parametrize("snippet", [s for s in written("python") if "def test_" not in s.values[0].text])
def test_python_does_what_it_says(snippet: Snippet, tmp_path: Path) -> None:
    for name in ("shot.toml", "shots/run.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(SMALL, encoding="utf-8")
    script = tmp_path / "snippet.py"
    script.write_text(snippet.text + PYTHON[f"{snippet.page.name}: {snippet.title}"], encoding="utf-8")
    command = [sys.executable, "-I", "-W", "error::UserWarning", script.name]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0, done.stderr[-3000:]


def test_pictures_are_guarded_by_the_fixture(tmp_path: Path) -> None:
    """docs/regression.md: its tests and its commands, on pictures that were rendered before."""
    code = next(s.text for s in EVERY if s.page.name == "regression.md" and "def test_" in s.text)
    commands = next(s.text for s in EVERY if s.page.name == "regression.md" and "--update-renders" in s.text)
    (tmp_path / "shot.toml").write_text(SMALL.replace('"small"', '"canyon_flight"'), encoding="utf-8")
    run("vehsim export shot.toml --out out", tmp_path)
    (stage,) = (tmp_path / "out" / "canyon_flight").glob("*.usda")
    run(f"vehsim render {stage} --out renders/comp --frames 1001-1002 --size 64x36", tmp_path)
    (tmp_path / "test_renders.py").write_text(code.replace("1117, 1217", "1003, 1005"), encoding="utf-8")
    run(commands.replace("pytest", "pytest -p no:cacheprovider"), tmp_path)
    picture = next((tmp_path / "renders" / "comp").rglob("*.png"))
    picture.write_bytes(b"")  # no longer a picture
    assert run("pytest -p no:cacheprovider", tmp_path, code=1)


# ---------------------------------------------------------------- commands


def run(text: str, folder: Path, code: int = 0) -> str:
    """The output of a shell in ``folder``, with this interpreter's commands."""
    environment = os.environ | {"PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    environment.pop("PYTEST_ADDOPTS", None)
    text = text.replace(".venv/bin/", "")
    done = subprocess.run(
        ["bash", "-euc", text], cwd=folder, env=environment, capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == code, (text, done.stdout[-1500:], done.stderr[-1500:])
    return done.stdout


class Shell(NamedTuple):
    """What a command needs beside ``shot.toml``: files by name; and patterns of the files that it leaves."""

    leaves: tuple[str, ...] = ()
    files: dict[str, str] = {}  # noqa: RUF012
    before: str = ""
    """commands to run first"""


MY_SHOT = SMALL.replace('"small"', '"my_shot"')
SHELL: dict[str, Shell | str] = {
    "README.md: Two commands": "minutes of work; `make demo` is examples/canyon_flight.toml, `make test` these tests",
    "README.md: A shot": Shell(("out/small/small.usda", "out/small/small.chase.mp4")),
    "getting-started.md: Getting started": "the same",
    "README.md: Your own shot in ten minutes": "each of its commands is run by tests/cli: test_new, test_inspect",
    "getting-started.md: Your own shot": Shell(
        ("out/first/first.usda", "out/first/first.strobe.png", "out/first/figures/car.*")
    ),
    "audit.md: The audit": Shell(("out/small/report.json",)),
    "cookbook.md: Write a first shot of any vehicle": Shell(("first.toml", "fly.toml", "drive.toml")),
    "cookbook.md: Drive an asset of your own": Shell(
        ("vehicles/kart/vehicle.toml", "race.toml"), {"kart.obj": (ELSEWHERE / "kart" / "kart.obj").read_text("utf-8")}
    ),
    "browser.md: A shot in the browser": Shell(("out/small/small.html",)),
    "browser.md: Edit it": "a session without an end; tests/live runs it",
    "batch.md: A thousand clips": Shell(
        ("out/a/a.usda", "out/b/*.mp4", "out/b/frames/*/*.png", "out/summary.json"),
        {f"shots/{name}.toml": SMALL.replace('"small"', f'"{name}"') for name in "ab"},
    ),
    "cookbook.md: Deliver only the layer, one file, keys for Blender, or a still": Shell(
        (
            "out/small/layers/heli.anim.usdc",
            "out/small/small.usdz",
            "out/small/small.strobe.png",
            "out/small/figures/heli.*",
        )
    ),
    "cookbook.md: Export forty variations on every core, and resume after a crash": Shell(
        ("out/small/small.usda", "out/small/*.mp4")
    ),
    "cookbook.md: Check whether pictures have changed": Shell(
        ("renders/*/*.1001.png", "renders/*/*.1121.png"),
        {"shot.toml": MY_SHOT.replace("0.25", "5.0")},
        "vehsim export shot.toml --out out; vehsim render out/my_shot/my_shot.usda --out references "
        "--frames 1001-1121x24",
    ),
    "character.md: Compare a motion with a real machine": Shell(
        ("out/gentle_start.review.html",),
        {"shot.toml": SMALL.replace('"small"', '"gentle_start"')},
        "vehsim export shot.toml --out out",
    ),
    "regression.md: Without pytest": Shell(
        ("renders/*/*.1001.png", "renders/*/depth/*.tif"),
        {"shot.toml": SMALL.replace('"small"', '"canyon_flight"').replace("0.25", "27.0")},
        "vehsim export shot.toml --out out; vehsim render out/canyon_flight/canyon_flight.usda --out approved "
        "--frames 1001-1649x48 --passes depth,segmentation",
    ),
    "other-tools.md: glTF": Shell(("out/small/small.glb",)),
    "riggers-guide.md: What comes out": Shell(
        ("out/shot/shot.usda",), {"shot.toml": SMALL.replace('"small"', '"shot"')}
    ),
    "shot-file.md: Overrides": Shell(("out/my_shot/my_shot.usda",), {"shot.toml": BASE}),
    "tutorial-own-vehicle.md: A vehicle of your own, from a blank page": Shell(("out/cart.usda",)),
    "vehicles.md: How the assets are made": "writes into the package; tests/parts compares what it generates",
}
"""Page and heading -> what commands need and leave, or why they are only parsed."""


@pytest.mark.parametrize("snippet", written("sh"))
def test_commands_do_what_they_say(snippet: Snippet, tmp_path: Path) -> None:
    for line in snippet.text.replace("\\\n", " ").splitlines():
        if words := shlex.split(line, comments=True):
            understand(words)
    if snippet.text.startswith("pytest"):  # run above, with the tests that they belong to
        return
    text = snippet.text
    if "blend" in text and shutil.which("blender") is None:
        lines = [line for line in text.splitlines() if re.search("blend|cycles|,abc", line)]
        for line in lines:
            if line.startswith("vehsim"):
                (tmp_path / "shot.toml").write_text(SMALL, encoding="utf-8")
                run(line, tmp_path, code=2)
                shutil.rmtree(tmp_path / "out", ignore_errors=True)
        text = "\n".join(line for line in text.splitlines() if line not in lines)
        if not text.strip():
            pytest.skip("no Blender here: that its exporters say so was tried, not what they write")
    wanted = SHELL[f"{snippet.page.name}: {snippet.title}"]
    if isinstance(wanted, str):
        return
    for name, content in ({"shot.toml": SMALL} | wanted.files).items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(content, encoding="utf-8")
    if "examples/" in text:
        (tmp_path / "examples").symlink_to(ROOT / "examples")
    if wanted.before:
        run(wanted.before, tmp_path)
    run(text, tmp_path)
    assert [pattern for pattern in wanted.leaves if not list(tmp_path.glob(pattern))] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_prose_exist(page: Path) -> None:
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    for command in re.findall(r"`((?:vehsim|make) [^`]+)`", prose):
        understand(shlex.split(command))


def understand(words: list[str]) -> None:
    """Parse the command of a line: it must exist and accept these options."""
    name, rest = words[0].removeprefix(".venv/bin/"), words[1:]
    if name == "vehsim":
        parse(rest)
    elif name == "make":
        assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), (
            f"make {rest[0]}: no such target"
        )
    elif name == "python" and rest[0] == "-m":
        assert (ROOT / f"{rest[1].removeprefix('vehsim.').replace('.', '/')}").with_suffix("").is_dir(), rest[1]
    elif name in ("python", "blender"):
        script = next(word for word in rest if word.endswith(".py"))
        assert (ROOT / script).is_file(), script
    else:
        assert name in ("openjd", "git", "cd", "pip", "pytest"), f"{name}: teach this test what it is"


def parse(words: list[str]) -> None:
    whole = typer.main.get_command(app)
    if words[0].startswith("--"):  # an option of vehsim itself
        assert any(words[0] in param.opts for param in whole.params), f"vehsim {words[0]}: no such option"
        return
    commands = whole.commands  # type: ignore[attr-defined]
    assert words[0] in commands, f"vehsim {words[0]}: no such command"
    command = commands[words[0]]
    context = command.make_context(words[0], [], resilient_parsing=True)  # nothing is required yet
    context.resilient_parsing = False  # but every given option must be known
    command.make_parser(context).parse_args(words[1:])
