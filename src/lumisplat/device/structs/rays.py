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
    """Distance along the ray up to which hits are ignored."""
    path_length: float
    """Length of the path from the eye to the origin, over all bounces."""
    spread: float
    """Footprint width over path length: square root of the solid angle of the ray's pixel; 0: a ray without width."""


@struct
class RayData:
    """Rays as arrays, one element for each ray; fields as in ``Ray``."""

    is_active: wp.array[wp.bool]
    """True if the ray exists; if not, its other fields are undefined."""
    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    t_min: wp.array[float]
    t_max: wp.array[float]
    """Distance at which the ray ends; inf: unbounded. Shadow rays end at their light."""
    path_length: wp.array[float]
    spread: wp.array[float]
    normal: wp.array[wp.vec3]
    """Unit normal, on the ray's side, of the layer of flat Gaussians at which the ray starts.

    Gaussians of another layer count even before ``t_min``. Zero: no Gaussian counts before ``t_min``."""
    sample_key: wp.array[wp.uint32]
    """Key of the ray's random numbers."""
    pixel_key: wp.array[wp.uint32]
    """Key of the low-discrepancy sequences that all samples of a pixel share."""
    sample: wp.array[int]
    """Index of the ray's sample in the low-discrepancy sequences of ``pixel_key``, from 0."""


@struct
class MeshHits:
    """Nearest triangle hit by each ray."""

    t: wp.array[float]
    """Hit distance; the ray's ``t_max`` if it hits no mesh, and undefined if the ray does not exist."""
    face: wp.array[int]
    """Index of the triangle in MeshData (first triangle of the mesh plus its own index); -1: no hit."""
    instance: wp.array[int]
    """Index of the hit instance among the mesh instances."""
    weights: wp.array[wp.vec2]
    """Barycentric weights of the triangle's second and third corner at the hit."""


@struct
class GaussianHits:
    """Blended Gaussians in front of the nearest mesh, one element for each ray."""

    color: wp.array[wp.vec3]
    """Blended colour, premultiplied, display-referred sRGB."""
    normal: wp.array[wp.vec3]
    """Sum of the Gaussians' unit normals, weighted like their colours; world space."""
    transmittance: wp.array[float]
    depth: wp.array[float]
    """Distance of the iso-opacity surface; inf: not reached."""
    gaussian: wp.array[int]
    """Gaussian at the iso-opacity surface, else the first one blended, as an index over the whole scene; -1: none."""
    hits: wp.array[int]
    """Number of Gaussians blended."""
    relit_color: wp.array[wp.vec3]
    """Part of ``color`` that relit splat sets contribute.

    The three ``relit`` arrays are empty unless the scene has both relit splat sets and others."""
    relit_weight: wp.array[float]
    """Blending weight of the relit splat sets on the ray."""
    relit_gaussian: wp.array[int]
    """Gaussian at the iso-opacity surface if its splat set is relit, else the first relit Gaussian on the ray.

    The index is undefined if ``relit_weight`` is 0."""
    mean_depth: wp.array[float]
    """Weighted mean distance of the relit Gaussians on the ray; inf: the ray hits no relit Gaussian.

    The two ``mean`` arrays are empty unless surfaces are the weighted means of a ray's Gaussians."""
    mean_finish: wp.array[wp.vec2]
    """Weighted mean roughness and metallic of the relit Gaussians on the ray."""


@struct
class HitProfiles:
    """Gaussians hit by rays, listed one by one in blending order.

    Each array has one element for each hit, except ``first``. The struct lies in a 1-element array.
    """

    first: wp.array[int]
    """Index of each ray's first element, and at last the end of the last ray's elements: one entry more than rays."""
    t: wp.array[float]
    """Distance by which hits are ordered."""
    alpha: wp.array[float]
    transmittance: wp.array[float]
    """Transmittance behind the Gaussian."""
    gaussian: wp.array[int]
    """Index of the Gaussian among all Gaussians of the scene."""


RELIT_FIELDS = ("relit_color", "relit_weight", "relit_gaussian")
"""Fields of `GaussianHits` that scenes with both relit and other splat sets need."""

MEAN_FIELDS = ("mean_depth", "mean_finish")
"""Fields of `GaussianHits` for frames whose surfaces are the weighted means of a ray's Gaussians."""

EXTRA_FIELDS = RELIT_FIELDS + MEAN_FIELDS
"""Fields of `GaussianHits` that only some frames need."""


@struct
class Bounce:
    """Specular reflection and refraction of a ray at a surface."""

    color: wp.vec3
    """Contribution of the surface's own colour, without bounces: display-referred sRGB, or linear in lit frames."""
    reflected: wp.vec3
    """Weight of the reflected ray; zero: no reflected ray."""
    refracted: wp.vec3
    """Weight of the refracted ray; zero: no refracted ray."""
    normal: wp.vec3
    """Shading normal by which the ray is reflected and refracted; unit, on the ray's side."""
    side: wp.vec3
    """Geometric normal of the surface; unit, on the ray's side."""
    eta: float
    """Index of refraction on the ray's side over the index behind the surface, used for refraction."""
    media: wp.vec4i
    """Media that the arriving ray is inside of: mesh instance indices plus one, in the order of entry."""
    media_behind: wp.vec4i


@struct
class Boundary:
    """The interface between media that a mesh surface forms for a ray."""

    exists: bool
    """False: both sides are the same medium, and the ray continues straight."""
    eta: float
    """Index of refraction on the ray's side over the index behind the surface."""
    media: wp.vec4i
    """Media that the arriving ray is inside of: mesh instance indices plus one, in the order in which the ray entered
    them."""
    media_behind: wp.vec4i
    is_unentered: bool
    """True if the ray leaves a medium that it never entered."""


@struct
class FirstSurface:
    """First surface on a ray, of Gaussians or of a mesh; fields as in `PixelData`."""

    depth: float
    normal: wp.vec3
    gaussian: int
    instance: int
