"""The camera that flies: places along its way, and a film of it."""

from __future__ import annotations

import tempfile
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from PIL import Image

import lumisplat as ls
from lumisplat.viewer.frames.picture import picture_of
from lumisplat.viewer.output.stills import still_config
from lumisplat.viewer.panels.buttons import add_buttons
from lumisplat.viewer.panels.desk import Desk, file_bytes, pose_of_page
from lumisplat.viewer.panels.errands import Steps
from lumisplat.viewer.panels.pictures import HEIGHTS
from lumisplat.viewer.server.turns import chosen, pressed
from lumisplat.viewer.state.flight import Key, keys_of, with_key, without_flight, without_last_key

if TYPE_CHECKING:
    import viser

FORMATS = ("mp4", "gif", "webp")
_KEY_ROWS = 720
"""Of the camera that is saved with the scene."""


class FilmPanel:
    """Controls of the flight and its film, in the present folder.

    Args:
        gui: The pages' controls.
        desk: Its session has the scene, whose first camera with keyframes is the flight.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk, self._session = desk, desk.session
        self._table = gui.add_markdown("")
        hint = "From the last place of the flight to the next one."
        self._seconds = gui.add_number("seconds", 2.0, min=0.1, max=3600.0, step=0.1, hint=hint)
        hint = "The place from which this page looks becomes the next one of the flight."
        gui.add_button("add this view", hint=hint).on_click(pressed(self._add))
        add_buttons(gui, ["drop the last", "drop all"], self._drop)
        self._fps = gui.add_number("frames a second", 25.0, min=1.0, max=50.0, step=1.0)
        self._fps.on_update(chosen(float, self._put_fps))
        self._height = gui.add_number("film rows", 540, min=HEIGHTS[0], max=HEIGHTS[1], step=2)
        self._samples = gui.add_number("film samples", 8, min=1, max=65536, step=1, hint="A pixel of each frame.")
        self._format = gui.add_dropdown("film format", FORMATS, hint="mp4 takes pip install 'lumisplat[video]'.")
        gui.add_button("make the film").on_click(pressed(self._film))
        self._shown: object = None
        self._session.on_change(self._show)

    def _show(self) -> None:
        document = self._session.state.document
        if self._shown is document.top:
            return
        self._shown = document.top
        self._table.content = flight_table(document)
        self._fps.value = float(document.top.get("animation", {}).get("fps", 25.0))

    def _put_fps(self, fps: float) -> None:
        self._session.apply(lambda document: document.with_animation(fps=fps), merge="fps")

    def _add(self, event: Any) -> None:
        pose = pose_of_page(self._desk.pages, event)
        if pose is None:
            return
        key = Key(pose.camera(_KEY_ROWS, self._session.state.exposure), pose.target)
        seconds = float(self._seconds.value)
        self._session.apply(lambda document: with_key(document, key, seconds))

    def _drop(self, which: str) -> None:
        if keys_of(self._session.state.document):
            self._session.apply(without_last_key if which == "drop the last" else without_flight)

    def _film(self, event: Any) -> None:
        pose, studio = pose_of_page(self._desk.pages, event), self._desk.studio
        if pose is None:
            return
        state, suffix = self._session.state, str(self._format.value)
        animation = state.document.animation
        if animation is None or (len(keys_of(state.document)) == 1 and not animation.actors):
            self._session.report("there is nothing to film: add two views, or an actor that moves")
            return
        config, height = still_config(state.config), int(np.clip(self._height.value, *HEIGHTS))
        cameras = film_cameras(animation, pose.camera(height, state.exposure))
        samples, client = int(self._samples.value), event.client

        def steps() -> Steps:
            renderer = studio.renderer(config)
            with tempfile.TemporaryDirectory() as folder:
                files: list[Path] = []
                for number, (time, camera) in enumerate(zip(animation.times.tolist(), cameras, strict=True)):
                    scene = studio.scene(state.document, config, time)
                    frame = yield from _part(studio.still(renderer, scene, camera, samples), number, len(cameras))
                    files.append(Path(folder) / f"{number:06d}.png")
                    Image.fromarray(picture_of(frame, "color")).save(files[-1], compress_level=1)
                film = film_file(map(ls.load_image, files), animation.fps, suffix)
            client.send_file_download(f"film.{suffix}", film, save_immediately=True)

        try:
            film_file([np.zeros((16, 16, 3), np.float32)], animation.fps, suffix)  # now, not after an hour of frames
            self._desk.errands.start(f"film of {len(cameras)} frames", steps())
        except ls.LumisplatError as error:
            self._session.report(" ".join(str(error).split()))


def flight_table(document: ls.SceneDocument) -> str:
    """The places of the flight, as a table."""
    keys = keys_of(document)
    if not keys:
        return "no flight yet: look from where it starts, and add that view"
    rows = [f"| {float(key['time']):g} s | {_place(key.get('eye'))} | {_place(key.get('target'))} |" for key in keys]
    return "\n".join(["| at | from | towards |", "| ---: | --- | --- |", *rows])


def film_cameras(animation: ls.Animation, view: ls.Camera) -> list[ls.Camera]:
    """The camera of each frame: along the flight, else where a page looks from, with as many rows as that has."""
    path, count = animation.camera_path, animation.frame_count
    if path is None:
        return [view] * count
    return [path.at(time).scaled(height=view.height) for time in animation.times.tolist()]


def film_file(pictures: Iterable[npt.NDArray[np.float32]], fps: float, suffix: str) -> bytes:
    """The bytes of a film of pictures, 0..1.

    Raises:
        LumisplatError: It cannot be made.
    """
    return file_bytes(f"film.{suffix}", lambda path: ls.save_animation(path, pictures, fps))


def _part(steps: Generator[float, None, ls.Frame], number: int, count: int) -> Generator[float, None, ls.Frame]:
    """The steps of one frame as steps of all of them."""
    while True:
        try:
            share = next(steps)
        except StopIteration as done:
            yield (number + 1.0) / count
            return done.value
        yield (number + share) / count


def _place(values: Any) -> str:
    return "" if values is None else ", ".join(f"{float(x):z.3g}" for x in values)
