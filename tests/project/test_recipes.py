"""Recipes of CONTRIBUTING name the files that they touch."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "lumisplat"


def recipe(title: str) -> str:
    """The text of a section of CONTRIBUTING."""
    return (ROOT / "CONTRIBUTING.md").read_text().split(f"## {title}\n")[1].split("\n## ")[0]


def test_the_recipe_for_lights_names_every_file_that_knows_a_type_of_light() -> None:
    """The numbered steps name the six files in which the newest type stands, by class, constant or kind."""
    words = re.compile(r"\bLightDisk\b|\bLIGHT_DISK\b|\"disk\"")
    found = {
        path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if words.search(path.read_text("utf-8"))
    }
    named = set(re.findall(r"^\d\. `([\w/]+\.py)`", recipe("Adding a light"), re.MULTILINE))
    assert found == named
    assert len(found) <= 6


def test_the_recipe_for_layers_names_every_file_of_a_layer() -> None:
    """Every file with the name, the field or the array of a layer that all steps are about."""
    words = re.compile(r"\"reflection\"|\breflection: |\.reflection\b")
    found = {
        path.relative_to(SOURCE).as_posix() for path in SOURCE.rglob("*.py") if words.search(path.read_text("utf-8"))
    }
    named = set(re.findall(r"`([\w/]+\.py)`", recipe("Adding an AOV layer")))
    assert len(found) > 5
    assert found <= named, f"not in the recipe: {', '.join(sorted(found - named))}"
    assert all((SOURCE / name).exists() or (ROOT / name).exists() for name in named)
