"""Out of the viewer: the scene file, and the command that renders the same."""

from __future__ import annotations

import html
import re
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.panels.desk import pose_of_page
from lumisplat.viewer.panels.notes import Notes
from lumisplat.viewer.server.turns import pressed
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser

_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 ._-]{0,80}\.toml")
_ROWS = 1080
"""Of the picture that a command renders."""


class FilesPanel:
    """Controls that save, in the present folder.

    Args:
        gui: The pages' controls.
        notes: Tells pages what was saved.
        session: Has the scene.
        pages: Open pages by the id of their connection.
    """

    def __init__(self, gui: viser.GuiApi, notes: Notes, session: Session, pages: dict[int, Page]) -> None:
        self._notes, self._session, self._pages = notes, session, pages
        self._name = gui.add_text("scene file", "edited.toml", hint="Beside the scene that was opened.")
        self._overwrite = gui.add_checkbox("overwrite", False, hint="Replace a file of that name.")
        gui.add_button("save the scene").on_click(pressed(lambda _: self.save()))
        gui.add_button("command line").on_click(pressed(self._show_command))

    def suggest(self, document: ls.SceneDocument) -> None:
        """Suggests a name that is not that of the file that was opened."""
        stem = re.sub(r"[^A-Za-z0-9 ._-]", "_", document.file.stem).lstrip(" ._-") or "scene"
        self._name.value = f"{stem[:70]}-edited.toml"

    def save(self) -> None:
        """Saves the scene file, and tells that, or why not."""
        target = self._target()
        if target is None:
            given = str(self._name.value)[:90]
            self._session.report(f"scene file is '{given}', expected a plain name that ends in .toml")
            return
        state = self._session.state
        left_out, overwrites = len(state.document.problems), bool(self._overwrite.value)
        if left_out and overwrites and target.exists():
            self._session.report(
                f"{target.name} is not replaced: {left_out} of its things could not be read, and would go"
            )
            return
        try:
            state.document.with_config(state.config).save(target, overwrite=overwrites)
        except ls.LumisplatError as error:
            self._session.report(str(error))
            return
        self._overwrite.value = False
        self._notes.tell("saved", f"{target}{f', without {left_out} things that could not be read' * bool(left_out)}")

    def _target(self) -> Path | None:
        """The file of the name that was typed, beside the scene; None: it is no plain name."""
        name = str(self._name.value).strip()
        folder = self._session.state.document.file.absolute().parent
        return folder / name if _PLAIN_NAME.fullmatch(name) else None

    def _show_command(self, event: Any) -> None:
        client: viser.ClientHandle = event.client
        pose = pose_of_page(self._pages, event)
        if pose is None:
            return
        line = command_line(self._target() or Path("edited.toml"), pose, self._session)
        with client.gui.add_modal("the same from the command line") as modal:
            client.gui.add_markdown("Save the scene first, then run this in a shell:")
            client.gui.add_html(f'<textarea readonly rows="5" class="lumi-command">{html.escape(line)}</textarea>')
            client.gui.add_button("close").on_click(pressed(lambda _: modal.close()))


def command_line(scene_file: Path, pose: Pose, session: Session) -> str:
    """The command that renders what a page shows of a saved scene; of one with actors, the frame of that time.

    Args:
        scene_file: The saved scene.
        pose: Where the page looks from.
        session: Has the scene.
    """
    state, camera = session.state, pose.camera(_ROWS, session.state.exposure)
    has_actors = any(entry.actor is not None and not entry.hidden for entry in state.document.entries)
    words = ["lumisplat", "animate" if has_actors else "render", shlex.quote(str(scene_file))]
    # An equals sign: a value that begins with a minus sign would be taken for an option.
    words += [
        f"{name}={','.join(f'{x:.12g}' for x in at)}"
        for name, at in (("--eye", pose.position), ("--target", pose.target))
    ]
    words += session.options.loading
    words += [f"--fov {np.degrees(pose.fov_y):.5g}", f"--width {camera.width}", f"--height {camera.height}"]
    words += [f"--exposure={camera.exposure:g}"] if camera.exposure else []
    if state.config.samples and not state.config.pipeline.is_sequence:  # there, they are the scene file's
        words.append(f"--samples {state.config.samples}")
    if has_actors and (animation := state.document.animation) is not None:
        number = min(round(session.options.time * animation.fps), animation.frame_count - 1)
        return " ".join([*words, f"--frames {number}", "-o frames"])
    return " ".join([*words, "-o view.png"])
