"""Many clips: sweeps expanded, exported by worker processes or a Dask cluster, resumed after anything.

`sweep.py` turns a shot file into its clips; `task.py` is one clip's work, the same wherever it runs; `inputs.py` names
what a clip is made of and tells finished work from half-written; `workers.py` and `cluster.py` run tasks; `summary.py`
says what happened; `screen.py` shows it while it does; `steps.py` and `job.py` cut the same work up for a render farm.
"""

from vehsim.batch.run import export_batch
from vehsim.batch.sweep import load_shots
from vehsim.batch.task import Outcome, Task

__all__ = ["Outcome", "Task", "export_batch", "load_shots"]
