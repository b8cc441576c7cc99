"""``vehsim``, also as ``python -m vehsim``: what workers are forked from loads beside the command itself.

Nothing else is imported here: multiprocessing has every worker import this module again.
"""

from __future__ import annotations

import atexit
import os
import re
import sys
from contextlib import suppress


def main() -> None:
    """The console command."""
    code = 1

    def leave() -> None:
        """After all others: what libraries would then tear down in order takes as long as a clip."""
        with suppress(OSError):  # whoever read it has gone
            for stream in filter(None, (sys.stdout, sys.stderr)):  # None where it was closed from the start
                stream.flush()
        os._exit(code)

    atexit.register(leave)  # first in, last out
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: others would turn while they wait
    try:
        if _has_workers(" ".join(sys.argv[1:])):
            from vehsim.batch.workers import warm_up

            warm_up()
        from vehsim import cli

        code = cli.run(sys.argv[1:])
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _has_workers(words: str) -> bool:
    """Will these words, read at a glance, have several processes at work?"""
    many = words.count(".toml") > 1 or re.search(r"--workers[ =](?!1\b)", words)
    return bool(many and words.startswith("export ") and not re.search("--(dask|dry-run|help)", words))


if __name__ == "__main__":
    main()
