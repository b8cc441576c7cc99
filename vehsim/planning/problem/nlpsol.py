"""CasADi's NLP solvers, with results that do not depend on the number of processors."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca

SETTERS = ("openblas_set_num_threads", "MKL_Set_Num_Threads")
"""Functions of BLAS libraries that set their number of threads."""


def nlpsol(name: str, plugin: str, nlp: Any, options: dict[str, Any]) -> ca.Function:
    """``casadi.nlpsol`` with single-threaded linear algebra, which fixes the order of rounding.

    Otherwise an ill-conditioned problem can have another solution on another number of processors.
    """
    _one_thread()
    return ca.nlpsol(name, plugin, nlp, options)


@cache
def _one_thread() -> None:
    """Set the BLAS library that IPOPT uses to one thread, for the rest of the process.

    In CasADi's wheel only CasADi uses this library. Environment variables do not suffice: a BLAS library reads them
    once, and a script may have loaded CasADi before vehsim.
    """
    folder = Path(ca.GlobalOptions.getCasadiPath())
    plugins = [folder / f"libcasadi_nlpsol_ipopt.{suffix}" for suffix in ("so", "dylib")]
    # on Windows a library's symbols do not include those of its dependencies
    windows = folder / "libcasadi-tp-openblas.dll"
    for path in (*plugins, windows):
        if path.is_file():
            library = ctypes.CDLL(str(path))
            for setter in SETTERS:
                if hasattr(library, setter):
                    getattr(library, setter)(1)
