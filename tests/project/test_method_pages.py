"""Pages of the method and source files cite each other: every citation exists."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
METHOD = sorted((ROOT / "docs" / "method").glob("*.md"))
CITED = re.compile(r"docs/method/(\w+\.md)(?:#([\w-]+))?")
NAMED = re.compile(r"(?<![\w/.])((?:docs|tests|bench|tools|examples)/[\w/.*-]+\.(?:md|py|npz))")
LABEL = re.compile(r"^\$\$ \(([\w-]+)\)$", re.MULTILINE)


def texts() -> Iterator[tuple[Path, str]]:
    """Returns the text of every source, test and page."""
    for folder, pattern in (
        *((name, "*.py") for name in ("src", "tests", "bench", "tools", "examples")),
        *(("docs", name) for name in ("*.md", "adr/*.md", "guide/*.md", "method/*.md")),
    ):
        files = (ROOT / folder).glob(pattern) if pattern.endswith(".md") else (ROOT / folder).rglob(pattern)
        yield from ((path, path.read_text()) for path in sorted(files))
    for path in sorted(ROOT.glob("*.md")):
        yield path, path.read_text()


def anchors(page: Path) -> set[str]:
    """Returns the headings of a page as links spell them, and the labels of its equations."""
    text = page.read_text()
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings} | {
        *LABEL.findall(text)
    }


def test_cited_method_pages_and_anchors_exist() -> None:
    """An anchor is a heading or an equation of a page of docs/method."""
    page_anchors = {page.name: anchors(page) for page in METHOD}
    found = [(path, *match.groups()) for path, text in texts() for match in CITED.finditer(text)]
    assert len(found) > 30
    lost = [
        f"{path.relative_to(ROOT)}: {page}#{anchor}"
        for path, page, anchor in found
        if page not in page_anchors or (anchor and anchor not in page_anchors[page])
    ]
    assert not lost


def test_files_named_in_sources_and_docs_exist() -> None:
    """The files are pages, tests, benchmarks and tools."""
    named = [(path, name) for path, text in texts() for name in NAMED.findall(text)]
    assert len(named) > 50
    assert not [f"{path.relative_to(ROOT)}: {name}" for path, name in named if not any(ROOT.glob(name))]


@pytest.mark.parametrize(
    "page", [*METHOD, ROOT / "CONTRIBUTING.md", ROOT / "docs" / "architecture.md"], ids=lambda page: page.stem
)
def test_method_pages_name_existing_source_files(page: Path) -> None:
    """Paths are relative to the package or the root of the repository."""
    named = re.findall(r"`((?:[\w-]+/)+[\w-]*(?:\.py|\.md)?)`", page.read_text())
    assert named
    folders = [ROOT / "src" / "lumisplat", ROOT]
    assert not [name for name in named if not any((folder / name).exists() for folder in folders)]


def test_equation_labels_of_method_pages_are_unique_and_referenced() -> None:
    """Labels are unique over all pages, and every reference has a label."""
    labels = [label for page in METHOD for label in LABEL.findall(page.read_text())]
    assert len(labels) == len(set(labels)) > 50
    referred = {name for page in METHOD for name in re.findall(r"\{eq\}`([\w-]+)`", page.read_text())}
    assert referred <= set(labels)
