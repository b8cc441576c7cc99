"""The verifier of random shots refutes spoiled deliveries, ask by ask, and no correct one.

Deliveries are authored here with USD only: smooth motions whose positions, speeds and attitudes are known formulas.
"""

from __future__ import annotations

import ast
import importlib.util
import math
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
TOOL = ROOT / "tools" / "audit_random" / "verify.py"
ASSETS = ROOT / "assets" / "vehicles"
FPS, FIRST, LAST, STILL = 24, 1001, 1121, 12
MIDDLE = (FIRST + LAST) // 2


def load(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module  # dataclasses need it
    spec.loader.exec_module(module)
    return module


verify = load(TOOL)
pytestmark = pytest.mark.broken_stages  # time codes and units are spoiled, and validating the others takes longest


def ease(frames: np.ndarray) -> np.ndarray:
    """From 0 to 1 between the holds, at rest without acceleration at both ends."""
    s = np.clip((frames - FIRST - STILL) / (LAST - FIRST - 2 * STILL), 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


class Delivery:
    """Samples to be spoiled: ``x`` (n, 3) m, ``angles`` (n, 3) roll, pitch, yaw in degrees, driven parts in their
    units."""

    def __init__(self, asset: str, start: Any, end: Any) -> None:
        self.asset = asset
        self.frames = np.arange(FIRST, LAST + 1.0)
        self.x = np.array(start) + ease(self.frames)[:, None] * np.subtract(end, start)
        self.angles = np.zeros((len(self.frames), 3))
        self.drives: dict[tuple[str, str], np.ndarray] = {}
        self.boxes: list[tuple[Any, Any]] = []
        self.ground: float | None = None
        self.dropped: list[int] = []
        self.fps, self.unit, self.last = float(FPS), 1.0, LAST

    def bump(self, width: float, centre: float = MIDDLE) -> np.ndarray:
        """A smooth bump of height one, ``width`` frames to either side."""
        s = np.clip(np.abs(self.frames - centre) / width, 0, 1)
        return (1 - s**2) ** 3

    def write(self, folder: Path) -> Path:
        from pxr import Gf, Usd, UsdGeom

        stage = Usd.Stage.CreateNew(str(folder / "shot.usda"))
        root = UsdGeom.Xform.Define(stage, "/shot")
        stage.SetDefaultPrim(root.GetPrim())
        UsdGeom.SetStageMetersPerUnit(stage, self.unit)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        stage.SetStartTimeCode(FIRST)
        stage.SetEndTimeCode(self.last)
        stage.SetTimeCodesPerSecond(self.fps)
        stage.SetFramesPerSecond(self.fps)
        mover = UsdGeom.Xform.Define(stage, "/shot/vehicles/mover")
        mover.GetPrim().GetReferences().AddReference(str(ASSETS / self.asset / f"{self.asset}.usdc"))
        mover.ClearXformOpOrder()
        place, turn = mover.AddTranslateOp(opSuffix="m"), mover.AddOrientOp(UsdGeom.XformOp.PrecisionDouble, "m")
        for k, frame in enumerate(self.frames):
            if k in self.dropped:
                continue
            place.Set(Gf.Vec3d(*self.x[k].tolist()), frame)
            roll, pitch, yaw = (
                Gf.Rotation(Gf.Vec3d(*axis), a) for axis, a in zip(np.eye(3).tolist(), self.angles[k], strict=True)
            )
            turn.Set(Gf.Quatd((roll * pitch * yaw).GetQuat()), frame)  # pxr multiplies from the left: roll first
        for (path, kind), values in self.drives.items():
            part = UsdGeom.Xformable(stage.OverridePrim(f"/shot/vehicles/mover/{path}"))
            op = part.AddXformOp(
                getattr(UsdGeom.XformOp, f"Type{kind[0].upper()}{kind[1:]}"), UsdGeom.XformOp.PrecisionDouble, "spin"
            )
            for frame, value in zip(self.frames, values, strict=True):
                op.Set(float(value), frame)
        for n, (centre, size) in enumerate(self.boxes):
            _box(stage, f"/shot/env/obstacles/box_{n}/box_{n}", centre, size)
        if self.ground is not None:
            mesh = UsdGeom.Mesh.Define(stage, "/shot/env/terrain/ground")
            mesh.CreatePointsAttr([(x, y, self.ground) for x, y in ((-99, -99), (99, -99), (99, 99), (-99, 99))])
            mesh.CreateFaceVertexCountsAttr([4])
            mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
        stage.GetRootLayer().Save()
        return folder / "shot.usda"


def _box(stage: Any, path: str, centre: Any, size: Any) -> None:
    from pxr import UsdGeom

    corners = [[(x, y, z) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))] for z in (-1, 1)]
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr([tuple(np.array(c) * size / 2 + centre) for c in corners[0] + corners[1]])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    faces = [3, 2, 1, 0, 4, 5, 6, 7, 0, 1, 5, 4, 1, 2, 6, 5, 2, 3, 7, 6, 3, 0, 4, 7]
    mesh.CreateFaceVertexIndicesAttr(faces)


