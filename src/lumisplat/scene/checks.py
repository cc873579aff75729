"""Checks that the scene dataclasses share. Values come from users, so declared types are not relied on."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import TypeGuard, TypeVar

import numpy as np

from lumisplat.config.checks import is_number, is_whole
from lumisplat.errors import SceneError

_Item = TypeVar("_Item")


def check_kind(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raises a `SceneError` unless ``value`` is an instance of ``kind``; ``expected`` describes it in the message."""
    if not isinstance(value, kind):
        raise SceneError(f"{name} is a {type(value).__name__}, expected {expected}")


def check_argument(function: str, value: object, kind: type, expected: str, hint: str = "") -> None:
    """Raises a `SceneError` unless ``value``, which a function was called with, is an instance of ``kind``."""
    if not isinstance(value, kind):
        raise SceneError(f"{function} takes {expected}, got a {type(value).__name__}{hint}")


def check_flag(name: str, value: object) -> None:
    """Raises a `SceneError` unless ``value`` is a bool, Python's or NumPy's."""
    if not isinstance(value, bool | np.bool_):
        raise SceneError(f"{name} is {value}, expected True or False")


def check_whole(name: str, value: object, low: int, high: int) -> None:
    """Raises a `SceneError` unless ``value`` is an integer with ``low <= value <= high``."""
    if not is_whole(value) or not low <= value <= high:
        raise SceneError(f"{name} is {value}, expected a whole number from {low} to {high:,}")


def check_positive(name: str, value: object) -> None:
    """Raises a `SceneError` unless ``value`` is a finite number above 0."""
    if not is_number(value) or not 0.0 < value < np.inf:
        raise SceneError(f"{name} is {value}, expected a positive number")


def items_of(name: str, values: object) -> Iterable[object]:
    """Returns ``values``, a list that the user gives.

    Raises:
        SceneError: It is a single object instead of a list.
    """
    if not _is_iterable(values):
        raise SceneError(f"{name} is one {type(values).__name__}, expected a list")
    return values


def with_checked(item: _Item, **values: object) -> _Item:
    """A copy of a frozen dataclass with other fields, whose values are known to be right: nothing is checked again."""
    changed = copy.copy(item)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def _is_iterable(values: object) -> TypeGuard[Iterable[object]]:
    return isinstance(values, Iterable)
