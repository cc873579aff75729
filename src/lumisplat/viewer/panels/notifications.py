"""Shows notifications on pages for a while."""

from __future__ import annotations

import contextlib
import logging
import time
from collections import deque
from typing import TYPE_CHECKING

from lumisplat.viewer.words import page_words

if TYPE_CHECKING:
    import viser


QUIET_LOG = logging.getLogger("lumisplat.pages")
"""For lines that those at the machine read, and pages do not."""
_LOG = logging.getLogger("lumisplat")

_SHOWN_S = 8.0
_AGAIN_S = 2.0
"""A line that comes again and again is told anew after so long a pause."""
_WAITING_MAX = 10
"""Notifications that wait for the first page, at most: the last ones."""


class Notifications:
    """Shows notifications on all pages, for a while. Those that nobody was there for wait for the next page.

    Args:
        server: Has the pages.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._last: tuple[str, str] | None = None
        self._told_at = 0.0
        self._waiting: deque[tuple[str, str, bool]] = deque(maxlen=_WAITING_MAX)
        # A handler would keep lines off the terminal, where they go as long as there is none.
        _LOG.addFilter(self._tell_warning)

    def tell(self, title: str, body: str, *, is_problem: bool = False) -> None:
        """Shows a note on all pages."""
        now, before, self._last = time.monotonic(), self._last, (title, body)
        is_new, self._told_at = before != self._last or now - self._told_at > _AGAIN_S, now
        if not is_new:
            return
        clients = list(self._server.get_clients().values())
        for client in clients:
            _show(client, title, body, is_problem=is_problem)
        if not clients:
            self._waiting.append((title, body, is_problem))

    def problem(self, body: str) -> None:
        """Shows why something could not be done."""
        self.tell("that did not work", body, is_problem=True)

    def open(self, client: viser.ClientHandle) -> None:
        """Shows a new page what nobody was there for."""
        while self._waiting:
            title, body, is_problem = self._waiting.popleft()
            _show(client, title, body, is_problem=is_problem)

    def close(self) -> None:
        """Ends with the viewer."""
        _LOG.removeFilter(self._tell_warning)

    def _tell_warning(self, record: logging.LogRecord) -> bool:
        """Tells pages what is logged of scenes and frames, such as odd colours; errors are told where they happen."""
        if record.levelno == logging.WARNING:
            self.tell("note", page_words(record.getMessage()))
        return True


def _show(client: viser.ClientHandle, title: str, body: str, *, is_problem: bool) -> None:
    with contextlib.suppress(RuntimeError):  # it has just gone
        client.add_notification(title, body, auto_close_seconds=_SHOWN_S, color="red" if is_problem else None)
