"""Writes docs/settings.md: every setting with its values, unit, default and help, from the declarations.

``python tools/make_settings_page.py``; a test compares the page with the declarations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING
from enum import Enum
from pathlib import Path
from typing import Any

from lumisplat import config
from lumisplat.config.setting import Setting, all_settings

PAGE = Path(__file__).resolve().parents[1] / "docs" / "settings.md"
TABLES: tuple[tuple[str, type], ...] = (
    ("Rendering: `RenderConfig`, the table `[render]` of a scene file", config.RenderConfig),
    ("Light of actors: `AvatarLightingConfig`, the table `[animation.lighting]`", config.AvatarLightingConfig),
    ("Data sets: `DatasetConfig`", config.DatasetConfig),
    ("Training: `TrainConfig`", config.TrainConfig),
    ("Materials found from images: `MaterialsConfig`", config.MaterialsConfig),
    ("Materials and light of a capture alone: `DelightConfig`", config.DelightConfig),
)
"""Titles of the tables and their classes."""
HEAD = """# Settings

<!-- Written by tools/make_settings_page.py from the declarations in src/lumisplat/config. -->

Every setting by its name in Python, in the tables of a scene file and after `--set`. The value `auto` is `None` in
Python. Programs read the same declarations by `lumisplat.config.setting`, as in
`all_settings(RenderConfig)["trace.hits_per_pass"]`.
"""


def page() -> str:
    """Returns the text of the page."""
    return "\n".join([HEAD, *(line for title, kind in TABLES for line in _table(title, kind))]).rstrip() + "\n"


def _table(title: str, kind: type) -> Iterator[str]:
    yield f"## {title}"
    yield ""
    yield "| setting | values | default | |"
    yield "| --- | --- | --- | --- |"
    for name, one in all_settings(kind).items():
        cells = (f"`{name}`", _values(one), _value(one, one.default), one.help.replace("|", "\\|"))
        yield f"| {' | '.join(cells)} |"
    yield ""


def _values(one: Setting) -> str:
    """Returns the allowed values of a setting."""
    texts = {
        "color": "a colour",
        "names": "names",
        "text": "a text",
        "vector": "three numbers",
        "flag": "true or false",
        "choice": ", ".join(f"`{choice.value}`" for choice in one.choices),
    }
    unit = f" {one.range.unit}" if one.range.unit else ""
    auto = f", or `{_value(one, None)}`" if one.is_optional else ""
    return texts.get(one.kind, one.expected) + unit + auto


def _value(one: Setting, value: Any) -> str:
    """Returns a value as a scene file has it."""
    if value is MISSING:
        return ""
    if value is None:
        return "none" if one.kind == "color" else "auto"
    if isinstance(value, tuple):
        return ", ".join(_value(one, part) for part in value)
    if isinstance(value, Enum):
        return str(value.value)
    return str(value).lower() if isinstance(value, bool) else f"{value:g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
