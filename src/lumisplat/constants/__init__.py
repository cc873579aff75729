"""Every threshold of the project: value, unit, reason, source. No other file holds a magic number of the method."""

from __future__ import annotations

# --- Gaussian response and blending (Kerbl et al. 2023, 3D Gaussian Splatting) ---

ALPHA_MIN = 1.0 / 255.0
"""Alpha below which a Gaussian is ignored at a pixel: one step of an 8-bit image. INRIA, gsplat, 3DGRT agree."""

ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian, so that none alone hides everything behind it. INRIA's rule."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel or ray stops where its transmittance would fall to this; the crossing Gaussian is dropped. INRIA, gsplat."""

DEPTH_ISO_TRANSMITTANCE = 0.7
"""Transmittance that marks the iso-opacity surface. NVIDIA's default;
docs/method/rasterisation.md#iso-opacity-surface."""

NORMAL_DEGENERATE = 0.2
"""Length (of the alpha-weighted mean of unit normals) below which the sum is degenerate and the view direction is
used. docs/method/gaussians.md#normals; the figure is NVIDIA's."""

BEYOND_HORIZON = 0.5
"""Cosine with the direction away from the eye up to which a Gaussian's own normal is of a surface that bends away
there, 30 degrees beyond its horizon; one that faces away further is of a surface seen from behind.
docs/method/gaussians.md#normals."""

HORIZON_COSINE = 0.02
"""Cosine of what is bent to a horizon, one degree: at 0, rounding would decide whether a surface is seen at all."""

# --- Rays through Gaussians (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing) ---

KERNEL_DEGREE = 2
"""Exponent of the distance in the response of ordinary captures."""

KERNEL_DEGREE_MAX = 5
"""Quintic. All degrees respond exp(-4.5) at three standard deviations."""

KERNEL_LINEAR_SLOPE = 0.329630334487
"""Degree 0 is max(1 - slope * d, 0), which is exp(-4.5) at d = 3. NVIDIA's figure."""

HITS_PER_PASS = 16
"""Hits that a ray keeps sorted: 3DGRT's k, beyond which registers spill on GPUs."""

NODE_WIDTH = 8
"""Children of a node of a bounding volume hierarchy: their boxes fill a vector register."""

BOX_MARGIN = 1e-6
"""Boxes grow by this share of their longest side and distance from the origin: rounding must not lose a hit."""

TRAVERSE_MARGIN = 1e-6
"""Rays widen by this share of the distance, and of their origin's coordinates: rounding must not lose a box."""

FOOTPRINT_REACH = 3.7
"""Widest canonical reach of a Gaussian of any degree and opacity."""

FOOTPRINT_LEAD = 1.1
"""A Gaussian is widened by the footprint at its mean, but by at most this much of the footprint where its ellipsoid
begins: nodes widen as their Gaussians do."""

FOOTPRINT_MAX = 0.1
"""Largest half width of a ray's footprint over the length of its path, beyond that of any sensible image."""

PASS_REWIND = 1e-4
"""A new pass starts earlier by this share of the distance: rounding may put the hits of a box outside of it."""

HIT_COUNTS = (4, 8, 16, 32)
"""How many hits settings may ask for; kernels have storage for the most."""

HITS_KEPT_CPU, HITS_KEPT_CUDA = 64, 32
"""Hits that a ray keeps sorted, which saves passes: 1.6 and 1.4 times faster than 16. On CUDA they are local memory."""

COHERENT_SPREAD = 0.15
"""Rays of a packet are not traced with its first one if their directions differ from that one's by more than this."""

COHERENT_RADIUS = 0.03
"""Nor are they if their origins differ from that one's by more than this share of the scene's largest capture."""

TREE_SURFACE_LEVELS = 10
"""Levels of a hierarchy that are split by surface area; below, in the middle, which bounds the depth of any input."""

TRAVERSE_STACK = 256
"""Entries of the stack: the levels of both hierarchies, times a node's children but the one that is visited."""

TRAVERSE_STACK_SMALL = 96
"""Entries of the stack of CUDA's kernels for scenes whose hierarchies need no more, which is known once they are built:
49 in a million Gaussians spread evenly, 57 in the biker; 106 in a million that crowd together a thousandfold."""

REBUILD_COST = 1.5
"""A refitted hierarchy is rebuilt once its cost, relative to its root's surface, has grown by this factor."""

STRAY_SHARE = 0.01
"""Share of the Gaussians, at each end of an axis, that a capture's size leaves out: outliers must not stretch it."""

SAH_BINS = 16
"""Bins per axis, at whose edges a build tries to split a node (Wald 2007)."""

SAMPLES_MAX = 16_777_216
"""Largest number of samples of a pixel: up to here, means of layers still change in float32."""

SAMPLES_OPEN = 1_000_000
"""Most samples of a frame that ends by its time or its noise: no scene needs as many."""

NOISE_SAMPLES_MIN = 16
"""Samples of a pixel before its noise is estimated: of fewer, the estimate is itself noise."""

