"""The viewer as a page client sees it, over a WebSocket without a browser."""

from __future__ import annotations

import asyncio
import gc
import itertools
import logging
import math
import shlex
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli import main
from lumisplat.viewer.frames.page import BrowserScreen, Page
from lumisplat.viewer.frames.pose import Pose
from lumisplat.viewer.panels.files import command_line
from lumisplat.viewer.server import event_queue
from lumisplat.viewer.session import State
from support.viewer.page_client import PageClient

HEIGHT = 90
UP = (0.0, -1.0, 0.0)
LIGHT = (0.0, -1.0, -0.8)
TIMEOUT_S = 300.0
"""Longest wait on a busy machine, seconds; a working viewer never takes that long."""


def cloud(seed: int = 3, count: int = 400) -> ls.Gaussians:
    """Returns a ball of coloured Gaussians, radius 0.5."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    means = 0.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return ls.Gaussians(
        means=means,
        rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        scales=np.full((count, 3), 0.06),
        opacities=np.full(count, 0.9),
        sh=rng.uniform(-0.5, 1.0, (count, 1, 3)),
    )


def lit_scene() -> ls.Scene:
    """Returns a relit ball on the left, a box on the right, and a light above."""
    ball = ls.SplatInstance(cloud(), position=(-0.7, 0.0, 0.0), material=ls.MaterialPbr(), name="ball")
    box = ls.MeshInstance(ls.box(0.8), position=(0.8, 0.0, 0.0), name="crate")
    return ls.Scene([ball], [box], [ls.LightPoint(LIGHT, intensity=2.0, name="lamp")], up=UP)


def camera(x: float = 0.0, height: int = HEIGHT) -> ls.Camera:
    """Returns a camera in front of the scene, shifted to the right."""
    return ls.Camera.look_at((x, -0.4, -3.5), (0.0, 0.0, 0.0), UP, width=160 * height // 90, height=height)


def eventually(holds: Callable[[], bool], what: str) -> None:
    """Waits for a condition that another thread fulfils."""
    until = time.monotonic() + TIMEOUT_S
    while not holds():
        assert time.monotonic() < until, what
        time.sleep(0.01)


async def wait_for_events() -> None:
    """Waits until all earlier events of pages are handled; runs on the viewer's event loop."""
    for _ in range(100):  # each turn of the loop handles one message
        await asyncio.sleep(0)
    queue = event_queue._QUEUES.get(asyncio.get_running_loop())
    if queue is not None:
        async with queue.lock:  # the lock is fair: first come, first served
            pass


def has_reported_pose(viewer: ls.Viewer, number: int) -> bool:
    """Returns True if the viewer has the camera that the page reported last."""
    client, page = viewer._viser.get_clients().get(number), viewer._pages.get(number)
    if client is None or page is None:
        return True
    return page.pose == Pose.of(client.camera, viewer._session.extent.page_from_scene)


def settled(viewer: ls.Viewer, page: PageClient) -> np.ndarray:
    """Returns a page's image when all pages are finished."""
    page.picture()

    def rests() -> bool:
        pages, revision = dict(viewer._pages), viewer._session.revision
        return all(
            each.is_at_rest and each.key == (revision, each.pose_number) and has_reported_pose(viewer, number)
            for number, each in pages.items()
        )

    for _ in range(2):  # an acknowledgement may start another frame
        page.ping()
        asyncio.run_coroutine_threadsafe(wait_for_events(), viewer._viser.get_event_loop()).result()
        eventually(rests, "the pages do not come to rest")
    return page.picture()


def difference(first: np.ndarray, second: np.ndarray) -> float:
    """Returns the mean absolute difference of two images, in levels of 255."""
    return float(np.abs(first.astype(float) - second).mean())


@pytest.fixture
def viewer() -> Iterator[ls.Viewer]:
    """Opens a viewer of the lit scene without outlines, so that images equal rendered frames."""
    viewer = ls.view(
        lit_scene(), height=HEIGHT, device="cpu", config=ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    )
    viewer._loader.join()
    viewer._session.set_options(outlines=False)
    yield viewer
    viewer.close()


