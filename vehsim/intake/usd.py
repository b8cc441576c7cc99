"""Read USD files: stages that open, and meshes whose indices are valid."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehsim.errors import InputError
from vehsim.intake.gate import reading, refuse

Array = NDArray[np.float64]
Faces = NDArray[np.int64]
SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")


def open_stage(path: str | Path, load: bool = True) -> Any:
    """The stage of a file; ``load``: with its payloads. Raises ``InputError``."""
    from pxr import Usd, UsdGeom

    with reading(path, "asset", "export it again as USD"):
        try:
            stage = Usd.Stage.Open(str(path), *[Usd.Stage.LoadNone] * (not load))
        except Exception as error:
            raise refuse(path, "asset", f"not readable as USD ({_last_line(error)})", "export it again") from error
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
        raise refuse(path, "asset", f"not readable as USD ({_last_line(error)})", "export it again") from error


def triangles_of(mesh: Any, when: Any, file: str | Path) -> tuple[Array, Faces] | None:
    """A mesh's points (n, 3) in its own space and units, and its triangles (m, 3), in the sense they are authored.

    None for an empty one. Raises ``InputError`` that names the prim and ``file``, which holds it.
    """
    prim = str(mesh.GetPath())
    points = np.array(mesh.GetPointsAttr().Get(when) or [], float).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(when) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(when) or [], np.int64)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(when) or [], np.int64)
    if not len(points) or not len(counts):
        return None
    fits = counts.min() >= 0 and counts.sum() == len(indices) and _within(indices, len(points))
    if not (fits and _within(holes, len(counts))):
        raise InputError(f"its faces do not fit its {len(points)} points", "export the mesh again", key=prim, file=file)
    if not np.isfinite(points).all():
        raise InputError("points that are not finite numbers", "export the mesh again", key=prim, file=file)
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


def dependencies(asset: Path) -> tuple[list[Path], list[str]]:
    """The files that the USD file ``asset`` needs, including itself, and references that do not resolve."""
    from pxr import UsdUtils

    if asset.suffix == ".usdz":  # a package contains all files that it needs
        return [asset], []
    with reading(asset, "asset"):
        layers, assets, missing = UsdUtils.ComputeAllDependencies(str(asset))
        paths = [layer.realPath for layer in layers] + [str(path) for path in assets]
        return sorted({Path(path.split("[")[0]).resolve() for path in paths if path}), sorted(missing)


def beyond(files: Iterable[Path], *homes: Path) -> list[Path]:
    """The ``files`` outside all folders ``homes``, after following links: an asset could refer to any file of this
    machine."""
    inside = [home.resolve() for home in homes]
    return [file for file in files if not any(file.resolve().is_relative_to(home) for home in inside)]


def _within(indices: Faces, count: int) -> bool:
    return not len(indices) or bool(indices.min() >= 0 and indices.max() < count)


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1].strip()[:300] if lines else type(error).__name__
