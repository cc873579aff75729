"""Comparison with gsplat: the stored images of tools/make_gsplat_reference.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from support.compare.images import assert_images_alike
from support.files.splat_files import load_gaussians
from support.scenes.raster_scenes import gsplat_frames

REFERENCE = Path(__file__).resolve().parents[2] / "reference"


def reference(name: str) -> tuple[np.ndarray, ls.Camera]:
    """Returns a stored image, shape (H, W, 4), and its camera."""
    with np.load(REFERENCE / f"gsplat_{name}.npz") as stored:
        image = stored["image"] / float(stored["steps"])
        fx, fy, cx, cy = stored["intrinsics"]
        height, width = image.shape[:2]
        pose = stored["camera_from_world"]
        assert str(stored["made_with"]).startswith("gsplat 1.5.3")
    return image, ls.Camera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy, camera_from_world=pose)


def assert_like_gsplat(frame: ls.Frame, image: np.ndarray) -> None:
    """Asserts a mean error below half an 8-bit step over covered pixels, and 99.5 % within four steps."""
    shown = image[..., 3] > 0.0
    assert shown.mean() > 0.1
    actual = np.concatenate([frame.color, frame.alpha[..., None]], axis=-1)
    assert_images_alike(actual[shown][None], image[shown][None], mean=0.5 / 255.0, within=4.0 / 255.0, share=0.995)
    assert_images_alike(actual, image, mean=0.5 / 255.0, within=4.0 / 255.0, share=0.995)


@pytest.mark.parametrize("name", gsplat_frames())
def test_rasterised_synthetic_captures_equal_gsplat(renderer: ls.Renderer, name: str) -> None:
    """The captures cover SH degree 3, opacity compensation, and a wide lens that needs the Jacobian clamp."""
    gaussians, camera = gsplat_frames()[name]
    image, stored_camera = reference(name)
    np.testing.assert_array_equal(stored_camera.camera_from_world, camera.camera_from_world)
    assert_like_gsplat(renderer.render(ls.Scene([gaussians]), stored_camera), image)


@pytest.mark.data
@pytest.mark.parametrize("name", ["biker_front", "biker_close"])
def test_rasterised_real_capture_equals_gsplat(renderer: ls.Renderer, data_dir: Path, name: str) -> None:
    """The downloaded biker capture is rendered as a whole and from close up."""
    biker = load_gaussians(data_dir / "splats" / "biker.compressed.ply")
    image, camera = reference(name)
    assert_like_gsplat(renderer.render(ls.Scene([biker]), camera), image)
