"""Frames as images for notebooks, NumPy and metrics."""

from __future__ import annotations

import base64
import io
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

import lumisplat as ls
from support.scenes import raster_scenes as scenes


def shown(color: tuple[float, float, float] = (0.8, 0.4, 0.2), size: int = 32, **settings: Any) -> ls.Frame:
    """Renders one nearly opaque Gaussian that fills most of a small image."""
    scene = ls.Scene([scenes.one_gaussian(opacity=1.0, scale=2.0, color=color)])
    return ls.render(scene, scenes.front_camera(size, size), ls.RenderConfig(**settings), device="cpu")


def pixels_of(data: str) -> Image.Image:
    """Decodes the image of a notebook's MIME bundle."""
    return Image.open(io.BytesIO(base64.b64decode(data)))


@pytest.mark.parametrize("background", ["black", None])
def test_images_of_captures_brighter_than_white_are_clipped_to_white(background: str | None) -> None:
    """SH colours above white are clipped in images, as documented, and metrics accept such frames."""
    frame = shown((1.3, 0.5, 0.1), background=background)
    assert frame.color.max() > 1.05
    pixels = frame.pixels_srgb()
    assert pixels.min() >= 0.0 and pixels.max() == 1.0
    np.testing.assert_array_equal(pixels[..., 1], np.clip(pixels[..., 1], 0.0, 1.0))
    assert ls.metrics.psnr(pixels[..., :3], pixels[..., :3]) == float("inf")


def test_frames_convert_to_numpy_arrays_of_the_requested_dtype() -> None:
    """NumPy's protocol gives a new array of the PNG's pixels in the requested dtype."""
    frame = shown()
    np.testing.assert_array_equal(np.asarray(frame), frame.pixels_srgb())
    assert np.asarray(frame).dtype == np.float32
    assert np.asarray(frame, np.float64).dtype == np.float64
    np.testing.assert_array_equal(np.asarray(frame, np.uint8), (frame.pixels_srgb() * 255.0 + 0.5).astype(np.uint8))
    assert np.array(frame, copy=True).shape == (32, 32, 3)
    with pytest.raises(ValueError, match="copy=False is impossible"):
        np.array(frame, copy=cast(Any, False))
    assert ls.metrics.psnr(cast(Any, frame), cast(Any, frame)) == float("inf")


def test_notebook_output_of_a_frame_is_a_png_with_its_size_and_repr() -> None:
    """The MIME bundle contains a PNG of the pixels with its size, and the repr of the frame."""
    frame = shown()
    data, about = frame._repr_mimebundle_()
    assert set(data) == {"image/png", "text/plain"} and data["text/plain"] == repr(frame)
    assert about == {"image/png": {"width": 32, "height": 32}}
    np.testing.assert_array_equal(np.asarray(pixels_of(data["image/png"])), np.asarray(frame, np.uint8))
    alone = frame._repr_png_()
    assert alone is not None and alone == base64.b64decode(data["image/png"])


def test_notebook_output_of_a_frame_has_only_the_requested_mime_types() -> None:
    """MIME types that the notebook does not include, or that it excludes, are left out."""
    frame = shown()
    assert set(frame._repr_mimebundle_(include={"text/plain"})[0]) == {"text/plain"}
    assert set(frame._repr_mimebundle_(exclude={"text/plain"})[0]) == {"image/png"}
    assert frame._repr_mimebundle_(include={"image/png"}, exclude={"image/png"}) == ({}, {})


def test_notebook_output_of_large_opaque_frames_is_jpeg() -> None:
    """Frames above a megapixel become JPEGs; transparent ones stay PNGs, because JPEG has no alpha."""
    large = shown(size=1040)
    data, about = large._repr_mimebundle_()
    assert set(data) == {"image/jpeg", "text/plain"} and about == {"image/jpeg": {"width": 1040, "height": 1040}}
    assert large._repr_png_() is None
    difference = np.asarray(pixels_of(data["image/jpeg"]), np.float64) - np.asarray(large, np.uint8)
    assert np.sqrt((difference**2).mean()) < 2.0
    clear = shown(size=1040, background="transparent")
    data, _ = clear._repr_mimebundle_()
    assert pixels_of(data["image/png"]).mode == "RGBA"


def test_notebook_output_of_a_frame_that_cannot_be_encoded_is_text() -> None:
    """Showing a broken frame in a notebook never raises."""
    broken = replace(shown(), color=cast(Any, None))
    data, about = broken._repr_mimebundle_()
    assert set(data) == {"text/plain"} and "no image" in data["text/plain"] and about == {}
    assert broken._repr_png_() is None