NOISE_CHECKS = 8
"""How often noise is estimated while samples double: a frame has at most an eighth more of them than it needs."""

NOISE_PIXELS = 0.95
"""Share of the pixels whose relative error is below the noise of a frame; the others are few."""

NOISE_LUMINANCE_MIN = 0.01
"""Linear luminance, after exposure, below which errors are no longer relative: 2 % of it are a third of a step of 8
bits in display space."""

SAMPLE_RATES = 16
"""Steps in which adaptive sampling chooses how often a pixel takes part."""

SAMPLE_RATE_MIN = 2
"""Fewest of these: an eighth of all samples reaches pixels that seemed quiet, where light that was missed may be."""

NOISE_RADIUS_PX = 3
"""Adaptive sampling knows a pixel by those up to so many rows and columns away."""

SAMPLES_OF_RANDOM_LIGHT = 16
"""Samples of a pixel where light comes from random directions, or alpha is drawn, unless they are given: what noise is
left is fine grain."""

SAMPLES_OF_SKY_ON_SPLATS = 8
"""The same where an environment shines on splat sets alone: captures are rough, and 8 samples of them are as near to
many (41 dB on the biker) as 16 of meshes (42 dB on a duck), but cost more, as each ray crosses Gaussians."""

SUBPIXEL_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Step from a sample of a pixel to the next, pixels, modulo 1: the R2 sequence, 1/g and 1/g^2 with g^3 = g + 1 (Roberts
2018, The Unreasonable Effectiveness of Quasirandom Sequences)."""

# --- Rays that hit meshes, mirrors and glass ---

TRIANGLE_BOX_MARGIN = 2.0**-19
"""Boxes of triangles grow by this share of the mesh's size: 32 roundings of a coordinate. Without it, 2 % of the rays
aimed at the edges of a cube from inside leave it."""

INSTANCE_BOX_MARGIN = 1e-3
"""Boxes of mesh instances grow by this share of their diagonal. Distant rays are started at the box, for accuracy; the
rounding error of that start, from a thousand diagonals away, is well below this."""

RAY_START_BACK = 4e-6
"""Rays start before a distant box by this share of the distance to it: 64 roundings."""

SPAWN_ERROR = 2.0**-20
"""Rounding error of a hit point as a share of the numbers that it and the next intersection are computed from: 16
roundings. Reflected and refracted rays start this far off the surface. With a quarter of it, some escape from closed
mirrors of thin triangles."""

SPAWN_SLENDER = 1000.0
"""Longest side over height of a triangle beyond which the offset grows no further: it must stay invisible."""

SMOOTH_HEIGHT_MIN = 1.0e-5
"""Height of a smooth surface over its triangle, as a share of its sides, below which it is rounding: there is none."""

SMOOTH_START_COSINE = 0.1
"""Cosine of the light on a triangle of a smooth mesh, from which on shadow rays start at the triangle itself. Where it
is less or negative, they start higher, up to the smooth surface (docs/adr/0019-smooth-terminators.md)."""

BOUNCE_WEIGHT_MIN = 1.0 / 512.0
"""Share of a pixel below which a reflected or refracted ray is not traced: half a step of an 8-bit image."""

GLOSSY_SHARE_FOLLOWED = 0.25
"""Share of a ray in a highlight from which on it sends a ray on in every sample; with less of it in fewer samples,
whose rays count for more: of a dielectric, that reflects 0.04, in one of six."""

METAL_MIN = 0.5
"""Factor ``metallic`` from which on a rough material counts as a metal, which is black without what is around it."""

# --- Light and shadow ---

CAPTURE_GAIN_MAX = 16.0
"""Stops by which the light of captures is brightened at most: 65,536 times."""

CAPTURE_GAIN_FOUND_MAX = 6.0
"""Stops that are found at most: beyond, the place is too dark to say what light it has."""

SURROUNDINGS_ALBEDO = 0.5
"""Albedo that surfaces around an object are taken to have on average, of which the brightness of the light on them
follows: rooms have 0.4 to 0.6 (CIBSE, Lighting Guide 5)."""

GAIN_DIRECTIONS = 1024
"""Rays that look around an object for the gain of captured light."""


KEPT_SHARE_MIN = 1.0e-6
"""Share of a ray of Gaussians that keep their captured colour, below which it is rounding beside relit ones."""

EXPOSURE_MAX = 100
"""Stops by which pictures may be brightened or darkened: two to this power is still a float32."""

SURFACE_DEPTH_SCALES = 3.0
"""How far from its mean a Gaussian's surface may lie on a ray, in its largest scales: where a Gaussian ends. Only
Gaussians smaller than a pixel, which its footprint shows where they are not, come that far."""

SHADOW_OFFSET = 4.0
"""Distance, in scales of a Gaussian, within which it neither shadows a surface nor, as the surface, is shadowed: the
smaller one of the two decides. Of three captures, lit from where they are seen, 2 leaves 1.6 to 4.6 % of the light in
their own shadow, 3 0.8 to 3.1 %, 4 0.6 to 2.2 %; by the surface's alone, 3 left 0.6 to 1.7 % (docs/adr/0018)."""

