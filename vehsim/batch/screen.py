"""The display of a running batch: a live table on a terminal, plain lines elsewhere, or JSON for programs."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

from vehsim.batch.task import Outcome, Task
from vehsim.errors import Problem

if TYPE_CHECKING:
    from vehsim.runtime.progress import Progress

PAUSE, CHANGE = 5.0, 1.0
"""Time between two plain lines of progress, s: the longest, and the shortest if the state changed."""
EVENTS = {"error": "refused", "fault": "failed", "warning": "warning"}
"""Names of problems in the log, by severity."""
AT_WORK = 3
"""Largest number of active clips in a plain line."""
STATES = ("queued", "planning", "baking", "rendering", "done", "skipped", "failed")
ROWS = 20
"""Largest number of active clips in a table."""


class Watcher(Protocol):
    """Receives the progress of clips, and their outcomes."""

    def tell(self, name: str, state: str, what: str, done: float) -> None: ...

    def end(self, outcome: Outcome) -> None: ...


@contextmanager
def watch(tasks: Sequence[Task], screen: Any, log: str, quiet: bool) -> Iterator[Watcher]:
    """The watcher for a ``log`` of "text" or "json". ``screen``: a rich console for messages other than results."""
    if log == "json":
        yield _JsonLog({task.name: task.source for task in tasks})
    elif quiet:
        yield _Lines(tasks, screen, quiet)
    elif not screen.is_terminal:
        lines = _Progress(tasks, screen)
        with ticking(lines.line) as tick:
            lines.tick = tick
            yield lines
    else:
        table = _Table(tasks, screen)
        from rich.live import Live

        with Live(table, console=screen, refresh_per_second=8, transient=True):
            yield table


@contextmanager
def logged(name: str, source: str) -> Iterator[Progress]:
    """The JSON log of work on one clip in this process: its progress, its warnings, and its outcome."""
    log, began = _JsonLog({name: source}), time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = lambda message, *rest, **more: log.warn(name, str(message))  # type: ignore[assignment]  # restored by the context
        try:
            yield lambda what, done: log.tell(name, "planning", what, done)
        except Exception as error:
            problems = tuple(problem.as_dict() for problem in getattr(error, "problems", ()))
            seconds = time.monotonic() - began
            log.end(Outcome(name, "failed", type(error).__name__, str(error), problems, seconds=seconds))
            raise
        log.end(Outcome(name, "done", seconds=time.monotonic() - began))


@contextmanager
def ticking(line: Callable[[], tuple[str, str]]) -> Iterator[Callable[[], None]]:
    """Print the result of ``line``, a state and a text, on standard error at a new state and every `PAUSE` seconds.

    Yields a function to call with news: a thread prints each second, but libraries may block it.
    """
    began = last = time.monotonic()
    before, lock, ended = "", threading.Lock(), threading.Event()

    def tick() -> None:
        nonlocal last, before
        with lock:
            now, (state, text) = time.monotonic(), line()
            if text and now - last >= (PAUSE if state == before else CHANGE):
                last, before = now, state
                with suppress(OSError, ValueError):  # the reader has exited: the work continues
                    print(f"{text}  {now - began:.0f} s", file=sys.stderr, flush=True)

    def keep() -> None:
        while not ended.wait(CHANGE):
            tick()

    thread = threading.Thread(target=keep, daemon=True)
    thread.start()
    try:
        yield tick
    finally:
        ended.set()
        thread.join()  # no line may follow the result


class _Lines:
    """One line for every finished clip."""

    def __init__(self, tasks: Sequence[Task], screen: Any, quiet: bool) -> None:
        self._tasks = {task.name: task for task in tasks}
        self._screen, self._quiet = screen, quiet

    def tell(self, name: str, state: str, what: str, done: float) -> None:
        pass

    def end(self, outcome: Outcome) -> None:
        task = self._tasks[outcome.name]
        if not self._quiet:
            for text in outcome.warnings:
                self._screen.print(f"warning: {_where(task)}: {text}", markup=False, style="yellow")
        if outcome.state == "failed":
            self._screen.print(f"{_where(task)}: {outcome.message}", markup=False, style="red")
            if outcome.detail and os.environ.get("VEHSIM_DEBUG"):
                self._screen.print(outcome.detail, markup=False, highlight=False)
        elif self._quiet:
            return
        elif outcome.frames is None:
            _answer(f"{task.target}: already finished")
        else:
            source = ", motion from the cache" * outcome.recalled
            _answer(f"{task.target}: {', '.join(task.to)} of frames {outcome.frames[0]} to {outcome.frames[1]}{source}")


class _AtWork(_Lines):
    """Tracks the work of every clip."""

    def __init__(self, tasks: Sequence[Task], screen: Any) -> None:
        super().__init__(tasks, screen, quiet=False)
        self._states = dict.fromkeys(self._tasks, "queued")
        self._active: dict[str, tuple[str, str, float]] = {}

    def tell(self, name: str, state: str, what: str, done: float) -> None:
        self._states[name] = state
        self._active[name] = (state, what, done)
        if state == "queued":
            del self._active[name]

    def end(self, outcome: Outcome) -> None:
        self._states[outcome.name] = outcome.state
        self._active.pop(outcome.name, None)
        super().end(outcome)


class _Progress(_AtWork):
    """Without a terminal: a plain line every few seconds, so that a log shows the progress."""

    tick: Callable[[], None]

    def tell(self, name: str, state: str, what: str, done: float) -> None:
        super().tell(name, state, what, done)
        self.tick()

    def line(self) -> tuple[str, str]:
        """The states of all clips, and the current work."""
        active = list(self._active.items())
        if len(self._tasks) == 1:
            return " ".join(self._states.values()), "".join(f"{name}  {what}" for name, (_, what, _) in active)
        ended = sum(state in ("done", "skipped", "failed") for state in self._states.values())
        shown = [f"{name}  {what}" for name, (_, what, _) in active[:AT_WORK]]
        more = [f"{len(active) - AT_WORK} more active"] * (len(active) > AT_WORK)
        return str(ended), "; ".join([f"{ended} of {len(self._tasks)} done", *shown, *more])


class _Table(_AtWork):
    """The whole batch in one bar, and a row for every active clip; a rich renderable."""

    def __rich__(self) -> Any:
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        counts = Counter(self._states.values())
        ended = counts["done"] + counts["skipped"] + counts["failed"]
        head = Table.grid(padding=(0, 1))
        words = ", ".join(f"{counts[state]} {state}" for state in STATES if counts[state])
        head.add_row(ProgressBar(len(self._tasks), ended, width=30), Text(f"{ended} of {len(self._tasks)}: {words}"))
        rows = Table.grid(padding=(0, 1))
        for name, (state, what, done) in list(self._active.items())[:ROWS]:
            rows.add_row(Text(name), Text(state, style="cyan"), ProgressBar(1.0, done, width=16), Text(what))
        return Group(head, rows)


def log_problems(problems: Sequence[Problem]) -> None:
    """Write lines to the log for shots that are refused, and for warnings of others."""
    for problem in problems:
        where = {"source": problem.file, "line": problem.line, "key": problem.key}
        _log(EVENTS[problem.severity], 0.0, **where, message=str(problem), problem=problem.as_dict())


class _JsonLog:
    """One line of JSON on standard output per event; times appear only here."""

    def __init__(self, sources: Mapping[str, str]) -> None:
        """``sources``: the shot file of each clip, by the clip's name."""
        self._sources = sources
        self._began = time.monotonic()
        self._say("batch", clips=len(sources))

    def tell(self, name: str, state: str, what: str, done: float) -> None:
        self._say("progress", clip=name, state=state, what=what, done=round(done, 4))

    def end(self, outcome: Outcome) -> None:
        for text in outcome.warnings:
            self.warn(outcome.name, text)
        problems = list(outcome.problems)
        error = {"kind": outcome.kind, "message": outcome.message, "problems": problems, "detail": outcome.detail}
        more = {key: value for key, value in error.items() if value} if outcome.state == "failed" else {}
        more |= {"motion": "cache"} if outcome.recalled else {}
        seconds = round(outcome.seconds, 3)
        self._say(outcome.state, clip=outcome.name, source=self._sources[outcome.name], seconds=seconds, **more)

    def warn(self, name: str, text: str) -> None:
        self._say("warning", clip=name, message=text)

    def _say(self, event: str, **more: Any) -> None:
        _log(event, time.monotonic() - self._began, **more)  # the wall clock may jump


def _log(event: str, elapsed: float, **more: Any) -> None:
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    _answer(json.dumps({"event": event, "time": now, "elapsed": round(elapsed, 3), **more}))


def _answer(text: str) -> None:
    print(text, flush=True)


def _where(task: Task) -> str:
    """The shot file, and the clip if a sweep made several of it."""
    from pathlib import Path

    return task.source if Path(task.source).stem == task.name else f"{task.source}: {task.name}"
