"""Layers and relit pictures of a view against their truth: figures, and pictures of both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lumisplat.errors import MissingExtraError, SceneError
from lumisplat.math.arrays import Doubles, Flags, FloatArray
from lumisplat.math.color import encode_srgb
from lumisplat.metrics.images import flip, psnr, ssim
from lumisplat.metrics.materials import Channels, channel_scale, normal_errors
from lumisplat.relighting.evaluation.results import MaterialView, RelitFigures

Pair = tuple[FloatArray, FloatArray]
"""What was found, and the truth."""


@dataclass(frozen=True, slots=True)
class SeenView:
    """A view's layers and pictures, found and true, shape (H, W, C)."""

    name: str
    region: Flags
    """What counts, shape (H, W)."""
    layers: Mapping[str, Pair]
    """Those that both have."""
    relit: Mapping[str, Pair]
    """By environment, display colours over black."""

    def counted(self, layer: str) -> tuple[Doubles, Doubles]:
        """A layer's pixels that count, shape (N, C) each; N is 0 if there is no such layer."""
        if layer not in self.layers:
            return np.zeros((0, 3)), np.zeros((0, 3))
        found, truth = self.layers[layer]
        return found[self.region].astype(np.float64), truth[self.region].astype(np.float64)


def albedo_scale(views: Sequence[SeenView]) -> Channels:
    """The one scale a channel of all views; 1 if there is no albedo to compare."""
    pairs = [view.counted("albedo") for view in views]
    found, truth = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
    return channel_scale(found, truth) if len(found) else (1.0, 1.0, 1.0)


def normal_figures(views: Sequence[SeenView]) -> tuple[float, float]:
    """Mean and median angle between normals over all views' pixels, degrees."""
    errors = np.concatenate([normal_errors(*view.counted("normal")) for view in views])
    return (float(errors.mean()), float(np.median(errors))) if len(errors) else (math.nan, math.nan)


def roughness_rmse(views: Sequence[SeenView]) -> float:
    """Root mean square error of roughness over all views' pixels."""
    pairs = [view.counted("roughness") for view in views]
    errors = np.concatenate([(found - truth)[:, 0] for found, truth in pairs])
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else math.nan


def measured(view: SeenView, scale: Channels) -> tuple[MaterialView, list[str]]:
    """The figures and pictures of a view, and why figures are missing.

    Args:
        view: The view; its relit pictures have the scaled albedo already.
        scale: Of the albedo.
    """
    problems: list[str] = []
    mean, median = normal_figures([view])
    result = MaterialView(
        name=view.name,
        coverage=float(view.region.mean()),
        albedo_psnr=_albedo_psnr(view, scale),
        albedo_psnr_unscaled=_albedo_psnr(view, (1.0, 1.0, 1.0)),
        albedo_psnr_linear=_albedo_psnr(view, scale, linear=True),
        normal_mean=mean,
        normal_median=median,
        roughness_rmse=roughness_rmse([view]),
        relit={name: _relit_figures(pair, view.region, problems) for name, pair in view.relit.items()},
        region=view.region,
        pictures=_pictures(view, scale),
    )
    return result, problems


def _albedo_psnr(view: SeenView, scale: Channels, *, linear: bool = False) -> float:
    if "albedo" not in view.layers:
        return math.nan
    found, truth = _albedo_pictures(view, scale, linear=linear)
    return psnr(found, truth, region=view.region)


def _albedo_pictures(view: SeenView, scale: Channels, *, linear: bool = False) -> Pair:
    found, truth = view.layers["albedo"]
    pair = np.clip(found * np.array(scale, np.float32), 0.0, 1.0), np.clip(truth, 0.0, 1.0)
    return pair if linear else (_displayed(pair[0]), _displayed(pair[1]))


def _displayed(linear: FloatArray) -> FloatArray:
    return np.clip(encode_srgb(linear), 0.0, 1.0).astype(np.float32)


def _relit_figures(pair: Pair, region: Flags, problems: list[str]) -> RelitFigures:
    figures: list[float] = []
    for name, metric in {"psnr": psnr, "ssim": ssim, "flip": flip}.items():
        try:
            figures.append(metric(*pair, region=region))
        except (MissingExtraError, SceneError) as error:
            figures.append(math.nan)
            problems.append(f"no {name}: {error}")
    return RelitFigures(*figures)


def _pictures(view: SeenView, scale: Channels) -> dict[str, Pair]:
    """Display pictures of layers and relit views, black where nothing counts."""
    shown: dict[str, Pair] = {}
    if "albedo" in view.layers:
        shown["albedo"] = _albedo_pictures(view, scale)
    if "normal" in view.layers:
        found, truth = view.layers["normal"]
        shown["normal"] = 0.5 + 0.5 * found, 0.5 + 0.5 * truth
    if "roughness" in view.layers:
        found, truth = (np.repeat(values, 3, axis=2) for values in view.layers["roughness"])
        shown["roughness"] = found, truth
    shown |= {f"relit/{name}": pair for name, pair in view.relit.items()}
    inside = view.region[..., None].astype(np.float32)
    return {name: (np.clip(a, 0.0, 1.0) * inside, np.clip(b, 0.0, 1.0) * inside) for name, (a, b) in shown.items()}
