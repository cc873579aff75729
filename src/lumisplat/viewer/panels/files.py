"""Out of the viewer: the scene file, pictures, the command that renders the same."""

from __future__ import annotations

import re
import shlex
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.panels.notes import tell
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,80}\.toml")
_FORMATS = ("png", "exr")
_HEIGHTS = (16, 8192)


class FilesPanel:
    """Controls that save, in the present folder.

    Args:
        server: Tells pages what was saved.
        session: Has the scene.
        pages: Open pages by the id of their connection.
        device: Where pictures are rendered.
    """

    def __init__(self, server: viser.ViserServer, session: Session, pages: dict[int, Page], device: str) -> None:
        gui = server.gui
        self._server, self._session, self._pages, self._device = server, session, pages, device
        self._name = gui.add_text("scene file", "edited.toml", hint="Beside the scene that was opened.")
        self._overwrite = gui.add_checkbox("overwrite", False, hint="Replace a file of that name.")
        gui.add_button("save the scene").on_click(lambda _: self._save())
        self._height = gui.add_number("picture rows", 1080, min=_HEIGHTS[0], max=_HEIGHTS[1], step=1)
        self._samples = gui.add_number("picture samples", 64, min=1, max=65536, step=1)
        self._format = gui.add_dropdown("picture format", _FORMATS)
        gui.add_button("take a picture").on_click(self._shoot)
        gui.add_button("command line").on_click(self._show_command)

    def suggest(self, document: ls.SceneDocument) -> None:
        """Suggests a name that is not that of the file that was opened."""
        self._name.value = f"{document.file.stem}-edited.toml"

    def save(self) -> bool:
        """Saves the scene file; whether it could."""
        target = self._target()
        if target is None:
            given = str(self._name.value)[:90]
            self._session.report(f"scene file is '{given}', expected a plain name that ends in .toml")
            return False
        state = self._session.state
        try:
            state.document.with_config(state.config).save(target, overwrite=bool(self._overwrite.value))
        except ls.LumisplatError as error:
            self._session.report(str(error))
            return False
        self._overwrite.value = False
        tell(self._server, "saved", str(target))
        return True

    def _save(self) -> None:
        self.save()

    def _target(self) -> Path | None:
        """The file of the name that was typed, beside the scene; None: it is no plain name."""
        name = str(self._name.value).strip()
        folder = self._session.state.document.file.absolute().parent
        return folder / name if _PLAIN_NAME.fullmatch(name) else None

    # --- Pictures ---

    def _shoot(self, event: Any) -> None:
        page = self._pages.get(event.client_id)
        if page is None or page.pose is None:
            return
        threading.Thread(target=self._render, args=(page,), name="lumisplat picture", daemon=True).start()

    def _render(self, page: Page) -> None:
        """Renders a page's view at any size and sends it to the page as a download."""
        assert page.pose is not None
        state, scene = self._session.state, self._session.scene
        suffix = str(self._format.value)
        note = page.client.add_notification("taking a picture", "rendering", loading=True, with_close_button=False)
        try:
            content = picture_bytes(
                scene,
                page.pose.camera(int(np.clip(self._height.value, *_HEIGHTS)), state.exposure),
                picture_config(scene, state.config, int(self._samples.value)),
                self._device,
                suffix if suffix in _FORMATS else "png",
            )
            page.client.send_file_download(f"view.{suffix}", content)
        except ls.LumisplatError as error:
            self._session.report(str(error))
        finally:
            note.remove()

    def _show_command(self, event: Any) -> None:
        page = self._pages.get(event.client_id)
        if page is None or page.pose is None:
            return
        target = self._target() or Path("edited.toml")
        line = command_line(target, page, self._session.state.exposure)
        with page.client.gui.add_modal("the same from the command line") as modal:
            page.client.gui.add_markdown(f"Save the scene first, then:\n\n```\n{line}\n```")
            page.client.gui.add_button("close").on_click(lambda _: modal.close())


def picture_config(scene: ls.Scene, config: ls.RenderConfig, samples: int) -> ls.RenderConfig:
    """Settings of a picture with so many samples, where the pipeline has any."""
    if config.pipeline is ls.Pipeline.REALTIME:
        return config
    return replace(config, samples=max(1, samples), noise=None, time_limit=None, adaptive=None)


def picture_bytes(scene: ls.Scene, camera: ls.Camera, config: ls.RenderConfig, device: str, suffix: str) -> bytes:
    """A rendered picture as the bytes of a file.

    Raises:
        LumisplatError: It cannot be rendered.
    """
    frame = ls.render(scene, camera, config, device=device)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"view.{suffix}"
        frame.save(path)
        return path.read_bytes()


def command_line(scene_file: Path, page: Page, exposure: float) -> str:
    """The command that renders a page's view of a saved scene."""
    assert page.pose is not None
    camera = page.pose.camera(1080)
    matrix = np.linalg.inv(camera.camera_from_world)
    eye, forward = matrix[:3, 3], matrix[:3, 2]
    target = eye + forward * max(page.pose.focus, 1e-3)
    numbers = {"--eye": eye, "--target": target}
    words = ["lumisplat", "render", shlex.quote(str(scene_file))]
    words += [f"{name}={','.join(f'{x:.6g}' for x in values)}" for name, values in numbers.items()]
    words += [f"--fov {np.degrees(page.pose.fov_y):.5g}", f"--width {camera.width}", f"--height {camera.height}"]
    words += [f"--exposure {exposure:g}"] if exposure else []
    return " ".join([*words, "-o view.png"])