def test_viewer_page_shows_the_rendered_image(viewer: ls.Viewer) -> None:
    """The still image equals a frame with the same samples and camera, up to JPEG error."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        shown = settled(viewer, page) / 255.0
    expected = ls.render(lit_scene(), camera(), viewer._session.state.config, device="cpu").pixels_srgb()
    assert shown.shape == expected.shape
    assert ls.metrics.psnr(shown.astype(np.float32), expected) > 35.0


def test_viewer_pages_have_independent_cameras(viewer: ls.Viewer) -> None:
    """A page keeps its camera while the other page moves."""
    with PageClient(viewer.url) as left, PageClient(viewer.url) as right:
        left.look(camera(-1.5))
        right.look(camera(1.5))
        before, other = settled(viewer, left), settled(viewer, right)
        assert difference(before, other) > 2.0
        right.look(camera(1.0))
        settled(viewer, right)
        np.testing.assert_array_equal(left.picture(), before)


def held(begun: threading.Event, ends: threading.Event) -> Generator[None]:
    """Holds the render thread until ``ends`` is set."""
    begun.set()
    ends.wait()
    yield


@pytest.mark.parametrize("is_fast", [False, True])
def test_viewer_renders_in_full_at_once_after_a_page_has_said_that_its_camera_stopped(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch, is_fast: bool
) -> None:
    """No silence of the camera is waited for; a fast full frame comes without a reduced one before."""
    steps: list[Any] = []
    shown = viewer._loop._on_frame
    viewer._loop._on_frame = lambda page, step, took: (steps.append(step), shown(page, step, took))[1]
    with PageClient(viewer.url) as page:
        page.look(camera())
        before = settled(viewer, page)
        monkeypatch.setattr("lumisplat.viewer.frames.loop.SETTLED_S", math.inf)
        monkeypatch.setattr("lumisplat.viewer.frames.page.SETTLED_GAPS", math.inf)
        monkeypatch.setattr("lumisplat.viewer.frames.page.DIRECT_MS", math.inf if is_fast else 0.0)
        steps.clear()
        begun, ends = threading.Event(), threading.Event()
        viewer._loop.run_in_background(held(begun, ends))
        begun.wait()
        page.look(camera(0.5))
        page.stop()
        (stopped,) = viewer._pages.values()
        try:
            eventually(lambda: stopped._has_stopped, "no stop arrived")
        finally:
            ends.set()  # the render thread sees the camera and its stop together
        after = settled(viewer, page)
    assert difference(before, after) > 0.5 and steps
    assert [step is None for step in steps] == ([] if is_fast else [False]) + [True] * 4
    expected = ls.render(lit_scene(), camera(0.5), viewer._session.state.config, device="cpu").pixels_srgb()
    assert ls.metrics.psnr((after / 255.0).astype(np.float32), expected) > 35.0


def test_click_in_the_image_selects_the_visible_object(viewer: ls.Viewer) -> None:
    """The AOVs of the last frame determine what is selected: a capture with its Gaussian, a mesh, or nothing."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        selected = viewer._session
        page.click(0.36, 0.5)
        eventually(lambda: selected.selected is not None, "the click did nothing")
        assert viewer.document.entry(selected.selected or 0).name == "ball"
        page.click(0.66, 0.5)
        eventually(lambda: viewer.document.entry(selected.selected or 0).name == "crate", "the mesh is not selected")
        page.click(0.02, 0.02)
        eventually(lambda: selected.selected is None, "the click on the background selected an object")
        eventually(lambda: any(note.startswith("ball: Gaussian ") for note in page.notes()), "no notification arrived")


def test_click_plots_the_gaussians_on_its_ray_if_asked(viewer: ls.Viewer) -> None:
    """The plot appears below its checkbox, and goes with it."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        plot = viewer._rays._plot
        page.choose("plot ray", True)
        page.click(0.36, 0.5)
        eventually(lambda: plot.visible, "the ray is not plotted")
        assert plot.image.any()
        page.choose("plot ray", False)
        eventually(lambda: not plot.visible, "the plot is still shown")


def test_changing_the_selection_removes_the_controls_of_the_previous_object(
    viewer: ls.Viewer, recwarn: pytest.WarningsRecorder
) -> None:
    """Controls of one object after another are added and removed exactly once."""
    for entry in (*viewer.document.entries, *viewer.document.entries):
        viewer._session.select(entry.id)
    viewer._session.select(None)
    assert not [str(warning.message) for warning in recwarn]


def light_id(viewer: ls.Viewer) -> int:
    """Returns the entry id of the light."""
    return next(entry.id for entry in viewer.document.entries if entry.name == "lamp")


def test_one_undo_restores_the_light_that_a_drag_of_the_gizmo_moved(viewer: ls.Viewer) -> None:
    """The image follows the drag; one undo restores it bit for bit."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        viewer._session.select(light_id(viewer))
        before, document = settled(viewer, page), viewer.document
        count = len(page.pictures)
        page.send("TransformControlsDragStartMessage", name=viewer._gizmo.node)
        for step in range(1, 6):
            position = [LIGHT[0] + 0.6 * step, LIGHT[1], LIGHT[2]]
            page.send(
                "TransformControlsUpdateMessage", name=viewer._gizmo.node, wxyz=[1.0, 0.0, 0.0, 0.0], position=position
            )
        page.send("TransformControlsDragEndMessage", name=viewer._gizmo.node)
        expected = pytest.approx((3.0, *LIGHT[1:]))
        eventually(lambda: viewer.scene.lights[0].position == expected, "the light did not move")  # pyright: ignore
        page.picture(after=count)
        moved = settled(viewer, page)
        assert difference(before, moved) > 2.0
        assert viewer._session.undo() and viewer.document is document
        np.testing.assert_array_equal(settled(viewer, page), before)
        assert viewer._session.redo() and viewer.scene.lights[0].position == pytest.approx((3.0, *LIGHT[1:]))  # pyright: ignore
        np.testing.assert_array_equal(settled(viewer, page), moved)


