"""A control for each setting, and between the two the words and numbers that people see."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import lumisplat as ls
from lumisplat.config.setting import Setting, settings_of
from lumisplat.viewer.colors import linear_from_picked, picked_from_linear
from lumisplat.viewer.server.event_queue import chosen
from lumisplat.viewer.words import label

if TYPE_CHECKING:
    import viser

AUTO = "auto"
"""What people read and type for None."""

_DIGITS = 7
"""Digits behind the point that people may type."""
_NUMBER_CHARACTERS, _VECTOR_CHARACTERS = 11, 8
"""Characters of a number, and of each number of a vector, that a control has room for."""
_SLIDER_SPAN = 1e4
"""Ranges whose ends differ by a larger factor are typed, not dragged."""


_UNIT_CHARACTERS = 7
"""Longer units stand in the hint alone."""


def shown_settings(cls: type) -> list[Setting]:
    """Returns the fields of a dataclass that a control can show, in their order."""
    return [one for one in settings_of(cls) if one.kind not in ("span", "names", "other")]


def label_of(field: Setting) -> str:
    """Returns the name in words, with a short unit."""
    words, unit = label(field.name), field.range.unit
    return f"{words} ({unit})" if unit and len(unit) <= _UNIT_CHARACTERS and "(" not in words else words


def hint_of(field: Setting) -> str | None:
    """Returns what a setting does and which values it takes; None: nothing is known."""
    return f"{field.help} {field.limits}".strip() or None


class Control:
    """One field on the page, in the present folder.

    Args:
        gui: Where.
        field: What it shows.
        value: Its value.
        put: Called with the value that somebody has chosen, in a thread of the page server; raises a LumisplatError if
            it is refused.
        report: Told why a value is refused; the control then shows the last one again.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        field: Setting,
        value: Any,
        put: Callable[[Any], None],
        report: Callable[[str], None],
    ) -> None:
        self.field = field
        self.handle: Any = _handle(gui, field, value)
        self._none: Any = None
        """Whether an optional colour is None, which no colour shows."""
        self._shown = value
        self._put, self._report = put, report
        read = partial(from_shown, field)
        typed = _has_keys(field, value)
        self.handle.on_update(chosen(lambda shown: (shown,), lambda given: self._take(read, given[0]), is_typed=typed))
        if field.kind == "color" and field.is_optional:
            self._none = gui.add_checkbox(f"no {label_of(field)}", value is None, hint="Transparent.")
            self._none.on_update(chosen(lambda is_none: (is_none,), lambda given: self._take(self._color, given[0])))

    @property
    def handles(self) -> list[Any]:
        """What is on the page of it."""
        return [self.handle] if self._none is None else [self.handle, self._none]

    def show(self, value: Any) -> None:
        """Shows another value."""
        self._shown = value
        if self._none is not None:
            self._none.value = value is None
        if self._none is None or value is not None:
            self.handle.value = to_shown(self.field, value)

    def set_unused(self, reason: str | None) -> None:
        """Disables the control, and says what would give it an effect; None: it has one."""
        for handle in self.handles:
            set_unused(handle, hint_of(self.field), reason)

    def _take(self, read: Callable[[Any], Any], shown: Any) -> None:
        try:
            value = unrounded(read(shown), self._shown)
            if value != self._shown:
                self._put(value)
        except ls.LumisplatError as error:
            self._report(" ".join(str(error).split()))
            self.show(self._shown)

    def _color(self, is_none: bool) -> Any:
        return None if is_none else from_shown(self.field, self.handle.value)


def unrounded(given: Any, before: Any, width: int = _NUMBER_CHARACTERS) -> Any:
    """A value of a control; numbers that were not changed there are as they were, not as they were shown.

    Args:
        given: What the control shows.
        before: The value that it was to show.
        width: Characters of each of its numbers.
    """
    if isinstance(given, float) and isinstance(before, float):
        return before if given == shown_number(before, width) else given
    if isinstance(given, tuple) and isinstance(before, tuple):
        pairs = zip(cast("tuple[Any, ...]", given), cast("tuple[Any, ...]", before), strict=False)
        return tuple(unrounded(new, old, _VECTOR_CHARACTERS) for new, old in pairs)
    return cast(Any, given)


def set_unused(handle: Any, hint: str | None, reason: str | None) -> None:
    """Disables a control that has no effect, and says in its hint what would give it one.

    Args:
        handle: The control.
        hint: What it says where it has one.
        reason: What would give it an effect; None: it has one.
    """
    set_if_changed(handle, "disabled", reason is not None)
    set_if_changed(handle, "hint", hint if reason is None else f"{reason} {hint or ''}".strip())


