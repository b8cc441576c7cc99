"""``latest.usda`` beside versions of a delivery: a root layer that sublayers the newest."""

from __future__ import annotations

from pathlib import Path

from vehsim.delivery import owner


def write_latest(version: Path, home: Path) -> None:
    """Point ``home/latest.usda`` at the stage of ``version``, and ``latest.<vehicle>.usda`` at each of its layers.

    What USD reads only from the root layer (units, up axis, time) is repeated.
    """
    shots = [path for path in version.glob("*.usda") if path.stem == home.name]
    for path in shots:
        _sublayer(home / "latest.usda", path)
    for path in sorted((version / "layers").glob("*.anim.usdc")):
        _sublayer(home / f"latest.{path.name.removesuffix('.anim.usdc')}.usda", path)


def _sublayer(latest: Path, newest: Path) -> None:
    from pxr import Sdf

    source = Sdf.Layer.OpenAsAnonymous(str(newest))
    layer = Sdf.Layer.CreateAnonymous(".usda")
    for key in source.pseudoRoot.ListInfoKeys():
        if key in (
            "metersPerUnit",
            "upAxis",
            "defaultPrim",
            "timeCodesPerSecond",
            "framesPerSecond",
            "customLayerData",
        ):
            layer.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
    layer.startTimeCode, layer.endTimeCode = source.startTimeCode, source.endTimeCode
    layer.subLayerPaths.append(f"./{newest.relative_to(latest.parent).as_posix()}")
    beside = latest.with_name(f".{latest.name}.{owner()}.partial")
    beside.write_text(layer.ExportToString(), encoding="utf-8")
    beside.replace(latest)
