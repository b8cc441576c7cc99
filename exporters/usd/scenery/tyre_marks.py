"""Tyre marks: what sliding tyres leave on the ground, as ribbons that grow behind the wheels.

A tyre marks the ground by its slip times its load: the work of its friction per metre of its way. Each slide is cut
into ribbons of constant topology. Their points move: rows that the tyre has not reached yet lie at its contact, so that
any renderer that reads moving points shows marks as they are made. They are for pictures only.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.exporters.usd.metadata import local_origin
from vehsim.exporters.usd.sampling import clip_at
from vehsim.exporters.usd.scenery.lighting import encode_srgb
from vehsim.exporters.usd.scenery.textured import author_textured
from vehsim.exporters.usd.stage import TYRE_MARK
from vehsim.vehicles.definition.surfaces import SurfaceName
from vehsim.world.ground.tyres import Tyre, contacts, tyres_of

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip
    from vehsim.delivery.take import Take
    from vehsim.exporters.usd.packing import Pack
    from vehsim.world.terrain.terrain import Terrain

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Look:
    """How tyres mark a surface: the linear ``colour`` and the ``opacity`` of a full mark. Slip times load, over the
    tyre's mean load, marks from ``least`` on and fully from ``most`` on; ``rolling``: strength of the track of a tyre
    that rolls."""

    colour: tuple[float, float, float]
    opacity: float
    least: float
    most: float
    rolling: float = 0.0


LOOKS: Mapping[SurfaceName, Look] = {
    "asphalt": Look((0.012, 0.012, 0.013), 0.85, 0.08, 0.6),
    "wet asphalt": Look((0.02, 0.02, 0.021), 0.35, 0.15, 0.8),
    "gravel": Look((0.085, 0.066, 0.05), 0.75, 0.05, 0.5, 0.12),
    "snow": Look((0.30, 0.31, 0.33), 0.8, 0.05, 0.4, 0.35),
    "ice": Look((0.25, 0.28, 0.30), 0.35, 0.1, 0.6),
}
"""Rubber on asphalt, damp earth below loose stones, pressed snow, scratched ice (our choice)."""
PER_FRAME = 2
"""Rows of a ribbon per frame: 0.2 m at 35 km/h."""
ROWS = 48
"""Largest number of rows of a ribbon: the samples of a mark grow with its length, not with its square."""
FAINT = 0.02
"""Strength below which there is no mark."""
PATCH = 0.5
"""Length of a tyre's contact over its radius: the width of the mark of a tyre that slides sideways."""
ABOVE = 0.006
"""Height of marks above the ground, m."""
NEAR = 0.3
"""Largest distance between a contact and the ground below it, m: further away is another ground, such as a bridge's."""
STILL = 0.05
"""Speed of a contact, m/s, below which its mark is as wide as the tyre."""
TEXELS = (64, 64)
"""Width and height of the texture: across a mark, and from no mark to a full one."""
SHOULDER = 0.14
"""Share of a mark's width over which each of its edges fades."""


@dataclass(frozen=True, eq=False)
class Ribbon:
    """A piece of a mark: ``times`` (k,) in frames at which the tyre made its rows, ``points`` (k, 2, 3) m of their left
    and right ends, ``strengths`` (k,)."""

    times: Array
    points: Array
    strengths: Array

    def at(self, frame: float) -> Array:
        """Points (k, 2, 3) in a frame: rows not yet made lie at the last one that is."""
        made = max(int(np.searchsorted(self.times, frame + 1e-9, side="right")) - 1, 0)
        return self.points[np.minimum(np.arange(len(self.times)), made)]


