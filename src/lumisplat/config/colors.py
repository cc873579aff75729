"""Colours that a user gives: as numbers, as ``"#ff8800"`` or by a name."""

from __future__ import annotations

from collections.abc import Iterable
from typing import cast

from lumisplat.config.checks import is_number, quoted
from lumisplat.errors import ConfigError

Color = tuple[float, float, float]

NO_COLOR = ("transparent", "none")
"""Words for no colour at all."""


def display_color(name: str, value: object) -> Color | None:
    """Display-referred sRGB, 0..1 each, or None for no colour.

    Args:
        name: What the colour is of, for messages.
        value: Three numbers in 0..1; or a text: three numbers with commas or spaces, ``"#ff8800"``, ``"#f80"``, a name
            of CSS such as ``"white"``, ``"transparent"`` or ``"none"``; or None.

    Raises:
        ConfigError: It is none of these.
    """
    if value is None or (isinstance(value, str) and value.strip().lower() in NO_COLOR):
        return None
    parts = _of_text(value) if isinstance(value, str) else _of_numbers(value)
    if parts is None:
        raise ConfigError(
            f"{name} is {quoted(value)}, expected three numbers in 0..1, '#ff8800', a name such as 'white', "
            "or 'transparent'"
        )
    return parts


def _of_numbers(value: object) -> Color | None:
    """Three numbers in 0..1; None: it is something else."""
    if not isinstance(value, Iterable):
        return None
    parts = list(cast(Iterable[object], value))
    numbers = [float(part) for part in parts if is_number(part) and 0.0 <= part <= 1.0]
    if not len(numbers) == len(parts) == 3:
        return None
    red, green, blue = numbers
    return red, green, blue


def _of_text(text: str) -> Color | None:
    """A colour that is written; None: no colour is written so."""
    from PIL import ImageColor

    try:
        return _of_numbers([float(part) for part in text.replace(",", " ").split()])
    except ValueError:
        pass
    try:
        channels = ImageColor.getrgb(text.strip())
    except ValueError:
        return None
    return _of_numbers([channel / 255.0 for channel in channels])  # not a colour with alpha, of four
