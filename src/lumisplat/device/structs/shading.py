"""Data of shading: materials, interactions of rays, and what rays see. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.camera import SampleData
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.light import Bsdf, EnvironmentData, LightData
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, SplatInstanceData

SEES_BACKGROUND = wp.constant(0)
SEES_ENVIRONMENT = wp.constant(1)
SEES_NOTHING = wp.constant(2)


@struct
class TextureData:
    """Where a texture lies in the texels of MeshData."""

    first: int
    width: int
    """0: there is none."""
    height: int


@struct
class MaterialData:
    """A material, one a splat or mesh instance in the order of the scene's instances."""

    model: int
    """BSDF_SIMPLE or BSDF_PBR."""
    emits_capture_only: int
    """1: of splats that shine as captured and reflect nothing."""
    keeps_capture: int
    """1: of splats that show all that was captured of them, and more where light adds to it."""
    shadow_only: int
    """1: of splats that are darkened where something blocks a light, and that is all."""
    emissive: wp.vec3
    ambient: wp.vec3
    diffuse: wp.vec3
    specular: wp.vec3
    shininess: float
    metallic: float
    roughness: float
    specular_strength: float
    """Strength of the dielectric reflection."""
    ior: float
    transmission: float
    metallic_roughness_texture: TextureData
    normal_texture: TextureData
    normal_scale: float
    occlusion_texture: TextureData
    occlusion_strength: float
    emissive_texture: TextureData


@struct
class SplatAttributes:
    """What the Gaussians of an asset carry for light; arrays without elements: nothing."""

    scales: wp.array(dtype=wp.vec3)
    roughness: wp.array(dtype=float)
    metallic: wp.array(dtype=float)


@struct
class ShadingSettings:
    """Settings of shading, in a 1-element array."""

    is_lit: int
    """0: all surfaces show their own colour, display-referred, and nothing is lit."""
    background: wp.vec3
    """Display-referred sRGB behind everything; black where there is none."""
    camera_sees: int
    """SEES_BACKGROUND, SEES_ENVIRONMENT in its place, or SEES_NOTHING: of the rays that are not reflected."""
    light_count: int
    has_shadow_only: int
    """1: there are sets that are only darkened."""
    soft: int
    """1: lights are sampled over their extent."""
    shadow_offset: float
    """Scales of a Gaussian."""
    shadow_offset_absolute: float
    """Scene units."""


@struct
class ShadingScene:
    """All that shading reads of a scene."""

    settings: wp.array(dtype=ShadingSettings)
    sample: wp.array(dtype=SampleData)
    splats: wp.array(dtype=SplatInstanceData)
    attributes: wp.array(dtype=SplatAttributes)
    """Of the Gaussian assets."""
    mesh_instances: wp.array(dtype=MeshInstanceData)
    meshes: MeshData
    materials: wp.array(dtype=MaterialData)
    """Of the splat instances, then of the mesh instances."""
    lights: wp.array(dtype=LightData)
    environment: EnvironmentData


@struct
class SplatSurface:
    """What the Gaussians before the nearest mesh show a ray."""

    instance: int
    """Of their surface, or of the first of them where they reach none; -1: there is nothing."""
    gaussian: int
    """Of the surface, in its asset; -1: there is none."""
    transmittance: float
    captured: wp.vec3
    """Display-referred sRGB, premultiplied by ``weight``; over the background where only that is behind."""
    weight: float
    """Share of the ray's colour that was captured."""
    albedo: wp.vec3
    """Linear, straight: the surface's own colour."""


@struct
class Interaction:
    """A ray's interaction with a surface: all that light needs to know of both."""

    exists: bool
    """Whether there is a surface that reflects."""
    position: wp.vec3
    """World space."""
    normal: wp.vec3
    """Shading normal, world space, unit, on the side of ``wo``."""
    geometric_normal: wp.vec3
    """Of the triangle itself, world space, unit, on the side of ``wo``; of Gaussians the shading normal."""
    wo: wp.vec3
    """Outgoing direction, unit: back along the ray."""
    bsdf: Bsdf
    weight: float
    """Share in the ray's colour of what the surface reflects."""
    occlusion: float
    """Share of the environment's light that arrives."""
    shadow_only: bool
    """Light that arrives is only compared, not reflected."""


