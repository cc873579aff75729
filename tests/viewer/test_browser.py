"""The viewer works in Chromium, driven by Playwright; skipped if no Chromium is installed."""

from __future__ import annotations

import io
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_viewer import HEIGHT, LIGHT, TIMEOUT_S, difference, document_in, eventually, light_id, lit_scene

import lumisplat as ls
from lumisplat.viewer.panels.video import keys_of

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE = {"width": 800, "height": 500}

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Launches Chromium."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def viewer() -> Iterator[ls.Viewer]:
    """Opens a viewer of the lit scene."""
    viewer = ls.view(
        lit_scene(), height=4 * HEIGHT, device="cpu", config=ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    )
    viewer._loader.join()
    yield viewer
    viewer.close()


def open_page(browser: Any, viewer: ls.Viewer) -> Any:
    """Opens a page of the viewer and waits until its image is finished."""
    page, count = browser.new_page(viewport=SIZE), len(viewer._pages)
    page.goto(viewer.url)
    eventually(lambda: len(viewer._pages) > count, "the page did not connect")
    settle(viewer)
    return page


def settle(viewer: ls.Viewer) -> None:
    """Waits until all pages show their finished image."""

    def rests() -> bool:
        pages, revision = list(viewer._pages.values()), viewer._session.revision
        return bool(pages) and all(page.is_at_rest and page.key == (revision, page.pose_number) for page in pages)

    for _ in range(3):  # a message in transit may start another frame
        time.sleep(0.3)
        eventually(rests, "the image is not finished")


def still(page: Any) -> np.ndarray:
    """Returns a screenshot of a page's left part, once two screenshots in a row are equal."""
    last = shot(page)
    for _ in range(100):
        page.wait_for_timeout(500)
        now = shot(page)
        if np.array_equal(last, now):
            break
        last = now
    return last


def shot(page: Any) -> np.ndarray:
    """Returns a screenshot of a page's left part, without the panel."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    return picture[200:, :440]


def shown(viewer: ls.Viewer) -> np.ndarray:
    """Returns the left part of the image that the renderer rendered for the page."""
    (page,) = viewer._pages.values()
    assert page.frame is not None
    camera, height = page.frame.camera, SIZE["height"]
    size = round(height * camera.width / camera.height), height  # the image is beside the panel
    image = Image.fromarray(np.asarray(page.frame, np.uint8)).resize(size, Image.Resampling.BILINEAR)
    return np.asarray(image)[200:, :440]


def shows_its_frame(page: Any, viewer: ls.Viewer) -> bool:
    """Returns True if a page shows the image rendered for it, up to JPEG error; waits for a busy browser."""
    for _ in range(200):
        if ls.metrics.psnr(shot(page) / 255.0, shown(viewer) / 255.0) > 30.0:
            return True
        page.wait_for_timeout(500)
    return False


def until(holds: Callable[[], bool], page: Any) -> None:
    """Waits for a condition while the browser runs."""
    end = time.monotonic() + TIMEOUT_S
    while not holds():
        assert time.monotonic() < end
        page.wait_for_timeout(50)


def test_browser_shows_the_rendered_image(browser: Any, viewer: ls.Viewer) -> None:
    """The browser image equals the rendered one over the whole page: not mirrored, shifted or darker."""
    viewer._session.set_options(outlines=False)
    page = open_page(browser, viewer)
    assert shows_its_frame(page, viewer)
    page.close()


@pytest.mark.deep
def test_dragging_the_gizmo_in_a_browser_moves_the_light(browser: Any, viewer: ls.Viewer) -> None:
    """Dragging the gizmo's axis moves the light; undo restores the light and the image."""
    page = open_page(browser, viewer)
    step_back(viewer)
    viewer._session.select(light_id(viewer))
    settle(viewer)
    before = still(page)
    tip = handle_tip(viewer)
    page.mouse.move(*tip)
    page.mouse.down()
    for step in range(1, 9):
        page.mouse.move(tip[0] + 12 * step, tip[1])
        page.wait_for_timeout(60)
    page.mouse.up()
    until(lambda: viewer.scene.lights[0].position[0] > LIGHT[0] + 0.1, page)  # pyright: ignore
    settle(viewer)
    until(lambda: difference(before, still(page)) > 1.0, page)
    page.keyboard.press("Control+z")
    until(lambda: viewer.scene.lights[0].position[0] == LIGHT[0], page)  # pyright: ignore
    settle(viewer)
    until(lambda: difference(before, still(page)) < 0.5, page)
    page.close()


