"""Constants that several modules share, each with its unit, reason and source. Other constants live in their module."""

from __future__ import annotations

# --- Gaussian response and blending (Kerbl et al. 2023, 3D Gaussian Splatting) ---

ALPHA_MIN = 1.0 / 255.0
"""Alpha below which a Gaussian is skipped at a pixel: one step of an 8-bit image, as in INRIA's code, gsplat and
3DGRT.
"""

ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian, so that no single Gaussian hides everything behind it. INRIA's rule."""

NORMAL_DEGENERATE = 0.2
"""Length of the alpha-weighted mean of unit normals below which the mean is unreliable and the view direction replaces
it. docs/method/gaussians.md#normals; the value is NVIDIA's."""

# --- Rays through Gaussians (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing) ---

KERNEL_DEGREE = 2
"""Exponent of the distance in the Gaussian response exp(-d^2 / 2) of ordinary captures."""

KERNEL_DEGREE_MAX = 5
"""Largest exponent of the generalised response (quintic). Every degree responds exp(-4.5) at three standard
deviations.
"""

NODE_WIDTH = 8
"""Number of children of a BVH node: one coordinate of their eight boxes fills a vector register."""

BOX_MARGIN = 1e-6
"""Fraction of a box's longest side and of its distance from the origin by which BVH boxes grow, so that rounding loses
no hit."""

HIT_COUNTS = (4, 8, 16, 32)
"""Accepted values of ``TraceConfig.hits_per_pass`` and ``ShadowConfig.hits``; kernels have storage for the largest."""

HIT_BUFFER_CPU, HIT_BUFFER_CUDA = 64, 32
"""Number of sorted hits that a ray buffers per pass: on the CPU, and on CUDA, where the buffer is in local memory.
Fewer passes make rays 1.6 times faster on the CPU, and 1.4 times on CUDA, than buffers of 16 hits."""

TRAVERSE_STACK = 256
"""Entries of the stack with which a ray traverses the top-level BVH and the BVH of an asset: for each level of both,
all children of a node except the child being visited.
"""

TRAVERSE_STACK_SMALL = 96
"""Entries of the smaller traversal stack that CUDA kernels use if a scene's BVHs are shallow enough, which is known
after the build. Measured need: 49 for a million evenly spread Gaussians, 57 for a capture of 153,000, 106 for a million
Gaussians whose density varies a thousandfold."""

REBUILD_COST = 1.5
"""Factor by which the cost of a refitted BVH (surface area of all nodes over that of the root) may grow before the BVH
is rebuilt."""

OUTLIER_SHARE = 0.01
"""Fraction of the Gaussians at each end of an axis that a capture's extent ignores, so that outliers do not stretch
it.
"""

BOUNCES_MAX = 64
"""Largest number of bounces of a ray, for which arrays are allocated."""

SAMPLES_MAX = 16_777_216
"""Largest number of samples per pixel: beyond 2^24, one more sample no longer changes a float32 mean."""

NOISE_SAMPLES_MIN = 16
"""Smallest number of samples from which the noise of a pixel is estimated: with fewer, the estimate is itself noise."""

NOISE_PIXELS = 0.95
"""Quantile of the pixels' relative errors that is reported as the noise of a frame."""

SAMPLE_RATES = 16
"""Number r of sampling rates: adaptive sampling gives a pixel 1, 2, ... or r of every r samples of the frame."""

SUBPIXEL_STEPS = (0.7548776662466927, 0.5698402909980532)
"""Offset in pixels, modulo 1, from one sample of a pixel to the next: the R2 sequence, 1/g and 1/g^2 with g^3 = g + 1
(Roberts 2018, The Unreasonable Effectiveness of Quasirandom Sequences)."""

# --- Rays that hit meshes, mirrors and glass ---

RAY_START_BACK = 4e-6
"""Distance in front of a mesh's bounding box from which rays are intersected with the mesh, as a fraction of the ray's
distance to the box: 64 float32 roundings."""

SPAWN_ERROR = 2.0**-20
"""Rounding error of a hit point, relative to the coordinates from which the point and the next intersection are
computed: 16 roundings. Reflected and refracted rays start this far off the surface. With a quarter of this offset, some
rays escape from closed mirrors of thin triangles."""

