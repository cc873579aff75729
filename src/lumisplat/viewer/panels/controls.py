"""GUI controls for the fields of a settings dataclass; converts values of settings to displayed values and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from enum import Enum
from functools import partial
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

import lumisplat as ls
from lumisplat.config.setting import Setting, settings_of
from lumisplat.viewer.server.event_queue import value_callback
from lumisplat.viewer.words import label

if TYPE_CHECKING:
    import viser
    from _typeshed import DataclassInstance


Color = tuple[float, float, float]

KELVIN_RANGE = (1500.0, 12000.0)
"""Range of the colour temperature slider, kelvins: from candlelight to a blue sky."""

# Krystek 1985, "An algorithm to calculate correlated colour temperature", CIE 1960 (u, v), 1000 to 15000 K.
_U = ((0.860117757, 1.54118254e-4, 1.28641212e-7), (1.0, 8.42420235e-4, 7.08145163e-7))
_V = ((0.317398726, 4.22806245e-5, 4.20481691e-8), (1.0, -2.89741816e-5, 1.61456053e-7))

_REC709_FROM_XYZ = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def color_of_temperature(kelvins: float) -> Color:
    """Returns the linear Rec.709 colour of a black body, with its largest channel 1 and no negative channel.

    Args:
        kelvins: Temperature, 1000 to 15000 K.
    """
    u, v = (_ratio(table, kelvins) for table in (_U, _V))
    x, y = (3.0 * u / (2.0 * u - 8.0 * v + 4.0), 2.0 * v / (2.0 * u - 8.0 * v + 4.0))
    xyz = (x / y, 1.0, (1.0 - x - y) / y)
    channels = [max(sum(m * c for m, c in zip(row, xyz, strict=True)), 0.0) for row in _REC709_FROM_XYZ]
    red, green, blue = (channel / max(channels) for channel in channels)
    return red, green, blue


def color_bytes_from_linear(color: Color) -> tuple[int, int, int]:
    """Converts a linear colour to sRGB bytes for a colour picker; values above 1 are clipped."""
    red, green, blue = (round(255.0 * _encoded(min(max(channel, 0.0), 1.0))) for channel in color)
    return red, green, blue


def linear_from_color_bytes(picked: tuple[int, int, int]) -> Color:
    """Converts sRGB bytes of a colour picker to a linear colour, rounded to five digits for readable scene files."""
    red, green, blue = (round(_decoded(channel / 255.0), 5) for channel in picked)
    return red, green, blue


def _ratio(table: tuple[tuple[float, ...], tuple[float, ...]], t: float) -> float:
    above, below = (sum(factor * t**power for power, factor in enumerate(row)) for row in table)
    return above / below


def _encoded(linear: float) -> float:
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * math.pow(linear, 1.0 / 2.4) - 0.055


def _decoded(encoded: float) -> float:
    return encoded / 12.92 if encoded <= 0.04045 else math.pow((encoded + 0.055) / 1.055, 2.4)


AUTO = "auto"
"""Text that a control displays for the value None, which lets the library choose."""

_DIGITS = 7
"""Largest number of decimals of a number that users can type into a number or vector box."""
_NUMBER_CHARACTERS, _VECTOR_CHARACTERS = 11, 8
"""Number of characters that fit into a number box, and into the box of one component of a vector."""
_SLIDER_SPAN = 1e4
"""A setting whose range ends above this value gets a number box instead of a slider."""


_UNIT_CHARACTERS = 7
"""Number of characters of the longest unit that a label includes; longer units appear only in the tooltip."""


def control_settings(cls: type) -> list[Setting]:
    """Returns a description of each field of a settings dataclass for which a control exists, in order."""
    return [one for one in settings_of(cls) if one.kind not in ("span", "names", "other")]


def label_of(field: Setting) -> str:
    """Returns the text beside a setting's control: its name in words, and its unit if that is short."""
    words, unit = label(field.name), field.range.unit
    return f"{words} ({unit})" if unit and len(unit) <= _UNIT_CHARACTERS and "(" not in words else words


def hint_of(field: Setting) -> str | None:
    """Returns the tooltip of a setting: its description and range; None if it has neither."""
    return f"{field.help} {field.limits}".strip() or None


