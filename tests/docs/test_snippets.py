"""Every snippet of every page: shots are checked, Python runs, commands are parsed. What stands in a page works.

Pages are README.md and docs/*.md. A fence says its language: ``toml`` (a whole shot, a piece of one, or a
vehicle.toml), ``python``, ``sh``, or ``text`` for what is no code.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer

import vehsim
from vehsim.cli import app
from vehsim.shot import Shot

ROOT = Path(vehsim.__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)

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
"""The shot that snippets call shot.toml: there so that they have one to load."""

PIECES = {"sinusoid": "car", None: "helicopter"}
"""Method of a piece of a shot -> the vehicle that it is tried on."""


class Snippet(NamedTuple):
    page: Path
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page.name}:{self.line}"


def snippets(page: Path) -> Iterator[Snippet]:
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        yield Snippet(page, text[: match.start()].count("\n") + 1, match[1], match[2])


EVERY = [snippet for page in PAGES for snippet in snippets(page)]


def written(language: str) -> list[Any]:
    return [pytest.param(snippet, id=str(snippet)) for snippet in EVERY if snippet.language == language]


def test_every_fence_says_its_language() -> None:
    unknown = [str(snippet) for snippet in EVERY if snippet.language not in ("toml", "python", "sh", "text")]
    assert not unknown, "give ```toml, ```python, ```sh, or ```text for what is no code"


@pytest.mark.parametrize("snippet", written("toml"))
def test_toml_is_what_check_accepts(snippet: Snippet, tmp_path: Path) -> None:
    data = tomllib.loads(snippet.text)
    if "model" in data:
        load_with(snippet.text, data["name"], tmp_path)
        return
    shot = Shot.from_dict(data if "shot" in data else completed(data), folder=ROOT / "examples")
    assert [str(problem) for problem in shot.check() if problem.severity == "error"] == []


def load_with(vehicle_toml: str, name: str, tmp_path: Path) -> None:
    """The vehicle of that name, shipped or from elsewhere, with this vehicle.toml."""
    homes = [ROOT / "assets" / "vehicles" / name, ROOT / "tests" / "assets_elsewhere" / name]
    shutil.copytree(next(home for home in homes if home.is_dir()), tmp_path / name)
    (tmp_path / name / "vehicle.toml").write_text(vehicle_toml, encoding="utf-8")
    assert vehsim.load_vehicle(str(tmp_path / name)).name == name


def completed(piece: dict[str, Any]) -> dict[str, Any]:
    """A piece of a shot file with what is missing for a whole one."""
    vehicle = piece.get("vehicle", {})
    vehicle = dict(vehicle[0] if isinstance(vehicle, list) else vehicle)
    motion = dict(vehicle.get("motion", {}))
    asset = PIECES.get(motion.get("method"), PIECES[None])
    if "method" not in motion:
        at_rest = {"velocity": [0, 0, 0], "heading": 0}
        marks = [{"frame": 1001, "position": [0, 0, 16]} | at_rest, {"frame": 1145, "position": [50, 0, 16]} | at_rest]
        motion = {"method": "plan", "mark": marks} | motion
    whole = {"name": "heli", "asset": asset} | vehicle | {"motion": motion}
    return {"shot": {"schema": 1, "name": "canyon_run"}} | piece | {"vehicle": [whole]}


@pytest.mark.parametrize("snippet", written("python"))
def test_python_runs(snippet: Snippet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("shot.toml", "shots/run.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(SMALL, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    if "__main__" in snippet.text:  # its worker processes import it
        (tmp_path / "snippet.py").write_text(snippet.text, encoding="utf-8")
        subprocess.run([sys.executable, "snippet.py"], check=True, timeout=120)
    else:
        exec(compile(snippet.text, str(snippet), "exec"), {"__name__": "__main__"})


@pytest.mark.parametrize("snippet", written("sh"))
def test_commands_are_there(snippet: Snippet) -> None:
    for line in snippet.text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            understand(words)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_in_prose_are_there(page: Path) -> None:
    prose = FENCE.sub("", page.read_text(encoding="utf-8"))
    for said in re.findall(r"`((?:vehsim|make) [^`]+)`", prose):
        understand(shlex.split(said))


def understand(words: list[str]) -> None:
    """The command of a line: that it exists, and takes these options."""
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
    context = command.make_context(words[0], [], resilient_parsing=True)  # so far nothing need be given
    context.resilient_parsing = False  # but what is given must be known
    command.make_parser(context).parse_args(words[1:])
