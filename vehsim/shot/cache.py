"""The caches of solved motion and of cameras, by content: after a change of only pictures or exports, nothing is solved
again; after one of cameras, they are.

The key covers everything that determines the motion: vehicles with their files, world, marks, frame rate and frames,
the code and its libraries. Motion that depends on the machine (`time_limit`) or on laws that a script added to vehsim
is not cached, nor are failures. Newly solved motion is read back from the cached bytes, so both are equal.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from vehsim.errors import InputError
from vehsim.runtime.cache import content_of, kept, lookup, packed, store, unpacked
from vehsim.runtime.code import code
from vehsim.runtime.registry import Registry

if TYPE_CHECKING:
    from vehsim.cameras.camera import Camera, CameraRig
    from vehsim.clip.clip import Clip
    from vehsim.shot.schema.shot_file import ShotFile
    from vehsim.vehicles import Vehicle

T = TypeVar("T")
SolvedMotion = tuple[dict[str, "Clip"], dict[str, Any]]
"""Clips and reports by vehicle, for `Shot.solve`."""
KIND = "motion"
FROM_CACHE = "motion from the cache"
"""Its progress message."""
MOST = "VEHSIM_CACHE_GB"
"""The environment variable for the size of the cached motion, GB."""
DEFAULT = 2.0
REGISTRIES = {
    "vehsim.planning.terms": ("COSTS", "LIMITS"),
    "vehsim.pilots.controllers": ("PILOTS",),
    "vehsim.vehicles.library.library": ("MODELS",),
}
"""Tables to which a script may add its own laws, which `code` does not cover."""


def recalled_or(
    solve: Callable[[], SolvedMotion], key: str | None, vehicles: Mapping[str, Vehicle]
) -> tuple[SolvedMotion, bool]:
    """The motion of ``vehicles`` cached under ``key``, or that of ``solve``; and whether it was cached.

    Warnings are repeated. A ``key`` of None disables the cache.
    """
    most = _most()
    if key is None or most <= 0:
        return solve(), False
    content = found = lookup(KIND, key)
    if content is None:
        content = store(KIND, key, _solved(solve), most)
    motion, texts = _unpacked(content, vehicles)
    for text in texts:
        warnings.warn(text, stacklevel=4)
    return motion, found is not None


def _most() -> int:
    """Largest size of cached motion, bytes."""
    given = os.environ.get(MOST) or DEFAULT
    try:
        return int(float(given) * 1e9)
    except (ValueError, OverflowError):
        raise InputError("not a number", "give a number of GB; 0 disables the cache", key=MOST, value=given) from None


def motion_key(file: ShotFile, files: Iterable[Path], world: str) -> str | None:
    """A hash of everything that determines the motion; None if it should not be cached.

    ``files``: those that it is made of, in addition to the shot file; ``world``: the hash of the world.
    """
    motions = [table.motion for table in file.vehicle]
    if all(motion.method == "clip" for motion in motions):  # loading is no work
        return None
    if any(getattr(motion, "time_limit", None) is not None for motion in motions) or _extended():
        return None
    request = file.model_dump(mode="json", by_alias=True, include={"shot", "world", "vehicle"})
    del request["shot"]["name"]
    for obstacle in request["world"]["obstacle"]:
        for look in ("finish", "colour"):
            obstacle.pop(look, None)
    contents = [content_of(path) for path in files]
    made_of = {"code": code(), "request": request, "files": contents, "world": world}
    return sha256(json.dumps(made_of, sort_keys=True).encode()).hexdigest()


def _extended() -> bool:
    """Whether a script has added its own costs, limits, pilots or models."""
    for module, names in REGISTRIES.items():
        for name in names:
            registry: Registry[Any] | None = getattr(sys.modules.get(module), name, None)
            if registry is not None and registry.has_additions:
                return True
    return False


def _solved(solve: Callable[[], SolvedMotion]) -> bytes:
    """Motion and warnings of ``solve`` as bytes. Its exception is passed on, after its warnings."""
    (clips, reports), texts = _with_warnings(solve)
    header = {"clips": list(clips), "reports": reports, "warnings": texts}
    parts = [json.dumps(header, default=_plain).encode(), *(clip.to_bytes(ending=True) for clip in clips.values())]
    return packed([np.frombuffer(part, np.uint8) for part in parts])


def filmed(
    rigs: Iterable[CameraRig], solve: Callable[[CameraRig], Camera], key: str | None, shown: Mapping[str, Any]
) -> list[Camera]:
    """The camera of each rig, cached under what else determines it: a ``key``, where None disables the cache, and by
    name what a film has ``shown`` of it. Warnings are repeated."""
    return [solve(rig) if key is None else _filmed(rig, solve, f"{key} {shown[rig.name]}") for rig in rigs]


def _filmed(rig: CameraRig, solve: Callable[[CameraRig], Camera], key: str) -> Camera:
    from vehsim.cameras.camera import Camera

    def made() -> bytes:
        camera, texts = _with_warnings(lambda: solve(rig))
        about = {"aperture_mm": camera.aperture_mm, "lens_mm": camera.lens_mm, "warnings": texts}
        parts = np.frombuffer(json.dumps(about).encode(), np.uint8), camera.frames, camera.positions
        return packed([*parts, camera.orientations])

    header, frames, positions, orientations = unpacked(kept("camera", (key, rig), made))
    about = json.loads(header.tobytes())
    for text in about["warnings"]:
        warnings.warn(text, stacklevel=5)
    return Camera(rig.name, frames, positions, orientations, about["lens_mm"], tuple(about["aperture_mm"]))


def _with_warnings(make: Callable[[], T]) -> tuple[T, list[str]]:
    """The result of ``make`` and vehsim's own warnings; others are passed on, all of them if it raises an exception."""
    caught: list[warnings.WarningMessage] = []
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            made = make()
    except BaseException:
        _issue(caught)
        raise
    ours = [w for w in caught if issubclass(w.category, UserWarning)]
    _issue([w for w in caught if w not in ours])  # a library's warning on this occasion
    return made, [str(w.message) for w in ours]


def _issue(caught: list[warnings.WarningMessage]) -> None:
    for w in caught:
        warnings.warn_explicit(w.message, w.category, w.filename, w.lineno)


def _unpacked(content: bytes, vehicles: Mapping[str, Vehicle]) -> tuple[SolvedMotion, list[str]]:
    from vehsim.clip.clip import Clip

    header, *clips = (part.tobytes() for part in unpacked(content))
    about = json.loads(header)
    found = zip(about["clips"], clips, strict=True)
    motion = {name: Clip.from_bytes(clip, vehicles[name]) for name, clip in found}
    return (motion, about["reports"]), about["warnings"]


def _plain(value: Any) -> Any:
    """Numpy's numbers and arrays as JSON data."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} in a report of motion")
