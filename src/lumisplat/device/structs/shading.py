"""Data of shading: surfaces as light meets them, and what each ray shows. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.light import Bsdf, EnvironmentData, LightData
from lumisplat.device.structs.rays import MeshPlacement
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, struct

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
    untouched: int
    """1: of splats that shine as captured and reflect nothing."""
    keeps: int
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
class SplatPlacement:
    """One placement of an asset, for what light meets there."""

    first: int
    """Index of the instance's first Gaussian among all of the scene's."""
    asset: int
    """Among the SplatAttributes."""
    scale: float
    """World from object."""


@struct
class ShadingSettings:
    """Settings of shading, in a 1-element array."""

    background: wp.vec3
    """Display-referred sRGB behind everything; black where there is none."""
    camera_sees: int
    """SEES_BACKGROUND, SEES_ENVIRONMENT in its place, or SEES_NOTHING: of the rays that are not reflected."""
    light_count: int
    sample: int
    """Number of the sample of each pixel."""
    darkens: int
    """1: there are sets that are only darkened."""
    soft: int
    """1: lights are sampled over their extent."""
    shadow_offset: float
    """Scales of a Gaussian."""
    shadow_offset_absolute: float
    """Scene units."""


@struct
class ShadingScene:
    """A lit scene: all that shading reads."""

    settings: wp.array(dtype=ShadingSettings)
    splats: wp.array(dtype=SplatPlacement)
    attributes: wp.array(dtype=SplatAttributes)
    mesh_instances: wp.array(dtype=MeshInstanceData)
    placements: wp.array(dtype=MeshPlacement)
    meshes: MeshData
    materials: wp.array(dtype=MaterialData)
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
    """A surface where light meets it."""

    exists: int
    """0: there is none that reflects."""
    position: wp.vec3
    """World space."""
    normal: wp.vec3
    """World space, unit, on the side of the view."""
    side: wp.vec3
    """The same of the triangle itself."""
    view: wp.vec3
    """Unit, back along the ray."""
    bsdf: Bsdf
    scale: float
    """Share in the ray's colour of what the surface reflects."""
    occlusion: float
    """Share of the environment's light that arrives."""
    shadow_only: int
    """1: what arrives is only compared, not reflected."""


@struct
class Contribution:
    """What a light adds to a ray's colour if nothing is in the way."""

    direction: wp.vec3
    """From the surface, unit."""
    distance: float
    color: wp.vec3
    """Linear; zero: not worth a shadow ray."""


@struct
class RayColors:
    """What rays see."""

    captured: wp.array(dtype=wp.vec3)
    """Display-referred sRGB, premultiplied by the next."""
    captured_weight: wp.array(dtype=float)
    light: wp.array(dtype=wp.vec3)
    """Linear: what light adds or shadows take, and all that meshes and the environment give; may be negative."""
    alpha: wp.array(dtype=float)
    """What is not background."""
    kept: wp.array(dtype=wp.vec3)
    """Share of what was captured that shadows leave; where sets are only darkened."""


@struct
class Arrivals:
    """What of the light arrives at surfaces that are only darkened."""

    sent: wp.array(dtype=wp.vec3)
    """Irradiance if nothing were in the way."""
    arrived: wp.array(dtype=wp.vec3)