LAYER_FLATNESS = 0.15
"""Smallest over middle scale of a Gaussian up to which its thin axis tells the layer that it is of (docs/adr/0088)."""

LAYER_COSINE = 0.35
"""Cosine between the normals of two layers up to which only their order decides: 70 degrees apart and more."""

LAYER_HEIGHT = 0.0625
"""How far before a surface the mean of a Gaussian of another layer stands at least, and how far before its plane the
surface, in shadow offsets: a quarter of a scale."""

LAYER_RISE = 1.0
"""By how much that rises with the cosine beyond ``LAYER_COSINE``: to 2.85 scales between parallel layers."""

LAYER_LIFT = 0.0625
"""How far above a surface of Gaussians rays begin that bounce there, in shadow offsets: a quarter of a scale. From
within a layer, those along it come out below and see what lights its other side (docs/adr/0088)."""

SHRINK_RAYS_PER_GAUSSIAN = 2.0
"""Shadow rays of a stochastic sample, active or not, per Gaussian, from which on its hierarchies are shrunk. That costs
what one ray per Gaussian saves in a capture that is all surface, and pays off far earlier if rays cross much of it."""

SHRINK_INSTANCES_MAX = 8
"""Largest number of instances of an asset whose hierarchy is shrunk: it has to be valid for all of them."""

EDGE_WEIGHT_MAX = 1e-5
"""Barycentric weight above which a ray through glass is certainly not on a triangle's edge: above all rounding."""

CATCHER_AMBIENT = 0.5
"""Ambient light, as radiance over albedo, on a shadow catcher that does not say it, in scenes with lights and without
an environment: half of what makes white paper white."""

CATCHER_STEPS = 144
"""The noise of depths is measured between pixels so many of which are the longer side of a picture: as far apart as
Gaussians of short trainings are large. Between neighbours their depths are smooth."""

CATCHER_BLUR = 2.0
"""Standard deviation by which the ratio of a catcher is smoothed, over that of its height; a pixel's is taken off. With
2, the shadow on a wall of 12,000 Gaussians has one edge; floors with a surface stay as they are to the bit."""

CATCHER_BLUR_STEPS = 2
"""Its most, in those distances."""

CATCHER_DEPTHS = 16.0
"""Standard deviation of depths that are one layer for it, over that of the height."""

CATCHER_ALBEDO = 0.5
"""Albedo of meshes that catch shadows whose material has no base colour of its own: light bounces off them in paths."""

CATCHER_ALBEDO_MIN = 0.02
"""Least albedo of a mesh that catches shadows, in each channel: a black one would show no ratio."""

CATCHER_FILL_PX = 3
"""Pixels by which the ratio of meshes that catch shadows is carried on behind the edges of objects."""

AMBIENT_RAYS_OF_FRAMES = 2
"""Shadow rays a frame in real time from each pixel that shows a shadow catcher: frames are averaged."""

LIT_WEIGHT_MIN = 1.0 / 512.0
"""Transmittance of the Gaussians before a mesh below which the mesh is not lit: half a step of an 8-bit image. Opaque
captures transmit up to 1 %."""

SPLAT_ROUGHNESS_MIN = 0.03
"""Least roughness of splats: their normals are not smooth enough for mirrors."""

GGX_WIDTH_MIN = 1e-6
"""Alpha (roughness 0.001) below which a rough highlight gets no narrower: float32 directions are no finer."""

LIGHT_DISTANCE_MIN = 1e-6
"""Distance, scene units, below which a point light gets no brighter, so that it stays finite."""

LIGHT_COSINE_MIN = 0.1
"""Lights are chosen as if they were at least this cosine above the horizon: parts of them may be."""

LIGHT_POWER_MAX = 1e30
"""Candela, lux, radiance and irradiance at most: what float32 still multiplies with."""

ENVIRONMENT_SHARE_STEPS = 2**24
"""Shares of an environment's texels are multiples of one over this: all float32 can tell apart below 1."""

ENVIRONMENT_SHARE_MIN = 4
"""Least share of a texel or row that is not black, in those steps: each can be sampled."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Weights of linear Rec.709."""

# --- Pictures of lit frames (docs/method/lighting.md#pictures) ---

RADIANCE_BRIGHTEST = 2.0**64
"""Radiance is clamped to this: far above the white of every tone mapper, far below float32's largest number."""

WEIGHT_ROUNDING = 1e-5
"""Weights this close to 1 count as 1, because they are sums of float32 products."""

NEUTRAL_TOE = 0.04
"""Khronos PBR Neutral, github.com/KhronosGroup/ToneMapping: F90, and with it Ks and Kd of its specification."""
NEUTRAL_START = 0.8 - NEUTRAL_TOE
NEUTRAL_DESATURATION = 0.15