def test_choices_and_sliders_on_a_viewer_page_change_the_image(viewer: ls.Viewer) -> None:
    """A choice and a slider take effect; an invalid value is reported and changes nothing."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        before = settled(viewer, page)
        page.choose("exposure", 1.5)
        eventually(lambda: viewer._session.state.exposure == 1.5, "the exposure did not change")
        assert settled(viewer, page).mean() > 1.2 * before.mean()
        page.choose("shadows", "off")
        eventually(lambda: viewer._session.state.config.shadows is ls.Shadows.OFF, "the shadows did not change")
        state = viewer._session.state
        page.choose("samples", "many")
        eventually(lambda: any("many" in note for note in page.notes()), "no notification arrived")
        assert viewer._session.state == state


def test_error_views_of_the_viewer_color_captures_by_how_sure_their_albedo_is(viewer: ls.Viewer) -> None:
    """Captures with errors offer the view; it is violet where the error is 0 and yellow where it is 2, lit or not."""
    session, ball = viewer._session, cloud()
    assert "albedo_error" not in session.views
    for error, color in (
        (np.zeros(ball.count), (0.078, 0.0, 0.285)),
        (np.full(ball.count, 2.0), (0.999, 0.957, 0.696)),
    ):
        scene = ls.Scene([ls.SplatInstance(replace(ball, albedo_error=error), material=ls.MaterialPbr())], up=UP)
        session.open(State(ls.io.SceneDocument.of(replace(scene, lights=lit_scene().lights))))
        session.set_options(view="albedo_error")
        assert "roughness_error" not in session.views
        with PageClient(viewer.url) as page:
            page.look(camera())
            picture = settled(viewer, page)
        middle = picture[HEIGHT // 2, picture.shape[1] // 2]
        assert np.abs(middle / 255.0 - color).max() < 0.05


def test_changing_tone_map_exposure_or_view_in_the_viewer_renders_no_new_samples(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last frame is tone mapped again; a change of the seed renders a new frame."""
    render, count = ls.Renderer.render, 0

    def counted(*args: Any, **options: Any) -> ls.Frame:
        nonlocal count
        count += 1
        return render(*args, **options)

    session = viewer._session
    with PageClient(viewer.url) as page:
        page.look(camera())
        pictures = [settled(viewer, page)]
        monkeypatch.setattr(ls.Renderer, "render", counted)
        session.configure(lambda config: replace(config, tone_map=ls.ToneMap.AGX))
        pictures.append(settled(viewer, page))
        page.choose("exposure", 1.0)
        eventually(lambda: session.state.exposure == 1.0, "the exposure did not change")
        pictures.append(settled(viewer, page))
        session.set_options(view="depth")
        pictures.append(settled(viewer, page))
        assert count == 0
        assert min(difference(one, other) for one, other in itertools.pairwise(pictures)) > 0.5
        session.configure(lambda config: replace(config, seed=1))
        settled(viewer, page)
        assert count > 0


def test_damaged_uploads_to_the_viewer_are_reported_and_leave_neither_file_nor_entry(
    viewer: ls.Viewer, tmp_path: Path
) -> None:
    """A damaged upload leaves no entry and no file; a valid mesh becomes an entry under a safe name."""
    viewer._session.edit(lambda state: replace(state, document=document_in(tmp_path)))
    with PageClient(viewer.url) as page:
        page.look(camera())
        page.upload("upload file", "broken.ply", b"ply\nnonsense")
        eventually(lambda: any("broken" in note for note in page.notes()), "no notification arrived")
        page.upload("upload file", "../../evil.txt", b"text")
        eventually(lambda: any("evil.txt" in note for note in page.notes()), "no notification arrived")
        assert len(viewer.document.entries) == 1 and not list(tmp_path.rglob("*broken*"))
        triangle = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
        page.upload("upload file", "../a b.obj", triangle)
        eventually(lambda: len(viewer.document.entries) == 2, "the mesh is missing")
        assert (tmp_path / "uploads" / "a_b.obj").read_bytes() == triangle
        settled(viewer, page)