def author_tyre_marks(stage: Any, scope: str, take: Take, pack: Pack) -> None:
    """Author the marks of all vehicles of a take as ``<scope>/<vehicle>_<wheel>_<number>``, and their materials."""
    from pxr import UsdGeom, UsdShade

    materials: dict[str, Any] = {}
    layer = Path(stage.GetRootLayer().realPath)
    for name, clip in take.clips.items():
        for wheel, ribbons in marks_of(clip, take.world.terrain, take.frames):
            surface = clip.vehicle.surface
            if surface not in materials:
                file = pack.folder / "assets" / "tyre_marks" / f"{surface.replace(' ', '_')}.png"
                _write_texture(file, LOOKS[surface])
                pack.written.append(file)
                place = f"{scope}/materials/{file.stem}"
                UsdGeom.Scope.Define(stage, f"{scope}/materials")
                materials[surface] = _author_material(stage, place, pack.relative(file, layer))
            for k, ribbon in enumerate(ribbons):
                mesh = UsdGeom.Mesh.Define(stage, f"{scope}/{name}_{wheel}_{k}")
                _author_ribbon(mesh, ribbon, LOOKS[surface])
                UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(materials[surface])


def marks_of(clip: Clip, terrain: Terrain | None, frames: tuple[int, int]) -> Iterator[tuple[str, list[Ribbon]]]:
    """Names of the wheels that mark the ground in ``frames`` (first, last), each with its ribbons."""
    first, last = max(frames[0], clip.start_frame), min(frames[1], clip.end_frame)
    if last <= first or not clip.vehicle.group.planar:
        return
    times = np.arange(PER_FRAME * (last - first) + 1) / PER_FRAME + first
    at, look = clip_at(clip, times), LOOKS[clip.vehicle.surface]
    for tyre in tyres_of(at):
        strengths = _strengths(tyre, look)
        if not strengths.any():
            continue
        points = _edges(at, tyre, terrain)
        yield tyre.name, [Ribbon(times[part], points[part], strengths[part]) for part in _pieces(strengths > 0)]


def _strengths(tyre: Tyre, look: Look) -> Array:
    """How strong a mark a tyre leaves (n,): 0 to 1."""
    share = np.ones(len(tyre.slip)) if tyre.load is None else tyre.load / max(float(tyre.load.mean()), 1e-9)
    scrub = np.clip((np.minimum(tyre.slip, 1.0) * share - look.least) / (look.most - look.least), 0, 1)
    strength = (look.rolling + (1 - look.rolling) * scrub) * tyre.contact
    return np.where(strength < FAINT, 0.0, strength)


def _pieces(marked: NDArray[np.bool_]) -> Iterator[slice]:
    """Runs of rows with a mark, each with a row before and after it, in pieces of at most `ROWS` that share a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(int)))
    for start, end in edges.reshape(-1, 2).tolist():
        start, end = max(start - 1, 0), min(end + 1, len(marked))
        for k in range(start, end - 1, ROWS - 1):
            yield slice(k, min(k + ROWS, end))


def _edges(clip: Clip, tyre: Tyre, terrain: Terrain | None) -> Array:
    """The left and right end (n, 2, 3) m of a tyre's mark at every sample: across its way, on the ground."""
    places, headings = contacts(clip, tyre)
    way = np.gradient(places, clip.times, axis=0)[:, :2]
    speed, nose = np.linalg.norm(way, axis=1), headings[:, :2]
    nose = nose / np.maximum(np.linalg.norm(nose, axis=1, keepdims=True), 1e-9)
    way = np.where((speed > STILL)[:, None], way / np.maximum(speed, STILL)[:, None], nose)
    along, aside = np.abs((way * nose).sum(axis=1)), np.abs(way[:, 0] * nose[:, 1] - way[:, 1] * nose[:, 0])
    rings = tyre.wheel.rings
    width = np.ptp(rings[:, 0]) * along + PATCH * rings[:, 1].max() * aside
    left = np.column_stack([-way[:, 1], way[:, 0]])
    turned = np.sum(left[1:] * left[:-1], axis=1) < 0  # a tyre that begins to roll back
    left *= np.where(np.cumsum(np.concatenate([[0], turned])) % 2, -1.0, 1.0)[:, None]
    reach = left * (width / 2)[:, None]
    ends = np.repeat(places[:, None], 2, axis=1)
    ends[:, 0, :2] += reach
    ends[:, 1, :2] -= reach
    if terrain is not None:
        ground = terrain.height(ends[..., :2].reshape(-1, 2)).reshape(len(ends), 2)
        ends[..., 2] = np.where(np.abs(ground - ends[..., 2]) < NEAR, ground, ends[..., 2])
    ends[..., 2] += ABOVE
    return ends


