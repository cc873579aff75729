"""Controls of the camera path and its video; the path's key views are keyframes of a camera in the scene file."""

from __future__ import annotations

import base64
import html
import io
import math
import tempfile
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
from PIL import Image

import lumisplat as ls
from lumisplat.viewer.frames.page import Picture, frame_image
from lumisplat.viewer.frames.pose import Pose, move_page_to
from lumisplat.viewer.panels.background_jobs import JobContext, Steps, file_bytes, still_config, view_callback
from lumisplat.viewer.panels.buttons import Channel, button
from lumisplat.viewer.panels.files import HEIGHTS
from lumisplat.viewer.server.event_queue import press_callback, value_callback

if TYPE_CHECKING:
    import viser


FORMATS = ("mp4", "gif", "webp")
_THUMBNAIL = (128, 72)
"""Width and height of the thumbnails of key views, pixels."""
_KEY_ROWS = 720
"""Image height, pixels, that the scene file stores for the camera of a new camera path."""


class VideoPanel:
    """Controls of the camera path and its video, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        context: Session and job runner. The camera path is the document's first camera with keyframes.
    """

    def __init__(self, gui: viser.GuiApi, context: JobContext) -> None:
        self._context, self._session = context, context.session
        self._list = gui.add_html("")
        self._channel = Channel(
            gui, {"sooner": self._sooner, "later": self._later, "delete": self._delete}, {"look": self._look}
        )
        self._thumbnails: dict[str, str] = {}
        """Thumbnail of each key view as a data URL, by a text with the key view's content."""
        hint = "Time from the last key view to the new one."
        self._seconds = gui.add_number("seconds to next", 2.0, min=0.1, max=3600.0, step=0.1, hint=hint)
        hint = "Appends the view of this page to the camera path."
        gui.add_button("add key view", hint=hint).on_click(
            view_callback(self._session, self._add, lambda: (float(self._seconds.value),))
        )
        gui.add_button("delete all key views").on_click(press_callback(self._delete_all))
        self._fps = gui.add_number("frames per second", 25.0, min=1.0, max=50.0, step=1.0)
        self._fps.on_update(value_callback(float, self._put_fps))
        with gui.add_folder("video"):
            self._height = gui.add_number("height (px)", 540, min=HEIGHTS[0], max=HEIGHTS[1], step=2)
            self._samples = gui.add_number("samples per pixel", 8, min=1, max=65536, step=1)
            self._format = gui.add_dropdown("format", FORMATS, hint="mp4 needs: pip install 'lumisplat[video]'")
            gui.add_button("render video").on_click(view_callback(self._session, self._render))
        self._shown: object = None
        self._session.on_change(self._show)

    def _show(self) -> None:
        document = self._session.state.document
        if self._shown is document.top:
            return
        self._shown = document.top
        self._list_keys()
        self._fps.value = float(document.top.get("animation", {}).get("fps", 25.0))

    def _list_keys(self) -> None:
        """Updates the HTML list of key views, and requests thumbnails that do not exist yet."""
        document = self._session.state.document
        keys = keys_of(document)
        names = [repr(sorted((name, value) for name, value in key.items() if name != "time")) for key in keys]
        self._thumbnails = {name: held for name, held in self._thumbnails.items() if name in names}
        for name, key in zip(names, keys, strict=True):
            if name not in self._thumbnails:
                self._thumbnails[name] = ""
                camera = camera_of(key, self._session.scene.up_direction, _THUMBNAIL)
                self._context.thumbnail(camera, partial(self._take_thumbnail, name))
        images = [self._thumbnails[name] for name in names]
        self._list.content = keys_html(keys, images, self._channel.id)

    def _take_thumbnail(self, name: str, picture: Picture) -> None:
        with self._session.changed:
            if name in self._thumbnails:
                self._thumbnails[name] = image_address(picture)
                self._list_keys()

    def _put_fps(self, fps: float) -> None:
        self._session.apply(lambda document: document.with_animation(fps=fps), merge="fps")

    def _add(self, _: Any, pose: Pose, seconds: float) -> None:
        key = Key(pose.camera(_KEY_ROWS, self._session.state.exposure), pose.target)
        self._session.apply(lambda document: with_key(document, key, seconds))

    def _sooner(self, number: int) -> None:
        self._session.apply(lambda document: with_key_moved(document, number, -1))

    def _later(self, number: int) -> None:
        self._session.apply(lambda document: with_key_moved(document, number, 1))

    def _delete(self, number: int) -> None:
        self._session.apply(lambda document: without_key(document, number))

    def _look(self, number: int, client: viser.ClientHandle) -> None:
        """Moves the camera of one page to the key view with an index."""
        keys, session = keys_of(self._session.state.document), self._session
        if number < len(keys):
            up = session.scene.up_direction
            move_page_to(client, camera_of(keys[number], up, _THUMBNAIL), session.extent.page_from_scene, up)

    def _delete_all(self, _: Any) -> None:
        if keys_of(self._session.state.document):
            self._session.apply(without_camera_path)

    def _render(self, event: Any, pose: Pose) -> None:
        still_renderer = self._context.still_renderer
        state, suffix = self._session.state, str(self._format.value)
        animation = state.document.animation
        if animation is None or (len(keys_of(state.document)) == 1 and not animation.has_moving_content):
            self._session.report(
                "there is no animation to render: add two key views, an animated actor, or keyframes of a light"
            )
            return
        config, height = still_config(state.config), int(np.clip(self._height.value, *HEIGHTS))
        cameras = video_cameras(animation, pose.camera(height, state.exposure))
        samples, client = int(self._samples.value), event.client

        def steps() -> Steps:
            renderer = still_renderer.renderer(config)
            with tempfile.TemporaryDirectory() as folder:
                files: list[Path] = []
                for number, (time, camera) in enumerate(zip(animation.times.tolist(), cameras, strict=True)):
                    scene = still_renderer.scene(state.document, config, time)
                    frame = yield from _part(
                        still_renderer.still(renderer, scene, camera, samples), number, len(cameras)
                    )
                    files.append(Path(folder) / f"{number:06d}.png")
                    Image.fromarray(frame_image(frame, "color")).save(files[-1], compress_level=1)
                video = video_file(map(ls.load_image, files), animation.fps, suffix)
            client.send_file_download(f"video.{suffix}", video, save_immediately=True)

        try:
            # A tiny video first, to report a missing encoder before rendering.
            video_file([np.zeros((16, 16, 3), np.float32)], animation.fps, suffix)
            self._context.jobs.start(f"video of {len(cameras)} frames", steps())
        except ls.LumisplatError as error:
            self._session.report(" ".join(str(error).split()))