REST = {"velocity": [0, 0, 0]}
SECONDS = (LAST - FIRST - 2 * STILL) / FPS
START, END = (0.0, 0.0, 20.0), (12.0, 0.0, 22.0)
PEAK = 1.875 / SECONDS
"""Speed at the midpoint over the distance."""
PUSH = 10 / math.sqrt(3) / SECONDS**2
"""Largest acceleration over the distance."""
WAY = math.hypot(12, 2)
FASTEST = round(FIRST + STILL + 0.2113 * SECONDS * FPS)
"""The frame with the largest acceleration."""


def shot(asset: str, marks: list[dict[str, Any]], **motion: Any) -> dict[str, Any]:
    plan = {"method": "plan", "mark": marks, **motion}
    header = {"schema": 1, "name": "shot", "start_frame": FIRST}
    return {"shot": header, "vehicle": [{"name": "mover", "asset": asset, "motion": plan}]}


def flight() -> tuple[Delivery, dict[str, Any]]:
    """A helicopter that stays, flies through a gate at the midpoint, looks ahead, and stays; with every possible
    request."""
    made = Delivery("helicopter", START, END)
    made.boxes = [((6.0, 9.0, 23.0), (2.0, 2.0, 6.0))]
    marks = [
        {"frame": FIRST, "position": START, "heading": 0.0, **REST, "hold": STILL},
        {
            "frame": MIDDLE,
            "position": [6, 0, 21],
            "velocity": [12 * PEAK, 0, 2 * PEAK],
            "orientation": [1, 0, 0, 0],
            "gate": {"direction": [1, 0, 0], "radius": 0.5},
        },
        {"frame": MIDDLE + 5, "speed": float(WAY * _slope(5)), "position": [*_place(5)], "tolerance": 0.1},
        {"frame": LAST - STILL, "position": END, **REST, "hold": STILL},
    ]
    limits = {
        "speed": WAY * PEAK,
        "climb": 2 * PEAK,
        "acceleration": WAY * PUSH,
        "g_load": float(math.hypot(12 * PUSH / 9.81, 1 + 2 * PUSH / 9.81)),
        "turn_rate": 5.0,
        "bank": 3.0,
        "ceiling": 22.0,
    }
    look = {"at": [60, 0, 20], "within": 4.0}
    stay = {"above": 20.0, "below": 22.0, "inside": [-1, -1, 13, 1]}
    requested = shot("helicopter", marks, limits=limits, look=[look], stay=[stay], clearance=0.8)
    return made, requested | {"world": {"obstacle": [{"shape": "box", "centre": [6, 9, 20], "size": [2, 2, 6]}]}}


def _slope(frames: float) -> float:
    s = 0.5 + frames / FPS / SECONDS
    return 30 * s**2 * (1 - s) ** 2 / SECONDS


def _place(frames: float) -> np.ndarray:
    return np.array(START) + ease(np.array([MIDDLE + frames]))[0] * np.subtract(END, START)


def drive() -> tuple[Delivery, dict[str, Any]]:
    """A car straight ahead over level ground, whose steered wheels turn slightly."""
    made = Delivery("car", (0, 0, 0), (12, 0, 0))
    made.ground = 0.0
    sigma = 0.1 * made.bump(30)
    for side, name in ((1, "fl"), (-1, "fr")):
        made.drives[f"steer_{name}", "rotateZ"] = np.degrees(np.arctan2(sigma, 1 - side * 0.77 / 2.6 * sigma))
    marks = [
        {"frame": FIRST, "position": [0, 0, 0], "heading": 0.0, **REST, "hold": STILL, "joints": {"sigma": 0.0}},
        {"frame": MIDDLE, "joints": {"sigma": 0.1}},
        {"frame": LAST - STILL, "position": [12, 0, 0], **REST, "hold": STILL},
    ]
    limits = {"steering": 5.8, "steering_rate": 8.0, "joints": {"sigma": 0.1}, "joint_rates": {"sigma": 0.15}}
    return made, shot("car", marks, limits=limits, clearance=0.5) | {"world": {"terrain": "flat"}}


