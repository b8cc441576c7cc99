"""One bad shot or file never stops a batch: it is named, with key and remedy, and the others are delivered."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.hostile_files.writers import CUBE, FACES, glb, usda
from vehsim.cli import commands as cli

pytestmark = [pytest.mark.broken_stages, pytest.mark.filterwarnings("ignore")]

HEAD = '[shot]\nschema = 1\nname = "{name}"\n'
CAR = HEAD + '[[vehicle]]\nname = "car"\nasset = "car"\n[vehicle.motion]\nmethod = "simulate"\nduration = 0.1\n'
FLIGHT = (
    HEAD
    + '[[vehicle]]\nname = "h"\nasset = "helicopter"\n[vehicle.motion]\nmethod = "plan"\nsegments = 8\n'
    + "[[vehicle.motion.mark]]\nframe = 1001\nposition = [0, 0, 30]\nvelocity = [0, 0, 0]\n"
    + "[[vehicle.motion.mark]]\nframe = 1100\nposition = [40, 0, 30]\n"
)
BOX = '[[world.obstacle]]\nshape = "box"\ncentre = [20, 10, 0]\nsize = [{size}]\n'
FAR = FACES.copy()
FAR[3] = 10**8

BAD = {
    "terrain.usda": (CAR + '[world]\nterrain = "terrain.usda"\n', "terrain.usda: /rig/mesh: its faces do not fit"),
    "terrain.glb": (CAR + '[world]\nterrain = "terrain.glb"\n', "terrain.glb: terrain"),
    "obstacle.glb": (
        CAR + '[[world.obstacle]]\nshape = "mesh"\npath = "obstacle.glb"\n',
        "world.obstacle[0].path = 'obstacle.glb': {folder}/obstacle.glb: mesh: ",
    ),
    "empty.obj": (
        CAR + '[[world.obstacle]]\nshape = "mesh"\npath = "empty.obj"\n',
        "world.obstacle[0].path = 'empty.obj': {folder}/empty.obj: mesh: ",
    ),
    "empty.npz": (CAR + '[world.water]\ngrids = "empty.npz"\n', "empty.npz: world.water.grids: cannot be read"),
    "short.npz": (CAR + '[world]\nterrain = "short.npz"\n', "short.npz: heights: cannot be read"),
    "thin": (
        FLIGHT + BOX.replace("{size}", "1e-6, 1, 40"),
        "world.obstacle[0].shape = 'box': only 1e-06 m thick",
    ),
    "gate": (
        FLIGHT + "gate = { direction = [1, 0, 0] }\n" + BOX.replace("{size}", "1, 1, 1"),
        "neither radius",
    ),
    "digits": (FLIGHT + f"velocity = [0, 0, {'9' * 400}]\n", "velocity[2]: a whole number of more than 64 bits"),
    "nested": (CAR + f"[{'.'.join('a' * 2000)}]\n", "nested too deeply"),
}
CONTENT = {
    "terrain.usda": usda(CUBE * 50, FAR),
    "terrain.glb": glb(CUBE * 50, FAR),
    "obstacle.glb": glb(CUBE, FAR),
    "empty.obj": b"",
    "empty.npz": b"",
    "short.npz": b"PK\x03\x04 cut short",
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_named_and_the_other_shots_continue(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, says = BAD[name]
    bad, good, out = tmp_path / "bad.toml", tmp_path / "good.toml", tmp_path / "out"
    bad.write_text(text.replace("{name}", "bad"))
    good.write_text(CAR.replace("{name}", "good"))
    if name in CONTENT:
        (tmp_path / name).write_bytes(CONTENT[name])
    assert cli.run(["check", str(bad)]) == 2
    output = capsys.readouterr().err
    assert says.replace("{folder}", str(tmp_path)) in output and "; " in output and str(bad) in output
    assert cli.run(["export", str(bad), "--out", str(out), "--to", "npz"]) == 2
    assert not out.exists()
    assert cli.run(["export", str(bad), str(good), "--out", str(out), "--to", "npz"]) == 1
    assert (out / "good" / "car.npz").is_file() and not (out / "bad").exists()


def test_one_bad_stage_or_delivery_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither does an unexpected exception in vehsim."""
    from vehsim.exporters.checks import audit, validate

    (tmp_path / "good.toml").write_text(CAR.replace("{name}", "good"))
    assert cli.run(["export", str(tmp_path / "good.toml"), "--out", str(tmp_path / "out")]) == 0
    good, bad = tmp_path / "out" / "good", tmp_path / "out" / "bad"
    bad.mkdir()
    (bad / "report.json").write_text('{"shot": "bad", "audit": []}')
    (bad / "bad.usda").write_bytes(usda(CUBE * 50, FAR)[:-20])
    capsys.readouterr()
    assert cli.run(["audit", str(bad), str(tmp_path), str(good)]) == 2
    output = capsys.readouterr()
    assert f"{bad}/bad.usda: asset: cannot be read" in output.err and f"{tmp_path}: not a delivery" in output.err
    assert "car: " in output.out and "MISSED" not in output.out
    (bad / "bad.usda").write_bytes((good / "good.usda").read_bytes())
    assert cli.run(["audit", str(bad), str(good)]) == 2
    output = capsys.readouterr()
    assert f"{bad}: report.json holds no asks" in output.err and "car: " in output.out
    for module, name, command, items in (
        (validate, "validate_stage", "validate", (bad / "bad.usda", good / "good.usda")),
        (audit, "audit_delivery", "audit", (bad, good)),
    ):
        whole = getattr(module, name)

        def fails(path: Path, *more: object, whole: object = whole) -> object:
            if "bad" in path.name:
                raise RuntimeError("of our own")
            return whole(path, *more)

        monkeypatch.setattr(module, name, fails)
        assert cli.run([command, *map(str, items)]) == 1
        output = capsys.readouterr()
        assert f"{items[0]}: unexpected: RuntimeError: of our own; this is an error in vehsim" in output.err
        assert "good" in output.out or "car: " in output.out
