"""The command ``vehsim``, also ``python -m vehsim``; starts the process for workers while the command loads."""

from __future__ import annotations

import atexit
import os
import re
import sys
from contextlib import suppress


def main() -> None:
    """The entry point of the console command."""
    code = 1

    def leave() -> None:
        """Exit last, and skip the orderly teardown of libraries, which takes as long as a clip."""
        with suppress(OSError):  # the reader of the output has exited
            for stream in filter(None, (sys.stdout, sys.stderr)):  # None if the stream was closed from the start
                stream.flush()
        os._exit(code)

    atexit.register(leave)  # registered first, runs last
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: more threads would only wait
    try:
        if _has_workers(" ".join(sys.argv[1:])):
            from vehsim.batch.workers import warm_up

            warm_up()
        from vehsim.cli import commands as cli

        code = cli.run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _has_workers(words: str) -> bool:
    """Whether these arguments need several processes; a quick check of the text."""
    many = words.count(".toml") > 1 or re.search(r"--workers[ =](?!1\b)", words)
    return bool(many and words.startswith("export ") and not re.search("--(dask|dry-run|help)", words))


if __name__ == "__main__":
    main()