AGX_STOPS = (-12.47393, 4.026069)
"""Domain of AgX's curve, log2 of radiance: from 10 stops below middle grey to 6.5 above."""
AGX_PIVOT = (10.0 / 16.5, 0.5)
"""Sobotka's first configuration (AgX-S2O3): the curve maps its pivot, middle grey, to half of display white."""
AGX_SLOPE, AGX_TOE, AGX_SHOULDER = 2.0, 3.0, 3.25
"""Slope at the pivot, and the powers that bend the curve below and above it."""
AGX_GAMMA = 2.2

DENOISE_TOUCH_REACH = 2
"""A captured pixel counts as untouched by light if so are the captured ones up to so many pixels away: where every
second sample finds a light, one of 25 pixels does but for once in 30 million."""

# --- Paths of light that bounces (docs/method/paths.md) ---

EMITTER_MARGIN = 1e-5
"""Shadow rays to triangles that shine end before them by this share of the way."""

SPECULAR_BOUNCES = 3
"""Reflections and refractions that a ray follows, unless told."""

PATH_BOUNCES = 8
"""Bounces of a path, unless told."""

SAMPLES_OF_PATHS = 64
"""Paths a pixel, unless told."""

COAT_HEAD_ON, COAT_ROUGHNESS_MIN, SHEEN_ROUGHNESS_MIN = 0.04, 0.03, 0.1
"""Of clearcoat, which is never perfectly smooth, and of sheen, whose albedo is above 1 at ever more angles below."""

ROULETTE_BOUNCE = 3
"""From this bounce on, paths end at random."""

ROULETTE_RANGE = (0.05, 0.95)
"""Probability with which they go on: their largest throughput, clamped to this."""

# --- Deep Gaussian shadow maps (Mir et al. 2026; docs/method/deep_shadow_maps.md) ---

SHADOW_TILE = 8
"""Side of the tiles of an atlas for which casters are looked up, texels: the paper's."""

SHADOW_BLOCK_TILES = 8
"""Side of the blocks of tiles for which they are looked up first: 256 of them at 1024 texels."""

SHADOW_BOUND_STEP = 4
"""Texels between the points that bound a tile: atlas edges fold at multiples of it, as sizes are multiples of 8."""

SHADOW_BOUND_MARGIN = 1e-4
"""Share by which bounds of tiles and casters grow: rounding must not lose a caster."""

SHADOW_DEPTH_MIN = 1e-6
"""Optical depth of a whole Gaussian along a ray below which it is left out, when casters are culled: a thousand such
tails change the transmittance by 0.001."""

SHADOW_ERF_MAX = 4.0
"""Argument from which on the error function is one: erfc(4) is 1.5e-8, below float32's last digit."""

SHADOW_BLOCKING_REACH = 6.0
"""Standard deviations from a mean at which a Gaussian absorbs no more: erfc(6 / sqrt(2)) is 2e-9."""

SHADOW_TEXEL_ANGLE = 12.0
"""Radians, divided by the texels across a face, within which lookups find their texels: octahedral maps stretch up to 3
radians over a unit of two, and a lookup reads a texel's diagonal away."""

SHADOW_FOOTPRINT = 3.0
"""Standard deviations from a receiver's mean within which it samples the map: where splats end, too."""

SHADOW_STENCIL_WEIGHT = 0.6065306597126334
"""Weight of the stencil's outer points, one standard deviation off, against the middle's 1: exp(-1/2)."""

# --- Light found in captures (Mir et al. 2026, section 3.1, gives no figures; docs/adr/0014) ---

LIGHT_SEARCH_STRAYS = 0.02
"""Share of the Gaussians, the farthest from the character, that do not count for the scene's size: captures have strays
far outside."""

LIGHT_SEARCH_REACH = 1.5
"""Radius of the region, in sizes of the scene: lamps hang at its rim, also among the Gaussians that do not count."""

LIGHT_SEARCH_VIEWPOINTS = 0.1
"""Distance of the viewpoints from the character, in sizes of the scene: in a room of 3 m, a person's width."""

LIGHT_SEARCH_EMITTER = 1.0 / 12.0
"""Size of a compact emitter, in sizes of the scene: in a room of 3 m, a lamp of 25 cm."""

LIGHT_SEARCH_SEPARATION = 3.0
"""Distance of two lights, in sizes of an emitter: beyond the surroundings that a candidate is compared with."""

LIGHT_SEARCH_CLIP = 0.99
"""Quantile of luminance above which it counts by its logarithm: single Gaussians of captures are a hundred times too
bright."""

LIGHT_SEARCH_PRIOR = 4.0
"""Gaussians of median score that are added to each direction's surroundings: one outlier decides nothing."""

LIGHT_SEARCH_BROAD = 0.05
"""Factor on the score of a light that does not stand out from its surroundings at all."""

# --- Traces of light on captured surfaces (docs/method/relighting.md#traces-of-light) ---

SURFACE_CELLS = 64
"""Cells along each side of the cube that holds a capture: in a room of 5 m, 8 cm."""

SURFACE_REACH = 1.1
"""Half the side of that cube, in sizes of the scene."""

SURFACE_COVERAGE = 0.3
"""Area of the Gaussians in a cell, times their opacity, in faces of the cell, from which it is solid: haze is not."""

