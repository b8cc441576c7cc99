"""The package as users install it: a wheel with its assets, and nothing else of ours in site-packages."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the committed package outside the checkout."""
    place = tmp_path_factory.mktemp("wheel")
    source = place / "source"
    names = ("pyproject.toml", "README.md", "LICENSE", "vehsim", "exporters", "assets")
    source.mkdir()
    for name in names:
        subprocess.run(["cp", "-R", str(ROOT / name), str(source / name)], check=True)
    pip(["wheel", "--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(place), str(source)])
    (found,) = place.glob("vehsim-*.whl")
    return found


def pip(arguments: list[str]) -> None:
    subprocess.run([sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments], check=True)


def test_the_wheel_contains_only_vehsim_and_its_assets(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"vehsim"}
    assert not [name for name in names if "/test" in name or name.endswith((".pyc", ".orig"))]
    for folder in ("vehicles", "terrains"):
        for path in (ROOT / "assets" / folder).rglob("*"):
            if path.is_file() and not path.name.startswith("."):
                assert f"vehsim/assets/{path.relative_to(ROOT / 'assets').as_posix()}" in names
    assert "vehsim/exporters/usd/exporter.py" in names
    assert "vehsim/py.typed" in names


def test_wheel_works_outside_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    pip(["install", "--no-deps", "--no-compile", "--quiet", "--target", str(site), str(wheel)])
    assert {path.name.partition("-")[0] for path in site.iterdir()} <= {"vehsim", "bin"}
    code = (
        "import vehsim, vehsim.assets, vehsim.exporters, vehsim.cli.commands\n"
        f"assert all(m.__file__.startswith({str(site)!r}) for m in (vehsim, vehsim.assets, vehsim.exporters))\n"
        "raise SystemExit(vehsim.cli.commands.run(['vehicles']))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(site)}
    answer = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    assert "helicopter" in answer.stdout


def test_an_sdist_gives_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    """The source distribution contains every file of the wheel."""
    code = "from setuptools.build_meta import build_sdist; build_sdist('dist')"
    subprocess.run([sys.executable, "-c", code], cwd=wheel.parent / "source", check=True, capture_output=True)
    (sdist,) = (wheel.parent / "source" / "dist").glob("vehsim-*.tar.gz")
    pip(["wheel", "--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(tmp_path), str(sdist)])
    (again,) = tmp_path.glob("vehsim-*.whl")
    before, after = (sorted(zipfile.ZipFile(path).namelist()) for path in (wheel, again))
    assert before == after


def test_every_module_loads_without_unix_only_modules() -> None:
    code = (
        "import importlib, pkgutil, sys\n"
        "sys.modules.update(dict.fromkeys(('fcntl', 'grp', 'pwd', 'resource', 'termios')))\n"
        "import vehsim, vehsim.exporters\n"
        "for package in (vehsim, vehsim.exporters):\n"
        "    for found in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "        if not found.name.endswith(('.__main__', '.preload')):\n"
        "            importlib.import_module(found.name)\n"
    )
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.returncode == 0, answer.stderr


def test_every_dependency_has_an_upper_bound() -> None:
    """The next major version of a library may break an installed vehsim."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert [text for text in project["dependencies"] if "<" not in text] == []


def test_every_package_is_shipped() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    inside = {
        ".".join((*prefix, *path.parent.relative_to(ROOT).parts))
        for folder, prefix in (("vehsim", ()), ("exporters", ("vehsim",)))
        for path in (ROOT / folder).rglob("__init__.py")
    }
    assert inside | {"vehsim.assets"} == listed


def test_lock_holds_every_dependency() -> None:
    """``make lock`` was run after pyproject.toml last changed its dependencies."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    locked = {line.partition("==")[0] for line in (ROOT / "requirements.lock").read_text().splitlines() if "==" in line}
    wanted = project["dependencies"] + project["optional-dependencies"]["dev"]
    assert {name.partition(">=")[0].strip() for name in wanted} <= locked