def document_in(folder: Path) -> ls.io.SceneDocument:
    """Returns a document opened from a scene file in a folder."""
    ls.save(folder / "ball.ply", cloud())
    (folder / "scene.toml").write_text('[[splats]]\npath = "ball.ply"\n')
    return ls.io.SceneDocument.open(folder / "scene.toml")


def test_invalid_messages_of_a_viewer_page_have_no_effect(viewer: ls.Viewer) -> None:
    """Undecodable data, invalid cameras and values of a wrong type are ignored."""
    with PageClient(viewer.url) as page, PageClient(viewer.url) as other:
        page.look(camera())
        other.look(camera())
        settled(viewer, page)
        page.send_raw(b"\xff\x00nonsense")
        size = {"image_height": 90, "image_width": 160}
        away = {"look_at": [0.0] * 3, "up_direction": [0.0, -1.0, 0.0]}
        page.send("ViewerCameraMessage", wxyz=[0.0] * 4, position=[1.0] * 3, fov=0.8, near=0.1, far=1.0, **size, **away)
        page.send("GuiUpdateMessage", uuid=page.control("exposure"), updates={"value": "bright"})
        page.send("GuiUpdateMessage", uuid=page.control("pipeline"), updates={"value": "magic"})
        page.send("ScenePointerMessage", event_type="click", screen_pos=[], modifier=None)
        state = viewer._session.state
        count = len(page.pictures)
        page.look(camera(0.5))
        page.picture(after=count)
        assert difference(settled(viewer, page), settled(viewer, other)) > 0.5
        assert viewer._session.state == state


def test_failed_frame_is_reported_and_rendering_continues(viewer: ls.Viewer) -> None:
    """Incompatible settings give an error with labels of the page; undo restores the image."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        before = settled(viewer, page)
        raster = ls.RasterConfig(
            projection=ls.config.Projection.UNSCENTED, strategy=ls.config.RasterStrategy.STOCHASTIC
        )
        viewer._session.configure(lambda config: replace(config, raster=raster))
        eventually(
            lambda: any("does not work with projection unscented" in note for note in page.notes()),
            "no notification arrived",
        )
        viewer._session.undo()
        np.testing.assert_array_equal(settled(viewer, page), before)


def test_scene_saved_after_edits_renders_the_same_frame(viewer: ls.Viewer, tmp_path: Path) -> None:
    """After edits of all kinds, the saved file renders the page's frame."""
    document = viewer.document.changed(light_id(viewer), intensity=20.0)
    document, number = document.added("meshes", {"shape": "sphere", "size": 0.4, "position": [0.0, -0.6, 0.0]})
    document = document.changed(number, material={"roughness": 0.2})
    config = viewer._session.state.config
    document.with_config(config).save(tmp_path / "edited.toml")
    scene, settings = ls.load(tmp_path / "edited.toml"), ls.load_config(tmp_path / "edited.toml")
    assert isinstance(scene, ls.Scene) and settings == config
    expected = ls.render(document.scene(), camera(), config, device="cpu").color
    np.testing.assert_allclose(ls.render(scene, camera(), settings, device="cpu").color, expected, atol=2e-5)


