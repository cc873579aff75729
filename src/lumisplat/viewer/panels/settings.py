"""The settings of a dataclass as controls: each field by itself, groups in folders; new fields appear by themselves."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from enum import Enum
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import lumisplat as ls
from lumisplat.config.setting import Setting
from lumisplat.viewer.panels.controls import Control, label_of, set_if_changed, shown_settings

if TYPE_CHECKING:
    import viser
    from _typeshed import DataclassInstance

Settings = TypeVar("Settings", bound="DataclassInstance")


Put = Callable[[Callable[[Any], Any], "str | None"], None]
"""Takes a change of settings."""


class SettingsPanel(Generic[Settings]):
    """Controls of one object of settings, in the present folder.

    Args:
        gui: Where.
        settings: What they show at first.
        put: Called with what makes new settings of the present ones, which raises a LumisplatError if a value is
            refused, and the name of the field, None where each edit is undone on its own.
        report: Told why a value is refused.
        without: Fields that are shown elsewhere, or nowhere.
        only: If given, these fields alone.
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
        """Of the groups."""
        for field in shown_settings(type(settings)):
            if field.name in without or (only is not None and field.name not in only):
                continue
            value = getattr(settings, field.name)
            if field.kind == "group":
                self._folders[field.name] = gui.add_folder(label_of(field), expand_by_default=False)
                with self._folders[field.name]:
                    self._groups[field.name] = SettingsPanel(gui, value, self._group_changed(field.name), report)
            else:
                offered = replace(field, choices=tuple(c for c in field.choices if _is_taken(settings, field, c)))
                self._controls[field.name] = Control(gui, offered, value, self._field_changed(field), report)

    def show(self, settings: Settings) -> None:
        """Shows other settings."""
        for name, control in self._controls.items():
            control.show(getattr(settings, name))
        for name, group in self._groups.items():
            group.show(getattr(settings, name))

    def set_visible(self, visible: bool) -> None:
        """Shows or hides its own fields; groups have folders of their own."""
        for control in self._controls.values():
            for handle in control.handles:
                set_if_changed(handle, "visible", visible)

    def set_unused(self, unused: Mapping[str, str]) -> None:
        """Disables controls that have no effect, and hides such groups.

        Args:
            unused: Names of fields, those in groups as ``group.field``, each with what would give it an effect.
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


def _is_taken(settings: Any, field: Setting, choice: Enum) -> bool:
    """Whether settings may have a choice of a field."""
    try:
        replace(settings, **{field.name: choice})
    except ls.ConfigError:
        return False
    return True
