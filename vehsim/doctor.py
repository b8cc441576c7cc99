"""What this machine offers: Python, libraries, EGL, the film's codec, the cache. Standard library only at the top.

``python -m vehsim.doctor --egl`` tells ``tools/setup.sh`` by its exit code whether pictures can be rendered.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import platform
import sys
from dataclasses import dataclass

LIBRARIES = ("mujoco", "casadi", "numpy", "scipy", "usd-core", "trimesh", "libigl", "pydantic", "pillow", "av")


@dataclass(frozen=True)
class Finding:
    """One line of the report: ``what`` was looked at, whether it is ``good``, what was found, and how to mend it."""

    what: str
    good: bool
    found: str
    mend: str = ""


def egl_devices() -> int:
    """How many devices EGL can render on without a screen (Mesa's software renderer counts as one)."""
    try:
        ctypes.CDLL("libGL.so.1")  # PyOpenGL, which MuJoCo renders through, loads it beside EGL
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return 0
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    if not address:
        return 0
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(ctypes.c_int))(address)
    count = ctypes.c_int(0)
    return count.value if query(0, None, ctypes.byref(count)) else 0


def _python() -> Finding:
    return Finding("Python", sys.version_info >= (3, 11), platform.python_version(), "use Python 3.11 or newer")


def _library(name: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "not installed", f"pip install {name}")


def _egl() -> Finding:
    count = egl_devices()
    mend = "sudo apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri"
    return Finding("EGL", count > 0, f"{count} device(s)" if count else "no device", mend)


def _codec() -> Finding:
    mend = "pip install --force-reinstall av"
    try:
        import av

        codec = av.Codec("libx264", "w")
    except Exception as error:  # a broken build of PyAV fails in ways of its own: report, never crash
        return Finding("H.264", False, f"no libx264 encoder ({error})", mend)
    return Finding("H.264", True, codec.long_name)


def _cache() -> Finding:
    from vehsim.world import cache_folder

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".doctor"
        probe.touch()
        probe.unlink()
    except OSError as error:
        return Finding("cache", False, str(error), "set VEHSIM_CACHE to a folder you may write to")
    return Finding("cache", True, str(folder))


def examine() -> list[Finding]:
    """Look at everything vehsim stands on."""
    return [_python(), *map(_library, LIBRARIES), _egl(), _codec(), _cache()]


if __name__ == "__main__":
    if sys.argv[1:] == ["--egl"]:
        sys.exit(0 if egl_devices() else 1)
    for finding in examine():
        print(f"{'ok ' if finding.good else 'BAD'}  {finding.what}: {finding.found}")
