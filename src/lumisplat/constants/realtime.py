"""The thresholds of global illumination in real time."""

from __future__ import annotations

# --- Reprojection and filters (Schied et al. 2017, Spatiotemporal Variance-Guided Filtering) ---

ALBEDO_MIN = 1e-3
"""Least diffuse albedo that reflected light is divided by to find irradiance: below it, a surface shows none."""

STILL_PX = 0.01
"""Pixels within which a point counts as at a pixel's centre: what stands still is not resampled."""

SAME_SURFACE_PX = 8.0
"""Two points are on one surface if neither is farther from the other's plane than this many pixels are wide there;
GI-1.1's size of a tile."""

SAME_PIXEL_PX = 2.0
"""The same of a point and where it was a frame before: contact shadows are not taken from what stood on a surface."""

SAME_NORMAL_MESH = 0.9
"""Least cosine between the normals of one mesh surface in two frames: what turns faster loses its history."""

SAME_NORMAL_SPLATS = 0.5
"""The same of Gaussians, whose normals are noisy."""

CHANGE_SIGMAS = 3.0
"""Standard deviations by which samples around a pixel differ from their histories where light has changed: by chance
they do in one of some hundred pixels and frames."""

CHANGE_LEAST = 0.02
"""Share of the light below which no difference counts as a change."""

INDIRECT_SHARED = 4
"""Pixels that share a sample of indirect light, of which its noise is the same: 2 x 2 share a ray of a highlight."""

MOMENT_FRAMES = 8
"""Frames over which the moments of luminance are averaged at least, from which its variance follows."""

LUMINANCE_SIGMAS = 4.0
"""Neighbours count less the more standard deviations of noise lie between them and the pixel. SVGF's."""

YOUNG_FRAMES = 3.5
"""With fewer frames of history than this, the variance is that of the neighbourhood. SVGF's 4: means of equal histories
are whole numbers but for rounding."""

WEIGHT_LEAST = 1e-8
"""Least weight by position and normal with which a neighbour counts: those at an angle give a pixel without samples
nothing."""

WARM_UP_FRAMES = 32
"""Frames of a view that stands still, of which the last is shown: as many as direct light is averaged over."""

# --- Antialiasing over frames ---

ANTIALIASING_FRAMES = 32.0
"""Frames that a pixel is the mean of at most, each with a sample elsewhere in it."""

ANTIALIASING_MOVING = 3.0
"""The same where its history lies between pixels: each interpolation blurs it."""

ANTIALIASING_SIGMAS = 3.0
"""Standard deviations by which the samples of a pixel that stands still may differ from their mean."""

ANTIALIASING_LEAST = 0.05
"""Share of the light around a pixel by which its history may be outside what its neighbours show."""

FAR_AWAY = 1e6
"""Distance at which the background is for its motion, scene units."""

# --- Screen probes ---

PROBE_STAYS_PX = 2.0
"""A probe stays where it was if a pixel of its tile shows its surface within so many pixels."""

PROBE_NORMALS = 16
"""Side of the map of directions to whose nearest centre a probe's normal is moved where its cosines are looked up."""

# --- Rays that leave surfaces ---

RAY_LIFT = 1e-4
"""Share of the largest coordinate by which rays start above a mesh whose triangle is not known any more: rounding must
not put them below."""

SPECULAR_WAVES = 8
"""Smooth surfaces after one another that reflect such a ray or let it pass: two panes are four."""

MIRRORED_SOLID_ANGLE = 0.02
"""Least solid angle, steradians, as which a light counts that a mirror shows: a tenth of a probe's cell. Without it one
ray in thousands would be thousands of times too bright."""

LOBE_ALPHA_FROM = 0.16
"""Width of highlights (GGX, roughness 0.4) from which on their rays count less beside what screen probes see: their
cells are 0.4 wide. GI-1.1 follows rays to a roughness of 0.2, and probes take over without a blend."""

LOBE_ALPHA_TO = 0.25
"""Width (roughness 0.5) from which on highlights send no rays."""

# --- Light that bounces from frame to frame ---

YOUNG_SHARE = 0.5
"""Share of its rays so far for which a young mean counts when one more is added: what is found later has bounced more
often, and is nearer to the truth. The variance is a third higher than that of plain means."""

OUTDATED_SHARE = 1e-4
"""Share of its weight that a mean keeps when a light comes or goes: what is found next takes its place, and is until
then better than nothing. Many old cells of a tile together weigh less than one new sample."""

CHANGED_SHARE = 0.7
"""The same when lights move or change a little, in each of the frames that follow: means are over some three frames."""

CHANGED_FRAMES = 8
"""Frames for which means fade after a change."""

MOVED_SHARE = 0.8
"""Share of its weight that a mean keeps in a frame when things move that light falls on."""

MOVED_FRAMES = 16
"""Frames for which means fade after such a move."""

CHANGED_STRENGTH = 2.0
"""A light that is suddenly more than so many times as strong as before counts as another."""

# --- Radiance cache ---

LAYER_SHIFT = 0.382
"""Where, in cells, layers of cells begin: walls lie at whole numbers, halves or quarters, where rounding would put
their points into two layers."""

CELL_RAYS_MAX = 16
"""Rays that a cell of long rays sends in a frame at most, where few cells share those of a frame."""

BOUNCES_PER_RAY = 4
"""Times a frame that each cell takes in what its rays see: what they have met has taken in more light each time. A
look-up costs much less than a ray."""

MEANS_CHUNK = 64
"""Sums of tiles that one item adds up: a single one for all of a frame would keep a GPU waiting for a millisecond."""

# --- Captured emitters ---

EMITTER_BOXES = 16
"""Boxes around parts of a capture that is sampled as a light."""

EMITTER_REACH = 3.0
"""Standard deviations of Gaussians that are within the boxes."""

EMITTER_FLAT = 1e-3
"""Least edge of a box as a share of its longest: volumes of flat boxes are more than rounding errors."""

EMITTER_LEAST_SHARE = 0.05
"""Of the power, for a box around the whole capture; and of the mean luminance, for Gaussians that are dark."""

EMITTER_GAUSSIANS = 16_384
"""Gaussians of a capture by which boxes are found, at most."""

EMITTER_OPAQUE = 0.05
"""Transmittance at which rays to captures end; what lies behind counts as what they have met."""

EMITTER_RECEIVERS = 1024
"""Triangles or Gaussians of an instance that stand for all it has, when captures are told from surroundings."""

# --- Light grid ---

GRID_LIGHTS = 16
"""Lights among which a surface chooses one: where there are more, these are chosen for each cell of the world."""

GRID_CELLS_MAX = 2**18
"""Cells of a wave that have lights, at most; surfaces in further ones are not lit. A factor of two in distance has at
most 14,000 cells, choices counted: no view has so many, and a GPU need not wait for their number."""

GRID_CELL_SIZE = 1.0 / 4.0
"""Largest width of such a cell as a share of its distance from the eye; widths are powers of two."""

GRID_CHOICES = 4
"""Independent choices for each cell, of which each surface takes one: with the eight cells that it may take, more than
the 25 pixels whose noise is taken for independent where light changes."""
