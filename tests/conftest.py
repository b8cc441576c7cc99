"""The base of all tests: every USD stage a test writes is validated when the test ends.

A test that writes a broken stage on purpose says so with ``@pytest.mark.broken_stages``. Tests solve their motion, also
what an earlier run solved: the cache of motion is off but where it is tested.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

USD_SUFFIXES = {".usd", ".usda", ".usdc", ".usdz"}


def pytest_configure(config: pytest.Config) -> None:
    os.environ["VEHSIM_CACHE_GB"] = "0"
    config.addinivalue_line("markers", "broken_stages: the test writes stages that do not validate, on purpose")
    # where tests run in the background of a shell, Ctrl-C is ignored, also by what they start
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True)
def every_stage_validates(request: pytest.FixtureRequest) -> Iterator[None]:
    folder = request.getfixturevalue("tmp_path") if "tmp_path" in request.fixturenames else None
    yield
    if folder is not None and not request.node.get_closest_marker("broken_stages"):
        assert_stages_valid(folder)


def assert_stages_valid(folder: Path) -> None:
    """No stage below ``folder`` has an error of any validator, USD's or ours."""
    from vehsim.exporters.validate import validate_stage

    stages = [path for path in sorted(folder.rglob("*")) if path.suffix in USD_SUFFIXES]
    issues = [f"{path.relative_to(folder)}: {issue}" for path in stages for issue in validate_stage(path)]
    errors = [issue for issue in issues if "error: " in issue]
    assert not errors, "\n".join(errors)
