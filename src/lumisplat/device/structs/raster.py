"""Structs of the rasteriser: projected splats, triangles, tiles, blending, and Gaussians rasterised along rays."""

import warp as wp

from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import SampleData
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData


@struct
class RasterData:
    """Settings of the rasteriser, in a 1-element array."""

    dilation: float
    """Variance added to projected covariances, pixel^2."""
    sh_degree: int
    """Highest SH degree that is evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    background: wp.vec3
    """Background colour, display-referred sRGB."""


@struct
class Splat:
    """A projected Gaussian, 64 bytes.

    Its alpha at a pixel centre p is ``min(0.99, exp(e))`` with

    e = log_opacity - along * (dx - shear * dy)^2 - across * dy^2,   (dx, dy) = p - center.

    This is the conic's quadratic form with the square completed in x. The form avoids cancellation for long thin
    ellipses and gives in closed form the span of an image row where e exceeds a threshold.
    """

    center: wp.vec2
    """Centre in the image, pixels."""
    along: float
    shear: float
    across: float
    log_opacity: float
    """Natural logarithm of the opacity; -inf marks a culled Gaussian."""
    extent: wp.vec2
    """Half sides of the box outside which alpha is below 1/255, pixels."""
    color: wp.vec3
    """Colour, display-referred sRGB, not negative."""
    depth: float
    """View depth of the mean."""
    normal: wp.vec3
    """Normal, world space, unit, towards the viewer."""
    index: int
    """Index of the Gaussian among all Gaussians of the scene."""


@struct
class TileRect:
    """Half-open rectangle of tiles, 8 bytes; empty for culled splats."""

    x0: wp.int16
    y0: wp.int16
    x1: wp.int16
    y1: wp.int16


@struct
class ChunkData:
    """Smallest and largest depth key of one chunk of splats, and its numbers of visible and of non-finite splats."""

    key_min: wp.uint32
    key_max: wp.uint32
    visible: int
    nonfinite: int


@struct
class MeshPixels:
    """Nearest mesh surface of each pixel; for the first hits of lit frames, kernels write only the depth."""

    depth_z: wp.array[float]
    """View depth; inf: no mesh."""
    color: wp.array[wp.vec3]
    """Colour, display-referred sRGB."""
    normal: wp.array[wp.vec3]
    """Normal, world space, unit, towards the viewer."""
    instance: wp.array[int]
    """Index of the mesh instance among all instances of the scene."""


@struct
class BlendState:
    """State of front-to-back blending of one pixel."""

    color: wp.vec3
    """Blended colour, premultiplied."""
    normal: wp.vec3
    """Weighted sum of unit normals."""
    transmittance: float
    """Transmittance so far; a negative value marks a finished pixel whose transmittance is the magnitude."""
    surface: int
    """Index of the Gaussian at which the iso-opacity surface is reached; -1: not reached."""
    first: int
    """Index of the first Gaussian blended; -1: none."""
    hits: int
    """Number of Gaussians blended."""


@struct
class RasterMeshes:
    """Mesh data that the rasteriser needs to evaluate the alpha of triangles that are not opaque."""

    instances: wp.array[MeshInstanceData]
    splat_instance_count: int
    """Number of splat instances: ``Triangle.instance`` starts at this number."""
    meshes: MeshData
    sample: wp.array[SampleData]


@struct
class Triangle:
    """A camera-space triangle set up for rays through pixel centres (Olano and Greer 1997), 64 bytes.

    A ray (x, y, 1) hits the triangle where the three ``edge . ray`` have the same sign (or are zero). The view depth
    there is ``plane / normal . ray``; the edge values over their sum are perspective-correct barycentric coordinates.
    Vertices may lie behind the camera.
    """

    edge0: wp.vec3
    """Cross product of the two vertices opposite vertex 0."""
    edge1: wp.vec3
    edge2: wp.vec3
    normal: wp.vec3
    """Normal in camera space, not normalised."""
    plane: float
    """Plane offset, ``normal . vertex``."""
    row_first: wp.uint16
    """First image row that the triangle may touch."""
    row_last: wp.uint16
    face: int
    instance: int


@struct
class RayRasterData:
    """Settings of the rasteriser that evaluates Gaussians along pixel rays, in a 1-element array."""

    dilation: float
    """Variance by which Gaussians without antialiasing are widened, in squared widths of a pixel at the Gaussian."""
    sh_degree: int
    """Highest SH degree that is evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    field: float
    """Tangent of the angle from a pinhole's axis beyond which the projection is extended linearly in the angle."""


@struct
class PixelBox:
    """Half-open rectangle of pixels; empty for culled Gaussians."""

    x0: int
    y0: int
    x1: int
    y1: int


@struct
class RaySplat:
    """A Gaussian prepared for evaluation along pixel rays, 104 bytes."""

    canonical_from_world: wp.mat33
    """Canonical transform of the Gaussian, widened by the footprint of a pixel."""
    eye: wp.vec3
    """Eye in canonical space; with a rolling shutter, at the start of the first row."""
    log_opacity: float
    """Natural logarithm of the opacity."""
    color: wp.vec3
    """Colour, display-referred sRGB, not negative."""
    depth: float
    """Depth by which splats are sorted, above 0."""
    normal: wp.vec3
    """Normal, world space, unit, towards the viewer."""
    index: int
    """Index of the Gaussian among all Gaussians of the scene."""
    box: PixelBox
    """Pixels outside of which alpha is below 1/255."""


@struct
class PixelRays:
    """Rays of pixels along which Gaussians are evaluated, and the distances at which they end."""

    rays: RayData
    limits: wp.array[float]
    """Distance along each ray beyond which Gaussians are ignored."""
