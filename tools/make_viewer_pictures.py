"""Makes the images of the viewer's guide: the demo room in Chromium, and a video of a light that is dragged.

    python tools/make_viewer_pictures.py

Needs the extra ``dev`` and a Chromium; takes about five minutes on two cores.
"""

from __future__ import annotations

import io
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import lumisplat as ls

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZE: Any = {"width": 1280, "height": 800}
VIDEO_FRAMES, VIDEO_SIZE = 24, (640, 400)
LIGHT = (0.9, 1.5, 0.9)


def room() -> ls.Scene:
    """Returns the demo room, relit by a point light and by a weak one without shadows."""
    demo = ls.demo_scene()
    capture = ls.SplatInstance(demo.splats[0].gaussians, material=ls.MaterialPbr(), name="room")
    meshes = [replace(one, mesh=replace(one.mesh, colors=None)) for one in demo.meshes]
    light = ls.LightPoint(LIGHT, color=(1.0, 0.8, 0.55), intensity=9.0, radius=0.08, name="lamp")
    fill = ls.LightPoint((-0.5, 2.2, 2.5), color=(0.7, 0.85, 1.0), intensity=3.0, casts_shadow=False, name="fill")
    return ls.Scene([capture], meshes, [light, fill], up="y-up")


def main() -> None:
    """Writes docs/images/viewer.jpg, viewer_compare.jpg and viewer.webp."""
    from playwright.sync_api import sync_playwright

    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        sys.exit("no Chromium is installed")
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)
    viewer = ls.view(room(), config=config, height=SIZE["height"])
    viewer._status._stages.visible = viewer._status._plot.visible = False  # hides times of this machine
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport=SIZE)
        page.goto(viewer.url)
        wait_for(viewer, page)
        for note in page.locator("button.mantine-Notification-closeButton").all():
            note.click()
        look_from_the_hero(viewer)
        select(viewer, "brass")
        save(viewer, page, "viewer.jpg")
        light = select(viewer, "lamp")
        page.get_by_role("tab", name="View").click()
        page.locator("label:has-text('compare')").first.click()
        viewer._session.apply(
            lambda document: document.changed(light, position=[-1.0, 1.3, 0.6], color=[0.5, 0.7, 1.0])
        )
        save(viewer, page, "viewer_compare.jpg")
        page.locator("label:has-text('compare')").first.click()
        page.get_by_role("tab", name="Scene").click()
        video(viewer, page, light)
        browser.close()
    viewer.close()


def wait_for(viewer: ls.Viewer, page: Any) -> None:
    """Waits until the page shows all its samples."""

    def rests() -> bool:
        pages, revision = list(viewer._pages.values()), viewer._session.revision
        return bool(pages) and all(p.is_at_rest and p.key == (revision, p.pose_number) for p in pages)

    for _ in range(3):  # a late message may restart rendering
        page.wait_for_timeout(300)
        while not rests():
            page.wait_for_timeout(100)
    page.wait_for_timeout(1000)  # time to decode and draw


def look_from_the_hero(viewer: ls.Viewer) -> None:
    """Moves the page to the first camera of the demo."""
    viewer._fly(ls.demo_cameras()[0])


def select(viewer: ls.Viewer, name: str) -> int:
    """Selects an entry by its name, and returns its id."""
    number = next(entry.id for entry in viewer.document.entries if entry.name == name)
    viewer._session.select(number)
    return number


def shot(page: Any) -> Image.Image:
    """Returns a screenshot of the page."""
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def save(viewer: ls.Viewer, page: Any, name: str) -> None:
    """Writes a screenshot of the page at rest."""
    wait_for(viewer, page)
    shot(page).save(IMAGES / name, quality=88)
    print(IMAGES / name, flush=True)


def video(viewer: ls.Viewer, page: Any, light: int) -> None:
    """Writes a video of the light circling over the table."""
    pictures: list[np.ndarray] = []
    for number in range(VIDEO_FRAMES):
        angle = 2.0 * np.pi * number / VIDEO_FRAMES
        position = [float(1.1 * np.sin(angle)), 1.4, float(0.5 + 0.5 * np.cos(angle))]
        viewer._session.apply(
            lambda document, position=position: document.changed(light, position=position), merge="film"
        )
        wait_for(viewer, page)
        pictures.append(np.asarray(shot(page).resize(VIDEO_SIZE, Image.Resampling.LANCZOS), np.float32) / 255.0)
    ls.save_animation(IMAGES / "viewer.webp", pictures, fps=12.0)
    print(IMAGES / "viewer.webp", flush=True)


if __name__ == "__main__":
    started = time.monotonic()
    main()
    print(f"{time.monotonic() - started:.0f} s")
