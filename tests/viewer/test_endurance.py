"""Long work at the viewer, made short: three pages edit at once."""

from __future__ import annotations

import contextlib
import gc
import threading
from pathlib import Path

import pytest

import lumisplat as ls
from support.viewer.endurance import WEIGHTS, LeanPage, endured, orbit, scene_in, wait_until

MEMORY_MIB = 60.0
"""What a hundred edits may add: undo keeps them, and allocators do not give all back. An edit that is kept for each
frame, or a page that is never forgotten, takes more."""


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")  # of a page that closes while it is sent to
@pytest.mark.parametrize(
    "edits", [pytest.param(120, id="short"), pytest.param(3000, id="long", marks=pytest.mark.deep)]
)
def test_no_edit_is_lost_and_nothing_is_left_behind(edits: int, tmp_path: Path) -> None:
    """Each edit of a page is in the document, as often as it was undone; pages that close leave no thread."""
    report = endured(edits, tmp_path, seed=1)
    assert report.done.total() == edits and report.done.keys() == WEIGHTS.keys()
    assert report.threads[0] == report.threads[1] and report.errors == []
    assert report.memory_mib[-1] - report.memory_mib[0] < MEMORY_MIB


def test_what_is_pressed_at_once_is_done_in_its_order(tmp_path: Path) -> None:
    """No press is taken for the next one, and no drag ends before it begins."""
    viewer = ls.view(scene_in(tmp_path), height=90, device="cpu")
    viewer._loader.join()
    session = viewer._session
    lamp = next(entry.id for entry in viewer.document.entries if entry.kind == "lights")
    session.select(lamp)
    with LeanPage(viewer.url) as page:
        page.look(orbit(0.0))
        wait_until(lambda: bool(viewer._pages), "the page is not there")
        for number in range(1, 11):
            page.send("TransformControlsDragStartMessage", name=viewer._gizmo.node)
            for share in (0.3, 0.6, 1.0):
                place = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [share * number, -1.0, 0.0]}
                page.send("TransformControlsUpdateMessage", name=viewer._gizmo.node, **place)
            page.send("TransformControlsDragEndMessage", name=viewer._gizmo.node)
            for button in ("undo", "redo", "undo", "redo"):
                page.push(button)
        wait_until(lambda: list(viewer.document.entry(lamp).table["position"]) == [10.0, -1.0, 0.0], "a drag is lost")
        wait_until(
            lambda: len(session._past) == 10 and not session._future, "a drag is not one edit, or a press is lost"
        )
    viewer.close()


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")
def test_viewers_close_while_pages_go_on_asking(tmp_path: Path) -> None:
    """Without a word of Python's about what was never begun, which the suite takes for an error."""
    for _ in range(3):
        viewer = ls.view(scene_in(tmp_path), height=90, device="cpu")
        viewer._loader.join()
        with LeanPage(viewer.url) as page:
            page.look(orbit(0.0))
            wait_until(lambda viewer=viewer: bool(viewer._pages), "the page is not there")
            asking = threading.Thread(target=ask_on, args=(page,))
            asking.start()
            viewer.close()
            asking.join()
        gc.collect()


def ask_on(page: LeanPage) -> None:
    """Presses buttons until nobody is there."""
    with contextlib.suppress(Exception):
        for _ in range(4000):
            page.push("undo")
