"""Many clips: expand sweeps, export with worker processes or a Dask cluster, resume after any interruption.

`sweep.py` turns a shot file into its clips; `task.py` is one clip's work, the same everywhere; `inputs.py` hashes what
a clip is made of and recognises finished work; `workers.py` and `cluster.py` run tasks; `preload.py` is loaded by the
process from which workers are forked; `summary.py` records the outcomes; `screen.py` shows the progress; `steps.py` and
`job.py` divide the same work for a render farm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim.runtime.lazy import attach

_PUBLIC = {
    "Outcome": "vehsim.batch.task",
    "Task": "vehsim.batch.task",
    "export_batch": "vehsim.batch.run",
    "load_shots": "vehsim.batch.sweep",
}
__all__ = ["Outcome", "Task", "export_batch", "load_shots"]

if TYPE_CHECKING:
    from vehsim.batch.run import export_batch as export_batch
    from vehsim.batch.sweep import load_shots as load_shots
    from vehsim.batch.task import Outcome as Outcome
    from vehsim.batch.task import Task as Task
# Loaded at first use: workers are started before anything heavy is loaded.
__getattr__, __dir__ = attach(__name__, _PUBLIC)