SURFACE_FLATNESS = 0.25
"""Largest ratio of the smallest variance of what is in a cell to the second one: foliage has no normal."""

SURFACE_THIN = 0.5
"""Largest ratio of the smallest scale of a Gaussian to the second one for it to have a normal of its own."""

SURFACE_DISC = 1.2
"""Radius of the circle on which a Gaussian's area is put, standard deviations: about its root mean square."""

SURFACE_PER_CELL = 3
"""Gaussians of a cell that are used, at most: fine objects must not outvote the room."""

SURFACE_CLIP = 0.98
"""Quantile of the luminance of surfaces that none exceeds: lamps are not what they light."""

SURFACE_OFFSET = 1.8
"""Distance from a surface at which ways to the light start, cells: beyond the diagonal of its own."""

SURFACE_STEP = 0.7
"""Steps along ways to the light, cells."""

SURFACE_BLOCK = 4
"""Side of a block, cells: what texture makes brighter is brighter over a block, and counts once."""

SURFACES_MAX = 3000
"""Gaussians on surfaces that are used, a random choice if there are more."""

TRACE_DIRECTIONS = 128
"""Directions from which smooth surroundings light surfaces."""

TRACE_SURFACES_MIN = 200
"""Gaussians on surfaces below which there is nothing to see a light on."""

TRACE_RIDGE = 1e-6
"""Ridge of the regression, in mean squares of its columns: in a closed room the sky lights nothing."""

TRACE_FLOOR = 0.25
"""Residuals are relative to the explained luminance, at least to this share of the median."""

TRACE_STEPS = 4
"""Steps of the robust weights."""

TRACE_NEAREST = 2.0
"""Surfaces nearer to a lamp than this, in sizes of an emitter, do not count: a bright patch is bright around itself. As
far are the places with which a lamp's own is compared."""

TRACE_CASING = 1.5
"""What is nearer to a lamp than this, in sizes of an emitter, does not shadow it: it hangs in its own shade."""

TRACE_GROUND_MIN = 0.3
"""Length of the mean blocked direction from which the ground is known, 1 over an endless plane."""

LAMP_SIGNIFICANCE = 4.0
"""Least ratio of a lamp's factor to its standard error: by chance, one of 64 candidates comes to it in one
capture of 500."""

LAMP_DOUBT = 2.0
"""Factor on the evidence that is asked of what is low, or broad."""

LAMP_ELSEWHERE = 0.6
"""Least share of what a lamp beside the candidate explains: the light of a lamp is brightest around itself."""

LAMP_CANDIDATES = 64
"""Bright places that are tested as lamps, the best by `estimate_lights`' score."""

SUN_DIRECTIONS = 320
"""Directions in which a sun is searched first: 11 degrees apart."""

SUN_REFINED = 24
"""Directions around the best in each of two finer steps."""

SUN_SHARE = 0.05
"""Least share of what smooth surroundings do not explain that a sun does."""

SUN_SIGNIFICANCE = 6.0
"""Least ratio of a sun's factor to its standard error."""

SUN_SHARE_BEYOND = 0.025
"""Least share that a sun explains of what a sky of degree 2 does not: one of degree 1 does not hold an overcast sky,
which is brightest at its top."""

SUN_SIGNIFICANCE_BEYOND = 4.0
"""Least ratio of a sun's factor to its standard error beside a sky of degree 2."""

SUN_LIFT = 6.0
"""Distance from the ground, cells, of the place from which the sky is tested: objects stand beside and below it."""

SUN_LIT = 0.05
"""Least share of surfaces that a sun reaches: through a gap of a closed room shines none."""

SUN_APART = 0.7
"""Cosine of the angle beyond which a direction is another one."""

SUN_CONFIDENCE_MIN = 0.2
"""Confidence below which no sun is given."""

SUN_WAYS = 256
"""Rays from an actor to a sun that are followed, at most."""

# --- Projection to the image (EWA splatting, Zwicker et al. 2001) ---

DILATION_PX2 = 0.3
"""Variance added to the projected covariance, pixel^2: a low-pass filter of about one pixel. INRIA, gsplat eps2d."""

JACOBIAN_CLAMP = 1.3
"""The Jacobian is taken no further out than this many times tan(fov / 2): beyond, the linearisation explodes."""

NEAR_PLANE = 0.01
"""Default view depth, scene units, in front of which nothing is drawn. gsplat's default."""

NEAR_SHARE = 1e-3
"""The same as a share of a scene's size, where that is less: a scene of millimetres, in metres, is not cut away."""

COVARIANCE_2D_DET_MIN = 1e-12
"""Projected covariance determinants below this, pixel^4, are degenerate and the Gaussian is culled."""

# --- Spherical harmonics (Condon-Shortley signs as in INRIA's code) ---

SH_DEGREE_MAX = 3
"""Highest SH degree that is read, stored and evaluated."""

SH_C0 = 0.28209479177387814
"""Y_00 = 1 / (2 sqrt(pi))."""

