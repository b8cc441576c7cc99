"""USD files: stages that open, and meshes whose indices fit their points."""

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
    """For what reads values of an open stage: USD reads them when they are asked for, and may find them corrupt only
    then. Its complaint becomes an ``InputError`` that names ``path``."""
    try:
        yield
    except Exception as error:
        if type(error).__module__ != "pxr.Tf":  # asked this way, nobody loads USD for a shot without assets
            raise
        raise refuse(path, "asset", f"not readable as USD ({_last_line(error)})", "export it again") from error


def triangles_of(mesh: Any, when: Any, where: str) -> tuple[Array, Faces] | None:
    """A mesh's points (n, 3) in its own space and units, and its triangles (m, 3), in the sense they are authored.

    None for an empty one. Raises ``InputError`` that begins with ``where``: the file and the prim.
    """
    points = np.array(mesh.GetPointsAttr().Get(when) or [], float).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(when) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(when) or [], np.int64)
    holes = np.array(mesh.GetHoleIndicesAttr().Get(when) or [], np.int64)
    if not len(points) or not len(counts):
        return None
    fits = counts.min() >= 0 and counts.sum() == len(indices) and _within(indices, len(points))
    if not (fits and _within(holes, len(counts))):
        raise InputError(f"{where}: its faces do not fit its {len(points)} points; export the mesh again")
    if not np.isfinite(points).all():
        raise InputError(f"{where}: points that are not finite numbers; export the mesh again")
    return points, triangulate(counts, indices, holes)


def triangulate(counts: Faces, indices: Faces, holes: Faces | None = None) -> Faces:
    """Faces of ``counts`` corners as fans of triangles (m, 3), as Hydra draws them; ``holes`` are left out."""
    keep = np.ones(len(counts), bool)
    if holes is not None:
        keep[holes] = False
    start = np.cumsum(counts) - counts
    fans = np.where(keep, np.maximum(counts - 2, 0), 0)
    first = np.repeat(start, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return np.stack([indices[first], indices[first + step + 1], indices[first + step + 2]], axis=1)


def dependencies(asset: Path) -> tuple[list[Path], list[str]]:
    """Files that the USD file ``asset`` needs, itself included, and references that do not resolve."""
    from pxr import UsdUtils

    if asset.suffix == ".usdz":  # a package carries all it needs
        return [asset], []
    with reading(asset, "asset"):
        layers, assets, missing = UsdUtils.ComputeAllDependencies(str(asset))
        paths = [layer.realPath for layer in layers] + [str(path) for path in assets]
        return sorted({Path(path.split("[")[0]).resolve() for path in paths if path}), sorted(missing)


def beyond(files: Iterable[Path], *homes: Path) -> list[Path]:
    """Those of the ``files`` that lie in none of the folders ``homes``, links followed: whoever made an asset can have
    it name any file of this machine."""
    inside = [home.resolve() for home in homes]
    return [file for file in files if not any(file.resolve().is_relative_to(home) for home in inside)]


def _within(indices: Faces, count: int) -> bool:
    return not len(indices) or bool(indices.min() >= 0 and indices.max() < count)


def _last_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[-1].strip()[:300] if lines else type(error).__name__
