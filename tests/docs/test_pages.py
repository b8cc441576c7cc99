"""Properties of the pages besides their snippets: tables match the models, nothing is left out, no link is dead."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import vehsim
from vehsim.audit import MEASURES
from vehsim.cameras.rigs import RIGS
from vehsim.cli.commands import app
from vehsim.errors import InputError
from vehsim.integrators.references import METHODS
from vehsim.pilots.controllers import PILOTS
from vehsim.planning.problem.solver import SOLVERS
from vehsim.planning.terms import COSTS, LIMITS
from vehsim.shot.reference import table, with_tables
from vehsim.vehicles import available
from vehsim.vehicles.library.library import MODELS

ROOT = Path(vehsim.__file__).parents[1]
SHOT_FILE = (ROOT / "docs" / "shot-file.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["shot-file.md", "character.md"])
def test_key_tables_match_the_models(name: str) -> None:
    page = (ROOT / "docs" / name).read_text(encoding="utf-8")
    assert with_tables(page) == page, "run make docs"


def test_a_table_marks_required_keys_defaults_and_toml() -> None:
    rows = dict(row.split(" | ", 1) for row in table("Header").splitlines()[2:])
    assert rows["| `schema`"].endswith("| required |")
    assert rows["| `end_frame`"].endswith("| the end of the longest motion |")
    assert rows["| `start_frame`"].endswith("| `1001` |")
    assert '`"24000/1001"`' in rows["| `fps`"]
    assert "`shape`" not in table("BoxTable", ["shape"])
    with pytest.raises(InputError, match="no such table"):
        table("BoxTabel")


@pytest.mark.parametrize(
    "names",
    [COSTS, LIMITS, PILOTS, RIGS, SOLVERS, METHODS],
    ids=["costs", "limits", "pilots", "rigs", "solvers", "integrators"],
)
def test_every_name_a_shot_may_use_is_explained(names: dict[str, object]) -> None:
    missing = [name for name in names if f"`{name}`" not in SHOT_FILE and f'`"{name}"`' not in SHOT_FILE]
    assert not missing, "explain them in docs/shot-file.md"


def test_every_vehicle_is_shown() -> None:
    text = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")
    assert [name for name in available() if f"`{name}`" not in text] == []


def test_every_command_is_explained() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))
    names = [command.name or command.callback.__name__ for command in app.registered_commands if command.callback]
    assert [name for name in names if f"vehsim {name}" not in pages and f"`{name}`" not in pages] == []


PATHS = re.compile(r"`((?:vehsim|exporters|tests|tools|benchmarks|assets|examples)/[\w./-]*\w/?)`")
"""Files and folders of the repository that a page names."""


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", *(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))])
def test_every_path_named_by_a_page_exists(page: str) -> None:
    names = set(PATHS.findall((ROOT / page).read_text(encoding="utf-8"))) - {"assets/vehicles/sled/"}  # made there
    assert [name for name in names if not (ROOT / name).exists()] == []


PLACED = re.compile(r"((?:`[\w.]+`(?:, | and )?)+) (?:in|of) `((?:vehsim|exporters)/[\w/]+\.py)`")
"""Names that a page places in a file: "`A` and `B` in `vehsim/c.py`"."""


@pytest.mark.parametrize("page", ["CONTRIBUTING.md", "docs/interfaces.md", "docs/one-shot.md"])
def test_every_name_placed_in_a_file_is_defined_there(page: str) -> None:
    places = PLACED.findall(" ".join((ROOT / page).read_text(encoding="utf-8").split()))
    missing = []
    for names, path in places:
        code = (ROOT / path).read_text(encoding="utf-8")
        for name in re.findall(r"`(?:\w+\.)?(\w+)`", names):
            if not re.search(rf"^ *(?:async )?(?:def|class) {name}\b|^{name}\b", code, re.MULTILINE):
                missing.append((name, path))
    assert places and not missing


def test_every_public_name_is_in_the_reference() -> None:
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    assert [name for name in vehsim.__all__ if f"::: vehsim.{name}\n" not in text and name != "__version__"] == []


NAMES = """
import os, sys
from operator import attrgetter

import casadi, mujoco, numpy, pydantic, scipy  # what takes long, and is not ours

import vehsim

for name in sys.argv[1:]:
    if not (child := os.fork()):  # every name in an interpreter that has imported vehsim and nothing else of it
        code = 1
        try:
            attrgetter(name.removeprefix("vehsim."))(vehsim)
            code = 0
        except AttributeError as error:
            print(name, error, sep=": ", flush=True)
        finally:
            os._exit(code)
    os.waitpid(child, 0)
"""


def test_every_dotted_name_works_after_import_vehsim_alone() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "examples").glob("*.py")]
    found = {name for page in pages for name in re.findall(r"\bvehsim(?:\.[A-Za-z]\w*)+", page.read_text("utf-8"))}
    groups = {
        "vehsim.terrains",
        "vehsim.reports",
        *(names.group for names in (COSTS, LIMITS, PILOTS, RIGS, MODELS, MEASURES)),
    }
    names = sorted(found - groups - {"vehsim.assets.generate", "vehsim.schema.json"})  # entry points, a script, a file
    assert {"vehsim.vehicles.Nonholonomic", "vehsim.integrators.forced.Forced"} <= set(names)
    answer = subprocess.run([sys.executable, "-I", "-c", NAMES, *names], capture_output=True, text=True, check=True)
    assert answer.stdout == ""


def test_dir_lists_every_public_name_and_module() -> None:
    answer = subprocess.run(
        [sys.executable, "-I", "-c", "import vehsim; print(*dir(vehsim))"], capture_output=True, text=True, check=True
    )
    modules = {path.stem for path in (ROOT / "vehsim").iterdir() if path.suffix == ".py" or path.is_dir()}
    public = {name for name in modules if not name.startswith("_") and "." not in name}
    shown = {name for name in answer.stdout.split() if not name.startswith("__")}
    assert shown == public | {"assets", "exporters"} | (set(vehsim.__all__) - {"__version__"})


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """MkDocs checks every link and anchor, mkdocstrings every name of the reference; strict turns warnings into
    errors."""
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for page in ("index", "shot-file/index", "api/index", "examples/index", "cookbook/index"):
        assert (tmp_path / f"{page}.html").is_file()
    reference = (tmp_path / "api" / "index.html").read_text(encoding="utf-8")
    assert "Position of the rig" in reference or "vehsim.plan" in reference


FOLDERS = ("vehsim", "exporters", "tests", "tools", "benchmarks", "examples", "assets", "extension")


def _read(file: str) -> str:
    return (ROOT / file).read_text(encoding="utf-8")


def _pages() -> list[Path]:
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", _pages(), ids=lambda page: page.name)
def test_files_and_names_cited_by_a_page_exist(page: Path) -> None:
    text = " ".join(page.read_text(encoding="utf-8").split())
    files = set(re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w/.-]+?)/?`", text))
    missing = [name for name in files if "sled" not in name and not (ROOT / name).exists()]  # a recipe makes the sled
    modules = {path.name for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")}
    missing += [name for name in re.findall(r"`(?:\w+/)*(\w+\.py)`", text) if name not in modules]
    cited = re.findall(r"`([A-Za-z_][\w.]*)` (?:in|of) `((?:vehsim|exporters)/[\w/]+\.py)`", text)
    missing += [
        f"{name} in {file}"
        for name, file in cited
        if (ROOT / file).is_file()
        and not re.search(rf"(?m)^\s*(def|class) {(last := name.rpartition('.')[2])}\b|^\s*{last}\b.*=", _read(file))
    ]
    assert not missing
