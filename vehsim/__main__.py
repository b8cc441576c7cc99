"""``vehsim``, also as ``python -m vehsim``: what workers are forked from loads beside the command itself.

Nothing else is imported here: multiprocessing has every worker import this module again.
"""

from __future__ import annotations

import os
import re
import sys


def main() -> None:
    """The console command."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices are small: others would turn while they wait
    try:
        words = " ".join(sys.argv[1:])
        if re.match(r"export .*--workers[ =](?!1\b)", words) and not re.search("--(dask|dry-run|help)", words):
            from vehsim.batch.workers import warm_up

            warm_up()
        from vehsim import cli
    except KeyboardInterrupt:
        sys.exit(130)
    cli.main()


if __name__ == "__main__":
    main()
