"""Denoising of a frame's light by Open Image Denoise (Áfra 2019-2026, openimagedenoise.org; package mitsuba-oidn).

docs/method/lighting.md#denoising describes which images are denoised, and which images guide the denoiser.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from lumisplat.config import PathPrimary, RasterStrategy, RenderConfig, TraceStrategy
from lumisplat.constants import WEIGHT_ROUNDING
from lumisplat.errors import ConfigError, MissingExtraError
from lumisplat.frame.frame_data import FrameData
from lumisplat.frame.layers import check_layer
from lumisplat.math.arrays import Flags, FloatArray
from lumisplat.math.tone_map import captured_radiance

UNLIT_REACH = 2
"""A captured pixel counts as unlit if light changes no captured pixel within this many columns and rows (5 x 5
pixels). One pixel is not enough, because its few samples may all miss a light."""


def check_denoiser() -> None:
    """Raises MissingExtraError unless the denoiser is installed."""
    _package()


def denoised_light(frame: FrameData) -> FloatArray:
    """Returns a lit frame's ``light``, denoised, shape (H, W, 3); captured pixels that receive no light are unchanged.

    Positive light is denoised as radiance, and negative light (shadows) as a fraction of the captured radiance, so that
    captures keep their detail in shadows.

    Raises:
        ConfigError: The frame is unlit, or has no albedo.
        MissingExtraError: The denoiser is not installed.
    """
    if not frame.has("light") or frame.captured is None or frame.captured_weight is None or frame.light is None:
        raise ConfigError(
            "an unlit frame cannot be denoised, because it shows captures as trained: set RenderConfig.lighting=True"
        )
    light = np.where(np.isfinite(frame.light), frame.light, np.float32(0.0))
    captured = captured_radiance(frame.captured, frame.captured_weight)
    shadow = np.divide(np.maximum(-light, 0.0), captured, out=np.zeros_like(light), where=captured > 0.0)
    added = _denoised(np.maximum(light, 0.0), _guides(frame))
    taken = captured * _denoised(shadow, {})
    return np.where(_unlit_pixels(frame)[..., None], frame.light, added - taken)


def _unlit_pixels(frame: FrameData) -> Flags:
    """Returns a mask of the captured pixels that receive no light, shape (H, W).

    A pixel is in the mask only if light changes no captured pixel of the 5 x 5 pixels around it. Its own samples alone
    are too few: all of them may miss a dim light or a thin shadow.
    """
    assert frame.light is not None and frame.captured_weight is not None
    is_captured = frame.captured_weight >= 1.0 - WEIGHT_ROUNDING
    reach = UNLIT_REACH
    changed = np.pad(is_captured & frame.light.any(axis=2), reach)
    around = np.lib.stride_tricks.sliding_window_view(changed, (2 * reach + 1, 2 * reach + 1))
    return is_captured & ~around.any(axis=(2, 3))


def _guides(frame: FrameData) -> dict[str, Any]:
    """Returns the images albedo and normal for the denoiser; empty if defocus or random choice makes them useless.

    The entry ``clean_aux`` tells the denoiser whether albedo and normal are free of noise.
    """
    if frame.camera.aperture > 0.0:
        return {}  # out of focus, samples of one pixel hit different surfaces
    if frame.config is None or draws_surfaces(frame.config):
        if not frame.has("albedo") or (frame.gaussian_index >= 0).any():
            return {}
    check_layer(frame, "albedo")
    assert frame.albedo is not None
    albedo = np.clip(np.nan_to_num(frame.albedo), 0.0, 1.0)
    return {"albedo": albedo, "normal": np.ascontiguousarray(frame.normal), "clean_aux": not frame.draws_meshes}


def draws_surfaces(config: RenderConfig) -> bool:
    """Returns whether rays choose their first Gaussian at random, so that albedo and normals are noisy."""
    if config.pipeline.traces_paths:
        return config.path.primary is not PathPrimary.ISO
    if not config.pipeline.rasterises:
        return config.trace.strategy is not TraceStrategy.SORTED
    return config.raster.strategy is not RasterStrategy.SORTED


def _denoised(image: FloatArray, guides: dict[str, Any]) -> FloatArray:
    """Returns a denoised copy of a non-negative linear HDR image, shape (H, W, 3), or the image itself if black."""
    if not image.any():
        return image
    result = np.array(_package().denoise(np.ascontiguousarray(image), hdr=True, **guides), np.float32)
    return np.maximum(result, 0.0)


def _package() -> Any:
    """Imports and returns the denoiser's package.

    Raises:
        MissingExtraError: The package is not installed.
    """
    try:
        return import_module("mitsuba_oidn")
    except ImportError:
        raise MissingExtraError("denoising", "denoise") from None
