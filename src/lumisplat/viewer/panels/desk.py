"""What images and videos are made with, for a page that asks for one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lumisplat as ls
from lumisplat.viewer.frames.page import Page
from lumisplat.viewer.frames.picture import Picture
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.output.stills import Studio
from lumisplat.viewer.panels.errands import Errands
from lumisplat.viewer.state.session import Session


@dataclass(frozen=True)
class Desk:
    """The session, the pages, and who does the work."""

    session: Session
    pages: Mapping[int, Page]
    """Open pages by the id of their connection."""
    errands: Errands
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
