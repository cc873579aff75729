"""Denoised light of a frame, by Open Image Denoise (Áfra 2019-2026, openimagedenoise.org; package mitsuba-oidn).

What is denoised, and by which guides: docs/method/lighting.md#denoising.
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

DENOISE_TOUCH_REACH = 2
"""A captured pixel counts as untouched by light if so are the captured ones up to so many pixels away: where every
second sample finds a light, one of 25 pixels does but for once in 30 million."""


def check_denoiser() -> None:
    """Raises MissingExtraError unless the denoiser is installed."""
    _package()


def denoised_light(frame: FrameData) -> FloatArray:
    """The field ``light`` of a lit frame, (H, W, 3), denoised; as it was where light touches no capture.

    What is added and what shadows take are denoised apart: the former as radiance, the latter as a share of the
    captured light, so that captures keep their detail in shadows.

    Raises:
        ConfigError: The frame is unlit, or has no albedo.
        MissingExtraError: The denoiser is not installed.
    """
    if not frame.has("light") or frame.captured is None or frame.captured_weight is None or frame.light is None:
        raise ConfigError(
            "an unlit frame cannot be denoised: it shows captures as trained (RenderConfig.lighting=True)"
        )
    light = np.where(np.isfinite(frame.light), frame.light, np.float32(0.0))
    captured = captured_radiance(frame.captured, frame.captured_weight)
    shadow = np.divide(np.maximum(-light, 0.0), captured, out=np.zeros_like(light), where=captured > 0.0)
    added = _denoised(np.maximum(light, 0.0), _guides(frame))
    taken = captured * _denoised(shadow, {})
    return np.where(_untouched(frame)[..., None], frame.light, added - taken)


def _untouched(frame: FrameData) -> Flags:
    """Where a pixel shows captures and the background alone, and light changed none of those around it, (H, W).

    One pixel alone does not say so: a few samples may miss a dim light, or pass a thin shadow.
    """
    assert frame.light is not None and frame.captured_weight is not None
    is_captured = frame.captured_weight >= 1.0 - WEIGHT_ROUNDING
    reach = DENOISE_TOUCH_REACH
    changed = np.pad(is_captured & frame.light.any(axis=2), reach)
    around = np.lib.stride_tricks.sliding_window_view(changed, (2 * reach + 1, 2 * reach + 1))
    return is_captured & ~around.any(axis=(2, 3))


def _guides(frame: FrameData) -> dict[str, Any]:
    """Albedo and normals of the first surfaces, unless these are drawn at random; and whether they have no noise."""
    if frame.camera.aperture > 0.0:
        return {}  # each sample has surfaces of its own
    if frame.config is None or draws_surfaces(frame.config):
        if not frame.has("albedo") or (frame.gaussian_index >= 0).any():
            return {}
    check_layer(frame, "albedo")
    assert frame.albedo is not None
    albedo = np.clip(np.nan_to_num(frame.albedo), 0.0, 1.0)
    return {"albedo": albedo, "normal": np.ascontiguousarray(frame.normal), "clean_aux": not frame.draws_meshes}


def draws_surfaces(config: RenderConfig) -> bool:
    """Whether the first Gaussian on a ray is drawn at random, so that albedo and normals are as noisy as light is."""
    if config.pipeline.traces_paths:
        return config.path.primary is not PathPrimary.ISO
    if not config.pipeline.rasterises:
        return config.trace.strategy is not TraceStrategy.SORTED
    return config.raster.strategy is not RasterStrategy.SORTED


def _denoised(image: FloatArray, guides: dict[str, Any]) -> FloatArray:
    """A linear image of any range from 0, (H, W, 3), denoised; black ones are as they were."""
    if not image.any():
        return image
    result = np.array(_package().denoise(np.ascontiguousarray(image), hdr=True, **guides), np.float32)
    return np.maximum(result, 0.0)


def _package() -> Any:
    """The package that brings the denoiser.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        return import_module("mitsuba_oidn")
    except ImportError:
        raise MissingExtraError("denoising", "denoise") from None
