"""A package outside the checkout adds a vehicle, its model, a terrain, a pilot, a camera rig, a cost and a limit."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from vehsim.assets import shipped

PACKAGE = '''
from pathlib import Path

import casadi as ca
import numpy as np

from vehsim.cameras.rigs import Move
from vehsim.lie import SE2
from vehsim.planning.terms import Limit
from vehsim.vehicles import Channel, Control, Nonholonomic

QUARRY = Path(__file__).parent / "quarry"
SLED_FOLDER = Path(__file__).parent / "sled"


def sled(name="sled", *, mass, yaw_inertia):
    """A box on two freely rolling skids: pushed ahead, turned, never sideways."""
    return Nonholonomic(
        name=name,
        group=SE2,
        joints=(),
        lagrangian=lambda r, u, xi: (yaw_inertia * xi[0] ** 2 + mass * (xi[1] ** 2 + xi[2] ** 2)) / 2,
        constraints=lambda r: (np.zeros((1, 0)), [[0, 0, 1]]),
        forces=lambda r, u, xi, c: (ca.SX(0, 1), ca.vertcat(c[1] - 0.1 * xi[0], c[0] - xi[1], 0)),
        controls=(Control("push", -20, 20, 5, "N"), Control("turn", -5, 5, 1, "N m")),
        channels={name: Channel(value=lambda t, r, u, xi, c: t) for name in ("roll_right", "roll_left")},
    )


class Coast:
    def __init__(self, vehicle, push=1.0):
        self.push = float(push)

    def reset(self):
        pass

    def __call__(self, t, state):
        return np.array([self.push, 0.0])

    def targets(self, duration):
        return []


def _above(rig, subject, distance, world):
    return subject.centre + [0.0, -0.1, distance], subject.centre


ABOVE = Move(_above)
SPIN = Limit(lambda k: ca.sqrt(k.omega[2] ** 2 + 1e-8), "rad/s", "yaw rate")


def spin(track, wanted, scene):
    return np.maximum(np.abs(track.omegas[:, 2]) - track.blur.omega, 0.0)


def gentle(segment):
    return segment.h * ca.sumsqr(segment.start.controls)
'''

ENTRY_POINTS = """
[vehsim.models]
sled = studio_kit:sled
[vehsim.vehicles]
studio_sled = studio_kit:SLED_FOLDER
[vehsim.terrains]
quarry = studio_kit:QUARRY
[vehsim.pilots]
coast = studio_kit:Coast
[vehsim.camera_rigs]
above = studio_kit:ABOVE
[vehsim.costs]
gentle = studio_kit:gentle
[vehsim.limits]
spin = studio_kit:SPIN
[vehsim.measures]
spin = studio_kit:spin
"""

SHOT = """
[shot]
schema = 1
name = "yard"
fps = 24
[world]
terrain = "quarry"
[[vehicle]]
name = "planned"
asset = "studio_sled"
[vehicle.motion]
method = "plan"
cost = { gentle = 1.0 }
limits = { spin = 30 }
segments = 24
[[vehicle.motion.mark]]
frame = 1001
position = [0, 0, 0]
heading = 0
velocity = [0, 0, 0]
[[vehicle.motion.mark]]
frame = 1121
position = [6, 3, 0]
heading = 60
velocity = [0, 0, 0]
[[vehicle]]
name = "coasting"
asset = "studio_sled"
[vehicle.motion]
method = "simulate"
pilot = { name = "coast", push = 2.0 }
start = { position = [0, 10, 0] }
duration = 3
[camera]
rig = "above"
target = "planned"
"""


@pytest.fixture
def site(tmp_path: Path) -> Path:
    """A folder of installed packages that includes the studio's package."""
    site = tmp_path / "site"
    package = site / "studio_kit"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(PACKAGE)
    information = site / "studio_kit-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: studio-kit\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(ENTRY_POINTS)
    shutil.copytree(shipped("vehicle")["two_wheeled"].parent, package / "sled")
    channels = '[channels.roll_right]\nprim = "wheel_right"\nop = "rotateY"\n'
    channels += '[channels.roll_left]\nprim = "wheel_left"\nop = "rotateY"\n'
    top = 'schema = 1\nname = "studio_sled"\nmodel = "sled"\nasset = "two_wheeled.usdc"\n'
    (package / "sled" / "vehicle.toml").write_text(f"{top}[physics]\nmass = 16.0\nyaw_inertia = 0.5\n{channels}")
    (package / "quarry").mkdir()
    np.savez(package / "quarry" / "heights.npz", heights=np.zeros((9, 9)))
    terrain = 'schema = 1\nname = "quarry"\nheights = "heights.npz"\ncell = 10.0\norigin = [-40.0, -40.0]\n'
    (package / "quarry" / "terrain.toml").write_text(terrain)
    return site


def run(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site)}
    return subprocess.run(
        [sys.executable, "-m", "vehsim", *arguments], env=environment, capture_output=True, text=True, check=False
    )


