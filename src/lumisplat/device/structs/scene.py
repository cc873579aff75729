"""Data that kernels exchange. One struct is one noun of the method."""

from typing import TYPE_CHECKING, TypeVar

import warp as wp

if TYPE_CHECKING:
    Noun = TypeVar("Noun")

    def struct(noun: type[Noun]) -> type[Noun]:
        """Type checkers see a plain class, which is how host code uses it."""
        return noun
else:
    struct = wp.struct


@struct
class CameraData:
    """A pinhole camera and the settings of a frame. Lives in a 1-element array, so that captured graphs see changes."""

    world_from_camera: wp.mat33
    """Rotation."""
    eye: wp.vec3
    """Centre of projection, world space."""
    focal: wp.vec2
    """Pixels."""
    center: wp.vec2
    """Principal point, pixels."""
    jacobian_min: wp.vec2
    """Lowest x/z and y/z at which the projection is linearised."""
    jacobian_max: wp.vec2
    """Highest x/z and y/z at which the projection is linearised."""
    width: int
    height: int
    tiles_x: int
    tiles_y: int
    near: float
    dilation: float
    """Variance added to projected covariances, pixel^2."""
    transmittance_min: float
    depth_iso_transmittance: float
    background: wp.vec3
    """Display-referred sRGB."""


@struct
class GaussianData:
    """A Gaussian asset on the device, in its own space."""

    means: wp.array(dtype=wp.vec3)
    rotations: wp.array(dtype=wp.quat)
    """Object from Gaussian."""
    scales: wp.array(dtype=wp.vec3)
    """Standard deviations."""
    opacities: wp.array(dtype=float)
    sh: wp.array(dtype=wp.vec3)
    """Coefficients, ``sh_count`` consecutive ones a Gaussian."""
    sh_count: int
    normals: wp.array(dtype=wp.vec3)
    """That the asset carries; without elements: none."""
    albedo: wp.array(dtype=wp.vec3)
    """Display-referred; without elements: none."""


@struct
class InstanceData:
    """One placement of an asset as a frame sees it."""

    camera_from_object: wp.mat33
    """Rotation and uniform scale."""
    camera_from_object_offset: wp.vec3
    world_from_object: wp.mat33
    """Rotation only."""
    eye: wp.vec3
    """Centre of projection in object space."""
    first: int
    """Index of the instance's first Gaussian among all of the scene's."""
    antialiased: int
    """1: compensate opacity for the dilation (Mip-Splatting)."""
    sh_degree: int
    """Highest that is evaluated."""
    own_colors: int
    """1: Gaussians show their albedo."""
    own_normals: int
    """1: normals are those that the asset carries."""


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
    """What one chunk of depth keys holds."""

    key_min: wp.uint32
    key_max: wp.uint32
    visible: int
    nonfinite: int


@struct
class PixelData:
    """What primary visibility finds, one element a pixel: the seam between it and everything that shades."""

    color: wp.array(dtype=wp.vec3)
    """Radiance over the background, display-referred sRGB while unlit."""
    alpha: wp.array(dtype=float)
    """1 - transmittance; 1 where a mesh ends the pixel."""
    depth: wp.array(dtype=float)
    """Distance along the pixel's ray to the iso-opacity surface, scene units; inf: none."""
    normal: wp.array(dtype=wp.vec3)
    """World space, unit, towards the viewer; zero where there is nothing."""
    gaussian: wp.array(dtype=int)
    """Index of the surface's Gaussian in its own instance; -1: none."""
    instance: wp.array(dtype=int)
    """Splat instances first, then mesh instances; -1: none."""


@struct
class MeshHits:
    """The nearest mesh surface, one element a pixel."""

    depth_z: wp.array(dtype=float)
    """View depth; inf: none."""
    color: wp.array(dtype=wp.vec3)
    """Display-referred sRGB."""
    normal: wp.array(dtype=wp.vec3)
    """World space, unit, towards the viewer."""
    instance: wp.array(dtype=int)
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
    splat: int
    """Splat of the iso-opacity surface; where it is not reached, -2 - the first splat; -1: there is none."""
    hits: int
    """How many were blended."""


@struct
class MeshData:
    """All meshes of a scene, end to end, each in its own space."""

    positions: wp.array(dtype=wp.vec3)
    normals: wp.array(dtype=wp.vec3)
    uvs: wp.array(dtype=wp.vec2)
    colors: wp.array(dtype=wp.vec3)
    """Linear."""
    indices: wp.array(dtype=wp.vec3i)
    """Into the arrays above, over all meshes."""
    texels: wp.array(dtype=wp.uint32)
    """RGBA8, sRGB-encoded, all textures end to end."""
    linear_from_byte: wp.array(dtype=float)
    """sRGB decoding table, 256 entries."""
    unit_from_byte: wp.array(dtype=float)
    """Bytes over 255."""


@struct
class MeshInstanceData:
    """One placement of a mesh as a frame sees it."""

    camera_from_object: wp.mat33
    camera_from_object_offset: wp.vec3
    world_from_object_normal: wp.mat33
    """Inverse transpose of the linear part."""
    base_color: wp.vec3
    """Linear."""
    face_first: int
    """First face in MeshData."""
    first: int
    """Index of the instance's first triangle among all of the scene's."""
    has_normals: int
    texture_first: int
    texture_width: int
    """0: no texture."""
    texture_height: int


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
