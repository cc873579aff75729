"""Connects to the viewer without a browser, by viser's protocol on a bare WebSocket."""

from __future__ import annotations

import contextlib
import io
import threading
import time
import uuid
from typing import Any, Self

import msgspec
import numpy as np
import zstandard
from PIL import Image
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

import lumisplat as ls


class PageClient:
    """Sends cameras and edits, acknowledges frames as a page does, and stores the received frames.

    Args:
        url: Address of the viewer with its token.
        answers: Whether the page acknowledges frames.
    """

    def __init__(self, url: str, *, answers: bool = True) -> None:
        import viser

        self.messages: list[dict[str, Any]] = []
        """All received messages except frames."""
        self.pictures: list[tuple[float, bytes]] = []
        """Received frames: arrival time and JPEG."""
        self._answers = answers
        address = url.replace("http", "ws")
        self._socket = connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None)  # pyright: ignore
        self._arrived = threading.Condition()
        self._thread = threading.Thread(target=self._receive, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection."""
        self._socket.close()
        self._thread.join()

    def send(self, kind: str, **fields: Any) -> None:
        """Sends a message."""
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def send_raw(self, raw: bytes) -> None:
        """Sends raw bytes."""
        self._socket.send(raw)

    def ping(self) -> None:
        """Waits until the viewer's connection has received everything that was sent."""
        assert self._socket.ping().wait(300.0), "the viewer does not answer"

    def look(self, camera: ls.Camera, target: Any = (0.0, 0.0, 0.0)) -> None:
        """Sends a camera."""
        from viser import transforms

        world_from_camera = np.linalg.inv(camera.camera_from_world)
        self.send(
            "ViewerCameraMessage",
            wxyz=[float(x) for x in transforms.SO3.from_matrix(world_from_camera[:3, :3]).wxyz],
            position=[float(x) for x in world_from_camera[:3, 3]],
            fov=2.0 * float(np.arctan(0.5 * camera.height / camera.fy)),
            near=0.01,
            far=1000.0,
            image_height=camera.height,
            image_width=camera.width,
            look_at=[float(x) for x in target],
            up_direction=[0.0, -1.0, 0.0],
        )

    def stop(self) -> None:
        """Says that the camera stays where it was sent last."""
        self.send("CameraStoppedMessage")

    def picture(self, after: int = 0, timeout: float = 300.0) -> np.ndarray:
        """Waits for more than ``after`` frames, and returns the latest, (H, W, 3) uint8."""
        with self._arrived:
            assert self._arrived.wait_for(lambda: len(self.pictures) > after, timeout), "no picture came"
            return np.asarray(Image.open(io.BytesIO(self.pictures[-1][1])))

    def control(self, label: str, folder: str | None = None) -> str:
        """Returns the id of a control by its label, and by its folder's label where several share one label."""
        until = time.monotonic() + 60.0
        while time.monotonic() < until:
            named = [(m, m["props"]) for m in list(self.messages) if "uuid" in m and isinstance(m.get("props"), dict)]
            folders = {m["uuid"] for m, props in named if props.get("label") == folder}
            for message, props in named:
                if props.get("label") == label and (folder is None or message["container_uuid"] in folders):
                    return str(message["uuid"])
            time.sleep(0.02)
        raise AssertionError(f"there is no control {label!r}")

    def choose(self, label: str, value: Any, folder: str | None = None) -> None:
        """Changes the value of a control."""
        self.send("GuiUpdateMessage", uuid=self.control(label, folder), updates={"value": value})

    def press(self, label: str) -> None:
        """Presses a button."""
        self.choose(label, True)

    def downloads(self) -> dict[str, bytes]:
        """Returns the completely received files by name; of equal names, the last."""
        messages = list(self.messages)
        whole: dict[str, bytes] = {}
        for start in (message for message in messages if message["type"] == "FileTransferStartDownload"):
            parts = {
                message["part_index"]: message["content"]
                for message in messages
                if message["type"] == "FileTransferPart" and message["transfer_uuid"] == start["transfer_uuid"]
            }
            if len(parts) == start["part_count"]:
                whole[start["filename"]] = b"".join(parts[number] for number in sorted(parts))
        return whole

    def click(self, across: float, down: float) -> None:
        """Clicks on the frame."""
        at = [[across, down]]
        ray = {"ray_origin": [0.0, 0.0, 0.0], "ray_direction": [0.0, 0.0, 1.0]}
        self.send("ScenePointerMessage", event_type="click", screen_pos=at, modifier=None, **ray)

    def upload(self, label: str, name: str, content: bytes) -> None:
        """Uploads a file in one part."""
        source, transfer = self.control(label), uuid.uuid4().hex
        shared = {"source_component_uuid": source, "transfer_uuid": transfer}
        start = {"filename": name, "mime_type": "", "part_count": 1, "size_bytes": len(content)}
        self.send("FileTransferStartUpload", **shared, **start)
        self.send("FileTransferPart", **shared, part_index=0, content=content)

    def notes(self) -> list[str]:
        """Returns the texts of the notifications that the page received."""
        shown = (message for message in self.messages if message["type"] == "NotificationShowMessage")
        return [f"{note['props']['title']}: {note['props']['body']}" for note in shown]

    def _receive(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            self._receive_all()

    def _receive_all(self) -> None:
        decompressor = zstandard.ZstdDecompressor()
        for raw in self._socket:
            assert isinstance(raw, bytes)
            size, packed = int.from_bytes(raw[:8], "little"), int.from_bytes(raw[8:16], "little")
            window = msgspec.msgpack.decode(decompressor.decompress(raw[16 : 16 + packed], max_output_size=size))
            buffers = _buffers(raw, 16 + packed, window["binaryBufferLengths"])
            for message in window["messages"]:
                self._take(message, buffers)

    def _take(self, message: dict[str, Any], buffers: list[bytes]) -> None:
        kind = message["type"]
        if kind == "LocalStorageGetItemRequestMessage" and self._answers:
            answer = {"value": None, "error": None, "request_uuid": message["request_uuid"]}
            self.send("LocalStorageGetItemResponseMessage", **answer)
        elif kind == "BackgroundImageMessage":
            data = message["rgb_data"]
            data = buffers[data["__binary_index"]] if isinstance(data, dict) else data
            if data:
                with self._arrived:
                    self.pictures.append((time.monotonic(), bytes(data)))
                    self._arrived.notify_all()
        else:
            self.messages.append(message)


def _buffers(raw: bytes, start: int, lengths: list[int]) -> list[bytes]:
    """Returns the binary buffers after a window's messages, each aligned to 8 bytes."""
    found: list[bytes] = []
    at = start
    for length in lengths:
        at += (8 - at % 8) % 8
        found.append(raw[at : at + length])
        at += length
    return found
