"""Checks of single values, shared by settings, scenes and functions. Values come from users and may have any type."""

from __future__ import annotations

import difflib
import math
import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeGuard, TypeVar, cast

import numpy as np

from lumisplat.errors import ConfigError, LumisplatError

_Choice = TypeVar("_Choice", bound=Enum)
_Kind = TypeVar("_Kind")

FLOAT32_MAX = float(np.finfo(np.float32).max)
"""Largest finite float32, the number type of the kernels."""


def plain(value: Any) -> Any:  # noqa: PLR0911
    """Returns NumPy scalars and zero-dimensional arrays as Python numbers, and other values unchanged."""
    if type(value) in _PLAIN:
        return value
    if isinstance(value, np.bool_):
        return bool(cast(Any, value))
    if isinstance(value, np.integer | int):
        return int(cast(int, value))
    if isinstance(value, np.floating | float):
        return float(cast(float, value))
    if getattr(value, "shape", None) == () and (hasattr(value, "__array__") or hasattr(value, "__dlpack__")):
        try:
            array = np.asarray(value) if hasattr(value, "__array__") else np.from_dlpack(value)
        except (BufferError, RuntimeError, TypeError, ValueError):  # the array is on a GPU
            return value
        return plain(array[()]) if array.dtype.kind in "biuf" else value
    return value


_PLAIN = (bool, int, float, str, tuple, list, type(None))


def refusal(error: type[LumisplatError], name: str, value: object, expected: str) -> LumisplatError:
    """Returns an error that refuses a value; ``setting`` is the last word of ``name``, such as ``width``.

    Args:
        error: Type of the error.
        name: Name of the setting, field or parameter, as the message begins with it: ``camera width``.
        value: The refused value.
        expected: The rest of the message, such as ``expected a whole number``.
    """
    refused = error(f"{name} is {quoted(value)}, {expected}")
    refused.setting = name.rpartition(" ")[2]
    return refused


def is_number(value: object) -> TypeGuard[float]:
    """Returns whether ``value`` is a real number: Python's, NumPy's, or a zero-dimensional array."""
    return type(plain(value)) in (int, float)


def is_whole(value: object) -> TypeGuard[int]:
    """Returns whether ``value`` is an integer: Python's, NumPy's, or a zero-dimensional array."""
    return type(plain(value)) is int


def is_flag(value: object) -> TypeGuard[bool]:
    """Returns whether ``value`` is a bool: Python's, NumPy's, or a zero-dimensional array."""
    return type(plain(value)) is bool


@dataclass(frozen=True, slots=True)
class Range:
    """Range of the numbers that a field accepts.

    An ``int`` field accepts only integers, and both numbers of a pair must be in the range.
    """

    low: float = -math.inf
    """Smallest accepted number, or the limit below it if ``above`` is set; -inf for no limit."""
    high: float = math.inf
    """Largest accepted number, or the limit above it if ``below`` is set; inf for no limit. Numbers beyond the range
    of float32, the type of the kernels, are refused in any case, except where ``infinite`` is set."""
    unit: str = ""
    """Unit of the numbers, as messages name it, such as ``degrees``; empty for numbers without a unit."""
    above: bool = False
    """True if ``low`` itself is excluded."""
    below: bool = False
    """True if ``high`` itself is excluded."""
    step: int = 1
    """Number of which accepted integers are multiples; 1 accepts every integer."""
    infinite: bool = False
    """True if numbers beyond the range of float32, such as infinity, are accepted, too."""

    def holds(self, number: float) -> bool:
        """Returns whether a number is accepted: within the limits, a multiple of ``step``, and not NaN."""
        if not (self.low < number if self.above else self.low <= number):
            return False
        if not (number < self.high if self.below else number <= self.high):
            return False
        return (self.infinite or abs(number) <= FLOAT32_MAX) and (self.step == 1 or number % self.step == 0)

    def expected(self, kind: type = float) -> str:
        """Returns the range in the words of messages and tables: ``a whole number from 1 to 64``."""
        low, high = (kind(end) if math.isfinite(end) else end for end in (self.low, self.high))
        if kind is int:
            multiple = f", a multiple of {self.step}" if self.step > 1 else ""
            ends = f" from {low} to {high}" if math.isfinite(high) else f", at least {low}"
            return f"a whole number{ends if math.isfinite(low) else ''}{multiple}"
        if math.isfinite(high):
            if not (self.above or self.below):
                return f"{_short(low)} to {_short(high)}"
            first, last = "more than" if self.above else "at least", "less than" if self.below else "at most"
            return f"{first} {low:g} and {last} {high:g}"
        if not math.isfinite(low):
            return "a finite number"
        return f"a number {'above' if self.above else 'at least'} {low:g}{', or inf' if self.infinite else ''}"

    def taken(self, name: str, value: Any, kind: type, error: type[LumisplatError] = ConfigError) -> Any:
        """Converts a value to a Python number of ``kind``, ``int`` or ``float``, and checks that the range accepts it.

        Raises:
            LumisplatError: The value is not a number of that kind, or is outside the range; the error is of type
                ``error``.
        """
        if type(value) is kind and self.holds(value):  # the usual case, which must be fast: cameras are made in loops
            return value
        number = plain(value)
        is_kind = type(number) is int or (kind is float and type(number) is float)
        if not is_kind or not self.holds(number):
            unit = f" ({self.unit})" if self.unit else ""
            raise refusal(error, name, value, f"expected {self.expected(kind)}{unit}")
        return kind(number)


