"""``latest.usda`` beside the versions of a delivery: a root layer that sublayers the newest."""

from __future__ import annotations

from pathlib import Path

from vehsim.runtime.files import write_file


def write_latest(version: Path, home: Path) -> None:
    """Point ``home/latest.usda`` to the stage of ``version``, and ``latest.<vehicle>.usda`` to each of its layers.

    Metadata that USD reads only from the root layer (units, up axis, time) is repeated.
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
    write_file(latest, layer.ExportToString())
