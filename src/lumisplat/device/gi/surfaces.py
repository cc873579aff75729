"""Surfaces that pixels show in real time: their data, where they were in the frame before, and their albedo."""

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
"""Two points are on one surface if neither is farther from the other's plane than this many pixels are wide there;
GI-1.1's size of a tile."""

SAME_NORMAL_MESH = 0.9
"""Least cosine between the normals of one mesh surface in two frames: what turns faster loses its history."""

SAME_NORMAL_SPLATS = 0.5
"""The same of Gaussians, whose normals are noisy."""

YOUNG_SHARE = 0.5
"""Share of its rays so far for which a young mean counts when one more is added: what is found later has bounced more
often, and is nearer to the truth. The variance is a third higher than that of plain means."""


@struct
class SurfacePixels:
    """The surfaces of one kind, Gaussians' or meshes', that the pixels of a frame show: its G-buffer.

    One element a pixel, row by row.
    """

    share: wp.array[float]
    """How much of the pixel they are, 0..1; 0: there is none, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World space."""
    normal: wp.array[wp.vec3]
    """Shading normal, unit, towards the viewer."""
    distance: wp.array[float]
    """From the eye, scene units."""
    extent: wp.array[float]
    """How far the surface may be from where it is said to be, scene units: the largest scale of its Gaussian; 0 for
    meshes."""
    albedo: wp.array[wp.vec3]
    """Share of even light that it reflects diffusely to the viewer, linear."""
    glossy_albedo: wp.array[wp.vec3]
    """Share that its highlight reflects."""
    alpha: wp.array[float]
    """Width of the highlight, as of ``Bsdf``."""
    previous: wp.array[wp.vec3]
    """Where the point of the surface was in the frame before, world space; NaN: it was not there."""


@struct
class InstanceMotion:
    """Where an instance was in the frame before: one a splat or mesh instance, in the order of the scene's."""

    existed: int
    """0: it was not there."""
    deforms: int
    """1: its Gaussians or vertices have moved on their own."""
    before_from_now: wp.mat33
    """Where points of the world that move with it were; linear part."""
    before_from_now_offset: wp.vec3
    before_from_object: wp.mat33
    """World of the frame before from object; linear part."""
    before_from_object_offset: wp.vec3
    means: wp.array[wp.vec3]
    """Those of its Gaussians then, object space; like the next two without elements unless it deforms."""
    rotations: wp.array[wp.quat]
    positions: wp.array[wp.vec3]
    """Those of the vertices then, where ``MeshData`` has those of now."""


@struct
class PixelLight:
    """One light sample a ray of the first wave, for one of its two surfaces."""

    slot: wp.array[int]
    """Which of the ray's interactions it lights: 0, Gaussians, or 1, a mesh; -1: neither."""
    diffuse: wp.array[wp.vec3]
    """Unshadowed radiance that the surface, as if it were all of the pixel, reflects diffusely; linear."""
    glossy: wp.array[wp.vec3]
    """The rest of what it reflects."""


@struct
class SurfaceLight:
    """What surfaces of one kind receive and reflect, one element a pixel, row by row."""

    is_sampled: wp.array[wp.bool]
    """Whether there is a sample in this frame; if not, the other fields are undefined."""
    diffuse: wp.array[wp.vec3]
    """Diffusely reflected radiance over the albedo, linear."""
    glossy: wp.array[wp.vec3]
    """Radiance reflected otherwise, linear."""


@struct
class LightHistory:
    """Light of surfaces of one kind as means over frames, one element a pixel, row by row.

    Each surface has two values, diffuse and glossy as ``SurfaceLight``: moments are those of two luminances.
    """

    frames: wp.array[float]
    """In the means; 0: there is no history."""
    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    moments: wp.array[wp.vec4]
    """Means of the luminance and of its square; diffuse, then glossy."""


@struct
class FilteredLight:
    """Light of surfaces of one kind as means over pixels, one element a pixel, row by row."""

    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    variance: wp.array[wp.vec2]
    """Of the luminance of each."""


@struct
class TemporalPixels:
    """What the pixels of a frame show, before and while it is averaged with the frames before; row by row."""

    color: wp.array[wp.vec3]
    """Linear radiance."""
    motion: wp.array[wp.vec3]
    """In pixels, of the surface that ends the pixel or of the background, and its distance; NaN: it was not there."""
    instance: wp.array[int]
    """Of that surface, as ``FirstSurface``; -1: the background."""
    previous_pixel: wp.array[wp.vec2]
    """Where the pixel was in the frame before, in pixels from the centre of the first."""
    weight: wp.array[float]
    """Of this frame in the mean, 0..1; 1: there is no history."""


@struct
class TemporalHistory:
    """What pixels have shown as means over frames, one element a pixel, row by row."""

    frames: wp.array[float]
    """In the mean; 0: there is no history."""
    color: wp.array[wp.vec3]
    """Linear radiance."""
    sample: wp.array[float]
    """Luminance of the last frame's sample."""
    change: wp.array[float]
    """Mean of the squared differences between the luminances of successive samples."""
    instance: wp.array[int]
    """Of the nearest surface that the 3 x 3 pixels around showed in the last frame, as ``FirstSurface``; -1: none."""


# --- Turns of pixels (``RealtimeConfig.light_interval``), and means of what depends on other means ---

BLOCK = wp.constant(RAY_BLOCK_PX)