RECOLOR_DARK = 1e-4
"""Display-referred colour below which the gain of `scale_light` is taken: far inside the straight part of the sRGB
curve (0.04), where the gain is the factor, and far above float32's rounding of 0.5 (6e-8)."""

# --- Probes of environment light, and what is relit by them (docs/method/relighting.md#probes) ---

PROBE_DEGREE_MAX = 8
"""Highest SH degree of a probe: 81 coefficients, lobes of some 20 degrees. Beyond, an image serves better."""

PROBE_FACE_PX = 64
"""Pixels along a face of a probe's cube: about 1.4 degrees, where harmonics of degree 8 change over 20."""

PROBE_RIDGE = 1e-9
"""Ridge of the fit where weights sum to 4 pi: below float32's rounding, so that what harmonics can hold comes out
exactly, and enough for a solution where directions are too few."""

PROBE_IMAGE_ROWS = 64
"""Rows of a probe's latitude-longitude image: several pixels to the narrowest wave of degree 8."""

CAPTURED_LIGHT_ROWS = 32
"""Rows of the image of a capture around meshes without lights: 5.6 degrees, finer than most highlights."""

CAPTURED_LIGHT_COVERED = 0.75
"""Share of all directions that a capture must cover around meshes to light them; else a light at the camera does. Rooms
and places under a sky cover nearly all; ground without a sky covers half, from below, and would show meshes nearly
black."""

CAPTURED_LIGHT_DRAWS = 32
"""Directions in which each pixel of a mesh looks for the light of a capture, over all samples of a frame: without
shadow rays they cost little, and a frame needs one sample only. docs/adr/0093-meshes-put-into-captures.md."""

NORMAL_NEIGHBOURS = 24
"""Median number of neighbours through which the plane of a Gaussian's normal is fitted: over two rings on a surface."""

NORMAL_NEIGHBOURS_PER_CELL = 16
"""Neighbours that count in a cube of the search radius, twice as many as a surface has there: dense clusters would
otherwise pair all with all."""

NORMAL_NEIGHBOURS_MIN = 4
"""Least number of neighbours that determine a plane."""

OUTSIDE_CELLS = 1_500_000
"""Largest number of voxels that find a set's outside: about a centimetre for a person; half a second."""

OUTSIDE_OPACITY_MIN = 0.1
"""Gaussians fainter than this are no wall: haze around an object must not enclose it."""

OUTSIDE_REACH = 1.5
"""Scales of a Gaussian up to which its disc is solid: neighbours on a surface meet there."""

OUTSIDE_STEPS_MAX = 12
"""Largest number of cells from a disc's centre to its rim: a few huge Gaussians may leak, but not take all the time."""

OUTSIDE_CONNECTED = 0.25
"""Weight of a cell's connection to the outside, around corners; the rest is that of its open directions."""

OUTSIDE_CONTRAST = 0.1
"""One side is outside if its share exceeds the other's by this: two or three of 26 directions."""

# --- Gaussians from meshes (scene/sampling/); lengths in spacings, the square root of the area a Gaussian has ---

SAMPLING_SPACINGS_PER_DIAGONAL = 300
"""Without a count, neighbours are about this fraction of the bounding box's diagonal apart: detail against number, some
70,000 to 100,000 Gaussians for a compact object."""

SAMPLING_DEFAULT_COUNTS = (1_000, 1_000_000)
"""Bounds of the default count."""

SAMPLING_COUNT_MAX = 50_000_000
"""Candidates and pairs take about 1 KB a Gaussian: this is 50 GB and a quarter of an hour."""

SAMPLING_CANDIDATES_PER_GAUSSIAN = 4.0
"""Points to choose from: Poisson-disk elimination needs several times as many as it keeps."""

SAMPLING_SEARCH_SPACINGS = 0.86
"""First radius of the elimination, which shrinks until the count is kept; the densest packing of discs reaches 1.07."""

SAMPLING_RADIUS_STEP = 0.97
"""Factor by which the radius shrinks while too few points are kept."""

SAMPLING_RADIUS_STEPS_MAX = 100
"""Steps at most, to a twentieth of the radius: closer points coincide, and make up for those missing."""

SAMPLING_OPACITY = 0.995
"""Above ALPHA_MAX, so that a disc's centre is as opaque as a Gaussian can be."""

SAMPLING_THICKNESS = 0.05
"""Scale along the normal, as a share of the smaller wide one: flat enough to tell layers (docs/adr/0088)."""

SAMPLING_FIRST_SCALE = 0.7
"""Wide scales before they grow; without holes to close they stay."""

SAMPLING_GROWTH = 1.08
"""Factor by which a disc grows in a step."""

SAMPLING_GROWTH_STEPS = 8
"""Steps at most: 1.08^8 = 1.85 times the first scale."""

SAMPLING_GROWTH_REACH = 0.5
"""A disc grows too where its exponent is within this of the nearest disc's: one alone would grow out of proportion."""

SAMPLING_COVERED_ALPHA = 0.95
"""A candidate point counts as covered from this alpha on."""

