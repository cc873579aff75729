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
    """Kernel function of Gaussians: the response as a function of the distance from the mean in standard deviations."""

    degree: int
    """n of the kernel ``exp(-a d^n)``, 1 to 5, where d is the canonical distance; 0: the linear kernel ``1 - a d``."""
    falloff: float
    """Coefficient a of the kernel ``exp(-a d^n)``, or of the linear kernel ``1 - a d``; d is the canonical distance."""
    min_response: float
    adaptive: int
    """1: rays ignore a Gaussian where ``opacity * response`` is below ``min_response``; 0: where ``response`` is below
    it."""


@struct
class SplatInstanceData:
    """One instance of a Gaussian asset: the data that rasteriser, ray tracer and shading need."""

    camera_from_object: wp.mat33
    """Linear part of the transform from object to camera space: a rotation times a uniform scale."""
    camera_from_object_offset: wp.vec3
    object_from_world: wp.mat33
    """Linear part of the transform from world to object space: a rotation times a uniform scale."""
    object_from_world_offset: wp.vec3
    world_from_object: wp.mat33
    """Rotation from object to world space; unlike ``object_from_world``, it does not contain the uniform scale."""
    scale: float
    """Uniform scale from object to world space."""
    eye: wp.vec3
    """Camera's centre of projection in object space."""
    first: int
    """Index of the instance's first Gaussian when all splat instances are counted one after another."""
    asset: int
    """Index of the instance's asset among the scene's Gaussian assets."""
    kernel: KernelData
    antialiased: int
    """1: the opacity is reduced to compensate for the dilation of the projected Gaussian (Mip-Splatting)."""
    undilated: int
    """1: the rasteriser adds no dilation to the projected Gaussians, because frames average jittered samples."""
    footprint: float
    """Standard deviation by which rays widen Gaussians, in pixel widths; 0: no widening."""
    hit_distance: int
    """Distance at which rays hit the instance's Gaussians: HIT_PEAK, HIT_HULL or HIT_MEAN."""
    sh_degree: int
    """Highest SH degree, 0 to 3, at which the instance's colours are evaluated."""
    shows_albedo: int
    """1: the colour of a Gaussian is its stored albedo, for relighting; 0: its captured colour from SH."""
    tint: wp.vec3
    """Linear factor on the colours of the Gaussians, 0..1: the base colour of a relit set's material."""
    stored_normals: int
    """1: the instance is lit by the normals stored with its Gaussians; 0: by normals computed from their shapes."""
    shadow_catcher: int
    """1: the instance is a shadow catcher. Shadow rays that start at any shadow catcher pass all shadow catchers
    unblocked."""
    depth_iso_transmittance: float
    """Transmittance at the surface of the instance's Gaussians; negative: that of the settings."""
    relit: int
    """1: the instance shows only light that it reflects or emits by its material, and none of its captured colour."""


@struct
class TextureData:
    """Place, size and wrapping of one texture within the texel array ``MeshData.texels``."""

    first: int
    width: int
    """Width in texels; 0: there is no texture."""
    height: int
    wrap_u: int
    """How texture coordinates outside 0..1 wrap along u: WRAP_REPEAT, WRAP_MIRROR or WRAP_CLAMP."""
    wrap_v: int


@struct
class VariedData:
    """Transmission, clearcoat and sheen of a material: constant factors, and the textures that vary them."""

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
    """All meshes of a scene, each in its own object space; arrays concatenate the meshes' vertices or triangles."""

    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    uvs: wp.array[wp.vec2]
    colors: wp.array[wp.vec3]
    """Vertex colours, linear."""
    indices: wp.array[wp.vec3i]
    """Three vertex indices for each triangle of all meshes; they index ``positions``, ``normals``, ``uvs`` and
    ``colors``."""
    texels: wp.array[wp.uint32]
    """RGBA8 texels of all textures one after another: sRGB-encoded colours, linear data."""
    linear_from_byte: wp.array[float]
    """Decoding table from sRGB bytes to linear values, 256 entries."""
    unit_from_byte: wp.array[float]
    """Decoding table from bytes to byte / 255, 256 entries."""
    varied: wp.array[VariedData]
    """Textured transmission, clearcoat and sheen of materials, indexed by ``SmoothData.varied``; element 0 is unused.
    """
    sheen_curves: wp.array[wp.vec4]
    """Sheen albedo coefficients for each of a series of sheen roughnesses; empty: no texture varies a sheen's
    roughness."""


