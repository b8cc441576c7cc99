"""Files outside an asset's own folder are never copied silently: they are refused, or copied on request."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import vehsim
from vehsim.assets import shipped
from vehsim.cli import commands as cli
from vehsim.errors import InputError
from vehsim.vehicles import load_vehicle

pytestmark = pytest.mark.broken_stages

SHOT = """
[shot]
schema = 1
name = "shot"
[[vehicle]]
name = "it"
asset = "studio/it"
[vehicle.motion]
method = "simulate"
duration = 0.1
[export]
{export}
"""


@pytest.fixture(params=["relative", "absolute", "link", "payload"])
def studio(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A vehicle whose asset refers to ``secret.txt``, above its folder."""
    from pxr import Sdf, Usd

    folder = tmp_path / "studio" / "it"
    folder.parent.mkdir()
    shutil.copytree(shipped("vehicle")["car"].parent, folder)
    (tmp_path / "studio" / "secret.txt").write_text("secret")
    (tmp_path / "studio" / "secret.usda").write_text('#usda 1.0\ndef "secret" {\n}\n')
    stage = Usd.Stage.Open(str(folder / "car.usdc"))
    named = {"relative": "../secret.txt", "absolute": str(tmp_path / "studio" / "secret.txt"), "link": "./inside.txt"}
    if request.param == "link":
        (folder / "inside.txt").symlink_to("../secret.txt")
    if request.param == "payload":
        stage.GetDefaultPrim().GetPayloads().AddPayload("../secret.usda", "/secret")
    else:
        attribute = stage.GetDefaultPrim().CreateAttribute("note", Sdf.ValueTypeNames.Asset)
        attribute.Set(Sdf.AssetPath(named[request.param]))
    stage.Save()
    return folder


def export(folder: Path, more: str) -> int:
    (folder / "shot.toml").write_text(SHOT.format(export=more))
    return cli.run(["export", str(folder / "shot.toml"), "--to", "usd", "--out", str(folder / "out")])


def test_files_outside_the_assets_folder_are_refused(studio: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = studio.parents[1]
    assert export(home, "") == 2
    output = capsys.readouterr().err
    assert "vehicle[0].asset = 'studio/it'" in output and "secret" in output
    assert 'outside its own folder; put it there, or give export.outside = "copy"' in output
    assert not (home / "out").exists()
    clip = vehsim.simulate(load_vehicle(studio), None, [0.0, 0.0], duration=0.1)
    with pytest.raises(InputError, match="outside its own folder"):
        clip.export(home / "out" / "it.usda")


def test_files_outside_the_assets_folder_are_copied_on_request(
    studio: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    home = studio.parents[1]
    assert export(home, 'outside = "copy"') == 0
    assert "warning: " in (output := capsys.readouterr().err) and "copied too" in output
    assert any(path.name.startswith(("secret", "inside")) for path in (home / "out").rglob("*"))


def test_kept_assets_are_referenced_where_they_are(studio: Path) -> None:
    home = studio.parents[1]
    assert export(home, 'assets = "keep"') == 0
    assert not any(path.name.startswith(("secret", "inside")) for path in (home / "out").rglob("*"))
