"""A headless browser, if this machine has one: pages are opened from files, as users open them."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = ("--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars")


def browser() -> str:
    """The path of a browser; skips the test without one."""
    found = next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser on this machine: install one of {', '.join(NAMES)}")
    return found


def opened(page: Path, profile: Path, *flags: str) -> str:
    """The document of a page after its scripts ran, without any network."""
    how = [*FLAGS, f"--user-data-dir={profile}", "--host-resolver-rules=MAP * ~NOTFOUND", *flags]
    done = subprocess.run([browser(), *how, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=300)
    return done.stdout
