"""Constants of the separation of a capture into materials and light (docs/method/delighting.md)."""

SIDE_DIRECTIONS = 26
"""Directions over the sphere in which Gaussians look for the side from which they are seen."""

SIDE_ENCLOSED = 0.1
"""Share of Gaussians that see no sky on either side, from which on a capture was taken from inside of it."""

SKY_SEEN = 0.1
"""Share of the sky that a side sees at least, if it sees any: walls that were learnt from photographs let 2 to 6 %
through. Of captured rooms, 36 to 63 % of the Gaussians see less on both sides, of captured objects at most 0.2 %."""

SKY_ENOUGH = 0.2
"""Share of the sky from which on more of it does not make a side likelier to be the one that was seen."""

SIDE_FAR = 0.02
"""Mean distance of what a side sees, in extents of the set, from which on it is open."""

CONTENT_SURE = 0.003
"""Difference between what two sides see of the set, as a mean distance in its extents, that makes half sure."""

SIDE_STIFFNESS = 5.0
"""How much neighbours that lie alike agree on their sides, beside how much Gaussians that are sure insist."""

SIDE_SHARPNESS = 4
"""Exponent of the cosine between the axes of neighbours that agree on their sides."""

SIDE_STEPS = 300
"""Most steps of conjugate gradients by which they do."""

SIDE_ERROR = 1e-6
"""Root mean square of the residual at which these end: signs are read off, which lie farther from 0."""

ALPHA_LEAST = 1e-6
"""Share of a ray that is met, below which its colour is not told."""

SURFACE_SPREAD = 0.5
"""Within how much of a Gaussian rays begin, standard deviations of its own: as they do where it is baked."""

CELL_REACH = 1.3
"""How far apart the centres of neighbouring cells of the sky may be, in sums of the radii of discs as large."""

BRIGHT_CELLS = 6
"""Cells of the sky that are divided further: those that shine most."""

BRIGHT_PARTS = 4
"""Into so many times so many parts."""

BRIGHT_ROUNDS = 2
"""Times that this is done."""

VIEW_DIRECTIONS = 16
"""Directions in which the colour of a Gaussian is looked at."""

VIEW_TILT = 0.5
"""By how much these are bent towards normals: at grazing angles, colours say little."""

CLIPPED = 0.985
"""Display-referred value of all channels from which on a Gaussian may have been brighter than could be captured."""

LAMPS_MAX = 8
"""Groups of such Gaussians whose light is found apart."""

LAMP_GAP = 4.0
"""Distance between Gaussians of one group, in median scales of such Gaussians."""

LAMP_POINTS = 24
"""Places of a group whose light is traced."""

NEIGHBOURS = 12
"""Gaussians, about, over which the light at a Gaussian is averaged: it changes less than its noise."""

NORMAL_SHARPNESS = 8
"""Exponent of the cosine between normals of those."""

PAIRS = 24_000
"""Pairs of neighbours whose albedos are compared, at most."""

FAR_SHARE = 0.25
"""Pairs of any Gaussians that are compared, beside one of neighbours: things of like chroma are often of one albedo,
and neighbours more often."""

CHROMA_WIDTH = 0.03
"""Difference of chromaticity, natural logarithm, of Gaussians that may have one albedo."""

EDGE_WIDTHS = (0.2, 0.1)
"""Differences of albedo, natural logarithm, from which on they are rather edges (Cauchy): first and last."""

RADIANCE_LEAST = 1e-4
"""Radiance below which nothing is told apart."""

FAR_LEAST = 1000
"""Such pairs, at least."""

LIGHT_STEPS = 25
"""Steps of Gauss-Newton, at most."""

LIGHT_STEP_MAX = 0.7
"""Longest of them, natural logarithm of radiances."""

LIGHT_CONVERGED = 1e-3
"""Largest change of a radiance, natural logarithm, at which they end."""

SKY_SMOOTHNESS = 3e-3
"""Weight of differences between neighbouring directions of the sky, beside one pair of Gaussians."""

LIGHT_PRIOR = 3e-4
"""Weight of a radiance's distance from that which it begins with, likewise."""

ALBEDO_HIGH = 0.8
"""Albedo of the lightest surfaces in their lightest channel, that fixes the scale where light comes from the sky."""

LIT_LEAST = 0.05
"""Light of the sky and lamps at a Gaussian, in medians, from which on it tells how bright these may be."""

LIT_MOST = 3.0
"""Light of lamps at a Gaussian, in medians, from which on it tells that no better, for its error grows with it: a shade
beside a lamp counts as nine walls at most. Of trained rooms, 2 to 4 % of the Gaussians have more."""

