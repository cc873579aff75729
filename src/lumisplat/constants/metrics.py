"""Thresholds of metrics (Mir et al. 2026, sections 4.1 and 4.2; docs/method/relighting.md#metrics)."""

IRRADIANCE_SH_DEGREE = 3
"""Order L of the irradiance that PAA-Y and APF-Y fit. Section 4.1."""

NEIGHBOURHOOD_RADIUS = 1.5
"""Metres around an avatar's centre within which the scene is compared with it: the middle of section 4.1's 1 to 2."""

TRIMMED_SHARE = 0.05
"""Share of the largest residuals that a fit leaves out. Section 4.1."""

HUBER_WIDTH = 1.345
"""Standard deviations beyond which residuals count linearly: 95 % as efficient as least squares where errors are
normal (Huber 1981; Holland and Welsch 1977)."""

HUBER_WIDTH_MIN = 0.05
"""Relative residual below which no point is an outlier, however well the others fit: 8-bit colours are no better."""

MAD_PER_DEVIATION = 0.6745
"""Median of the absolute values of normal errors, standard deviations."""

FIT_STEPS_MAX = 100
"""Reweightings of a fit; it ends where the coefficients change by less than FIT_TOLERANCE. Some ten do."""

FIT_TOLERANCE = 1e-9
"""Relative to the largest coefficient."""

IRRADIANCE_SMOOTHNESS = 1e-3
"""Weight of the penalty l (l + 1) c^2 on a band of irradiance, per sample: in directions without normals, irradiance is
smooth. With normals in all directions, bands shrink by some 4 to 20 %, higher ones more. Less leaves noise: of a floor
lit evenly, 3000 normals within 0.2 of upright, scales log-normal by 0.5, PAA-Y from constant light is 0.12 to 0.20 with
this, and 0.3 to 0.45 with a tenth of it."""

IRRADIANCE_FLOOR = 0.1
"""Irradiance, relative to the mean luminance, below which residuals of a fit are no longer relative to it: darker
values are mostly noise and the camera's black level."""

CHROMATICITY_SAMPLES_MAX = 2000
"""Gaussians of each side in NCM-ab, drawn at random beyond: optimal transport between so many takes half a second,
four times as many half a minute."""

SHADOW_MASK_THRESHOLD = 0.1
"""tau: shadow strength above which a pixel is in shadow. Section 4.2."""

BOUNDARY_TOLERANCE_PX = 2.0
"""Distance, pixels, within which boundaries of shadows agree. Section 4.2, table 3."""

SSIM_SIGMA_PX = 1.5
"""Standard deviation of SSIM's window. Wang et al. 2004."""

SSIM_WINDOW_PX = 11
"""Side of SSIM's window. Wang et al. 2004."""

FLIP_PIXELS_PER_DEGREE = 67.02064514160156
"""FLIP's own default: a display 0.7 m wide, of 3840 pixels, seen from 0.7 m. Andersson et al. 2020."""
