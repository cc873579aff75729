"""Metrics of image quality, lighting and shadows."""

from lumisplat.metrics.images import (
    flip as flip,
)
from lumisplat.metrics.images import (
    ms_ssim as ms_ssim,
)
from lumisplat.metrics.images import (
    ms_ssim_scales as ms_ssim_scales,
)
from lumisplat.metrics.images import (
    psnr as psnr,
)
from lumisplat.metrics.images import (
    ssim as ssim,
)
from lumisplat.metrics.lighting import LitPoints as LitPoints
from lumisplat.metrics.lighting import apf_y as apf_y
from lumisplat.metrics.lighting import ncm_ab as ncm_ab
from lumisplat.metrics.lighting import paa_y as paa_y
from lumisplat.metrics.shadows import boundary_f as boundary_f
from lumisplat.metrics.shadows import sae as sae
from lumisplat.metrics.shadows import sm_iou as sm_iou
