"""A notebook cell shows the viewer: camera control, images, fallbacks and cleanup."""

from __future__ import annotations

import base64
import io
import logging
import math
import sys
import threading
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_viewer import HEIGHT, UP, difference, eventually, lit_scene, page_threads

import lumisplat as ls
from lumisplat.viewer import notebook as notebook_cells
from lumisplat.viewer.frames.page import ScreenImage
from lumisplat.viewer.notebook import ELEVATION_MAX, CellScreen, Notebook, Orbit, PointerControl

WIDGET = "application/vnd.jupyter.widget-view+json"
CONFIG = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
EYE, TARGET = (3.0, -2.0, -4.0), (0.5, 0.2, -0.3)
TILTED = (0.6, -0.8, 0.0)


def image_position(orbit: Orbit, point: Any) -> np.ndarray:
    """Returns a point's image position from the centre, right and down, in image heights."""
    camera = orbit.pose(1.0).camera(100)
    x, y, z = camera.camera_from_world[:3, :3] @ np.asarray(point, float) + camera.camera_from_world[:3, 3]
    return np.array([camera.fx * x / z, camera.fy * y / z]) / 100.0


def pointer_control(orbit: Orbit | None = None) -> PointerControl:
    """Returns a pointer control for a frame of 640 x 360."""
    return PointerControl(orbit or Orbit.of(EYE, TARGET, UP, 0.8), 1.0, 640.0, 360.0)


def drag(mouse: PointerControl, across: float, down: float, button: int = 1, modifiers: tuple[str, ...] = ()) -> Any:
    """Returns the result of a drag from the centre of the frame: the clicked point or None."""
    held: dict[str, Any] = {"button": button, "modifiers": modifiers}
    mouse.handle({"type": "pointer_down", "x": 320.0, "y": 180.0, **held})
    mouse.handle({"type": "pointer_move", "x": 320.0 + across, "y": 180.0 + down, **held})
    return mouse.handle({"type": "pointer_up", "x": 320.0 + across, "y": 180.0 + down, **held})


@pytest.mark.parametrize("up", [UP, TILTED])
@pytest.mark.parametrize(("around", "above"), [(0.3, 0.0), (-2.0, 0.4), (7.0, -0.9)])
def test_orbit_rotation_keeps_target_distance_and_horizon(up: tuple[float, ...], around: float, above: float) -> None:
    """The camera rotates by the given angles about the vertical and upward, with its target at the image centre."""
    before = Orbit.of(EYE, TARGET, up, 0.8)
    after = before.rotated(around, above)
    assert math.dist(after.eye, TARGET) == pytest.approx(math.dist(EYE, TARGET))
    np.testing.assert_allclose(image_position(after, TARGET), 0.0, atol=1e-9)
    assert after.elevation == pytest.approx(before.elevation + above)
    level = [np.array(orbit.backward) - np.dot(orbit.backward, up) * np.array(up) for orbit in (before, after)]
    cosine = level[0] @ level[1] / np.linalg.norm(level[0]) / np.linalg.norm(level[1])
    assert cosine == pytest.approx(math.cos(around))
    right, down, _ = after.pose(1.0).camera(2).camera_from_world[:3, :3]
    assert abs(right @ np.array(up)) < 1e-9 and down @ np.array(up) < 0.0


@pytest.mark.parametrize("above", [-50.0, 50.0])
def test_orbit_elevation_is_clamped_at_the_poles(above: float) -> None:
    """From the clamped elevation, the camera rotates back to where it was."""
    start = Orbit.of(EYE, TARGET, UP, 0.8)
    steep = start.rotated(0.0, above)
    assert steep.elevation == pytest.approx(math.copysign(ELEVATION_MAX, above))
    back = steep.rotated(0.0, start.elevation - steep.elevation)
    np.testing.assert_allclose(back.eye, EYE, atol=1e-9)


def test_orbit_camera_right_above_the_target_can_rotate() -> None:
    """The elevation is clamped below the pole, so that the image's up direction is defined."""
    orbit = Orbit.of((0.0, -5.0, 0.0), (0.0, 0.0, 0.0), UP, 0.8)
    assert orbit.elevation == pytest.approx(ELEVATION_MAX) and orbit.distance == pytest.approx(5.0)
    assert np.isfinite(orbit.rotated(1.0, -0.5).pose(1.5).camera(90).camera_from_world).all()


