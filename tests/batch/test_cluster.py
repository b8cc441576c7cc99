"""An external Dask cluster, by its address: the same bytes, also when its workers are killed while working."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from vehsim.batch import export_batch, load_shots
from vehsim.cli import commands as cli

Content = Callable[[Path], dict[str, str]]
Write = Callable[..., Path]
PATIENCE = 600.0
"""Time limit on a busy machine, s: only a failing test waits that long."""
TEN = '"vehicle.car.motion.duration" = { from = 1.0, to = 3.0, count = 10 }'


@pytest.fixture
def cluster() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed", reason='needs the extra: pip install "vehsim[dask]"')
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster


def test_clips_of_lost_workers_are_made_by_other_workers(
    cluster: Any, write: Write, tmp_path: Path, content: Content
) -> None:
    shots = load_shots(write(sweep=TEN))
    export_batch(shots, tmp_path / "here", ["usd", "npz"])
    killed: list[int] = []

    def kill() -> None:
        """Kill each worker once, while clips are being written."""
        for k, worker in enumerate(list(cluster.workers.values())):
            while len(list((tmp_path / "there").glob("drive*"))) < 2 * (k + 1):
                time.sleep(0.01)
            with suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGKILL)
                killed.append(worker.pid)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    outcomes = export_batch(shots, tmp_path / "there", ["usd", "npz"], dask=cluster.scheduler_address)
    killer.join(PATIENCE)
    assert len(killed) == 2
    assert {(outcome.state, outcome.message) for outcome in outcomes} == {("done", "")}
    assert content(tmp_path / "there") == content(tmp_path / "here")


def test_no_scheduler_at_the_address(write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("distributed")
    shot, out = write(sweep='"shot.start_frame" = [1, 2]'), tmp_path / "out"
    assert cli.run(["export", str(shot), "--out", str(out), "--dask", "nonsense://1"]) == 2
    assert "--dask = 'nonsense://1'" in capsys.readouterr().err
    assert not out.exists()
