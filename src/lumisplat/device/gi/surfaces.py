"""Real-time rendering's G-buffer: surfaces of pixels, their reprojection to the previous frame, and their albedo."""

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
"""Two points lie on one surface only if each is at most this far from the other's tangent plane, in pixel widths.

It is the tile size of GI-1.1."""

SAME_NORMAL_MESH = 0.9
"""A mesh point keeps its history only if the cosine between its normals in two frames is at least this."""

SAME_NORMAL_SPLATS = 0.5
"""A point on Gaussians keeps its history only if the cosine between its normals in two frames is at least this.

The bound is low, because these normals are noisy."""

FOOTPRINT_PX2 = 1.0 / 6.0
"""Variance, along each axis, of the window of a pixel within which normals widen highlights, square pixels.

The light of a highlight smaller than a pixel then depends on its place between pixel centres by 7 % along each axis,
and for the variance 1/12 of a square pixel by 39 %, which flickers."""

FOOTPRINT_ALPHA2_MAX = 0.18
"""Largest squared GGX alpha by which the normals of a pixel widen highlights (Tokuyoshi and Kaplanyan 2019)."""

YOUNG_SHARE = 0.5
"""When a sample is added to a mean of few samples, the mean counts as only this fraction of its number of samples.

Later samples include more bounces and are closer to the converged value. The variance is a third higher than that of
ordinary means."""


@struct
class SurfacePixels:
    """G-buffer of one kind of surface, Gaussians or meshes; one element for each pixel, in row order."""

    share: wp.array[float]
    """Fraction of the pixel that the surface covers, 0..1; 0: no surface, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World-space position of the surface point that the pixel shows."""
    normal: wp.array[wp.vec3]
    """Unit shading normal of the surface point, world space, towards the viewer."""
    distance: wp.array[float]
    """Distance of the surface point from the eye, scene units."""
    extent: wp.array[float]
    """Position uncertainty of the surface, scene units: the largest scale of its Gaussian; 0 for meshes."""
    albedo: wp.array[wp.vec3]
    """Diffuse albedo, linear: fraction of uniform illumination that is reflected to the viewer."""
    glossy_albedo: wp.array[wp.vec3]
    """Albedo of highlight and layers, linear: fraction of uniform illumination reflected to the
    viewer."""
    alpha: wp.array[float]
    """GGX alpha of the highlight, roughness squared; 0: a mirror."""
    footprint: wp.array[float]
    """Squared GGX alpha by which the normals within the pixel widen its highlights (`footprint_alpha2`)."""
    previous: wp.array[wp.vec3]
    """World-space position of the same surface point in the previous frame; NaN: it did not exist."""


@struct
class Reprojection:
    """For each pixel, in row order: which pixels of the previous frame showed its surface, and their weights."""

    first: wp.array[int]
    """Index of the upper left one of four pixels."""
    weights: wp.array[wp.vec4]
    """Weights of this pixel, and of those to its right, below, and below to the right; all 0: none showed it."""


@struct
class PreviousImage:
    """Pixels of the previous frame's images, which may have another size than those of this frame."""

    size: wp.vec2i
    """Width and height, pixels."""
    scale: wp.vec2
    """A point at ``p`` in this frame's images is at ``scale * p + shift`` in the previous frame's, pixels from the
    corner, if the camera has not moved."""
    shift: wp.vec2


OUTDATED_HISTORY_WEIGHT = 1e-4
"""Factor on the weight of cached lighting in a frame in which a light appears or disappears. New samples then replace
the cached lighting at once. Where there are no new samples yet, the cached lighting is still shown."""

OUTDATED = wp.constant(wp.float32(1.001 * OUTDATED_HISTORY_WEIGHT))


@struct
class SequenceData:
    """Number of a frame in its real-time sequence, and how far cached lighting is valid, in a 1-element array."""

    frame: int
    """Number of the frame, from 0."""
    history_weight: float
    """Factor on the weight of cached lighting in this frame, 0..1; 1 unless lighting has changed."""
    before: PreviousImage
    """Images of the previous frame."""
    moved: int
    """Number of boxes around objects that have moved, `MovedBox`."""


@struct
class MovedBox:
    """World-space box around an object that has moved, appeared or left since the previous frame, where it was or is.

    Light that passes by all boxes is blocked as in the previous frame. Of large captures, the box encloses a sample of
    the Gaussians, so that a few may stick out.
    """

    center: wp.vec3
    half: wp.vec3
    """Half the length of the box along each axis, scene units."""


