"""Long jobs for a page, such as a video: one at a time, with progress and a button that cancels it."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import lumisplat as ls
from lumisplat.viewer.frames.page import Page, Picture
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.output import Studio
from lumisplat.viewer.server.event_queue import pressed
from lumisplat.viewer.state.session import Session

if TYPE_CHECKING:
    import viser


Steps = Generator[float, None, None]
"""Work in steps: each gives the share that is done, 0..1."""


class BackgroundJobs:
    """Progress and a button to cancel, hidden while there is nothing to do, in the present folder.

    Args:
        gui: The pages' controls.
        do: Does the steps, in its own thread.
    """

    def __init__(self, gui: viser.GuiApi, do: Callable[[Generator[None]], None]) -> None:
        self._do = do
        self._line = gui.add_markdown("", visible=False)
        self._bar = gui.add_progress_bar(0.0, visible=False)
        self._button = gui.add_button("cancel", visible=False, color="red")
        self._button.on_click(pressed(self._cancel))
        self._is_busy = self._is_cancelled = False

    def start(self, label: str, steps: Steps) -> None:
        """Starts the work.

        Raises:
            ConfigError: Other work is not done yet.
        """
        if self._is_busy:
            steps.close()
            raise ls.ConfigError(f"{label}: wait for what is being made, or cancel it")
        self._is_busy, self._is_cancelled = True, False
        self._line.content = label
        self._show(0.0)
        self._do(self._steps(steps))

    def _steps(self, steps: Steps) -> Generator[None]:
        try:
            for share in steps:
                if self._is_cancelled:
                    return
                self._show(share)
                yield
        finally:
            steps.close()
            self._is_busy = False
            self._line.visible = self._bar.visible = self._button.visible = False

    def _show(self, share: float) -> None:
        self._bar.value = 100.0 * share
        self._line.visible = self._bar.visible = self._button.visible = True

    def _cancel(self, _: Any) -> None:
        self._is_cancelled = True


@dataclass(frozen=True)
class JobContext:
    """The session, the pages, and who does the work."""

    session: Session
    pages: Mapping[int, Page]
    """Open pages by the id of their connection."""
    jobs: BackgroundJobs
    studio: Studio
    thumbnail: Callable[[ls.Camera, Callable[[Picture], object]], None]
    """Renders a small image of the scene soon, and passes it on."""


def pose_of_page(pages: Mapping[int, Page], event: Any) -> Pose | None:
    """From where the page looks on which something was pressed; None: it has gone, or has not said it yet."""
    page = pages.get(event.client_id)
    return None if page is None else page.pose


def file_bytes(name: str, write: Callable[[Path], None]) -> bytes:
    """The bytes of a file that something writes.

    Args:
        name: Of the file; its extension says the format.
        write: Writes it to a path.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()
