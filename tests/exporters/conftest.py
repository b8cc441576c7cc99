"""Small fixtures: a two-part vehicle asset in any units, smooth motion with a fast rotor, a bumpy terrain."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vehsim.cameras.camera import CameraRig
from vehsim.cameras.framing import solve_camera
from vehsim.clip.clip import Clip
from vehsim.delivery.take import RenderSettings, Take
from vehsim.lie import SE3
from vehsim.rig.rig import Drive, Rig
from vehsim.vehicles.definition.base import Control
from vehsim.vehicles.definition.character import Character
from vehsim.world.terrain.terrain import Terrain
from vehsim.world.world import World

FRAMES = (1001, 1024)


def silent(what: str, done: float) -> None:
    """Ignore progress."""


def write_asset(path: Path, metres: float = 1.0, up: str = "Z", edit: Callable[[Any], None] | None = None) -> Path:
    """A box with a rotor on top, in ``metres`` per unit, ``up`` its up axis; ``edit`` gets the stage."""
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdShade

    path.parent.mkdir(parents=True, exist_ok=True)
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up)
    root = UsdGeom.Xform.Define(stage, "/toy")
    stage.SetDefaultPrim(root.GetPrim())
    Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
    UsdGeom.Scope.Define(stage, "/toy/materials")
    material = UsdShade.Material.Define(stage, "/toy/materials/paint")
    shader = UsdShade.Shader.Define(stage, "/toy/materials/paint/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(0.8, 0.1, 0.05))
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))

    def place(x: float, y: float, z: float) -> Gf.Vec3d:  # metres, Z up, to the asset's own axes and units
        own = (x, y, z) if up == "Z" else (x, z, -y)
        return Gf.Vec3d(*(value / metres for value in own))

    body = UsdGeom.Xform.Define(stage, "/toy/body")
    _box(stage, "/toy/body/body", np.array(place(2.0, 1.0, 0.6)), material)
    body.AddTranslateOp().Set(place(0.0, 0.0, 0.5))
    rotor = UsdGeom.Xform.Define(stage, "/toy/rotor")
    _box(stage, "/toy/rotor/rotor", np.array(place(2.4, 0.2, 0.05)), material)
    rotor.AddTranslateOp().Set(place(0.2, 0.0, 1.2))
    if edit:
        edit(stage)
    stage.GetRootLayer().Save()
    return path


def _box(stage: Any, path: str, half_sizes: Any, material: Any) -> None:
    from pxr import Gf, UsdGeom, UsdShade, Vt

    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * np.abs(half_sizes)
    faces = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([k for face in faces for k in face])
    mesh.CreateExtentAttr([Gf.Vec3f(*corners.min(0)), Gf.Vec3f(*corners.max(0))])
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def toy_clip(asset: Path, spin_axis: str = "Z", still: bool = False, drives: dict[str, Drive] | None = None) -> Clip:
    """One second at 24 frames on a climbing bend, its rotor at 40 rad/s; or standing still."""
    t = np.arange(FRAMES[1] - FRAMES[0] + 1) / 24.0
    s = np.zeros_like(t) if still else t
    positions = np.stack([12 * np.sin(s), 12 - 12 * np.cos(s), 6 + 2 * s], axis=1)
    euler = np.stack([s, 0.2 * np.sin(3 * s), -0.4 * np.sin(2 * s)], axis=1)
    orientations = Rotation.from_euler("ZYX", euler).as_quat(scalar_first=True)
    signs = np.where((orientations[1:] * orientations[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    orientations *= np.concatenate([[1.0], np.cumprod(signs)])[:, None]
    drives = drives or {"rotor": Drive("rotor", f"rotate{spin_axis}")}
    rig = Rig(asset=asset, root="", drives=drives)
    vehicle = SimpleNamespace(
        parameters={},
        name="toy",
        joints=(),
        channels={},
        controls=(Control("lift", unit="N"),),
        control_names=("lift",),
        rig=rig,
        character=Character(),
        origin=np.zeros(3),
        hull=None,
        floating=None,
        rolls=False,
        group=SE3,
    )
    count = len(t)
    return Clip(
        vehicle,  # type: ignore[arg-type]
        t,
        positions,
        orientations,
        np.zeros((count, 6)),
        np.zeros((count, 0)),
        np.zeros((count, 0)),
        np.zeros((count, 1)),
        {name: 40.0 * s for name in drives},
        Fraction(24),
        FRAMES[0],
    )


@pytest.fixture(scope="session")
def toys() -> SimpleNamespace:
    """``asset(path, ...)`` and ``clip(asset, ...)`` make toys; ``silent`` ignores progress."""
    return SimpleNamespace(asset=write_asset, clip=toy_clip, silent=silent, frames=FRAMES)


@pytest.fixture(scope="session")
def bumpy() -> Terrain:
    x, y = np.meshgrid(np.arange(-40, 41, 2.0), np.arange(-40, 41, 2.0))
    return Terrain("bumpy", 1.5 * np.sin(x / 7) * np.cos(y / 9), (-40.0, -40.0), (2.0, 2.0))


@pytest.fixture
def make_take(bumpy: Terrain) -> Callable[..., Take]:
    """Takes of toy clips: ``make_take(clip)`` or with other ``clips``, ``world`` and ``size``."""

    def make(*clips: Clip, world: World | None = None, size: tuple[int, int] = (160, 90), **more: Any) -> Take:
        named = {f"toy{k}": clip for k, clip in enumerate(clips)}
        world = world or World(bumpy)
        camera = solve_camera(CameraRig(), named, world, FRAMES, size[0] / size[1])
        settings = RenderSettings(size=size)
        return Take("shot", named, world, (camera,), Fraction(24), FRAMES, settings, **more)

    return make
