"""What an evaluation of found materials and light returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from lumisplat.math.arrays import Flags, FloatArray


class RelitFigures(NamedTuple):
    """How near relit pictures are to true ones, where the object is."""

    psnr: float
    """Decibels."""
    ssim: float
    """At most 1; NaN: pictures are too small, or scikit-image is not installed."""
    flip: float
    """0..1, the lower the better; NaN: flip-evaluator is not installed."""


@dataclass(frozen=True, slots=True, eq=False)
class MaterialView:
    """A view held out: figures and pictures of what was found. Figures are NaN where there is nothing to compare."""

    name: str
    coverage: float
    """Share of its pixels that the object covers by half or more, 0..1: what is compared."""
    albedo_psnr: float
    """Of sRGB-encoded albedo after one scale a channel, dB."""
    albedo_psnr_unscaled: float
    """The same without a scale, dB."""
    albedo_psnr_linear: float
    """Of linear albedo after the scale, dB."""
    normal_mean: float
    """Mean angle between normals, degrees."""
    normal_median: float
    """Median angle between normals, degrees."""
    roughness_rmse: float
    """Root mean square error of perceptual roughness, 0..1."""
    relit: Mapping[str, RelitFigures]
    """By the names of the light that photographs were not made in."""
    region: Flags
    """What is compared, shape (H, W)."""
    pictures: Mapping[str, tuple[FloatArray, FloatArray]]
    """What was found and the truth, display colours, shape (H, W, 3) each, by ``albedo``, ``normal``, ``roughness`` and
    the names of the light: ``relit/sunny``."""


@dataclass(frozen=True, slots=True, eq=False)
class MaterialEvaluation:
    """How near found materials and light are to the truth, as `evaluate_materials` measures it.

    Figures are NaN where the set has no truth, or the capture nothing that was found; ``remarks`` say which. PSNR, SSIM
    and FLIP are means over the views, the others are of all their pixels together.
    """

    albedo_scale: tuple[float, float, float]
    """The factor of each channel by which found albedo is as bright as the truth; 1 without a truth."""
    albedo_psnr: float
    """Of sRGB-encoded albedo after that scale, dB."""
    albedo_psnr_unscaled: float
    """The same without a scale, dB."""
    albedo_psnr_linear: float
    """Of linear albedo after the scale, dB."""
    normal_mean: float
    """Mean angle between normals, degrees."""
    normal_median: float
    """Median angle between normals, degrees."""
    roughness_rmse: float
    """Root mean square error of perceptual roughness, 0..1."""
    environment_psnr: float
    """Of the environment after one scale a channel, dB (see the guide)."""
    relit: Mapping[str, RelitFigures]
    """By the names of the light that photographs were not made in; albedo is scaled as above."""
    views: tuple[MaterialView, ...]
    """The views held out, by name."""
    remarks: tuple[str, ...]
    """What was not compared, or stands for something that was not found, a line each."""

    def __repr__(self) -> str:
        relit = ", ".join(f"{name} {figures.psnr:.2f}" for name, figures in self.relit.items())
        return (
            f"MaterialEvaluation(views={len(self.views)}, albedo_psnr={self.albedo_psnr:.2f}, "
            f"normal_mean={self.normal_mean:.2f}, roughness_rmse={self.roughness_rmse:.4f}, relit_psnr={{{relit}}})"
        )