def test_orbit_camera_of_a_notebook_cell_starts_at_the_given_eye_and_target() -> None:
    """The first camera looks from the eye at the target, upright, with the cell's aspect ratio."""
    wanted = ls.Camera.look_at(EYE, TARGET, UP, width=160, height=90, fov_y=0.8)
    camera = Orbit.of(EYE, TARGET, UP, 0.8).pose(16 / 9).camera(90)
    np.testing.assert_allclose(camera.camera_from_world, wanted.camera_from_world, atol=1e-9)
    assert (camera.width, camera.height) == (160, 90) and camera.fy == pytest.approx(wanted.fy)


def test_panning_an_orbit_camera_moves_its_target_by_the_given_image_fractions() -> None:
    """Panning moves the target by the given fractions of the image height, without rotation."""
    before = Orbit.of(EYE, TARGET, TILTED, 0.8)
    after = before.panned(0.25, -0.1)
    np.testing.assert_allclose(image_position(after, TARGET), (0.25, -0.1), atol=1e-9)
    assert after.backward == before.backward and after.distance == before.distance


def test_zooming_an_orbit_camera_changes_its_distance_within_limits_and_nothing_else() -> None:
    """The distance is clamped between a nearest and a farthest distance."""
    orbit = Orbit.of(EYE, TARGET, UP, 0.8)
    assert orbit.zoomed(0.5, 0.1, 100.0) == replace(orbit, distance=0.5 * orbit.distance)
    assert orbit.zoomed(1e-9, 0.1, 100.0).distance == 0.1 and orbit.zoomed(1e9, 0.1, 100.0).distance == 100.0


def test_mouse_drag_in_a_notebook_cell_makes_the_scene_follow_the_pointer() -> None:
    """Points in front of the target follow the pointer; a drag over the frame height is a full rotation."""
    mouse = pointer_control()
    near = np.array(TARGET) + 0.1 * np.array(mouse.orbit.backward)
    drag(mouse, 20.0, 0.0)
    assert image_position(mouse.orbit, near)[0] > 1e-4
    mouse = pointer_control()
    drag(mouse, 0.0, 20.0)
    assert image_position(mouse.orbit, near)[1] > 1e-4
    mouse = pointer_control()
    drag(mouse, 360.0, 0.0)
    np.testing.assert_allclose(mouse.orbit.eye, EYE, atol=1e-9)


@pytest.mark.parametrize(("button", "modifiers"), [(2, ()), (1, ("Shift",)), (3, ())])
def test_mouse_drag_with_shift_or_another_button_pans_the_view(button: int, modifiers: tuple[str, ...]) -> None:
    """The target follows the pointer."""
    mouse = pointer_control()
    assert drag(mouse, 72.0, -36.0, button, modifiers) is None
    np.testing.assert_allclose(image_position(mouse.orbit, TARGET), (0.2, -0.1), atol=1e-9)


def test_mouse_press_and_release_without_movement_is_a_click() -> None:
    """The click is a fraction of the current frame size. A drag, another button or a lone release is not a click."""
    mouse = pointer_control()
    mouse.handle({"type": "resize", "width": 960.0, "height": 240.0})
    assert mouse.aspect == 4.0 and drag(mouse, 0.0, 0.0) == (320.0 / 960.0, 180.0 / 240.0)
    assert drag(mouse, 30.0, 0.0) is None and drag(mouse, 0.0, 0.0, button=2) is None
    assert mouse.handle({"type": "pointer_up", "x": 1.0, "y": 1.0, "button": 1, "modifiers": ()}) is None


def test_pointer_movement_without_a_press_leaves_the_camera_unchanged() -> None:
    """Keys and pointer movement leave the camera unchanged; the wheel zooms."""
    mouse = pointer_control()
    start = mouse.orbit
    mouse.handle({"type": "pointer_move", "x": 5.0, "y": 9.0, "button": 0, "modifiers": ()})
    mouse.handle({"type": "key_down", "key": "a", "modifiers": ()})
    assert mouse.orbit == start
    mouse.handle({"type": "wheel", "dy": 100.0})
    assert mouse.orbit.distance > start.distance and mouse.orbit.target == start.target


# --- Live frames ---


@pytest.fixture
def viewer() -> Iterator[ls.Viewer]:
    """Opens a viewer of the lit scene without outlines, so that images equal rendered frames."""
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    viewer._loader.join()
    viewer._session.set_options(outlines=False)
    yield viewer
    viewer.close()


@pytest.fixture
def notebook() -> Iterator[Any]:
    """Connects a notebook client without a browser."""
    pytest.importorskip("jupyter_rfb", reason="the extra notebook is not installed")
    from support.viewer.cell_client import CellClient

    with CellClient() as client:
        yield client