SPAWN_SLENDER = 1000.0
"""Ratio of a triangle's longest side to its height up to which the offset of spawned rays grows with the ratio.
Offsets for thinner triangles would become visible."""

# --- Light and shadow ---

EXPOSURE_MAX = 100
"""Largest exposure change in stops, up or down: 2^100 is still a float32."""

SHADOW_OFFSET = 4.0
"""Distance, in scales of a Gaussian, within which a Gaussian and a surface of Gaussians do not shadow each other; the
smaller of their two scales counts. Light lost to self-shadowing in three captures lit from the camera: 1.6 to 4.6 % at
2, 0.8 to 3.1 % at 3, 0.6 to 2.2 % at 4 (docs/adr/0018)."""

COLOR_STRENGTH_MAX = 5.0
"""Largest ``color_strength`` of shadows; there Gaussians transmit all the light that their colours allow
(docs/method/shadows.md#threshold-and-tint). The range is NVIDIA's."""

CATCHER_AMBIENT = 0.5
"""Default ambient light of a shadow catcher, as radiance over albedo, in scenes with lights and without an
environment: half of the light that makes white paper white."""

SPLAT_ROUGHNESS_MIN = 0.03
"""Smallest roughness of Gaussians: their normals are too uneven for sharp mirrors."""

LIGHT_DISTANCE_MIN = 1e-6
"""Distance in scene units below which a point light gets no brighter, so that its irradiance stays finite."""

LIGHT_POWER_MAX = 1e30
"""Largest intensity, illuminance, radiance or irradiance of a light: products with it still fit into float32."""

ENVIRONMENT_SHARE_STEPS = 2**24
"""Steps per unit to which the sampling probabilities of an environment's texels are rounded: float32 is no finer below
1.
"""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Luminance weights of linear Rec.709 RGB."""

# --- Tone mapping (docs/method/lighting.md#developed-frames) ---

RADIANCE_MAX = 2.0**64
"""Upper bound to which radiance is clamped: far above the white of every tone mapper, far below the largest float32."""

WEIGHT_ROUNDING = 1e-5
"""Blending weights whose sum is within this of 1 count as full coverage, because float32 sums round."""

NEUTRAL_TOE = 0.04
"""F90 of Khronos PBR Neutral (github.com/KhronosGroup/ToneMapping); its Ks and Kd follow."""

NEUTRAL_START = 0.8 - NEUTRAL_TOE

NEUTRAL_DESATURATION = 0.15

AGX_STOPS = (-12.47393, 4.026069)
"""Domain of the AgX curve in log2 of radiance: from 10 stops below middle grey to 6.5 above."""

AGX_PIVOT = (10.0 / 16.5, 0.5)
"""Pivot of the AgX curve in Sobotka's first configuration (AgX-S2O3): middle grey maps to half of display white."""

AGX_SLOPE, AGX_TOE, AGX_SHOULDER = 2.0, 3.0, 3.25
"""Slope of the AgX curve at its pivot, and the powers of its toe and shoulder."""

AGX_GAMMA = 2.2

# --- Path tracing (docs/method/paths.md) ---

COAT_HEAD_ON, COAT_ROUGHNESS_MIN, SHEEN_ROUGHNESS_MIN = 0.04, 0.03, 0.1
"""F0 of clearcoat, smallest roughness of clearcoat, and smallest roughness of sheen. With smaller roughness, the
albedo of sheen exceeds 1 at more and more angles."""

# --- Deep Gaussian shadow maps (Mir et al. 2026; docs/method/deep_shadow_maps.md) ---

SHADOW_TILE = 8
"""Side, in texels, of the tiles of a deep shadow map, each with a list of its casters; the value of Mir et al. 2026."""

SHADOW_BOUND_MARGIN = 1e-4
"""Fraction by which the bounds of a deep shadow map's tiles and casters grow, so that rounding loses no caster."""

SHADOW_FOOTPRINT = 3.0
"""Standard deviations from a receiver's mean up to which it samples a deep shadow map, and up to which casters reach.
"""

# --- Light estimation from captured surfaces (docs/method/relighting.md#traces-of-light) ---

SURFACE_REACH = 1.1
"""Half the side of the cube in which estimates of lights and sun look for captured surfaces, in units of the capture's
extent."""

