"""Constants of materials and light found from photographs (docs/method/relightable.md)."""

SKY_CHUNK = 128
"""Gaussians whose derivatives by the sky are added up by one item."""

# --- Light that is traced ---

LIFT_SHORTEST = 4.0
"""How far above a Gaussian rays begin, in its least scales, at which its own response is 3e-4."""

LIFT_ALONG = 1.0
"""The same in its middle scales: neighbours lie as far above its plane."""

SPREAD_SHARE = 0.3
"""Of the angle between neighbouring directions, what is added to alpha of highlights, in squares: narrower ones would
fall between directions."""

# --- Exposures ---

EXPOSURE_VIEWS = 24
"""Photographs whose exposures are compared, at most."""

EXPOSURE_PIXELS = 64
"""Of a photograph, at least, for it to tell."""

EXPOSURE_RANGE = (0.08, 0.92)
"""Display values between which neither black nor white has cut off what was there."""

EXPOSURES_DIFFER = 0.25
"""Standard deviation of exposures, stops, from which on it is said: photographs of one exposure have 0.1,
rendered ones 0.01."""

# --- The start ---

OUTGOING_DIRECTIONS = 64
"""Over the sphere, in which the captured colour of a Gaussian is looked at."""

OUTGOING_COSINE = 0.3
"""Of those with the normal, at least: flatter views are extrapolated."""

# --- The sky ---

SKY_PAIRS = 60_000
"""Pairs of Gaussians by whose albedos the sky is found."""

SKY_RATE = 0.05
"""How far the logarithm of a radiance moves in the first step; it falls to 0."""

SKY_SMOOTHNESS = 1e-3
"""Weight of squared differences between neighbouring directions, beside the mean over pairs."""

SKY_NEIGHBOURS = 6

SKY_PRIOR = 1e-4
"""Weight of the squared distance from where it begins, likewise."""

SKY_SEEN = 0.02
"""Share of the sky that Gaussians see at the median, below which there is none to be found: a closed room."""

# --- Albedos that are alike ---

CHROMA_WIDTH = 0.15
"""Difference of chromaticity, natural logarithm, of Gaussians that may have one albedo."""

EDGE_WIDTH = 0.3
"""Difference of albedo, natural logarithm, from which on it is rather an edge of a texture (Cauchy)."""

# --- Materials ---

ROUGHNESS_MIN = 0.1
"""Least roughness that is found."""

NEIGHBOURS = 6
"""Gaussians near each, whose materials are compared with its own."""

ALBEDO_RATE = 0.01
ROUGHNESS_RATE = 0.02
SKY_FINE_RATE = 0.005
"""How far logits and logarithms move in the first step; from half of the steps on, rates fall to a tenth."""

ALBEDO_SMOOTHNESS = 0.05
"""Weight of squared differences, between neighbours, of what photographs change of the logarithms of albedos."""

ROUGHNESS_SMOOTHNESS = 0.05
"""Weight of squared differences between neighbours."""

PHOTO_SSIM = 0.2
"""Share of SSIM in the loss of photographs, as in training."""