@pytest.mark.parametrize(
    ("settings", "exposure"),
    [
        ({}, 0.0),
        ({"samples": 3, "shadows": ls.Shadows.SOFT, "tone_map": ls.ToneMap.AGX, "max_bounces": 2}, -1.5),
        ({"pipeline": ls.Pipeline.PATH, "samples": 32, "background": (0.2, 0.4, 0.6)}, 0.5),
        ({"pipeline": ls.Pipeline.RASTER, "lighting": False, "raster": ls.RasterConfig(dilation=0.0)}, 0.0),
    ],
    ids=["default", "soft shadows, tone mapped", "path traced", "unlit"],
)
def test_command_displayed_by_the_viewer_renders_the_image_of_the_page(
    viewer: ls.Viewer, tmp_path: Path, settings: dict[str, Any], exposure: float
) -> None:
    """The saved scene and the page's command reproduce the page's image for any settings."""
    ls.save(tmp_path / "ball.ply", cloud())
    light = "[[lights]]\ntype = 'point'\nposition = [0.0, -1.0, -0.8]\nintensity = 2.0\n"
    (tmp_path / "scene.toml").write_text(f'[[splats]]\npath = "ball.ply"\nmaterial = {{type = "pbr"}}\n{light}')
    document = ls.io.SceneDocument.open(tmp_path / "scene.toml")
    viewer._session.edit(
        lambda state: State(document.with_up((0.1, -1.0, 0.2)), replace(state.config, **settings), exposure)
    )
    with PageClient(viewer.url) as page:
        page.look(camera(0.7))
        page.choose("scene file", "edited.toml")
        page.press("save scene")
        eventually((tmp_path / "edited.toml").exists, "the scene was not saved")
        shown = settled(viewer, page)
        (open_page,) = viewer._pages.values()
        assert open_page.pose is not None
        words = shlex.split(command_line(tmp_path / "edited.toml", open_page.pose, viewer._session))
    assert words[:2] == ["lumisplat", "render"] and words[-2:] == ["-o", "view.png"]
    size = ["--width", "160", "--height", str(HEIGHT)]
    at = words.index("--width")
    arguments = [*words[1:at], *size, *words[at + 4 : -1], str(tmp_path / "view.png"), "--device", "cpu"]
    assert main(arguments) == 0
    assert ls.metrics.psnr(ls.load_image(tmp_path / "view.png"), (shown / 255.0).astype(np.float32)) > 35.0


def test_viewer_stops_a_long_frame_of_a_still_view_when_the_view_moves(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sample of a still view stops when the view moves, without a message, and is rendered again later."""
    stopped, begun = threading.Event(), threading.Event()
    render = ls.Renderer.render

    def recorded(*args: Any, **options: Any) -> ls.Frame:
        if options.get("stop") is not None:
            begun.set()
        try:
            return render(*args, **options)
        except ls.errors.StoppedError:
            stopped.set()
            raise

    monkeypatch.setattr(ls.Renderer, "render", recorded)
    viewer._session.set_options(height=720)
    viewer._session.configure(lambda config: replace(config, samples=64, noise=1e-6))
    with PageClient(viewer.url) as page:
        for step in range(40):
            page.look(camera(0.1 * step))
            begun.clear()
            assert begun.wait(60), "the view does not come to rest"
            if stopped.is_set():
                break
        assert stopped.is_set()
        viewer._session.configure(lambda config: replace(config, samples=4))
        page.look(camera())
        assert ls.metrics.psnr(settled(viewer, page) / 255.0, rendered_at(720)) > 35.0
        assert not page.notes()


def test_still_view_gets_a_full_frame_sooner_after_a_motion_than_after_an_edit(viewer: ls.Viewer) -> None:
    """A motion ends when its messages end; edits may follow each other at any interval."""
    with PageClient(viewer.url) as page:
        for step in range(30):
            page.look(camera(0.01 * step))
            time.sleep(0.005)
        settled(viewer, page)
        shown = next(iter(viewer._pages.values()))
        assert shown.rests_at <= shown.stops_at
        viewer._session.set_options(height=2 * HEIGHT)
        settled(viewer, page)
        assert shown.rests_at > shown.stops_at


def rendered_at(height: int) -> np.ndarray:
    """Renders the image that a page in front of the lit scene should show."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    return ls.render(lit_scene(), camera(height=height), config, device="cpu").pixels_srgb()


def test_viewer_sends_new_frames_also_to_pages_that_never_acknowledge_any(viewer: ls.Viewer) -> None:
    """A client that only watches never acknowledges frames."""
    with PageClient(viewer.url, answers=False) as page:
        for step in range(4):
            count = len(page.pictures)
            page.look(camera(0.2 * step))
            page.picture(after=count)


def page_threads() -> set[threading.Thread]:
    """Returns the threads that send to pages."""
    return {thread for thread in threading.enumerate() if thread.name == "lumisplat page"}


def test_page_opened_after_another_lost_its_connection_shows_the_edited_scene(recwarn: pytest.WarningsRecorder) -> None:
    """The closed page's threads end without warnings, and a new page shows the edited scene."""
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=ls.RenderConfig(samples=2))
    viewer._loader.join()
    before = page_threads()
    page = PageClient(viewer.url)
    page.look(camera())
    settled(viewer, page)
    (client,) = viewer._viser.get_clients().values()
    page._socket.socket.shutdown(socket.SHUT_RDWR)  # like a page whose process is killed
    eventually(lambda: not viewer._pages, "the closed page was not removed")
    client.scene.set_background_image(np.zeros((4, 4, 3), np.uint8))
    assert not recwarn.list
    eventually(lambda: not page_threads() - before, "the page's thread has not ended")
    viewer._session.apply(lambda document: document.removed(light_id(viewer)))
    with PageClient(viewer.url) as again:
        again.look(camera())
        settled(viewer, again)
        assert not viewer.scene.lights
    viewer.close()


