"""The layers of the code: imports go down only, and no two modules import each other in a circle.

Type-only and lazy imports count: a reader follows them as well as the interpreter does.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

LAYERS = (
    ("cli",),
    ("live",),
    ("batch",),
    ("exporters",),
    ("shot",),
    ("delivery",),
    ("sinusoids",),
    ("planning", "simulation", "pilots", "cameras"),
    ("continuation",),
    ("audit",),
    ("requests",),
    ("world",),
    ("integrators",),
    ("clip",),
    ("vehicles",),
    ("rig",),
    ("intake",),
    ("lie",),
    ("assets",),
    ("runtime",),
    ("constants", "errors"),
)
"""Rooms from top to bottom, as in docs/architecture.md; rooms on one layer do not import each other."""

HEAVY = {"mujoco", "pxr", "casadi", "scipy", "trimesh", "igl", "shapely", "PIL", "av", "llvmlite"}


@cache
def modules() -> dict[str, Path]:
    found = {"vehsim.assets": ROOT / "assets" / "__init__.py"}  # the generators are scripts
    for folder, package in (("vehsim", "vehsim"), ("exporters", "vehsim.exporters")):
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((package, *(part for part in parts if part != "__init__")))] = path
    return found


@cache
def imports(module: str) -> frozenset[str]:
    """Our modules that a module imports, anywhere in its file."""
    found = set()
    for node in ast.walk(ast.parse(modules()[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module}:{node.lineno}: relative import; write it out"
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                found.add(whole if whole in modules() else str(node.module))
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return frozenset(name for name in found & modules().keys() if name not in (module, "vehsim"))


def room(module: str) -> str:
    return module.split(".")[1]


def layer(module: str) -> int:
    found = [i for i, rooms in enumerate(LAYERS) if room(module) in rooms]
    assert found, f"{module} is in no layer: add its room to LAYERS and to docs/architecture.md"
    return found[0]


@pytest.mark.parametrize("module", [name for name in modules() if name not in ("vehsim", "vehsim.__main__")])
def test_imports_go_down(module: str) -> None:
    for imported in imports(module):
        assert room(imported) == room(module) or layer(imported) > layer(module), f"{module} imports {imported}"


def test_no_module_imports_the_top() -> None:
    named = {path: ast.parse(path.read_text(encoding="utf-8")) for path in modules().values()}
    for path, tree in named.items():
        if path != ROOT / "vehsim" / "__init__.py":
            plain = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "vehsim"]
            assert all(f"vehsim.{alias.name}" in modules() for node in plain for alias in node.names), path


def test_no_import_cycles() -> None:
    """Tarjan's strongly connected components of the import graph have one module each."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    cycles: list[list[str]] = []

    def visit(module: str) -> None:
        index[module] = low[module] = len(index)
        stack.append(module)
        for imported in sorted(imports(module)):
            if imported not in index:
                visit(imported)
            if imported in stack:
                low[module] = min(low[module], low[imported])
        if low[module] == index[module]:
            component = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(component) > 1:
                cycles.append(sorted(component))

    for module in modules():
        if module not in index and module != "vehsim":
            visit(module)
    assert cycles == []


@pytest.mark.parametrize("module", ["vehsim", "vehsim.__main__", "vehsim.cli.commands"])
def test_import_stays_light(module: str) -> None:
    code = f"import sys, {module}; print(*sorted({HEAVY | {'numpy', 'pydantic'}} & set(sys.modules)))"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.split() == []
