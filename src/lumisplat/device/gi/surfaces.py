"""Surfaces that pixels show in real-time rendering: G-buffer, reprojection to the previous frame, and albedo."""

import warp as wp

from lumisplat.constants import RAY_BLOCK_PX, STILL_PX
from lumisplat.device.material.bsdf import (
    coat_share,
    has_layers,
    left_by_coat,
    left_by_sheen,
    mirrored_share,
    sheen_share,
    simple_scale,
    view_albedo,
)
from lumisplat.device.material.microfacets import lost_share, transmits
from lumisplat.device.mesh.mesh_surface import hit_weights
from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import CameraData
from lumisplat.device.structs.scene import GaussianData, MeshData, SplatInstanceData
from lumisplat.device.structs.shading import BSDF_SIMPLE, Bsdf

# Reprojection and filters (Schied et al. 2017, Spatiotemporal Variance-Guided Filtering)

SAME_SURFACE_PX = 8.0
"""Largest distance of two points of one surface from each other's tangent planes, in pixel widths.

It is the tile size of GI-1.1."""

SAME_NORMAL_MESH = 0.9
"""Smallest cosine between the normals of one point of a mesh in two frames; the history of faster rotation is dropped.
"""

SAME_NORMAL_SPLATS = 0.5
"""Smallest cosine between the normals of one point of a surface of Gaussians in two frames; the normals are noisy."""

YOUNG_SHARE = 0.5
"""Weight of a mean of few samples when another sample is added, as a fraction of its number of samples.

Later samples include more bounces and are closer to the converged value. The variance is a third higher than that of
ordinary means."""


@struct
class SurfacePixels:
    """G-buffer of the surfaces of one kind, Gaussians or meshes; one element for each pixel, in row order."""

    share: wp.array[float]
    """Fraction of the pixel that the surface covers, 0..1; 0: no surface, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """Position, world space."""
    normal: wp.array[wp.vec3]
    """Shading normal, unit, towards the viewer."""
    distance: wp.array[float]
    """Distance from the eye, scene units."""
    extent: wp.array[float]
    """Position uncertainty of the surface, scene units: the largest scale of its Gaussian; 0 for meshes."""
    albedo: wp.array[wp.vec3]
    """Diffuse albedo, linear: fraction of a constant environment that is reflected towards the viewer."""
    glossy_albedo: wp.array[wp.vec3]
    """Albedo of the highlight, linear: fraction of a constant environment that is reflected towards the viewer."""
    alpha: wp.array[float]
    """GGX alpha of the highlight, as in ``Bsdf``."""
    previous: wp.array[wp.vec3]
    """Position of the surface point in the previous frame, world space; NaN: it did not exist."""


@struct
class InstanceMotion:
    """Motion of an instance since the previous frame; one for each splat or mesh instance, in scene order."""

    existed: int
    """0: the instance did not exist in the previous frame."""
    deforms: int
    """1: the Gaussians or vertices of the instance moved individually."""
    before_from_now: wp.mat33
    """Linear part of the world-space transform from current to previous positions."""
    before_from_now_offset: wp.vec3
    before_from_object: wp.mat33
    """Linear part of the transform from object space to the world space of the previous frame."""
    before_from_object_offset: wp.vec3
    means: wp.array[wp.vec3]
    """Previous means of the instance's Gaussians, object space.

    The arrays ``means``, ``rotations`` and ``positions`` are empty unless the instance deforms."""
    rotations: wp.array[wp.quat]
    positions: wp.array[wp.vec3]
    """Previous positions of the instance's vertices, indexed as in ``MeshData``."""


@struct
class PixelLight:
    """One light sample for each ray of the first wave, at one of the ray's two surfaces."""

    slot: wp.array[int]
    """Surface that the sample lights: 0 for Gaussians, 1 for a mesh; -1: none."""
    diffuse: wp.array[wp.vec3]
    """Unshadowed diffusely reflected radiance, as if the surface covered the whole pixel; linear."""
    glossy: wp.array[wp.vec3]
    """Unshadowed radiance reflected by highlights and other non-diffuse lobes, linear."""


