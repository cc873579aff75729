"""Structs of the scene: Gaussian assets, meshes, and their instances."""

import warp as wp

from lumisplat.device.structs import struct

WRAP_REPEAT: int = wp.constant(0)
WRAP_MIRROR: int = wp.constant(1)
WRAP_CLAMP: int = wp.constant(2)

ALPHA_OPAQUE: int = wp.constant(0)
ALPHA_MASK: int = wp.constant(1)
ALPHA_BLEND: int = wp.constant(2)


@struct
class GaussianData:
    """A Gaussian asset on the device, in object space."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """Rotation from the Gaussian's axes to object space."""
    scales: wp.array[wp.vec3]
    """Standard deviations along the Gaussian's axes."""
    opacities: wp.array[float]
    sh: wp.array[wp.vec3]
    """SH coefficients, ``sh_count`` consecutive elements for each Gaussian."""
    sh_count: int
    normals: wp.array[wp.vec3]
    """Normals stored in the asset; empty: the asset has none."""
    albedo: wp.array[wp.vec3]
    """Display-referred albedo; empty: the asset has none."""


@struct
class KernelData:
    """Kernel function of Gaussians: the response by canonical distance, which also determines their bounds."""

    degree: int
    """Exponent of the distance, 0 (linear kernel) to 5."""
    falloff: float
    """Coefficient a of the response exp(-a d^degree), or the slope of the linear kernel."""
    min_response: float
    adaptive: int
    """1: a Gaussian ends where response times opacity falls to ``min_response``; 0: where the response alone does."""


@struct
class SplatInstanceData:
    """One instance of a Gaussian asset: the data that rasteriser, ray tracer and shading need."""

    camera_from_object: wp.mat33
    """Linear part of the transform from object to camera space: rotation times uniform scale."""
    camera_from_object_offset: wp.vec3
    object_from_world: wp.mat33
    """Linear part of the transform from world to object space: rotation times uniform scale."""
    object_from_world_offset: wp.vec3
    world_from_object: wp.mat33
    """Rotation from object to world space, without the scale."""
    scale: float
    """Uniform scale from object to world space."""
    eye: wp.vec3
    """Camera's centre of projection in object space."""
    first: int
    """Index of the instance's first Gaussian among all Gaussians of the scene."""
    asset: int
    """Index of the instance's asset among the scene's Gaussian assets."""
    kernel: KernelData
    antialiased: int
    """1: the opacity is reduced to compensate for the dilation of the projected Gaussian (Mip-Splatting)."""
    footprint: float
    """Standard deviation by which rays widen Gaussians, in pixel widths; 0: no widening."""
    hit_distance: int
    """HIT_PEAK, HIT_HULL or HIT_MEAN: the distance at which rays hit the Gaussians."""
    sh_degree: int
    """Highest SH degree that is evaluated."""
    shows_albedo: int
    """1: Gaussians show their albedo instead of their SH colour."""
    stored_normals: int
    """1: use the normals stored in the asset."""
    shadow_catcher: int
    """1: the instance is a shadow catcher; shadow rays that start at a shadow catcher pass it unattenuated."""
    relit: int
    """1: the instance is fully relit and shows none of its captured colour."""


@struct
class TextureData:
    """Location of a texture in the texel array of MeshData."""

    first: int
    width: int
    """Width in texels; 0: there is no texture."""
    height: int
    wrap_u: int
    """WRAP_REPEAT, WRAP_MIRROR or WRAP_CLAMP."""
    wrap_v: int


@struct
class VariedData:
    """Transmission, clearcoat and sheen of a material that has a texture for any of them: constants and textures."""

    transmission: float
    transmission_texture: TextureData
    coat: float
    coat_texture: TextureData
    coat_roughness: float
    coat_roughness_texture: TextureData
    sheen: wp.vec3
    sheen_texture: TextureData
    sheen_roughness: float
    sheen_roughness_texture: TextureData
    sheen_curve: wp.vec4