SAMPLING_FACING_COSINE = -0.5
"""Neighbours whose normals make a smaller cosine lie on the two sides of a thin wall."""

SAMPLING_AXIS_COSINE = 0.97
"""Where shading and geometric normal make a smaller cosine (14 degrees), discs lie in the face."""

SAMPLING_EDGE_BAND = 0.2
"""Nearer to a crease than this, a surface need not be covered: discs would have to reach over it."""

SAMPLING_EDGE_ROW = 0.45
"""Scale that a disc next to a crease may always have."""

SAMPLING_CREASE_POINTS_PER_GAUSSIAN = 50
"""Creases of compact objects need fewer than ten points a Gaussian; slivers, all edge and no area, would ask for any
number."""

CREASE_COSINE = 0.77
"""Faces whose normals make a smaller cosine than this meet at a crease (about 40 degrees)."""

# --- Meshes ---

TRIANGLE_HEIGHT_MIN = 1e-12
"""Height of a triangle over its longest edge, at or below which it has no area: corners on a line come out at 1e-16 in
float64, thin triangles from float32 at 1e-7."""

CREASE_ANGLE = 0.9
"""Largest angle between faces of a mesh without normals that is shaded smoothly, radians (51.6 degrees): 99 % of the
edges of spot, the bunny and the teapot bend less than 41 degrees, those of hexagonal prisms 60, of boxes 90."""

WELD_SHARE = 1e-6
"""Distance, relative to the diagonal of a mesh, below which its vertices are one where it is smoothed: text files round
to six digits."""

# --- Placement ---

TRANSFORM_MAX = 1e18
"""Largest entry of a transform and of its inverse: squares of it still fit into float32."""

SIMILARITY_TOLERANCE = 1e-4
"""How far a capture's axes may be from equal length (squared) and from right angles (cosine): rounding of poses that
were stored with five digits."""

FRAMING_FARTHEST = 1e17
"""How far a scene may reach from the origin, in its units: a camera may stand at up to 1e18."""

BULK_TAIL = 0.02
"""Share of a capture's opacity left out at each end of each axis: stray Gaussians must neither set the frame nor hold
an object above the ground."""
BOX_TAIL = 0.002
"""The same of the box of a capture in a data set, which is to hold what is seen of it, and not its strays."""

# --- Local origins (docs/adr/0086-one-local-origin.md) ---

ORIGIN_GRID = 16.0
"""Step of the grid of origins of what is rendered, in sizes of the scene, rounded up to a power of two: positions have
five digits below the size of the scene, and what stands around zero, or moves a little, keeps its origin."""

ORIGIN_LOSS = 0.01
"""Rounding of float32 positions, as a share of the median width of what they are of, above which files and captures are
about an origin of their own."""

ORIGIN_MESH_WIDTH = 0.01
"""Width of what is to be told apart on a mesh, as a share of its size: steps are a ten-thousandth of it at most."""

SIZE_SAMPLE = 4096
"""Points of an asset, at most, that tell its size where that need not be exact."""

SIZE_TAIL = 0.02
"""Share of them at each end of each axis that counts as strays."""

# --- Limits of 32-bit indices ---

IMAGE_PIXELS_MAX = 200_000_000
"""Pixels of a frame: its buffers take ten words a pixel and are indexed by signed 32-bit numbers."""

ITEMS_MAX = 2**31 - 1
"""Gaussians or triangles of a scene, and (tile, item) pairs of a frame."""

# --- Work decomposition ---

TILE_PX = 16
"""Side of a raster tile, pixels. One CUDA block of 256 threads, and a cache-sized accumulator on the CPU."""

STRIP_PX = 8
"""Width, in pixels, of a part of a tile's row that CPUs composite in one vector (AVX: 8 floats); divides `TILE_PX`."""

DEPTH_KEY_CULLED = 0xFFFFFFFF
"""Depth key of a Gaussian that cannot touch the image; the bits of every positive float are smaller."""

DEPTH_KEY_NONFINITE = 0xFFFFFFFE
"""Depth key of a Gaussian that is dropped because a projected value is NaN or infinite."""

RAY_BLOCK_PX = 4
"""Side of the blocks of pixels whose rays are consecutive, so that neighbours hit the same boxes."""

PACKET_RAYS = RAY_BLOCK_PX * RAY_BLOCK_PX
"""Rays that the CPU traces together; numbers of rays are multiples of it everywhere."""

RAY_BANDS_PER_THREAD = 32
"""Bands a CPU thread gets when rays are traced: packets differ more in cost than tiles do."""

TILE_BANDS_PER_THREAD = 12
"""Bands a CPU thread gets when tiles are composited: tiles differ tenfold in cost, bands even that out."""

SHADE_BANDS_PER_THREAD = 4
"""Bands a CPU thread gets when surfaces are shaded: where rays hit nothing there is little to do."""

COUNT_SUM_THREADS = 4096
"""Items that add up counts in 64 bits, in the parallel schedule: (tile, item) pairs, samples that are not finite."""

