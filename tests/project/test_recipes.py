"""Recipes of CONTRIBUTING name the files that they change."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "lumisplat"


def recipe(title: str) -> str:
    """Returns the text of a section of CONTRIBUTING."""
    return (ROOT / "CONTRIBUTING.md").read_text().split(f"## {title}\n")[1].split("\n## ")[0]


def test_recipe_for_adding_a_light_names_every_file_that_mentions_a_light_type() -> None:
    """The steps name the six files that mention the newest light type, by class, constant or kind."""
    words = re.compile(r"\bLightDisk\b|\bLIGHT_DISK\b|\"disk\"")
    found = {
        path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if words.search(path.read_text("utf-8"))
    }
    named = set(re.findall(r"^\d\. `([\w/]+\.py)`", recipe("Adding a light"), re.MULTILINE))
    assert found == named
    assert len(found) <= 6


def test_recipe_for_adding_a_light_names_every_kernel_file_that_branches_on_light_types() -> None:
    """Lights in a plane need no branch of their own; all others do."""
    words = re.compile(r"[=!]= LIGHT_(?!ENVIRONMENT)[A-Z]+\b")
    found = {
        path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if words.search(path.read_text("utf-8"))
    }
    named = set(re.findall(r"`([\w/]+\.py)`", recipe("Adding a light")))
    assert found <= named, f"not in the recipe: {', '.join(sorted(found - named))}"
    assert len(found) > 2


def test_recipe_for_adding_a_layer_names_every_file_that_mentions_a_layer() -> None:
    """The steps name every file with the name, field or array of a layer."""
    words = re.compile(r"\"reflection\"|\breflection: |\.reflection\b")
    found = {
        path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if words.search(path.read_text("utf-8"))
    }
    named = set(re.findall(r"`([\w/]+\.py)`", recipe("Adding an AOV layer")))
    assert len(found) > 5
    assert found <= named, f"not in the recipe: {', '.join(sorted(found - named))}"
    assert all((SOURCE / name).exists() or (ROOT / name).exists() for name in named)
