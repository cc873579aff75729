"""Constants of derivatives and of training; research they come from is named beside each."""

COMPENSATION_MIN = 0.005
"""Mip-Splatting's compensation of an opacity below which it is taken for constant: it falls to 0 for a Gaussian that is
seen edge-on, where its derivative by the scales grows beyond all bounds. gsplat's has this floor after 1.5.3."""

SH_COEFFICIENTS_MAX = 16
"""Coefficients of spherical harmonics of degree 3."""

POSE_CHUNK = 256
"""Gaussians whose derivatives by the camera's pose are added up by one item."""

BACKWARD_HITS = 2**22
"""Hits of rays whose derivatives are on the device at once: 44 bytes each, some 180 MiB, unless a packet has more."""

EXPOSURE_CHUNK = 256
"""Pixels whose derivatives by an exposure are added up by one item."""

# --- The optimiser (Kingma and Ba 2015; values of Kerbl et al. 2023) ---

ADAM_BETA_1 = 0.9
ADAM_BETA_2 = 0.999
ADAM_EPSILON = 1e-15

# --- Markov chain Monte Carlo (Kheradmand et al. 2024; values of gsplat) ---

NOISE_SLOPE = 100.0
"""How sharply the noise ends at `DEAD_OPACITY`."""

# --- Surfaces ---

SURFACE_ALPHA = 0.5
"""Alpha above which a pixel has a surface."""

SURFACE_VARIANCE_MIN = 1e-6
"""Variance of depth, extents^2, below which a surface is thin enough. Gao et al. 2024, code."""

SURFACE_SPREAD = 0.1
"""Standard deviation of depth, extents, beyond which it counts by ever less: what is farther apart is fog in which no
surface is yet to be seen, and a film close to the cameras would be the thinnest of all (decision 0071)."""

SURFACES_AFTER = 0.23
"""Share of the steps after which normals and depths count. 7,000 of 30,000, Huang et al. 2024, code."""

# --- Poses ---

POSES_AFTER = 0.1
"""Share of the steps after which poses are learnt: before, nothing is where it will be."""

# --- The loss ---

SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
"""Wang et al. 2004, section III-C, of pictures in 0..1."""

COVERED_MIN = 1e-6
"""Alpha, and 1 less alpha, below which the entropy of what is covered stays as it is. Gao et al. 2024, code."""

# --- How Gaussians come and go ---

POINTS_SHARE_MIN = 0.05
"""Known points, as a share of those that training begins with where none are known, below which random ones are added:
MCMC adds a twentieth of what there is, and never gets far from next to nothing."""

DENSIFY_AFTER = 500
"""Steps before the first change of the number of Gaussians, but for short trainings: a sixtieth of these."""

DENSIFY_EVERY = 100
"""Steps between two changes."""

DENSIFY_UNTIL = {"mcmc": 0.83, "adaptive": 0.5}
"""Share of the steps after which their number stays. gsplat's 25,000 and 15,000 of 30,000."""

DEAD_OPACITY = 0.005
"""Opacity at or below which a Gaussian is dead, or pruned. Kerbl et al. 2023, Kheradmand et al. 2024."""

GROWTH = 1.05
"""Factor by which their number grows in a change, up to the cap. gsplat's."""

RELOCATED_MAX = 51
"""Gaussians that share a place, at most: more are counted as so many. gsplat's."""

SPLIT_SCALE = 0.01
"""Scale, as a share of the extent, above which a Gaussian is split and not cloned. Kerbl et al. 2023."""

SPLIT_SHRINKS = 1.6
"""Factor by which both halves are smaller. Kerbl et al. 2023, section 5.2."""

TOO_LARGE = 0.1
"""Scale, as a share of the extent, above which a Gaussian is pruned."""

TOO_LARGE_AFTER = 3000
RESET_EVERY = 3000
"""Steps between two resets of opacities. Kerbl et al. 2023."""

RESET_OPACITY = 0.01
"""Opacity to which they are reset. Kerbl et al. 2023."""

# --- The frame (docs/adr/0086-one-local-origin.md) ---

TRAINING_EXTENT = 4.4
"""Extent of the cameras in the frame in which Gaussians are learnt, whatever the unit of the scene: cameras four units
around an object, as in NeRF's synthetic sets, for which weights of scales and strengths of noise are chosen."""

# --- The start ---

INITIAL_OPACITY = {"mcmc": 0.5, "adaptive": 0.1}
INITIAL_SCALE = {"mcmc": 0.3, "adaptive": 1.0}
"""Scale of the first Gaussians, as a share of the root mean square of the distances to their three nearest neighbours.
That of MCMC is between gsplat's 0.1 and 1."""

INITIAL_DEPTHS = (0.4, 1.8)
"""Depths of points at random, as shares of the distance to what the cameras look at."""

INITIAL_SCALE_MIN = 1e-6
"""Least scale of the first Gaussians, scene units: points may coincide."""

# --- Rates ---

SH_REST_SHARE = 0.05
"""How far harmonics above the constant one move, as a share of that. Kerbl et al. 2023."""

NOISE_STRENGTH = 5e5
"""Of the noise, times the rate of the means. gsplat's."""
