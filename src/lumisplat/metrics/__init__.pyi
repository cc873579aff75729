"""Metrics of image quality, lighting and shadows."""

from lumisplat.metrics.images import (
    flip as flip,
    ms_ssim as ms_ssim,
    ms_ssim_scales as ms_ssim_scales,
    psnr as psnr,
    ssim as ssim,
)
from lumisplat.metrics.lighting import LitPoints as LitPoints, apf_y as apf_y, ncm_ab as ncm_ab, paa_y as paa_y
from lumisplat.metrics.preference import WinRate as WinRate, win_rate as win_rate
from lumisplat.metrics.shadows import boundary_f as boundary_f, sae as sae, sm_iou as sm_iou

__all__: list[str]