def keys_html(keys: Sequence[Mapping[str, Any]], images: Sequence[str], channel: str) -> str:
    """Returns the HTML list of key views: a thumbnail, the time, and buttons for each.

    Args:
        keys: Keyframes of the camera path.
        images: Data URL of each thumbnail; an empty text for one that is not rendered yet.
        channel: Id of the text control that receives clicks: ``look``, ``sooner``, ``later`` or ``delete``, and the
            index of the key view.
    """
    if not keys:
        return '<div class="lumi-list">no camera path yet: go to its first view and press add key view</div>'
    cards: list[str] = []
    for number, (key, image) in enumerate(zip(keys, images, strict=True)):
        buttons = "".join(
            button(f"{command} {number}", icon_name, title)
            for command, icon_name, title in (
                ("sooner", "left", "earlier in the video"),
                ("later", "right", "later in the video"),
                ("delete", "cross", "delete"),
            )
        )
        look = f'role="button" tabindex="0" data-command="look {number}" title="go to this view"'
        picture = f'<img src="{image}" alt="key view {number + 1}" {look}>' if image else ""
        time = f'<span class="lumi-name">{float(key["time"]):g} s</span>'
        cards.append(f'<div class="lumi-key">{picture}<div class="lumi-row">{time}{buttons}</div></div>')
    return f'<div class="lumi-keys" data-to="{html.escape(channel)}">{"".join(cards)}</div>'


def image_address(picture: Picture) -> str:
    """Returns an image as a JPEG in a data URL, which HTML can show without another request."""
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "jpeg", quality=80)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


def video_cameras(animation: ls.Animation, view: ls.Camera) -> list[ls.Camera]:
    """Returns a camera for each frame of a video: along the camera path, or ``view`` for all frames without one.

    All cameras have the image height of ``view``.
    """
    path, count = animation.camera_path, animation.frame_count
    if path is None:
        return [view] * count
    return [path.at(time).scaled(height=view.height) for time in animation.times.tolist()]


def video_file(pictures: Iterable[npt.NDArray[np.float32]], fps: float, suffix: str) -> bytes:
    """Encodes images with values 0 to 1 as a video, and returns the file content; ``suffix`` selects the format.

    Raises:
        LumisplatError: The video cannot be encoded.
    """
    return file_bytes(f"video.{suffix}", lambda path: ls.save_animation(path, pictures, fps))


def _part(steps: Generator[float, None, ls.Frame], number: int, count: int) -> Generator[float, None, ls.Frame]:
    """Runs the steps of frame ``number`` of a video with ``count`` frames; yields the progress of the whole video.

    Returns the frame.
    """
    while True:
        try:
            share = next(steps)
        except StopIteration as done:
            yield (number + 1.0) / count
            return done.value
        yield (number + share) / count


_NAME = "flight"


@dataclass(frozen=True)
class Key:
    """Key view of the camera path: a camera, and the point that it looks at."""

    camera: ls.Camera
    target: tuple[float, float, float]
    """World position at which the camera of the key view looks, at the centre of its image."""

    def table(self, time: float) -> dict[str, Any]:
        """Returns the key view as a keyframe table of a scene file, at a time in seconds."""
        _, down, _ = self.camera.camera_from_world[:3, :3]
        table: dict[str, Any] = {
            "time": time,
            "eye": _plain(self.camera.eye),
            "target": _plain(self.target),
            "up": _plain(-down),
            "fov_y_degrees": float(f"{math.degrees(self.camera.fov_y):.6g}"),
        }
        return table | ({"exposure": self.camera.exposure} if self.camera.exposure else {})


