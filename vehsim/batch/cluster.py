"""The same tasks on a Dask cluster: its scheduler places them, and restarts the clips of lost workers.

Every worker must see the output folder and the shots' files under the same paths, and have the same version of vehsim:
a worker that computes a different hash for a clip refuses it.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterator, Sequence
from typing import Any

from vehsim.batch.task import Outcome, Task, Tell, measure, run_task
from vehsim.delivery.folders import clean_up
from vehsim.errors import InputError

LOCAL = "local"
TOPIC = "vehsim"


def run_on_dask(tasks: Sequence[Task], address: str, count: int, tell: Tell) -> Iterator[Outcome]:
    """The outcomes of ``tasks``, each as soon as it is available. ``address`` of a scheduler, or "local": ``count``
    processes on this machine. Raises ``InputError`` if there is no such cluster."""
    with _client(address, count) as client:
        from distributed import as_completed

        client.subscribe_topic(TOPIC, lambda event: tell(*event[1]))
        run = secrets.token_hex(4)  # a scheduler remembers keys, so use new ones
        fields = {task.field: task for task in tasks if task.field is not None}
        measured = {
            field: client.submit(measure, task, key=f"vehsim-field-{run}-{field}") for field, task in fields.items()
        }
        futures = {
            client.submit(
                _run_there, task, measured.get(task.field or ""), key=f"vehsim-{run}-{task.name}", pure=False
            ): task
            for task in tasks
        }
        for future in as_completed(futures):
            outcome = _outcome(future, futures.pop(future))
            future.release()  # otherwise the scheduler makes a finished clip again when its worker is lost
            yield outcome
    for task in tasks:  # delete files that killed workers left beside clips that other workers have finished since
        clean_up(task.target)


def _outcome(future: Any, task: Task) -> Outcome:
    """Wait once more for a result that was lost with its worker: the scheduler makes it again."""
    from concurrent.futures import CancelledError

    try:
        outcome: Outcome = future.result()
        return outcome
    except (Exception, CancelledError) as error:
        text = f"the cluster lost it: {type(error).__name__}: {error}; see the cluster's own logs, then --resume"
        return Outcome(task.name, "failed", "WorkerLost", text)


def _run_there(task: Task, measured: Any) -> Outcome:
    from distributed import get_worker

    worker = get_worker()
    states = [""]

    def tell(name: str, state: str, what: str, done: float) -> None:
        if state != states[0]:  # one message to the scheduler each
            states[0] = state
            worker.log_event(TOPIC, (name, state, what, done))

    return run_task(task, tell)


def _client(address: str, count: int) -> Any:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("Dask is not installed", "pip install 'vehsim[dask]'", key="--dask") from None
    if address == LOCAL:
        cluster = LocalCluster(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=None)
        return _Closing(Client(cluster), cluster)
    try:
        return Client(address, timeout="20s")
    except (OSError, ValueError) as error:
        remedy = "give the address of a running scheduler, such as tcp://host:8786, or local"
        raise InputError(str(error), remedy, key="--dask", value=address) from None


class _Closing:
    """A client that closes its own cluster."""

    def __init__(self, client: Any, cluster: Any) -> None:
        self._client, self._cluster = client, cluster

    def __enter__(self) -> Any:
        return self._client

    def __exit__(self, *error: Any) -> None:
        self._client.close()
        self._cluster.close()
