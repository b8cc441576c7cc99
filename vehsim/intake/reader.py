"""Read foreign files in another process, within bounds: a file that crashes a library, or never ends, is refused.

Each interpreter starts one reader process at its first file of unknown content, keeps it, and replaces it when it dies.
It is not a `vehsim.runtime.processes.Worker`, because workers read files too and have no workers of their own.
Answers are plain data and arrays, never objects, so nothing that a file could contain is executed here. They are cached
by content: a file is read once, and known files need no other process.
"""

from __future__ import annotations

import atexit
import io
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vehsim import errors
from vehsim.errors import InputError, Problem, VehsimError
from vehsim.intake.foreign import MAX_BYTES, limit, raise_limit, reading, refuse
from vehsim.runtime.cache import Stamp, content_of, lookup, stamp, store

Answer = tuple[Any, list[NDArray[Any]]]
"""Plain data, as JSON has it, and arrays."""
Read = Callable[..., Answer]
"""A public function of a module: the path of a file and more plain arguments -> what the file contains."""

KEPT, MOST_KEPT = 50_000_000, 1_000_000_000
"""Bytes of the largest answer that is kept for other processes, and of all of them."""
MADE = 3
"""Change it whenever the answers of a reading function change: cached answers are then made again."""
PATIENCE = 10.0
"""Time that a file may take, in multiples of the limit for the processor: other programs use the machine too."""
READY = b"ready"
TEMPORARY = ("TMPDIR", "TEMP", "TMP")
"""Environment variables that name the folder for temporary files."""
PROGRAM = "import sys; sys.path[:] = {!r}; from vehsim.intake.reader import serve; serve({!r})"


def read_cached(read: Read, path: Path, key: str, *more: Any) -> Answer:
    """The answer of ``read(path, *more)`` in the reader process, or the cached answer for a file of the same content.
    It must depend on content and arguments only. Raises ``InputError`` that names file and ``key``.

    Of a file beyond ``MAX_BYTES``, only a part is read, which is faster than comparing its content.
    """
    with reading(path, key):
        if path.stat().st_size > MAX_BYTES:
            return read_in_process(read, path, key, *more)
        made_of = (MADE, _name(read), content_of(path), more)
    if (found := lookup("read", made_of)) is not None:
        return _unpacked(io.BytesIO(found))
    answer = read_in_process(read, path, key, *more)
    if sum(array.nbytes for array in answer[1]) < KEPT:
        store("read", made_of, b"".join(_packed(*answer)), MOST_KEPT)
    return answer


def read_in_process(read: Read, path: Path, key: str, *more: Any) -> Answer:
    """The answer of ``read(path, *more)`` in the reader process. Raises ``InputError`` that names file and ``key``.

    Warnings are repeated here. A refused file is not read again before it changes.
    """
    with reading(path, key):
        request = (_name(read), str(path), key, repr(more), *map(limit, ("VEHSIM_READ_SECONDS", "VEHSIM_READ_GB")))
        written = stamp(path)
    if request in _refused and _refused[request][0] == written:
        raise _refused[request][1]
    try:
        return _ask({"read": _name(read), "path": str(path), "key": key, "more": more, "folder": os.getcwd()})
    except InputError as error:
        _refused[request] = written, error
        raise


_refused: dict[Any, tuple[Stamp, InputError]] = {}
"""Files that this process has refused, so that it does not wait again for one that never ends."""


def _name(read: Read) -> str:
    return f"{read.__module__}:{read.__qualname__}"


# ---------------------------------------------------------------- in the main process


def _ask(request: dict[str, Any]) -> Answer:
    """The reader process's answer. If the process dies, the file is refused."""
    with _Process.at_work:
        process = _Process.current()
        try:
            answer, arrays = process.ask(request)
        except BaseException as error:  # also an interrupt: the next answer would belong to this request
            if isinstance(error, EOFError | OSError | ValueError):
                raise process.failure(Path(request["path"]), request["key"]) from None
            process.end()
            raise
    for message in answer["warnings"]:
        warnings.warn(message, stacklevel=4)
    if "error" in answer:
        kind: type[VehsimError] = getattr(errors, answer["error"])
        raise kind.of(*(Problem(**problem) for problem in answer["problems"]))
    return answer["facts"], arrays


