"""The doors between the rooms: an import may only go down the list in docs/architecture.md."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

FLOORS = (
    (
        "vehsim",
        "vehsim.__main__",
        "vehsim.cli",
        "vehsim._arguments",
        "vehsim.choices",
        "vehsim.doctor",
        "vehsim.inspecting",
        "vehsim.starting",
    ),
    ("vehsim.batch",),
    ("vehsim.exporters",),
    ("vehsim.shot",),
    ("vehsim.take", "vehsim.delivery", "vehsim._earlier"),
    (
        "vehsim.cameras",
        "vehsim._camera_path",
        "vehsim._camera_rigs",
        "vehsim.simulation",
        "vehsim.pilots",
        "vehsim._gait",
        "vehsim._route",
        "vehsim.planning",
        "vehsim.sinusoids",
    ),
    ("vehsim.audit",),
    ("vehsim.requests",),
    ("vehsim.integrators", "vehsim.world", "vehsim.clip", "vehsim._interpolate"),
    ("vehsim.vehicles", "vehsim.parts", "vehsim._meshes", "vehsim.rigging", "vehsim.blocking"),
    ("vehsim.intake",),
    ("vehsim.lie", "vehsim._quaternions"),
    ("vehsim.errors", "vehsim.assets", "vehsim._cache", "vehsim._code", "vehsim._ending", "vehsim._lazy"),
)
"""From the roof to the cellar; the rooms of one floor may see each other."""

UPWARDS = {("vehsim.clip", "vehsim.take")}
"""`Clip.export` hands itself to a take, which finds exporters by their entry points."""

HEAVY = {"mujoco", "pxr", "casadi", "scipy", "trimesh", "igl", "PIL", "av"}


def floor(module: str) -> int:
    rooms = [(room, i) for i, rooms in enumerate(FLOORS) for room in rooms]
    found = [(room, i) for room, i in rooms if module == room or (room != "vehsim" and module.startswith(f"{room}."))]
    assert found, f"{module} stands on no floor: add its room to docs/architecture.md and to FLOORS"
    return max(found, key=lambda pair: len(pair[0]))[1]


def room_of(module: str) -> str:
    return ".".join(module.split(".")[:2])


def modules() -> Iterator[tuple[str, Path]]:
    for folder, package in (("vehsim", "vehsim"), ("exporters", "vehsim.exporters")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            yield ".".join((package, *(part for part in parts if part != "__init__"))), path


def imports(path: Path, module: str) -> Iterator[tuple[str, ast.stmt]]:
    """Modules of ours that a file imports, but for those it needs only to check types."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    typing_only = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative import; write it out"
            if node.module == "vehsim":
                yield from ((f"vehsim.{alias.name}", node) for alias in node.names if alias.name != "__version__")
            elif node.module:
                yield node.module, node
        elif isinstance(node, ast.Import):
            yield from ((alias.name, node) for alias in node.names)


@pytest.mark.parametrize("module, path", [pytest.param(*pair, id=pair[0]) for pair in modules()])
def test_imports_go_down(module: str, path: Path) -> None:
    for imported, node in imports(path, module):
        if not imported.startswith("vehsim"):
            continue
        if (room_of(module), room_of(imported)) in UPWARDS:
            continue
        assert floor(imported) >= floor(module), f"{path}:{node.lineno}: {module} must not import {imported}"


@pytest.mark.parametrize("module", ["vehsim", "vehsim.__main__", "vehsim.cli"])
def test_import_stays_light(module: str) -> None:
    code = f"import sys, {module}; print(*sorted({HEAVY | {'numpy', 'pydantic'}} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == []


def test_world_knows_nothing_of_planning() -> None:
    for module, path in modules():
        if module.startswith("vehsim.world"):
            assert not [name for name, _ in imports(path, module) if name.startswith("vehsim.planning")]