@struct
class Interactions:
    """The interactions of a wave of rays, two a ray, as ``Interaction``: written once, read by all that lights.

    Element ``ray`` is the surface of the Gaussians, element ``stride + ray`` the mesh behind them.
    """

    exists: wp.array(dtype=wp.bool)
    position: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    geometric_normal: wp.array(dtype=wp.vec3)
    wo: wp.array(dtype=wp.vec3)
    model: wp.array(dtype=int)
    diffuse: wp.array(dtype=wp.vec3)
    specular: wp.array(dtype=wp.vec3)
    grazing: wp.array(dtype=float)
    alpha: wp.array(dtype=float)
    shininess: wp.array(dtype=float)
    weight: wp.array(dtype=float)
    occlusion: wp.array(dtype=float)
    shadow_only: wp.array(dtype=wp.bool)
    spawn_point: wp.array(dtype=wp.vec3)
    """Where rays start that leave the surface; without elements where none do."""
    spawn_t_min: wp.array(dtype=float)
    """Distance along them within which Gaussians do not count."""


@struct
class Contribution:
    """What a light adds to a ray's colour if nothing is in the way."""

    direction: wp.vec3
    """From the surface, unit."""
    distance: float
    color: wp.vec3
    """Linear; zero: not worth a shadow ray."""


@struct
class RayRadiance:
    """What rays see. Display-referred colours that were captured stay apart from linear light."""

    captured: wp.array(dtype=wp.vec3)
    """Display-referred sRGB, premultiplied by the next; of an unlit wave all that rays see."""
    captured_weight: wp.array(dtype=float)
    light: wp.array(dtype=wp.vec3)
    """Linear: what light adds or shadows take, and all that meshes and the environment give; may be negative."""
    alpha: wp.array(dtype=float)
    """What is not background."""
    capture_factor: wp.array(dtype=wp.vec3)
    """Share of what was captured that shadows leave; without elements where no set is only darkened."""
    reflection: wp.array(dtype=wp.vec3)
    """The part of ``light`` that mirrors and glass bring; like the next two without elements where nobody asked."""
    albedo: wp.array(dtype=wp.vec3)
    """Linear: the surfaces' own colour."""
    emission: wp.array(dtype=wp.vec3)
    """Linear: what they emit without lights."""


@struct
class WaveData:
    """A wave of rays, in a 1-element array: kernels that shade take it by reference.

    By value, compilers copy all of these arrays' descriptors for each ray, which costs more than the shading itself.
    """

    from_camera: int
    """1: the rays are the first ones, not reflected or refracted."""
    may_branch: int
    """1: smooth meshes send rays on where these are worth following."""
    rays: RayData
    meshes: MeshHits
    gaussians: GaussianHits
    interactions: Interactions
    radiance: RayRadiance
    path_weights: wp.array(dtype=float)
    """Largest share of a ray's colour in its pixel."""
    weights: wp.array(dtype=wp.vec3)
    """Share of a ray's colour in that of the ray it branches off; without elements in the first wave."""
    branches: wp.array(dtype=int)
    """How many rays go on, 0 or 1: element ``ray`` is the reflected ray, ``stride + ray`` the refracted one."""
    branch_ends: wp.array(dtype=int)
    """Inclusive sum of these: one more than the place of the branch's ray in the next wave."""


@struct
class Arrivals:
    """Irradiance of surfaces that are only darkened; without elements where there are none."""

    sent: wp.array(dtype=wp.vec3)
    """If nothing were in the way."""
    arrived: wp.array(dtype=wp.vec3)
