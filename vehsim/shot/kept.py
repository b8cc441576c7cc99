"""Solved motion, kept by content: after a change of cameras, pictures or exports alone, nothing is solved again.

The key covers everything that decides motion: vehicles with their files, world, marks, frame rate and frames, the code
and the libraries below it. Motion that depends on the machine (`time_limit`) or on laws that a script added to vehsim
is not kept, and a failure never is. What was just solved is read back from the bytes that are kept: both are the same.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Mapping
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import numpy as np

from vehsim._cache import keep, packed, recalled, shrink, unpacked
from vehsim._code import code
from vehsim.errors import InputError
from vehsim.shot.inputs import content_of, motion_files

if TYPE_CHECKING:
    from vehsim.clip import Clip
    from vehsim.shot.shot import Shot

Motion = tuple[dict[str, "Clip"], dict[str, Any]]
"""Clips and reports by vehicle, as `Shot.solve` goes on with them."""
KIND = "motion"
FROM_CACHE = "motion from the cache"
"""What progress says of it."""
MOST = "VEHSIM_CACHE_GB"
"""The environment variable that says how much motion is kept, GB."""
DEFAULT = 2.0
REGISTRIES = {
    "vehsim.planning.terms": ("COSTS", "LIMITS"),
    "vehsim.pilots": ("PILOTS",),
    "vehsim.vehicles.library": ("MODELS",),
}
"""Where a script may add laws of its own, which `code` does not cover."""


def recalled_or(solve: Callable[[], Motion], shot: Shot) -> tuple[Motion, bool]:
    """The motion of ``shot`` as it was kept, or else of ``solve``; and whether it was kept. Warnings are repeated."""
    most = _most()
    key = _key(shot) if most > 0 else None
    if key is None:
        return solve(), False
    content = found = recalled(KIND, key)
    if content is None:
        content = keep(KIND, key, _solved(solve))
        shrink(KIND, most)
    motion, said = _unpacked(content, shot)
    for text in said:
        warnings.warn(text, stacklevel=4)
    return motion, found is not None


def _most() -> int:
    """Bytes of motion to keep."""
    given = os.environ.get(MOST) or DEFAULT
    try:
        return int(float(given) * 1e9)
    except (ValueError, OverflowError):
        raise InputError(f"{MOST} = {given!r}: not a number; give GB, 0 to keep no motion") from None


def _key(shot: Shot) -> str | None:
    """A hash of everything that decides the motion; None where it should not be kept."""
    motions = [table.motion for table in shot.file.vehicle]
    if all(motion.method == "clip" for motion in motions):  # loading is no work
        return None
    if any(getattr(motion, "time_limit", None) is not None for motion in motions) or _extended():
        return None
    asked = shot.file.model_dump(mode="json", by_alias=True, include={"shot", "world", "vehicle"})
    del asked["shot"]["name"]
    files = [content_of(path) for path in motion_files(shot)]
    made_of = {"code": code(), "asked": asked, "files": files, "world": shot.world.content_hash}
    return sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def _extended() -> bool:
    """Has a script added costs, limits, pilots or models of its own?"""
    for module, names in REGISTRIES.items():
        for name in names:
            registry: Mapping[str, Any] = getattr(sys.modules.get(module), name, {})
            if not all(_module(entry).partition(".")[0] == "vehsim" for entry in registry.values()):
                return True
    return False


def _module(entry: Any) -> str:
    return entry if isinstance(entry, str) else str(getattr(getattr(entry, "law", entry), "__module__", ""))


def _solved(solve: Callable[[], Motion]) -> bytes:
    """Motion and warnings of ``solve`` as bytes. What it raises is passed on, after its warnings."""
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            clips, reports = solve()
    except BaseException:
        _issue(caught)
        raise
    said = [w for w in caught if issubclass(w.category, UserWarning)]
    _issue([w for w in caught if w not in said])  # of libraries, on this occasion
    header = {"clips": list(clips), "reports": reports, "warnings": [str(w.message) for w in said]}
    parts = [json.dumps(header, default=_plain).encode(), *(clip.to_bytes() for clip in clips.values())]
    return packed([np.frombuffer(part, np.uint8) for part in parts])


def _issue(caught: list[warnings.WarningMessage]) -> None:
    for w in caught:
        warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)


def _unpacked(content: bytes, shot: Shot) -> tuple[Motion, list[str]]:
    from vehsim.clip import Clip

    header, *clips = (part.tobytes() for part in unpacked(content))
    about = json.loads(header)
    vehicles = {table.name: shot.vehicle(table) for table in shot.file.vehicle}
    found = zip(about["clips"], clips, strict=True)
    motion = {name: Clip.from_bytes(clip, vehicles[name]) for name, clip in found}
    return (motion, about["reports"]), about["warnings"]


def _plain(value: Any) -> Any:
    """Numpy's numbers and arrays as JSON knows them."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} in a report of motion")
