"""The material of scenery with a picture: `UsdPreviewSurface` whose colour is a texture at the primvar ``st``."""

from __future__ import annotations

from typing import Any


def author_textured(stage: Any, path: str, texture: str, image: str, wrap: str = "repeat") -> tuple[Any, Any, Any]:
    """Author a material at ``path`` with the sRGB ``texture``, a path relative to the layer, read by the shader
    ``image``; returns the material, that shader, and the surface."""
    from pxr import Sdf, UsdShade

    types = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, path)
    reader, picture, surface = (UsdShade.Shader.Define(stage, f"{path}/{name}") for name in ("st", image, "surface"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(texture))
    picture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        picture.CreateInput(side, types.Token).Set(wrap)
    picture.CreateInput("st", types.Float2).ConnectToSource(reader.CreateOutput("result", types.Float2))
    surface.CreateIdAttr("UsdPreviewSurface")
    diffuse = surface.CreateInput("diffuseColor", types.Color3f)
    diffuse.ConnectToSource(picture.CreateOutput("rgb", types.Float3))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    return material, picture, surface