def settled(viewer: ls.Viewer, notebook: Any) -> np.ndarray:
    """Returns the image in the cell when it is finished."""
    notebook.picture()
    page, session = viewer._notebook._cell.page, viewer._session  # pyright: ignore[reportOptionalMemberAccess]

    def rests() -> bool:
        return page.is_at_rest and page.key == (session.revision, page.pose_number)

    eventually(rests, "the cell does not come to rest")
    return notebook.picture()


def expected(viewer: ls.Viewer, scene: ls.Scene) -> np.ndarray:
    """Renders a scene with the cell's camera, as bytes."""
    pose = viewer._notebook._cell.page.pose  # pyright: ignore[reportOptionalMemberAccess]
    assert pose is not None
    return 255.0 * ls.render(scene, pose.camera(HEIGHT), CONFIG, device="cpu").pixels_srgb()


def test_notebook_cell_shows_the_rendered_image(viewer: ls.Viewer, notebook: Any) -> None:
    """The still image equals a frame with the same samples and camera; the bundle has widget and image."""
    data, about = viewer._repr_mimebundle_()
    assert data[WIDGET]["model_id"] and data["text/plain"] == repr(viewer)
    assert about["image/png"] == {"width": 160, "height": 90} and data["image/png"]
    shown = settled(viewer, notebook)
    assert shown.shape == (90, 160, 3)
    assert ls.metrics.psnr(shown / 255.0, expected(viewer, lit_scene()) / 255.0) > 35.0


def test_dragging_back_in_a_notebook_cell_restores_the_view_before_the_drag(viewer: ls.Viewer, notebook: Any) -> None:
    """The image follows the drag; dragging back restores it."""
    viewer._repr_mimebundle_()
    before = settled(viewer, notebook)
    notebook.drag(90.0, 40.0)
    turned = settled(viewer, notebook)
    assert difference(before, turned) > 2.0
    assert viewer._notebook._cell.page._has_stopped  # pyright: ignore[reportOptionalMemberAccess]
    assert ls.metrics.psnr(turned / 255.0, expected(viewer, lit_scene()) / 255.0) > 35.0
    notebook.drag(-90.0, -40.0)
    assert difference(before, settled(viewer, notebook)) < 1.0


def test_notebook_cell_shows_scene_changes_by_code_and_their_undo(viewer: ls.Viewer, notebook: Any) -> None:
    """The cell is another page of the session: it shows a new scene, and undo restores the old one."""
    viewer._repr_mimebundle_()
    before = settled(viewer, notebook)
    darker = replace(lit_scene(), lights=(ls.LightPoint((0.0, -1.0, -0.8), intensity=0.3),))
    viewer.show(darker)
    after = settled(viewer, notebook)
    assert after.mean() < 0.7 * before.mean()
    assert ls.metrics.psnr(after / 255.0, expected(viewer, darker) / 255.0) > 35.0
    assert viewer._session.undo()
    np.testing.assert_array_equal(settled(viewer, notebook), before)


def line_of(viewer: ls.Viewer) -> str:
    """Returns the text line below the frame."""
    return viewer._notebook._cell._line.value  # pyright: ignore[reportOptionalMemberAccess]


def test_click_in_a_notebook_cell_selects_the_visible_object(viewer: ls.Viewer, notebook: Any) -> None:
    """The text line names the object beside the page's address; a click on the background clears the selection."""
    viewer._repr_mimebundle_()
    settled(viewer, notebook)
    assert viewer.url in line_of(viewer)
    frame = viewer._notebook._cell.page.frame  # pyright: ignore[reportOptionalMemberAccess]
    assert frame is not None
    rows, columns = np.nonzero(frame.instance_index == 1)
    notebook.click((np.median(columns) + 0.5) / 160.0, (np.median(rows) + 0.5) / 90.0)
    assert viewer._session.selected_entry is not None and viewer._session.selected_entry.name == "crate"
    assert "crate: depth" in line_of(viewer) and viewer.url in line_of(viewer)
    settled(viewer, notebook)
    notebook.click(0.01, 0.01)
    assert viewer._session.selected is None and "crate" not in line_of(viewer)


def test_notebook_cell_shows_errors_as_escaped_text(viewer: ls.Viewer, notebook: Any) -> None:
    """HTML in an error message is escaped."""
    viewer._repr_mimebundle_()
    viewer._session.report("<b>lamp</b> is broken")
    assert "&lt;b&gt;lamp&lt;/b&gt; is broken" in line_of(viewer)


