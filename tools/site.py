"""Hooks of the documentation site: texts elsewhere in the repository become pages, and links are adapted.

README.md is the front page, examples/ becomes one page of shots, and files outside docs/ to which pages link are added.
"""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(\]\()([^)\s#:]+)(#[^)\s]*)?\)")
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
OUTSIDE = ("CHANGELOG.md", "CONTRIBUTING.md", "LICENSE", "benchmarks/*.md", "benchmarks/figures/*", "examples/*")
"""Files outside docs/ that the site contains."""
PAGES = {"README.md": "index.md", "examples": "examples.md"}
"""Pages with another name: path in the repository -> path in the site."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Pages and files that come from outside docs/."""
    files.append(File.generated(config, "index.md", content=(ROOT / "README.md").read_text(encoding="utf-8")))
    files.append(File.generated(config, "examples.md", content=_examples()))
    for path in sorted(found for pattern in OUTSIDE for found in ROOT.glob(pattern) if found.is_file()):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Convert links within the repository to links within the site; snippets stay unchanged."""
    pieces, end = [], 0
    for fence in FENCE.finditer(markdown):
        pieces += [_linked(markdown[end : fence.start()], page.file.src_uri, files), fence[0]]
        end = fence.end()
    return "".join([*pieces, _linked(markdown[end:], page.file.src_uri, files)])


def _linked(text: str, page: str, files: Files) -> str:
    folder = {"index.md": ROOT, "examples.md": ROOT / "examples"}.get(page) or _source(page).parent

    def follow(match: re.Match[str]) -> str:
        target = (folder / match[2]).resolve()
        if not target.is_relative_to(ROOT) or not target.exists():
            return match[0]  # MkDocs reports what is wrong with it
        where = target.relative_to(ROOT).as_posix()
        where = PAGES.get(where, where.removeprefix("docs/"))
        if files.get_file_from_path(where) is None:  # only in the repository, not in the site
            return f"{match[1]}#)" if target.is_dir() else match[0]
        up = "../" * page.count("/")
        return f"{match[1]}{up}{where}{match[3] or ''})"

    return LINK.sub(follow, text)


def _source(page: str) -> Path:
    """The path in the repository of a page of the site."""
    return ROOT / "docs" / page if (ROOT / "docs" / page).exists() else ROOT / page


def _examples() -> str:
    """Every shot and script of examples/, unchanged."""
    parts = ["# Examples\n\nEvery shot as it stands: `vehsim export examples/NAME.toml --out out`.\n"]
    for path in sorted(ROOT.glob("examples/*")):
        if path.suffix in (".toml", ".py"):
            language = "toml" if path.suffix == ".toml" else "python"
            parts.append(f"\n## {path.name}\n```{language}\n{path.read_text(encoding='utf-8')}```\n")
    return "".join(parts)