@struct
class MeshData:
    """Meshes of a scene in concatenated arrays, each mesh in its own object space."""

    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    uvs: wp.array[wp.vec2]
    colors: wp.array[wp.vec3]
    """Vertex colours, linear."""
    indices: wp.array[wp.vec3i]
    """Vertex indices of the triangles of all meshes, into the vertex arrays ``positions`` to ``colors``."""
    texels: wp.array[wp.uint32]
    """RGBA8 texels of all textures one after another: sRGB-encoded colours, linear data."""
    linear_from_byte: wp.array[float]
    """Decoding table from sRGB bytes to linear values, 256 entries."""
    unit_from_byte: wp.array[float]
    """Decoding table from bytes to byte / 255, 256 entries."""
    varied: wp.array[VariedData]
    """Textured transmission, clearcoat and sheen, one element for each material that has them; element 0 is unused."""
    sheen_curves: wp.array[wp.vec4]
    """Table of sheen albedo coefficients by roughness; empty: no texture varies the roughness of a sheen."""


@struct
class AlphaData:
    """Alpha of a mesh's material."""

    mode: int
    """ALPHA_OPAQUE, ALPHA_MASK or ALPHA_BLEND."""
    factor: float
    """Constant factor by which the alpha of the texture is multiplied."""
    cutoff: float
    """Smallest alpha that counts as opaque with ALPHA_MASK."""
    is_drawn: int
    """1: alpha is the probability that a ray or pixel hits the surface.

    0: every ray hits the surface, and the fraction 1 - alpha continues behind it."""
    is_bent: int
    """1: path rays continue behind the surface as through glass.

    Shadow rays that glass blocks then end at the surface whatever its alpha is, because the continuing path rays find
    the light behind the surface."""


@struct
class SmoothData:
    """Specular reflection and transmission of a material."""

    smooth: int
    """0: the material neither reflects nor transmits specularly, and the surface shows its base colour."""
    metallic: float
    specular: float
    ior: float
    transmission: float
    is_medium: int
    """1: refracted rays enter the inside of the mesh."""
    thin_walled: int
    """1: a wall without an inside, through which rays pass straight."""
    priority: int
    """Priority of the medium inside the mesh where several media overlap."""
    absorption: wp.vec3
    """Absorption coefficient of the medium inside, linear, per scene unit."""
    coat: float
    """Strength of the clearcoat layer."""
    coat_alpha: float
    sheen: float
    """Largest channel of the sheen colour."""
    sheen_curve: wp.vec4
    varied: int
    """Index into MeshData.varied; 0: no texture varies transmission, clearcoat or sheen."""


@struct
class MeshInstanceData:
    """One instance of a mesh: the data that rasteriser, ray tracer and shading need."""

    camera_from_object: wp.mat33
    """Linear part of the transform from object to camera space."""
    camera_from_object_offset: wp.vec3
    world_from_object: wp.mat33
    """Linear part of the transform from object to world space."""
    world_from_object_normal: wp.mat33
    """Inverse transpose of ``world_from_object``, up to scale; transforms normals."""
    object_from_world: wp.mat33
    """Inverse of ``world_from_object``."""
    position: wp.vec3
    """Object origin in world space."""
    low: wp.vec3
    """Lower corner of a world-space bounding box with a margin for rounding."""
    high: wp.vec3
    asset: int
    """Index of the TriangleBvh that holds the mesh's triangles.

    Only rays use ``asset``, ``root`` and the other fields of this struct that follow."""
    root: int
    """Root node of the mesh's tree in TriangleBvh ``asset``."""
    first: int
    """Index of the instance's first triangle among all triangles of the scene."""
    face_first: int
    """Index of the mesh's first face in MeshData."""
    has_normals: int
    base_color: wp.vec3
    """Base colour factor, linear."""
    texture: TextureData
    alpha: AlphaData
    material: SmoothData