def wait_for_views_that_move(viewer: ls.Viewer) -> None:
    """Waits until no changed view is left to draw and the background job continues."""
    begun = threading.Event()

    def background_job() -> Generator[None]:
        begun.set()
        yield

    viewer._loop.run_in_background(background_job())
    assert begun.wait(60.0)


def test_hidden_notebook_cell_is_not_rendered_until_it_becomes_visible(viewer: ls.Viewer, notebook: Any) -> None:
    """A cell that becomes visible shows later changes; a new browser gets an image at once."""
    viewer._repr_mimebundle_()
    before = settled(viewer, notebook)
    notebook.send("hide")
    count, page = len(notebook.pictures), viewer._notebook._cell.page  # pyright: ignore[reportOptionalMemberAccess]
    number = page.key
    viewer.show(replace(lit_scene(), lights=()))
    wait_for_views_that_move(viewer)
    assert len(notebook.pictures) == count and page.key == number
    notebook.send("show")
    assert difference(before, settled(viewer, notebook)) > 1.0
    count = len(notebook.pictures)
    notebook.send("show")
    notebook.picture(after=count)


def test_notebook_cells_of_a_viewer_share_one_widget_until_it_is_closed(viewer: ls.Viewer, notebook: Any) -> None:
    """A new widget is created after the first one was closed."""
    first, again = viewer._repr_mimebundle_()[0], viewer._repr_mimebundle_()[0]
    assert first[WIDGET] == again[WIDGET]
    notebook.send("close")
    assert viewer._repr_mimebundle_()[0][WIDGET] != first[WIDGET]


class Buffer:
    """A fake widget that counts frames and acknowledges them on demand."""

    def __init__(self) -> None:
        self.frames = 0
        self.answer: Any = None

    def observe(self, answer: Any, names: str) -> None:
        """Stores the callback for acknowledgements."""
        self.answer = answer

    def send_frame(self, picture: np.ndarray) -> None:
        """Counts a frame."""
        self.frames += 1


def test_notebook_cell_sends_its_next_frame_after_the_last_one_is_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Acknowledgements of older frames do not count; closing ends the wait."""
    monkeypatch.setattr(notebook_cells, "ANSWER_S", 60.0)
    buffer: Any = Buffer()
    screen, shown = CellScreen(buffer), ScreenImage(np.zeros((2, 2, 3), np.uint8), 80)

    def start() -> threading.Thread:
        count, thread = buffer.frames, threading.Thread(target=screen.show, args=(shown,), daemon=True)
        thread.start()
        eventually(lambda: buffer.frames > count, "no frame was sent")
        return thread

    first = start()
    buffer.answer({"new": {}})
    first.join(timeout=0.1)
    assert first.is_alive()
    buffer.answer({"new": {"index": 1}})
    first.join(timeout=10.0)
    assert not first.is_alive()
    second = start()
    buffer.answer({"new": {"index": 1}})
    second.join(timeout=0.1)
    assert second.is_alive()
    screen.close()
    second.join(timeout=10.0)
    assert not second.is_alive()


def test_notebook_cell_shows_new_frames_while_its_busy_kernel_acknowledges_none(
    viewer: ls.Viewer, notebook: Any
) -> None:
    """A running cell that edits the scene still shows new frames."""
    notebook.answers = False
    viewer._repr_mimebundle_()
    for step in range(3):
        count = len(notebook.pictures)
        viewer.show(replace(lit_scene(), lights=(ls.LightPoint((0.0, -1.0, -0.8), intensity=1.0 + step),)))
        notebook.picture(after=count)


@pytest.mark.parametrize("what", ["viewer", "widget"])
def test_closed_notebook_cell_or_viewer_leaves_no_thread(what: str, notebook: Any) -> None:
    """The cell shows that it is closed, and later edits do not reach it."""
    before, threads = page_threads(), set(threading.enumerate())
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    viewer._repr_mimebundle_()
    assert page_threads() - before
    cell = viewer._notebook._cell
    assert cell is not None
    if what == "widget":
        cell.buffer.close()
        assert not page_threads() - before
        viewer.show(ls.Scene())
    viewer.close()
    assert "closed" in line_of(viewer) and viewer.url not in line_of(viewer)
    assert not viewer._session.error_listeners or cell.notify not in viewer._session.error_listeners
    eventually(
        lambda: not [t for t in set(threading.enumerate()) - threads if t.name.startswith("lumisplat")],
        "a thread is left",
    )
    assert viewer._repr_mimebundle_() == ({"text/plain": "Viewer(closed)"}, {})


# --- Still images ---


def shell(*, allow_stdin: bool, types: tuple[str, ...] = ("image/png", "text/plain")) -> SimpleNamespace:
    """Returns a fake IPython shell with a kernel."""
    kernel = SimpleNamespace(get_parent=lambda channel: {"content": {"allow_stdin": allow_stdin}})
    return SimpleNamespace(kernel=kernel, display_formatter=SimpleNamespace(active_types=types))


def bundled_image(data: dict[str, Any]) -> np.ndarray:
    """Returns the image of a MIME bundle."""
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data["image/png"]))))


def test_notebook_output_of_a_viewer_without_a_kernel_is_an_image_and_text(viewer: ls.Viewer) -> None:
    """The bundle has a PNG of the first view and the text; no page or thread is left."""
    before = page_threads()
    data, about = viewer._repr_mimebundle_()
    assert (
        set(data) == {"image/png", "text/plain"} and data["text/plain"] == repr(viewer) and viewer.url in repr(viewer)
    )
    assert about == {"image/png": {"width": 160, "height": 90}}
    view = ls.frame_camera(lit_scene(), width=160, height=90, fov_y=0.8)
    wanted = np.asarray(ls.render(lit_scene(), view, CONFIG, device="cpu"), np.uint8)
    assert ls.metrics.psnr(bundled_image(data) / 255.0, wanted / 255.0) > 40.0
    assert page_threads() == before and not viewer._loop._pages


def test_notebook_converters_get_a_still_image_of_a_viewer_and_no_widget(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program such as nbconvert has a kernel but no user, so it gets no widget."""
    monkeypatch.setattr(notebook_cells, "_shell", lambda: shell(allow_stdin=False))
    assert set(viewer._repr_mimebundle_()[0]) == {"image/png", "text/plain"}


