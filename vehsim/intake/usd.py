"""Read USD files: stages that open, and meshes whose indices are valid.

USD reads its files in this process, because deliveries are composed of them. The reader process has opened and read
each of them before, once for its content.
"""

from __future__ import annotations

import glob
import json
import math
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.intake.foreign import limit, raise_limit, reading, reason_of, refuse
from vehsim.intake.polygons import polygons
from vehsim.intake.reader import Answer, read_in_process
from vehsim.runtime.cache import Stamp, content_of, lookup, stamp, store

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
MAX_DEPTH = 500
"""Largest depth of a prim: the time to compose one grows with it."""
MOST_KEPT = 20_000_000
"""Largest size of the cached answers of `examine`, bytes: five thousand stages."""
SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


DRAWN = ("default", "render")
"""Purposes that are drawn and measured. Proxies stand for render geometry in viewports; guides are not drawn."""


def is_drawn(prim: Any) -> bool:
    """Whether a prim's purpose is one of `DRAWN`."""
    from pxr import UsdGeom

    return UsdGeom.Imageable(prim).ComputePurpose() in DRAWN


def open_stage(path: str | Path, load: bool = True) -> Any:
    """The stage of a file; ``load``: with its payloads. Raises ``InputError``."""
    from pxr import Usd, UsdGeom

    with reading(path, "asset", "export it again as USD"):
        dependencies(path)
        try:
            stage = Usd.Stage.Open(str(path), *[Usd.Stage.LoadNone] * (not load))
        except Exception as error:
            raise refuse(path, "asset", f"not readable as USD ({reason_of(error)})", "export it again") from error
        metres = UsdGeom.GetStageMetersPerUnit(stage)
        if not (math.isfinite(metres) and metres > 0):
            raise refuse(path, "metersPerUnit", "not a length", "give metres, such as 0.01 for centimetres", metres)
        return stage


@contextmanager
def complaints(path: str | Path) -> Iterator[None]:
    """A context for reading values of an open stage. USD reads them on demand, and may find them corrupt only then; its
    error becomes an ``InputError`` that names ``path``."""
    try:
        yield
    except Exception as error:
        if type(error).__module__ != "pxr.Tf":  # checked in this way, USD is not loaded for a shot without assets
            raise
        raise refuse(path, "asset", f"not readable as USD ({reason_of(error)})", "export it again") from error


def triangles_of(prim: Any, when: Any, file: str | Path) -> tuple[Array, Faces] | None:
    """Points (n, 3) of a mesh or a shape in its own space and units, and its triangles (m, 3), in the authored winding
    order.

    None for an empty one. Raises ``InputError`` that names the prim and ``file``, which holds it.
    """
    found = polygons(prim, when, file)
    if found is None:
        return None
    points, counts, indices, _ = found
    place = str(prim.GetPath())
    authored = prim.GetAttribute("holeIndices")  # which a shape has not
    holes = np.array((authored.Get(when) if authored else None) or [], np.int64)
    fits = counts.min() >= 0 and counts.sum() == len(indices) and _within(indices, len(points))
    if not (fits and _within(holes, len(counts))):
        raise InputError(
            f"its faces do not fit its {len(points)} points",
            "export the mesh again",
            key=place,
            file=file,
        )
    if not np.isfinite(points).all():
        raise InputError("points that are not finite numbers", "export the mesh again", key=place, file=file)
    return points, triangulate(counts, indices, holes)


