"""A frame in a cell: the widget of jupyter_rfb, and the screen that sends pictures to it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from importlib import import_module
from typing import Any

import lumisplat as ls
from lumisplat.viewer.frames.picture import Shown
from lumisplat.viewer.thresholds import ANSWER_S


def import_widgets() -> tuple[Any, Any]:
    """The packages ipywidgets and jupyter_rfb.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """
    try:
        return import_module("ipywidgets"), import_module("jupyter_rfb")  # whose types are unknown
    except ImportError:
        raise ls.MissingExtraError("live frames in a notebook's cell", "notebook") from None


def frame_buffer(width: int, height: int, on_event: Callable[[dict[str, Any]], None]) -> Any:
    """A widget that shows what `CellScreen` sends.

    Args:
        width: Width in the notebook, pixels of the page; people may drag its corner.
        height: Height likewise.
        on_event: Called with each event, in a thread of the kernel.

    Raises:
        MissingExtraError: jupyter_rfb is not installed.
    """
    from IPython.utils.capture import capture_output

    _, jupyter_rfb = import_widgets()
    with capture_output(
        stdout=False, stderr=False
    ):  # of the place that it shows for errors of events, an empty line above the frame
        buffer = jupyter_rfb.RemoteFrameBuffer(css_width=f"{width}px", css_height=f"{height}px")
    buffer.handle_event = on_event
    return buffer


class CellScreen:
    """Sends pictures to a widget; its pages answer which one they have drawn.

    A kernel that runs a cell hears no answers: so long, pictures are sent as often as `ANSWER_S` says.

    Args:
        buffer: The widget, of `frame_buffer`; no one else sends frames to it.
    """

    def __init__(self, buffer: Any) -> None:
        self._buffer = buffer
        self._sent = 0
        self._is_there = threading.Event()
        buffer.observe(self._on_answer, names="_frame_feedback")

    def show(self, shown: Shown) -> None:
        """Sends a picture, and waits until it is drawn."""
        self._is_there.clear()
        self._sent += 1
        self._buffer.quality = shown.quality
        self._buffer.send_frame(shown.picture)
        self._is_there.wait(ANSWER_S)

    def close(self) -> None:
        """Ends the wait."""
        self._is_there.set()

    def _on_answer(self, change: Any) -> None:
        if change["new"].get("index", 0) >= self._sent:
            self._is_there.set()
