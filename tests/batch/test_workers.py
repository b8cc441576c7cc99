"""Worker processes: their initial state, what they wait for, and their replacement after they end."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from vehsim.batch import Outcome, Task, export_batch, load_shots, workers
from vehsim.batch.task import prepare
from vehsim.batch.workers import Job, _dispatch
from vehsim.runtime import processes
from vehsim.runtime.processes import ENDING, METHODS, THREADS
from vehsim.runtime.signals import raising

Content = Callable[[Path], dict[str, str]]
Write = Callable[..., Path]
TWO = '"vehicle.car.motion.duration" = [0.25, 0.3]'
forked = pytest.mark.skipif("forkserver" not in METHODS, reason="workers are not forked here")


@forked
def test_the_fork_server_has_all_modules_and_a_single_thread() -> None:
    code = "import os, vehsim.batch.preload; print(len(os.listdir('/proc/self/task')))"
    one = {**os.environ, **dict.fromkeys(THREADS, "1")}
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=one)
    assert answer.stdout.strip() == "1"


@forked
def test_forked_workers_handle_ctrl_c_silently(monkeypatch: pytest.MonkeyPatch) -> None:
    """It reaches the whole group: blocked while the process starts, then ignored; workers do not inherit the mask."""
    from multiprocessing import forkserver

    blocked = []
    monkeypatch.setattr(
        forkserver, "ensure_running", lambda: blocked.append(signal.pthread_sigmask(signal.SIG_BLOCK, ()))
    )
    workers.warm_up()
    assert blocked[0] >= set(ENDING)
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, ()) & set(ENDING)
    code = (
        "import signal, vehsim.batch.preload; from vehsim.runtime.processes import ENDING\n"
        "print(*(signal.getsignal(number).name for number in ENDING), *signal.pthread_sigmask(signal.SIG_BLOCK, ()))"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_BLOCK, ENDING),
    )
    assert answer.stdout.split() == ["SIG_IGN"] * len(ENDING)


@pytest.mark.parametrize(
    "words, early",
    [
        ("export a.toml --workers 2", True),
        ("export --workers=16 a.toml --to usd", True),
        ("export a.toml b.toml", True),
        ("export a.toml --workers 1", False),
        ("export a.toml", False),
        ("export a.toml --workers 2 --dry-run", False),
        ("check a.toml b.toml", False),
    ],
)
def test_the_fork_server_starts_before_the_command_is_loaded(words: str, early: bool) -> None:
    from vehsim.__main__ import _has_workers

    assert _has_workers(words) is early


@forked
def test_a_command_leaves_no_temporary_files(write: Write, tmp_path: Path) -> None:
    """Not even the fork server's socket, although a command ends without the usual teardown."""
    path, temporary = write(sweep=TWO), tmp_path / "temporary"
    temporary.mkdir()
    command = [sys.executable, "-m", "vehsim", "export", str(path), "--out", str(tmp_path / "out"), "--to", "npz"]
    subprocess.run([*command, "--workers", "2"], check=True, env={**os.environ, "TMPDIR": str(temporary)})
    assert list(temporary.iterdir()) == []


def test_a_repeated_signal_is_raised_once() -> None:
    """From the group, and from the first process: the second must not disturb the cleanup."""
    before = signal.signal(signal.SIGTERM, raising(KeyboardInterrupt, once=True))
    try:
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