def set_if_changed(handle: Any, name: str, value: object) -> None:
    """Sets a property of a control: each time it is set, all pages are told."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def to_shown(field: Setting, value: Any) -> Any:
    """A value as its control shows it."""
    if _is_typed(field):
        return AUTO if value is None else _text(field, value)
    match field.kind:
        case "choice":
            return value.value
        case "color":
            return _picked(field, value)
        case "vector":
            return tuple(shown_number(x, _VECTOR_CHARACTERS) for x in value)
        case "number":
            return shown_number(value)
        case _:
            return value


def shown_number(value: float, width: int = _NUMBER_CHARACTERS) -> float:
    """A number rounded so that its control shows all of it.

    Args:
        value: The number.
        width: Characters that there is room for; digits before the point are always there.
    """
    if not math.isfinite(value):
        return value
    for digits in range(_DIGITS, 0, -1):
        if len(f"{value:.{digits}f}".rstrip("0").rstrip(".")) <= width:
            return float(f"{value:.{digits}f}")
    return float(f"{value:.0f}")


def from_shown(field: Setting, shown: Any) -> Any:
    """The value that a control shows.

    Raises:
        ConfigError: A number was typed that is none.
    """
    if _is_typed(field):
        return _parsed(field, str(shown))
    match field.kind:
        case "choice":
            return _choice(field, shown)
        case "color":
            return linear_from_picked(shown) if field.is_linear else tuple(channel / 255.0 for channel in shown)
        case "vector":
            return tuple(float(x) for x in shown)
        case _:
            return shown


def _is_typed(field: Setting) -> bool:
    """Whether a field is shown as a word or a text: it may be automatic, or infinite."""
    return (field.is_optional and field.kind != "color") or (field.kind == "number" and field.default == math.inf)


def _has_keys(field: Setting, value: Any) -> bool:
    """Whether its control is a box to type in, which tells each key."""
    if _is_typed(field):
        return not field.is_optional or field.kind not in ("flag", "choice")
    return field.kind in ("text", "vector") or (field.kind in ("whole", "number") and not _is_slider(field, value))


def _is_slider(field: Setting, shown: Any) -> bool:
    """Whether the range of a number is short, and known."""
    low, high = field.low, field.high
    return low is not None and high is not None and low <= shown <= high <= _SLIDER_SPAN


def _picked(field: Setting, color: tuple[float, float, float] | None) -> tuple[int, ...]:
    """A colour as bytes of sRGB; black for none."""
    if color is None:
        return 0, 0, 0
    return picked_from_linear(color) if field.is_linear else tuple(round(255.0 * channel) for channel in color)


def _choice(field: Setting, value: object) -> Any:
    for choice in field.choices:
        if choice.value == value:
            return choice
    raise ls.ConfigError(
        f"{label_of(field)} is '{value}', expected {', '.join(choice.value for choice in field.choices)}"
    )


def _text(field: Setting, value: Any) -> str:
    if field.kind == "flag":
        return "on" if value else "off"
    return value.value if field.kind == "choice" else f"{value:g}" if field.kind == "number" else f"{value}"


def _parsed(field: Setting, text: str) -> Any:
    """The value of a text, of a field that may be automatic or infinite."""
    word = text.strip().lower()
    if word in ("", AUTO) and field.is_optional:
        return None
    if field.kind == "flag":
        return word == "on"
    if field.kind == "choice":
        return _choice(field, word)
    if field.kind == "text":
        return text
    try:
        return int(word) if field.kind == "whole" else float(word)
    except ValueError:
        what = "a whole number" if field.kind == "whole" else "a number"
        word = AUTO if field.is_optional else "inf"
        raise ls.ConfigError(f"{label_of(field)} is '{text}', expected {what}, or {word}") from None


def _handle(gui: viser.GuiApi, field: Setting, value: Any) -> Any:  # noqa: PLR0911
    """The control itself."""
    label, shown, hint = label_of(field), to_shown(field, value), hint_of(field)
    if field.is_optional and field.kind in ("flag", "choice"):
        words = ("on", "off") if field.kind == "flag" else tuple(choice.value for choice in field.choices)
        return gui.add_dropdown(label, (AUTO, *words), initial_value=shown, hint=hint)
    if _is_typed(field):
        return gui.add_text(label, shown, hint=hint)
    match field.kind:
        case "flag":
            return gui.add_checkbox(label, shown, hint=hint)
        case "choice":
            return gui.add_dropdown(label, [choice.value for choice in field.choices], initial_value=shown, hint=hint)
        case "color":
            return gui.add_rgb(label, shown, hint=hint)
        case "vector":
            vector = gui.add_vector3(label, shown, step=1e-3, hint=hint)
            vector.precision = _DIGITS
            return vector
        case "text":
            return gui.add_text(label, shown, hint=hint)
        case _:
            return _number_handle(gui, field, shown, hint)


def _number_handle(gui: viser.GuiApi, field: Setting, shown: Any, hint: str | None) -> Any:
    """A slider where the range is short and known, else a box to type in."""
    whole, low, high = field.kind == "whole", field.low, field.high
    if low is not None and high is not None and _is_slider(field, shown):
        ends = (int(low), int(high)) if whole else (low, high)
        step = field.range.step if whole else _step(high - low)
        return gui.add_slider(label_of(field), ends[0], ends[1], step, shown, hint=hint)
    least = None if low is None else type(shown)(low)
    handle = gui.add_number(label_of(field), shown, min=least, step=field.range.step if whole else 1e-4, hint=hint)
    if not whole:
        handle.precision = _DIGITS
    return handle


def _step(span: float) -> float:
    """A thousandth of a range, as a power of ten."""
    return 10.0 ** math.floor(math.log10(span) - 2.5)
