"""Thresholds that several modules share: value, unit, reason, source. Those of one module stand in it."""

from __future__ import annotations

# --- Gaussian response and blending (Kerbl et al. 2023, 3D Gaussian Splatting) ---

ALPHA_MIN = 1.0 / 255.0
"""Alpha below which a Gaussian is ignored at a pixel: one step of an 8-bit image. INRIA, gsplat, 3DGRT agree."""

ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian, so that none alone hides everything behind it. INRIA's rule."""

NORMAL_DEGENERATE = 0.2
"""Length (of the alpha-weighted mean of unit normals) below which the sum is degenerate and the view direction is
used. docs/method/gaussians.md#normals; the figure is NVIDIA's."""

# --- Rays through Gaussians (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing) ---

KERNEL_DEGREE = 2
"""Exponent of the distance in the response of ordinary captures."""

KERNEL_DEGREE_MAX = 5
"""Quintic. All degrees respond exp(-4.5) at three standard deviations."""

NODE_WIDTH = 8
"""Children of a node of a bounding volume hierarchy: their boxes fill a vector register."""

BOX_MARGIN = 1e-6
"""Boxes grow by this share of their longest side and distance from the origin: rounding must not lose a hit."""

HIT_COUNTS = (4, 8, 16, 32)
"""How many hits settings may ask for; kernels have storage for the most."""

HITS_KEPT_CPU, HITS_KEPT_CUDA = 64, 32
"""Hits that a ray keeps sorted, which saves passes: 1.6 and 1.4 times faster than 16. On CUDA they are local memory."""

TRAVERSE_STACK = 256
"""Entries of the stack: the levels of both hierarchies, times a node's children but the one that is visited."""

TRAVERSE_STACK_SMALL = 96
"""Entries of the stack of CUDA's kernels for scenes whose hierarchies need no more, which is known once they are built:
49 in a million Gaussians spread evenly, 57 in the biker; 106 in a million that crowd together a thousandfold."""

REBUILD_COST = 1.5
"""A refitted hierarchy is rebuilt once its cost, relative to its root's surface, has grown by this factor."""

STRAY_SHARE = 0.01
"""Share of the Gaussians, at each end of an axis, that a capture's size leaves out: outliers must not stretch it."""

SAMPLES_MAX = 16_777_216
"""Largest number of samples of a pixel: up to here, means of layers still change in float32."""

NOISE_SAMPLES_MIN = 16
"""Samples of a pixel before its noise is estimated: of fewer, the estimate is itself noise."""

NOISE_PIXELS = 0.95
"""Share of the pixels whose relative error is below the noise of a frame; the others are few."""

SAMPLE_RATES = 16
"""Steps in which adaptive sampling chooses how often a pixel takes part."""

SUBPIXEL_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Step from a sample of a pixel to the next, pixels, modulo 1: the R2 sequence, 1/g and 1/g^2 with g^3 = g + 1 (Roberts
2018, The Unreasonable Effectiveness of Quasirandom Sequences)."""

# --- Rays that hit meshes, mirrors and glass ---

RAY_START_BACK = 4e-6
"""Rays start before a distant box by this share of the distance to it: 64 roundings."""

SPAWN_ERROR = 2.0**-20
"""Rounding error of a hit point as a share of the numbers that it and the next intersection are computed from: 16
roundings. Reflected and refracted rays start this far off the surface. With a quarter of it, some escape from closed
mirrors of thin triangles."""

SPAWN_SLENDER = 1000.0
"""Longest side over height of a triangle beyond which the offset grows no further: it must stay invisible."""

# --- Light and shadow ---

EXPOSURE_MAX = 100
"""Stops by which pictures may be brightened or darkened: two to this power is still a float32."""

SHADOW_OFFSET = 4.0
"""Distance, in scales of a Gaussian, within which it neither shadows a surface nor, as the surface, is shadowed: the
smaller one of the two decides. Of three captures, lit from where they are seen, 2 leaves 1.6 to 4.6 % of the light in
their own shadow, 3 0.8 to 3.1 %, 4 0.6 to 2.2 %; by the surface's alone, 3 left 0.6 to 1.7 % (docs/adr/0018)."""

CATCHER_AMBIENT = 0.5
"""Ambient light, as radiance over albedo, on a shadow catcher that does not say it, in scenes with lights and without
an environment: half of what makes white paper white."""

SPLAT_ROUGHNESS_MIN = 0.03
"""Least roughness of splats: their normals are not smooth enough for mirrors."""

LIGHT_DISTANCE_MIN = 1e-6
"""Distance, scene units, below which a point light gets no brighter, so that it stays finite."""

LIGHT_POWER_MAX = 1e30
"""Candela, lux, radiance and irradiance at most: what float32 still multiplies with."""

ENVIRONMENT_SHARE_STEPS = 2**24
"""Shares of an environment's texels are multiples of one over this: all float32 can tell apart below 1."""

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

# --- Paths of light that bounces (docs/method/paths.md) ---