@forked
def test_workers_have_the_environment_of_their_caller(
    write: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not that of the fork server, which may have been started long before."""
    import shutil

    from vehsim.vehicles import load_vehicle

    shot = write(asset="~/mine", sweep=TWO)
    for home in ("first", "second"):
        (tmp_path / home).mkdir()
        shutil.copytree(load_vehicle("car").rig.asset.parent, tmp_path / home / "mine")  # type: ignore[union-attr]
        monkeypatch.setenv("HOME", str(tmp_path / home))
        outcomes = export_batch(load_shots(shot), tmp_path / "out", ["npz"], workers=2)
        assert [outcome.state for outcome in outcomes] == ["done", "done"], outcomes
        shutil.rmtree(tmp_path / home)


@forked
@pytest.mark.parametrize("why", ["no room for a socket", "killed"])
def test_workers_start_without_a_fork_server(
    write: Write, tmp_path: Path, content: Content, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    shots, out = load_shots(write(sweep=TWO)), tmp_path / "out"
    export_batch(shots, out, ["npz"])
    expected = content(out)
    if why == "killed":
        workers.warm_up()
        monkeypatch.setattr(workers, "warm_up", lambda: os.kill(_server(), signal.SIGKILL))
    else:
        monkeypatch.setattr(processes, "METHODS", ["nowhere", "spawn"])
        contexts = {"nowhere": _Nowhere(), "spawn": multiprocessing.get_context("spawn")}
        monkeypatch.setattr(multiprocessing, "get_context", contexts.__getitem__)
    outcomes = export_batch(shots, tmp_path / "again", ["npz"], workers=2)
    assert [outcome.state for outcome in outcomes] == ["done", "done"], outcomes
    assert content(tmp_path / "again") == expected


@pytest.mark.parametrize("method", METHODS)
def test_a_script_without_a_guard_exports_a_batch(write: Write, tmp_path: Path, method: str) -> None:
    """Workers do not import the calling script, which would start the batch again."""
    script = tmp_path / "script.py"
    script.write_text(
        "from vehsim.runtime import processes\nfrom vehsim.batch import export_batch, load_shots\nprint('once')\n"
        f"processes.METHODS = [{method!r}]\nshots = load_shots({str(write(sweep=TWO))!r})\n"
        f"print(*(outcome.state for outcome in export_batch(shots, {str(tmp_path / 'out')!r}, ['npz'], workers=2)))\n"
    )
    answer = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=True)
    assert answer.stdout == "once\ndone done\n" and not answer.stderr


class _Nowhere:
    """A way to start processes that has no room for its socket."""

    def Process(self, **what: Any) -> Any:
        class Refused:
            def start(self) -> None:
                raise OSError("AF_UNIX path too long")

        return Refused()


def _server() -> int:
    """The process from which ours are forked."""
    children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
    (server,) = [pid for pid in children if b"forkserver" in Path(f"/proc/{pid}/cmdline").read_bytes()]
    return int(server)


class _Hand:
    """A worker that records each job, and ends the jobs it is told to end."""

    def __init__(self, given: list[tuple[str, str]], when: dict[str, list[_Hand]]) -> None:
        self.pipe, self._theirs = multiprocessing.Pipe()
        self.job: Job | None = None
        self._given, self._when = given, when

    def give(self, job: Job) -> bool:
        self.job = job
        self._given.append(("measure" if job.measures else "run", job.task.name))
        if not job.measures:
            for hand in (self, *self._when.pop(job.task.name, [])):
                hand.end()
        return True

    def end(self) -> None:
        assert self.job is not None
        self._theirs.send(Outcome(self.job.task.name, "done"))

    def receive(self) -> Any:
        return self.pipe.recv()


def test_only_clips_that_need_a_field_wait_for_it() -> None:
    """While one measures the canyon, the other makes clips in free space."""
    tasks = [Task(name, {}, "", "", "out", ("usd",), "", field=field) for name, field in FIELDS.items()]
    given: list[tuple[str, str]] = []
    when: dict[str, list[_Hand]] = {}
    crew = [_Hand(given, when), _Hand(given, when)]
    when["free2"] = [crew[0]]  # by then the field is measured
    jobs = [Job(tasks[0], measures=True), *map(Job, tasks)]
    outcomes = list(_dispatch(crew, jobs, lambda *args: None))  # type: ignore[arg-type]
    assert given[:3] == [("measure", "canyon1"), ("run", "free1"), ("run", "free2")]
    assert sorted(given[3:]) == [("run", "canyon1"), ("run", "canyon2")]
    assert sorted(outcome.name for outcome in outcomes) == sorted(FIELDS)


FIELDS = {"canyon1": "field", "free1": None, "canyon2": "field", "free2": None}


FLIGHT = """[shot]
schema = 1
name = "flight"
[world]
terrain = "ground.npz"
[[vehicle]]
name = "heli"
asset = "helicopter"
[vehicle.motion]
method = "plan"
[[vehicle.motion.mark]]
frame = 1
position = [20, 20, 15]
velocity = [0, 0, 0]
[[vehicle.motion.mark]]
frame = 200
position = [60, 40, 15]
velocity = [0, 0, 0]
"""


@pytest.mark.parametrize(("cells", "more", "whole"), [(20, "", True), (120, "", False), (120, "tower", True)])
def test_the_whole_field_is_measured_only_if_flights_need_it(
    tmp_path: Path, cells: int, more: str, whole: bool
) -> None:
    """Flights over a wide terrain measure the part around their marks."""
    np.savez(tmp_path / "ground.npz", heights=np.zeros((cells, cells)), origin=(0.0, 0.0), cell=(5.0, 5.0))
    tower = '[[world.obstacle]]\nshape = "box"\nname = "tower"\ncentre = [40, 60, 10]\nsize = [4, 4, 20]\n'
    (tmp_path / "flight.toml").write_text(FLIGHT + (tower if more else ""))
    (shot,) = load_shots(tmp_path / "flight.toml")
    assert (prepare(shot, tmp_path / "out", ["usd"]).field is not None) == whole