def _author_ribbon(mesh: Any, ribbon: Ribbon, look: Look) -> None:
    from pxr import Gf, Sdf, UsdGeom, Vt

    count = len(ribbon.times)
    primvars, types, vertex = UsdGeom.PrimvarsAPI(mesh), Sdf.ValueTypeNames, UsdGeom.Tokens.vertex
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    corners = 2 * np.arange(count - 1)[:, None] + np.array([0, 1, 3, 2])
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray([4] * (count - 1)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners.astype(np.int32).ravel()))
    mesh.GetPrim().CreateAttribute(TYRE_MARK, types.Bool, variability=Sdf.VariabilityUniform).Set(True)
    strengths = np.repeat(ribbon.strengths, 2)
    st = np.column_stack([np.tile([0.0, 1.0], count), (strengths * (TEXELS[1] - 1) + 0.5) / TEXELS[1]])
    primvars.CreatePrimvar("st", types.TexCoord2fArray, vertex).Set(Vt.Vec2fArray.FromNumpy(st.astype(np.float32)))
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*look.colour)])
    opacity = Vt.FloatArray.FromNumpy((look.opacity * strengths).astype(np.float32))
    primvars.CreatePrimvar("displayOpacity", types.FloatArray, vertex).Set(opacity)
    mesh.CreateNormalsAttr(Vt.Vec3fArray(2 * count, Gf.Vec3f(0, 0, 1)))
    mesh.SetNormalsInterpolation(vertex)
    origin = local_origin(ribbon.points.reshape(-1, 3).mean(axis=0))
    if origin.any():
        mesh.AddTranslateOp().Set(Gf.Vec3d(*origin.tolist()))
    layer = mesh.GetPrim().GetStage().GetEditTarget().GetLayer()
    whole = np.arange(np.floor(ribbon.times[0]), np.ceil(ribbon.times[-1]) + 1).tolist()
    places = np.stack([ribbon.points, *map(ribbon.at, whole)]) - origin
    single = places.astype(np.float32).reshape(len(places), -1, 3)
    boxes = np.stack([single.min(axis=1), single.max(axis=1)], axis=1)
    for attribute, values in ((mesh.CreatePointsAttr(), single), (mesh.CreateExtentAttr(), boxes)):
        first, *arrays = map(Vt.Vec3fArray.FromNumpy, values)
        attribute.Set(first)
        path = attribute.GetPath()
        with Sdf.ChangeBlock():  # tells listeners once
            for frame, array in zip(whole, arrays, strict=True):
                layer.SetTimeSample(path, frame, array)


def _write_texture(file: Path, look: Look) -> None:
    """Colour and opacity of a mark: across it, it fades at its edges; from its bottom to its top it gets stronger."""
    from PIL import Image

    width, height = TEXELS
    across, strong = (np.arange(width) + 0.5) / width, np.linspace(1, 0, height)
    alpha = look.opacity * strong[:, None] * profile(across)
    colour = np.broadcast_to(encode_srgb(np.array(look.colour)), (height, width, 3))
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.dstack([colour, np.round(255 * alpha).astype(np.uint8)])).save(file)


def profile(across: Array) -> Array:
    """Share of a mark's strength (n,) at ``across`` (n,), 0 to 1 from one edge to the other."""
    edge = np.clip(np.minimum(across, 1 - across) / SHOULDER, 0, 1)
    return np.asarray(edge * edge * (3 - 2 * edge))


def _author_material(stage: Any, path: str, texture: str) -> Any:
    from pxr import Sdf

    types = Sdf.ValueTypeNames
    material, image, surface = author_textured(stage, path, texture, "mark", wrap="clamp")
    surface.CreateInput("roughness", types.Float).Set(0.85)
    opacity = surface.CreateInput("opacity", types.Float)
    opacity.ConnectToSource(image.CreateOutput("a", types.Float))
    return material
