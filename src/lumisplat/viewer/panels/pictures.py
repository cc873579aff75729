"""Pictures out of the viewer: of any size, with layers, and the captures as a page that needs no server."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.output.capture_page import capture_page
from lumisplat.viewer.output.stills import still_config
from lumisplat.viewer.panels.desk import Desk, file_bytes, pose_of_page
from lumisplat.viewer.panels.errands import Steps
from lumisplat.viewer.server.turns import pressed

if TYPE_CHECKING:
    import viser

FORMATS = ("png", "exr")
HEIGHTS = (16, 8192)
_LAYERS_HINT = (
    "Of an EXR, besides depth, normals, positions and indices, which it always has: some of albedo, emission, "
    "reflection, lights, hits, sample_count; of paths and in real time direct_diffuse, indirect_diffuse, "
    "direct_glossy, indirect_glossy, too. With commas."
)


class PicturesPanel:
    """Controls that make pictures, in the present folder; a page gets what it asked for as a download.

    Args:
        gui: The pages' controls.
        desk: Its session has the scene.
    """

    def __init__(self, gui: viser.GuiApi, desk: Desk) -> None:
        self._desk, self._session = desk, desk.session
        self._height = gui.add_number("height (px)", 1080, min=HEIGHTS[0], max=HEIGHTS[1], step=1)
        hint = "0: as wide as the page shows it."
        self._width = gui.add_number("width (px)", 0, min=0, max=HEIGHTS[1], step=1, hint=hint)
        self._samples = gui.add_number("samples per pixel", 64, min=1, max=65536, step=1)
        self._format = gui.add_dropdown("format", FORMATS, hint="PNG: as shown. EXR: linear light, with layers.")
        self._layers = gui.add_text("layers", "", hint=_LAYERS_HINT)
        gui.add_button("render image").on_click(pressed(self._for_page(self._picture)))
        hint = "One file with the captures as captured, without lights: it opens in any browser, without a server."
        gui.add_button("export captures as HTML", hint=hint).on_click(pressed(self._for_page(self._capture_page)))

    def _for_page(self, start: Callable[[viser.ClientHandle, Pose], None]) -> Callable[[Any], None]:
        def on_click(event: Any) -> None:
            pose = pose_of_page(self._desk.pages, event)
            if pose is None:
                return
            try:
                start(event.client, pose)
            except ls.LumisplatError as error:
                self._session.report(str(error))

        return on_click

    def _picture(self, client: viser.ClientHandle, pose: Pose) -> None:
        """Renders a page's view at any size."""
        state, suffix = self._session.state, str(self._format.value)
        height, studio = int(np.clip(self._height.value, *HEIGHTS)), self._desk.studio
        if self._width.value:
            pose = replace(pose, aspect=int(np.clip(self._width.value, *HEIGHTS)) / height)
        layers = listed(str(self._layers.value)) if suffix == "exr" else ()
        config = still_config(state.config, layers)
        camera, samples = pose.camera(height, state.exposure), int(self._samples.value)
        time = self._session.options.time

        def steps() -> Steps:
            scene = studio.scene(state.document, config, time)
            renderer = studio.renderer(config)
            _as_file(renderer.render(scene, camera.scaled(height=HEIGHTS[0])), suffix, layers)  # fails now, not at last
            renderer.reset()
            frame = yield from studio.still(renderer, scene, camera, samples)
            client.send_file_download(f"view.{suffix}", _as_file(frame, suffix, layers), save_immediately=True)

        self._desk.errands.start(f"image of {camera.width} × {camera.height}", steps())

    def _capture_page(self, client: viser.ClientHandle, _: Pose) -> None:
        """Makes a page of the captures, as captured."""
        document = self._session.state.document
        scene = document.scene() if document.animation is None else document.animation.scene
        if not scene.splats:
            raise ls.SceneError("export captures as HTML: there is no capture that stands still")

        def steps() -> Steps:
            yield 0.0
            client.send_file_download("capture.html", capture_page(scene).encode(), save_immediately=True)

        self._desk.errands.start("captures as HTML", steps())


def listed(layers: str) -> tuple[str, ...]:
    """Names that were typed with commas."""
    return tuple(name.strip() for name in layers.split(",") if name.strip())


def _as_file(frame: ls.Frame, suffix: str, layers: tuple[str, ...]) -> bytes:
    """The bytes of a frame's file; an EXR has layers besides those of every frame.

    Raises:
        ConfigError: The frame has no such layer.
    """
    always = tuple(name for name in ls.Frame.LAYERS if name not in ls.Frame.NEEDS)
    wanted = dict.fromkeys((*always, *layers)) if suffix == "exr" else None
    return file_bytes(f"view.{suffix}", lambda path: frame.save(path, wanted))
