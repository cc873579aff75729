"""Rows of buttons, and buttons in HTML lists; presses are handled in the order in which they were sent."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lumisplat.viewer.server.event_queue import queued_callback

if TYPE_CHECKING:
    import viser


_ICON = (
    '<svg viewBox="0 0 24 24" fill="none" stroke="currentColor" stroke-width="1.8" stroke-linecap="round" '
    'stroke-linejoin="round">{}</svg>'
)
_DOTS = ((6, 7), (12, 5), (18, 8), (4, 13), (10, 12), (16, 14), (8, 18), (14, 19), (20, 17))
_RAYS = "M12 2v2M12 20v2M2 12h2M20 12h2M5 5l1.4 1.4M17.6 17.6L19 19M5 19l1.4-1.4M17.6 6.4L19 5"
_SHAPES = {
    "splats": "".join(f'<circle cx="{x}" cy="{y}" r="1.4" fill="currentColor"/>' for x, y in _DOTS),
    "meshes": '<path d="M12 3l8 4.5v9L12 21l-8-4.5v-9zM4 7.5l8 4.5 8-4.5M12 12v9"/>',
    "actors": '<circle cx="12" cy="5" r="2.5"/><path d="M12 8v7M6 10l6 1 6-1M8 21l4-6 4 6"/>',
    "lights": '<path d="M9 18h6M10 21h4M8.5 15a6 6 0 1 1 7 0z"/>',
    "directional": f'<circle cx="12" cy="12" r="4"/><path d="{_RAYS}"/>',
    "environment": '<circle cx="12" cy="12" r="9"/><path d="M3 12h18M12 3c5 5 5 13 0 18M12 3c-5 5-5 13 0 18"/>',
    "shown": '<path d="M2 12c5-8 15-8 20 0-5 8-15 8-20 0z"/><circle cx="12" cy="12" r="2.6"/>',
    "hidden": '<path d="M2 12c5-8 15-8 20 0-5 8-15 8-20 0zM4 20L20 4"/>',
    "locked": '<path d="M6 11h12v9H6zM8.5 11V8a3.5 3.5 0 0 1 7 0v3"/>',
    "left": '<path d="M15 5l-7 7 7 7"/>',
    "right": '<path d="M9 5l7 7-7 7"/>',
    "cross": '<path d="M6 6l12 12M18 6L6 18"/>',
    "open": '<path d="M6 11h12v9H6zM8.5 11V8a3.5 3.5 0 0 1 6.8-1"/>',
}


def add_buttons(gui: viser.GuiApi, names: Sequence[str], act: Callable[[str], object]) -> None:
    """Adds a row of buttons.

    viser stores only the last pressed button of a row. The callback reads the button from each event, so that two
    presses on two pages are not taken for two presses of one button.

    Args:
        gui: Controls of the pages.
        names: Labels of the buttons.
        act: Handles a press, given the button's label.
    """
    press: Any = queued_callback(lambda event: str(event.target.value), act)
    gui.add_button_group("", list(names)).on_click(press)


class Channel:
    """Receives clicks on elements of an HTML list: the page's script writes them into a hidden text control.

    A click is a text such as ``hide 12``: a command, and a number such as an entry id.

    Args:
        gui: Controls of the pages.
        actions: Function for each command, called with the number.
        moves: Function for each command that concerns the clicked page only, called with the number and the page's
            connection.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        actions: Mapping[str, Callable[[int], object]],
        moves: Mapping[str, Callable[[int, viser.ClientHandle], object]] | None = None,
    ) -> None:
        self._handle = gui.add_text("", "")
        take: Any = queued_callback(_click_of, self._take)
        self._handle.on_update(take)
        self._actions, self._moves = actions, moves or {}

    @property
    def id(self) -> str:
        """Id of the hidden text control, which the ``data-to`` attribute of the HTML list names."""
        handle: Any = self._handle
        return handle._impl.uuid

    def _take(self, click: tuple[str, viser.ClientHandle]) -> None:
        words = click[0].split()
        if len(words) < 2 or not words[1].isdecimal():
            return
        if words[0] in self._actions:
            self._actions[words[0]](int(words[1]))
        elif words[0] in self._moves:
            self._moves[words[0]](int(words[1]), click[1])


def _click_of(event: Any) -> tuple[str, viser.ClientHandle] | None:
    """Returns the text of a click and the connection of the clicked page; None if no page sent the event."""
    return None if event.client is None else (str(event.target.value), event.client)


def icon(name: str) -> str:
    """Returns the SVG code of the icon with the given name, such as ``lights`` or ``cross``."""
    return _ICON.format(_SHAPES[name])


def button(command: str, icon_name: str, title: str, *, is_on: bool = False) -> str:
    """Returns the HTML code of a small icon button in a list row.

    Args:
        command: Text that a click sends to the `Channel` of the list, such as ``hide 12``.
        icon_name: Name of the icon.
        title: Tooltip.
        is_on: True highlights the button.
    """
    return (
        f'<span role="button" data-command="{command}" class="{"on" * is_on}" title="{title}">{icon(icon_name)}</span>'
    )


def plain(text: str) -> str:
    """Replaces by spaces the characters of a text that have a meaning in Markdown, HTML or tables."""
    return re.sub(r"[|<>`*_\[\]{}\\&#~!]", " ", text)