def triangulate(counts: Faces, indices: Faces, holes: Faces | None = None) -> Faces:
    """Faces of ``counts`` corners as fans of triangles (m, 3), as Hydra draws them, without ``holes``."""
    keep = np.ones(len(counts), bool)
    if holes is not None:
        keep[holes] = False
    start = np.cumsum(counts) - counts
    fans = np.where(keep, np.maximum(counts - 2, 0), 0)
    first = np.repeat(start, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack([indices[first], indices[first + step + 1], indices[first + step + 2]], axis=1)


def key_times(attribute: Any) -> list[float]:
    """Time codes of an attribute's keys: its time samples, or the knots of its spline."""
    times = [float(time) for time in attribute.GetTimeSamples()]
    if not times and hasattr(attribute, "HasSpline") and attribute.HasSpline():  # USD has splines since 24.11
        times = [float(time) for time in attribute.GetSpline().GetKnots().keys()]  # noqa: SIM118
    return times


def dependencies(asset: str | Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """The files that the USD file ``asset`` needs, including itself, and references that do not resolve.

    The reader process reads every value of every layer first, so that nothing broken is opened here; again if one of
    the files was written. Raises ``InputError`` for a stage that cannot be read within the limits.
    """
    with reading(asset, "asset"):
        asset = Path(asset).resolve()
        known = _known.get(asset)
        if (
            known is None
            or known[0] != (_stamps(known[1]), limit("VEHSIM_READ_PRIMS"))
            or _found_since(known[2], asset.parent)
        ):
            files, missing = _screened(asset)
            _known[asset] = known = ((_stamps(files), limit("VEHSIM_READ_PRIMS")), files, missing)
        return known[1:]


_known: dict[Path, tuple[Any, tuple[Path, ...], tuple[str, ...]]] = {}
"""Results of `dependencies` in this process."""


def _found_since(missing: Iterable[str], folder: Path) -> bool:
    """Whether references that did not resolve name files that exist now; a texture may have several tiles."""
    names = (glob.escape(str(folder / name)).replace("<UDIM>", "*") for name in missing)
    return any(glob.glob(name) for name in names)


def _stamps(files: Iterable[Path]) -> tuple[Stamp | None, ...]:
    return tuple(stamp(file) if file.exists() else None for file in files)


def _screened(asset: Path) -> tuple[tuple[Path, ...], tuple[str, ...]]:
    """The answer of `examine`, cached as long as its files have the same content."""
    most = limit("VEHSIM_READ_PRIMS")
    made_of = (4, str(asset), content_of(asset))
    kept = lookup("screened", made_of)
    facts = None if kept is None else json.loads(kept)
    if (
        facts is None
        or facts["prims"] > most
        or any(content_of(name) != known for name, known in facts["files"].items())
        or _found_since(facts["missing"], asset.parent)
    ):
        facts = read_in_process(examine, asset, "asset", most)[0]
        store("screened", made_of, json.dumps(facts).encode(), MOST_KEPT)
    return tuple(map(Path, facts["files"])), tuple(facts["missing"])


def references(asset: Path) -> tuple[list[Any], list[Path], list[str]]:
    """The layers and files that a USD file needs, and references that do not resolve, found in this process: for the
    reader process, and for copies of files that it has read."""
    from pxr import UsdUtils

    if asset.suffix == ".usdz":  # a package contains all files that it needs
        return [], [asset], []
    layers, assets, missing = UsdUtils.ComputeAllDependencies(str(asset))
    named = [layer.realPath for layer in layers] + [str(path) for path in assets]
    return layers, sorted({Path(path.split("[")[0]).resolve() for path in named if path}), sorted(missing)


def examine(asset: Path, most: float) -> Answer:
    """Read a whole stage: every value of every layer, composition, transforms, material bindings and bounds. Return the
    hash of each of its files, the references that do not resolve, and the number of prims.

    Raises ``InputError`` beyond ``most`` prims. It runs in the reader process.
    """
    from pxr import Sdf, Usd, UsdGeom, UsdShade

    layer = Sdf.Layer.FindOrOpen(str(asset))
    if layer is None:
        raise refuse(asset, "asset", "not readable as USD", "export it again")
    written = _read_layers([layer], asset, most)  # first: to look for files in a million prims takes long
    layers, files, missing = references(asset)
    stage = Usd.Stage.Open(str(asset))
    others = [layer for layer in {*layers, *stage.GetUsedLayers()} if layer != stage.GetRootLayer()]
    written += _read_layers(others, asset, most)
    transforms = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    prims = 0
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies(Usd.PrimAllPrimsPredicate)):
        prims += 1
        if prims > most:
            raise _too_many(asset, most)
        _check_types(prim, asset)
        transforms.GetLocalToWorldTransform(prim)
        imageable = UsdGeom.Imageable(prim)
        if imageable:
            imageable.ComputeVisibility(Usd.TimeCode.EarliestTime())
            imageable.ComputePurpose()
            UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    purposes = UsdGeom.Imageable.GetOrderedPurposeTokens()
    UsdGeom.BBoxCache(Usd.TimeCode.EarliestTime(), purposes).ComputeWorldBound(stage.GetPseudoRoot())
    contents = {str(file): content_of(file) for file in files}
    return {"files": contents, "missing": missing, "prims": max(prims, written)}, []


def _read_layers(layers: Iterable[Any], asset: Path, most: float) -> int:
    """Read every value of every spec: USD reads them on demand, and may find them corrupt only then. Returns the number
    of prims, those of all variants included."""
    prims = 0
    for layer in layers:
        left = deque([layer.pseudoRoot])
        while left:
            spec = left.popleft()
            below = [*spec.nameChildren, *(one.primSpec for kind in spec.variantSets for one in kind.variants)]
            left += below
            prims += len(below)
            if prims > most:
                raise _too_many(asset, most)
            if spec.path.pathElementCount > MAX_DEPTH:
                said = f"prims nested deeper than {MAX_DEPTH}"
                raise refuse(asset, "asset", said, "group its prims in fewer levels")
            for each in (spec, *spec.properties):
                for key in each.ListInfoKeys():
                    with suppress(TypeError):  # a type that Python does not know, such as those of layer offsets
                        each.GetInfo(key)
                for time in layer.ListTimeSamplesForPath(each.path):
                    layer.QueryTimeSample(each.path, time)
    return prims


def _check_types(prim: Any, asset: Path) -> None:
    """Refuse properties of a prim's schemas, and drawn inputs of shaders, that are written with a type from which their
    values cannot be read."""
    from pxr import Sdf

    definition, inputs = prim.GetPrimDefinition(), _drawn_inputs() if prim.GetTypeName() == "Shader" else {}
    for attribute in prim.GetAuthoredAttributes():
        schema = definition.GetSchemaAttributeSpec(attribute.GetName())
        needed = schema.typeName if schema else inputs.get(attribute.GetName())
        for spec in attribute.GetPropertyStack() if needed else ():
            written = spec.typeName if isinstance(spec, Sdf.AttributeSpec) else None
            if not written or not (written == needed or _alike(written, needed)):
                said = f"of type {written or 'rel'}, not {needed}"
                raise InputError(said, "export it again", key=str(spec.path), file=asset)


@cache
def _drawn_inputs() -> dict[str, Any]:
    """The inputs of shaders that are drawn, with their types."""
    from pxr import Sdf

    colours = "diffuseColor", "emissiveColor"
    numbers = "opacity", "roughness", "metallic", "clearcoat", "clearcoatRoughness"
    types = dict.fromkeys(colours, Sdf.ValueTypeNames.Color3f) | dict.fromkeys(numbers, Sdf.ValueTypeNames.Float)
    return {f"inputs:{name}": kind for name, kind in types.items()}


def _alike(one: Any, other: Any) -> bool:
    """Whether values of a USD type can be read as those of another: both have numbers, as many, or both have text."""
    first, second = (np.asarray(kind.scalarType.defaultValue) for kind in (one, other))
    kinds = [next(same for same in ("biuf", "U", "O") if each.dtype.kind in same) for each in (first, second)]
    same = kinds[0] == kinds[1] != "O" and first.shape == second.shape
    return one.isArray == other.isArray and (same or bool(one.type == other.type))


def _too_many(asset: Path, most: float) -> InputError:
    remedy = raise_limit("VEHSIM_READ_PRIMS", "give a stage of the vehicle or terrain alone")
    return refuse(asset, "asset", f"more than {most:,.0f} prims", remedy)


def beyond(files: Iterable[Path], *homes: Path) -> list[Path]:
    """The ``files`` outside all folders ``homes``, after following links: an asset could refer to any file of this
    machine."""
    inside = [home.resolve() for home in homes]
    return [file for file in files if not any(file.resolve().is_relative_to(home) for home in inside)]


def _within(indices: Faces, count: int) -> bool:
    return not len(indices) or bool(indices.min() >= 0 and indices.max() < count)
