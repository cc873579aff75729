"""Rows of buttons that do what they were pressed for, however soon the next is pressed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from lumisplat.viewer.server.turns import in_turn

if TYPE_CHECKING:
    import viser


def add_buttons(gui: viser.GuiApi, names: Sequence[str], act: Callable[[str], object]) -> None:
    """Adds a row of buttons.

    A row has one value, that of the button pressed last: two that are pressed at once, on two pages, must not be
    taken for one of them pressed twice.

    Args:
        gui: The pages' controls.
        names: On the buttons.
        act: Does what a button is for, by its name.
    """
    press: Any = in_turn(lambda event: str(event.target.value), act)
    gui.add_button_group("", list(names)).on_click(press)