def _short(number: float) -> str:
    """Returns a number as text, with at most seven digits unless it is short."""
    return str(number) if len(str(number)) <= 12 else f"{number:.7g}"


@dataclass(frozen=True, slots=True)
class OneOf:
    """Lists the only values that a field accepts: a few integers, or some members of an enum."""

    values: tuple[int, ...] | tuple[Enum, ...]
    """The accepted values."""

    def expected(self, kind: type = int) -> str:
        """Returns the integers in the words of messages: ``4, 8 or 16``."""
        *others, last = map(str, self.values)
        return f"{', '.join(others)} or {last}"

    def taken(self, name: str, value: object, kind: type, error: type[LumisplatError] = ConfigError) -> int:
        """Converts a value to a Python integer, and checks that it is one of ``values``.

        Raises:
            LumisplatError: The value is none of the integers; the error is of type ``error``.
        """
        number = plain(value)
        if type(number) is not int or number not in self.values:
            raise refusal(error, name, value, f"expected {self.expected()}")
        return number


def check_range(name: str, value: object, low: float, high: float, error: type[LumisplatError] = ConfigError) -> float:
    """Returns a number with ``low <= value <= high`` as a Python number.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    return Range(low, high).taken(name, value, float, error)


def check_positive(name: str, value: object, error: type[LumisplatError] = ConfigError) -> float:
    """Returns a finite number above 0 as a Python number.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    return Range(0.0, above=True).taken(name, value, float, error)


def check_whole(name: str, value: object, low: int, high: int, error: type[LumisplatError] = ConfigError) -> int:
    """Returns an integer with ``low <= value <= high`` as a Python number.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    return Range(low, high).taken(name, value, int, error)


def check_flag(name: str, value: object, error: type[LumisplatError] = ConfigError) -> bool:
    """Returns a bool of Python or NumPy as Python's.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    flag = plain(value)
    if type(flag) is not bool:
        raise refusal(error, name, value, "expected True or False")
    return flag


def check_text(name: str, value: object, error: type[LumisplatError] = ConfigError) -> str:
    """Returns ``value`` if it is a text.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    if not isinstance(value, str):
        raise refusal(error, name, value, "expected a text")
    return value


def check_kind(name: str, value: object, kind: type[_Kind], error: type[LumisplatError] = ConfigError) -> _Kind:
    """Returns ``value`` if it is an instance of ``kind``.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOU" else "a"
        raise refusal(error, name, value, f"expected {article} {kind.__name__}")
    return value


def enum_member(
    name: str, value: object, members: Iterable[_Choice], error: type[LumisplatError] = ConfigError
) -> _Choice:
    """Returns the member of an enum that ``value`` is or names: ``Pipeline.TRACE`` for itself and for ``"trace"``.

    Raises:
        LumisplatError: ``value`` is anything else.
    """
    for member in members:
        if value is member or (isinstance(value, str) and member.value == value):
            return member
    raise refusal(error, name, value, f"expected {choices(members)}")


