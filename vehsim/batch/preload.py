"""Modules for workers: the process from which they are forked imports this module once.

Only `multiprocessing`'s fork server may import it, because it changes the handling of signals. It opens, solves and
draws nothing, because a process with threads cannot be forked.
"""

from __future__ import annotations

import gc
import importlib
import signal

from vehsim.runtime.processes import ENDING, die_with_parent

MODULES = (
    "numpy.ma",
    "platformdirs",
    "pxr.UsdLux",
    "pxr.UsdPhysics",
    "pxr.UsdShade",
    "pxr.UsdUtils",
    "vehsim.batch.inputs",
    "vehsim.exporters.usd.scenery.ground",
    "vehsim.exporters.tables.npz",
    "vehsim.exporters.usd",
    "vehsim.planning",
    "vehsim.shot",
    "vehsim.simulation",
    "vehsim.vehicles.models.helicopter",
    "vehsim.world.contact",
    "vehsim.world.wind",
    "PIL.PngImagePlugin",
)
"""Modules that most clips need; the others are imported on demand."""

for _number in ENDING:  # the first process tells the workers, which clean up before they exit
    signal.signal(_number, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
die_with_parent()
gc.disable()  # objects of loaded modules are permanent
for _name in MODULES:
    importlib.import_module(_name)
importlib.import_module("pxr.Work").SetConcurrencyLimit(1)  # stages are small: more threads would only wait
importlib.import_module("vehsim.batch.inputs").code()  # read and hash the code once for all workers
importlib.import_module("vehsim.delivery").exporter_names()  # also look through the installed packages once
gc.freeze()  # exclude these objects from garbage collection, which would copy their memory pages in each worker
gc.enable()