@struct
class InstanceMotion:
    """Motion since the previous frame of one splat or mesh instance, in the order of the scene's instances."""

    existed: int
    """1: the instance was in the previous frame; 0: it is new, and the other fields are undefined."""
    deforms: int
    """1: Gaussians or vertices moved within the instance; 0: at most the instance moved as a whole."""
    before_from_now: wp.mat33
    """Linear part of the map from a point's world-space position now to its position in the previous frame."""
    before_from_now_offset: wp.vec3
    before_from_object: wp.mat33
    """Linear part of the instance's transform in the previous frame, from object to world space."""
    before_from_object_offset: wp.vec3
    means: wp.array[wp.vec3]
    """Means of the instance's Gaussians in the previous frame, object space.

    ``means``, ``rotations`` and ``positions`` are empty unless ``deforms`` is 1."""
    rotations: wp.array[wp.quat]
    positions: wp.array[wp.vec3]
    """Vertex positions in the previous frame, object space, indexed as those of ``MeshData``."""


@struct
class PixelLight:
    """One light sample for each camera ray, at either the Gaussians or the mesh that it hits."""

    slot: wp.array[int]
    """Surface that the light sample lights: 0 for Gaussians, 1 for a mesh; -1: none."""
    diffuse: wp.array[wp.vec3]
    """Linear radiance of the sampled light, unshadowed, that the surface reflects diffusely, as if it covered the
    whole pixel.
    """
    glossy: wp.array[wp.vec3]
    """Linear radiance of the sampled light, unshadowed, that all other lobes reflect, as if the surface covered the
    whole pixel."""
    light: wp.array[int]
    """Index of the sampled light if its visibility is remembered, else -1.

    Then ``diffuse`` and ``glossy`` are only what its visibility at its centre leaves out."""
    ratio: wp.array[float]
    """Unshadowed irradiance of the sample over that of the light's centre, 0..`VISIBILITY_MOST`."""


@struct
class SurfaceLight:
    """Light reflected by one kind of surface, Gaussians or meshes; one element for each pixel, in row order."""

    is_sampled: wp.array[wp.bool]
    """True if the pixel has a sample in this frame; if false, the other fields are undefined."""
    diffuse: wp.array[wp.vec3]
    """Linear radiance that the surface reflects diffusely, divided by its diffuse albedo."""
    glossy: wp.array[wp.vec3]
    """Linear radiance that highlights and all other lobes but the diffuse one reflect."""


@struct
class LightHistory:
    """For each pixel, in row order: means over frames of the light of one kind of surface, Gaussians or meshes.

    Each surface has a diffuse and a glossy mean as in ``SurfaceLight``, and moments of both luminances.
    """

    frames: wp.array[float]
    """Number of frames of the history; 0: none. While light changes, means of indirect light cover fewer of them."""
    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    moments: wp.array[wp.vec4]
    """Mean and mean square of the luminance of diffuse light (x, y) and of glossy light (z, w)."""


@struct
class FilteredLight:
    """Light of one kind of surface, Gaussians or meshes, after the spatial filter; for each pixel, in row order."""

    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    deviation: wp.array[wp.vec2]
    """Standard deviation of the luminance of diffuse light (x) and of glossy light (y)."""


@struct
class TemporalPixels:
    """Current frame's pixels, to be averaged with previous frames by temporal antialiasing; in row order."""

    color: wp.array[wp.vec3]
    """Linear radiance of the pixel in the current frame."""
    motion: wp.array[wp.vec3]
    """Motion of what the pixel shows since the previous frame: x and y in pixels, z as change of the distance from the
    eye.

    The pixel shows the surface at which its ray ends, or the background. NaN: a new surface."""
    instance: wp.array[int]
    """Index of the instance at which the pixel's ray ends, splat instances first; -1: the background."""
    previous_pixel: wp.array[wp.vec2]
    """Where the pixel's surface was in the previous frame, pixels; (0, 0) is the centre of the first pixel."""
    weight: wp.array[float]
    """Weight of the current frame in the mean over frames, 0..1; 1: there is no history."""
    changed: wp.array[int]
    """Pixel whose change of known light is added to this pixel's means; -1: none is."""


@struct
class TemporalHistory:
    """Means over frames that temporal antialiasing keeps; one element for each pixel, in row order."""

    frames: wp.array[float]
    """Number of frames in the pixel's mean; 0: the pixel has no history."""
    color: wp.array[wp.vec3]
    """Mean linear radiance of the pixel over frames."""
    sample: wp.array[float]
    """Luminance that the pixel had in the last frame, before averaging."""
    change: wp.array[float]
    """Mean over frames of the squared difference of the pixel's luminance between successive frames."""
    instance: wp.array[int]
    """Index, in the last frame, of the instance nearest to the eye among the 3 x 3 pixels around, splats first; -1:
    background."""