class _Process:
    """The reader process of this interpreter. It has a temporary folder of its own, which is removed with it: libraries
    leave files there when they crash."""

    at_work = threading.Lock()
    """Held while a file is read: answers come in the order of the questions."""
    _kept: _Process | None = None

    def __init__(self) -> None:
        alone = dict.fromkeys(("PXR_WORK_THREAD_LIMIT", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self.made_for = _circumstances()
        self._overdue = False
        program = _python()
        try:
            self._folder = tempfile.mkdtemp(prefix="vehsim-reader-")
        except OSError as error:
            raise InputError(f"no temporary folder ({error})", "name a folder with free space", key="TMPDIR") from None
        try:
            self._process = subprocess.Popen(
                [program, "-c", PROGRAM.format(sys.path, self._folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env=os.environ | alone | dict.fromkeys(TEMPORARY, self._folder),
            )
            if self._process.stdout is None or self._process.stdout.read(len(READY)) != READY:
                self.end()
                raise OSError("it cannot import vehsim")
        except OSError as error:
            shutil.rmtree(self._folder, ignore_errors=True)
            remedy = "name a Python that can import vehsim with multiprocessing.set_executable"
            raise InputError(f"cannot read files in another process ({error})", remedy, value=program) from None

    @classmethod
    def current(cls) -> _Process:
        """The running process, or a new one."""
        if cls._kept is None or cls._kept.made_for != _circumstances() or cls._kept._process.poll() is not None:
            if cls._kept is not None:
                cls._kept.end()
            cls._kept = cls()
            atexit.register(cls._kept.end)
        return cls._kept

    def ask(self, request: dict[str, Any]) -> Answer:
        questions, answers = self._process.stdin, self._process.stdout
        assert questions is not None and answers is not None
        watch = threading.Timer(PATIENCE * limit("VEHSIM_READ_SECONDS"), self._interrupt)
        watch.daemon = True
        watch.start()
        try:
            questions.write(json.dumps(request).encode() + b"\n")
            questions.flush()
            return _unpacked(answers)
        finally:
            watch.cancel()

    def _interrupt(self) -> None:
        self._overdue = True
        self._process.kill()

    def end(self) -> None:
        """End the process, which holds nothing that could be lost. A fork leaves it to the process that started it."""
        atexit.unregister(self.end)
        if self.made_for[0] != os.getpid():
            return
        self._process.kill()
        self._process.wait()
        for pipe in filter(None, (self._process.stdin, self._process.stdout)):
            with suppress(OSError):
                pipe.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def failure(self, path: Path, key: str) -> InputError:
        """The error for the file that it read when it died, by its exit code."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(PATIENCE)
        self.end()
        code = self._process.returncode
        if self._overdue or code == -getattr(signal, "SIGXCPU", 24):
            message = f"takes more than {limit('VEHSIM_READ_SECONDS'):g} s to read"
            return refuse(path, key, message, raise_limit("VEHSIM_READ_SECONDS"))
        if code in (-getattr(signal, "SIGKILL", 9), -signal.SIGABRT):  # libraries abort without memory
            message = f"cannot be read (broken, or takes more than {limit('VEHSIM_READ_GB'):g} GB)"
            return refuse(path, key, message, f"export the file again; {raise_limit('VEHSIM_READ_GB')}")
        how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return refuse(path, key, f"cannot be read (the library that reads it crashed: {how})", "export the file again")


def _circumstances() -> tuple[int, frozenset[tuple[str, str]]]:
    """What a reader process depends on: the interpreter, which may have been forked, and the environment variables for
    limits and for USD."""
    variables = ((name, value) for name, value in os.environ.items() if name.startswith(("VEHSIM_", "PXR_")))
    return os.getpid(), frozenset(variables)


def _python() -> str:
    """The interpreter; ``multiprocessing.set_executable`` names it where the program is a host application."""
    from multiprocessing import spawn

    return os.fsdecode(spawn.get_executable())


# ---------------------------------------------------------------- in the reader process


def serve(folder: str) -> None:
    """The reader process: answer questions until there are no more, then remove ``folder``, its temporary folder: the
    main process may have been killed."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # libraries print
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes; the main one handles it
    _bound("RLIMIT_AS", limit("VEHSIM_READ_GB") * 1e9)
    _bound("RLIMIT_CORE", 0)
    with suppress(OSError):
        answers.write(READY)
        answers.flush()
        for line in sys.stdin.buffer:
            for part in _packed(*_answer(json.loads(line))):
                answers.write(part)
            answers.flush()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


def _answer(request: dict[str, Any]) -> Answer:
    _bound("RLIMIT_CPU", math.ceil(sum(os.times()[:2]) + limit("VEHSIM_READ_SECONDS")))
    with suppress(OSError):
        os.chdir(request["folder"])
    module, _, name = request["read"].partition(":")
    path = Path(request["path"])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            with reading(path, request["key"]):
                facts, arrays = getattr(import_module(module), name)(path, *request["more"])
            answer: dict[str, Any] = {"facts": facts}
        except VehsimError as error:
            answer, arrays = {"error": type(error).__name__, "problems": [vars(each) for each in error.problems]}, []
    own = [str(each.message) for each in caught if issubclass(each.category, UserWarning)]
    return answer | {"warnings": list(dict.fromkeys(own))}, arrays


def _bound(name: str, most: float) -> None:
    """Limit a resource of this process, if the system supports it; a stricter limit stays."""
    with suppress(ImportError, AttributeError, OSError, ValueError):
        import resource

        kind = getattr(resource, name)
        hard = resource.getrlimit(kind)[1]
        soft = int(most) if hard == resource.RLIM_INFINITY else min(int(most), hard)
        resource.setrlimit(kind, (soft, hard))


# ---------------------------------------------------------------- messages


def _packed(answer: Any, arrays: Sequence[NDArray[Any]]) -> Iterator[bytes | memoryview]:
    """The length of the head, the head in JSON, and the arrays' bytes."""
    plain = [np.ascontiguousarray(array) for array in arrays]
    head = {"told": answer, "arrays": [[array.dtype.str, array.shape] for array in arrays]}
    text = json.dumps(head, default=str).encode()
    yield len(text).to_bytes(8, "little")
    yield text
    yield from (array.reshape(-1).view(np.uint8).data for array in plain if array.nbytes)


def _unpacked(file: BinaryIO | Any) -> Answer:
    """What `_packed` wrote. Raises ``EOFError`` if it ends early."""
    head = json.loads(_exactly(file, int.from_bytes(_exactly(file, 8), "little")))
    arrays = []
    for dtype, shape in head["arrays"]:
        array = np.empty(shape, dtype)
        if array.nbytes:
            _fill(file, array.reshape(-1).view(np.uint8).data)
        arrays.append(array)
    return head["told"], arrays


def _exactly(file: Any, count: int) -> bytes:
    found = bytearray(count)
    _fill(file, memoryview(found))
    return bytes(found)


def _fill(file: Any, space: memoryview) -> None:
    while space:
        count = file.readinto(space)
        if not count:
            raise EOFError
        space = space[count:]
