"""The materials of a stage for a renderer: a colour, its opacity and a texture, for each part of a mesh."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Material:
    """A material: linear ``colour``, ``opacity``, ``roughness``, ``metallic``, a colour ``texture`` file or None;
    ``polish``: the roughness of its outermost layer, which is the clear coat of paint."""

    colour: tuple[float, float, float] = (0.5, 0.5, 0.5)
    opacity: float = 1.0
    roughness: float = 0.5
    metallic: float = 0.0
    emission: float = 0.0
    polish: float = 0.5
    texture: Path | None = None


def surfaces_of(prim: Any, count: int, time: float) -> Iterator[tuple[str, Ints, Material]]:
    """(name, faces, surface) for each material of a mesh: those of its subsets, then its own for the rest."""
    from pxr import UsdShade

    path = str(prim.GetPath())
    rest = np.ones(count, bool)
    for subset in UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets():
        chosen = np.array(subset.GetIndicesAttr().Get(time) or [], np.int64)
        rest[chosen] = False
        if len(chosen):
            yield f"{path}/{subset.GetPrim().GetName()}", chosen, read_surface(subset.GetPrim(), time)
    if rest.any():
        yield path, np.flatnonzero(rest), read_surface(prim, time)


def read_surface(prim: Any, time: float) -> Material:
    """The preview surface bound to a prim, else its display colour, else grey."""
    from pxr import UsdGeom, UsdShade

    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    shader = material.ComputeSurfaceSource()[0] if material else None
    if not shader:
        gprim = UsdGeom.Gprim(prim)
        rgb = gprim.GetDisplayColorAttr().Get(time) if gprim else None
        alpha = gprim.GetDisplayOpacityAttr().Get(time) if gprim else None
        colour = tuple(float(x) for x in rgb[0]) if rgb else (0.5, 0.5, 0.5)
        return Material(colour=colour, opacity=float(alpha[0]) if alpha else 1.0)  # type: ignore[arg-type]  # three floats

    def value(name: str, default: Any) -> Any:
        port = shader.GetInput(name)
        got = port.Get(time) if port else None
        return default if got is None else got

    emissive = value("emissiveColor", (0.0, 0.0, 0.0))
    colour = value("diffuseColor", (0.18, 0.18, 0.18))
    roughness = float(value("roughness", 0.5))
    coated = value("clearcoat", 0.0) >= 0.5
    return Material(
        colour=(float(colour[0]), float(colour[1]), float(colour[2])),
        opacity=float(value("opacity", 1.0)),
        roughness=roughness,
        metallic=float(value("metallic", 0.0)),
        emission=float(max(emissive)),
        polish=float(value("clearcoatRoughness", 0.01)) if coated else roughness,
        texture=_texture(shader),
    )


def _texture(shader: Any) -> Path | None:
    """The texture file of a surface's diffuse colour."""
    from pxr import UsdShade

    diffuse = shader.GetInput("diffuseColor")
    if not diffuse or not diffuse.HasConnectedSource():
        return None
    source = UsdShade.Shader(diffuse.GetConnectedSources()[0][0].source.GetPrim())
    if source.GetIdAttr().Get() != "UsdUVTexture":
        warnings.warn(f"{source.GetPath()}: only UsdUVTexture is drawn; this colour is omitted", stacklevel=4)
        return None
    file = source.GetInput("file").Get()
    if not file or not file.resolvedPath:
        warnings.warn(f"{source.GetPath()}: its texture does not resolve; drawn without it", stacklevel=4)
        return None
    return Path(file.resolvedPath)
