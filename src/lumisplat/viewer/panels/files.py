"""Saves the scene file, shows the equivalent command line, and exports images and captures."""

from __future__ import annotations

import html
import re
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.panels.background_jobs import (
    JobContext,
    Steps,
    captures_html,
    file_bytes,
    still_config,
    view_callback,
)
from lumisplat.viewer.panels.status import Notifications
from lumisplat.viewer.server.event_queue import press_callback
from lumisplat.viewer.session import Session

if TYPE_CHECKING:
    import viser


_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,80}\.toml")
_ROWS = 1080
"""Image height in the command line that `command_line` returns, pixels."""


class FilesPanel:
    """Controls that save the scene file and show the command that renders it, in viser's open GUI folder.

    Args:
        gui: Controls of the pages.
        notifications: Shows notifications on pages.
        session: Session to save.
    """

    def __init__(self, gui: viser.GuiApi, notifications: Notifications, session: Session) -> None:
        self._notifications, self._session = notifications, session
        self._name = gui.add_text("scene file", "edited.toml", hint="File name, in the folder of the opened scene.")
        self._overwrite = gui.add_checkbox("overwrite", False, hint="Replaces an existing file of that name.")
        gui.add_button("save scene").on_click(press_callback(lambda _: self.save()))
        gui.add_button("command line").on_click(view_callback(session, self._show_command))

    def suggest(self, document: ls.io.SceneDocument) -> None:
        """Fills in a file name to save a document under, other than the name of the file it was opened from."""
        stem = re.sub(r"[^A-Za-z0-9 ._-]", "_", document.file.stem).lstrip(" ._-") or "scene"
        self._name.value = f"{stem[:70]}-edited.toml"

    def save(self) -> None:
        """Saves the scene file and notifies the pages of the result."""
        target = self._target()
        if target is None:
            given = str(self._name.value)[:90]
            self._session.report(f"scene file is '{given}', expected a file name that ends in .toml, without folders")
            return
        state = self._session.state
        left_out, overwrites = len(state.document.problems), bool(self._overwrite.value)
        if left_out and overwrites and target.exists():
            self._session.report(
                f"{target.name} is not replaced: {left_out} of its objects could not be read and would be lost"
            )
            return
        try:
            state.document.with_config(state.config).save(target, overwrite=overwrites)
        except ls.LumisplatError as error:
            self._session.report(str(error))
            return
        self._overwrite.value = False
        self._notifications.notify(
            "saved", f"{target}{f', without {left_out} objects that could not be read' * bool(left_out)}"
        )

    def _target(self) -> Path | None:
        """Returns the path to save to: the typed name in the scene file's folder; None if the name is not allowed."""
        name = str(self._name.value).strip()
        folder = self._session.state.document.file.absolute().parent
        return folder / name if _PLAIN_NAME.fullmatch(name) else None

    def _show_command(self, event: Any, pose: Pose) -> None:
        client: viser.ClientHandle = event.client
        line = command_line(self._target() or Path("edited.toml"), pose, self._session)
        with client.gui.add_modal("command line") as modal:
            client.gui.add_markdown("Save the scene, then run this command to render the same view:")
            client.gui.add_html(f'<textarea readonly rows="5" class="lumi-command">{html.escape(line)}</textarea>')
            client.gui.add_button("close").on_click(press_callback(lambda _: modal.close()))


def command_line(scene_file: Path, pose: Pose, session: Session) -> str:
    """Returns the ``lumisplat render`` command for a page's view of a saved scene.

    Args:
        scene_file: The saved scene file.
        pose: Camera of the page.
        session: Session with the settings, and with the animation time if the scene has actors.
    """
    state, camera = session.state, pose.camera(_ROWS, session.state.exposure)
    has_actors = any(entry.actor is not None and not entry.hidden for entry in state.document.entries)
    words = ["lumisplat", "animate" if has_actors else "render", shlex.quote(str(scene_file))]
    # The equals sign keeps a negative value from being parsed as an option.
    words += [
        f"{name}={','.join(f'{x:.12g}' for x in at)}"
        for name, at in (("--eye", pose.position), ("--target", pose.target))
    ]
    words += session.options.loading
    words += [f"--fov {np.degrees(pose.fov_y):.5g}", f"--width {camera.width}", f"--height {camera.height}"]
    words += [f"--exposure={camera.exposure:g}"] if camera.exposure else []
    if state.config.samples and not state.config.pipeline.is_sequence:  # realtime samples are in the scene file
        words.append(f"--samples {state.config.samples}")
    if has_actors and (animation := state.document.animation) is not None:
        number = min(round(session.options.time * animation.fps), animation.frame_count - 1)
        return " ".join([*words, f"--frames {number}", "-o frames"])
    return " ".join([*words, "-o view.png"])