def test_a_shot_names_what_a_package_registers(site: Path, tmp_path: Path) -> None:
    shot = tmp_path / "yard.toml"
    shot.write_text(SHOT)
    done = run(site, "export", str(shot), "--out", str(tmp_path / "out"), "--to", "usd,csv")
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "out" / "yard" / "report.json").read_text())
    rows = {row["key"]: row for row in report["audit"]["planned"]}
    assert rows["limits.spin"]["met"] and 0.1 < rows["limits.spin"]["value"] <= np.radians(30) * 1.01
    assert report["terrain"] == "quarry" and report["cameras"]
    listed = run(site, "vehicles")
    assert "studio_sled" in listed.stdout
    assert "quarry" in run(site, "terrains").stdout


def test_a_limit_without_a_measure_is_refused(site: Path, tmp_path: Path) -> None:
    entries = next(site.glob("*.dist-info")) / "entry_points.txt"
    entries.write_text(ENTRY_POINTS.partition("[vehsim.measures]")[0])
    (tmp_path / "yard.toml").write_text(SHOT)
    done = run(site, "check", str(tmp_path / "yard.toml"))
    assert done.returncode == 2 and "limits.spin" in done.stderr and "vehsim.measures" in done.stderr


def test_a_package_that_does_not_load_is_named(site: Path, tmp_path: Path) -> None:
    (site / "studio_kit" / "__init__.py").write_text("import nothing_of_this_name\n")
    (tmp_path / "yard.toml").write_text(SHOT)
    done = run(site, "check", str(tmp_path / "yard.toml"))
    assert done.returncode == 2 and "studio-kit" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("healthy", "broken", "says"),
    [
        ("return np.maximum(", "return 1 / 0 * np.maximum(", "vehsim.measures 'spin'"),
        ("return np.array([self.push, 0.0])", "return self.gone", "vehsim.pilots 'coast'"),
        ("return segment.h *", "return [][0] *", "vehsim.costs 'gentle'"),
    ],
)
def test_an_error_in_a_package_is_not_called_one_of_vehsim(
    site: Path, tmp_path: Path, healthy: str, broken: str, says: str
) -> None:
    assert healthy in PACKAGE
    (site / "studio_kit" / "__init__.py").write_text(PACKAGE.replace(healthy, broken))
    planned, _, coasting = SHOT.partition('[[vehicle]]\nname = "coasting"')
    coasting = (
        planned.partition("[[vehicle]]")[0] + '[[vehicle]]\nname = "coasting"' + coasting.partition("[camera]")[0]
    )
    (tmp_path / "yard.toml").write_text(coasting if "pilots" in says else planned)  # planning takes longer
    (tmp_path / "good.toml").write_text(
        '[shot]\nschema = 1\nname = "good"\n[[vehicle]]\nname = "car"\nasset = "car"\n'
        '[vehicle.motion]\nmethod = "simulate"\nduration = 0.1\n'
    )
    shots = [str(tmp_path / name) for name in ("yard.toml", "good.toml")]
    done = run(site, "export", *shots, "--out", str(tmp_path / "out"), "--to", "csv")
    assert done.returncode == 1
    assert "this is an error in the package studio-kit, which registers" in done.stderr and says in done.stderr
    assert "error in vehsim" not in done.stderr and (tmp_path / "out" / "good" / "car.csv").is_file()


def test_a_package_that_does_not_load_stops_no_other_shot(site: Path, tmp_path: Path) -> None:
    (site / "studio_kit" / "__init__.py").write_text("import nothing_of_this_name\n")
    limited = (
        SHOT.replace('"quarry"', '"flat"').replace('"studio_sled"', '"two_wheeled"').replace("spin = 30", "speed = 3")
    )
    limited = limited.replace("cost = { gentle = 1.0 }\n", "").partition('[[vehicle]]\nname = "coasting"')[0]
    (tmp_path / "yard.toml").write_text(limited)
    done = run(site, "export", str(tmp_path / "yard.toml"), "--out", str(tmp_path / "out"), "--to", "csv")
    assert done.returncode == 0, done.stderr
    listed = run(site, "vehicles")
    assert listed.returncode == 0 and "car: controls" in listed.stdout and "studio-kit" in listed.stderr
    for command in ("terrains", "schema"):
        assert run(site, command).returncode == 0


def test_a_delivery_with_a_limit_of_a_missing_package_does_not_pass(site: Path, tmp_path: Path) -> None:
    (tmp_path / "yard.toml").write_text(SHOT)
    done = run(site, "export", str(tmp_path / "yard.toml"), "--out", str(tmp_path / "out"), "--to", "usd")
    assert done.returncode == 0, done.stderr
    assert run(site, "audit", str(tmp_path / "out" / "yard")).returncode == 0
    alone = run(tmp_path, "audit", str(tmp_path / "out" / "yard"))
    assert alone.returncode == 2 and "limits.spin" in alone.stderr and "Traceback" not in alone.stderr


def test_a_package_cannot_replace_a_shipped_name(site: Path) -> None:
    entries = next(site.glob("*.dist-info")) / "entry_points.txt"
    entries.write_text("[vehsim.vehicles]\ncar = studio_kit:SLED_FOLDER\n")
    listed = run(site, "vehicles")
    assert listed.returncode == 0 and "registers 'car', which vehsim ships" in listed.stderr
