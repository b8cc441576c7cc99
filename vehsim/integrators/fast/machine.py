"""CasADi functions as machine code: CasADi writes C, the system's compiler builds it, the cache keeps it by content.

The default is off: another compiler may round the last bit differently, and a film must be the same on every machine.
Without a compiler there is a warning, and CasADi's interpreter is used. The built files are safe to delete and safe
under concurrent writers: every process builds a separate file and renames it into place.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import warnings
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from stat import S_ISDIR, S_ISREG, S_ISVTX, S_IWGRP, S_IWOTH
from typing import Any

import casadi as ca

from vehsim.runtime.cache import cache_folder
from vehsim.runtime.files import replacing_file

FLAGS = ("-O2", "-fPIC", "-shared", "-ffp-contract=off", *(("-Wl,-Bsymbolic",) if sys.platform == "linux" else ()))
"""No option that reorders arithmetic. ``-Bsymbolic``: glibc also has a function called ``step``."""

_PLACEHOLDER = "vehsim_function_"

_LOOP = """
/* m rows of n rows: every pointer moves by its own strides, in doubles; of null pointers CasADi makes zeros */
void vehsim_loop(long long m, long long n, const double** in, const long long* over, const long long* along,
                 double** out, const long long* out_over, const long long* out_along) {{
  const double* arg[{arg}]; double* res[{res}]; casadi_int iw[{iw}]; double w[{w}];
  for (long long j = 0; j < m; ++j)
    for (long long k = 0; k < n; ++k) {{
      for (int i = 0; i < {n_in}; ++i) arg[i] = in[i] ? in[i] + j * over[i] + k * along[i] : 0;
      for (int i = 0; i < {n_out}; ++i) res[i] = out[i] ? out[i] + j * out_over[i] + k * out_along[i] : 0;
      {name}(arg, res, iw, w, 0);
    }}
}}
"""


def compiler() -> list[str] | None:
    """The command of the system's C compiler (``CC``, or else cc, gcc or clang), None if there is none."""
    for command in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        words = shlex.split(command)
        if words and shutil.which(words[0]):
            return words
    return None


@dataclass(frozen=True)
class Built:
    """A function's library, and the function's name in it."""

    library: Path
    name: str

    def function(self) -> ca.Function:
        """The same function as machine code."""
        return ca.external(self.name, str(self.library))

    @cached_property
    def loop(self) -> Any:
        """``vehsim_loop`` of the function (its C stands above), which releases Python's lock."""
        return ctypes.CDLL(str(self.library)).vehsim_loop


def build(function: ca.Function) -> Built | None:
    """A function as machine code; None, with a warning, without a compiler or where it cannot be trusted."""
    command = compiler()
    if command is None:
        _warn_once("no C compiler: set CC, or install one; continuing with CasADi's interpreter, which is slower")
        return None
    source, name = _source(function, " ".join(command))
    library = cache_folder() / "machine-code" / f"{name}.so"
    # who can rename a folder can put another in its place; many systems let a private group write new folders
    for folder, who in ((cache_folder().resolve(), S_IWOTH), (library.parent, S_IWGRP | S_IWOTH)):
        if not _is_ours(folder, who):
            remedy = f"chmod go-w {folder}, remove it, or give another VEHSIM_CACHE"
            _warn_once(f"other users can write to {folder}: no code in it is run; {remedy}; continuing without it")
            return None
    if not (library.is_file() and _is_ours(library) and _loads(library)):
        try:
            _compile(source, library, command)
        except (OSError, subprocess.SubprocessError) as error:
            words = getattr(error, "stderr", None) or str(error)
            _warn_once(f"{command[0]} cannot build here ({words.strip()[:300]}); continuing with CasADi's interpreter")
            return None
    return Built(library, name)


def _is_ours(path: Path, who: int = S_IWGRP | S_IWOTH) -> bool:
    """Check that only this user or the system can write the file, by the bits ``who``; a folder that does not exist
    yet is ours.

    Links are not followed, because their target could change at any time.
    """
    if not hasattr(os, "getuid"):  # on platforms whose cache folder is private to the user
        return True
    try:
        stat = path.lstat()
    except FileNotFoundError:
        return True
    plain = S_ISDIR(stat.st_mode) or S_ISREG(stat.st_mode)
    sticky = S_ISDIR(stat.st_mode) and stat.st_mode & S_ISVTX  # such as /tmp: others can neither rename nor delete ours
    return plain and stat.st_uid in (os.getuid(), 0) and bool(sticky or not stat.st_mode & who)


def _source(function: ca.Function, command: str) -> tuple[str, str]:
    """C of a function and of its loop, and a name made from everything that the machine code depends on."""
    symbols: Any = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    renamed = ca.Function(_PLACEHOLDER, symbols, ca.cse(function.call(symbols)))
    with tempfile.TemporaryDirectory() as folder:
        generator = ca.CodeGenerator(f"{_PLACEHOLDER}.c")
        generator.add(renamed)
        generator.generate(f"{folder}/")
        text = Path(folder, f"{_PLACEHOLDER}.c").read_text(encoding="utf-8")
    sizes = {"arg": renamed.sz_arg(), "res": renamed.sz_res(), "iw": renamed.sz_iw(), "w": renamed.sz_w()}
    counts = {"n_in": renamed.n_in(), "n_out": renamed.n_out(), "name": _PLACEHOLDER}
    text += _LOOP.format(**{k: v + 1 for k, v in sizes.items()}, **counts)
    machine = (platform.system(), platform.machine(), command, FLAGS)
    name = f"vehsim_{hashlib.sha256(repr((text, machine)).encode()).hexdigest()[:24]}"
    return text.replace(_PLACEHOLDER, name), name


def _compile(source: str, library: Path, command: list[str]) -> None:
    library.parent.parent.mkdir(parents=True, exist_ok=True)
    library.parent.mkdir(mode=0o700, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=library.parent) as folder, replacing_file(library) as made:
        file = Path(folder, "function.c")
        file.write_text(source, encoding="utf-8")
        subprocess.run(
            [*command, *FLAGS, str(file), "-o", str(made), "-lm"],
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
        )
        made.chmod(0o700)  # independent of the umask: code that others can write is not run


def _loads(library: Path) -> bool:
    try:
        return bool(ctypes.CDLL(str(library)).vehsim_loop)
    except (OSError, AttributeError):  # truncated, or from another machine
        return False


@cache
def _warn_once(message: str) -> None:
    warnings.warn(f"machine code: {message}", stacklevel=2)
