"""Structs of rays and their hits: meshes, blended Gaussians, specular bounces and media."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class Ray:
    """One ray, world space."""

    origin: wp.vec3
    direction: wp.vec3
    """Direction, unit."""
    t_min: float
    """Distance along the ray below which hits are ignored."""
    path_length: float
    """Length of the path from the eye to the ray's origin, summed over all bounces, scene units."""
    spread: float
    """Width of the ray's footprint per unit of path length: the square root of its pixel's solid angle; 0: no width."""


@struct
class RayData:
    """Rays as arrays, one element for each ray; fields as in ``Ray``."""

    is_active: wp.array[wp.bool]
    """True if the ray exists; all other fields of an inactive ray are undefined."""
    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    t_min: wp.array[float]
    t_max: wp.array[float]
    """Distance along the ray at which it ends, such as a shadow ray's distance to its light; inf: the ray does not
    end."""
    path_length: wp.array[float]
    spread: wp.array[float]
    normal: wp.array[wp.vec3]
    """Unit normal, on the side to which the ray leaves, of the layer of flat Gaussians at which the ray starts.

    Gaussians that do not belong to this layer can be hit even before ``t_min``. Zero: no Gaussian is hit before
    ``t_min``."""
    sample_key: wp.array[wp.uint32]
    """Key from which the random numbers of the ray are derived; it differs from sample to sample."""
    pixel_key: wp.array[wp.uint32]
    """Key of the ray's low-discrepancy sequences; all samples of a pixel share it."""
    sample: wp.array[int]
    """Index of the ray's sample in the low-discrepancy sequences of ``pixel_key``, from 0."""


@struct
class MeshHits:
    """Nearest triangle hit by each ray."""

    t: wp.array[float]
    """Hit distance; the ray's ``t_max`` if it hits no mesh, and undefined if the ray does not exist."""
    face: wp.array[int]
    """Index of the hit triangle among all triangles of MeshData; -1: the ray hits no mesh."""
    instance: wp.array[int]
    """Index of the hit instance among the mesh instances."""
    weights: wp.array[wp.vec2]
    """Barycentric weights v and w of the triangle's second and third corner; the first corner has ``1 - v - w``."""


@struct
class GaussianHits:
    """Result of blending the Gaussians in front of the nearest mesh, one element for each ray."""

    color: wp.array[wp.vec3]
    """Blended colour, premultiplied, display-referred sRGB."""
    normal: wp.array[wp.vec3]
    """Sum of the Gaussians' unit normals, weighted like their colours; world space."""
    transmittance: wp.array[float]
    depth: wp.array[float]
    """Distance along the ray to the iso-opacity surface; inf: the opacity does not reach the threshold."""
    gaussian: wp.array[int]
    """Gaussian at the iso-opacity surface; the frontmost Gaussian if opacity stays lower; -1: no Gaussian.

    The index counts over all splat instances of the scene."""
    hits: wp.array[int]
    """Number of Gaussians that were blended on the ray."""
    relit_color: wp.array[wp.vec3]
    """Part of ``color`` that splat sets with a material lit by the scene (relit sets) contribute.

    The arrays ``relit_color``, ``relit_weight`` and ``relit_gaussian`` are empty unless the scene also has other splat
    sets."""
    relit_weight: wp.array[float]
    """Sum of the blending weights of those Gaussians on the ray that belong to relit splat sets."""
    relit_gaussian: wp.array[int]
    """Gaussian at the iso-opacity surface if it belongs to a relit splat set, else the ray's frontmost relit Gaussian.

    The index counts over all splat instances; it is undefined if ``relit_weight`` is 0."""
    mean_depth: wp.array[float]
    """Mean distance of the relit Gaussians on the ray, weighted like their colours; inf: no relit Gaussian is hit.

    ``mean_depth`` and ``mean_finish`` are empty unless shading uses such means instead of the iso-opacity surface."""
    mean_finish: wp.array[wp.vec2]
    """Mean roughness and mean metallic of the relit Gaussians on the ray, weighted like their colours."""


@struct
class HitProfiles:
    """Gaussians hit by rays, listed one by one in blending order.

    Each array has one element for each hit, except ``first``. The struct lies in a 1-element array.
    """

    first: wp.array[int]
    """Elements ``first[i]`` to ``first[i + 1] - 1`` of the other arrays are the hits of ray i.

    With n rays, ``first`` has n + 1 elements."""
    t: wp.array[float]
    """Hit distance along the ray, by which the hits are sorted from front to back."""
    alpha: wp.array[float]
    transmittance: wp.array[float]
    """Transmittance of the ray behind the hit Gaussian, including the Gaussian itself."""
    gaussian: wp.array[int]
    """Index of the hit Gaussian, counted over all splat instances of the scene."""


RELIT_FIELDS = ("relit_color", "relit_weight", "relit_gaussian")
"""Fields of `GaussianHits` that are filled only in scenes with both relit and other splat sets."""

MEAN_FIELDS = ("mean_depth", "mean_finish")
"""Fields of `GaussianHits` that are filled only if the lit surface is the weighted mean of a ray's Gaussians."""

EXTRA_FIELDS = RELIT_FIELDS + MEAN_FIELDS
"""Fields of `GaussianHits` that only some frames fill: RELIT_FIELDS and MEAN_FIELDS."""


@struct
class Bounce:
    """Specular reflection and refraction of a ray at a mesh surface: weights, normals and media of both new rays."""

    color: wp.vec3
    """Radiance of the surface itself, without reflection and refraction: linear, or display-referred sRGB in unlit
    frames."""
    reflected: wp.vec3
    """Weight of the reflected ray; zero: no reflected ray."""
    refracted: wp.vec3
    """Weight of the refracted ray; zero: no refracted ray."""
    normal: wp.vec3
    """Shading normal by which the ray is reflected and refracted; unit, on the ray's side."""
    side: wp.vec3
    """Unit normal of the hit triangle, on the side from which the ray arrives; new rays start on this or the opposite
    side."""
    eta: float
    """Index of refraction on the ray's side over the index behind the surface, used for refraction."""
    media: wp.vec4i
    """Media that the arriving ray is inside of: mesh instance indices plus one, in the order of entry."""
    media_behind: wp.vec4i


@struct
class Boundary:
    """Interface between two media where a ray hits a mesh: indices of refraction, and the media on both sides."""

    exists: bool
    """False: the same medium is on both sides, for example inside another mesh of higher priority.

    The ray then passes straight through."""
    eta: float
    """Index of refraction on the ray's side over the index behind the surface."""
    media: wp.vec4i
    """Media that the arriving ray is inside of, in the order of entry: mesh instance indices plus one."""
    media_behind: wp.vec4i
    is_unentered: bool
    """True if the ray leaves a mesh that is a medium without having entered it, as from a camera inside glass."""


@struct
class FirstSurface:
    """Depth, normal, Gaussian and instance of the first surface on a ray, splats or mesh; fields as in `PixelData`."""

    depth: float
    normal: wp.vec3
    gaussian: int
    instance: int
