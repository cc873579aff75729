"""The viewer in a real browser: Chromium, driven by Playwright; skipped where there is none."""

from __future__ import annotations

import io
import shutil
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image
from test_viewer import HEIGHT, eventually, lit_scene

import lumisplat as ls

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE = {"width": 800, "height": 500}

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser."""
    playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def viewer() -> Iterator[ls.Viewer]:
    """A viewer on the lit scene."""
    viewer = ls.view(
        lit_scene(), height=4 * HEIGHT, device="cpu", config=ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    )
    viewer._loader.join()
    yield viewer
    viewer.close()


def open_page(browser: Any, viewer: ls.Viewer) -> Any:
    """A page of the viewer, once it shows a finished picture."""
    page = browser.new_page(viewport=SIZE)
    page.goto(viewer.url)
    eventually(lambda: bool(viewer._pages), "the page did not connect")
    settle(viewer)
    return page


def settle(viewer: ls.Viewer) -> None:
    """Waits until all pages show all that there is to show."""
    time.sleep(0.3)
    eventually(lambda: all(page.is_finished for page in viewer._pages.values()), "the picture is not finished")
    time.sleep(1.0)  # the browser decodes and draws it


def shot(page: Any) -> np.ndarray:
    """The left part of a page, beside the panel."""
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    return picture[200:, :440]


def shown(viewer: ls.Viewer) -> np.ndarray:
    """The same part of what the renderer has rendered for the page."""
    (page,) = viewer._pages.values()
    assert page.frame is not None
    image = Image.fromarray(np.asarray(page.frame, np.uint8)).resize(
        (SIZE["width"], SIZE["height"]), Image.Resampling.BILINEAR
    )
    return np.asarray(image)[200:, :440]


def test_a_browser_shows_the_renderers_picture(browser: Any, viewer: ls.Viewer) -> None:
    """All over the page: not mirrored, shifted or too dark."""
    viewer._session.set_options(outlines=False)
    page = open_page(browser, viewer)
    assert ls.psnr(shot(page) / 255.0, shown(viewer) / 255.0) > 30.0
    page.close()


def test_a_page_that_is_reloaded_needs_no_token(browser: Any, viewer: ls.Viewer) -> None:
    """Its cookie lets it in; another browser without either sees 401."""
    page = open_page(browser, viewer)
    address = viewer.url.partition("?")[0]
    assert page.goto(address).status == 200
    eventually(lambda: len(viewer._pages) == 1, "the page did not come back")
    settle(viewer)
    assert shot(page).std() > 5.0
    other = browser.new_context().new_page()
    assert other.goto(address).status == 401
    other.close()
    page.close()