COAT_HEAD_ON, COAT_ROUGHNESS_MIN, SHEEN_ROUGHNESS_MIN = 0.04, 0.03, 0.1
"""Of clearcoat, which is never perfectly smooth, and of sheen, whose albedo is above 1 at ever more angles below."""

# --- Deep Gaussian shadow maps (Mir et al. 2026; docs/method/deep_shadow_maps.md) ---

SHADOW_TILE = 8
"""Side of the tiles of an atlas for which casters are looked up, texels: the paper's."""

SHADOW_BOUND_MARGIN = 1e-4
"""Share by which bounds of tiles and casters grow: rounding must not lose a caster."""

SHADOW_FOOTPRINT = 3.0
"""Standard deviations from a receiver's mean within which it samples the map: where splats end, too."""

# --- Traces of light on captured surfaces (docs/method/relighting.md#traces-of-light) ---

SURFACE_REACH = 1.1
"""Half the side of the cube that holds a capture's surfaces, in sizes of the scene."""

TRACE_DIRECTIONS = 128
"""Directions from which smooth surroundings light surfaces."""

TRACE_SURFACES_MIN = 200
"""Gaussians on surfaces below which there is nothing to see a light on."""

TRACE_GROUND_MIN = 0.3
"""Length of the mean blocked direction from which the ground is known, 1 over an endless plane."""

# --- Projection to the image (EWA splatting, Zwicker et al. 2001) ---

JACOBIAN_CLAMP = 1.3
"""The Jacobian is taken no further out than this many times tan(fov / 2): beyond, the linearisation explodes."""

NEAR_PLANE = 0.01
"""Default view depth, scene units, in front of which nothing is drawn. gsplat's default."""

# --- Spherical harmonics (Condon-Shortley signs as in INRIA's code) ---

SH_DEGREE_MAX = 3
"""Highest SH degree that is read, stored and evaluated."""

SH_C0 = 0.28209479177387814
"""Y_00 = 1 / (2 sqrt(pi))."""

# --- Probes of environment light, and what is relit by them (docs/method/relighting.md#probes) ---

PROBE_FACE_PX = 64
"""Pixels along a face of a probe's cube: about 1.4 degrees, where harmonics of degree 8 change over 20."""

# --- Meshes ---

CREASE_ANGLE = 0.9
"""Largest angle between faces of a mesh without normals that is shaded smoothly, radians (51.6 degrees): 99 % of the
edges of spot, the bunny and the teapot bend less than 41 degrees, those of hexagonal prisms 60, of boxes 90."""

# --- Placement ---

TRANSFORM_MAX = 1e18
"""Largest entry of a transform and of its inverse: squares of it still fit into float32."""

SIMILARITY_TOLERANCE = 1e-4
"""How far a capture's axes may be from equal length (squared) and from right angles (cosine): rounding of poses that
were stored with five digits."""

# --- Local origins (docs/adr/0086-one-local-origin.md) ---

ORIGIN_LOSS = 0.01
"""Rounding of float32 positions, as a share of the median width of what they are of, above which files and captures are
about an origin of their own."""

ORIGIN_MESH_WIDTH = 0.01
"""Width of what is to be told apart on a mesh, as a share of its size: steps are a ten-thousandth of it at most."""

# --- Limits of 32-bit indices ---

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

# --- Files ---

SCALE_MIN = 1e-12
"""Smallest standard deviation read from a file, scene units: captures hold logarithms whose exponential underflows to
zero. Its square and the reciprocal of it are still normal float32 numbers."""

FLAT_THICKNESS = 1e-3
"""Third scale of a 2D Gaussian read from a file, as a share of the smaller of its two. Pictures of 20,000 discs are
within 2/255 of those of discs a hundred times thinner, rasterised and traced, also 100 units from the origin; ten times
thicker ones show at silhouettes."""

FILE_BYTES_MAX = 4 * 2**30
"""Size, bytes, of the largest file that is read as a whole. Captures in PLY are read in blocks, and may be larger."""

# --- Lens distortion ---

DISTORTION_STEPS = 12
"""Newton steps of its inverse: quadratic, so that 5 suffice for lenses; more help near the fold of the polynomial."""

# --- Sequences of frames, animations ---

ANIMATION_FRAMES_MAX = 1_000_000
"""Frames of an animation: more than eleven hours at 24 a second. More are a typing error, and run out of memory."""

# --- Compilation ---

FUSED_FLAGS = (
    "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000"
    " -mllvm=-inline-cold-callsite-threshold=3000 -mllvm=-slp-recursion-max-depth=4"
)
"""Flags for CPU kernels that gain from fused multiply-adds; but for that, Warp's defaults. One string for all modules:
Warp precompiles its header once per string, which takes seconds."""

# --- Lit captures ---

RIDGE = 3e-4
"""Penalty of (l (l + 1))^2 times the square of a coefficient of degree l, where an even view counts 1: what nobody sees
stays smooth. Of degree 3, it takes 4 % of what is seen from everywhere."""