@struct
class SurfaceLight:
    """Light reflected by surfaces of one kind (Gaussians or meshes), one element for each pixel, in row order."""

    is_sampled: wp.array[wp.bool]
    """True if the pixel has a sample in this frame; if false, the other fields are undefined."""
    diffuse: wp.array[wp.vec3]
    """Diffusely reflected radiance over the albedo, linear."""
    glossy: wp.array[wp.vec3]
    """Radiance reflected by highlights and other non-diffuse lobes, linear."""


@struct
class LightHistory:
    """Temporal means of the light of surfaces of one kind (Gaussians or meshes), for each pixel, in row order.

    Each surface has a diffuse and a glossy mean as in ``SurfaceLight``, and moments of both luminances.
    """

    frames: wp.array[float]
    """Number of frames that the means average; 0: no history."""
    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    moments: wp.array[wp.vec4]
    """Mean and mean square of the diffuse luminance, then of the glossy luminance."""


@struct
class FilteredLight:
    """Spatially filtered light of surfaces of one kind (Gaussians or meshes), for each pixel, in row order."""

    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    variance: wp.array[wp.vec2]
    """Variances of the diffuse and of the glossy luminance."""


@struct
class TemporalPixels:
    """Current pixels that temporal antialiasing averages with previous frames, in row order."""

    color: wp.array[wp.vec3]
    """Linear radiance."""
    motion: wp.array[wp.vec3]
    """Motion since the previous frame: x and y in pixels, and distance from the eye; NaN: new surface.

    It is the motion of the surface at which the pixel's ray ends, or of the background."""
    instance: wp.array[int]
    """Index of the instance at which the pixel's ray ends, splat instances first; -1: the background."""
    previous_pixel: wp.array[wp.vec2]
    """Position of the pixel in the previous frame; (0, 0) is the centre of the first pixel."""
    weight: wp.array[float]
    """Weight of the current frame in the temporal mean, 0..1; 1: no history."""


@struct
class TemporalHistory:
    """Temporal means of pixels over frames, one element for each pixel, in row order."""

    frames: wp.array[float]
    """Number of frames that the mean averages; 0: no history."""
    color: wp.array[wp.vec3]
    """Mean linear radiance."""
    sample: wp.array[float]
    """Luminance of the pixel in the last frame alone."""
    change: wp.array[float]
    """Mean squared difference between the luminances of successive frames."""
    instance: wp.array[int]
    """Index of the nearest instance in the surrounding 3 x 3 pixels of the last frame, splat instances first; -1:
    none."""


# --- Pixels sampled in each frame (``RealtimeConfig.light_interval``), and weights of young means ---

BLOCK = wp.constant(RAY_BLOCK_PX)