# --- Editing captures ---

FLOATER_NEIGHBOURS = 4
"""Others that a Gaussian must have around it."""

FLOATER_REACH = 3.0
"""How far around it, in its largest scale or the capture's median one: where a Gaussian ends."""

DECIMATE_NEIGHBOURS = 4
"""Next ones along a Morton curve, in each direction, with which a Gaussian may be merged. More make passes slower, and
merge more where it is cheap, less evenly: 8 are 0.3 dB worse on the biker."""

DECIMATE_COLOR_WEIGHT = 30.0
"""Loss by a difference of colours of 1, relative to that by an e-fold larger spread. Within 0.3 dB from 10 to 100."""

DECIMATE_OPACITY_MIN = 1e-9
"""Opacity below which a Gaussian's mass falls no further: weights must not be 0."""

# --- Files ---

SCALE_MIN = 1e-12
"""Smallest standard deviation read from a file, scene units: captures hold logarithms whose exponential underflows to
zero. Its square and the reciprocal of it are still normal float32 numbers."""

FLAT_THICKNESS = 1e-3
"""Third scale of a 2D Gaussian read from a file, as a share of the smaller of its two. Pictures of 20,000 discs are
within 2/255 of those of discs a hundred times thinner, rasterised and traced, also 100 units from the origin; ten times
thicker ones show at silhouettes."""

LOGIT_MAX = 20.0
"""Opacities are written as logits of at most this size: the float32 sigmoid of 20 is 1, that of -20 is 2e-9."""

DECODED_BYTES_FREE = 256 * 2**20
"""Decoded size, bytes, that any file may ask for. Above it, EXPANSION_MAX applies."""

EXPANSION_MAX = 200
"""Decoded bytes per stored byte, above which a file is taken for a decompression bomb. Real captures stay under 30."""

FILE_BYTES_MAX = 4 * 2**30
"""Size, bytes, of the largest file that is read as a whole. Captures in PLY are read in blocks, and may be larger."""

TEXTURE_BYTES_FREE = 2**30
"""Decoded size, bytes, that the textures of one file may have together: twenty of 4096 x 4096. Above it, EXPANSION_MAX
applies to their sum."""

TOML_KEY_PARTS_MAX = 32
"""Parts of a dotted key of a TOML file; scene files have up to three. Python's parser takes their number squared."""

# --- Lens distortion ---

DISTORTION_MAX = 1e9
"""Largest coefficient of a lens: far beyond those of any, and its polynomial still fits into float64."""

DISTORTION_MIN = 1e-30
"""Coefficients below this count as 0: they move no point, and reciprocals of them overflow."""

DISTORTION_STEPS = 12
"""Newton steps of its inverse: quadratic, so that 5 suffice for lenses; more help near the fold of the polynomial."""

DISTORTION_RESIDUAL = 1e-9
"""Largest error of the inverse in float64, in tangents or radians; above it, a pixel shows nothing."""

DISTORTION_RESIDUAL_FLOAT = 2e-6
"""The same in float32, relative to one plus the radius: 16 roundings, a hundredth of a pixel of the largest images."""

UNDISTORTED_AREA_MAX = 8.0
"""Pixels of the pinhole image from which a distorted one is resampled, relative to those of the latter. Above it most
of the work is thrown away, and rays are faster."""

UNDISTORTED_SCALE_MAX = 2.0
"""Largest factor of the focal length of that pinhole image, where a lens magnifies its edges."""

# --- Rigs ---

RIG_BLACK_COLOR = 0.5 / 255.0
"""Vertex colour below which a vertex is black: 8 bits round it to 0."""

RIG_BLACK_SHARE = 0.5
"""Share of black vertices above which a file is taken to hold something else than colours in COLOR_0."""

RIG_HIDDEN_AREA = 1e-4
"""Area of a posed triangle, relative to that at rest, below which its Gaussians vanish: scaled to a hundredth, or so
flat that its normal is lost in float32."""

RIG_SHEAR_MIN = 1e-5
"""Cosine between a Gaussian's two deformed wide axes up to which they stay its axes: above float32's rounding, by
which round discs would else turn."""

# --- Sequences of frames, animations ---

ANIMATION_FRAMES_MAX = 1_000_000
"""Frames of an animation: more than eleven hours at 24 a second. More are a typing error, and run out of memory."""

ANIMATION_SAMPLES_MAX = 400_000
"""Samples of a camera or capture of a glTF animation, which are made when it is read: more than an hour. So many take a
minute on one core, and 500 MB."""

SEQUENCE_TIME_SLACK = 1e-6
"""Frames by which a time may precede the frame that it denotes: k / fps * fps is below k for some k."""

# --- Compilation ---

FUSED_FLAGS = (
    "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000"
    " -mllvm=-inline-cold-callsite-threshold=3000 -mllvm=-slp-recursion-max-depth=4"
)
"""Flags for CPU kernels that gain from fused multiply-adds; but for that, Warp's defaults. One string for all modules:
Warp precompiles its header once per string, which takes seconds."""
