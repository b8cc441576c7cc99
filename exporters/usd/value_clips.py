"""Value clips: the samples of a long animation layer in several files, which USD opens only when they play."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np


def split_into_clips(path: Path, length: int) -> list[Path]:
    """Move the time samples of the layer ``path`` into value clips of at most ``length`` frames; returns their files.

    Neighbouring clips share the frame at which they meet, so that values between two samples do not change. A layer
    that fits into one clip stays unchanged.
    """
    from pxr import Sdf, Usd

    layer = Sdf.Layer.FindOrOpen(str(path))
    start, end = layer.startTimeCode, layer.endTimeCode
    sampled: list[Any] = []
    layer.Traverse(Sdf.Path.absoluteRootPath, lambda p: sampled.append(p) if layer.ListTimeSamplesForPath(p) else None)
    if end - start < length or not sampled:
        return []
    times = [time for attribute in sampled for time in layer.ListTimeSamplesForPath(attribute)]
    opens, closes = min(start, *times), max(end, *times)
    borders = [*np.arange(start, end - 1e-9, length).tolist(), end]
    files = []
    for first, last in pairwise([opens, *borders[1:-1], closes]):
        file = path.with_name(f"{path.name.removesuffix('.usdc')}.{round(max(first, start))}.usdc")
        clip = Sdf.Layer.CreateNew(str(file))
        _copy_metadata(layer, clip)
        clip.startTimeCode, clip.endTimeCode = first, last
        with Sdf.ChangeBlock():
            for attribute in sampled:
                _copy_samples(layer, clip, attribute, first, last)
        clip.Save()
        files.append(file)

    manifest = path.with_name(f"{path.name.removesuffix('.usdc')}.manifest.usda")
    generated = Usd.ClipsAPI.GenerateClipManifestFromLayers([Sdf.Layer.FindOrOpen(str(f)) for f in files], _root(layer))
    _copy_metadata(layer, generated)
    generated.Export(str(manifest))
    with Sdf.ChangeBlock():
        for attribute in sampled:
            for time in layer.ListTimeSamplesForPath(attribute):
                layer.EraseTimeSample(attribute, time)
    stage = Usd.Stage.Open(layer)
    api = Usd.ClipsAPI(stage.GetPrimAtPath(_root(layer)))
    api.SetClipAssetPaths([Sdf.AssetPath(f"./{file.name}") for file in files])
    api.SetClipPrimPath(str(_root(layer)))
    api.SetClipActive([(border, float(k)) for k, border in enumerate(borders[:-1])])
    api.SetClipTimes([(opens, opens), (closes, closes)])  # samples of an open shutter are outside start and end
    api.SetClipManifestAssetPath(Sdf.AssetPath(f"./{manifest.name}"))
    slim = Sdf.Layer.CreateAnonymous(".usdc")
    slim.TransferContent(layer)  # a crate file that is saved again would keep the space of removed data
    path.unlink()
    slim.Export(str(path))
    layer.Reload(force=True)
    return [*files, manifest]


def _root(layer: Any) -> Any:
    from pxr import Sdf

    return Sdf.Path.absoluteRootPath.AppendChild(layer.defaultPrim)


def _copy_metadata(source: Any, target: Any) -> None:
    target.defaultPrim = source.defaultPrim
    for key in ("metersPerUnit", "upAxis"):
        target.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
    target.timeCodesPerSecond, target.framesPerSecond = source.timeCodesPerSecond, source.framesPerSecond


def _copy_samples(source: Any, target: Any, path: Any, first: float, last: float) -> None:
    """The samples of an attribute that are necessary to read it from ``first`` to ``last``."""
    from pxr import Sdf

    times = np.array(source.ListTimeSamplesForPath(path))
    low = max(int(np.searchsorted(times, first, side="right")) - 1, 0)
    high = min(int(np.searchsorted(times, last, side="left")), len(times) - 1)
    prim = Sdf.CreatePrimInLayer(target, path.GetPrimPath())
    Sdf.AttributeSpec(prim, path.name, source.GetAttributeAtPath(path).typeName)
    for time in times[low : high + 1].tolist():
        target.SetTimeSample(path, time, source.QueryTimeSample(path, time))
