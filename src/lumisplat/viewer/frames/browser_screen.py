"""A page in a browser as a screen: pictures are its background."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from lumisplat.viewer.frames.picture import Shown
from lumisplat.viewer.thresholds import ANSWER_S, PATIENCE_S

if TYPE_CHECKING:
    import viser

_POLL_S = 0.2


class BrowserScreen:
    """Sends pictures to a page of viser, and asks whether they are there.

    Args:
        client: The page's connection.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        self._client = client
        self._is_open = True
        self._has_answered = False
        self._answers = True

    def show(self, shown: Shown) -> None:
        """Sends a picture, and waits for the page's answer."""
        self._client.scene.set_background_image(
            shown.picture, format="jpeg", jpeg_quality=shown.quality, depth=shown.depth
        )
        self._client.flush()
        self._await_answer()

    def close(self) -> None:
        """Ends the wait."""
        self._is_open = False

    def _await_answer(self) -> None:
        """Waits until the page has taken what it was sent: it answers in order, and viser's pages answer this."""
        until = time.monotonic() + (PATIENCE_S if self._has_answered else ANSWER_S)
        while self._answers and self._is_open:
            try:
                self._client.local_storage.get_item("frame", timeout=_POLL_S)
                self._has_answered = True
                return
            except TimeoutError:
                if time.monotonic() >= until:
                    self._answers = self._has_answered
                    return
            except RuntimeError:  # it has gone, or keeps nothing, which is an answer, too
                return