@struct
class AlphaData:
    """Alpha of a mesh's material: mode, constant factor, and what rays do with it."""

    mode: int
    """How alpha is used, as in glTF: ALPHA_OPAQUE, ALPHA_MASK or ALPHA_BLEND."""
    factor: float
    """Constant factor by which the alpha of the texture is multiplied."""
    cutoff: float
    """Smallest alpha that counts as opaque with ALPHA_MASK."""
    is_drawn: int
    """1: a ray hits the surface at random, with probability alpha. 0: every ray hits the surface, and also continues
    behind it with weight 1 - alpha."""
    is_bent: int
    """1: path rays that alpha lets through continue as through glass, refracted into the mesh.

    Shadow rays that glass may block then end at the surface, whatever its alpha is: the continued path rays find the
    light behind the surface."""


@struct
class SmoothData:
    """Specular reflection and transmission of a mesh's material, and the medium inside the mesh."""

    smooth: int
    """1: the material reflects or transmits like a mirror or glass. 0: it does not, and the surface shows its base
    colour."""
    metallic: float
    specular: float
    ior: float
    transmission: float
    is_medium: int
    """1: the mesh is filled with a medium, and refracted rays enter it; 0: the mesh has no inside."""
    thin_walled: int
    """1: the surface is a wall without thickness, such as a soap bubble; rays pass through it without refraction."""
    priority: int
    """Where several media overlap, rays travel in the one of highest priority; of equal ones, in the last one entered.
    """
    absorption: wp.vec3
    """Absorption coefficient of the medium inside the mesh, per channel, linear, per scene unit."""
    coat: float
    """Strength of the clearcoat layer, 0..1."""
    coat_alpha: float
    sheen: float
    """Largest channel of the material's sheen colour; 0: no sheen."""
    sheen_curve: wp.vec4
    varied: int
    """Index into MeshData.varied; 0: no texture varies transmission, clearcoat or sheen."""


@struct
class MeshInstanceData:
    """One instance of a mesh: the data that rasteriser, ray tracer and shading need."""

    camera_from_object: wp.mat33
    """Linear part (3 x 3) of the transform from object to camera space."""
    camera_from_object_offset: wp.vec3
    world_from_object: wp.mat33
    """Linear part (3 x 3) of the transform from object to world space."""
    world_from_object_normal: wp.mat33
    """Inverse transpose of ``world_from_object``, up to scale; transforms normals."""
    object_from_world: wp.mat33
    """Inverse of ``world_from_object``."""
    position: wp.vec3
    """Position of the object's origin in world space."""
    keeps_directions: int
    """1: the instance is not rotated, scaled or sheared, so directions are the same in object and world space."""
    low: wp.vec3
    """Lower corner of the instance's bounding box, world space, enlarged against rounding."""
    high: wp.vec3
    asset: int
    """Index, in ``MeshBvh.assets``, of the group of BVHs that holds the mesh's tree.

    Only ray tracing reads ``asset``, ``root``, and the fields declared after them."""
    root: int
    """Index of the root of the mesh's tree among the nodes of ``TriangleBvh`` number ``asset``."""
    first: int
    """Index of the instance's first triangle when all mesh instances are counted one after another."""
    face_first: int
    """Index of the mesh's first triangle in ``MeshData.indices``."""
    has_normals: int
    base_color: wp.vec3
    """Base colour of the mesh's material, linear; texture and vertex colours are multiplied by it."""
    texture: TextureData
    alpha: AlphaData
    material: SmoothData
