"""What a settings class says of its fields: kind, range and help, read off its types, docstrings and checks."""

from __future__ import annotations

import ast
import inspect
import re
import sys
import types
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from enum import Enum
from functools import cache
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from lumisplat.config.setting import settings_of
from lumisplat.viewer.words import label

Kind = Literal["flag", "choice", "whole", "number", "color", "vector", "text", "group"]

_NUMBER = r"(-?\d[\d,]*(?:\.\d+)?(?:e-?\d+)?)"
_RANGE = re.compile(rf"{_NUMBER}(?: \([^)]*\))?\s*(?:\.\.|\bto\b)\s*{_NUMBER}(?![\w^])")
"""``0..1``, ``1 to 256``."""
_MULTIPLE = re.compile(r"\ba multiple of (\d+)")
_AT_LEAST = re.compile(r"\b(?:at least|>=|above|>) (\d+(?:\.\d+)?)")


@dataclass(frozen=True)
class Described:
    """A field as a control shows it."""

    name: str
    kind: Kind
    help: str
    """The docstring below the field, on one line."""
    is_optional: bool = False
    """Whether it may be None, that is automatic."""
    low: float | None = None
    """Least value; None: there is none, or it is not known."""
    high: float | None = None
    """Largest value."""
    choices: tuple[Enum, ...] = ()
    unit: str = ""
    """Of a number, behind its label."""
    step: int = 1
    """A whole number is a multiple of it."""
    group: type | None = None
    """The class of a group of fields."""
    default: Any = None

    @property
    def is_linear(self) -> bool:
        """Whether a colour is linear light; else it is as displays show it."""
        return self.name != "background"

    @property
    def label(self) -> str:
        """The name in words."""
        words = label(self.name)
        return f"{words} ({self.unit})" if self.unit else words


@cache
def described(cls: type) -> tuple[Described, ...]:
    """The fields of a dataclass that a control can show, in their order; others, such as arrays, are left out."""
    hints, helps = get_type_hints(cls), _docstrings(cls)
    declared = {one.name: one for one in settings_of(cls)}
    found: list[Described] = []
    for field in fields(cls):
        default = field.default_factory() if field.default_factory is not MISSING else field.default
        one = _described(field.name, hints[field.name], helps.get(field.name, ""), default)
        if one is not None and (known := declared[field.name]).low is not None:
            one = replace(one, low=known.low, high=known.high, step=known.range.step)
        if one is not None:
            found.append(one)
    return tuple(found)


def _described(name: str, hint: Any, text: str, default: Any) -> Described | None:
    """One field; None: no control can show it."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    rest = [option for option in options if option is not types.NoneType]
    if len(rest) != 1:
        return None
    kind = _kind(name, rest[0])
    if kind is None:
        return None
    low, high = _range(text) if kind in ("whole", "number") else (None, None)
    choices: tuple[Enum, ...] = tuple(rest[0]) if kind == "choice" else ()
    help_text = " ".join(text.split()).replace("``", "").replace("`", "")
    if choices:
        help_text = " ".join([help_text, *_choice_help(rest[0])])
    group = rest[0] if kind == "group" else None
    multiple = _MULTIPLE.search(text) if kind == "whole" else None
    step = int(multiple[1]) if multiple else 1
    return Described(
        name, kind, help_text, len(rest) < len(options), low, high, choices, step=step, group=group, default=default
    )


def _kind(name: str, hint: Any) -> Kind | None:  # noqa: PLR0911
    if hint is bool:
        return "flag"
    if hint is int:
        return "whole"
    if hint is float:
        return "number"
    if hint is str:
        return "text"
    if isinstance(hint, type) and issubclass(hint, Enum):
        return "choice"
    if isinstance(hint, type) and is_dataclass(hint):
        return "group"
    if get_args(hint) == (float, float, float):
        return "color" if name in _COLORS or name.endswith("_color") else "vector"
    return None


_COLORS = ("background", "color", "base_color")


def _range(text: str) -> tuple[float | None, float | None]:
    """The first range that a docstring names."""
    if match := _RANGE.search(text):
        low, high = (float(end.replace(",", "")) for end in match.groups())
        if low < high:
            return low, high
    if match := _AT_LEAST.search(text):
        return float(match[1]), None
    return None, None


def _choice_help(cls: type[Enum]) -> list[str]:
    """What each member of an enum means, shortened to its first clause."""
    helps = _docstrings(cls)
    firsts = {name: " ".join(text.split()).partition(". ")[0].rstrip(".") for name, text in helps.items()}
    return [f"{member.value}: {firsts[member.name]}." for member in cls if member.name in firsts]


@cache
def _docstrings(cls: type) -> dict[str, str]:
    """The docstring below each field or member of a class, and of those that it derives from."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__[:-1]):
        node = _definitions(base.__module__).get(base.__name__)
        if node is None:  # of Python itself, or made without a file
            continue
        for field, after in zip(node.body, node.body[1:], strict=False):
            target = field.target if isinstance(field, ast.AnnAssign) else None
            if isinstance(field, ast.Assign):
                target = field.targets[0]
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else None
            if isinstance(target, ast.Name) and isinstance(text, str):
                found[target.id] = text
    return found


@cache
def _definitions(module: str) -> dict[str, ast.ClassDef]:
    """The classes that a module's source defines, by name; each source is parsed once, as that takes long."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
