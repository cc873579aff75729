"""Constants of derivatives and of training; research they come from is named beside each."""

COMPENSATION_MIN = 0.005
"""Mip-Splatting's compensation of an opacity below which it is taken for constant: it falls to 0 for a Gaussian that is
seen edge-on, where its derivative by the scales grows beyond all bounds. gsplat has the same floor."""

SH_COEFFICIENTS_MAX = 16
"""Coefficients of spherical harmonics of degree 3."""

POSE_CHUNK = 256
"""Gaussians whose derivatives by the camera's pose are added up by one item."""
