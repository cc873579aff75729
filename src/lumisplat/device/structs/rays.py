"""Data of rays: rays, and what they hit. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class Ray:
    """One ray, world space."""

    origin: wp.vec3
    direction: wp.vec3
    """Unit."""
    t_min: float
    """What is hit no farther than this does not count."""
    path_length: float
    """Length of the path before the origin: the eye, unfolded, is this far behind it."""


@struct
class RayData:
    """Rays, one element each, as ``Ray``."""

    is_active: wp.array(dtype=wp.bool)
    """Whether there is a ray; where there is none, the other fields are undefined."""
    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=float)
    t_max: wp.array(dtype=float)
    """Where the ray ends; inf: nowhere. Shadow rays end at their light."""
    path_length: wp.array(dtype=float)
    sample_key: wp.array(dtype=wp.uint32)
    """Key of the ray's random numbers."""
    pixel_key: wp.array(dtype=wp.uint32)
    """The same for what is spread evenly over the samples of a pixel, which share it."""


@struct
class MeshHits:
    """The nearest triangle on each ray."""

    t: wp.array(dtype=float)
    """Its distance; where there is none, where the ray ends. Not above ``t_min`` where there is no ray."""
    face: wp.array(dtype=int)
    """First triangle of the mesh in MeshData plus the triangle's own number; -1: none."""
    instance: wp.array(dtype=int)
    """Among the mesh instances."""
    weights: wp.array(dtype=wp.vec2)
    """Barycentric weights of the second and third corner."""


@struct
class GaussianHits:
    """What the Gaussians before the nearest mesh give each ray."""

    color: wp.array(dtype=wp.vec3)
    """Premultiplied, display-referred sRGB."""
    normal: wp.array(dtype=wp.vec3)
    """Sum of unit normals, weighted as the colours are; world space."""
    transmittance: wp.array(dtype=float)
    depth: wp.array(dtype=float)
    """Distance of the iso-opacity surface; inf: it is not reached."""
    gaussian: wp.array(dtype=int)
    """Gaussian of the surface, among all of the scene's; where it is not reached, the first one blended; -1: none."""
    hits: wp.array(dtype=int)
    """How many were blended."""


@struct
class RayShear:
    """How to shear corners so that a ray becomes an axis (Woop, Benthin and Wald 2013)."""

    axis: int
    """Largest component of the direction."""
    slope: wp.vec2
    """The two other components, after it in cyclic order, per unit of it."""
    inverse: float
    """Ray parameter per unit along the axis."""


@struct
class MeshRay:
    """A ray in the space of an instance's mesh; distances along it stay the world's."""

    origin: wp.vec3
    direction: wp.vec3
    """Of any length."""
    shear: RayShear
    begin: float
    """How far its origin is from the world-space ray's."""


@struct
class TriangleHit:
    """Where a ray meets a triangle."""

    t: float
    """inf: nowhere."""
    weights: wp.vec2
    """Barycentric weights of the second and third corner."""


@struct
class Bounce:
    """What a surface does with a ray that meets it."""

    color: wp.vec3
    """What it shows of itself, display-referred sRGB."""
    reflected: wp.vec3
    """Weight of what the reflected ray sees; zero: there is none."""
    refracted: wp.vec3
    normal: wp.vec3
    """Unit, on the side of the ray; what reflection and refraction go by."""
    side: wp.vec3
    """The same of the triangle itself."""
    eta: float
    """Index of refraction on the side of the ray over that behind the surface."""


@struct
class FirstSurface:
    """The first surface on a ray, that of Gaussians or a mesh, as PixelData."""

    depth: float
    normal: wp.vec3
    gaussian: int
    instance: int
