"""Data of rays: cameras as rays leave them, rays, and what they meet. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.scene import struct


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

    origin: wp.array(dtype=wp.vec3)
    direction: wp.array(dtype=wp.vec3)
    t_min: wp.array(dtype=float)
    path_length: wp.array(dtype=float)
    t_max: wp.array(dtype=float)
    """Distance of the nearest mesh; inf: none; not above ``t_min``: there is no ray."""
    sample_key: wp.array(dtype=wp.uint32)
    """Key of the ray's random numbers."""
    pixel_key: wp.array(dtype=wp.uint32)
    """The same for what is spread evenly over the samples of a pixel, which share it."""


@struct
class RayMeshHits:
    """The nearest triangle on each ray."""

    face: wp.array(dtype=int)
    """First triangle of the mesh in MeshData plus the triangle's own number; -1: none."""
    instance: wp.array(dtype=int)
    """Among the mesh instances."""
    weights: wp.array(dtype=wp.vec2)
    """Barycentric weights of the second and third corner."""


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
class SmoothData:
    """How a material passes light on where it is smooth."""

    smooth: int
    """0: it does not, and shows its base colour."""
    metallic: float
    specular: float
    ior: float
    transmission: float


@struct
class MeshPlacement:
    """One placement of a mesh as rays meet it; in the order of the MeshInstanceData."""

    low: wp.vec3
    """Corner of a world-space box around it, with room for rounding."""
    high: wp.vec3
    object_from_world: wp.mat33
    """Linear part of the inverse."""
    world_from_object: wp.mat33
    """Linear part."""
    position: wp.vec3
    """The object's origin, world space."""
    tree: wp.uint64
    """Id of the bounding volume hierarchy of the mesh's triangles, object space."""
    face_first: int
    """First face in MeshData."""
    material: SmoothData


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
class RaySurface:
    """The surface that a ray's pixel shows, as SurfaceData."""

    depth: float
    normal: wp.vec3
    gaussian: int
    instance: int


@struct
class GaussianHits:
    """What the Gaussians before the nearest mesh give each ray."""

    color: wp.array(dtype=wp.vec3)
    """Premultiplied, display-referred sRGB."""
    normal: wp.array(dtype=wp.vec3)
    """Sum of unit normals, weighted as the colours are; world space."""
    transmittance: wp.array(dtype=float)
    depth: wp.array(dtype=float)
    """Distance of the surface; inf: not reached."""
    gaussian: wp.array(dtype=int)
    """Gaussian of the surface, among all of the scene's; where it is not reached, -2 - the first one; -1: none."""
    hits: wp.array(dtype=int)
    """How many were blended."""


@struct
class LensData:
    """A camera as rays leave it for one sample of each pixel. Lives in a 1-element array."""

    world_from_camera: wp.mat33
    """Rotation at the start of the first row."""
    eye: wp.vec3
    """World space, then."""
    shutter: int
    """1: the pose changes from row to row, as the next three say."""
    turn_axis: wp.vec3
    """World space, unit: what the camera turns about while the rows are exposed."""
    turn_angle: float
    """Until the end of the last row, radians."""
    motion: wp.vec3
    """Of the eye until then, world space."""
    focal: wp.vec2
    """Pixels; fisheye: per radian, orthographic: per scene unit."""
    center: wp.vec2
    """Principal point, pixels."""
    model: int
    """PINHOLE, FISHEYE or ORTHOGRAPHIC of ``lumisplat.device.camera.camera``."""
    width: int
    height: int
    near: float
    aperture: float
    """Radius of the lens; 0: none."""
    focus_distance: float
    offset: wp.vec2
    """Where in each pixel the sample lies, 0..1."""
    sample: int
    seed: wp.uint32
