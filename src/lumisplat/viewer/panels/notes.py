"""What pages are told in passing."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import viser

_SHOWN_S = 8.0


def tell(server: viser.ViserServer, title: str, body: str, *, is_problem: bool = False) -> None:
    """Shows a note on all pages, for a while."""
    for client in server.get_clients().values():
        with contextlib.suppress(RuntimeError):  # it has just gone
            client.add_notification(title, body, auto_close_seconds=_SHOWN_S, color="red" if is_problem else None)
