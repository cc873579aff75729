"""Data of rays: rays, and what they hit. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs import struct


@struct
class Ray:
    """One ray, world space."""

    origin: wp.vec3
    direction: wp.vec3
    """Unit."""
    t_min: float
    """Distance up to which hits do not count."""
    path_length: float
    """Length of the path from the eye to the origin, over all bounces."""
    spread: float
    """Width of the ray's footprint over the length of its path: the root of the solid angle of its pixel; 0: it
    has no width."""


@struct
class RayData:
    """Rays, one element each, as ``Ray``."""

    is_active: wp.array[wp.bool]
    """Whether there is a ray; if not, the other fields are undefined."""
    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    t_min: wp.array[float]
    t_max: wp.array[float]
    """Where the ray ends; inf: nowhere. Shadow rays end at their light."""
    path_length: wp.array[float]
    spread: wp.array[float]
    normal: wp.array[wp.vec3]
    """Of the layer of flat Gaussians that the ray leaves, unit, on its side: Gaussians of another layer count before
    ``t_min``, too. Zero: none do."""
    sample_key: wp.array[wp.uint32]
    """Key of the ray's random numbers."""
    pixel_key: wp.array[wp.uint32]
    """Key of the low-discrepancy sequences that the samples of a pixel share."""
    sample: wp.array[int]
    """Number of the ray's sample in these sequences, from 0."""


@struct
class MeshHits:
    """The nearest triangle on each ray."""

    t: wp.array[float]
    """Its distance; without a hit, the ray's ``t_max``, which is undefined if there is no ray."""
    face: wp.array[int]
    """First triangle of the mesh in MeshData plus the triangle's own number; -1: none."""
    instance: wp.array[int]
    """Among the mesh instances."""
    weights: wp.array[wp.vec2]
    """Barycentric weights of the second and third corner."""


@struct
class GaussianHits:
    """The Gaussians before the nearest mesh on each ray, blended."""

    color: wp.array[wp.vec3]
    """Premultiplied, display-referred sRGB."""
    normal: wp.array[wp.vec3]
    """Sum of unit normals, weighted as the colours are; world space."""
    transmittance: wp.array[float]
    depth: wp.array[float]
    """Distance of the iso-opacity surface; inf: it is not reached."""
    gaussian: wp.array[int]
    """Gaussian of the surface or, if it is not reached, the first one blended, among all of the scene's; -1: none."""
    hits: wp.array[int]
    """How many were blended."""
    relit_color: wp.array[wp.vec3]
    """The part of ``color`` of relit sets; like what follows without elements unless there are others as well."""
    relit_weight: wp.array[float]
    """Their share of the ray."""
    relit_gaussian: wp.array[int]
    """The surface's Gaussian if it is one of theirs, else the first of them; undefined if their share is 0."""
    mean_depth: wp.array[float]
    """Distance of the weighted-mean surface of relit sets; inf: none of them is there. Like what follows without
    elements unless surfaces are means."""
    mean_finish: wp.array[wp.vec2]
    """Its roughness and metallic."""


@struct
class HitProfiles:
    """The Gaussians on rays one by one, in the order in which they are blended; in a 1-element array.

    One element a hit, but for the first field.
    """

    first: wp.array[int]
    """Element of the first hit of each ray, and the end of the last one's; one element more than rays."""
    t: wp.array[float]
    """Distance by which hits are ordered."""
    alpha: wp.array[float]
    transmittance: wp.array[float]
    """Behind the Gaussian."""
    gaussian: wp.array[int]
    """Among all of the scene's."""


RELIT_FIELDS = ("relit_color", "relit_weight", "relit_gaussian")
"""Fields of `GaussianHits` for scenes with relit sets and others."""

MEAN_FIELDS = ("mean_depth", "mean_finish")
"""Fields of `GaussianHits` for surfaces that are means."""

EXTRA_FIELDS = RELIT_FIELDS + MEAN_FIELDS
"""Fields of `GaussianHits` that not all frames need."""


@struct
class Bounce:
    """Specular reflection and refraction of a ray at a surface."""

    color: wp.vec3
    """The surface's own share: display-referred sRGB, or linear in lit frames."""
    reflected: wp.vec3
    """Weight of the reflected ray; zero: there is none."""
    refracted: wp.vec3
    """Weight of the refracted ray; zero: there is none."""
    normal: wp.vec3
    """Shading normal, by which rays are reflected and refracted; unit, on the side of the ray."""
    side: wp.vec3
    """Geometric normal; unit, on the side of the ray."""
    eta: float
    """Index of refraction on the side of the ray over that behind the surface, by which it is refracted."""
    media: wp.vec4i
    """On the side of the ray, as ``Boundary``."""
    media_behind: wp.vec4i


@struct
class Boundary:
    """What the surface of a mesh is to a ray."""

    exists: bool
    """False: the same medium is on both sides, and the ray goes on straight."""
    eta: float
    """Index of refraction on the side of the ray over that behind the surface."""
    media: wp.vec4i
    """On the side of the ray: one more than the numbers of mesh instances, in the order in which they were entered."""
    media_behind: wp.vec4i
    is_unentered: bool
    """The ray leaves a medium that it has not entered."""


@struct
class FirstSurface:
    """The first surface on a ray, that of Gaussians or a mesh, as PixelData."""

    depth: float
    normal: wp.vec3
    gaussian: int
    instance: int
