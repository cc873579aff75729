"""Checks that all scene dataclasses use. Field values come from users, so their types are not trusted."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeGuard, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import Range, plain, quoted
from lumisplat.config.setting import take_fields
from lumisplat.errors import SceneError
from lumisplat.math.arrays import host_array

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Item = TypeVar("_Item")

Vector = tuple[float, float, float]


def check_kind(name: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    """Raises a `SceneError` unless ``value`` is an instance of ``kind``; ``expected`` names ``kind`` in the message."""
    if not isinstance(value, kind):
        raise SceneError(f"{name} is a {type(value).__name__}, expected {expected}")


def check_argument(function: str, value: object, kind: type, expected: str, hint: str = "") -> None:
    """Raises a `SceneError`, ending in ``hint``, unless ``value``, an argument of ``function``, is a ``kind``.

    ``expected`` names ``kind`` in the message.
    """
    if not isinstance(value, kind):
        raise SceneError(f"{function} takes {expected}, got a {type(value).__name__}{hint}")


def check_whole(name: str, value: object, low: int, high: int) -> int:
    """Returns ``value`` as a Python integer with ``low <= value <= high``, or raises a `SceneError`."""
    return Range(low, high).taken(name, value, int, SceneError)


def check_positive(name: str, value: object) -> float:
    """Returns ``value`` as a finite Python float above 0, or raises a `SceneError`."""
    return Range(0.0, above=True).taken(name, value, float, SceneError)


def take_scene_fields(item: DataclassInstance, prefix: str = "") -> None:
    """Converts and checks the fields of a new dataclass object by their annotations, see `take_fields`.

    Raises:
        SceneError: A value does not fit its field.
    """
    take_fields(item, prefix, SceneError)


class LinearColor:
    """Converter to (red, green, blue), linear Rec.709, from three numbers or from one number for all channels.

    Args:
        high: Largest value of a channel.
    """

    kind = "color"

    def __init__(self, high: float = math.inf) -> None:
        self._range = Range(0.0, high)

    def __call__(self, value: npt.ArrayLike, name: str = "color") -> Vector:
        """Returns the red, green and blue channels of the colour ``value``.

        Raises:
            SceneError: The value is neither one nor three numbers, or a channel is out of range.
        """
        single: Any = plain(value)
        values: Any = (single,) * 3 if type(single) in (int, float) else host_array(single)
        if hasattr(values, "__array__") and np.ndim(values) == 1:
            values = np.asarray(values).tolist()
        channels = list(cast(Sequence[Any], values)) if isinstance(values, Sequence) else []
        numbers = [plain(one) for one in channels]
        if len(numbers) != 3 or not all(type(one) in (int, float) and self._range.holds(one) for one in numbers):
            bound = f"in 0..{self._range.high:g}" if math.isfinite(self._range.high) else "of at least 0"
            raise SceneError(f"{name} is {quoted(value)}, expected three numbers {bound}")
        return float(numbers[0]), float(numbers[1]), float(numbers[2])


class OptionalColor:
    """Converter like `LinearColor` of colours in 0..1 that also accepts None."""

    kind = "color"

    def __call__(self, value: npt.ArrayLike | None, name: str = "color") -> Vector | None:
        """Returns the channels of the colour ``value``, or None for None; raises a SceneError for invalid colours."""
        return None if value is None else UNIT_COLOR(value, name)


COLOR, UNIT_COLOR = LinearColor(), LinearColor(1.0)
"""Converters of linear colours with channels of at least 0 (`COLOR`), and of colours in 0..1 (`UNIT_COLOR`)."""


def items_of(name: str, values: object) -> Iterable[object]:
    """Returns ``values`` unchanged if they are iterable, such as a list.

    Raises:
        SceneError: ``values`` is a single object; the message calls the argument ``name``.
    """
    if not _is_iterable(values):
        raise SceneError(f"{name} is a {type(values).__name__}, expected a list")
    return values


def with_checked(item: _Item, **values: object) -> _Item:
    """Copies a frozen dataclass with fields replaced by ``values``. No check runs, so ``values`` must be valid."""
    changed = copy.copy(item)
    for name, value in values.items():
        object.__setattr__(changed, name, value)
    return changed


def _is_iterable(values: object) -> TypeGuard[Iterable[object]]:
    return isinstance(values, Iterable)