TRACE_DIRECTIONS = 128
"""Number of directions from which light estimation lights captured surfaces by a smooth environment."""

TRACE_SURFACES_MIN = 200
"""Smallest number of captured surface points from which lights or a sun can be estimated."""

TRACE_GROUND_MIN = 0.3
"""Length of `ground_direction`, which is opposite to the mean unblocked direction at a point, from which on it counts
as downwards. The length is 1 above an endless plane, and 0 in a closed room."""

# --- Projection to the image (EWA splatting, Zwicker et al. 2001) ---

JACOBIAN_CLAMP = 1.3
"""Image position, in units of tan(fov / 2), at which the projection's Jacobian is clamped: farther out, the
linearisation explodes."""

NEAR_PLANE = 0.01
"""Default near plane: view depth in scene units. gsplat's default."""

# --- Spherical harmonics (Condon-Shortley signs as in INRIA's code) ---

SH_DEGREE_MAX = 3
"""Highest SH degree that is read, stored and evaluated."""

SH_C0 = 0.28209479177387814
"""Constant SH basis function, Y_00 = 1 / (2 sqrt(pi))."""

# --- Light probes (docs/method/relighting.md#probes) ---

PROBE_FACE_PX = 64
"""Side of a light probe's cube-map faces in pixels: about 1.4 degrees a pixel, while SH of degree 8 vary over 20
degrees."""

# --- Meshes ---

CREASE_ANGLE = 0.9
"""Largest angle, in radians, between faces that are shaded smoothly in meshes without normals (51.6 degrees). 99 % of
the edges of spot, the bunny and the teapot bend by less than 41 degrees; hexagonal prisms by 60, boxes by 90."""

# --- Placement ---

TRANSFORM_MAX = 1e18
"""Largest absolute entry of a transform and of its inverse: its square still fits into float32."""

SIMILARITY_TOLERANCE = 1e-4
"""Tolerance for the axes of a capture's transform: differences of squared lengths, and cosines between axes. It allows
for poses that were stored with five digits."""

# --- Local origins (docs/adr/0086-one-local-origin.md) ---

ORIGIN_LOSS = 0.01
"""Largest float32 rounding of positions, relative to the median width of a Gaussian or triangle. Captures and files
that exceed it get a local origin."""

ORIGIN_MESH_WIDTH = 0.01
"""Size of the smallest mesh detail that must survive rounding, relative to the mesh; with `ORIGIN_LOSS`, positions are
accurate to a ten-thousandth of the mesh."""

# --- Limits of 32-bit indices ---

ITEMS_MAX = 2**31 - 1
"""Largest number of Gaussians or triangles in a scene, and of (tile, item) pairs in a frame, where an item is a splat
or triangle that touches the tile."""

# --- Work decomposition ---

TILE_PX = 16
"""Side of a raster tile in pixels: one CUDA thread block of 256 threads, and an accumulator that fits the CPU's cache.
"""

STRIP_PX = 8
"""Pixels of a tile row that the CPU composites in one vector (AVX: 8 floats); divides `TILE_PX`."""

DEPTH_KEY_CULLED = 0xFFFFFFFF
"""Depth key of a culled Gaussian: larger than the bits of every positive float."""

DEPTH_KEY_NONFINITE = 0xFFFFFFFE
"""Depth key of a Gaussian that is dropped because a projected value is NaN or infinite."""

RAY_BLOCK_PX = 4
"""Side, in pixels, of the square of pixels whose rays are stored consecutively, because neighbours hit the same boxes.
"""

PACKET_RAYS = RAY_BLOCK_PX * RAY_BLOCK_PX
"""Rays in a packet, which the CPU traces together; ray counts are rounded up to multiples of it."""

RAY_TILE_PX = 8
"""Side, in pixels, of the tiles that list the Gaussians which camera rays may hit; a multiple of `RAY_BLOCK_PX`."""

RAY_BANDS_PER_THREAD = 32
"""Bands (ranges of rays) per CPU thread when tracing: the cost of ray packets varies more than the cost of tiles."""

TILE_BANDS_PER_THREAD = 12
"""Bands (ranges of tiles) per CPU thread when compositing: the cost of tiles varies tenfold, and several bands balance
the threads."""