def handle_tip(viewer: ls.Viewer) -> tuple[float, float]:
    """Returns the page position of the tip of the gizmo's x axis."""
    (page,) = viewer._pages.values()
    assert page.pose is not None and viewer._gizmo._handle is not None
    camera = page.pose.camera(SIZE["height"])
    x, y, z = LIGHT
    point = camera.camera_from_world @ np.array([x + 0.85 * viewer._gizmo._handle.scale, y, z, 1.0])
    return camera.cx + camera.fx * point[0] / point[2], camera.cy + camera.fy * point[1] / point[2]


def step_back(viewer: ls.Viewer) -> None:
    """Moves the page's camera back until the light is in view."""
    (page,), (client,) = viewer._pages.values(), viewer._viser.get_clients().values()
    client.camera.look_at = (0.0, -0.5, 0.0)
    client.camera.position = (0.0, -0.5, -5.0)
    eventually(lambda: page.pose is not None and page.pose.position[2] < -4.9, "the camera did not move")


def test_reloaded_viewer_page_is_admitted_by_its_cookie_without_a_token(browser: Any, viewer: ls.Viewer) -> None:
    """The cookie admits a reloaded page; another browser without token and cookie gets status 401."""
    page = open_page(browser, viewer)
    address = viewer.url.partition("?")[0]
    assert page.goto(address).status == 200
    eventually(lambda: len(viewer._pages) == 1, "the page did not reconnect")
    settle(viewer)
    until(lambda: shot(page).std() > 5.0, page)
    other = browser.new_context().new_page()
    assert other.goto(address).status == 401
    other.close()
    page.close()


def pixels(viewer: ls.Viewer) -> np.ndarray:
    """Returns the rendered pixels of the single page's frame."""
    (page,) = viewer._pages.values()
    assert page.frame is not None
    return np.asarray(page.frame, np.uint8).copy()


@pytest.mark.deep
def test_undo_in_a_browser_restores_the_image_bit_for_bit(browser: Any, viewer: ls.Viewer) -> None:
    """Typing an exposure changes the image; undo restores it exactly."""
    page = open_page(browser, viewer)
    before, seen = pixels(viewer), still(page)
    page.get_by_text("Light", exact=True).click()
    field = page.locator("label:has-text('exposure')").locator("xpath=ancestor::div[.//input][1]").locator("input").last
    field.fill("2")
    field.press("Enter")
    until(lambda: viewer._session.state.exposure == 2.0, page)
    settle(viewer)
    until(lambda: difference(seen, shot(page)) > 5.0, page)
    page.get_by_text("undo", exact=True).click()
    until(lambda: viewer._session.state.exposure == 0.0, page)
    settle(viewer)
    np.testing.assert_array_equal(pixels(viewer), before)
    page.close()


@pytest.mark.deep
def test_browser_pages_have_independent_cameras(browser: Any, viewer: ls.Viewer) -> None:
    """Orbiting one page with the mouse leaves the image of the other page unchanged."""
    left, right = open_page(browser, viewer), open_page(browser, viewer)
    before = still(left)
    until(lambda: difference(before, still(right)) < 0.5, right)
    right.mouse.move(200, 420)
    right.mouse.down()
    for step in range(1, 9):
        right.mouse.move(200 + 15 * step, 420)
        right.wait_for_timeout(60)
    right.mouse.up()
    until(lambda: len({page.pose for page in viewer._pages.values()}) == 2, right)
    settle(viewer)
    until(lambda: difference(still(left), still(right)) > 2.0, right)
    assert difference(still(left), before) < 0.5
    for page in (left, right):
        page.close()


def test_broken_upload_in_a_browser_shows_an_error(browser: Any, viewer: ls.Viewer, tmp_path: Path) -> None:
    """A notification names the file, and the scene is unchanged."""
    viewer._session.edit(lambda state: replace(state, document=document_in(tmp_path)))
    page = open_page(browser, viewer)
    (tmp_path / "broken.glb").write_bytes(b"glTF nonsense")
    page.get_by_text("add", exact=True).first.click()
    page.set_input_files("input[type=file]", tmp_path / "broken.glb")
    page.get_by_text(re.compile("broken.glb")).first.wait_for(timeout=1000 * TIMEOUT_S)
    assert len(viewer.document.entries) == 1
    page.close()


