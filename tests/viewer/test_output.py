"""What leaves the viewer as a download: pictures with layers, films, captures as a page."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_viewer import HEIGHT, camera, cloud, eventually, lit_scene, settled

import lumisplat as ls
from lumisplat.viewer.panels.background_jobs import captures_html
from support.viewer.page_client import PageClient

CONFIG = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=4)


@pytest.fixture
def viewer() -> Iterator[ls.Viewer]:
    """A viewer on the lit scene."""
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    viewer._loader.join()
    yield viewer
    viewer.close()


@pytest.fixture
def page(viewer: ls.Viewer) -> Iterator[PageClient]:
    """A page at rest."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        yield page


def test_a_picture_is_the_frame_of_its_size_and_samples(page: PageClient) -> None:
    """As `lumisplat.render` gives it at the page's camera, whatever the page shows; narrower, if that is asked for."""
    page.choose("height (px)", 120, folder="images")
    page.choose("width (px)", 100)
    page.choose("samples per pixel", 3, folder="images")
    page.press("render image")
    eventually(lambda: "view.png" in page.downloads(), "no picture came")
    picture = np.asarray(Image.open(io.BytesIO(page.downloads()["view.png"])))
    view = ls.Camera.look_at(
        (0.0, -0.4, -3.5), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=100, height=120, fov_y=camera().fov_y
    )
    expected = ls.render(lit_scene(), view, ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=3), device="cpu")
    assert picture.shape == (120, 100, 3)
    assert np.abs(picture / 255.0 - expected.pixels_srgb()).max() < 0.01


def test_an_exr_has_the_layers_that_were_asked_for(page: PageClient, tmp_path: Path) -> None:
    """Besides those that it always has; one that there is not is told at once, and nothing comes."""
    import OpenEXR

    page.choose("height (px)", 64, folder="images")
    page.choose("samples per pixel", 2, folder="images")
    page.choose("format", "exr", folder="images")
    page.choose("layers", "albedo, lights")
    page.press("render image")
    eventually(lambda: "view.exr" in page.downloads(), "no picture came")
    (tmp_path / "view.exr").write_bytes(page.downloads()["view.exr"])
    with OpenEXR.File(str(tmp_path / "view.exr")) as file:
        channels = set(file.channels())
    assert {"depth.Z", "normal.X", "index.instance", "albedo", "light.lamp.shadow"} <= channels
    page.choose("layers", "albdo")
    page.press("render image")
    eventually(lambda: any("albdo" in note for note in page.notes()), "nobody was told")


def test_a_video_has_a_frame_for_each_time_of_the_flight(viewer: ls.Viewer, page: PageClient) -> None:
    """Each as seen from there."""
    page.press("add key view")
    page.choose("seconds to next", 0.5)
    page.look(camera(1.5))
    settled(viewer, page)
    page.press("add key view")
    page.choose("height (px)", 48, folder="video")
    page.choose("samples per pixel", 1, folder="video")
    page.choose("format", "webp", folder="video")
    page.choose("frames per second", 8.0)
    eventually(lambda: viewer.document.top.get("animation", {}).get("fps") == 8.0, "the rate stayed")
    page.press("render video")
    eventually(lambda: "video.webp" in page.downloads(), "no video came")
    video = Image.open(io.BytesIO(page.downloads()["video.webp"]))
    animation = viewer.document.animation
    assert animation is not None and animation.camera_path is not None and getattr(video, "n_frames", 0) == 4
    config, similar = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=1), []
    for number in (0, 3):
        video.seek(number)
        view = animation.camera_path.at(number / 8.0).scaled(height=48)
        expected = ls.render(lit_scene(), view, config, device="cpu").pixels_srgb()
        similar.append(ls.metrics.psnr(np.asarray(video.convert("RGB"), np.float32) / 255.0, expected))
    assert min(similar) > 30.0


def test_work_can_be_cancelled_and_other_work_waits(viewer: ls.Viewer, page: PageClient) -> None:
    """A picture of a great many samples ends when it is told to; while it goes on, no other is begun."""
    page.choose("samples per pixel", 60000, folder="images")
    page.press("render image")
    eventually(lambda: bool(viewer._loop._background), "it did not begin")
    page.press("render image")
    eventually(lambda: any("cancel it" in note for note in page.notes()), "nobody was told")
    page.press("cancel")
    eventually(lambda: not viewer._loop._background, "it did not end")
    assert not page.downloads()


def test_work_that_is_not_done_does_not_keep_a_viewer_open() -> None:
    """It is closed in the middle of a picture."""
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    viewer._loader.join()
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        page.choose("samples per pixel", 60000, folder="images")
        page.press("render image")
        eventually(lambda: bool(viewer._loop._background), "it did not begin")
        viewer.close()
    assert not viewer._loop._thread.is_alive()


def test_captures_as_a_page_need_nothing_else() -> None:
    """No address of another place is in the file, and the Gaussians are, under the transforms of their instances."""
    scene = ls.Scene([ls.SplatInstance(cloud(), position=(3.0, 0.0, 0.0), scale_by=2.0)])
    text = captures_html(scene)
    assert text.lstrip().lower().startswith("<!doctype html") and 'src="http' not in text and "ws://127" not in text
    recording = embedded(text)
    assert b"/capture 0" in recording
    first = (2.0 * cloud().means[0] + (3.0, 0.0, 0.0)).astype(np.float32)
    assert first.tobytes() in recording


def embedded(text: str) -> bytes:
    """The recording in a page of viser."""
    import re

    import zstandard

    found = max(re.findall(r"[A-Za-z0-9+/=]{1000,}", text), key=len)
    raw = base64.b64decode(found)
    return zstandard.ZstdDecompressor().decompress(raw[8:], max_output_size=int.from_bytes(raw[:8], "little"))
