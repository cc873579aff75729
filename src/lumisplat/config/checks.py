"""Checks that settings of all kinds share."""

from __future__ import annotations

import reprlib
from enum import Enum
from typing import TypeGuard

import numpy as np

from lumisplat.errors import ConfigError


def check_range(name: str, value: object, low: float, high: float) -> None:
    """Raises ConfigError unless ``value`` is a number with ``low <= value <= high`` (NaN never is)."""
    if not is_number(value) or not low <= value <= high:
        raise ConfigError(f"{name} is {quoted(value)}, expected {low} to {high}")


def check_whole(name: str, value: object, low: int, high: int) -> None:
    """Raises ConfigError unless ``value`` is an integer, Python's or NumPy's, with ``low <= value <= high``."""
    if not is_whole(value) or not low <= value <= high:
        raise ConfigError(f"{name} is {quoted(value)}, expected a whole number from {low} to {high}")


def check_flag(name: str, value: object) -> None:
    """Raises ConfigError unless ``value`` is a bool, Python's or NumPy's."""
    if not isinstance(value, bool | np.bool_):
        raise ConfigError(f"{name} is {quoted(value)}, expected True or False")


def check_enum(name: str, value: object, kind: type[Enum]) -> None:
    """Raises ConfigError unless ``value`` is a member of ``kind``; the message names the one of that value, if any."""
    if not isinstance(value, kind):
        meant = {member.value: member for member in kind}.get(str(value), next(iter(kind)))
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise ConfigError(f"{name} is {quoted(value)}, expected {article} {kind.__name__} such as {meant}")


def check_kind(name: str, value: object, kind: type) -> None:
    """Raises ConfigError unless ``value`` is a ``kind``."""
    if not isinstance(value, kind):
        raise ConfigError(f"{name} is {quoted(value)}, expected a {kind.__name__}")


def is_number(value: object) -> TypeGuard[float]:
    """Whether ``value`` is one real number, Python's or NumPy's."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def is_whole(value: object) -> TypeGuard[int]:
    """Whether ``value`` is an integer, Python's or NumPy's."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def quoted(value: object) -> str:
    """A value as a message of one line shows it."""
    return str(value) if is_number(value) else " ".join(reprlib.repr(value).split())