def landing() -> tuple[Delivery, dict[str, Any]]:
    """A gentle landing on a pad; its skids are 0.0 m below its root."""
    made = Delivery("helicopter", (0, 0, 2.0), (0, 0, 0.0))
    made.ground = 0.0
    marks = [
        {"frame": FIRST, "position": [0, 0, 2], "heading": 0.0, **REST},
        {"frame": LAST - STILL, "position": [0, 0, 1], "heading": 0.0, "on_ground": True, "hold": STILL},
    ]
    return made, shot("helicopter", marks, clearance=0.2)


def circuit() -> tuple[Delivery, dict[str, Any]]:
    """A loop: up and down again, at rest at its ends."""
    made = Delivery("helicopter", START, START)
    made.x[:, 2] += 2 * made.bump(40)
    marks = [{"frame": FIRST, "position": START}, {"frame": MIDDLE, "position": [0, 0, 22]}, {"frame": LAST}]
    return made, shot("helicopter", marks, loop=True)


def free() -> tuple[Delivery, dict[str, Any]]:
    """Marks at frames chosen by the planner."""
    made = Delivery("helicopter", START, END)
    marks = [
        {"frame": FIRST, "position": START, **REST},
        {"frame": "free", "position": [*_place(3)]},
        {"frame": "free", "position": END, **REST, "hold": STILL},
    ]
    return made, shot("helicopter", marks)


def handles() -> tuple[Delivery, dict[str, Any]]:
    """A cut out of a flight that continues before and after it."""
    made = Delivery("helicopter", START, END)
    requested = shot("helicopter", [{"frame": FIRST + 50, "position": [*_place(-10)]}, {"frame": LAST - 50}])
    requested["shot"] |= {"start_frame": FIRST + 50, "end_frame": LAST - 50, "handles": 50}
    return made, requested


def halt(made: Delivery) -> None:
    """The motion stops at the last frame of the cut."""
    made.x[made.frames > LAST - 50] = made.x[made.frames == LAST - 50]


def spoil_x(k: int, width: float, size: float, centre: float = MIDDLE) -> Callable[[Delivery], None]:
    def spoil(made: Delivery) -> None:
        made.x[:, k] += size * made.bump(width, centre)

    return spoil


def spoil_angle(k: int, width: float, size: float, centre: float = MIDDLE) -> Callable[[Delivery], None]:
    def spoil(made: Delivery) -> None:
        made.angles[:, k] += size * made.bump(width, centre)

    return spoil


def wave(k: int, centre: float, size: float, angle: bool = False) -> Callable[[Delivery], None]:
    """A vehicle at its place at a frame, but moving there."""

    def spoil(made: Delivery) -> None:
        values = made.angles if angle else made.x
        values[:, k] += size * np.sin((made.frames - centre) / 4) * made.bump(20, centre)

    return spoil


def steer(size: float) -> Callable[[Delivery], None]:
    def spoil(made: Delivery) -> None:
        for name in ("steer_fl", "steer_fr"):
            made.drives[name, "rotateZ"] = size * made.drives[name, "rotateZ"]

    return spoil


def backwards(made: Delivery) -> None:
    near = np.abs(made.frames - MIDDLE) < 3
    made.x[near] = made.x[near][::-1]


def set_attribute(name: str, value: Any) -> Callable[[Delivery], None]:
    return lambda made: setattr(made, name, value)


def drift(made: Delivery) -> None:
    made.x[:, 1] += 0.02 * np.clip((made.frames - (LAST - STILL)) / STILL, 0, 1)


def sink(made: Delivery) -> None:
    """The same descent in half a second."""
    s = np.clip((made.frames - (LAST - STILL - 12)) / 12, 0, 1)
    made.x[:, 2] = 2 - 2 * s**2 * (3 - 2 * s)


