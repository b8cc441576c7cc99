"""A delivery audited from its files alone: correct ones pass, spoiled ones fail."""

from __future__ import annotations

import json
import math
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from vehsim.audit import missed
from vehsim.errors import InputError, SolveError
from vehsim.exporters.checks.audit import audit_delivery, changed_files
from vehsim.shot import Shot

SHOT: dict[str, Any] = {
    "shot": {"schema": 1, "name": "over", "fps": "24000/1001", "start_frame": 1001},
    "world": {
        "terrain": "flat",
        "obstacle": [{"shape": "box", "name": "block", "centre": [30, 0, 0], "size": [4, 4, 10]}],
    },
    "vehicle": [
        {
            "name": "heli",
            "asset": "helicopter",
            "motion": {
                "method": "plan",
                "segments": 24,
                "clearance": 2.0,
                "limits": {"speed": 16, "ceiling": 30},
                "look": [{"at": [60, 0, 10], "frames": [1001, 1020], "within": 20}],
                "stay": [{"above": 5}],
                "mark": [
                    {"frame": 1001, "position": [0, 0, 12], "heading": 0, "velocity": [0, 0, 0]},
                    {"frame": 1193, "position": [60, 0, 12], "heading": 0, "velocity": [0, 0, 0], "hold": 24},
                ],
            },
        }
    ],
}

UNSEEN = ("clearance", "control_rate", "command", "spinning")
"""Measures that a stage does not show: it has no controls."""


@pytest.fixture(scope="module")
def delivery(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Shot.from_dict(SHOT).solve().export(tmp_path_factory.mktemp("out"), ("usd", "usdz"))


@pytest.fixture
def copy(delivery: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(delivery, tmp_path / "over"))


def edit(folder: Path, change: Callable[[float, Any], Any], below: str = ".xformOp:translate") -> None:
    """Change the root's positions in the animation layer, or another op's values: frame, value -> value."""
    from pxr import Gf, Sdf

    layer = Sdf.Layer.FindOrOpen(str(folder / "layers" / "heli.anim.usdc"))
    path = Sdf.Path(f"/{layer.defaultPrim}{below}")
    for frame in layer.ListTimeSamplesForPath(path):
        value = np.array(layer.QueryTimeSample(path, frame))
        changed = change(frame, value)
        layer.SetTimeSample(path, frame, Gf.Vec3d(*changed.tolist()) if value.ndim else float(changed))
    layer.Save()


def keys(folder: Path) -> set[str]:
    return {row.key for rows in audit_delivery(folder).values() for row in missed(rows)}


def test_the_report_has_a_row_for_every_ask_measured_on_clip_and_stage(delivery: Path) -> None:
    rows = json.loads((delivery / "report.json").read_text())["audit"]["heli"]
    requested = {row["key"] for row in rows}
    assert {"mark[0].position", "mark[1].position", "mark[1].heading", "mark[1].velocity", "mark[1].hold"} <= requested
    assert {"limits.speed", "limits.ceiling", "look_at", "stay", "clearance", "shot.end_frame"} <= requested
    requests = [row for row in rows if row["severity"] == "error"]
    assert all(row["met"] for row in requests)
    assert all(row["stage"]["met"] for row in requests if row["measure"] not in UNSEEN)


def test_a_good_delivery_passes_from_its_files_alone(copy: Path) -> None:
    assert keys(copy) == set()
    (row,) = [row for row in audit_delivery(copy)["heli"] if row.key == "clearance"]
    rows = json.loads((copy / "report.json").read_text())["audit"]["heli"]
    (ours,) = [row for row in rows if row["key"] == "clearance"]
    assert row.value == pytest.approx(ours["value"], abs=0.05)  # libigl on the stage's meshes against MuJoCo's hulls


def test_a_packaged_delivery_passes_too(copy: Path) -> None:
    (copy / "over.usda").unlink()
    assert keys(copy) == set()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        (lambda frame, p: np.add(p, [0, 0, 0.002 * (frame == 1193)]), "mark[1].position"),
        (lambda frame, p: p - [0, 0, 0.01 * max(0.0, frame - 1193)], "mark[1].hold"),
        (lambda frame, p: np.add(p, [0.05 * (frame - 1001), 0, 0]), "mark[1].position"),
        (lambda frame, p: p * [1, 1, 3], "limits.ceiling"),
        (lambda frame, p: np.add(p, [2.0 * (frame == 1050), 0, 0]), "limits.speed"),
        (lambda frame, p: p - [0, 0, 20.0 * (1030 < frame < 1100)], "stay"),
        (lambda frame, p: np.array([p[0], 0.0, 9.0]) if 1030 < frame < 1120 else p, "clearance"),
    ],
)
def test_a_spoiled_stage_is_refused(copy: Path, change: Callable[[float, Any], Any], key: str) -> None:
    edit(copy, change)
    assert key in keys(copy)