SKY_LEAST = 0.05
"""Radiance of the sky and lamps that the fit begins with, at least."""

LIGHTEST = 0.95
"""Share of Gaussians that are darker than those."""

SCALE_STEPS = 5
"""Steps by which the scale is found: what Gaussians show each other stays as it was captured."""

LIGHT_SEEN = 0.03
"""Light at a Gaussian, as a share of the median, below which its albedo is that of its neighbours."""

ROUGHNESS_UNKNOWN = 0.8
"""Roughness of Gaussians whose highlights say nothing."""

ROUGHNESS_GRID = (0.15, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0)
"""Roughnesses that are tried: below the first one, harmonics of degree 3 show the same."""

ROUGHNESS_ROWS = 2048
"""Gaussians that are tried at once: some 100 MB."""

LOBE_VIEWS = 96
"""Views of the upper hemisphere in which colours are compared. With 24, what harmonics cannot keep of a sharp highlight
turns up in what they do, and roughness 0.3 is found as 0.4; with 48, as 0.33."""

VIEW_COSINE_LEAST = 0.2
"""Cosine between normal and view, from which on they are: nobody sees Gaussians edge-on."""

BIN_RINGS = 8
"""Rings of equal solid angle into which the light above a Gaussian is sorted."""

BIN_SECTORS = 20
"""Equal sectors of each: bins are 11 degrees wide."""

BIN_SAMPLES = 4
"""Times as many directions of each bin are integrated over."""

ALBEDO_STEPS = 4
"""Steps of Gauss-Newton to the albedo that goes with a roughness."""

HIGHLIGHT_NOISE = 0.008
"""Error of captured colours, display-referred, that is expected at least: 2 of 255."""

LIKE_ALBEDO = 0.1
"""Difference of albedo, natural logarithm, of neighbours that may be of one material."""

LIKE_NORMALS = 4
"""Exponent of the cosine between their normals."""

MATT_LEAST = 0.2
"""Share of what Gaussians show that is left, at least, when what they mirror is taken away."""

SURE = 0.8
"""Sureness of a roughness from which on highlights are said to tell it."""

GAUSSIANS_LEAST = 64
"""Gaussians of which a surface consists, at least."""

OPACITY_SEEN = 0.1
"""Opacity of those, at least."""

FOG_RAYS = 512
"""Rays from outside by which fog is told from surfaces."""

FOG_HALF = 0.5
"""Share of its light that a ray has to lose to have met anything."""

FOG_EXTENT, FOG_SCALES = 0.02, 2.0
"""How far around the depth that it shows a ray that meets a surface loses its light: a share of the extent of the set,
or so many times the largest scale of the Gaussian there if that is farther, as coarse surfaces are thick."""

FOG_SHARP = 0.6
"""Share of what they lose that half of the rays lose within that, at least, if there is a surface: 0.9 to 1 of captures
of others and of baked ones, 0.39 to 0.99 of those that were learnt in some minutes, 0 to 0.56 of balls of fog
(docs/adr/0079-fog-has-no-surface.md)."""

FOG_ROUND, FOG_SHARE = 0.9, 0.8
"""Least scale over the middle one from which on a Gaussian has no normal, and share of such ones, by area, in fog: 0.02
to 0.65 of captures, those that were hardly learnt included."""

SURFACE_SHARP = 0.8
"""Share that half of the rays lose at once below which a capture has no clear surface: 0.90 to 1 of captures of others,
of Gaussians of meshes and of a fox that was trained with flatness, 0.66 to 0.70 of foxes without."""

AGREEING_LEAST = 0.35
"""Mean squared cosine between normals of neighbours below which they are random: in fog it is 0.333 to 0.340, of
captures of others 0.41 to 0.76, of foxes of some minutes 0.5 to 0.9."""

AGREEING_PICKS, AGREEING_SET, AGREEING_NEIGHBOURS = 256, 50_000, 16
"""Gaussians whose normals are compared, of how many at most, and with how many each."""

AGREEING_COUNT = 300
"""Gaussians from which on they are: on fewer, neighbours are far apart, and surfaces turn."""

TOO_LIGHT = 0.02
"""Share of Gaussians beyond what is possible, or not explained, from which on it is worth a remark."""

RESIDUAL_LARGE = 0.25
"""Unexplained share of a captured colour that counts for that."""

SKY_IMAGE_ROWS = 64
"""Of the image of the sky that was found."""
