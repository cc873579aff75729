"""The pages of the method and the sources point to each other: what is cited exists."""

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
    """Every source, test and page of ours."""
    for folder, pattern in (
        *((name, "*.py") for name in ("src", "tests", "bench", "tools", "examples")),
        *(("docs", name) for name in ("*.md", "adr/*.md", "guide/*.md", "method/*.md")),
    ):
        files = (ROOT / folder).glob(pattern) if pattern.endswith(".md") else (ROOT / folder).rglob(pattern)
        yield from ((path, path.read_text()) for path in sorted(files))
    for path in sorted(ROOT.glob("*.md")):
        yield path, path.read_text()


def anchors(page: Path) -> set[str]:
    """Headings of a page as its links spell them, and labels of its equations."""
    text = page.read_text()
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).strip().lower().replace(" ", "-") for heading in headings} | {
        *LABEL.findall(text)
    }


def test_citations_of_the_method_lead_somewhere() -> None:
    """Each page of docs/method that a source names exists, and its anchor is a heading or an equation on it."""
    known = {page.name: anchors(page) for page in METHOD}
    found = [(path, *match.groups()) for path, text in texts() for match in CITED.finditer(text)]
    assert len(found) > 30
    lost = [
        f"{path.relative_to(ROOT)}: {page}#{anchor}"
        for path, page, anchor in found
        if page not in known or (anchor and anchor not in known[page])
    ]
    assert not lost


def test_files_that_are_named_exist() -> None:
    """Each path of a page, test, benchmark or tool in sources and docs is there."""
    named = [(path, name) for path, text in texts() for name in NAMED.findall(text)]
    assert len(named) > 50
    assert not [f"{path.relative_to(ROOT)}: {name}" for path, name in named if not any(ROOT.glob(name))]


@pytest.mark.parametrize(
    "page", [*METHOD, ROOT / "CONTRIBUTING.md", ROOT / "docs" / "architecture.md"], ids=lambda page: page.stem
)
def test_pages_name_files_of_the_package(page: Path) -> None:
    """Each page says where things are in the code, from the package's folder or the root, and all of it exists."""
    named = re.findall(r"`((?:[\w-]+/)+[\w-]*(?:\.py|\.md)?)`", page.read_text())
    assert named
    places = [ROOT / "src" / "lumisplat", ROOT]
    assert not [name for name in named if not any((place / name).exists() for place in places)]


def test_equations_have_one_name() -> None:
    """Labels of equations are unique over all pages, and every reference to one is to a label."""
    labels = [label for page in METHOD for label in LABEL.findall(page.read_text())]
    assert len(labels) == len(set(labels)) > 50
    referred = {name for page in METHOD for name in re.findall(r"\{eq\}`([\w-]+)`", page.read_text())}
    assert referred <= set(labels)
