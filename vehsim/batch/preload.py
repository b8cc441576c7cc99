"""What workers start with: the process they are forked from imports this module, once for all of them.

Only `multiprocessing`'s fork server may import it: it changes how the process takes signals. Nothing is opened, solved
or drawn here, for a process with threads cannot be forked.
"""

from __future__ import annotations

import gc
import importlib
import signal

from vehsim.batch.workers import ENDING, die_with_parent

MODULES = (
    "numpy.ma",
    "platformdirs",
    "pxr.UsdLux",
    "pxr.UsdPhysics",
    "pxr.UsdShade",
    "pxr.UsdUtils",
    "vehsim.batch.inputs",
    "vehsim.exporters.ground",
    "vehsim.exporters.npz",
    "vehsim.exporters.usd",
    "vehsim.planning",
    "vehsim.shot",
    "vehsim.simulation",
    "vehsim.vehicles.helicopter",
    "vehsim.world.contact",
    "vehsim.world.wind",
    "PIL.PngImagePlugin",
)
"""What most clips need; the rest is imported by who meets it."""

for _number in ENDING:  # workers are told by the first process, and tidy up before they go
    signal.signal(_number, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
die_with_parent()
gc.disable()  # what modules make stays
for _name in MODULES:
    importlib.import_module(_name)
importlib.import_module("pxr.Work").SetConcurrencyLimit(1)  # stages are small: more threads would turn while they wait
importlib.import_module("vehsim.batch.inputs").code()  # read and hashed once for all
importlib.import_module("vehsim.delivery").exporter_names()  # what is installed is looked through as well
gc.freeze()  # no worker need look through it, or copy it by looking
gc.enable()
