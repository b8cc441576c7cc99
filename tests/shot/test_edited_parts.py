"""`[vehicle.edit]` names the wheels, rotors and rudders that an edited stage moves: they follow from the motion."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import vehsim
from vehsim.cli import commands as cli

pytestmark = pytest.mark.broken_stages  # an animator's layer over a delivery states no unit and no range
SHOT = """
[shot]
schema = 1
name = "it"
[world]
{world}
[[vehicle]]
name = "mover"
asset = "{asset}"
{edit}
[vehicle.motion]
method = "simulate"
duration = 1
step = 0.01
{motion}
"""
MOVERS = {
    "car": (
        'terrain = "hills"',
        "start = { velocity = [6, 0, 0] }\ncommands = [{ frame = 1001, torque = 50, steering_rate = 0.1 }]",
    ),
    "helicopter": ("", "start = { position = [0, 0, 20] }\ncommands = [{ frame = 1001, collective = 9800 }]"),
    "boat": ("", "start = { velocity = [4, 0, 0] }\ncommands = [{ frame = 1001, thrust = 500, steering = 0.1 }]"),
}


def edited(folder: Path, asset: str, change: Callable[[Any], None]) -> tuple[list[str], dict[str, Any]]:
    """The warnings of a shot with an edit in which ``change`` was done to the vehicle's prim, and its report."""
    from pxr import Sdf, Usd

    world, motion = MOVERS[asset]
    text = SHOT.replace("{world}", world).replace("{asset}", asset).replace("{motion}", motion)
    (folder / "before.toml").write_text(text.replace("{edit}", ""))
    assert cli.run(["export", str(folder / "before.toml"), "--out", str(folder / "out"), "--quiet"]) == 0
    layer = Sdf.Layer.CreateNew(str(folder / "edited.usda"))
    layer.subLayerPaths = ["out/it/it.usda"]
    stage = Usd.Stage.Open(layer)
    stage.SetTimeCodesPerSecond(24)
    stage.SetFramesPerSecond(24)
    change(stage.GetPrimAtPath("/it/vehicles/mover"))
    layer.Save()
    table = '[vehicle.edit]\nusd = "edited.usda"\nprim = "/it/vehicles/mover"'
    (folder / "after.toml").write_text(text.replace("{edit}", table))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        take = vehsim.Shot.load(folder / "after.toml").solve()
    return [str(each.message) for each in said], take.report["vehicles"]["mover"]["edit"]


def turned(prim: Any, path: str, op: str, degrees: float, frame: float) -> None:
    """Turn a part's own curve on one frame, as an animator moves a key."""
    curve = prim.GetPrimAtPath(path).GetAttribute(f"xformOp:{op}:spin")
    before = {time: curve.Get(time) for time in range(1001, 1026)}
    for time, value in before.items():
        curve.Set(value + degrees * (time == frame), time)


@pytest.mark.parametrize(
    ("asset", "path", "op", "frame"),
    [
        ("car", "steer_fl/wheel_fl", "rotateY", 1012.0),
        ("car", "steer_fr", "rotateZ", 1020.0),
        ("helicopter", "main_rotor", "rotateZ", 1005.0),
        ("boat", "outboard", "rotateZ", 1010.0),
    ],
)
def test_a_part_that_was_turned_is_named(tmp_path: Path, asset: str, path: str, op: str, frame: float) -> None:
    said, report = edited(tmp_path, asset, lambda prim: turned(prim, path, op, 5.0, frame))
    (text,) = [each for each in said if "also moves" in each]
    assert text.startswith(f"mover: the edit also moves {path} (by 5 degrees at frame {frame:g}), without effect")
    (part,) = report["parts"]
    assert part["path"] == path and part["frame"] == frame and part["metres"] < 2e-3
    assert part["degrees"] == pytest.approx(5.0, abs=1e-3)
