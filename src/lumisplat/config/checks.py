"""Checks that settings of all kinds share."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Iterable
from enum import Enum
from typing import TypeGuard, TypeVar, cast

import numpy as np

from lumisplat.errors import ConfigError

_Choice = TypeVar("_Choice", bound=Enum)


def check_range(name: str, value: object, low: float, high: float) -> None:
    """Raises ConfigError unless ``value`` is a number with ``low <= value <= high`` (NaN never is)."""
    if not is_number(value) or not low <= value <= high:
        raise ConfigError(f"{name} is {quoted(value)}, expected {low} to {high}")


def check_between(name: str, value: object, low: float, high: float) -> None:
    """Raises ConfigError unless ``value`` is a number with ``low < value < high``."""
    if not is_number(value) or not low < value < high:
        raise ConfigError(f"{name} is {quoted(value)}, expected more than {low:g} and less than {high:g}")


def check_positive(name: str, value: object) -> None:
    """Raises ConfigError unless ``value`` is a finite number above 0."""
    if not is_number(value) or not 0.0 < value < math.inf:
        raise ConfigError(f"{name} is {quoted(value)}, expected a number above 0")


def check_whole(name: str, value: object, low: int, high: int) -> None:
    """Raises ConfigError unless ``value`` is an integer, Python's or NumPy's, with ``low <= value <= high``."""
    if not is_whole(value) or not low <= value <= high:
        raise ConfigError(f"{name} is {quoted(value)}, expected a whole number from {low} to {high}")


def check_flag(name: str, value: object) -> None:
    """Raises ConfigError unless ``value`` is a bool, Python's or NumPy's."""
    if not is_flag(value):
        raise ConfigError(f"{name} is {quoted(value)}, expected True or False")


def enum_member(name: str, value: object, kind: type[_Choice]) -> _Choice:
    """A member of ``kind``, given as such or by its value: ``Pipeline.TRACE`` or ``"trace"``.

    Raises:
        ConfigError: ``value`` is neither.
    """
    if isinstance(value, kind):
        return value
    if isinstance(value, str):
        for member in kind:
            if member.value == value:
                return member
    raise ConfigError(f"{name} is {quoted(value)}, expected {choices(kind)}")


def take_enum(settings: object, name: str, kind: type[Enum]) -> None:
    """Makes a frozen dataclass's field, which may be given by its value, a member of ``kind``.

    Raises:
        ConfigError: It is none.
    """
    object.__setattr__(settings, name, enum_member(name, getattr(settings, name), kind))


def take_range(settings: object, name: str, low: float, high: float) -> None:
    """Makes a frozen dataclass's field, a pair of numbers, a tuple; the first is the least.

    Raises:
        ConfigError: It is no pair within ``low`` to ``high``.
    """
    pair = _pair(getattr(settings, name))
    if pair is None or not all(is_number(value) and low <= value <= high for value in pair) or pair[0] > pair[1]:
        raise ConfigError(
            f"{name} is {quoted(getattr(settings, name))}, expected the least and the largest value, "
            f"{low:g} to {high:g}"
        )
    object.__setattr__(settings, name, (float(pair[0]), float(pair[1])))


def take_whole_range(settings: object, name: str, low: int, high: int) -> None:
    """As `take_range`, of whole numbers."""
    pair = _pair(getattr(settings, name))
    if pair is None or not all(is_whole(value) and low <= value <= high for value in pair) or pair[0] > pair[1]:
        raise ConfigError(
            f"{name} is {quoted(getattr(settings, name))}, expected the least and the largest number, whole ones from "
            f"{low} to {high}"
        )
    object.__setattr__(settings, name, (int(pair[0]), int(pair[1])))


def take_names(settings: object, name: str) -> None:
    """Makes a frozen dataclass's field, a list of names, a tuple.

    Raises:
        ConfigError: It is something else.
    """
    value = getattr(settings, name)
    names = None if isinstance(value, str) else listed_names(value)
    if names is None:
        raise ConfigError(f"{name} is {quoted(value)}, expected a list of names of files")
    object.__setattr__(settings, name, names)


def _pair(value: object) -> tuple[float, float] | None:
    """Two values; a single number is both."""
    if is_number(value):
        return value, value
    if not isinstance(value, tuple | list) or len(cast(list[object], value)) != 2:
        return None
    first, last = cast(list[float], value)
    return first, last


def choices(kind: type[Enum]) -> str:
    """The values of an enum as a message lists them: ``'raster', 'trace' or 'hybrid'``."""
    *others, last = (f"'{member.value}'" for member in kind)
    return f"{', '.join(others)} or {last}"


def check_kind(name: str, value: object, kind: type) -> None:
    """Raises ConfigError unless ``value`` is a ``kind``."""
    if not isinstance(value, kind):
        raise ConfigError(f"{name} is {quoted(value)}, expected a {kind.__name__}")


def listed_names(value: object) -> tuple[str, ...] | None:
    """Names that are given as a list, or as one text with commas; None: it is neither, or holds something else."""
    if isinstance(value, str):
        return tuple(name.strip() for name in value.split(",") if name.strip())
    names = list(cast(Iterable[object], value)) if isinstance(value, Iterable) else [None]
    texts = [name for name in names if isinstance(name, str)]
    return tuple(texts) if len(texts) == len(names) else None


def suggestion(name: str, known: Iterable[str]) -> str:
    """A hint for an unknown name: the most similar known name, else all known names."""
    near = difflib.get_close_matches(name, list(known), n=1)
    return f"did you mean {near[0]!r}?" if near else f"expected {', '.join(known)}"


def is_number(value: object) -> TypeGuard[float]:
    """Whether ``value`` is one real number, Python's or NumPy's."""
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool)


def is_whole(value: object) -> TypeGuard[int]:
    """Whether ``value`` is an integer, Python's or NumPy's."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def is_flag(value: object) -> TypeGuard[bool]:
    """Whether ``value`` is a bool, Python's or NumPy's."""
    return isinstance(value, bool | np.bool_)


def quoted(value: object) -> str:
    """A value as a message of one line shows it."""
    return str(value) if is_number(value) else " ".join(reprlib.repr(value).split())