def choices(members: Iterable[Enum]) -> str:
    """Returns the values of an enum's members in the words of messages: ``'raster', 'trace' or 'hybrid'``."""
    *others, last = (f"'{member.value}'" for member in members)
    return f"{', '.join(others)} or {last}"


def listed_names(value: object) -> tuple[str, ...] | None:
    """Returns names from a list of texts, or from a text with commas; None if the value is neither."""
    if isinstance(value, str):
        return tuple(name.strip() for name in value.split(",") if name.strip())
    names = list(cast(Iterable[object], value)) if isinstance(value, Iterable) else [None]
    texts = [name for name in names if isinstance(name, str)]
    return tuple(texts) if len(texts) == len(names) else None


RENAMED_SETTINGS = {"lamps": "points", "lamp_lux": "point_lux", "sky": "ambient", "sky_steps": "environment_steps"}
"""Present name of each setting that was renamed, by its former name; only error messages suggest it."""


def suggestion(name: str, names: Iterable[str]) -> str:
    """Returns advice for an unknown name: its present name if renamed, else the most similar name, else all names."""
    names = list(names)
    if RENAMED_SETTINGS.get(name) in names:
        return f"it is called {RENAMED_SETTINGS[name]!r} now"
    near = difflib.get_close_matches(name, names, n=1)
    near = near or [one for one in names if len(name) > 2 and one.startswith(name)]
    return f"did you mean {near[0]!r}?" if near else f"expected {', '.join(names)}"


def quoted(value: object) -> str:
    """Returns a value as error messages show it: numbers in full, other values as a ``repr`` shortened to one line."""
    return str(value) if is_number(value) else " ".join(reprlib.repr(value).split())


Color = tuple[float, float, float]

NO_COLOR = ("transparent", "none")
"""Texts that `display_color` turns into None, which means no colour: a transparent background, for example."""


class DisplayColor:
    """Converts values of dataclass fields to display-referred sRGB by `display_color`; a ``converter`` of `given`."""

    kind = "color"
    is_linear = False

    def __call__(self, value: str | Iterable[float] | None, name: str = "color") -> Color | None:
        """Returns a field's value as display-referred sRGB colour, channels 0..1; None if it means no colour."""
        return display_color(name, value)


def display_color(name: str, value: object) -> Color | None:
    """Returns a display-referred sRGB colour with channels in 0..1, or None for no colour.

    Args:
        name: Name of the colour, for messages.
        value: Three numbers in 0..1; a text with three numbers, ``"#ff8800"``, ``"#f80"``, a CSS name such as
            ``"white"``, ``"transparent"`` or ``"none"``; or None.

    Raises:
        ConfigError: ``value`` is anything else.
    """
    if value is None or (isinstance(value, str) and value.strip().lower() in NO_COLOR):
        return None
    parts = _color_from_text(value) if isinstance(value, str) else _color_from_numbers(value)
    if parts is None:
        expected = "expected three numbers in 0..1, '#ff8800', a name such as 'white', or 'transparent'"
        raise refusal(ConfigError, name, value, expected)
    return parts


def _color_from_numbers(value: object) -> Color | None:
    """Returns three numbers in 0..1 as a colour; None if the value is anything else."""
    if not isinstance(value, Iterable):
        return None
    parts = list(cast(Iterable[object], value))
    numbers = [float(part) for part in parts if is_number(part) and 0.0 <= part <= 1.0]
    if not len(numbers) == len(parts) == 3:
        return None
    red, green, blue = numbers
    return red, green, blue


def _color_from_text(text: str) -> Color | None:
    """Returns the colour of a text such as ``"#ff8800"``, ``"white"`` or three numbers; None if it is none of these."""
    from PIL import ImageColor

    try:
        return _color_from_numbers([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        pass
    try:
        channels = ImageColor.getrgb(text.strip())
    except ValueError:
        return None
    return _color_from_numbers([channel / 255.0 for channel in channels])  # None for four channels, a colour with alpha