SHADE_BANDS_PER_THREAD = 4
"""Bands (ranges of rays) per CPU thread when shading surfaces: pixels without a hit cost little."""

COUNT_SUM_THREADS = 4096
"""Number of CUDA threads that together sum an array of counts in 64 bits: pairs of a raster tile and a splat or
triangle that touches it, or samples that are not finite."""

# --- Files ---

SCALE_MIN = 1e-12
"""Smallest standard deviation in scene units read from a file, because files store logarithms whose exponential may
underflow to zero. Its square and the reciprocal of its square are normal float32 numbers."""

FLAT_THICKNESS = 1e-3
"""Third scale given to 2D Gaussians read from a file, relative to the smaller of their two scales. Frames of 20,000
discs are within 2/255 of frames with discs a hundred times thinner, rasterised and traced, also 100 units from the
origin; discs ten times thicker show at silhouettes."""

FILE_BYTES_MAX = 4 * 2**30
"""Size in bytes of the largest file that is read as a whole. PLY captures are read in pieces, and may be larger."""

# --- Lens distortion ---

DISTORTION_STEPS = 12
"""Newton steps that invert a lens distortion. Convergence is quadratic: 5 suffice for real lenses, and more help near
the fold of the polynomial."""

# --- Sequences of frames, animations ---

ANIMATION_FRAMES_MAX = 1_000_000
"""Largest number of frames in an animation, eleven hours at 24 fps. More are a typing error, and exhaust memory."""

# --- Compilation ---

FUSED_FLAGS = (
    "-march=native -ffp-contract=fast -mllvm=-inline-threshold=9000"
    " -mllvm=-inline-cold-callsite-threshold=3000 -mllvm=-slp-recursion-max-depth=4"
)
"""Compiler flags of CPU kernels that gain from fused multiply-adds; otherwise Warp's defaults. All modules share one
string, because Warp precompiles its header once per string, which takes seconds."""

# --- SH fits of lit captures ---

RIDGE = 3e-4
"""Factor of the ridge penalty of SH fits of degree l: ``RIDGE (l (l + 1))^2`` on the square of each coefficient, where
views evenly spread over all directions have weight 1. The penalty keeps directions without views smooth, and takes 4 %
of degree 3 with views in all directions."""

# --- Spatial blocks of captures (docs/adr/0073-out-of-core-captures-in-blocks.md) ---

BLOCK_GAUSSIANS_MAX = 2**19
"""Largest number of Gaussians in a spatial block of a capture stored in blocks: 29 MB at SH degree 0. A billion
Gaussians make 2,000 blocks."""

BLOCK_PIECE = 2**18
"""Number of Gaussians that are read, sorted or copied at once while a capture is written in blocks."""

# --- Material estimation of captures (docs/method/delighting.md) ---

RADIANCE_LEAST = 1e-4
"""Lower bound, in units of display white, to which radiance is raised before its logarithm is taken or it divides."""

GAUSSIANS_LEAST = 64
"""Smallest number of Gaussians with `SURFACE_OPACITY_MIN` for a capture to have surfaces that can be measured or
delit."""

SURFACE_OPACITY_MIN = 0.1
"""Smallest opacity of the Gaussians that form a surface."""

SURFACE_DEPTH_EXTENT, SURFACE_DEPTH_SCALES = 0.02, 2.0
"""Half the depth range around a surface in which a ray must lose its transmittance for the surface to count as sharp:
the larger of a fraction of the capture's extent, and a multiple of the largest scale of the Gaussian there, because
coarse surfaces are thick."""

ISOTROPIC_RATIO, ISOTROPIC_SHARE_MAX = 0.9, 0.8
"""Ratio of the smallest to the middle scale above which a Gaussian counts as round, without a normal; then the
fraction of round Gaussians, by area, from which on a capture counts as haze. Measured fractions are 0.02 to 0.65, even
for barely trained captures.
"""

AGREEING_PICKS, AGREEING_SET, AGREEING_NEIGHBOURS = 256, 50_000, 16
"""Sample sizes with which the agreement of neighbouring normals is measured: number of Gaussians, largest number of
Gaussians among which their neighbours are searched, and neighbours of each."""

# --- Light fitting ---