@wp.func
def is_sampled_in_frame(x: int, y: int, interval: int, frame: int) -> bool:
    """Whether a pixel has samples in this frame: all have in the first one, then every ``interval``-th block."""
    return frame == 0 or (x // BLOCK + y // BLOCK + frame) % interval == 0


SHARE = wp.constant(wp.float32(YOUNG_SHARE))


@wp.func
def mean_weight(count: float, history: float) -> float:
    """For how many samples a mean of ``count`` counts when one more is added; less than all of them while it is young.

    ``history``: samples that a mean goes back.
    """
    if count < history:
        return SHARE * count
    return history - 1.0


# --- Motion (docs/method/realtime.md#motion) ---

UNMOVED = -1
"""In place of the number of an instance: it is where it was."""

GONE = -2
"""It is not there any more."""


@wp.func
def has_left(before: int, now: int, moved_to: wp.array[int]) -> bool:
    """Whether an instance that a pixel showed has moved, and is not the one that it shows now.

    ``before`` is its number in the frame before, splats first; -1: the background. ``moved_to`` has, by these numbers,
    those in this frame of what has moved, ``STANDS`` or ``GONE``.
    """
    if before < 0:
        return False
    return moved_to[before] != wp.static(UNMOVED) and moved_to[before] != now


@wp.func
def no_position() -> wp.vec3:
    """In place of a position: the surface is new."""
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
    """Where a point was that moves with a Gaussian.

    ``number``: the Gaussian's instance, whose asset has it.
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
    """Where a point of a mesh was.

    ``face`` counts among those of all meshes, ``weights`` are barycentric, of its second and third corner.
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
    """Where a pinhole camera showed a point: x and y in pixels, centres at +0.5, and its distance; 0: nowhere."""
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
    """How a point has moved as the camera shows it: x and y in pixels, and its distance; NaN: it was not there.

    Each is that of now minus that of the frame before.

    ``previous``: where the point was then; NaN: nowhere.
    """
    if wp.isnan(previous[0]):
        return no_position()
    before = pixel_before(previous, camera_before)
    if before[2] <= 0.0:
        return no_position()
    return pixel_before(position, camera) - before


# --- Reprojection: which pixels of the frame before show the same surface (docs/method/realtime.md#reprojection) ---

SURFACE_PX = wp.constant(wp.float32(SAME_SURFACE_PX))

NORMAL_MESH = wp.constant(wp.float32(SAME_NORMAL_MESH))

NORMAL_SPLATS = wp.constant(wp.float32(SAME_NORMAL_SPLATS))

STILL = wp.constant(wp.float32(STILL_PX))


@wp.func
def snapped(x: float) -> float:
    """A coordinate in pixels; that of the pixel's centre, if it is there but for rounding."""
    return wp.where(wp.abs(x - wp.round(x)) < STILL, wp.round(x), x)


@wp.func
def least_cosine(extent: float) -> float:
    """Between the normals of one surface; ``extent`` is above 0 for Gaussians."""
    return wp.where(extent > 0.0, NORMAL_SPLATS, NORMAL_MESH)


@wp.func
def tolerance(distance: float, extent: float, camera: wp.array[CameraData]) -> float:
    """How far points of one surface may be from each other's planes, scene units."""
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
    """Whether two points with normals are on one surface.

    ``tolerated``: distance between each and the plane of the other, scene units.
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
    """Whether a point with a normal is on the surface that a pixel shows: as `is_near`, with that of its image."""
    if surfaces.share[pixel] <= 0.0:
        return False
    return is_near(position, normal, tolerated, cosine_min, surfaces.position[pixel], surfaces.normal[pixel])


# --- Albedo: the share of a constant environment's light that is reflected (docs/method/realtime.md#surfaces) ---

MEAN_COSINE = wp.constant(wp.float32(2.0 / 3.0))
"""Of even light, weighted by the cosine."""


@wp.func
def left_by_layers(bsdf: Bsdf, cosine: float) -> float:
    """Share of even light that layers leave to what is below, as if all of it came at its mean cosine."""
    if not has_layers(bsdf):
        return 1.0
    return left_by_coat(bsdf, cosine, MEAN_COSINE) * left_by_sheen(bsdf, cosine, MEAN_COSINE)


@wp.func
def diffuse_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that the diffuse part reflects to a view at that cosine."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.cw_mul(simple_scale(bsdf), bsdf.diffuse)
    if bsdf.dielectric <= 0.0:
        return left_by_layers(bsdf, cosine) * bsdf.diffuse
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.diffuse


@wp.func
def base_highlight(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that the highlight below layers reflects; a smooth surface, which has none, 0."""
    if bsdf.alpha <= 0.0 or bsdf.grazing <= 0.0:
        return wp.vec3(0.0)
    return view_albedo(bsdf, cosine) + lost_share(cosine, bsdf.alpha) * bsdf.rescattered


@wp.func
def glossy_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of a white sky that all but the diffuse part reflects, except what smooth surfaces mirror."""
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
    """Share of a white sky behind a rough surface that comes through to a view."""
    if bsdf.model == BSDF_SIMPLE or not transmits(bsdf):
        return wp.vec3(0.0)
    return left_by_layers(bsdf, cosine) * (1.0 - mirrored_share(bsdf, cosine)) * bsdf.transmitted


@wp.func
def highlight_width(bsdf: Bsdf) -> float:
    """Width of the highlight, as alpha of GGX; that of Phong's exponent by Walter et al. 2007."""
    if bsdf.model == BSDF_SIMPLE:
        return wp.sqrt(2.0 / (bsdf.shininess + 2.0))
    return bsdf.alpha


@wp.func
def matte_albedo(bsdf: Bsdf, cosine: float) -> wp.vec3:
    """Share of light from all around that a surface sends to a view, by reflection or through it, at most 1."""
    albedo = diffuse_albedo(bsdf, cosine) + glossy_albedo(bsdf, cosine) + transmitted_albedo(bsdf, cosine)
    return wp.min(albedo, wp.vec3(1.0))
