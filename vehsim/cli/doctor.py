"""Check this machine, from Python to the cache. Only the standard library is imported at the top.

``tools/setup.sh`` calls ``python -m vehsim.cli.doctor --egl``, whose exit code tells whether pictures can be rendered.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import platform
import sys
from dataclasses import dataclass

LIBRARIES = ("mujoco", "casadi", "numpy", "scipy", "trimesh", "libigl", "python-fcl", "pydantic", "pillow", "av")


@dataclass(frozen=True)
class Check:
    """One line of the report: what was checked, whether it is good, what was found, and how to fix it."""

    what: str
    good: bool
    found: str
    remedy: str = ""


def egl_devices() -> int:
    """Number of devices on which EGL can render without a screen; Mesa's software renderer counts as one."""
    try:
        ctypes.CDLL("libGL.so.1")  # MuJoCo renders through PyOpenGL, which loads this library in addition to EGL.
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


def _python() -> Check:
    return Check("Python", sys.version_info >= (3, 11), platform.python_version(), "use Python 3.11 or newer")


def _library(name: str) -> Check:
    try:
        return Check(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Check(name, False, "not installed", f"pip install {name}")


def _usd() -> Check:
    """USD from PyPI or from the host application that runs this interpreter."""
    try:
        from pxr import Usd
    except ImportError as error:
        return Check("USD", False, str(error), "pip install usd-core")
    version, oldest = Usd.GetVersion()[1:], (24, 3)
    text = f"{version[0]}.{version[1]}"
    return Check("USD", version >= oldest, text, f"use USD {oldest[0]}.{oldest[1]} or newer")


def _machine_code() -> Check:
    """Good without it, too: the interpreter gives the same results."""
    import casadi

    from vehsim.runtime.machine_code import MachineCode

    x = casadi.SX.sym("x")
    try:
        MachineCode(casadi.Function("square", [x], [x * x]))
        return Check("machine code", True, f"llvmlite {importlib.metadata.version('llvmlite')}")
    except (ImportError, OSError, RuntimeError) as error:
        return Check("machine code", True, f"none, so that plans and simulations take longer ({error})")


def _egl() -> Check:
    if sys.platform != "linux":
        return Check("OpenGL", True, "MuJoCo's own for this system; pictures are tested on Linux with EGL")
    count = egl_devices()
    remedy = "sudo apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri"
    return Check("EGL", count > 0, f"{count} device(s)" if count else "no device", remedy)


def _codec() -> Check:
    remedy = "pip install --force-reinstall av"
    try:
        import av

        codec = av.Codec("libx264", "w")
    except Exception as error:  # A broken PyAV build may raise anything: report it, never crash.
        return Check("H.264", False, f"no libx264 encoder ({error})", remedy)
    return Check("H.264", True, codec.long_name)


def _cache() -> Check:
    from vehsim.runtime.cache import cache_folder

    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".doctor"
        probe.touch()
        probe.unlink()
    except OSError as error:
        return Check("cache", False, str(error), "set VEHSIM_CACHE to a writable folder")
    return Check("cache", True, str(folder))


def examine() -> list[Check]:
    """Check everything that vehsim needs."""
    return [_python(), *map(_library, LIBRARIES), _usd(), _machine_code(), _egl(), _codec(), _cache()]


if __name__ == "__main__":
    if sys.argv[1:] == ["--egl"]:
        sys.exit(0 if egl_devices() else 1)
    for finding in examine():
        print(f"{'ok ' if finding.good else 'BAD'}  {finding.what}: {finding.found}")