# --- Captures in tiles (docs/adr/0073-captures-in-blocks.md) ---

BLOCK_GAUSSIANS_MAX = 2**19
"""Gaussians of a block: 29 MB at degree 0, which a disk reads in a moment; a billion are 2,000 blocks."""

BLOCK_PIECE = 2**18
"""Gaussians that are read, sorted or copied at once."""

# --- Materials and light of captures (docs/method/delighting.md) ---

RADIANCE_LEAST = 1e-4
"""Radiance below which nothing is told apart."""

GAUSSIANS_LEAST = 64
"""Gaussians of which a surface consists, at least."""

OPACITY_SEEN = 0.1
"""Opacity of those, at least."""

FOG_EXTENT, FOG_SCALES = 0.02, 2.0
"""How far around the depth that it shows a ray that meets a surface loses its light: a share of the extent of the set,
or so many times the largest scale of the Gaussian there if that is farther, as coarse surfaces are thick."""

FOG_ROUND, FOG_SHARE = 0.9, 0.8
"""Least scale over the middle one from which on a Gaussian has no normal, and share of such ones, by area, in fog: 0.02
to 0.65 of captures, those that were hardly learnt included."""

AGREEING_PICKS, AGREEING_SET, AGREEING_NEIGHBOURS = 256, 50_000, 16
"""Gaussians whose normals are compared, of how many at most, and with how many each."""

# --- Fit of lights ---

SKY_SHARE_MIN, SKY_ERRORS_MIN = 0.01, 3.0
"""An environment that gives less than this share of the light that is explained, and whose mean radiance is less than
so many standard errors from 0, is none: where lamps alone shone, noise and 8 bits gave shares of up to 0.006, and 1.6
errors."""

DAMPING_START, DAMPING_MAX = 1e-3, 1e4
"""Of Levenberg and Marquardt, relative to the diagonal: with the largest, a step is too short to be worth it."""

# --- Materials and light from images (docs/method/relightable.md) ---

SKY_CHUNK = 128
"""Gaussians whose derivatives by the sky are added up by one item."""

SPREAD_SHARE = 0.3
"""Of the angle between neighbouring directions, what is added to alpha of highlights, in squares: narrower ones would
fall between directions."""

# --- Metrics (Mir et al. 2026, sections 4.1 and 4.2; docs/method/relighting.md#metrics) ---

HUBER_WIDTH = 1.345
"""Standard deviations beyond which residuals count linearly: 95 % as efficient as least squares where errors are
normal (Huber 1981; Holland and Welsch 1977)."""

MAD_PER_DEVIATION = 0.6745
"""Median of the absolute values of normal errors, standard deviations."""

SSIM_SIGMA_PX = 1.5
"""Standard deviation of SSIM's window. Wang et al. 2004."""

SSIM_WINDOW_PX = 11
"""Side of SSIM's window. Wang et al. 2004."""

# --- Parts of frames (docs/adr/0072-parts-of-pictures.md) ---

WINDOW_STEP = 16
"""Edges of windows are multiples of so many pixels, so that what neighbouring pixels share is what it is in the whole
picture: tiles of the rasteriser (`TILE_PX`) and blocks of rays (`RAY_BLOCK_PX`)."""

# --- Training images ---

ONE_PLACE = 1e-7
"""Extent of cameras, as a share of how far they are from zero, below which it is rounding: they stand in one place."""

# --- Global illumination in real time (docs/method/realtime.md) ---

STILL_PX = 0.01
"""Pixels within which a point counts as at a pixel's centre: what stands still is not resampled."""

PROBE_NORMALS = 16
"""Side of the map of directions to whose nearest centre a probe's normal is moved where its cosines are looked up."""

MEANS_CHUNK = 64
"""Sums of tiles that one item adds up: a single one for all of a frame would keep a GPU waiting for a millisecond."""

EMITTER_OPAQUE = 0.05
"""Transmittance at which rays to captures end; what lies behind counts as what they have met."""

GRID_LIGHTS = 16
"""Lights among which a surface chooses one: where there are more, these are chosen for each cell of the world."""

GRID_CELLS_MAX = 2**18
"""Cells of a wave that have lights, at most, so that a GPU need not wait for their number; surfaces in further ones
choose among all lights. A factor of two in distance has at most 14,000 cells, choices counted."""

# --- Training ---

SH_COEFFICIENTS_MAX = 16
"""Coefficients of spherical harmonics of degree 3."""

POSE_CHUNK = 256
"""Gaussians whose derivatives by the camera's pose are added up by one item."""

EXPOSURE_CHUNK = 256
"""Pixels whose derivatives by an exposure are added up by one item."""

ADAM_BETA_1 = 0.9

ADAM_BETA_2 = 0.999

ADAM_EPSILON = 1e-15

SURFACE_ALPHA = 0.5
"""Alpha above which a pixel has a surface."""

DEAD_OPACITY = 0.005
"""Opacity at or below which a Gaussian is dead, or pruned. Kerbl et al. 2023, Kheradmand et al. 2024."""