@pytest.mark.deep
@pytest.mark.skipif(os.name != "posix", reason="no process can be killed like that")
def test_page_can_be_reopened_after_the_browser_was_killed(browser: Any, viewer: ls.Viewer, tmp_path: Path) -> None:
    """The killed page and its thread are removed; a new page shows the edited scene."""
    command = [CHROMIUM, "--headless", f"--user-data-dir={tmp_path}", *FLAGS, "--window-size=400,300", viewer.url]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True)
    eventually(lambda: bool(viewer._pages), "the page did not connect")
    settle(viewer)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    eventually(lambda: not viewer._pages, "the killed page is not removed")
    viewer._session.apply(lambda document: document.removed(light_id(viewer)))
    page = open_page(browser, viewer)
    viewer._session.set_options(outlines=False)
    assert not viewer.scene.lights and shows_its_frame(page, viewer)
    page.close()


def test_clicks_on_outliner_rows_select_hide_and_lock_objects(browser: Any, viewer: ls.Viewer) -> None:
    """Clicks on outliner rows select, hide and lock; the browser tab shows the program's name."""
    page = open_page(browser, viewer)
    assert page.title() == "Lumisplat"
    crate = next(entry.id for entry in viewer.document.entries if entry.name == "crate")
    page.locator(".lumi-name", has_text="crate").click()
    until(lambda: viewer._session.selected == crate, page)
    page.locator(f'[data-command="hide {crate}"]').click()
    until(lambda: viewer.document.entry(crate).hidden, page)
    page.locator(f'[data-command="hide {crate}"]').click()
    until(lambda: not viewer.document.entry(crate).hidden, page)
    page.locator(f'[data-command="lock {crate}"]').click()
    until(lambda: viewer._session.locked == {crate}, page)
    assert not page.locator(".mantine-TextInput-input").first.is_visible() or page.locator(".lumi-row.selected").count()
    page.close()


def test_first_edit_of_a_material_keeps_its_folder_open_and_the_panel_unscrolled(
    browser: Any, viewer: ls.Viewer
) -> None:
    """The first edit of a material neither closes its folder nor scrolls the panel."""
    page = open_page(browser, viewer)
    page.locator(".lumi-name", has_text="crate").click()
    page.get_by_text("material", exact=True).click()
    field = page.locator("label:has-text('metallic')").locator("xpath=ancestor::div[.//input][1]").locator("input").last
    field.scroll_into_view_if_needed()
    page.wait_for_timeout(500)
    before = field.bounding_box()
    field.fill("1")
    field.press("Enter")
    until(lambda: getattr(viewer.scene.meshes[0].mesh.material, "metallic", 0.0) == 1.0, page)
    page.wait_for_timeout(1000)
    assert field.is_visible() and field.bounding_box() == before
    page.close()


def test_viewer_panel_on_a_phone_is_a_drawer_with_the_whole_scene_above_it(browser: Any, viewer: ls.Viewer) -> None:
    """The drawer has the page's width; the camera moves back so that the whole scene fits above the drawer."""
    page, count = browser.new_page(viewport={"width": 390, "height": 844}), len(viewer._pages)
    page.goto(viewer.url)
    eventually(lambda: len(viewer._pages) > count, "the page did not connect")
    page.wait_for_timeout(1500)
    settle(viewer)
    drawer = page.locator('.mantine-Paper-root[style*="position: fixed"]').first.bounding_box()
    picture = page.locator("canvas").first.bounding_box()
    assert drawer["width"] == 390 and drawer["height"] <= 0.5 * 844 + 1
    assert picture["y"] + picture["height"] == pytest.approx(drawer["y"], abs=2)
    (shown,) = viewer._pages.values()
    assert shown.pose is not None and shown.frame is not None
    assert shown.pose.aspect == pytest.approx(picture["width"] / picture["height"], rel=0.02)
    expected, _ = viewer._first_view.at(shown.pose.aspect)
    np.testing.assert_allclose(shown.pose.position, expected, rtol=0.02)
    page.close()


