"""The viewer offers downloads: images with layers, videos, and captures as HTML."""

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
    """Opens a viewer of the lit scene."""
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    viewer._loader.join()
    yield viewer
    viewer.close()


@pytest.fixture
def page(viewer: ls.Viewer) -> Iterator[PageClient]:
    """Opens a page and waits until its image is finished."""
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        yield page


def test_exported_image_has_the_requested_size_and_samples(page: PageClient) -> None:
    """The image equals `lumisplat.render` with the page's camera, whatever the page displays, at any width."""
    page.choose("height (px)", 120, folder="images")
    page.choose("width (px)", 100)
    page.choose("samples per pixel", 3, folder="images")
    page.press("render image")
    eventually(lambda: "view.png" in page.downloads(), "no image was downloaded")
    picture = np.asarray(Image.open(io.BytesIO(page.downloads()["view.png"])))
    view = ls.Camera.look_at(
        (0.0, -0.4, -3.5), (0.0, 0.0, 0.0), (0.0, -1.0, 0.0), width=100, height=120, fov_y=camera().fov_y
    )
    expected = ls.render(lit_scene(), view, ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, samples=3), device="cpu")
    assert picture.shape == (120, 100, 3)
    assert np.abs(picture / 255.0 - expected.pixels_srgb()).max() < 0.01


def test_exported_exr_has_the_requested_layers(page: PageClient, tmp_path: Path) -> None:
    """The EXR also has the standard layers; an unknown layer is reported at once and nothing is downloaded."""
    import OpenEXR

    page.choose("height (px)", 64, folder="images")
    page.choose("samples per pixel", 2, folder="images")
    page.choose("format", "exr", folder="images")
    page.choose("layers", "albedo, lights")
    page.press("render image")
    eventually(lambda: "view.exr" in page.downloads(), "no image was downloaded")
    (tmp_path / "view.exr").write_bytes(page.downloads()["view.exr"])
    with OpenEXR.File(str(tmp_path / "view.exr")) as file:
        channels = set(file.channels())
    assert {"depth.Z", "normal.X", "index.instance", "albedo", "light.lamp.shadow"} <= channels
    page.choose("layers", "albdo")
    page.press("render image")
    eventually(lambda: any("albdo" in note for note in page.notes()), "no notification arrived")


def test_video_saved_by_the_viewer_has_a_frame_for_each_time_of_the_camera_path(
    viewer: ls.Viewer, page: PageClient
) -> None:
    """Each frame is rendered from the path's camera at its time."""
    page.press("add key view")
    page.choose("seconds to next", 0.5)
    page.look(camera(1.5))
    settled(viewer, page)
    page.press("add key view")
    page.choose("height (px)", 48, folder="video")
    page.choose("samples per pixel", 1, folder="video")
    page.choose("format", "webp", folder="video")
    page.choose("frames per second", 8.0)
    eventually(lambda: viewer.document.top.get("animation", {}).get("fps") == 8.0, "the frame rate did not change")
    page.press("render video")
    eventually(lambda: "video.webp" in page.downloads(), "no video was downloaded")
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


def test_viewer_runs_one_background_job_at_a_time_and_can_cancel_it(viewer: ls.Viewer, page: PageClient) -> None:
    """A long render ends when cancelled; another job is refused while it runs."""
    page.choose("samples per pixel", 60000, folder="images")
    page.press("render image")
    eventually(lambda: bool(viewer._loop._background), "the job did not start")
    page.press("render image")
    eventually(lambda: any("cancel it" in note for note in page.notes()), "no notification arrived")
    page.press("cancel")
    eventually(lambda: not viewer._loop._background, "the job did not end")
    assert not page.downloads()


def test_viewer_closed_during_a_background_render_ends_its_render_thread() -> None:
    """The viewer closes in the middle of a render."""
    viewer = ls.view(lit_scene(), height=HEIGHT, device="cpu", config=CONFIG)
    viewer._loader.join()
    with PageClient(viewer.url) as page:
        page.look(camera())
        settled(viewer, page)
        page.choose("samples per pixel", 60000, folder="images")
        page.press("render image")
        eventually(lambda: bool(viewer._loop._background), "the job did not start")
        viewer.close()
    assert not viewer._loop._thread.is_alive()


def test_exported_html_is_self_contained_and_has_all_gaussians() -> None:
    """The file refers to no external address and has the Gaussians with their instance transforms."""
    scene = ls.Scene([ls.SplatInstance(cloud(), position=(3.0, 0.0, 0.0), scale_by=2.0)])
    text = captures_html(scene)
    assert text.lstrip().lower().startswith("<!doctype html") and 'src="http' not in text and "ws://127" not in text
    recording = embedded(text)
    assert b"/capture 0" in recording
    first = (2.0 * cloud().means[0] + (3.0, 0.0, 0.0)).astype(np.float32)
    assert first.tobytes() in recording


def embedded(text: str) -> bytes:
    """Returns the scene data embedded in an exported HTML page."""
    import re

    import zstandard

    found = max(re.findall(r"[A-Za-z0-9+/=]{1000,}", text), key=len)
    raw = base64.b64decode(found)
    return zstandard.ZstdDecompressor().decompress(raw[8:], max_output_size=int.from_bytes(raw[:8], "little"))