def test_ipython_terminal_shows_a_viewer_as_text_and_renders_no_frame(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No frame is rendered for a terminal."""
    formatter = SimpleNamespace(active_types=["text/plain"])
    monkeypatch.setattr(notebook_cells, "_shell", lambda: SimpleNamespace(display_formatter=formatter))
    monkeypatch.setattr(Notebook, "_picture", None)
    assert viewer._repr_mimebundle_() == ({"text/plain": repr(viewer)}, {})


def test_missing_package_for_notebook_widgets_is_reported_once(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The log and the text name the missing package, and the bundle has an image."""
    monkeypatch.setattr(notebook_cells, "_shell", lambda: shell(allow_stdin=True))
    monkeypatch.setitem(sys.modules, "jupyter_rfb", None)
    with caplog.at_level(logging.WARNING, "lumisplat"):
        bundles = [viewer._repr_mimebundle_()[0] for _ in range(2)]
    assert [set(data) for data in bundles] == [{"image/png", "text/plain"}] * 2
    address, line = bundles[1]["text/plain"].splitlines()
    assert address == repr(viewer) and "pip install 'lumisplat[notebook]'" in line
    assert [record.message for record in caplog.records] == [line]


def test_notebook_output_of_a_viewer_has_only_the_requested_mime_types(viewer: ls.Viewer, notebook: Any) -> None:
    """A bundle of only text creates no widget and renders no frame."""
    assert set(viewer._repr_mimebundle_(include={"text/plain"})[0]) == {"text/plain"}
    assert set(viewer._repr_mimebundle_(exclude={WIDGET, "image/png", "image/jpeg"})[0]) == {"text/plain"}
    assert viewer._notebook._cell is None
    assert set(viewer._repr_mimebundle_(exclude={WIDGET})[0]) == {"image/png", "text/plain"}
    assert set(viewer._repr_mimebundle_(include={WIDGET})[0]) == {WIDGET}


def test_notebook_output_of_a_viewer_is_text_if_rendering_raises_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A damaged file or any other error never raises in a cell."""
    (tmp_path / "damaged.ply").write_bytes(b"no capture")
    viewer = ls.view(tmp_path / "damaged.ply", device="cpu")
    data, about = viewer._repr_mimebundle_()
    assert "damaged.ply" in data["text/plain"] and viewer.url in data["text/plain"] and about == {}
    viewer.close()
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    monkeypatch.setattr(Notebook, "bundle", None)
    assert "no image" in viewer._repr_mimebundle_()[0]["text/plain"]
    viewer.close()
