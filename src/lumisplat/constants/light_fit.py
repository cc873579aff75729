"""Thresholds of fitting lights to photographs (docs/method/relighting.md#lights-of-a-photograph)."""

RANK_TOLERANCE = 1e-13
"""Eigenvalue, relative to the largest, up to which a combination of unknowns is not determined."""

FIT_SIZE = 128
"""Pixels along the longer side of the pictures in which lights are fitted: light is smooth, and shadows are wide."""

COARSE_SIZE = 40
"""The same where lamps are looked for: shadows that are coarse have no edges to be caught at."""

COARSE_SAMPLES = 0.25
"""Of the samples, there."""

FIT_SAMPLES_OF_PATHS = 64
"""Samples a pixel of paths, for each light: with them, 128 x 96 pixels know a lamp's light to some thousandths."""

CLIPPED_ABOVE = 0.995
"""Display value from which on a pixel may be clipped: 254 of 255 and above."""

RELATIVE_NOISE = 0.02
"""Error of a photograph's light that is expected of it, relative to the pixel and to the mean: no model is better."""

NOISE_BLUR = 2
"""Pixels to each side over which a photograph is averaged to say what error is expected: by noisy pixels
themselves, those that noise has made dark would weigh more."""

HUBER_WIDTH = 1.345
"""Deviations up to which residuals count as squares: 95 % efficient if they are normal (Huber 1981)."""

TUKEY_WIDTH = 4.685
"""Deviations from which on a residual does not count at all: as efficient (Beaton and Tukey 1974)."""

DEVIATION_MIN = 1e-4
"""Of residuals, in units of the expected noise: perfect photographs have none, and weights divide by it."""

ROBUST_STEPS = 40
"""Steps of reweighting, at most."""

ROBUST_CHANGE = 1e-7
"""Change of the unknowns, relative, at which reweighting ends."""

NORMAL_RIDGE = 1e-9
"""Relative to the diagonal of the normal equations: lights that cannot be told apart share evenly."""

NOISE_SHARE_MAX = 0.5
"""Of the square of a sum of pictures, at most so much is taken for noise and left out: of more, nothing is known."""

ALIKE_BELOW = 1e-3
"""Eigenvalue of the columns' correlations below which those that its vector is made of cannot be told apart: two of
them correlate to 0.999."""

DARK_SHARE = 1e-5
"""Of the brightest column's length: a light of that little is not in the photographs."""

SKY_ROWS = 32
"""Rows of the images of harmonics as environments, and of the environment that is found."""

SKY_SHARE_MIN, SKY_ERRORS_MIN = 0.01, 3.0
"""An environment that gives less than this share of the light that is explained, and whose mean radiance is less than
so many standard errors from 0, is none: where lamps alone shone, noise and 8 bits gave shares of up to 0.006, and 1.6
errors."""

SKY_DIRECTIONS = 96
"""Directions in which the radiance of harmonics must not be negative, spread evenly."""

FIT_DEGREE_MAX = 4
"""Of an environment's harmonics: matt surfaces take in hardly more than degree 2 (Ramamoorthi and Hanrahan 2001)."""

BLOCK_PX = 8
"""Side of the squares of pixels whose residuals are taken to go together, where errors are estimated."""

PLACES_A_SIDE = (3, 4)
"""Lamps are tried at so many places along each side of the box that holds the scene, cubed, one lattice after the
other: from one alone, three lamps of one photograph ended in a wrong place."""

PLACE_STEP = 0.004
"""Of the room's size: half the way between two pictures of a derivative."""

ANGLE_STEP = 0.02
"""The same of directions and cones, radians."""

COLOR_STEP = 0.04
"""The same of base colours."""

MOVE_MAX = 0.15
"""Of the room's size: the longest way of a lamp in one step."""

MOVED_LEAST = 2e-4
"""Of the room's size: steps shorter than this end the search."""

SEARCH_STEPS = 25
"""Gauss-Newton steps at each resolution, at most."""

STEPS_EXPECTED = 8
"""Steps that searches mostly take, to say how far a fit is: two that were far away took 11 and 22, others 2 to 8."""

DAMPING_START, DAMPING_MAX = 1e-3, 1e4
"""Of Levenberg and Marquardt, relative to the diagonal: with the largest, a step is too short to be worth it."""

SMOOTH_REACH = 1.0 / 32.0
"""How far to each side light that has bounced is averaged, of the longer side of the picture: as far in the scene,
whatever the picture's size. With twice that, at 64 pixels, a lamp of a bounced room was off by 2.8 % instead of 1.4."""

SMOOTH_COSINE_MIN = 0.9
"""Cosine between normals from which on neighbours are on one surface."""

SMOOTH_PLANE = 0.2
"""Distance of a neighbour from a pixel's plane up to which both are on one surface, relative to their distance."""

SMOOTH_ROUGHNESS_MIN = 0.3
"""Roughness below which what a surface reflects is not averaged: it may have edges."""

SMOOTH_ALBEDO_MIN = 0.02
"""Least albedo by which light is divided before it is averaged, so that textures stay sharp."""
