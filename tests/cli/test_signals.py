"""Signals that arrive while USD is being loaded."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

PATIENCE = 300.0
"""Time limit on a busy machine, s: only a failing test waits that long."""

WAITS = """
import os, select, signal
from vehsim.runtime import signals

signals._loads_usd = lambda frame, left=[True]: bool(left) and left.pop()  # the first signal comes too early
signal.signal(signal.SIGTERM, signals.raising(SystemExit))
os.kill(os.getpid(), signal.SIGTERM)
reader, _ = os.pipe()
select.select([reader], [], [])
"""


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="Windows waits otherwise")
def test_a_signal_that_had_to_wait_wakes_a_main_thread_that_waits():
    """The server of `vehsim live` waits for its sockets: a signal that is repeated must end this wait."""
    done = subprocess.run([sys.executable, "-c", WAITS], timeout=PATIENCE)
    assert done.returncode == 0
