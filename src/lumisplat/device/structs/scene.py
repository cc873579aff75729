"""Data of the scene: Gaussians, meshes, and their instances. One struct is one noun of the method."""

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
    """A Gaussian asset on the device, in its own space."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """Object from Gaussian."""
    scales: wp.array[wp.vec3]
    """Standard deviations."""
    opacities: wp.array[float]
    sh: wp.array[wp.vec3]
    """Coefficients, ``sh_count`` consecutive ones a Gaussian."""
    sh_count: int
    normals: wp.array[wp.vec3]
    """Stored in the asset; without elements: it has none."""
    albedo: wp.array[wp.vec3]
    """Display-referred; without elements: none."""


@struct
class KernelData:
    """The response of Gaussians by distance, on which their bounds depend."""

    degree: int
    """Exponent of the distance, 0 (linear) to 5."""
    falloff: float
    """a of the response exp(-a d^degree); the slope of the linear one."""
    min_response: float
    adaptive: int
    """1: ``min_response`` limits the response times the opacity."""


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
    footprint: float
    """Standard deviation by which rays find Gaussians widened, in widths of a pixel; 0: not at all."""
    hit_distance: int
    """Where rays hit Gaussians: one of HIT_PEAK, HIT_HULL, HIT_MEAN."""
    sh_degree: int
    """Highest that is evaluated."""
    shows_albedo: int
    """1: Gaussians show their albedo."""
    stored_normals: int
    """1: normals are those stored in the asset."""
    shadow_only: int
    """1: shadow rays that skip such instances pass through it."""
    relit: int
    """1: light alone determines what shows of it, nothing is as captured."""


@struct
class TextureData:
    """Where a texture lies in the texels of MeshData."""

    first: int
    width: int
    """0: there is no texture."""
    height: int
    wrap_u: int
    """WRAP_REPEAT and so on."""
    wrap_v: int


@struct
class VariedData:
    """Transmission and layers of a material in which textures vary them: their factors, and the textures."""

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
    """All meshes of a scene, end to end, each in its own space."""

    positions: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    uvs: wp.array[wp.vec2]
    colors: wp.array[wp.vec3]
    """Linear."""
    indices: wp.array[wp.vec3i]
    """Into the arrays above, over all meshes."""
    texels: wp.array[wp.uint32]
    """RGBA8, sRGB-encoded, all textures end to end."""
    linear_from_byte: wp.array[float]
    """sRGB decoding table, 256 entries."""
    unit_from_byte: wp.array[float]
    """Bytes over 255."""
    varied: wp.array[VariedData]
    """Of the materials that have such textures; element 0 has none."""
    sheen_curves: wp.array[wp.vec4]
    """Coefficients of the albedo of sheen, by its roughness; without elements: no texture has a roughness of sheen."""


@struct
class AlphaData:
    """Alpha of a mesh's material."""

    mode: int
    """ALPHA_OPAQUE and so on."""
    factor: float
    """Of the texture's alpha."""
    cutoff: float
    """Least alpha of what there is, by ALPHA_MASK."""
    is_drawn: int
    """1: alpha is the chance with which a ray or a pixel meets a blend; 0: each meets it, and goes on behind by the
    share that alpha leaves."""
    is_bent: int
    """1: the rays of paths do so as through glass. Shadow rays that glass blocks end there, whatever alpha leaves: rays
    that go on show the light behind."""


@struct
class SmoothData:
    """Specular reflection and transmission of a material."""

    smooth: int
    """0: neither, the surface shows its base colour."""
    metallic: float
    specular: float
    ior: float
    transmission: float
    is_medium: int
    """1: rays that are refracted enter the inside of the mesh."""
    thin_walled: int
    """1: a wall without an inside, through which rays go straight."""
    priority: int
    """Of the medium inside, where several overlap."""
    absorption: wp.vec3
    """Of the medium inside, linear, per scene unit."""
    coat: float
    """Strength of a clearcoat on it."""
    coat_alpha: float
    sheen: float
    """Largest channel of a sheen on it."""
    sheen_curve: wp.vec4
    varied: int
    """Index into MeshData.varied; 0: no textures vary transmission or layers."""


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
    asset: int
    """Which TriangleBvh has the mesh's triangles; like what follows for rays only."""
    root: int
    """Root of the tree of the mesh's triangles there."""
    first: int
    """Index of the instance's first triangle among all of the scene's."""
    face_first: int
    """First face in MeshData."""
    has_normals: int
    base_color: wp.vec3
    """Linear."""
    texture: TextureData
    alpha: AlphaData
    material: SmoothData
