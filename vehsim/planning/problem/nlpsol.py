"""CasADi's solvers of nonlinear programs, whose answers must not depend on the number of processors."""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca

SETTERS = ("openblas_set_num_threads", "MKL_Set_Num_Threads")
"""Functions of BLAS libraries that set their number of threads."""


def nlpsol(name: str, plugin: str, nlp: Any, options: dict[str, Any]) -> ca.Function:
    """``casadi.nlpsol``, with linear algebra on one thread: rounding then has one order.

    An ill-conditioned problem otherwise has another answer on another number of processors.
    """
    _one_thread()
    return ca.nlpsol(name, plugin, nlp, options)


@cache
def _one_thread() -> None:
    """Set the BLAS below IPOPT to one thread, for the rest of the process: in CasADi's wheel it serves CasADi alone.

    Environment variables do not suffice: a BLAS reads them once, and a script may have loaded CasADi before vehsim.
    """
    folder = Path(ca.GlobalOptions.getCasadiPath())
    plugins = [folder / f"libcasadi_nlpsol_ipopt.{suffix}" for suffix in ("so", "dylib")]
    windows = folder / "libcasadi-tp-openblas.dll"  # where a library's symbols do not include those of its dependencies
    for path in (*plugins, windows):
        if path.is_file():
            library = ctypes.CDLL(str(path))
            for setter in SETTERS:
                if hasattr(library, setter):
                    getattr(library, setter)(1)
