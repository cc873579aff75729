"""Data of the rasteriser: splats, triangles, tiles and the blending of pixels; Gaussians that it sees along rays.

One struct is one noun of the method.
"""

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
    """Highest that is evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    background: wp.vec3
    """Display-referred sRGB."""


@struct
class Splat:
    """A projected Gaussian, 64 bytes.

    Its alpha at a pixel centre p is ``min(0.99, exp(e))`` with

    e = log_opacity - along * (dx - shear * dy)^2 - across * dy^2,   (dx, dy) = p - center.

    This is the conic's quadratic form with the square completed in x: no cancellation for long thin ellipses, and the
    span of an image row where e exceeds a threshold follows in closed form.
    """

    center: wp.vec2
    """Pixels."""
    along: float
    shear: float
    across: float
    log_opacity: float
    """Natural logarithm; -inf marks a culled Gaussian."""
    extent: wp.vec2
    """Half sides of the box outside which alpha is below 1/255, pixels."""
    color: wp.vec3
    """Display-referred sRGB, not negative."""
    depth: float
    """View depth of the mean."""
    normal: wp.vec3
    """World space, unit, towards the viewer."""
    index: int
    """Among all Gaussians of the scene."""


@struct
class TileRect:
    """Half-open rectangle of tiles, 8 bytes; empty for what is culled."""

    x0: wp.int16
    y0: wp.int16
    x1: wp.int16
    y1: wp.int16


@struct
class ChunkData:
    """Range and counts of one chunk of depth keys."""

    key_min: wp.uint32
    key_max: wp.uint32
    visible: int
    nonfinite: int


@struct
class MeshPixels:
    """The nearest mesh surface of each pixel. For primary hits, only the depth is written."""

    depth_z: wp.array[float]
    """View depth; inf: none."""
    color: wp.array[wp.vec3]
    """Display-referred sRGB."""
    normal: wp.array[wp.vec3]
    """World space, unit, towards the viewer."""
    instance: wp.array[int]
    """Among all instances of the scene."""


@struct
class BlendState:
    """Front-to-back blending of one pixel."""

    color: wp.vec3
    """Premultiplied."""
    normal: wp.vec3
    """Weighted sum of unit normals."""
    transmittance: float
    """Negative: finished, with this magnitude."""
    surface: int
    """Gaussian of the iso-opacity surface; -1: it is not reached."""
    first: int
    """The first Gaussian that was blended; -1: none."""
    hits: int
    """How many were blended."""


@struct
class RasterMeshes:
    """The meshes of the triangles that are rasterised, for those of some alpha."""

    instances: wp.array[MeshInstanceData]
    splat_instance_count: int
    """``Triangle.instance`` counts from there."""
    meshes: MeshData
    sample: wp.array[SampleData]


@struct
class Triangle:
    """A triangle in camera space, set up for the rays through pixel centres (Olano and Greer 1997), 64 bytes.

    For a ray (x, y, 1): inside where the three ``edge . ray`` have one sign, zero included; the view depth there is
    ``plane / normal . ray``, and the edge values over their sum are perspective-correct barycentric coordinates.
    Vertices may lie behind the camera.
    """

    edge0: wp.vec3
    """Cross product of the vertices opposite vertex 0."""
    edge1: wp.vec3
    edge2: wp.vec3
    normal: wp.vec3
    """Camera space, not normalised."""
    plane: float
    """``normal . vertex``."""
    row_first: wp.uint16
    """First image row that the triangle may touch."""
    row_last: wp.uint16
    face: int
    instance: int


@struct
class RayRasterData:
    """Settings of the rasteriser, in a 1-element array."""

    dilation: float
    """Variance added to Gaussians that are not antialiased, in squared widths of the pixel where they are."""
    sh_degree: int
    """Highest that is evaluated."""
    transmittance_min: float
    depth_iso_transmittance: float
    field: float
    """Of a pinhole: tangent of the angle from its axis up to which points are projected as they are."""


@struct
class PixelBox:
    """Half-open rectangle of pixels; empty for what is culled."""

    x0: int
    y0: int
    x1: int
    y1: int


@struct
class RaySplat:
    """A Gaussian as the rays of pixels meet it, 104 bytes."""

    canonical_from_world: wp.mat33
    """Widened by the footprint of a pixel."""
    eye: wp.vec3
    """Canonical; with a rolling shutter, at the start of the first row."""
    log_opacity: float
    """Natural logarithm."""
    color: wp.vec3
    """Display-referred sRGB, not negative."""
    depth: float
    """By which splats are ordered, above 0."""
    normal: wp.vec3
    """World space, unit, towards the viewer."""
    index: int
    """Among all Gaussians of the scene."""
    box: PixelBox
    """Outside of it, alpha is below 1/255."""


@struct
class PixelRays:
    """The rays along which pixels see Gaussians, and where they end."""

    rays: RayData
    limits: wp.array[float]
    """Distances up to which Gaussians count."""
