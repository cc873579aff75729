"""Rewrites error messages of the library for pages: names of Python settings become the labels of their controls."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, get_args, get_type_hints

import lumisplat as ls

_FLAGS = {"=True": " on", "=False": " off"}
_CONFIG_FIELD = re.compile(r"\b[A-Z]\w*Config\.((?:\w+\.)*[a-z]\w*)(=True|=False)?\b")
_MEMBER = re.compile(r"\b([A-Z]\w*)\.([A-Z][A-Z0-9_]*)\b")
_WORD = re.compile(r"(?<![\w.'\"/\\-])[a-z]+(?:_[a-z]+)*(?![\w'\"/\\-]|\.\w)")
"""Pattern of a lower-case word, perhaps with underscores, that is neither quoted nor part of a path or file name."""
_OTHERS = {"aovs": "layers", "time_limit": "time limit (s)", "sh_degree": "SH degree"}
"""Control label of each setting whose label differs from its Python name, by that name."""


def label(name: str) -> str:
    """Returns the control label of a setting given as ``group.name`` or ``name``; the label does not name the group."""
    last = name.rpartition(".")[2]
    degrees = last.removesuffix("_degrees")
    return _OTHERS.get(last, degrees.replace("_", " ") + " (°)" * (degrees != last))


def page_words(message: str) -> str:
    """Returns a message with Python names replaced by the labels of their controls.

    ``Pipeline.HYBRID`` becomes *pipeline hybrid*, ``RenderConfig.lighting=True`` *lighting on*, ``time_limit`` *time
    limit*, so that users find the control to change.

    Args:
        message: Message of one line.
    """
    labels, names = _choices(), _names()

    def choice(found: re.Match[str]) -> str:
        kind = labels.get(found[1])
        if kind is None or found[2] not in kind[1].__members__:
            return found[0]
        return f"{kind[0]} {kind[1][found[2]].value}"

    message = _CONFIG_FIELD.sub(lambda found: label(found[1]) + _FLAGS.get(found[2] or "", ""), message)
    message = _MEMBER.sub(choice, message)
    return _WORD.sub(lambda word: names.get(word[0], word[0]), message)


@cache
def _choices() -> dict[str, tuple[str, type[Enum]]]:
    """Returns the enums that settings use, by class name, each with the label of the setting that uses it."""
    kinds: dict[str, tuple[str, type[Enum]]] = {}
    for name, kind in _settings(ls.RenderConfig):
        if isinstance(kind, type) and issubclass(kind, Enum):
            kinds.setdefault(kind.__name__, (label(name), kind))
    return kinds


@cache
def _names() -> dict[str, str]:
    """Returns the control label by Python name, for settings whose label differs from the name."""
    return {name: label(name) for name, _ in _settings(ls.RenderConfig) if "_" in name or name in _OTHERS}


def _settings(cls: type[Any]) -> Iterator[tuple[str, object]]:
    """Yields name and type of each setting of a settings class and, recursively, of its groups."""
    hints = get_type_hints(cls)
    for field in fields(cls):
        options = [one for one in get_args(hints[field.name]) or (hints[field.name],) if one is not type(None)]
        yield field.name, options[0]
        if isinstance(options[0], type) and is_dataclass(options[0]):
            yield from _settings(options[0])
