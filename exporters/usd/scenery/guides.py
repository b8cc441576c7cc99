"""Guides: information for animators that is not rendered.

The path of each vehicle, with its controls, speed and energies as animated attributes; its marks, the force on it, its
contacts, and the wind. All are prims of purpose ``guide``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vehsim.constants import STANDARD_GRAVITY
from vehsim.delivery.take import Take
from vehsim.exporters.usd.metadata import author_origin, local_origin, samples

if TYPE_CHECKING:
    from vehsim.clip.clip import Clip

Array = NDArray[np.float64]
Colour = tuple[float, float, float]

PATH_WIDTH, ARROW_WIDTH, POINT_WIDTH = 0.15, 0.1, 1.0
PATH, MARKS, FORCE, CONTACTS, WIND = (0.1, 0.7, 1.0), (1.0, 0.6, 0.0), (1.0, 0.2, 0.2), (1.0, 0.0, 0.8), (0.6, 0.9, 0.6)
METRES_PER_G = 2.0
"""Length of the force arrow of a vehicle at rest."""
SECONDS_OF_WIND = 0.5
"""Length of a wind arrow: the distance that the air travels in this time."""
WIND_ARROWS = 24


def author_guides(stage: Any, scope: str, take: Take, clips: Mapping[str, Clip]) -> None:
    """Author all guides below ``scope``; ``clips`` have a sample for every whole frame.

    Marks come from ``take.report["marks"]``: vehicle name -> list of mappings with a ``position`` (x, y, z) m.
    """
    for name, clip in clips.items():
        if len(clip.positions) > 1:
            path = _curves(stage, f"{scope}/{name}_path", clip.positions[None], PATH_WIDTH, PATH)
            _author_tracks(path, clip)
            _author_force(stage, f"{scope}/{name}_force", clip)
        _author_contacts(stage, f"{scope}/{name}_contacts", clip)
    for name, marks in take.report.get("marks", {}).items():
        positions = [mark["position"] for mark in marks if mark.get("position") is not None]
        if positions:
            _points(stage, f"{scope}/{name}_marks", np.asarray(positions, float), MARKS)
    wind = np.asarray(take.world.wind, float)
    if wind.any() and clips:
        places = np.concatenate([clip.positions for clip in clips.values()])
        places = places[np.unique(np.linspace(0, len(places) - 1, WIND_ARROWS).astype(int))]
        _curves(stage, f"{scope}/wind", _arrows(places, SECONDS_OF_WIND * wind), ARROW_WIDTH, WIND)


def _author_tracks(path: Any, clip: Clip) -> None:
    """Controls, speed and energies as animated attributes, which viewers show as curves: ``vehsim:controls:throttle``,
    ..."""
    from pxr import Sdf

    velocity = _velocity(clip)
    tracks = {
        f"controls:{control.name}": (clip.controls[:, k], control.unit)
        for k, control in enumerate(clip.vehicle.controls)
    }
    tracks["speed"] = (np.linalg.norm(velocity, axis=1), "m/s")
    tracks |= {f"energy:{name}": (values, "J") for name, values in clip.energy.items()}
    spec = path.GetPrim().GetStage().GetRootLayer().GetPrimAtPath(path.GetPath())
    with Sdf.ChangeBlock():
        for name, (values, unit) in tracks.items():
            track = samples(spec, f"vehsim:{name}", Sdf.ValueTypeNames.Double, clip.frames, values)
            track.documentation, track.custom = unit, True


def _author_force(stage: Any, prim_path: str, clip: Clip) -> None:
    """An arrow from the vehicle along the sum of all forces except its weight, two metres long per g."""
    from pxr import Gf

    seconds = 1.0 / float(clip.fps)
    lift = np.array([0.0, 0.0, STANDARD_GRAVITY])
    force = np.gradient(_velocity(clip), seconds, axis=0) + lift
    arrows = _arrows(clip.positions, force * (METRES_PER_G / STANDARD_GRAVITY))
    prim = _curves(stage, prim_path, arrows[:1], ARROW_WIDTH, FORCE)
    prim.GetPrim().SetDocumentation("the sum of all forces but weight; 2 m for each g")
    near = arrows - local_origin(arrows[0].mean(axis=0))
    for frame, arrow in zip(clip.frames.tolist(), near.astype(np.float32), strict=True):
        prim.GetPointsAttr().Set([Gf.Vec3f(*point.tolist()) for point in arrow], frame)
        prim.GetExtentAttr().Set(_extent(arrow, ARROW_WIDTH), frame)


def _author_contacts(stage: Any, prim_path: str, clip: Clip) -> None:
    """A point where each contact started, with its frame and impulse as primvars."""
    from pxr import Sdf, UsdGeom

    contacts = [event for event in clip.events if event.get("place") is not None]
    if not contacts:
        return
    points = _points(stage, prim_path, np.array([event["place"] for event in contacts], float), CONTACTS)
    primvars, floats = UsdGeom.PrimvarsAPI(points), Sdf.ValueTypeNames.FloatArray
    times = [clip.start_frame + float(event["time"]) * float(clip.fps) for event in contacts]
    primvars.CreatePrimvar("frame", floats, UsdGeom.Tokens.vertex).Set(times)
    impulses = [float(event.get("impulse", 0.0)) for event in contacts]
    primvars.CreatePrimvar("impulse", floats, UsdGeom.Tokens.vertex).Set(impulses)


def _velocity(clip: Clip) -> Array:
    """Velocity of the rig root, world axes (n, 3), m/s."""
    return np.gradient(clip.positions, clip.times, axis=0) if len(clip) > 1 else np.zeros((1, 3))


def _arrows(places: Array, vectors: Array) -> Array:
    """Polylines (n, 5, 3) from ``places`` (n, 3) along ``vectors`` (n, 3) or (3,), with a head in a vertical plane."""
    vectors = np.broadcast_to(vectors, places.shape)
    side = np.cross(vectors, (0.0, 0.0, 1.0))
    flat = np.linalg.norm(side, axis=1, keepdims=True)
    side = np.where(flat > 1e-6, side / np.maximum(flat, 1e-9), (1.0, 0.0, 0.0))
    across = 0.1 * np.linalg.norm(vectors, axis=1, keepdims=True) * side
    tips, necks = places + vectors, places + 0.8 * vectors
    return np.stack([places, tips, necks + across, tips, necks - across], axis=1)


def _curves(stage: Any, path: str, lines: Array, width: float, colour: Colour) -> Any:
    """Polylines ``lines`` (m, k, 3)."""
    from pxr import UsdGeom

    curves = UsdGeom.BasisCurves.Define(stage, path)
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr([lines.shape[1]] * len(lines))
    return _place(curves, lines.reshape(-1, 3), width, colour)


def _points(stage: Any, path: str, places: Array, colour: Colour) -> Any:
    from pxr import UsdGeom

    points = _place(UsdGeom.Points.Define(stage, path), places, POINT_WIDTH, colour)
    points.GetWidthsAttr().Set([POINT_WIDTH] * len(places))  # USD's own extent of points requires one width per point
    points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
    return points


def _place(prim: Any, points: Array, width: float, colour: Colour) -> Any:
    from pxr import Gf, UsdGeom, Vt

    points = points - author_origin(prim, points.mean(axis=0))
    prim.CreatePurposeAttr(UsdGeom.Tokens.guide)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
    prim.CreateWidthsAttr([width])
    prim.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    prim.CreateDisplayColorAttr([Gf.Vec3f(*colour)])
    prim.CreateExtentAttr(_extent(points, width))
    return prim


def _extent(points: Any, width: float) -> list[Any]:
    """The extent as USD computes it, to the bit: in single precision."""
    from pxr import Gf

    points, half = points.astype(np.float32), np.float32(width / 2)
    return [Gf.Vec3f(*(points.min(0) - half).tolist()), Gf.Vec3f(*(points.max(0) + half).tolist())]