@wp.func
def is_sampled_in_frame(x: int, y: int, interval: int, frame: int) -> bool:
    """Returns whether a pixel is sampled in frame number ``frame``.

    All pixels are sampled in the first frame; in later frames, one of each ``interval`` blocks of pixels is, in turn.
    """
    return frame == 0 or (x // BLOCK + y // BLOCK + frame) % interval == 0


SHARE = wp.constant(wp.float32(YOUNG_SHARE))


@wp.func
def mean_weight(count: float, history: float) -> float:
    """Returns the weight of a mean of ``count`` samples, in samples, when another sample is added.

    The weight of a mean of few samples is less than ``count``. ``history`` is the largest number of samples in a mean.
    """
    if count < history:
        return SHARE * count
    return history - 1.0


# --- Motion (docs/method/realtime.md#motion) ---

UNMOVED = -1
"""Value in place of an instance index: the instance did not move."""

GONE = -2
"""Value in place of an instance index: the instance was removed."""


@wp.func
def has_left(before: int, now: int, moved_to: wp.array[int]) -> bool:
    """Returns whether the instance that a pixel showed in the previous frame has moved away from the pixel.

    ``before`` is the index of this instance in the previous frame, splat instances first; -1: the background. ``now``
    is that of the instance that the pixel shows now. ``moved_to`` maps previous indices to current ones, or to
    ``UNMOVED`` or ``GONE``.
    """
    if before < 0:
        return False
    return moved_to[before] != wp.static(UNMOVED) and moved_to[before] != now


@wp.func
def no_position() -> wp.vec3:
    """Returns NaN coordinates, which mark a surface without a previous position."""
    return wp.vec3(wp.nan)


@wp.func
def splat_before(
    position: wp.vec3,
    number: int,
    gaussian: int,
    instances: wp.array[SplatInstanceData],
    assets: wp.array[GaussianData],
    motions: wp.array[InstanceMotion],
) -> wp.vec3:
    """Returns the previous position of a point that moves with Gaussian ``gaussian`` of instance ``number``."""
    if motions[number].existed == 0:
        return no_position()
    if motions[number].deforms == 0:
        return motions[number].before_from_now * position + motions[number].before_from_now_offset
    asset = instances[number].asset
    local = instances[number].object_from_world * position + instances[number].object_from_world_offset
    turned = wp.quat_rotate_inv(assets[asset].rotations[gaussian], local - assets[asset].means[gaussian])
    local = motions[number].means[gaussian] + wp.quat_rotate(motions[number].rotations[gaussian], turned)
    return motions[number].before_from_object * local + motions[number].before_from_object_offset


@wp.func
def mesh_before(
    position: wp.vec3, number: int, face: int, weights: wp.vec2, meshes: MeshData, motions: wp.array[InstanceMotion]
) -> wp.vec3:
    """Returns the previous position of a point of mesh instance ``number``.

    ``face`` is an index over all meshes; ``weights`` are the barycentric weights of the face's second and third corner.
    """
    if motions[number].existed == 0:
        return no_position()
    if motions[number].deforms == 0:
        return motions[number].before_from_now * position + motions[number].before_from_now_offset
    corners = meshes.indices[face]
    share = hit_weights(weights)
    local = share[0] * motions[number].positions[corners[0]]
    local += share[1] * motions[number].positions[corners[1]] + share[2] * motions[number].positions[corners[2]]
    return motions[number].before_from_object * local + motions[number].before_from_object_offset


@wp.func
def pixel_before(position: wp.vec3, camera: wp.array[CameraData]) -> wp.vec3:
    """Projects a point with a pinhole camera: returns x and y in pixels, with pixel centres at +0.5, and its distance.

    The distance is 0 for a point that is not visible.
    """
    from_eye = position - camera[0].eye
    view = wp.transpose(camera[0].world_from_camera) * from_eye
    if not view[2] > camera[0].near:
        return wp.vec3(0.0)
    x = camera[0].focal[0] * view[0] / view[2] + camera[0].center[0]
    y = camera[0].focal[1] * view[1] / view[2] + camera[0].center[1]
    return wp.vec3(x, y, wp.length(from_eye))


@wp.func
def motion_of(
    position: wp.vec3, previous: wp.vec3, camera: wp.array[CameraData], camera_before: wp.array[CameraData]
) -> wp.vec3:
    """Returns a point's motion in the image since the previous frame: x and y in pixels, and distance from the eye.

    The result is NaN if the point had no previous position or was not visible.

    ``previous`` is the point's position in the previous frame; NaN: it had none.
    """
    if wp.isnan(previous[0]):
        return no_position()
    before = pixel_before(previous, camera_before)
    if before[2] <= 0.0:
        return no_position()
    return pixel_before(position, camera) - before


# --- Reprojection: pixels of the previous frame that show the same surface (docs/method/realtime.md#reprojection) ---

SURFACE_PX = wp.constant(wp.float32(SAME_SURFACE_PX))

NORMAL_MESH = wp.constant(wp.float32(SAME_NORMAL_MESH))

NORMAL_SPLATS = wp.constant(wp.float32(SAME_NORMAL_SPLATS))

STILL = wp.constant(wp.float32(STILL_PX))


@wp.func
def snapped(x: float) -> float:
    """Rounds a pixel coordinate to the pixel's centre if it differs only by rounding."""
    return wp.where(wp.abs(x - wp.round(x)) < STILL, wp.round(x), x)


@wp.func
def least_cosine(extent: float) -> float:
    """Returns the smallest cosine between two normals of one surface; ``extent`` is above 0 for Gaussians."""
    return wp.where(extent > 0.0, NORMAL_SPLATS, NORMAL_MESH)


@wp.func
def tolerance(distance: float, extent: float, camera: wp.array[CameraData]) -> float:
    """Returns the largest distance of two points of one surface from each other's tangent planes, scene units."""
    return wp.max(SURFACE_PX * distance / camera[0].focal[0], extent)


@wp.func
def is_near(
    position: wp.vec3,
    normal: wp.vec3,
    tolerated: float,
    cosine_min: float,
    other_position: wp.vec3,
    other_normal: wp.vec3,
) -> bool:
    """Returns whether two points with normals lie on one surface.

    ``tolerated`` is the largest distance of each point from the tangent plane of the other, scene units, and
    ``cosine_min`` the smallest cosine between their normals.
    """
    if wp.dot(normal, other_normal) < cosine_min:
        return False
    offset = other_position - position
    across = wp.max(wp.abs(wp.dot(offset, normal)), wp.abs(wp.dot(offset, other_normal)))
    return across <= tolerated


@wp.func
def is_same_surface(
    position: wp.vec3,
    normal: wp.vec3,
    tolerated: float,
    cosine_min: float,
    pixel: int,
    surfaces: SurfacePixels,
) -> bool:
    """Returns whether a point with a normal lies on the surface that a pixel shows, by the test of `is_near`."""
    if surfaces.share[pixel] <= 0.0:
        return False
    return is_near(position, normal, tolerated, cosine_min, surfaces.position[pixel], surfaces.normal[pixel])


# --- Albedo: reflected fraction of a constant environment (docs/method/realtime.md#surfaces) ---

MEAN_COSINE = wp.constant(wp.float32(2.0 / 3.0))
"""Mean cosine of light from a constant environment, weighted by the cosine."""


@wp.func
def left_by_layers(bsdf: Bsdf, cosine: float) -> float:
    """Returns the fraction of constant illumination that clearcoat and sheen transmit, evaluated at its mean cosine."""
    if not has_layers(bsdf):
        return 1.0
    return left_by_coat(bsdf, cosine, MEAN_COSINE) * left_by_sheen(bsdf, cosine, MEAN_COSINE)


@wp.func
def diffuse_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the diffuse albedo for a view at a cosine from the normal, under a constant environment."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.diffuse)
    if bsdf.dielectric <= 0.0:
        return left_by_layers(bsdf, cosine) * bsdf.diffuse
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.diffuse


@wp.func
def base_highlight(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the albedo of the highlight below clearcoat and sheen; 0 for smooth surfaces, which have no highlight."""
    if bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0:
        return wp.vec3(0.0)
    return view_albedo(bsdf, cosine) + lost_share(cosine, bsdf.alpha) * bsdf.rescattered


@wp.func
def glossy_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the albedo of all lobes except the diffuse one, without the mirror reflection of smooth surfaces."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.specular)
    albedo = base_highlight(bsdf, cosine)
    if not has_layers(bsdf):
        return albedo
    fibres = wp.min(sheen_share(bsdf.sheen_curve, cosine), 1.0) * bsdf.sheen
    albedo = left_by_layers(bsdf, cosine) * albedo + left_by_coat(bsdf, cosine, MEAN_COSINE) * fibres
    return albedo + wp.vec3(coat_share(bsdf.coat, bsdf.coat_alpha, cosine))


@wp.func
def transmitted_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the fraction of a constant environment behind a rough surface that is transmitted to a view."""
    if bsdf.model == BSDF_SIMPLE or not transmits(bsdf):
        return wp.vec3(0.0)
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.transmitted


@wp.func
def highlight_width(bsdf: Bsdf) -> float:
    """Returns the GGX alpha of the highlight; for a Phong exponent, the equivalent alpha of Walter et al. 2007."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.sqrt(2.0 / (bsdf.shininess + 2.0))
    return bsdf.alpha


@wp.func
def matte_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the total albedo for a view under a constant environment, at most 1.

    It includes transmission through rough surfaces, but not the mirror reflection of smooth surfaces.
    """
    albedo = diffuse_albedo(bsdf, cosine) + glossy_albedo(bsdf, cosine) + transmitted_albedo(bsdf, cosine)
    return wp.min(albedo, wp.vec3(1.0))
