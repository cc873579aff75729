"""Three pages of a viewer edit its scene at the same time, in a short endurance run."""

from __future__ import annotations

import contextlib
import gc
import threading
from pathlib import Path

import pytest

import lumisplat as ls
from support.viewer.endurance import WEIGHTS, LeanPage, endured, orbit, scene_in, wait_until

MEMORY_MIB = 60.0
"""Memory that a hundred edits may add, MiB: undo stores the edits, and allocators do not return all memory. Storing an
edit for each frame of a drag, or the data of a closed page, would exceed the limit."""


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")  # a page may close during a send
@pytest.mark.parametrize(
    "edits", [pytest.param(120, id="short"), pytest.param(3000, id="long", marks=pytest.mark.deep)]
)
def test_viewer_loses_none_of_many_concurrent_edits_and_leaves_no_threads(edits: int, tmp_path: Path) -> None:
    """The document has every edit that was not undone, and closed pages leave no thread."""
    report = endured(edits, tmp_path, seed=1)
    assert report.done.total() == edits and report.done.keys() == WEIGHTS.keys()
    assert report.threads[0] == report.threads[1] and report.errors == []
    assert report.memory_mib[-1] - report.memory_mib[0] < MEMORY_MIB


def test_viewer_handles_events_that_a_page_sends_at_once_in_their_order(tmp_path: Path) -> None:
    """Ten drags, each followed by undo and redo, are ten edits in the order in which the page sent them."""
    viewer = ls.view(scene_in(tmp_path), height=90, device="cpu")
    viewer._loader.join()
    session = viewer._session
    light = next(entry.id for entry in viewer.document.entries if entry.kind == "lights")
    session.select(light)
    with LeanPage(viewer.url) as page:
        page.look(orbit(0.0))
        wait_until(lambda: bool(viewer._pages), "the page did not connect")
        for number in range(1, 11):
            page.send("TransformControlsDragStartMessage", name=viewer._gizmo.node)
            for share in (0.3, 0.6, 1.0):
                place = {"wxyz": [1.0, 0.0, 0.0, 0.0], "position": [share * number, -1.0, 0.0]}
                page.send("TransformControlsUpdateMessage", name=viewer._gizmo.node, **place)
            page.send("TransformControlsDragEndMessage", name=viewer._gizmo.node)
            for button in ("undo", "redo", "undo", "redo"):
                page.push(button)
        wait_until(lambda: list(viewer.document.entry(light).table["position"]) == [10.0, -1.0, 0.0], "a drag is lost")
        wait_until(
            lambda: len(session._past) == 10 and not session._future, "a drag is not one edit, or a press is lost"
        )
    viewer.close()


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")
def test_viewer_closes_cleanly_while_pages_send_events(tmp_path: Path) -> None:
    """Closing causes no warning about coroutines that never ran, which the test suite treats as errors."""
    for _ in range(3):
        viewer = ls.view(scene_in(tmp_path), height=90, device="cpu")
        viewer._loader.join()
        with LeanPage(viewer.url) as page:
            page.look(orbit(0.0))
            wait_until(lambda viewer=viewer: bool(viewer._pages), "the page did not connect")
            asking = threading.Thread(target=press_until_closed, args=(page,))
            asking.start()
            viewer.close()
            asking.join()
        gc.collect()


def press_until_closed(page: LeanPage) -> None:
    """Presses buttons until the connection closes."""
    with contextlib.suppress(Exception):
        for _ in range(4000):
            page.push("undo")