def test_a_spoiled_sample_that_misses_no_request_is_refused(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is requested of the helicopter's path from side to side: only the file itself shows the change."""
    from vehsim.cli.commands import run

    assert changed_files(copy) == []
    edit(copy, lambda frame, p: np.add(p, [0, 0.01 * (frame == 1130), 0]))
    assert keys(copy) == set() and changed_files(copy) == ["layers/heli.anim.usdc"]
    assert run(["audit", str(copy), "--quiet"]) == 1
    assert "MISSED  layers/heli.anim.usdc: changed since the export; export the shot again" in capsys.readouterr().out


def test_invalid_deliveries_are_named(copy: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a delivery"):
        audit_delivery(tmp_path / "nowhere")
    report = json.loads((copy / "report.json").read_text())
    del report["audit"]
    (copy / "report.json").write_text(json.dumps(report))
    with pytest.raises(InputError, match="holds no asks"):
        audit_delivery(copy)
    for stage in ("over.usda", "over.usdz"):
        (copy / stage).unlink()
    with pytest.raises(InputError, match="no stage"):
        audit_delivery(copy)


def test_the_audit_command_lists_missed_requests(
    copy: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    from vehsim.batch import screen
    from vehsim.cli.commands import run

    monkeypatch.setattr(screen, "PAUSE", 0.0)  # as if seconds passed between any two of our lines
    assert run(["audit", str(copy)]) == 0
    output = capsys.readouterr()
    assert "ok      heli: mark[1].hold" in output.out
    assert re.search(r"^heli: distances at frame \d+  \d+%  \d+ s$", output.err, re.MULTILINE)
    edit(copy, lambda frame, p: np.add(p, [0, 0, 0.01 * (frame == 1193)]))
    assert run(["audit", str(copy), "--quiet"]) == 1
    output = capsys.readouterr()
    assert "MISSED  heli: mark[1].position: 0.01 m, 0.001 allowed, at frame 1193" in output.out and not output.err


CAR: dict[str, Any] = {
    "shot": {"schema": 1, "name": "over", "end_frame": 1049},
    "world": {"terrain": "hills"},
    "vehicle": [
        {
            "name": "heli",
            "asset": "car",
            "motion": {"method": "simulate", "start": {"position": [0, 0, 0], "velocity": [4, 0, 0]}},
        }
    ],
}


def test_a_car_that_floats_or_sinks_is_refused(tmp_path: Path) -> None:
    from vehsim.world.world import World

    height = float(World("hills").height([[0.0, 0.0]])[0])
    CAR["vehicle"][0]["motion"]["start"]["position"][2] = height
    folder = Shot.from_dict(CAR).solve().export(tmp_path, ("usd",))
    assert keys(folder) == set()
    (row,) = [row for row in audit_delivery(folder)["heli"] if row.key == "wheels"]
    assert abs(row.value or 1.0) < 2e-3
    edit(folder, lambda frame, p: np.add(p, [0, 0, 0.008 * (frame == 1030)]))
    assert keys(folder) == {"wheels"}
    edit(folder, lambda frame, p: np.add(p, [0, 0, -0.016 * (frame == 1030)]))
    assert keys(folder) == {"wheels"}


def test_a_wheel_that_does_not_roll_is_refused(tmp_path: Path) -> None:
    """It turns by two turns too little in the second half, or in one frame; each wheel counts."""
    folder = Shot.from_dict(CAR).solve().export(tmp_path / "good", ("usd",))
    (row,) = [row for row in audit_delivery(folder)["heli"] if row.key == "rolling"]
    assert row.met and abs(row.value or 0.0) < math.radians(1)
    for prim in ("wheel_rl", "steer_fr/wheel_fr"):
        for change in (lambda frame: 30 * max(frame - 1025, 0), lambda frame: 720 * (frame > 1025)):
            spoiled = Path(shutil.copytree(folder, tmp_path / "spoiled" / "over"))
            edit(spoiled, lambda frame, angle, change=change: angle - change(frame), f"/{prim}.xformOp:rotateY:spin")
            assert keys(spoiled) == {"rolling"}
            shutil.rmtree(spoiled)


@pytest.mark.parametrize(("aside", "within"), [(0.0, False), (1.5, False), (2.5, True), (3.5, True)])
def test_a_car_in_the_wall_of_a_tunnel_is_reported(tmp_path: Path, aside: float, within: bool) -> None:
    """The depth of its deepest side is known: walls stand 3 m from the middle of the way, on which it was driven."""
    from vehsim.vehicles import load_vehicle
    from vehsim.world.obstacles.obstacles import hulls_of

    rock = [((-30, -25, -5), (30, 25, 0)), ((-10, -15, -1), (10, -3, 8)), ((-10, 3, -1), (10, 15, 8))]
    roof = ((-10, -3, 3), (10, 3, 8))
    trimesh.boolean.union([trimesh.creation.box(bounds=b) for b in (*rock, roof)]).export(tmp_path / "tunnel.obj")
    start = {"position": [-20, 0, 0], "velocity": [12, 0, 0]}
    motion = {"method": "simulate", "duration": 2, "start": start}
    data = CAR | {"vehicle": [{"name": "heli", "asset": "car", "motion": motion}]}
    data |= {"shot": {"schema": 1, "name": "over"}, "world": {"terrain": str(tmp_path / "tunnel.obj")}}
    folder = Shot.from_dict(data).solve().export(tmp_path / "out", ("usd",))
    edit(folder, lambda frame, p: np.add(p, [0, aside, 0]))
    (row,) = [row for row in audit_delivery(folder)["heli"] if row.key == "contact"]
    side = max(float(hull[:, 1].max()) for hull in hulls_of(load_vehicle("car")))
    assert row.met is not within
    assert row.value == (pytest.approx(3 - aside - side, abs=0.01) if within else np.inf)


def test_a_car_that_is_driven_into_a_wall_is_refused_by_the_wall(tmp_path: Path) -> None:
    """Its wheels are in the rock, where it has no ground. A car that only scrapes along it is warned about."""
    rock = [((-30, -25, -5), (30, 25, 0)), ((-10, -15, -1), (10, -3, 8)), ((-10, -4, 6), (10, 5, 8))]
    trimesh.boolean.union([trimesh.creation.box(bounds=b) for b in rock]).export(tmp_path / "cliff.obj")

    def driven(y: float, heading: float) -> Shot:
        start = {"position": [-5, y, 0], "heading": heading, "velocity": [5 * (heading == 0), -5 * (heading != 0), 0]}
        data = CAR | {"vehicle": [{"name": "heli", "asset": "car", "motion": {"method": "simulate", "duration": 1}}]}
        data["vehicle"][0]["motion"]["start"] = start
        world = {"terrain": str(tmp_path / "cliff.obj")}
        return Shot.from_dict(data | {"shot": {"schema": 1, "name": "over"}, "world": world})

    with pytest.raises(SolveError, match=r"heli: world.terrain = .*rock of the terrain at .*, -3.* plan"):
        driven(0, -90).solve()
    with pytest.warns(UserWarning, match=r"heli: reaches into the rock of the terrain at .* keep away"):
        driven(-2.2, 0).solve()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        driven(0, 0).solve()


def test_wheels_on_a_rigid_body_cannot_all_touch_rough_ground(tmp_path: Path) -> None:
    """Three wheels determine its pose: a warning names the gap of the fourth, and the delivery is kept."""
    x, y = np.meshgrid(np.arange(-20.0, 21.0), np.arange(-20.0, 21.0))
    np.savez(tmp_path / "rough.npz", heights=0.1 * np.sin(x) * np.sin(y), cell=[1.0, 1.0], origin=[-20.0, -20.0])
    kart = Path(__file__).parents[1] / "assets_elsewhere" / "kart"
    data = {
        "shot": {"schema": 1, "name": "over", "end_frame": 1025},
        "world": {"terrain": str(tmp_path / "rough.npz")},
        "vehicle": [{**CAR["vehicle"][0], "asset": str(kart)}],
    }
    with pytest.warns(UserWarning, match=r"heli: wheels: -?0\.\d+ m, -?0\.005 .*; give its wheels travel_\* channels"):
        folder = Shot.from_dict(data).solve().export(tmp_path, ("usd",))
    assert keys(folder) == set()
    (row,) = [row for row in audit_delivery(folder)["heli"] if row.key == "wheels"]
    assert row.met is False and row.severity == "warning"


STEERED: dict[str, Any] = {
    "shot": {"schema": 1, "name": "over"},
    "vehicle": [
        {
            "name": "heli",
            "asset": "car",
            "motion": {
                "method": "plan",
                "character": "stunt",
                "segments": 24,
                "limits": {"steering_rate": 20, "joint_rates": {"sigma": 0.3}, "joints": {"sigma": 0.3}},
                "mark": [
                    {"frame": 1001, "position": [0, 0, 0], "heading": 0, "joints": {"sigma": 0}},
                    {"frame": 1097, "position": [14, 4, 0], "heading": 20, "joints": {"sigma": 0.05}},
                ],
            },
        }
    ],
}


def test_joints_are_measured_from_the_stage(tmp_path: Path) -> None:
    """The wheels are steered differently from the plan: the clip's joints cannot show that."""
    folder = Shot.from_dict(STEERED).solve().export(tmp_path / "good", ("usd",))
    rows = {row.key: row for row in audit_delivery(folder)["heli"]}
    requested = {"mark[0].joints.sigma", "mark[1].joints.sigma", "limits.steering_rate", "limits.joint_rates.sigma",
             "limits.joints.sigma"}  # fmt: skip
    assert all(rows[key].met for key in requested)
    ours = {row["key"]: row["value"] for row in json.loads((folder / "report.json").read_text())["audit"]["heli"]}
    assert rows["limits.joints.sigma"].value == pytest.approx(ours["limits.joints.sigma"], abs=1e-3)
    assert abs(rows["limits.joint_rates.sigma"].value or 0) == pytest.approx(0.3, rel=0.1)

    wheel = "/steer_fl.xformOp:rotateZ:spin"
    spoils: dict[str, Callable[[float, Any], Any]] = {
        "limits.joint_rates.sigma": lambda frame, angle: angle + (frame == 1030) * 2.0,
        "limits.steering_rate": lambda frame, angle: angle + (frame == 1030) * 2.0,
        "limits.joints.sigma": lambda frame, angle: angle * 3,
        "mark[1].joints.sigma": lambda frame, angle: angle + (frame == 1097) * 0.2,
    }
    for key, change in spoils.items():
        spoiled = Path(shutil.copytree(folder, tmp_path / key / "over"))
        edit(spoiled, change, wheel)
        assert key in keys(spoiled)


@pytest.mark.parametrize("metres", [1.0, 2.0])  # it is faster and faster, or slows at the end
def test_a_stage_longer_than_a_motion_that_ends_while_it_moves_passes(metres: float, tmp_path: Path) -> None:
    """The velocity at the last mark belongs to the motion, not to the frames after it, where the boat stands still."""
    shot: dict[str, Any] = {
        "shot": {"schema": 1, "name": "passing", "end_frame": 1060, "handles": 8},
        "world": {"wind": [0.9, -1.1, 0]},
        "vehicle": [
            {
                "name": "boat",
                "asset": "boat",
                "motion": {
                    "method": "plan",
                    "mark": [
                        {"frame": 1001, "position": [0, 0, 0], "heading": 0, "velocity": [0, 0, 0]},
                        {"frame": 1049, "position": [metres, 0, 0], "speed": 2.0},
                    ],
                },
            }
        ],
    }
    with pytest.warns(UserWarning, match="stands still"):
        delivery = Shot.from_dict(shot).solve().export(tmp_path, ("usd",))
    assert keys(delivery) == set()
    (row,) = [row for row in audit_delivery(delivery)["boat"] if row.key == "mark[1].speed"]
    assert row.value is not None and row.value < 1e-3


def test_an_empty_mesh_in_the_look_of_a_terrain_is_no_ground(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    np.save(place / "heights.npy", np.zeros((30, 30)))
    metadata = '(\n defaultPrim = "m"\n metersPerUnit = 1\n upAxis = "Z"\n)'
    meshes = 'def Xform "m"\n{\n def Mesh "empty"\n {\n }\n}\n'
    (place / "look.usda").write_text(f"#usda 1.0\n{metadata}\n{meshes}")
    (place / "terrain.toml").write_text('heights = "heights.npy"\nlook = "look.usda"\ncell = 1.0\n')
    motion = {"method": "simulate", "duration": 0.1}
    shot = {"shot": {"schema": 1, "name": "empty"}, "world": {"terrain": str(place)}}
    take = Shot.from_dict(shot | {"vehicle": [{"name": "car", "asset": "car", "motion": motion}]}).solve()
    assert keys(take.export(tmp_path / "out", to=("usd",))) == set()