FORMATS = ("png", "exr")
HEIGHTS = (16, 8192)
_LAYERS_HINT = (
    "Extra EXR layers, separated by commas: albedo, emission, reflection, lights, hits, sample_count; for path and "
    "realtime pipelines also direct_diffuse, indirect_diffuse, direct_glossy, indirect_glossy. Depth, normals, "
    "positions and indices are always included."
)


class ImagesPanel:
    """Controls that render still images and export captures; the page that asks for a file downloads it.

    Args:
        gui: Controls of the pages.
        context: Session and job runner.
    """

    def __init__(self, gui: viser.GuiApi, context: JobContext) -> None:
        self._context, self._session = context, context.session
        self._height = gui.add_number("height (px)", 1080, min=HEIGHTS[0], max=HEIGHTS[1], step=1)
        hint = "0 uses the aspect ratio of the page."
        self._width = gui.add_number("width (px)", 0, min=0, max=HEIGHTS[1], step=1, hint=hint)
        self._samples = gui.add_number("samples per pixel", 64, min=1, max=65536, step=1)
        self._format = gui.add_dropdown("format", FORMATS, hint="PNG: as displayed. EXR: linear radiance, with layers.")
        self._layers = gui.add_text("layers", "", hint=_LAYERS_HINT)
        gui.add_button("render image").on_click(self._callback(self._picture))
        hint = "Exports the captures, unlit, as one file that opens in any browser without a server."
        gui.add_button("export captures as HTML", hint=hint).on_click(self._callback(self._export_captures))

    def _callback(self, start: Callable[[viser.ClientHandle, Pose], None]) -> Any:
        """Returns a button's callback that calls ``start`` and reports its errors."""

        def on_click(event: Any, pose: Pose) -> None:
            try:
                start(event.client, pose)
            except ls.LumisplatError as error:
                self._session.report(str(error))

        return view_callback(self._session, on_click)

    def _picture(self, client: viser.ClientHandle, pose: Pose) -> None:
        """Starts a background job that renders a page's view in the chosen size, and sends the file to the page."""
        state, suffix = self._session.state, str(self._format.value)
        height, still_renderer = int(np.clip(self._height.value, *HEIGHTS)), self._context.still_renderer
        if self._width.value:
            pose = replace(pose, aspect=int(np.clip(self._width.value, *HEIGHTS)) / height)
        layers = listed(str(self._layers.value)) if suffix == "exr" else ()
        config = still_config(state.config, layers)
        camera, samples = pose.camera(height, state.exposure), int(self._samples.value)
        time = self._session.options.time

        def steps() -> Steps:
            scene = still_renderer.scene(state.document, config, time)
            renderer = still_renderer.renderer(config)
            # A tiny frame first, to report an invalid layer before rendering.
            _as_file(renderer.render(scene, camera.scaled(height=HEIGHTS[0])), suffix, layers)
            renderer.reset()
            frame = yield from still_renderer.still(renderer, scene, camera, samples)
            client.send_file_download(f"view.{suffix}", _as_file(frame, suffix, layers), save_immediately=True)

        self._context.jobs.start(f"image of {camera.width} × {camera.height}", steps())

    def _export_captures(self, client: viser.ClientHandle, _: Pose) -> None:
        """Starts a background job that exports the captures, as captured, as an HTML page for download."""
        document = self._session.state.document
        scene = document.scene() if document.animation is None else document.animation.scene
        if not scene.splats:
            raise ls.SceneError("export captures as HTML: the scene has no static capture")

        def steps() -> Steps:
            yield 0.0
            client.send_file_download("capture.html", captures_html(scene).encode(), save_immediately=True)

        self._context.jobs.start("captures as HTML", steps())


def listed(layers: str) -> tuple[str, ...]:
    """Splits a text such as ``depth, normal`` into names."""
    return tuple(name.strip() for name in layers.split(",") if name.strip())


def _as_file(frame: ls.Frame, suffix: str, layers: tuple[str, ...]) -> bytes:
    """Encodes a frame as the content of an image file.

    Args:
        frame: The frame.
        suffix: Extension that selects the format.
        layers: Layers to store in an EXR in addition to those of every frame.

    Raises:
        ConfigError: The frame does not have a layer.
    """
    always = tuple(name for name in ls.Frame.LAYERS if name not in ls.Frame.NEEDS)
    wanted = dict.fromkeys((*always, *layers)) if suffix == "exr" else None
    return file_bytes(f"view.{suffix}", lambda path: frame.save(path, wanted))
