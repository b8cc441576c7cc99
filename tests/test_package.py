"""The package as users install it: a wheel with its assets, and nothing else of ours in site-packages."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
DEVELOP = ("dev", "docs")
"""Extras of those who work on vehsim; their versions are in requirements.lock."""


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

    (tmp_path / "car.toml").write_bytes((ROOT / "examples" / "car_commands.toml").read_bytes())
    code = "import sys, vehsim.cli.commands as c; raise SystemExit(c.run(sys.argv[1:]))"
    words = ["export", "car.toml", "--out", "out", "--to", "usd,npz,html"]
    exported = subprocess.run(
        [sys.executable, "-c", code, *words], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert exported.returncode == 0, exported.stderr
    assert {"car_commands.usda", "car.npz", "car_commands.html"} <= {
        path.name for path in (tmp_path / "out" / "car_commands").iterdir()
    }


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


@pytest.mark.parametrize("system", ["darwin", "win32"])
def test_shots_are_checked_and_exported_as_on_other_systems(system: str, tmp_path: Path) -> None:
    """Libraries load on this system; then vehsim sees another name, and no module or function that others lack."""
    libraries = (
        "av casadi fcl igl multiprocessing.connection multiprocessing.popen_spawn_posix multiprocessing.synchronize "
        "mujoco platformdirs pxr.UsdUtils scipy.interpolate scipy.ndimage scipy.optimize scipy.spatial.transform "
        "rich.console shapely trimesh typer"
    )
    code = (
        "import importlib, os, signal, sys\n"
        f"for name in {libraries!r}.split():\n"
        "    importlib.import_module(name)\n"
        f"sys.platform = {system!r}\n"
        "if sys.platform == 'win32':\n"
        "    sys.modules.update(dict.fromkeys(('fcntl', 'grp', 'pwd', 'resource', 'termios')))\n"
        "    for module, names in ((os, ('fork', 'getuid', 'killpg', 'sysconf')), (signal, ('SIGHUP', 'SIGKILL'))):\n"
        "        for name in names:\n"
        "            delattr(module, name)\n"
        "from vehsim.cli.commands import run\n"
        "raise SystemExit(run(sys.argv[1:]))\n"
    )

    def vehsim(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True, check=False
        )

    shot = str(ROOT / "examples" / "car_commands.toml")
    for words in (("check", shot), ("export", shot, "--out", "out", "--to", "usd,npz,html"), ("doctor",)):
        answer = vehsim(*words)
        assert answer.returncode == 0, answer.stdout + answer.stderr
    assert (tmp_path / "out" / "car_commands" / "car_commands.html").is_file()
    if system == "win32":
        answer = vehsim("export", shot, shot, "--out", "out", "--to", "npz", "--workers", "2", "--memory", "4")
        assert answer.returncode == 2 and "leave it out" in answer.stderr, answer.stderr


@pytest.mark.parametrize(
    ("system", "says"), [("linux", "libegl1"), ("darwin", "logged in at the screen"), ("win32", "desktop session")]
)
def test_what_cannot_draw_here_says_what_to_do_on_this_system(
    system: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    import mujoco

    from vehsim.errors import ExportError
    from vehsim.exporters.pictures.canvas import Canvas
    from vehsim.exporters.usd.scenery.shading import NO_STARS

    def fail(width: int, height: int) -> None:
        raise RuntimeError("no device")

    monkeypatch.setattr(mujoco, "GLContext", fail)
    monkeypatch.setattr(sys, "platform", system)
    with pytest.raises(ExportError, match=f"no .*OpenGL.*: no device; .*{says}"):
        Canvas(mujoco.MjModel.from_xml_string("<mujoco/>"), 32, 18, np.zeros(3), NO_STARS)


def test_a_context_that_only_warned_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """GLFW, with which MuJoCo draws on Windows, makes a context without a desktop; only its first use fails."""
    import mujoco

    from vehsim.errors import ExportError
    from vehsim.exporters.pictures.canvas import Canvas
    from vehsim.exporters.usd.scenery.shading import NO_STARS

    class Silent:
        def __init__(self, width: int, height: int) -> None: ...
        def make_current(self) -> None: ...
        def free(self) -> None: ...

    def fail(model: object, scale: object) -> None:
        raise mujoco.FatalError("a valid OpenGL context has not been created before mjr_makeContext was called")

    monkeypatch.setattr(mujoco, "GLContext", Silent)
    monkeypatch.setattr(mujoco, "MjrContext", fail)
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(ExportError, match=r"no OpenGL: .*; run it in a desktop session"):
        Canvas(mujoco.MjModel.from_xml_string("<mujoco/>"), 32, 18, np.zeros(3), NO_STARS)


def test_every_dependency_has_an_upper_bound() -> None:
    """The next major version of a library may break an installed vehsim."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [
        text for extra in project["optional-dependencies"].items() if extra[0] not in DEVELOP for text in extra[1]
    ]
    assert [text for text in (*project["dependencies"], *extras) if "<" not in text] == []


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