class Control:
    """GUI element that shows and changes one setting, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        field: Setting to show.
        value: Current value.
        put: Applies a value that a user chose, in a thread of the page server; raises a LumisplatError for an invalid
            one.
        report: Receives the reason if a value is invalid; the control then shows the last valid value.
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
        """Checkbox beside the colour picker of an optional colour, which sets it to None; None for other settings."""
        self._shown = value
        self._put, self._report = put, report
        read = partial(from_control_value, field)
        typed = _is_text_box(field, value)
        self.handle.on_update(
            value_callback(lambda shown: (shown,), lambda given: self._take(read, given[0]), is_typed=typed)
        )
        if field.kind == "color" and field.is_optional:
            self._none = gui.add_checkbox(f"no {label_of(field)}", value is None, hint="Transparent.")
            self._none.on_update(
                value_callback(lambda is_none: (is_none,), lambda given: self._take(self._color, given[0]))
            )

    @property
    def handles(self) -> list[Any]:
        """Handles of viser for the control: the GUI element, and for an optional colour also its checkbox."""
        return [self.handle] if self._none is None else [self.handle, self._none]

    def show(self, value: Any) -> None:
        """Displays a value of the setting, without applying it."""
        self._shown = value
        if self._none is not None:
            self._none.value = value is None
        if self._none is None or value is not None:
            self.handle.value = to_control_value(self.field, value)

    def set_unused(self, reason: str | None) -> None:
        """Disables a control whose setting has no effect, and adds the reason to its tooltip; None enables it again."""
        for handle in self.handles:
            set_unused(handle, hint_of(self.field), reason)

    def _take(self, read: Callable[[Any], Any], shown: Any) -> None:
        try:
            value = keep_unchanged_numbers(read(shown), self._shown)
            if value != self._shown:
                self._put(value)
        except ls.LumisplatError as error:
            self._report(" ".join(str(error).split()))
            self.show(self._shown)

    def _color(self, is_none: bool) -> Any:
        return None if is_none else from_control_value(self.field, self.handle.value)


def keep_unchanged_numbers(given: Any, before: Any, width: int = _NUMBER_CHARACTERS) -> Any:
    """Restores the full precision of numbers in a displayed value that the user did not edit.

    A control displays rounded numbers; a number that still equals its rounded original is replaced by the original.

    Args:
        given: Displayed value, after the user's change.
        before: Full-precision value before the change.
        width: Characters that fit into the control of each number.
    """
    if isinstance(given, float) and isinstance(before, float):
        return before if given == rounded_for_display(before, width) else given
    if isinstance(given, tuple) and isinstance(before, tuple):
        pairs = zip(cast("tuple[Any, ...]", given), cast("tuple[Any, ...]", before), strict=False)
        return tuple(keep_unchanged_numbers(new, old, _VECTOR_CHARACTERS) for new, old in pairs)
    return cast(Any, given)


def set_unused(handle: Any, hint: str | None, reason: str | None) -> None:
    """Disables a control that has no effect, and adds the reason to its tooltip; a reason of None enables it.

    Args:
        handle: The control.
        hint: Tooltip of the enabled control.
        reason: Text that says what would give the control an effect; None enables the control.
    """
    set_if_changed(handle, "disabled", reason is not None)
    set_if_changed(handle, "hint", hint if reason is None else f"{reason} {hint or ''}".strip())


def set_if_changed(handle: Any, name: str, value: object) -> None:
    """Assigns a property of a GUI element unless it has that value: each assignment sends a message to all pages."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def to_control_value(field: Setting, value: Any) -> Any:
    """Converts the value of a setting to the value that its control displays, such as a rounded number or a text."""
    if _is_shown_as_text(field):
        return AUTO if value is None else _text(field, value)
    match field.kind:
        case "choice":
            return value.value
        case "color":
            return _color_bytes(field, value)
        case "vector":
            return tuple(rounded_for_display(x, _VECTOR_CHARACTERS) for x in value)
        case "number":
            return rounded_for_display(value)
        case _:
            return value


def rounded_for_display(value: float, width: int = _NUMBER_CHARACTERS) -> float:
    """Rounds a number so that all its digits fit into a control.

    Args:
        value: The number.
        width: Characters that fit; digits before the decimal point are never dropped.
    """
    if not math.isfinite(value):
        return value
    for digits in range(_DIGITS, 0, -1):
        if len(f"{value:.{digits}f}".rstrip("0").rstrip(".")) <= width:
            return float(f"{value:.{digits}f}")
    return float(f"{value:.0f}")


def from_control_value(field: Setting, shown: Any) -> Any:
    """Converts the value that a control displays to the value of the setting.

    Raises:
        ConfigError: The typed text is not a number.
    """
    if _is_shown_as_text(field):
        return _parsed(field, str(shown))
    match field.kind:
        case "choice":
            return _choice(field, shown)
        case "color":
            return linear_from_color_bytes(shown) if field.is_linear else tuple(channel / 255.0 for channel in shown)
        case "vector":
            return tuple(float(x) for x in shown)
        case _:
            return shown


def _is_shown_as_text(field: Setting) -> bool:
    """True if a setting needs a text box or dropdown, because it can be None (``auto``) or infinite."""
    return (field.is_optional and field.kind != "color") or (field.kind == "number" and field.default == math.inf)


def _is_text_box(field: Setting, value: Any) -> bool:
    """True if a setting's control is a text box, which sends an event at each key press."""
    if _is_shown_as_text(field):
        return not field.is_optional or field.kind not in ("flag", "choice")
    return field.kind in ("text", "vector") or (field.kind in ("whole", "number") and not _is_slider(field, value))


