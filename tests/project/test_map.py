"""The map in docs/architecture.md names the folders of the package, down to two levels."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def folders_of_tree(package: Path) -> set[str]:
    """Returns the folders with modules, such as ``io/`` and ``io/gltf/``."""
    files = [path.relative_to(package) for path in package.rglob("*.py")]
    return {f"{'/'.join(path.parts[:depth])}/" for path in files for depth in (1, 2) if len(path.parts) > depth}


def folders_of_map(page: str) -> set[str]:
    """Returns the folders at the start of the map's lines; indented ones belong to the last folder that is not."""
    found: set[str] = set()
    top = ""
    for indent, names in re.findall(r"^(|  )((?:[a-z_]+/(?: +|$))+)", page, re.MULTILINE):
        top = "" if not indent else top
        found |= {f"{top}{name}" for name in names.split()}
        top = top or names.split()[-1]
    return found


def test_architecture_map_names_every_folder_of_the_package() -> None:
    """The map has exactly the folders of the first two levels."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    shown = folders_of_map(page.partition("## The map")[2].split("```")[1])
    there = folders_of_tree(ROOT / "src" / "lumisplat")
    missing, gone = sorted(there - shown), sorted(shown - there)
    assert not missing, f"docs/architecture.md's map lacks {', '.join(missing)}: add a line that says what lives there"
    assert not gone, f"docs/architecture.md's map names {', '.join(gone)}, which the package has not: remove them"


def test_reader_of_the_architecture_map_finds_nested_folders() -> None:
    """The reader finds several folders on one line, but not the text after them."""
    page = "io/        files\n  gltf/ usd/\n  ply.py    a module\n           and usd/ again\nmath/   numbers\n"
    assert folders_of_map(page) == {"io/", "io/gltf/", "io/usd/", "math/"}