SPOILS: list[tuple[str, Callable[[], Any], Callable[[Delivery], None]]] = [
    ("mark.position", flight, spoil_x(1, 40, 0.0015, LAST)),
    ("mark.heading", flight, spoil_angle(2, 40, 0.08, FIRST)),
    ("mark.orientation", flight, spoil_angle(0, 40, 0.08)),
    ("mark.velocity", flight, wave(1, MIDDLE, 0.002)),
    ("mark.rest", flight, wave(2, LAST - STILL, 0.05, angle=True)),
    ("mark.speed", flight, wave(0, MIDDLE + 5, 0.002)),
    ("mark.joints", drive, steer(0.95)),
    ("mark.frame", free, spoil_x(2, 60, 0.3)),
    ("gate.plane", flight, spoil_x(0, 30, 0.004)),
    ("gate.opening", flight, spoil_x(1, 30, 0.502)),
    ("gate.direction", flight, backwards),
    ("hold.position", flight, drift),
    ("hold.turn", flight, spoil_angle(2, 11, 0.1, LAST)),
    ("hold.speed", flight, drift),
    ("look", flight, spoil_angle(2, 30, 4.6)),
    ("stay", flight, spoil_x(2, 20, 0.003, LAST)),
    ("limit speed", flight, spoil_x(0, 20, 0.1, MIDDLE + 10)),
    ("limit climb", flight, spoil_x(2, 20, 0.1, MIDDLE + 10)),
    ("limit acceleration", flight, spoil_x(0, 8, -0.005, FASTEST)),
    ("limit g_load", flight, spoil_x(2, 8, -0.01, FASTEST)),
    ("limit turn_rate", flight, spoil_angle(2, 10, 2)),
    ("limit bank", flight, spoil_angle(0, 20, 3.1)),
    ("limit ceiling", flight, spoil_x(2, 20, 0.02, LAST)),
    ("limit steering", drive, steer(1.05)),
    ("limit steering_rate", drive, steer(1.7)),
    ("limit joints", drive, steer(1.05)),
    ("limit joint_rates", drive, steer(1.7)),
    ("loop.place", circuit, spoil_x(0, 20, 0.0015, LAST)),
    ("loop.turn", circuit, spoil_angle(1, 20, 0.1, LAST)),
    ("loop.velocity", circuit, wave(0, LAST, 0.002)),
    ("clearance", flight, spoil_x(1, 30, 2.0)),
    ("clearance", landing, spoil_x(2, 50, -2.5)),
    ("on_ground.touch", landing, spoil_x(2, 40, 0.03, LAST)),
    ("on_ground.level", landing, spoil_angle(0, 40, 0.1, LAST)),
    ("on_ground.descent", landing, sink),
    ("wheels", drive, spoil_x(2, 20, 0.01)),
    ("handles", handles, halt),
    ("obstacles", flight, set_attribute("boxes", [((6.0, 9.0, 23.0), (2.0, 2.0, 5.99))])),
    ("obstacles", flight, set_attribute("boxes", [])),
    ("terrain", drive, set_attribute("ground", -0.002)),
    ("samples", flight, set_attribute("dropped", [30])),
    ("time codes", flight, set_attribute("fps", 25.0)),
    ("time codes", flight, set_attribute("last", LAST + 1)),
    ("units", flight, set_attribute("unit", 0.01)),
]


@pytest.mark.parametrize("case", [flight, drive, landing, circuit, free, handles])
def test_correct_deliveries_are_not_refuted(case: Callable[[], Any], tmp_path: Path) -> None:
    made, requested = case()
    found = verify.verify(requested, made.write(tmp_path))
    assert [row.text for row in found.rows] == []


@pytest.mark.parametrize(("ask", "case", "spoil"), SPOILS, ids=[f"{s[0]}-{n}" for n, s in enumerate(SPOILS)])
def test_spoiled_deliveries_are_refuted(ask: str, case: Any, spoil: Any, tmp_path: Path) -> None:
    made, requested = case()
    spoil(made)
    found = verify.verify(requested, made.write(tmp_path))
    assert ask in {row.ask for row in found.rows} or (ask == "mark.frame" and found.rows)


def test_the_verifier_does_not_import_vehsim() -> None:
    imported = {
        name.split(".")[0]
        for node in ast.walk(ast.parse(TOOL.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }
    assert imported - set(sys.stdlib_module_names) == {"numpy", "pxr", "fcl", "igl"}
