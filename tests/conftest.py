"""The base of all tests: every USD stage that a test writes is validated when the test ends.

A test that writes a broken stage on purpose is marked with ``@pytest.mark.broken_stages``. Tests solve all their
motion: the cache of motion is off except where it is tested.
"""

from __future__ import annotations

import json
import os
import signal
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

USD_SUFFIXES = {".usd", ".usda", ".usdc", ".usdz"}

settings.register_profile("any load", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any load")  # how long a test takes depends on what else runs


def pytest_configure(config: pytest.Config) -> None:
    os.environ["VEHSIM_CACHE_GB"] = "0"
    if config.getoption("--measure") and not hasattr(config, "workerinput"):  # the first process writes for all
        config.pluginmanager.register(Recorder())
    config.addinivalue_line("markers", "broken_stages: the test writes stages that do not validate, on purpose")
    # where tests run in the background of a shell, Ctrl-C is ignored, also by processes that they start
    signal.signal(signal.SIGINT, signal.default_int_handler)


ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "tests" / "seconds.json"
"""File -> test function -> CPU seconds of all its cases, setup included, as `--measure` wrote them."""
BUDGET = 5.0
"""CPU seconds of the tests that `--fast` runs, the cheapest first; their imports take the same time again."""
SECONDS: pytest.StashKey[float] = pytest.StashKey()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--fast", action="store_true", help=f"the cheapest tests, {BUDGET:g} CPU s by {MEASURED.name}")
    parser.addoption("--measure", action="store_true", help=f"write what each test takes to {MEASURED.name}")


def measured() -> dict[str, dict[str, float]]:
    return json.loads(MEASURED.read_text()) if MEASURED.is_file() else {}


@cache
def fast_tests() -> frozenset[tuple[str, str]]:
    """File and function of the tests that `--fast` runs, without tests that were never measured."""
    total, chosen = 0.0, set()
    for seconds, *test in sorted((s, file, name) for file, tests in measured().items() for name, s in tests.items()):
        total += seconds
        if total > BUDGET:
            break
        chosen.add((test[0], test[1]))
    return frozenset(chosen)


def test_of(nodeid: str) -> tuple[str, str]:
    """File and function of a test's id."""
    file, _, name = nodeid.partition("::")
    return file, name.partition("[")[0]


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    if not config.getoption("--fast") or collection_path.suffix != ".py":
        return None
    return collection_path.relative_to(ROOT).as_posix() not in {file for file, _ in fast_tests()} or None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--fast"):
        slow = [item for item in items if test_of(item.nodeid) not in fast_tests()]
        items[:] = [item for item in items if test_of(item.nodeid) in fast_tests()]
        config.hook.pytest_deselected(items=slow)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    item.stash[SECONDS] = sum(os.times()[:4])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[Any]) -> None:
    if call.when == "call":  # also if a worker process reports it
        item.user_properties.append(("cpu_seconds", sum(os.times()[:4]) - item.stash[SECONDS]))


class Recorder:
    """Collects the times of a session's tests, and writes them."""

    def __init__(self) -> None:
        self.seconds: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "call":
            file, name = test_of(report.nodeid)
            self.seconds[file][name] += dict(report.user_properties)["cpu_seconds"]  # type: ignore[arg-type]

    def pytest_sessionfinish(self) -> None:
        known = {file: tests for file, tests in measured().items() if (ROOT / file).is_file()}
        for file, tests in self.seconds.items():
            known[file] = known.get(file, {}) | {name: round(seconds, 3) for name, seconds in tests.items()}
        MEASURED.write_text(json.dumps(known, indent=0, sort_keys=True) + "\n")


@pytest.fixture(autouse=True)
def every_stage_validates(request: pytest.FixtureRequest) -> Iterator[None]:
    folder = request.getfixturevalue("tmp_path") if "tmp_path" in request.fixturenames else None
    yield
    if folder is not None and not request.node.get_closest_marker("broken_stages"):
        assert_stages_valid(folder)


def assert_stages_valid(folder: Path) -> None:
    """Assert that no stage below ``folder`` has an error of any validator, USD's or ours."""
    from vehsim.exporters.checks.validate import validate_stage

    stages = [path for path in sorted(folder.rglob("*")) if path.suffix in USD_SUFFIXES]
    issues = [f"{path.relative_to(folder)}: {issue}" for path in stages for issue in validate_stage(path)]
    errors = [issue for issue in issues if "error: " in issue]
    assert not errors, "\n".join(errors)
