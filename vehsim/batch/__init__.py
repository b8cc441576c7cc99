"""Many clips: sweeps expanded, exported by worker processes or a Dask cluster, resumed after anything.

`sweep.py` turns a shot file into its clips; `task.py` is one clip's work, the same wherever it runs; `inputs.py` names
what a clip is made of and tells finished work from half-written; `workers.py` and `cluster.py` run tasks, `preload.py`
has what workers start with; `summary.py` says what happened; `screen.py` shows it while it does; `steps.py` and
`job.py` cut the same work up for a render farm.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehsim._lazy import attach

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
# at their first use: workers are started before anything heavy is loaded
__getattr__, __dir__ = attach(__name__, _PUBLIC)
