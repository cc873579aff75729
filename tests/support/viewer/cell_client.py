"""Replaces a notebook without browser and kernel: opens the widgets' comms, and answers as JupyterLab does."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import simplejpeg
from comm.base_comm import BaseComm


class CellClient:
    """Shows widgets created in its context; `send` sends events to the frame of jupyter_rfb.

    Args:
        answers: Whether the client acknowledges frames.
    """

    def __init__(self, *, answers: bool = True) -> None:
        self.answers = answers
        self.pictures: list[tuple[float, bytes]] = []
        """Received frames: arrival time and JPEG."""
        self.bytes = 0
        """Total size of frame messages, without Jupyter's envelopes."""
        self._frames: BaseComm | None = None
        self._arrived = threading.Condition()
        self._patches = [mock.patch("comm.create_comm", self._open), mock.patch(f"{_HOST}._shell", _notebook_shell)]

    def __enter__(self) -> CellClient:
        for patch in self._patches:
            patch.start()
        return self

    def __exit__(self, *_: object) -> None:
        for patch in self._patches:
            patch.stop()

    def send(self, kind: str, **fields: Any) -> None:
        """Sends an event."""
        self._to_kernel({"method": "custom", "content": {"type": kind, **fields}})

    def drag(self, across: float, down: float, *, button: int = 1, modifiers: tuple[str, ...] = ()) -> None:
        """Drags the pointer from the centre of the frame."""
        held: dict[str, Any] = {"button": button, "modifiers": list(modifiers)}
        self.send("pointer_down", x=320.0, y=180.0, buttons=[button], **held)
        self.send("pointer_move", x=320.0 + across, y=180.0 + down, buttons=[button], **held)
        self.send("pointer_up", x=320.0 + across, y=180.0 + down, buttons=[], **held)

    def click(self, across: float, down: float) -> None:
        """Clicks at fractions of the width and height of a frame of 640 x 360."""
        at = {"x": 640.0 * across, "y": 360.0 * down, "button": 1, "modifiers": []}
        self.send("pointer_down", buttons=[1], **at)
        self.send("pointer_up", buttons=[], **at)

    def picture(self, after: int = 0, timeout: float = 60.0) -> np.ndarray:
        """Waits for more than ``after`` frames, and returns the latest, (H, W, 3) uint8."""
        with self._arrived:
            assert self._arrived.wait_for(lambda: len(self.pictures) > after, timeout), "no picture came"
            return simplejpeg.decode_jpeg(self.pictures[-1][1])

    def _to_kernel(self, data: dict[str, Any]) -> None:
        assert self._frames is not None, "no frame is shown"
        self._frames.handle_msg({"content": {"data": data}, "buffers": []})

    def _open(self, **options: Any) -> BaseComm:
        comm = _Comm(self._take, **options)
        if options["data"]["state"].get("_anywidget_id", "").startswith("jupyter_rfb"):
            self._frames = comm
        return comm

    def _take(self, data: dict[str, Any], buffers: list[bytes]) -> None:
        content = data.get("content", {})
        if content.get("type") != "framebufferdata":
            return
        with self._arrived:
            self.pictures.append((time.monotonic(), bytes(buffers[0])))
            self.bytes += len(buffers[0]) + len(repr(content))
            self._arrived.notify_all()
        if self.answers:
            seen = {"index": content["index"], "timestamp": content["timestamp"], "localtime": time.time()}
            self._to_kernel({"method": "update", "state": {"_frame_feedback": seen}})


_HOST = "lumisplat.viewer.notebook"


class _Comm(BaseComm):
    """Channel of a widget; messages are handled immediately in the sending thread."""

    def __init__(self, take: Any, **options: Any) -> None:
        self._take = take
        super().__init__(**options)

    def publish_msg(
        self, msg_type: str, data: Any = None, metadata: Any = None, buffers: Any = None, **keys: Any
    ) -> None:
        if msg_type == "comm_msg" and data.get("method") == "custom":
            self._take(data, buffers)


def _notebook_shell() -> Any:
    """Returns IPython's shell as in a kernel of a notebook that accepts input."""
    kernel = SimpleNamespace(get_parent=lambda channel: {"content": {"allow_stdin": True}})
    return SimpleNamespace(kernel=kernel, display_formatter=SimpleNamespace(active_types=["image/png", "text/plain"]))