def test_clicking_the_thumbnail_of_a_key_view_moves_the_pages_camera_there(browser: Any, viewer: ls.Viewer) -> None:
    """The clicked page moves to the first of two key views with a level horizon; another page does not move."""
    page, other = open_page(browser, viewer), open_page(browser, viewer)
    (clicked, unclicked) = viewer._pages.values()
    page.get_by_role("tab", name="Video").click()
    page.get_by_text("add key view", exact=True).click()
    until(lambda: len(keys_of(viewer.document)) == 1, page)
    start, unclicked_pose = clicked.pose, unclicked.pose
    client = viewer._viser.get_clients()[min(viewer._viser.get_clients())]
    client.camera.position = np.asarray(client.camera.position) + np.array([1.0, -0.5, -1.0])
    until(lambda: clicked.pose != start, page)
    page.get_by_text("add key view", exact=True).click()
    until(lambda: len(keys_of(viewer.document)) == 2, page)
    page.locator('img[data-command="look 0"]').click()
    assert start is not None
    until(lambda: bool(np.allclose(clicked.pose.position, start.position, atol=1e-3)), page)  # pyright: ignore
    assert unclicked.pose == unclicked_pose
    up = np.asarray(client.camera.up_direction)
    np.testing.assert_allclose(up, viewer.scene.up_direction, atol=1e-6)
    page.close()
    other.close()


def test_dragging_the_clock_in_a_browser_moves_the_sun(browser: Any, viewer: ls.Viewer) -> None:
    """From noon to the evening the sun turns and dims; undo goes back to noon in one step."""
    sun = {"latitude": 48.1, "longitude": 11.6, "time": "2026-06-21T12:00+02:00"}
    viewer._session.apply(lambda document: document.removed(light_id(viewer)).added("sun", sun)[0])
    page = open_page(browser, viewer)
    page.locator(".lumi-name", has_text="sun").click()
    slider = page.locator("label:has-text('time of day')").locator("xpath=ancestor::div[.//input][1]")
    noon, before = viewer.scene.lights[0], shot(page)
    thumb, track = (slider.locator(f".mantine-Slider-{part}").bounding_box() for part in ("thumb", "track"))
    page.mouse.move(thumb["x"] + 0.5 * thumb["width"], thumb["y"] + 0.5 * thumb["height"])
    page.mouse.down()
    page.mouse.move(track["x"] + 0.85 * track["width"], track["y"], steps=8)
    page.mouse.up()
    until(lambda: viewer.scene.lights[0].intensity < 0.5 * noon.intensity, page)
    until(lambda: difference(before, shot(page)) > 5.0, page)
    assert np.dot(viewer.scene.lights[0].direction, noon.direction) < 0.5  # pyright: ignore
    page.keyboard.press("Control+z")
    until(lambda: viewer.scene.lights[0] == noon, page)
    page.close()


def test_playback_in_a_browser_moves_lights_in_real_time(browser: Any, viewer: ls.Viewer) -> None:
    """The key P starts the playback and stops it; between, the animation time runs like the clock on the wall."""
    keys = [{"time": 0.0}, {"time": 100.0, "position": [40.0, -1.0, -0.8]}]
    viewer._session.apply(lambda document: document.changed(light_id(viewer), keyframes=keys))
    page = open_page(browser, viewer)
    before = shot(page)
    page.keyboard.press("p")
    until(lambda: viewer._session.options.time > 0.0, page)
    started, first = time.monotonic(), viewer._session.options.time
    until(lambda: viewer._session.options.time > first + 1.0, page)
    assert viewer._session.options.time - first <= time.monotonic() - started + 0.2
    page.keyboard.press("p")
    until(lambda: not viewer._timeline._plays.value, page)
    settle(viewer)
    until(lambda: difference(before, shot(page)) > 1.0, page)
    page.close()


def test_page_says_that_its_camera_has_stopped_once_the_pointer_is_released(browser: Any, viewer: ls.Viewer) -> None:
    """A pointer that rests while it holds the camera says nothing; a camera that the wheel or a key moved says it."""
    page = open_page(browser, viewer)
    (moved,) = viewer._pages.values()
    start = moved.pose
    page.mouse.move(200, 420)
    page.mouse.down()
    page.mouse.move(260, 420, steps=6)
    until(lambda: moved.pose != start, page)
    page.wait_for_timeout(300)
    assert not moved._has_stopped
    page.mouse.move(300, 420, steps=6)
    page.mouse.up()
    until(lambda: moved._has_stopped, page)
    for move, end in ((lambda: page.mouse.wheel(0, 200), None), (lambda: page.keyboard.down("d"), "d")):
        number = moved.pose_number
        move()
        until(lambda number=number: moved.pose_number > number, page)
        if end:
            page.keyboard.up(end)
        until(lambda: moved._has_stopped, page)
        last = moved.pose_number
        page.wait_for_timeout(300)
        assert moved.pose_number == last and moved._has_stopped
    page.close()