def test_closed_viewer_frees_its_port_and_threads() -> None:
    """A viewer can be closed while a page is open, and closed a second time."""
    before = set(threading.enumerate())
    viewer = ls.view(cloud(), height=HEIGHT, device="cpu")
    page = PageClient(viewer.url)
    page.look(camera())
    page.picture()
    viewer.close()
    viewer.close()
    page.close()
    assert repr(viewer) == "Viewer(closed)"
    del viewer
    gc.collect()  # frees the renderers' thread pools
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=10)
        assert not thread.is_alive(), thread


def test_function_view_raises_for_a_missing_file_before_any_server_starts(tmp_path: Path) -> None:
    """`view` raises before any address exists."""
    for missing in (tmp_path / "a.ply", [tmp_path / "a.ply", str(tmp_path / "b.toml")]):
        threads = threading.active_count()
        with pytest.raises(ls.errors.MissingFileError, match=r"a\.ply: no such file"):
            ls.view(missing)
        assert threading.active_count() == threads


def test_viewer_method_wait_raises_the_error_of_an_unreadable_file(tmp_path: Path) -> None:
    """The error names the file that cannot be read."""
    (tmp_path / "damaged.ply").write_bytes(b"ply, or not")
    viewer = ls.view(tmp_path / "damaged.ply", device="cpu")
    with pytest.raises(ls.LumisplatError, match=r"damaged\.ply"):
        viewer.wait()
    viewer.close()


def test_viewer_method_wait_raises_the_error_of_an_invalid_animation(tmp_path: Path) -> None:
    """The captures are readable, but the animation is not; the viewer can be closed."""
    ls.save(tmp_path / "ball.ply", cloud())
    (tmp_path / "scene.toml").write_text('[[splats]]\npath = "ball.ply"\n[animation]\nfps = -3.0\n')
    viewer = ls.view(tmp_path / "scene.toml", device="cpu")
    with pytest.raises(ls.FormatError, match="fps"):
        viewer.wait()
    viewer.close()


def test_invalid_view_options_of_a_page_are_reported_and_ignored(viewer: ls.Viewer) -> None:
    """An invalid budget or view is reported, and rendering continues."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        before, options = settled(viewer, page), viewer._session.options
        page.choose("frame time (ms)", 0.0)
        page.choose("view", "magic")
        eventually(lambda: sum("expected" in note for note in page.notes()) == 2, "no notification arrived")
        assert viewer._session.options == options
        np.testing.assert_array_equal(settled(viewer, page), before)


def test_split_comparison_renders_both_sides_at_full_quality_while_another_page_moves(viewer: ls.Viewer) -> None:
    """The comparison of the scene before and after edits is finished even while another page's camera moves."""
    with PageClient(viewer.url) as page, PageClient(viewer.url) as other:
        page.look(camera())
        other.look(camera(1.0))
        before = settled(viewer, page)
        viewer._session.apply(
            lambda document: document.changed(light_id(viewer), color=[0.2, 0.3, 1.0], intensity=20.0)
        )
        after = settled(viewer, page)
        viewer._session.set_options(split=0.5)
        for step in range(6):
            count = len(other.pictures)
            other.look(camera(1.0 + 0.1 * step))
            other.picture(after=count)
        joined = settled(viewer, page)
        assert difference(joined[:, :78], before[:, :78]) < 2.0 and difference(joined[:, 83:], after[:, 83:]) < 2.0
        assert difference(before, after) > 4.0
        viewer._session.set_options(insets=True)
        shown = settled(viewer, page)
        assert difference(shown[64:, -30:], joined[64:, -30:]) > 4.0, "no inset is in the right part"


