"""`vehsim inspect`: a foreign asset's axes, sizes and wheels, compared with what riggers wrote by hand."""

from __future__ import annotations

import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

from vehsim import Shot, load_vehicle
from vehsim.assets import shipped
from vehsim.cli import commands as cli
from vehsim.cli.inspect import inspect, write_vehicle
from vehsim.cli.new import new_shot
from vehsim.errors import InputError
from vehsim.rig.linkage import moved
from vehsim.rig.ops import frames_of

ELSEWHERE = Path(__file__).parents[1] / "assets_elsewhere"
OWN = {path.parent.name: path.parent for path in sorted(ELSEWHERE.glob("*/vehicle.toml"))}
SHIPPED = {name: shipped("vehicle")[name].parent for name in ("car", "helicopter", "two_wheeled")}
HANDMADE = OWN | SHIPPED


def asset_of(folder: Path) -> Path:
    return next(path for path in sorted(folder.iterdir()) if path.stem == folder.name and path.suffix != ".mtl")


def written(folder: Path, to: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return write_vehicle(inspect(asset_of(folder)), to).parent


@pytest.mark.parametrize("name", HANDMADE)
def test_inspect_agrees_with_the_riggers_vehicle_toml(tmp_path: Path, name: str) -> None:
    ours, theirs = load_vehicle(written(HANDMADE[name], tmp_path / name)), load_vehicle(HANDMADE[name])
    driven = {channel for channel in theirs.rig.drives if not channel.startswith("travel_")}
    if name == "crawler":
        driven |= {"steer_fl", "steer_fr"}  # its author left them out
    if "main_rotor" in driven:
        driven |= {"disc_pitch", "disc_roll"}  # which older files leave out
    assert set(ours.rig.drives) == driven
    for channel in driven & set(theirs.rig.drives):
        mine, his = ours.rig.drives[channel], theirs.rig.drives[channel]
        assert (mine.op, np.sign(mine.factor)) == (his.op, np.sign(his.factor))
        assert mine.prim == his.prim or mine.prim.startswith(f"{his.prim}/")
        assert (mine.pivot is None) == (his.pivot is None)
    if theirs.group.dim == 3:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = inspect(asset_of(HANDMADE[name]))
        assert len(found.wheels) == sum(channel.startswith("roll_") for channel in driven)
        np.testing.assert_allclose(ours.rig.origin, theirs.rig.origin, atol=0.01)
        for channel in (
            "roll_rl",
            "roll_fl",
            "steer_fl",
            "roll_left",
        ):  # radius, wheelbase and track, from the rotation of the wheels
            if channel in ours.channels:
                assert turned(ours, channel) == pytest.approx(turned(theirs, channel), rel=0.003)


def turned(vehicle: object, channel: str) -> float:
    """How fast, or how far, a wheel turns in a bend: ``xi`` = (yaw rate, speed), ``r`` = joints."""
    one = vehicle.channels[channel]
    law = one.rate or one.value
    return float(law(0.0, [0.3, 0.4], [0.0, 0.0], [0.5, 2.0, 0.0], [0.0, 0.0]))


@pytest.mark.parametrize("name", OWN)
def test_the_written_vehicle_toml_works_unchanged(tmp_path: Path, name: str) -> None:
    """A shot of the vehicle, in a studio's folder, passes its check; its wheels roll as far as it drives."""
    shutil.copytree(OWN[name], tmp_path / "studio", ignore=shutil.ignore_patterns("vehicle.toml"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        path = write_vehicle(inspect(asset_of_copy(tmp_path / "studio", name)), tmp_path / "studio")
        shot, _ = new_shot(tmp_path / "first", str(path.parent))
        assert [str(problem) for problem in Shot.load(shot).check() if problem.severity == "error"] == []
        (clip,) = Shot.load(shot).solve().clips.values()
    assert np.linalg.norm(np.ptp(clip.positions, axis=0)) > 3 * 0.5
    if "roll_rl" in clip.channels:
        way = np.linalg.norm(np.diff(clip.positions[:, :2], axis=0), axis=1).sum()
        wheel = inspect(path.parent).wheels[0].radius
        mean = np.mean([np.ptp(clip.channels[f"roll_{at}"]) for at in ("rl", "rr")])
        assert mean * wheel == pytest.approx(way, rel=0.05)
    shutil.rmtree(tmp_path / "studio")  # no stage of ours


def asset_of_copy(folder: Path, name: str) -> Path:
    return next(path for path in sorted(folder.iterdir()) if path.stem == name and path.suffix != ".mtl")


CAR_USD = """#usda 1.0
(
    defaultPrim = "thing"
    metersPerUnit = {unit}
    upAxis = "Z"
)
def Xform "thing"
{{
    {parts}
}}
"""


def cylinder(name: str, centre: tuple[float, float, float], radius: float, width: float) -> str:
    """A wheel that turns about its Y, as USD."""
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = [(radius * np.sin(a), s * width / 2, radius * np.cos(a)) for s in (-1, 1) for a in angles]
    faces = [(k, (k + 1) % 16, 16 + (k + 1) % 16, 16 + k) for k in range(16)]
    return mesh(name, centre, ring, faces)


def mesh(name: str, centre: tuple, points: list, faces: list) -> str:
    rows = ", ".join(f"({x:.6f}, {y:.6f}, {z:.6f})" for x, y, z in points)
    return f"""def Xform "{name}"
    {{
        double3 xformOp:translate = {tuple(map(float, centre))}
        uniform token[] xformOpOrder = ["xformOp:translate"]
        def Mesh "{name}"
        {{
            int[] faceVertexCounts = {[len(face) for face in faces]}
            int[] faceVertexIndices = {[k for face in faces for k in face]}
            point3f[] points = [{rows}]
        }}
    }}
    """


def box(name: str, centre: tuple, size: tuple) -> str:
    corners = [(x * size[0], y * size[1], z * size[2]) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh(name, centre, corners, faces)


@pytest.mark.parametrize("unit", [1.0, 0.01])
@pytest.mark.parametrize("backwards", [False, True])
def test_units_and_reversed_noses_are_found(tmp_path: Path, unit: float, backwards: bool) -> None:
    sign, scale = (-1 if backwards else 1), 1 / unit
    wheels = {"wheel_fl": (1.2, 0.6), "wheel_fr": (1.2, -0.6), "wheel_rl": (-1.3, 0.6), "wheel_rr": (-1.3, -0.6)}
    parts = [box("body", (0, 0, 0.9 * scale), (4 * scale, 1.6 * scale, 0.8 * scale))]
    for name, (x, y) in wheels.items():
        place = (sign * x * scale, sign * y * scale, 0.3 * scale)
        parts.append(cylinder(name, place, 0.3 * scale, 0.2 * scale))
    (tmp_path / "thing.usda").write_text(CAR_USD.format(unit=unit, parts="\n".join(parts)))
    found = inspect(tmp_path / "thing.usda")
    assert found.keys["forward"] == ("-X" if backwards else "+X")
    np.testing.assert_allclose(found.bounds[1] - found.bounds[0], (4, 1.6, 1.3), atol=0.02)
    vehicle = load_vehicle(write_vehicle(found, tmp_path / "made").parent)
    np.testing.assert_allclose(vehicle.rig.origin, (-1.3, 0, 0), atol=1e-3)
    factors = {drive.factor for channel, drive in vehicle.rig.drives.items() if channel.startswith("roll")}
    assert factors == {-1.0 if backwards else 1.0}  # turned about, its own Y points to the right
    (tmp_path / "thing.usda").unlink()


def test_an_asset_without_turning_parts_is_a_rigid_body(tmp_path: Path) -> None:
    (tmp_path / "thing.usda").write_text(CAR_USD.format(unit=1, parts=box("crate", (0, 0, 0.5), (2, 1, 1))))
    vehicle = load_vehicle(write_vehicle(inspect(tmp_path / "thing.usda"), tmp_path / "made").parent)
    assert vehicle.inertia[5, 5] == pytest.approx(600.0) and not vehicle.controls
    np.testing.assert_allclose(vehicle.rig.origin, (0, 0, 0.5), atol=1e-6)
    (tmp_path / "thing.usda").unlink()


def test_inspect_prints_and_writes_but_never_overwrites(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asset = asset_of(OWN["kart"])
    assert cli.run(["inspect", str(asset)]) == 0
    output = capsys.readouterr().out
    for word in (
        "up axis   Y",
        "0.01 m",
        "nose      +Z",
        "1.9 x 1.16 x 0.65 m",
        "tyre_fl",
        "radius 0.14 m",
        "[physics]",
    ):
        assert word in output
    assert cli.run(["inspect", str(asset), "--write", str(tmp_path / "kart")]) == 0
    before = (tmp_path / "kart" / "vehicle.toml").read_text()
    assert cli.run(["inspect", str(asset), "--write", str(tmp_path / "kart")]) == 2
    assert "exists and is not overwritten" in capsys.readouterr().err
    assert (tmp_path / "kart" / "vehicle.toml").read_text() == before
    assert cli.run(["inspect", str(tmp_path / "kart")]) == 0  # also accepts a vehicle's folder


@pytest.mark.parametrize("name, content", [("a.usda", "nothing"), ("a.obj", "o a\n"), ("a.glb", "x"), ("a.txt", "x")])
def test_invalid_assets_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: str
) -> None:
    (tmp_path / name).write_text(content)
    assert cli.run(["inspect", str(tmp_path / name), "--write", str(tmp_path / "made")]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"{tmp_path / name}: ") and "Traceback" not in said
    assert not (tmp_path / "made").exists()
    assert cli.run(["inspect", str(tmp_path / "none.usd")]) == 2
    assert cli.run(["inspect", str(tmp_path)]) == 2
    (tmp_path / name).unlink()


def test_an_obj_whose_vertices_are_no_numbers_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 50.0v 0\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"a.obj: asset: cannot be read \(ValueError: could not convert"):
        inspect(tmp_path / "a.obj")


def test_an_asset_of_very_many_parts_is_refused(tmp_path: Path) -> None:
    parts = "".join(
        f'    def Xform "p{k}"\n    {{\n        def Mesh "m"\n        {{\n'
        "            point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0)]\n            int[] faceVertexCounts = [3]\n"
        "            int[] faceVertexIndices = [0, 1, 2]\n        }\n    }\n"
        for k in range(1001)
    )
    head = '#usda 1.0\n(\n    defaultPrim = "a"\n    metersPerUnit = 1\n    upAxis = "Z"\n)\ndef Xform "a"\n{\n'
    (tmp_path / "a.usda").write_text(head + parts + "}\n")
    with pytest.raises(InputError, match=r"a.usda: 1,001 parts, at most 1,000; inspect the vehicle alone"):
        inspect(tmp_path / "a.usda")


def test_a_blocked_vehicle_of_cylinders_and_cubes_drives(tmp_path: Path) -> None:
    """What animators block with has no mesh: wheels are found, roll on the ground, and are drawn."""
    from pxr import Usd, UsdGeom

    from vehsim.exporters.usd.exporter import write_usd
    from vehsim.exporters.usd.stage import StageReader
    from vehsim.runtime.progress import silent

    stage = Usd.Stage.CreateNew(str(tmp_path / "van.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/van").GetPrim())
    body = UsdGeom.Cube.Define(stage, "/van/body")
    body.AddTranslateOp().Set((0, 110, 0))
    body.AddScaleOp().Set((90, 60, 220))
    for name, x, z in (("fl", 82, 150), ("fr", -82, 150), ("rl", 82, -150), ("rr", -82, -150)):
        wheel = UsdGeom.Cylinder.Define(stage, f"/van/wheel_{name}")
        wheel.AddTranslateOp().Set((x, 35, z))
        wheel.CreateAxisAttr("X")
        wheel.CreateRadiusAttr(35)
        wheel.CreateHeightAttr(22)
    stage.Save()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = inspect(tmp_path / "van.usda")
        toml = write_vehicle(found, tmp_path / "van")
        shot, _ = new_shot(tmp_path / "drive", str(toml.parent))
        take = Shot.load(shot).solve()
        write_usd(take, tmp_path / "out", silent)
    assert len(found.wheels) == 4 and found.keys["forward"] == "+Z"
    (clip,) = take.clips.values()
    way = np.linalg.norm(np.diff(clip.positions[:, :2], axis=0), axis=1).sum()
    mean = np.mean([np.ptp(clip.channels[f"roll_{at}"]) for at in ("rl", "rr")])
    assert way > 1 and mean * 0.35 == pytest.approx(way, rel=0.05)
    shapes = StageReader(tmp_path / "out" / f"{take.name}.usda").shapes
    assert sum("wheel_" in shape.name for shape in shapes) == 4


def test_inspect_proposes_coning_for_blades_on_their_own_hinges(tmp_path: Path) -> None:
    """Three blades along their own Y; with the numbers that the file proposes in comments, they cone. Blades without
    frames of their own get no channel."""
    from pxr import Gf, Usd, UsdGeom

    def asset(name: str, framed: bool) -> Path:
        stage = Usd.Stage.CreateNew(str(tmp_path / f"{name}.usda"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        root = UsdGeom.Xform.Define(stage, "/bird")
        stage.SetDefaultPrim(root.GetPrim())

        def block(path: str, low: tuple[float, ...], high: tuple[float, ...]) -> None:
            cube = UsdGeom.Cube.Define(stage, path)
            cube.CreateSizeAttr(1.0)
            cube.AddTranslateOp().Set(Gf.Vec3d(*(np.add(low, high) / 2).tolist()))
            cube.AddScaleOp().Set(Gf.Vec3f(*np.subtract(high, low).tolist()))

        block("/bird/body", (-2, -0.5, 0), (2, 0.5, 1.5))
        rotor = UsdGeom.Xform.Define(stage, "/bird/main_rotor")
        rotor.AddTranslateOp().Set(Gf.Vec3d(0, 0, 2))
        for k in range(3):
            blade = UsdGeom.Xform.Define(stage, f"/bird/main_rotor/blade_{k}")
            if framed:
                blade.AddRotateZOp().Set(120.0 * k)
                block(f"{blade.GetPath()}/look", (-0.1, 0.3, 0), (0.1, 4, 0.05))
            else:
                box, turn = trimesh.creation.box((0.2, 3.7, 0.05)), np.radians(120.0 * k)
                flat = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
                points = box.vertices + np.array([0, 2.15, 0.025])
                points[:, :2] = points[:, :2] @ flat.T
                mesh = UsdGeom.Mesh.Define(stage, f"{blade.GetPath()}/look")
                mesh.CreatePointsAttr([Gf.Vec3f(*point) for point in points.tolist()])
                mesh.CreateFaceVertexCountsAttr([3] * len(box.faces))
                mesh.CreateFaceVertexIndicesAttr(box.faces.ravel().tolist())
        stage.Save()
        return tmp_path / f"{name}.usda"

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = write_vehicle(inspect(asset("bird", True)), tmp_path / "bird").read_text()
        plain = write_vehicle(inspect(asset("plain", False)), tmp_path / "plain").read_text()
    assert "coning" not in plain
    assert 'prim = ["main_rotor/blade_0", "main_rotor/blade_1", "main_rotor/blade_2"]' in text
    for key in ("rotor_radius", "solidity", "lock_number", "blades_up"):
        text = text.replace(f"# {key}", key)
    (tmp_path / "bird/vehicle.toml").write_text(text)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        bird = load_vehicle(tmp_path / "bird")
    assert bird.parameters == {} and {"coning_1", "coning_2", "coning_3"} < set(bird.rig.drives)
    poses = {f"coning_{k}": np.array([0.1]) for k in (1, 2, 3)}
    for k in range(3):
        path = f"main_rotor/blade_{k}"
        R, p = moved(bird.rig, path, poses, 1)
        tip = frames_of(bird.rig)[path] @ [0.0, 4.0, 0.0, 1.0]
        assert (R @ tip[:3] + p)[0, 2] - tip[2] == pytest.approx(4 * np.sin(0.1), abs=1e-6)
