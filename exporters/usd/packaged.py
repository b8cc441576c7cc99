"""The shot as one file: ``usdz``, a package with all dependencies, and ``flat``, one layer without composition arcs.

Both are made from the stage that the usd exporter wrote and checked.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from vehsim.delivery.exporters import Exporter
from vehsim.delivery.take import Take
from vehsim.errors import ExportError
from vehsim.intake.usd import SUFFIXES, references
from vehsim.runtime.progress import Progress


def write_usdz(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """``<shot>.usdz``: the stage, its layers, assets and textures in one uncompressed package."""
    from pxr import UsdUtils

    progress("usdz: packing", 0.0)
    path = folder / f"{take.name}.usdz"
    if not UsdUtils.CreateNewUsdzPackage(str(_stage(take, folder)), str(path)):
        raise ExportError("could not be packed", "see the messages of USD above", file=path.name)
    return [path]


def write_flat(take: Take, folder: Path, progress: Progress) -> Sequence[Path]:
    """``<shot>.flat.usdc``, the textures that it refers to, and the water's layer, its payload as in the stage: points
    that move are nearly all bytes of a delivery."""
    from pxr import Sdf, Usd, UsdUtils

    progress("flat: flattening", 0.0)
    path = folder / f"{take.name}.flat.usdc"
    water, place = folder.resolve() / "layers" / "water.usdc", f"/{take.name}/env/water"
    loaded = Usd.StageLoadRules.LoadAll()
    loaded.Unload(place)
    stage = Usd.Stage.Open(str(_stage(take, folder)), Usd.Stage.LoadNone)
    stage.SetLoadRules(loaded)
    layer = stage.Flatten(addSourceFileComment=False)
    needed = set(references(water)[1]) if water.is_file() else set()

    def relative(found: str) -> str:
        file = Path(found)
        if not file.is_absolute() or not file.is_relative_to(folder.resolve()):
            return found
        if file.suffix in SUFFIXES:
            return ""  # it names the source of a prim, which does not exist any more
        needed.add(file)
        return f"./{Path(os.path.relpath(file, folder.resolve())).as_posix()}"

    UsdUtils.ModifyAssetPaths(layer, relative)
    if water in needed:
        layer.GetPrimAtPath(place).payloadList.prependedItems = [Sdf.Payload("./layers/water.usdc")]
    layer.Export(str(path))
    return [path, *sorted(needed)]


def _stage(take: Take, folder: Path) -> Path:
    path = folder / f"{take.name}.usda"
    if not path.is_file():
        raise ExportError("there is no shot stage to make one file of", "leave out export.layer_only", file=path.name)
    return path


usdz = Exporter(
    name="usdz", suffixes=(".usdz",), write=write_usdz, needs=("usd",), makes="the stage and its files in one package"
)
flat = Exporter(name="flat", suffixes=(), write=write_flat, needs=("usd",), makes="the stage as one flat layer")