def test_number_typed_into_a_viewer_control_is_applied_after_a_pause_not_digit_by_digit(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Partly typed values are neither applied nor rejected; another event applies a typed value at once."""
    monkeypatch.setattr(event_queue, "TYPING_PAUSE_S", 10.0)  # keys arrive slowly on a busy machine
    light, session = light_id(viewer), viewer._session
    session.select(light)
    seen: list[Any] = []
    session.on_change(lambda: seen.append(viewer.document.entry(light).table.get("intensity")))
    with PageClient(viewer.url) as page:
        page.look(camera())
        page.picture()
        handle: Any = viewer._outliner._inspector._controls["intensity"].handle
        count = len(session._past)
        for typed in (0, 4, 42, 420):
            page.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": typed})
        page.choose("insets", True)
        eventually(lambda: viewer.document.entry(light).table["intensity"] == 420, "the typed number was not applied")
        assert len(session._past) == count + 1 and not {0, 4, 42} & set(seen) and not page.notes()
        session.end_merge()
        page.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": 7})
        page.choose("grid", True)
        eventually(lambda: viewer._session.options.grid, "the grid is not shown")
        assert viewer.document.entry(light).table["intensity"] == 7, (
            "the typed number is not applied before the next event"
        )


def test_each_gizmo_that_a_viewer_page_shows_gets_a_new_node_name(viewer: ls.Viewer) -> None:
    """Pages keep a gizmo's rotation by its name, so a new name prevents a wrong rotation."""
    names: list[str] = []
    for entry in (viewer.document.entries[0].id, light_id(viewer), viewer.document.entries[0].id):
        viewer._session.select(entry)
        names.append(viewer._gizmo.node)
    assert len(set(names)) == 3


def test_viewer_notifications_wait_until_a_page_is_open(viewer: ls.Viewer) -> None:
    """Log warnings about a scene wait like errors, and repeated messages are shown once."""
    log = logging.getLogger("lumisplat")
    log.warning("colours of leaves are out of range")
    viewer._session.report("a file was left out")
    with PageClient(viewer.url) as page:
        page.look(camera())
        eventually(lambda: len(page.notes()) == 2, "no notification arrived")
        for _ in range(5):
            viewer._session.report("a crop that leaves nothing")
        log.error("an error of the log only")
        viewer._session.report("the last one")
        eventually(lambda: len(page.notes()) >= 4, "no notification arrived")
        assert page.notes() == [
            "warning: colours of leaves are out of range",
            "error: a file was left out",
            "error: a crop that leaves nothing",
            "error: the last one",
        ]


def test_a_camera_that_is_stored_late_does_not_replace_the_one_that_has_stopped(
    viewer: ls.Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread reads a camera, and stores it only after a later one has arrived and stopped."""
    read, pose_of = threading.Event(), Pose.of

    def read_slowly(*arguments: Any) -> Pose:
        pose = pose_of(*arguments)
        if not read.is_set():
            read.set()
            time.sleep(0.3)
        return pose

    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        (stopped,) = viewer._pages.values()
        monkeypatch.setattr(Pose, "of", read_slowly)
        page.look(camera(0.3))
        assert read.wait(10.0)
        page.look(camera(0.6))
        page.stop()
        eventually(lambda: stopped._has_stopped, "no stop arrived")
        last = stopped.pose
        time.sleep(0.5)
        assert stopped._has_stopped and stopped.pose == last


def test_viewers_render_loop_does_not_add_a_page_that_has_already_closed(viewer: ls.Viewer) -> None:
    """A closed page in the render loop would never be removed."""
    page = Page(BrowserScreen(cast(Any, None)), viewer._session.changed)
    page.close()
    viewer._loop.add(page)
    assert page not in viewer._loop._pages


def test_undoing_a_colour_temperature_in_the_viewer_resets_its_slider(viewer: ls.Viewer) -> None:
    """Undo of a colour temperature resets its slider, so that the same temperature can be chosen again."""
    viewer._session.select(light_id(viewer))
    with PageClient(viewer.url) as page:
        page.look(camera())
        page.picture()
        for _ in range(2):
            page.choose("temperature (K)", 3000.0)
            eventually(lambda: viewer.scene.lights[0].color != (1.0, 1.0, 1.0), "the colour did not change")
            assert viewer._session.undo() and viewer.scene.lights[0].color == (1.0, 1.0, 1.0)


def test_dragging_the_gizmo_keeps_edits_made_meanwhile_on_other_pages(viewer: ls.Viewer) -> None:
    """An entry removed by another page stays removed, even if it is the dragged one."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        page.picture()
        viewer._session.select(light_id(viewer))
        move = {"name": viewer._gizmo.node, "wxyz": [1.0, 0.0, 0.0, 0.0]}
        page.send("TransformControlsDragStartMessage", name=viewer._gizmo.node)
        page.send("TransformControlsUpdateMessage", **move, position=[1.0, -1.0, 0.0])
        eventually(lambda: viewer.scene.lights[0].position[0] == 1.0, "the light did not move")  # pyright: ignore
        crate = next(entry.id for entry in viewer.document.entries if entry.name == "crate")
        viewer._session.apply(lambda document: document.removed(crate))
        page.send("TransformControlsUpdateMessage", **move, position=[2.0, -1.0, 0.0])
        eventually(lambda: viewer.scene.lights[0].position[0] == 2.0, "the light did not move")  # pyright: ignore
        assert not viewer.scene.meshes
        viewer._session.apply(lambda document: document.removed(light_id(viewer)))
        page.send("TransformControlsUpdateMessage", **move, position=[3.0, -1.0, 0.0])
        page.send("TransformControlsDragEndMessage", name=viewer._gizmo.node)
        page.choose("exposure", 1.0)  # handled after all earlier events
        eventually(lambda: viewer._session.state.exposure == 1.0, "the exposure did not change")
        assert not viewer.scene.lights and not page.notes()


def test_button_frame_all_of_the_viewer_centres_the_scene_in_the_image(viewer: ls.Viewer) -> None:
    """From any position, the scene's centre moves to the image centre."""
    with PageClient(viewer.url) as page:
        away = ls.Camera.look_at((9.0, -0.4, -3.5), (9.0, 0.0, 0.0), UP, width=160, height=HEIGHT)
        page.look(away, target=(9.0, 0.0, 0.0))
        page.picture()
        (client,) = viewer._viser.get_clients().values()
        viewer._viewpoints.look_at_all(SimpleNamespace(client=client))
        np.testing.assert_allclose(client.camera.look_at, viewer._session.extent.center, atol=1e-6)
        backward = np.asarray(client.camera.position) - client.camera.look_at
        np.testing.assert_allclose(backward / np.linalg.norm(backward), (0.0, -0.114, -0.993), atol=1e-2)


def test_status_line_of_a_viewer_page_describes_its_own_image_not_that_of_another_page(viewer: ls.Viewer) -> None:
    """The line shows neither the size nor the samples of another page's image."""
    with PageClient(viewer.url) as wide, PageClient(viewer.url) as narrow:
        wide.look(camera())
        narrow.look(replace(camera(), width=60))
        for page in (wide, narrow):
            settled(viewer, page)
        for page, own_size, other_size in ((wide, "160 × 90", "60 × 90"), (narrow, "60 × 90", "160 × 90")):
            lines_sent = [
                str(m["updates"].get("_markdown", "")) for m in page.messages if m["type"] == "GuiUpdateMessage"
            ]
            lines = [line for line in lines_sent if "ms" in line and "×" in line]
            assert lines and all(own_size in line and f"· {other_size}" not in line for line in lines), lines
            assert not any(line.startswith(other_size) for line in lines)


def test_saving_a_scene_in_the_viewer_does_not_replace_a_file_with_unreadable_objects(
    viewer: ls.Viewer, tmp_path: Path
) -> None:
    """The file that names an unreadable object is not replaced; saving elsewhere reports the loss."""
    document_in(tmp_path)
    file = tmp_path / "scene.toml"
    file.write_text(file.read_text() + '[[meshes]]\npath = "gone.obj"\n')
    text = file.read_text()
    viewer._session.edit(lambda state: replace(state, document=ls.io.SceneDocument.open(file)))
    with PageClient(viewer.url) as page:
        page.look(camera())
        page.picture()
        page.choose("scene file", "scene.toml")
        page.choose("overwrite", True)
        page.press("save scene")
        eventually(lambda: any("is not replaced" in note for note in page.notes()), "no notification arrived")
        assert file.read_text() == text
        page.choose("scene file", "other.toml")
        page.press("save scene")
        eventually(lambda: any("without 1 object" in note for note in page.notes()), "no notification arrived")
        assert (tmp_path / "other.toml").exists()


def test_changed_settings_free_viewer_renderers_that_no_page_uses_any_more(viewer: ls.Viewer) -> None:
    """Only renderers of the current settings remain, and they keep the uploaded scene."""
    held, session = viewer._loop._renderers._held, viewer._session
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        (shown,) = viewer._pages.values()
        before = dict(held)
        assets = {use: [asset.data for asset in renderer._scene.assets] for use, renderer in before.items()}
        session.configure(lambda config: replace(config, tone_map=ls.ToneMap.AGX))
        settled(viewer, page)
        assert held == before
        for use, renderer in held.items():
            assert all(a.data is b for a, b in zip(renderer._scene.assets, assets[use], strict=True))
        session.configure(lambda config: replace(config, pipeline=ls.Pipeline.REALTIME))
        settled(viewer, page)
        assert held.keys() == {shown}
        session.configure(lambda config: replace(config, pipeline=ls.Pipeline.RASTER))
        session.set_options(split=0.5)
        settled(viewer, page)
        assert held.keys() == {"moving", "at rest", ("before", True), ("before", False)}
        session.set_options(split=None)
        settled(viewer, page)
        assert held.keys() == {"moving", "at rest"}
