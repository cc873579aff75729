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
    """Variance that low-pass filtering adds to projected 2D covariances, pixel^2."""
    sh_degree: int
    """Highest SH degree, 0 to 3, at which the colours of splats are evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    background: wp.vec3
    """Colour behind the scene, display-referred sRGB."""


@struct
class Splat:
    """A projected Gaussian, 64 bytes.

    Its alpha at a pixel centre p is ``min(0.99, exp(e))`` with

    e = log_opacity - along * (dx - shear * dy)^2 - across * dy^2,   (dx, dy) = p - center.

    This is the conic's quadratic form with the square completed in x. The form avoids cancellation for long thin
    ellipses and gives in closed form the span of an image row where e exceeds a threshold.
    """

    center: wp.vec2
    """Projected mean of the Gaussian, pixels."""
    along: float
    shear: float
    across: float
    log_opacity: float
    """Natural logarithm of the opacity; -inf marks a culled Gaussian."""
    extent: wp.vec2
    """Half sides of the box outside which alpha is below 1/255, pixels."""
    color: wp.vec3
    """Colour of the Gaussian as the eye sees it, display-referred sRGB, not negative."""
    depth: float
    """View depth of the Gaussian's mean, by which splats are sorted."""
    normal: wp.vec3
    """Unit normal of the Gaussian, world space, towards the viewer."""
    index: int
    """Index of the splat's Gaussian, counted over all splat instances of the scene."""


@struct
class SplatEllipsoid:
    """The ellipsoid at which a rasterised Gaussian ends, where its alpha is 1/255, 52 bytes.

    Its canonical space is scaled: unit spheres have the radius of the Gaussian's smallest standard deviation. This
    keeps flat Gaussians inside float32.
    """

    canonical_from_world: wp.mat33
    """Linear map from world space to the space where the Gaussian, widened by a pixel's footprint, is a sphere."""
    eye: wp.vec3
    """Position of the eye in that space; with a rolling shutter, at the start of the first row."""
    reach2: float
    """Squared radius of the sphere at which the Gaussian ends; negative: pixels show the normal of its splat."""


@struct
class TileRect:
    """Half-open rectangle of image tiles that a splat may touch, 8 bytes; empty for culled splats."""

    x0: wp.int16
    y0: wp.int16
    x1: wp.int16
    y1: wp.int16


@struct
class ChunkData:
    """Smallest and largest depth key of one chunk of splats; numbers of its visible and of its non-finite splats."""

    key_min: wp.uint32
    key_max: wp.uint32
    visible: int
    nonfinite: int


@struct
class MeshPixels:
    """Nearest mesh surface of each pixel. Lit frames only need, and write, its depth."""

    depth_z: wp.array[float]
    """View depth of the nearest mesh at each pixel; inf: no mesh."""
    color: wp.array[wp.vec3]
    """Colour of the nearest mesh at each pixel, display-referred sRGB."""
    normal: wp.array[wp.vec3]
    """Unit normal of the nearest mesh at each pixel, world space, towards the viewer."""
    instance: wp.array[int]
    """Index of the nearest mesh's instance, numbered after all splat instances."""


@struct
class BlendState:
    """State of front-to-back blending of one pixel."""

    color: wp.vec3
    """Colour of the Gaussians blended so far, premultiplied, display-referred sRGB."""
    normal: wp.vec3
    """Sum of blending weight times unit normal over the Gaussians blended so far."""
    transmittance: float
    """Transmittance of the Gaussians blended so far; a finished pixel stores it negated, so that no more are blended.
    """
    surface: int
    """Index, over all splat instances, of the Gaussian at the iso-opacity surface; -1: the surface is not reached yet.
    """
    first: int
    """Index, over all splat instances, of the frontmost blended Gaussian; -1: none was blended yet."""
    hits: int
    """Number of Gaussians that the pixel has blended so far."""


@struct
class RasterMeshes:
    """Mesh data that the rasteriser needs to evaluate the alpha of triangles that are not opaque."""

    instances: wp.array[MeshInstanceData]
    splat_instance_count: int
    """Number of splat instances; ``Triangle.instance`` numbers mesh instances after them."""
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
    """Cross product of vertices 1 and 2, camera space; ``edge1``: of vertices 2 and 0; ``edge2``: of vertices 0 and 1.
    """
    edge1: wp.vec3
    edge2: wp.vec3
    normal: wp.vec3
    """Normal in camera space, not normalised."""
    plane: float
    """``dot(normal, vertex)`` for any vertex, camera space: the plane equation's constant."""
    row_first: wp.uint16
    """First image row that the triangle may touch."""
    row_last: wp.uint16
    face: int
    instance: int


@struct
class RayRasterData:
    """Settings of the rasteriser that evaluates Gaussians along pixel rays, in a 1-element array."""

    dilation: float
    """Variance by which Gaussians are widened, in units of the squared width of a pixel at the Gaussian's distance.

    Gaussians trained with antialiasing are not widened."""
    sh_degree: int
    """Highest SH degree, 0 to 3, at which the colours of splats are evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    field: float
    """Tangent of the off-axis angle up to which a pinhole projection is exact; farther out it is linear in the angle.
    """


@struct
class PixelBox:
    """Half-open rectangle of pixels; empty for culled Gaussians."""

    x0: int
    y0: int
    x1: int
    y1: int


@struct
class RaySplat:
    """A Gaussian prepared for evaluation along pixel rays, 108 bytes."""

    canonical_from_world: wp.mat33
    """Linear map from world space to the space where the Gaussian, widened by a pixel's footprint, is a unit sphere."""
    eye: wp.vec3
    """Position of the eye in the Gaussian's canonical space; with a rolling shutter, at the start of the first row."""
    log_opacity: float
    """Natural logarithm of the Gaussian's opacity."""
    color: wp.vec3
    """Colour of the Gaussian as the eye sees it, display-referred sRGB, not negative."""
    depth: float
    """Depth by which splats are sorted, above 0: view depth of the mean or, for a fisheye, its distance from the eye.
    """
    normal: wp.vec3
    """Unit normal of the Gaussian, world space, towards the viewer."""
    index: int
    """Index of the Gaussian, counted over all splat instances of the scene."""
    iso: float
    """Transmittance at the surface of the Gaussian's instance."""
    box: PixelBox
    """Rectangle of pixels outside which the Gaussian's alpha is below 1/255."""


@struct
class PixelRays:
    """Rays of pixels along which Gaussians are evaluated, and the distances at which they end."""

    rays: RayData
    limits: wp.array[float]
    """Distance along each pixel's ray at which the nearest mesh, if any, hides all Gaussians behind it."""