def _is_slider(field: Setting, shown: Any) -> bool:
    """True if a number gets a slider: its range is known, finite and no wider than `_SLIDER_SPAN`."""
    low, high = field.low, field.high
    return low is not None and high is not None and low <= shown <= high <= _SLIDER_SPAN


def _color_bytes(field: Setting, color: tuple[float, float, float] | None) -> tuple[int, ...]:
    """Converts a linear colour to sRGB bytes for a colour picker; None becomes black."""
    if color is None:
        return 0, 0, 0
    return color_bytes_from_linear(color) if field.is_linear else tuple(round(255.0 * channel) for channel in color)


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
    """Converts a typed text to the value of a setting that can be None (``auto``) or infinite."""
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
    """Creates the GUI element of a setting, such as a checkbox or slider, and returns its viser handle."""
    label, shown, hint = label_of(field), to_control_value(field, value), hint_of(field)
    if field.is_optional and field.kind in ("flag", "choice"):
        words = ("on", "off") if field.kind == "flag" else tuple(choice.value for choice in field.choices)
        return gui.add_dropdown(label, (AUTO, *words), initial_value=shown, hint=hint)
    if _is_shown_as_text(field):
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
    """Creates a slider for a number if `_is_slider` holds, else a number box; returns its viser handle."""
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
    """Returns a slider's step for a range of width ``span``: a power of ten between 1/3200 and 1/320 of it."""
    return 10.0 ** math.floor(math.log10(span) - 2.5)


Settings = TypeVar("Settings", bound="DataclassInstance")


Put = Callable[[Callable[[Any], Any], "str | None"], None]
"""Function that applies a change of settings. Its arguments are a function from old to new settings, and the field's
name; changes with one name are undone together, changes with the name None separately."""


class SettingsPanel(Generic[Settings]):
    """Controls for all fields of a settings dataclass, with a folder for each nested group, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        settings: Settings to show at the start.
        put: Applies a change, given a function from old to new settings and the field's name. The name is None for
            edits that are undone separately. Raises a LumisplatError for an invalid value.
        report: Receives the reason if a value is invalid.
        without: Fields to leave out.
        only: Fields to show; None shows all.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        settings: Settings,
        put: Put,
        report: Callable[[str], None],
        *,
        without: Collection[str] = (),
        only: Collection[str] | None = None,
    ) -> None:
        self._put = put
        self._controls: dict[str, Control] = {}
        self._groups: dict[str, SettingsPanel[Any]] = {}
        self._folders: dict[str, Any] = {}
        """GUI folder of each nested group of settings, by field name."""
        for field in control_settings(type(settings)):
            if field.name in without or (only is not None and field.name not in only):
                continue
            value = getattr(settings, field.name)
            if field.kind == "group":
                self._folders[field.name] = gui.add_folder(label_of(field), expand_by_default=False)
                with self._folders[field.name]:
                    self._groups[field.name] = SettingsPanel(gui, value, self._group_changed(field.name), report)
            else:
                offered = replace(field, choices=tuple(c for c in field.choices if _is_allowed(settings, field, c)))
                self._controls[field.name] = Control(gui, offered, value, self._field_changed(field), report)

    def show(self, settings: Settings) -> None:
        """Displays the values of given settings, without applying them."""
        for name, control in self._controls.items():
            control.show(getattr(settings, name))
        for name, group in self._groups.items():
            group.show(getattr(settings, name))

    def set_visible(self, visible: bool) -> None:
        """Shows or hides the controls of ungrouped fields; folders of nested groups stay as they are."""
        for control in self._controls.values():
            for handle in control.handles:
                set_if_changed(handle, "visible", visible)

    def set_unused(self, unused: Mapping[str, str]) -> None:
        """Disables controls, and hides groups of controls, whose settings have no effect.

        Args:
            unused: Reasons by field name; ``group.field`` names a field of a nested group.
        """
        for name, control in self._controls.items():
            control.set_unused(unused.get(name))
        for name, group in self._groups.items():
            prefix = f"{name}."
            group.set_unused({key.removeprefix(prefix): why for key, why in unused.items() if key.startswith(prefix)})
        for name, folder in self._folders.items():
            set_if_changed(folder, "visible", name not in unused)

    def _field_changed(self, field: Setting) -> Callable[[Any], None]:
        name = field.name
        merge = name if field.kind in ("whole", "number", "color", "vector") else None

        def put(value: Any) -> None:
            self._put(lambda settings: replace(settings, **{name: value}), merge)

        return put

    def _group_changed(self, name: str) -> Put:
        def put(change: Callable[[Any], Any], field: str | None) -> None:
            merge = None if field is None else f"{name}.{field}"
            self._put(lambda settings: replace(settings, **{name: change(getattr(settings, name))}), merge)

        return put


def _is_allowed(settings: Any, field: Setting, choice: Enum) -> bool:
    """True if a settings object accepts a choice for one of its fields, with all other fields unchanged."""
    try:
        replace(settings, **{field.name: choice})
    except ls.ConfigError:
        return False
    return True
