"""Data of the scene: Gaussians, meshes, and their instances. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


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
class KernelData:
    """How Gaussians respond: what their bounds depend on."""

    degree: int
    """Exponent of the distance, 0 (linear) to 5."""
    falloff: float
    """a of the response exp(-a d^degree); the slope of the linear one."""
    min_response: float
    adaptive: int
    """1: ``min_response`` is meant of the response times the opacity."""


@struct
class SplatInstanceData:
    """One placement of a Gaussian asset: for the rasteriser, for rays and for shading."""

    camera_from_object: wp.mat33
    """Rotation and uniform scale."""
    camera_from_object_offset: wp.vec3
    object_from_world: wp.mat33
    """Rotation and uniform scale."""
    object_from_world_offset: wp.vec3
    world_from_object: wp.mat33
    """Rotation only."""
    scale: float
    """World from object."""
    eye: wp.vec3
    """The camera's centre of projection in object space."""
    first: int
    """Index of the instance's first Gaussian among all of the scene's."""
    asset: int
    """Among the scene's Gaussian assets."""
    kernel: KernelData
    antialiased: int
    """1: compensate opacity for the dilation (Mip-Splatting)."""
    sh_degree: int
    """Highest that the instance shows."""
    own_colors: int
    """1: Gaussians show their albedo."""
    own_normals: int
    """1: normals are those that the asset carries."""
    shadow_only: int
    """1: shadow rays that skip such instances pass through it."""


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
class SmoothData:
    """How a material passes light on where it is smooth."""

    smooth: int
    """0: it does not, and shows its base colour."""
    metallic: float
    specular: float
    ior: float
    transmission: float


@struct
class MeshInstanceData:
    """One placement of a mesh: for the rasteriser, for rays and for shading."""

    camera_from_object: wp.mat33
    """Linear part."""
    camera_from_object_offset: wp.vec3
    world_from_object: wp.mat33
    """Linear part."""
    world_from_object_normal: wp.mat33
    """Its inverse transpose, of any scale."""
    object_from_world: wp.mat33
    """Linear part of the inverse."""
    position: wp.vec3
    """The object's origin, world space."""
    low: wp.vec3
    """Corner of a world-space box around it, with room for rounding."""
    high: wp.vec3
    bvh: wp.uint64
    """Id of the bounding volume hierarchy of the mesh's triangles, object space; for rays only."""
    first: int
    """Index of the instance's first triangle among all of the scene's."""
    face_first: int
    """First face in MeshData."""
    has_normals: int
    base_color: wp.vec3
    """Linear."""
    texture_first: int
    texture_width: int
    """0: no texture."""
    texture_height: int
    material: SmoothData