ENVIRONMENT_SHARE_MIN, ENVIRONMENT_ERRORS_MIN = 0.01, 3.0
"""A light fit has an environment if the environment explains at least this fraction of the light, or if its mean
radiance exceeds this number of standard errors. In captures lit by local lights only, noise and 8-bit images gave
fractions up to 0.006 and means up to 1.6 standard errors.
"""

DAMPING_START, DAMPING_MAX = 1e-3, 1e4
"""Initial and largest Levenberg-Marquardt damping of light fits, relative to the diagonal of the normal equations; at
the largest, steps are negligible."""

# --- Materials and light from images (docs/method/relightable.md) ---

ENVIRONMENT_CHUNK = 128
"""Number of Gaussians over which one thread sums the gradient with respect to the environment."""

SPREAD_SHARE = 0.3
"""Width that is added to highlights, as a fraction of the angle between neighbouring sampled directions; narrower
highlights would fall between the directions. The square of the width is added to the square of the GGX alpha."""

# --- Metrics (Mir et al. 2026, sections 4.1 and 4.2; docs/method/relighting.md#metrics) ---

HUBER_WIDTH = 1.345
"""Threshold of the Huber loss in standard deviations: 95 % as efficient as least squares for normal errors (Huber
1981; Holland and Welsch 1977)."""

MAD_PER_DEVIATION = 0.6745
"""Median absolute deviation of normal errors, in standard deviations."""

SSIM_SIGMA_PX = 1.5
"""Standard deviation of SSIM's Gaussian window, in pixels. Wang et al. 2004."""

SSIM_WINDOW_PX = 11
"""Side of SSIM's window in pixels. Wang et al. 2004."""

# --- Windows of frames (docs/adr/0072-tiles-and-sample-blocks-match-the-frame.md) ---

WINDOW_STEP = 16
"""Pixel step of the edges of windows, rectangles of an image that are rendered alone. As a multiple of raster tiles
(`TILE_PX`) and of squares of rays (`RAY_BLOCK_PX`), it makes their pixels equal those of the whole image."""

# --- Training images ---

COINCIDENT_EXTENT = 1e-7
"""Extent of camera positions, relative to their distance from the origin, below which they count as one position."""

# --- Global illumination in real time (docs/method/realtime.md) ---

STILL_PX = 0.01
"""Motion in pixels below which a surface counts as still in the image, so that its history is read at its own pixel,
without interpolation."""

PROBE_NORMALS = 16
"""Cells along each side of the octahedral map to which normals are rounded, to look up a screen probe's cosine
weights."""

MEANS_CHUNK = 64
"""Number of tiles whose irradiance sums one thread adds up to the frame's mean; a single thread for all tiles would
keep a GPU waiting for a millisecond."""

EMITTER_OPAQUE = 0.05
"""Transmittance at which rays towards captured emitters end; the remaining transmittance counts as blocked, too."""

GRID_LIGHTS = 16
"""Number of lights up to which real-time surfaces choose among all lights. With more, each cell of the light grid
stores a random sample of them for the surfaces in it."""

GRID_CELLS_MAX = 2**18
"""Largest number of light-grid cells, fixed so that the host need not wait for a GPU's count; surfaces in cells beyond
it sample all lights. A doubling of distance from the camera needs at most 14,000 cells."""

# --- Training ---

SH_COEFFICIENTS_MAX = 16
"""Number of SH coefficients of degree 3."""

POSE_CHUNK = 256
"""Number of Gaussians over which one thread sums the gradient with respect to the camera pose."""

EXPOSURE_CHUNK = 256
"""Number of pixels over which one thread sums the gradient with respect to an image's exposure."""

ADAM_BETA_1 = 0.9

ADAM_BETA_2 = 0.999

ADAM_EPSILON = 1e-15

SURFACE_ALPHA = 0.5
"""Smallest alpha of a pixel that counts as covered by a surface."""

DEAD_OPACITY = 0.005
"""Opacity below which adaptive densification prunes a Gaussian, and at or below which MCMC relocates it. Kerbl et al.
2023, Kheradmand et al. 2024."""

OPAQUE_BLOCK = 512
"""Camera rays whose paths at opaque meshes a thread of a CPU follows together.

Rays of later bounces are fewer, and fill the lanes of vector registers but for the last ones of each bounce. The
memory of a block, 60 KB, fits into the cache of a core; 1,024 rays take the same time.
"""