def keys_of(document: ls.io.SceneDocument) -> list[Mapping[str, Any]]:
    """Returns the keyframe tables of the document's camera path, in order; empty without a camera path."""
    flights: list[list[Mapping[str, Any]]] = [t["keyframes"] for t in _cameras(document) if "keyframes" in t]
    return flights[0] if flights else []


def with_key(document: ls.io.SceneDocument, key: Key, seconds: float) -> ls.io.SceneDocument:
    """Returns the document with a key view appended to its camera path; the animation lasts at least as long.

    Args:
        document: The scene document.
        key: The key view.
        seconds: Time from the last key view to the new one, seconds.

    Raises:
        FormatError: A scene file cannot represent the key view.
    """
    held = keys_of(document)
    time = round(float(held[-1]["time"]) + seconds, 6) if held else 0.0
    document = _with_keys(document, [*held, key.table(time)], key.camera)
    animation = document.animation
    if animation is not None and animation.duration < time:
        document = document.with_animation(duration=time, frames=None)
    return document


def without_key(document: ls.io.SceneDocument, number: int) -> ls.io.SceneDocument:
    """Returns the document without the key view of an index; the times of later ones shrink to close the gap.

    Raises:
        SceneError: The key view does not exist.
    """
    keys = _checked_keys(document, number)
    times = [float(key["time"]) for key in keys]
    gap = times[number + 1] - times[number] if number + 1 < len(times) else 0.0
    later = [dict(key) | {"time": round(float(key["time"]) - gap, 6)} for key in keys[number + 1 :]]
    remaining: list[Mapping[str, Any]] = [*keys[:number], *later]
    return _with_keys(document, remaining, None)


def with_key_moved(document: ls.io.SceneDocument, number: int, by: int) -> ls.io.SceneDocument:
    """Returns the document with a key view and its neighbour on the camera path exchanged; the times stay.

    Without a neighbour on that side, returns the document unchanged.

    Args:
        document: The scene document.
        number: Index of the key view.
        by: -1 swaps with the previous key view, 1 with the next one.

    Raises:
        SceneError: The key view does not exist.
    """
    keys = _checked_keys(document, number)
    other = number + by
    if not 0 <= other < len(keys):
        return document
    order = list(range(len(keys)))
    order[number], order[other] = other, number
    moved: list[Mapping[str, Any]] = [
        dict(keys[source]) | {"time": keys[index]["time"]} for index, source in enumerate(order)
    ]
    return _with_keys(document, moved, None)


def camera_of(key: Mapping[str, Any], up: tuple[float, float, float], size: tuple[int, int]) -> ls.Camera:
    """Returns the camera of a keyframe table.

    Args:
        key: The keyframe.
        up: Up direction if the keyframe has none.
        size: Image width and height, pixels.
    """
    fov = math.radians(float(key.get("fov_y_degrees", 45.0)))
    eye, target = key.get("eye", (0.0, 0.0, 0.0)), key.get("target", (0.0, 0.0, 1.0))
    width, height = size
    return ls.Camera.look_at(eye, target, key.get("up", up), width=width, height=height, fov_y=fov)


def _checked_keys(document: ls.io.SceneDocument, number: int) -> list[Mapping[str, Any]]:
    keys = keys_of(document)
    if not 0 <= number < len(keys):
        raise ls.SceneError(f"there is no key view {number + 1}: the camera path has {len(keys)}")
    return keys


def without_camera_path(document: ls.io.SceneDocument) -> ls.io.SceneDocument:
    """Returns the document without its camera path."""
    return _with_keys(document, [], None)


def _with_keys(
    document: ls.io.SceneDocument, keys: list[Mapping[str, Any]], camera: ls.Camera | None
) -> ls.io.SceneDocument:
    """Returns the document with ``keys`` as the keyframes of its camera path; without keys, the path is removed.

    A document without a camera path gets one with the image size of ``camera``, unless that is None.
    """
    tables: list[dict[str, Any]] = []
    is_found = False
    for table in _cameras(document):
        if "keyframes" not in table or is_found:
            tables.append(dict(table))
        elif keys:
            tables.append(dict(table) | {"keyframes": keys})
        is_found = is_found or "keyframes" in table
    if not is_found and keys and camera is not None:
        tables.append({"name": _NAME, "width": camera.width, "height": camera.height, "keyframes": keys})
    return document.with_cameras(tables)


def _cameras(document: ls.io.SceneDocument) -> list[Mapping[str, Any]]:
    return cast("list[Mapping[str, Any]]", document.top.get("cameras", []))


def _plain(vector: Any) -> list[float]:
    """Converts a vector to a list of numbers with seven digits, for readable scene files."""
    return [float(f"{float(x):.7g}") for x in vector]
