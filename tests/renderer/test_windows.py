"""Frames of camera windows equal crops of the full image to the bit, including random numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.compare.backends import BACKENDS, renderer_of
from support.scenes import lit_scene
from support.scenes.lenses import LENSES, layers, lens, rolling
from support.scenes.pipelines import SAMPLED
from support.scenes.raster_scenes import checker_quad, front_camera, random_gaussians, similarity

SCHEDULES = [backend for backend in BACKENDS if backend != "cpu as graph"]
"""CPU schedule and CUDA schedule on the CPU, and every GPU."""
DEVICES = [backend for backend in BACKENDS if not backend.startswith("cpu as")]
WINDOWS = [(16, 0, 32, 16), (48, 32, 23, 21), (0, 16, 16, 37)]
"""Windows in an image of 71 x 53: at the upper edge, in the lower right corner, at the left and lower edge."""
SIZE = 71, 53
ORTHOGRAPHIC = lens(22.0, SIZE, model=ls.CameraModel.ORTHOGRAPHIC)
RAY_CAMERAS = {
    "thin lens": lens(60.0, SIZE, aperture=0.05, focus_distance=2.5),
    "orthographic": ORTHOGRAPHIC,
    "distorted fisheye": replace(LENSES["fisheye of 220 degrees"], width=71, height=53, cx=36.0, cy=25.0),
    "rolling shutter": rolling(lens(60.0, SIZE, distortion=(0.05, -0.08, 0.0, 0.0, -0.001, 0.0))),
}


def assert_crop(renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera) -> None:
    """Asserts that every image of every window equals the crop of the full frame."""
    whole = renderer.render(scene, camera).arrays()
    for window in WINDOWS:
        left, top, width, height = window
        frame = renderer.render(scene, replace(camera, window=window))
        assert frame.color.shape == (height, width, 3)
        for name, image in frame.arrays().items():
            if name == "light_names":
                continue
            expected = whole[name]
            first = expected.ndim - 2 if expected.shape[-1] != 3 else expected.ndim - 3  # lights come first
            part = (slice(None),) * first + (slice(top, top + height), slice(left, left + width))
            np.testing.assert_array_equal(image, expected[part], f"{name} of {window}")


@pytest.mark.parametrize("backend", SCHEDULES)
@pytest.mark.parametrize("strategy", list(ls.config.RasterStrategy))
def test_unlit_frame_of_a_window_equals_the_crop_of_the_full_image(
    strategy: ls.config.RasterStrategy, backend: str
) -> None:
    """Splats are sorted and stochastic, in both schedules; some are larger than the window, and meshes have alpha."""
    sheet = checker_quad(0.0)
    seen_through = replace(sheet.material, alpha=0.5, alpha_mode="blend")
    scene = ls.Scene(
        [random_gaussians(3, count=300, degree=3), random_gaussians(31, count=6, scale_range=(1.0, 8.0))],
        [
            ls.MeshInstance(
                replace(sheet, material=seen_through), similarity((0.3, 1.0, 0.2), 0.5, 1.1, (0.2, 0.0, 4.0))
            )
        ],
    )
    config = ls.RenderConfig(raster=ls.RasterConfig(strategy=strategy), samples=2, background=None)
    assert_crop(renderer_of(backend, config), scene, front_camera(*SIZE, cx=30.3, cy=20.1))


@pytest.mark.parametrize("backend", DEVICES)
@pytest.mark.parametrize("pipeline", SAMPLED)
def test_lit_frame_of_a_window_equals_the_crop_of_the_full_image(pipeline: ls.Pipeline, backend: str) -> None:
    """The scene has soft shadows, mirrors, glass, captures and relit sets, and the frame has light layers."""
    aovs = ("albedo", "lights", "variance", "sample_count")
    if pipeline is ls.Pipeline.PATH:
        aovs += ("direct_diffuse", "indirect_diffuse", "indirect_glossy")
    config = lit_scene.config(pipeline, samples=2, shadows=ls.Shadows.SOFT, aovs=aovs)
    scene = lit_scene.scene(*lit_scene.LIGHTS, lit_scene.ENVIRONMENT)
    assert_crop(renderer_of(backend, config), scene, lit_scene.camera(*SIZE))


@pytest.mark.parametrize("name", RAY_CAMERAS)
def test_traced_frame_of_a_window_equals_the_crop_for_all_lenses(name: str) -> None:
    """The lenses are fisheye, thin lens, orthographic and rolling shutter."""
    camera = RAY_CAMERAS[name]
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, samples=2)
    assert_crop(ls.create_renderer(config, "cpu"), ls.Scene([layers(camera)]), camera)


@pytest.mark.parametrize("backend", SCHEDULES)
@pytest.mark.parametrize("name", ["distorted fisheye", "rolling shutter"])
def test_unscented_frame_of_a_window_equals_the_crop_of_the_full_image(name: str, backend: str) -> None:
    """The unscented projection uses sigma points for bounds, and pixel rays."""
    camera = RAY_CAMERAS[name]
    config = ls.RenderConfig(raster=ls.RasterConfig(projection=ls.config.Projection.UNSCENTED))
    assert_crop(renderer_of(backend, config), ls.Scene([layers(camera)]), camera)


@pytest.mark.parametrize("name", ["phone", "barrel"])
def test_rasterised_distorted_frame_of_a_window_equals_the_crop_of_the_full_image(name: str) -> None:
    """Rasterised frames with lens distortion are resampled from a larger pinhole frame."""
    camera = replace(LENSES[name], width=71, height=53, cx=36.0, cy=25.0, fx=60.0, fy=63.0)
    assert_crop(ls.create_renderer(None, "cpu"), ls.Scene([layers(camera)]), camera)


def test_focus_pixel_of_a_windowed_camera_is_in_full_image_coordinates() -> None:
    """The depth at a pixel of the window is that of the full image; so is the coverage of mattes."""
    camera = lens(60.0, SIZE, aperture=0.1)
    scene = ls.Scene([layers(camera)])
    config = ls.RenderConfig(pipeline=ls.Pipeline.TRACE)
    renderer = ls.create_renderer(config, "cpu")
    cut = replace(camera, window=WINDOWS[1])
    assert renderer.focused(scene, cut, 40, 20).focus_distance == renderer.focused(scene, camera, 40, 20).focus_distance
    mattes = [ls.layers.render_mattes(scene, view, config, device="cpu") for view in (cut, camera)]
    np.testing.assert_array_equal(mattes[0].objects.shares, mattes[1].objects.shares[:, 32:, 48:])


@pytest.mark.parametrize(
    ("window", "message"),
    [
        ((8, 0, 16, 16), "multiples of 16 pixels"),
        ((0, 0, 40, 53), "multiples of 16 pixels"),
        ((64, 0, 16, 16), "expected a part of the image of 71 x 53"),
        ((-16, 0, 32, 16), "expected a part of the image"),
        ((0, 0, 0, 16), "expected a part of the image"),
        ((0, 0, 16), "four whole numbers"),
        ((0, 0, 16.5, 16), "four whole numbers"),
    ],
)
def test_camera_refuses_windows_that_are_misaligned_empty_or_outside_its_image(
    window: tuple[float, ...], message: str
) -> None:
    """The constructor of the camera refuses windows outside the image or without pixels."""
    with pytest.raises(ls.SceneError, match=message):
        lens(60.0, SIZE, window=window)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pipeline": "realtime"}, "needs the whole image"),
        ({"pipeline": "path", "noise": 0.1}, "choose samples by the whole image"),
        ({"pipeline": "trace", "samples": 4, "adaptive": True}, "choose samples by the whole image"),
        ({"pipeline": "hybrid", "time_limit": 1.0}, "choose samples by the whole image"),
    ],
)
def test_settings_that_need_the_full_image_refuse_cameras_with_a_window(settings: dict[str, Any], message: str) -> None:
    """One message replaces pixels that would differ from the full image."""
    camera = lens(60.0, SIZE, window=WINDOWS[0])
    with pytest.raises(ls.ConfigError, match=message):
        ls.render(lit_scene.scene(), camera, ls.RenderConfig(**settings), device="cpu")


def test_gradients_and_the_method_scaled_refuse_cameras_with_a_window() -> None:
    """Gradients need the full image, and a camera must be scaled before its window is set."""
    camera = lens(60.0, SIZE, window=WINDOWS[0])
    with pytest.raises(ls.SceneError, match="need the whole image"):
        ls.splat_gradients(ls.Scene([layers(camera)]), camera, dL_dcolor=np.ones((53, 71, 3)), device="cpu")
    with pytest.raises(ls.SceneError, match="scale it first"):
        camera.scaled(width=10)
