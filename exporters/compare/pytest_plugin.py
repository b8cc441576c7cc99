"""The pytest plugin: the fixture ``render_regression`` compares renders with references.

::

    def test_the_canyon_looks_as_approved(render_regression):
        render_regression("out/canyon_flight/canyon_flight.usda", frames=[1001, 1217])

Given a stage, it renders picture, depth and segmentation; given a folder, it uses the pictures there, from any
renderer. References are in ``render_references/<test file>/<test>`` beside the test; ``pytest --update-renders`` writes
them. ``render_report/<test file>/<test>/index.html`` shows the changes. This module is the pytest side; `compare.py`
defines a change.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from vehsim.exporters.compare.compare import Comparison

REFERENCES, REPORT = "render_references", "render_report"
NO_REFERENCE = "{folder}: no reference pictures; look at {renders}, then write them with pytest --update-renders"


class RenderRegression:
    """Call it with a stage or a folder of pictures; it fails if they differ from their references.

    ``references`` and ``report``: folders of this test; ``update``: write references instead.
    """

    def __init__(self, references: Path, report: Path, renders: Path, update: bool) -> None:
        self.references, self.report, self.renders, self.update = references, report, renders, update
        self.written: list[Path] = []

    def __call__(
        self,
        source: str | Path,
        frames: Iterable[int] | None = None,
        camera: str | Sequence[str] | None = None,
        size: tuple[int, int] = (640, 360),
        passes: Sequence[str] = ("depth", "segmentation"),
        allowed: float | None = None,
    ) -> None:
        """Compare. ``allowed``: the share of colour pixels that may change; depth and segmentation keep their own.

        Raises ``AssertionError`` that names the pictures and the report; ``InputError`` for an unusable source.
        """
        from vehsim.exporters.compare.compare import compare_pictures, pictures_below
        from vehsim.exporters.pictures.frames import render_stage

        source = Path(source)
        renders = source
        if not source.is_dir():
            renders = self.renders / source.stem
            shutil.rmtree(renders, ignore_errors=True)
            render_stage(source, renders, camera=camera, frames=frames, size=size, passes=passes)
        references = self.references / source.stem
        if not self.update and not pictures_below(references):
            raise AssertionError(NO_REFERENCE.format(folder=references, renders=renders))
        paths = sorted({*pictures_below(references), *pictures_below(renders)})
        found = [compare_pictures(renders / path, references / path) for path in paths]
        changed = [comparison for comparison in found if comparison.fails(allowed)]
        if self.update:
            self._write([each.reference.relative_to(references) for each in changed], renders, references)
        elif changed:
            self._fail(changed, len(found), source.stem)

    def _write(self, paths: Iterable[Path], renders: Path, references: Path) -> None:
        """Update the references and their legends; unchanged ones keep their bytes."""
        from vehsim.exporters.pictures.passes import LEGEND, keep_legend

        for path in paths:
            target = references / path
            if not (renders / path).is_file():
                target.unlink()
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(renders / path, target)
            self.written.append(target)
        for legend in renders.rglob(LEGEND):  # names prims of the references that a later stage lacks
            keep_legend(legend.parent, references / legend.parent.relative_to(renders))

    def _fail(self, changed: Sequence[Comparison], count: int, name: str) -> None:
        from vehsim.exporters.compare.report import write_report

        folder = self.report / name
        shutil.rmtree(folder, ignore_errors=True)
        page = write_report(changed, folder, f"{self.report.name}: {name}", count)
        lines = "\n".join(f"  {comparison}" for comparison in changed[:12])
        more = f"\n  and {len(changed) - 12} more" if len(changed) > 12 else ""
        text = f"{len(changed)} of {count} pictures have changed:\n{lines}{more}\nsee {page}"
        raise AssertionError(f"{text}; if this is intended, look at them and run pytest --update-renders")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("vehsim")
    group.addoption("--update-renders", action="store_true", help="write the references of render_regression")
    group.addoption("--render-report", metavar="DIR", help=f"where to show what changed ({REPORT})")


WRITTEN = pytest.StashKey[list[Path]]()


def pytest_configure(config: pytest.Config) -> None:
    config.stash[WRITTEN] = []


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    written = config.stash[WRITTEN]
    if written:
        terminalreporter.write_line(f"{len(written)} reference pictures written; look at them before they are kept")


@pytest.fixture
def render_regression(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[RenderRegression]:
    """Compares a stage's renders, or a folder of pictures, with this test's references."""
    config, file = request.config, Path(request.node.path)
    test = re.sub(r"[^\w.=-]+", "_", request.node.name).strip("_")
    report = Path(config.getoption("--render-report") or config.rootpath / REPORT)
    check = RenderRegression(
        references=file.parent / REFERENCES / file.stem / test,
        report=report / file.stem / test,
        renders=tmp_path_factory.mktemp("renders"),
        update=bool(config.getoption("--update-renders")),
    )
    yield check
    config.stash[WRITTEN].extend(check.written)
