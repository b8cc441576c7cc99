"""``report.json``: the request, the results, versions, and a hash of every file that was written."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vehsim.delivery.take import Take
from vehsim.exporters.checks.audit import joints_in_rig, root_in_prim, stage_of, wheels_in_rig, with_stage
from vehsim.exporters.checks.review import review
from vehsim.exporters.usd.curves import count_keys
from vehsim.exporters.usd.exporter import LAYERS
from vehsim.runtime.code import PACKAGES, version


def write_report(take: Take, folder: Path, files: Sequence[Path]) -> Path:
    """Write ``folder/report.json`` about ``take`` and the ``files`` delivered; the same take gives the same bytes.

    Raises ``ExportError`` if the composed stage misses what the clips meet.
    """
    solved = dict(take.report)
    audit = solved.pop("audit", {})
    report = {
        "schema": 1,
        "shot": take.name,
        "fps": str(take.fps),
        "frames": list(take.frames),
        "terrain": take.world.terrain.name if take.world.terrain is not None else None,
        "wind": take.world.wind,
        "vehicles": {name: _clip_summary(clip, take.world) for name, clip in take.clips.items()},
        "cameras": {camera.name: {"lens_mm": _lenses(camera)} for camera in take.cameras},
        "solved": solved,
        "audit": audit,
        "versions": {name: version(name) for name in PACKAGES},
        "files": {path.relative_to(folder).as_posix(): sha256(path) for path in sorted(files)},
    }
    for name, clip in take.clips.items():
        if (layer := folder / "layers" / LAYERS["curves"].format(name)) in files:
            report["vehicles"][name]["curves"] = _keys(layer, clip.end_frame - clip.start_frame + 1)
    if audit and (stage := stage_of(folder, take.name)) is not None:
        for name, clip in take.clips.items():
            report["vehicles"][name]["T_rp"] = root_in_prim(clip)
            report["vehicles"][name]["joints"] = joints_in_rig(clip)
            report["vehicles"][name]["wheels"] = wheels_in_rig(clip)
            report["vehicles"][name]["motion"] = solved["vehicles"][name]["frames"]
        report = plain(report)
        report["audit"] = plain(with_stage(stage, report))
    else:
        report = plain(report)
    path = folder / "report.json"
    path.write_text(json.dumps(report, indent=1, sort_keys=True, allow_nan=False) + "\n", encoding="utf-8")
    return path


def _keys(layer: Path, frames: int) -> dict[str, Any]:
    """The number of keys of each curve, and the share of the samples that a key on every frame would need: of
    rotations that accumulate, and of the others."""
    from pxr import Sdf

    keys = count_keys(Sdf.Layer.FindOrOpen(str(layer)))
    spins = [count for path, count in keys.items() if path.endswith(":spin")]
    others = [count for path, count in keys.items() if not path.endswith(":spin")]
    shares = {"spins": spins, "others": others}
    return {
        "keys": keys,
        "share_of_samples": {kind: sum(some) / (frames * len(some)) for kind, some in shares.items() if some},
    }


def _lenses(camera: Any) -> float | list[float]:
    """The focal length, or all focal lengths of a cut, mm."""
    lenses: list[float] = np.unique(camera.lens_mm).tolist()
    return lenses[0] if len(lenses) == 1 else lenses


def _clip_summary(clip: Any, world: Any) -> dict[str, Any]:
    speeds = np.linalg.norm(clip.twists[:, -3:] if clip.twists.shape[1] == 6 else clip.twists[:, 1:], axis=1)
    return {
        "vehicle": clip.vehicle.name,
        **({"parameters": clip.vehicle.parameters} if clip.vehicle.parameters else {}),
        "frames": [clip.start_frame, clip.end_frame],
        "samples": len(clip.times),
        "duration_s": float(clip.times[-1] - clip.times[0]),
        "top_speed_m_s": float(speeds.max()),
        "events": list(clip.events),
        "energy_J": _ledger(clip.energy),
        "review": review(clip, world),
    }


def _ledger(energy: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """Each account of a clip's energy, J: its first, last, least and greatest value.

    ``imbalance`` is the change that the accounts do not explain: the integrator's error, O(h^2).
    """
    accounts = {name: np.asarray(values, float) for name, values in energy.items() if len(values)}
    if accounts.keys() >= {"kinetic", "potential", "work", "dissipated"}:
        total = accounts["kinetic"] + accounts["potential"] - accounts["work"] + accounts["dissipated"]
        accounts["imbalance"] = total - total[0]
    return {
        name: {"first": float(v[0]), "last": float(v[-1]), "least": float(v.min()), "most": float(v.max())}
        for name, v in accounts.items()
    }


def plain(value: Any) -> Any:
    """``value`` as JSON data: arrays as lists, paths as text, numbers that are not finite as None."""
    if value is None or type(value) in (bool, int, str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return value if isinstance(value, int | str) else str(value)


def sha256(path: Path) -> str:
    """The SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