@struct
class KnownLight:
    """Light of each pixel that needs no samples, because the visibility of its lights is remembered; in row order."""

    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    """Diffuse albedo of the surfaces, times the fraction of the pixel that they cover."""
    glossy_albedo: wp.array[wp.vec3]
    """Albedo of their highlights, times that fraction."""


# --- Pixels sampled in each frame (``RealtimeConfig.light_interval``), and weights of young means ---

BLOCK = wp.constant(RAY_BLOCK_PX)


@wp.func
def is_sampled_in_frame(x: int, y: int, interval: int, frame: int) -> bool:
    """Returns whether light is sampled at pixel (x, y) in frame number ``frame``.

    The first frame samples all pixels; each later one samples one of every ``interval`` blocks of pixels, in turn.
    """
    return frame == 0 or (x // BLOCK + y // BLOCK + frame) % interval == 0


SHARE = wp.constant(wp.float32(YOUNG_SHARE))


@wp.func
def mean_weight(count: float, history: float) -> float:
    """Returns the weight, in samples, that a mean of ``count`` samples has when another sample is added.

    It is less than ``count`` for young means, and at most ``history - 1``.
    """
    if count < history:
        return SHARE * count
    return history - 1.0


# --- Motion (docs/method/realtime.md#motion) ---

UNMOVED = -1
"""Value in the map from previous to current instance indices, ``moved_to``: the instance has not moved."""

GONE = -2
"""Value in the map from previous to current instance indices, ``moved_to``: the instance was removed."""


@wp.func
def has_left(before: int, now: int, moved_to: wp.array[int]) -> bool:
    """Returns whether the instance that a pixel showed in the previous frame has left it: it moved or was removed.

    ``before`` is the index of this instance in the previous frame, splats first; -1: the background. ``now`` is the
    index of the instance that the pixel shows now. ``moved_to`` maps previous indices to current ones, or to
    ``UNMOVED`` or ``GONE``.
    """
    if before < 0:
        return False
    return moved_to[before] != wp.static(UNMOVED) and moved_to[before] != now


@wp.func
def no_position() -> wp.vec3:
    """Returns NaN coordinates, the position of a surface point that was not in the previous frame."""
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
    """Returns where a point that moves with Gaussian ``gaussian`` of instance ``number`` was in the previous frame.

    Positions are in world space; NaN: the instance is new.
    """
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
    """Returns where a point of mesh instance ``number`` was in the previous frame, world space; NaN: it is new.

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
    """Projects a point by a pinhole camera: returns x and y in pixels, and the distance from the eye to the point.

    ``position`` is in world space. Pixel centres are at +0.5. The distance is 0 for a point that is not in front of the
    near plane.
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
    """Returns a point's motion since the previous frame: x and y in pixels, z in distance from the eye.

    ``previous`` is the point's world-space position in the previous frame. The result is NaN if ``previous`` is NaN or
    was not visible.
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
def in_previous_image(pixel: wp.vec2, before: PreviousImage) -> wp.vec2:
    """Returns where the previous frame's images show what would be at ``pixel`` in images of this frame's size.

    Both positions are in pixels from the centre of the first pixel.
    """
    return wp.cw_mul(before.scale, pixel) + (before.shift + 0.5 * (before.scale - wp.vec2(1.0)))


@wp.func
def snapped(x: float) -> float:
    """Rounds a pixel coordinate to the nearest whole number if the two differ only by rounding errors."""
    return wp.where(wp.abs(x - wp.round(x)) < STILL, wp.round(x), x)


@wp.func
def least_cosine(extent: float) -> float:
    """Returns the cosine that two normals of one surface must at least have: lower for Gaussians (``extent`` > 0)."""
    return wp.where(extent > 0.0, NORMAL_SPLATS, NORMAL_MESH)


@wp.func
def tolerance(distance: float, extent: float, camera: wp.array[CameraData]) -> float:
    """Returns how far, in scene units, two points of one surface may lie from each other's tangent planes.

    It is a number of pixel widths at ``distance`` or, if larger, the Gaussian's scale ``extent``.
    """
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
    """Returns whether two points with normals may lie on one surface.

    Each must be at most ``tolerated`` scene units from the other's tangent plane, and the cosine between their normals
    at least ``cosine_min``.
    """
    if wp.dot(normal, other_normal) < cosine_min:
        return False
    offset = other_position - position
    across = wp.max(wp.abs(wp.dot(offset, normal)), wp.abs(wp.dot(offset, other_normal)))
    return across <= tolerated


# --- Highlights within a pixel and beside it (docs/method/realtime.md#highlights-in-pixels) ---

FOOTPRINT = wp.constant(wp.float32(FOOTPRINT_PX2))

FOOTPRINT_MAX = wp.constant(wp.float32(FOOTPRINT_ALPHA2_MAX))


@wp.func
def turn_per_offset(normal: wp.vec3, view: wp.vec3, distance: float) -> float:
    """Returns the turn of a distant light's half vector, radians per scene unit along a surface at this distance.

    ``view`` is the unit direction to the eye.
    """
    return 0.5 / (distance * wp.max(wp.dot(normal, view), 1e-3))


@wp.func
def half_turn(offset: wp.vec3, normal: wp.vec3, other: wp.vec3, view: wp.vec3, per_offset: float) -> wp.vec3:
    """Returns how far the normal turns away from the half vector of a distant light between two points, radians.

    At the first point, with unit ``normal`` and the unit direction ``view`` to the eye, the half vector of the light is
    the normal. The second, at ``offset``, has the normal ``other``. ``per_offset`` is that of ``turn_per_offset``.
    """
    across = offset - wp.dot(offset, view) * view
    return other - normal + per_offset * (across - wp.dot(across, normal) * normal)


@wp.func
def footprint_of(
    pixel: int, size: wp.vec2i, step: wp.vec2i, view: wp.vec3, surfaces: SurfacePixels, camera: wp.array[CameraData]
) -> float:
    """Returns the squared turn from a pixel to its neighbours by ``step`` and by ``-step``: the mean; 0 without any."""
    position = surfaces.position[pixel]
    normal = surfaces.normal[pixel]
    distance = surfaces.distance[pixel]
    extent = surfaces.extent[pixel]
    tolerated = tolerance(distance, extent, camera)
    total = float(0.0)
    count = float(0.0)
    for side in range(2):
        x = pixel % size[0] + (2 * side - 1) * step[0]
        y = pixel // size[0] + (2 * side - 1) * step[1]
        if x >= 0 and x < size[0] and y >= 0 and y < size[1]:
            other = y * size[0] + x
            if is_same_surface(position, normal, tolerated, least_cosine(extent), other, surfaces):
                offset = surfaces.position[other] - position
                per_offset = turn_per_offset(normal, view, distance)
                turned = half_turn(offset, normal, surfaces.normal[other], view, per_offset)
                total += wp.dot(turned, turned)
                count += 1.0
    return total / wp.max(count, 1.0)


@wp.func
def footprint_alpha2(pixel: int, size: wp.vec2i, surfaces: SurfacePixels, camera: wp.array[CameraData]) -> float:
    """Returns the squared GGX alpha of the normals within a pixel, relative to the half vector of a distant light."""
    view = (camera[0].eye - surfaces.position[pixel]) / surfaces.distance[pixel]
    across = footprint_of(pixel, size, wp.vec2i(1, 0), view, surfaces, camera)
    down = footprint_of(pixel, size, wp.vec2i(0, 1), view, surfaces, camera)
    return wp.min(FOOTPRINT * (across + down), FOOTPRINT_MAX)


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
"""Mean cosine to the normal of uniform illumination, weighted by the cosine."""


@wp.func
def left_by_layers(bsdf: Bsdf, cosine: float) -> float:
    """Returns the fraction of uniform illumination that clearcoat and sheen let through to the base.

    It is evaluated for light at its mean cosine, and a view at ``cosine``.
    """
    if not has_layers(bsdf):
        return 1.0
    return left_by_coat(bsdf, cosine, MEAN_COSINE) * left_by_sheen(bsdf, cosine, MEAN_COSINE)


@wp.func
def diffuse_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the fraction of uniform illumination that is reflected diffusely to a view at ``cosine``."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.diffuse)
    if bsdf.dielectric <= 0.0:
        return left_by_layers(bsdf, cosine) * bsdf.diffuse
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.diffuse


@wp.func
def base_highlight(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Returns the albedo of the GGX highlight without layers, for a view at ``cosine``; 0 for smooth surfaces."""
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
    """Returns the fraction of uniform illumination behind rough glass that the glass passes to a view at ``cosine``."""
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
    """Returns the fraction of uniform illumination that reaches a view at ``cosine``, at most 1.

    It includes transmission through rough glass, but not the mirror reflection of smooth surfaces.
    """
    albedo = diffuse_albedo(bsdf, cosine) + glossy_albedo(bsdf, cosine) + transmitted_albedo(bsdf, cosine)
    return wp.min(albedo, wp.vec3(1.0))
