"""Data of light transport: lights, BSDFs, samples of both, materials, interactions and radiance of rays."""

import warp as wp

from lumisplat.device.structs import struct
from lumisplat.device.structs.camera import SampleData
from lumisplat.device.structs.rays import GaussianHits, MeshHits, RayData
from lumisplat.device.structs.scene import MeshData, MeshInstanceData, SplatInstanceData, TextureData

BSDF_SIMPLE: int = wp.constant(0)

BSDF_PBR: int = wp.constant(1)


@struct
class LightData:
    """A light, world space."""

    kind: int
    """LIGHT_POINT and so on, see device/light/light.py."""
    position: wp.vec3
    direction: wp.vec3
    """Unit: axis of a spot, direction in which directional light travels, normal of a flat light."""
    power: wp.vec3
    """Linear Rec.709: candela of points and spots, lux of directional light, radiance of flat lights, factor of the
    environment's image."""
    edge_u: wp.vec3
    edge_v: wp.vec3
    range: float
    """Of points and spots, where they end; of light from infinitely far, how far shadows reach; else inf."""
    radius: float
    """Of a point, spot or disk, scene units; of directional light, radians."""
    inner: float
    """1 - cosine of the angle from the axis of a spot up to which it has its full intensity."""
    outer: float
    """The same of the angle from which on it is dark. Cosines near 1 would lose the digits of small cones."""
    casts_shadow: int
    visible: int
    """1: paths see it, as a flat light or a sphere."""


@struct
class EnvironmentData:
    """The environment's image, and the tables that sample directions by its brightness."""

    exists: int
    """0: there is no environment."""
    visible: int
    """1: rays from the camera see it."""
    world_from_environment: wp.mat33
    """Rotation."""
    power: wp.vec3
    """Factor of the image."""
    mean: float
    """Luminance, mean over all directions."""
    texels: wp.array[wp.vec3]
    width: int
    height: int
    row_ends: wp.array[float]
    """Cumulative share of the light up to the end of each row."""
    column_ends: wp.array[float]
    """The same within each row, up to the end of each texel."""


@struct
class EmitterTriangle:
    """A triangle that shines, world space."""

    corner: wp.vec3
    edge1: wp.vec3
    edge2: wp.vec3
    """From the corner."""
    across: wp.vec3
    """Cross product of the edges: twice the triangle's area long."""
    lift: float
    """Share of ``across`` by which samples lie above the triangle, so that shadow rays to them do not hit it."""
    inside: wp.vec3
    """Least barycentric weights of samples: at an edge, they would lie in the wall beyond."""


@struct
class EmitterData:
    """The triangles of all meshes that shine, and the table that samples them by their power."""

    ends: wp.array[float]
    """Cumulative share of the power up to the end of each; without elements: no mesh shines."""
    triangles: wp.array[EmitterTriangle]
    instances: wp.array[int]
    """The mesh instance of each."""
    first: wp.array[int]
    """First triangle here of each mesh instance; -1: it does not shine."""
    power: float
    """Luminance times area, of all."""
    center: wp.vec3
    """Of a sphere that holds most of them, world space."""
    radius: float


@struct
class LightSample:
    """A direction from a surface towards a light, and the light that comes from there."""

    direction: wp.vec3
    """Unit, away from the surface."""
    distance: float
    """inf: infinitely far."""
    irradiance: wp.vec3
    """Unshadowed, of a surface that faces it; an estimate if the sample is random."""
    pdf: float
    """Probability density of the direction, per steradian; 0 if it is the only one."""


@struct
class Bsdf:
    """The reflection of light by a material at a point of a surface."""

    model: int
    """BSDF_SIMPLE or BSDF_PBR."""
    diffuse: wp.vec3
    """Albedo of the diffuse part; of BSDF_PBR before the mirrored share is taken off."""
    specular: wp.vec3
    """BSDF_SIMPLE: albedo of the highlight. BSDF_PBR: reflectance at normal incidence."""
    grazing: float
    """BSDF_PBR: reflectance at grazing incidence."""
    alpha: float
    """BSDF_PBR: alpha of the GGX distribution, roughness squared; 0: smooth, with specular bounces for a highlight."""
    shininess: float
    """BSDF_SIMPLE: exponent of the highlight."""
    dielectric: float
    """BSDF_PBR: strength of the reflection by what is not metal, which leaves the rest to the diffuse part."""
    eta: float
    """BSDF_PBR: index of refraction on the side of the viewer over that behind the surface."""
    mean_mirrored: float
    """BSDF_PBR: share of even light from all around that what is not metal mirrors."""
    transmitted: wp.vec3
    """Rough BSDF_PBR: share of the light let in that comes through; zero: none, and what follows is undefined."""
    thin_walled: bool
    """Light comes straight through; else it is refracted."""
    metallic: float
    metal: wp.vec3
    """Reflectance of the metal at normal incidence, times ``metallic``."""
    rescattered: wp.vec3
    """Rough BSDF_PBR: of the light that single scattering loses, what further scattering brings back; zero: nothing."""
    coat: float
    """Strength of the clearcoat."""
    coat_alpha: float
    """Alpha of its GGX distribution."""
    sheen: wp.vec3
    """Colour of the sheen; zero: there is none."""
    sheen_alpha: float
    """Roughness of the sheen, squared."""
    sheen_curve: wp.vec4
    """Its albedo: coefficients of the logarithm by the cosine."""


@struct
class CatcherLight:
    """Irradiance of a shadow catcher in one channel, as `lumisplat.baking.gaussian_views.CatcherLight`."""

    unshadowed: float
    change: float
    emitted_unshadowed: float
    emitted_change: float
    ambient: float
    blocked: float
    least: float


SEES_BACKGROUND: int = wp.constant(0)

SEES_ENVIRONMENT: int = wp.constant(1)

SEES_NOTHING: int = wp.constant(2)


@struct
class MaterialData:
    """A material, one a splat or mesh instance in the order of the scene's instances."""

    model: int
    """BSDF_SIMPLE or BSDF_PBR."""
    emits_capture_only: int
    """1: splats emit their captured colours, and reflect nothing."""
    keeps_capture: int
    """1: splats keep all of their captured colours, and add the light that they reflect."""
    shadow_only: int
    """1: splats keep their captured colours, darkened where lights are blocked."""
    emissive: wp.vec3
    double_sided: int
    """1: triangles emit from their backs, too."""
    ambient: wp.vec3
    diffuse: wp.vec3
    specular: wp.vec3
    shininess: float
    metallic: float
    roughness: float
    specular_strength: float
    """Strength of the dielectric reflection."""
    ior: float
    fresnel_mean: float
    """Share of even light from all around that a smooth dielectric of this ``ior`` mirrors."""
    transmission: float
    thin_walled: int
    compensates: int
    """1: what single scattering loses in rough metal is added."""
    coat: float
    coat_alpha: float
    sheen: wp.vec3
    sheen_alpha: float
    sheen_curve: wp.vec4
    metallic_roughness_texture: TextureData
    normal_texture: TextureData
    normal_scale: float
    occlusion_texture: TextureData
    occlusion_strength: float
    emissive_texture: TextureData


@struct
class SplatAttributes:
    """Attributes of an asset's Gaussians that shading reads; arrays without elements: the asset has none."""

    means: wp.array[wp.vec3]
    scales: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]


@struct
class ShadingSettings:
    """Settings of shading, in a 1-element array."""

    is_lit: int
    """0: all surfaces show their own display-referred colour."""
    background: wp.vec3
    """Display-referred sRGB behind everything; black where there is none."""
    camera_sees: int
    """What camera rays see behind the scene: SEES_BACKGROUND, SEES_ENVIRONMENT or SEES_NOTHING."""
    light_count: int
    absorbs: int
    """1: some medium inside a mesh absorbs light."""
    soft: int
    """1: lights are sampled over their extent."""
    more_draws: int
    """Directions in which interactions look for an environment that casts no shadow, besides the first."""
    changes_shadows: int
    """1: shadow rays darken or tint what they let through, as rays that meet lights do not."""
    capture_gain: float
    """Factor of the light that captures shine onto what they light; not of what is seen of them."""
    shadow_offset: float
    """Scales of a Gaussian."""
    shadow_offset_absolute: float
    """Scene units."""


@struct
class ShadingScene:
    """All that shading reads of a scene."""

    settings: wp.array[ShadingSettings]
    sample: wp.array[SampleData]
    splats: wp.array[SplatInstanceData]
    attributes: wp.array[SplatAttributes]
    """Of the Gaussian assets."""
    mesh_instances: wp.array[MeshInstanceData]
    meshes: MeshData
    materials: wp.array[MaterialData]
    """Of the splat instances, then of the mesh instances."""
    lights: wp.array[LightData]
    environment: EnvironmentData
    emitters: EmitterData


@struct
class SplatSurface:
    """The surface of the Gaussians before the nearest mesh on a ray, and their captured colours."""

    instance: int
    """Instance of the surface or, without a surface, of the first Gaussian; -1: there is none."""
    gaussian: int
    """Gaussian that lights change, in its asset; -1: they change none."""
    depth: float
    """Its distance along the ray, scene units."""
    is_mean: bool
    """It is the weighted mean of all relit Gaussians on the ray."""
    transmittance: float
    captured: wp.vec3
    """Display-referred sRGB, premultiplied by ``weight``; over the background if nothing else is behind."""
    weight: float
    """Share of the ray's colour that was captured."""
    captured_share: float
    """Share of the ray of Gaussians that keep their captured colour."""
    albedo: wp.vec3
    """Linear, straight: the own colour of what lights change."""
    share: float
    """Share of the ray of what lights change."""


@struct
class Interaction:
    """A ray's interaction with a surface: all that lighting reads of both."""

    exists: bool
    """Whether there is a surface that reflects."""
    position: wp.vec3
    """World space."""
    normal: wp.vec3
    """Shading normal, world space, unit, on the side of ``wo``."""
    horizon_normal: wp.vec3
    """No light arrives from below: of the smooth surface, without normal map, or of the triangle where there is none;
    world space, unit, on the side of ``wo``."""
    geometric_normal: wp.vec3
    """Of the triangle itself, world space, unit, on the side of ``wo``; of Gaussians the shading normal."""
    smooth_height: float
    """How far above its triangle the smooth surface of a mesh is, along ``horizon_normal``, scene units."""
    wo: wp.vec3
    """Outgoing direction, unit: back along the ray."""
    bsdf: Bsdf
    weight: float
    """Share in the ray's colour of what the surface reflects."""
    occlusion: float
    """Share of the environment's light that arrives."""
    shadow_only: bool
    """Whether the surface reflects no light, and is only darkened by the share that is blocked."""


@struct
class Interactions:
    """The interactions of a wave of rays, two a ray, as ``Interaction``: written once, read by every light.

    Element ``ray`` is the surface of the Gaussians, element ``stride + ray`` the mesh behind them.
    """

    exists: wp.array[wp.bool]
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    horizon_normal: wp.array[wp.vec3]
    wo: wp.array[wp.vec3]
    model: wp.array[int]
    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    grazing: wp.array[float]
    alpha: wp.array[float]
    shininess: wp.array[float]
    dielectric: wp.array[float]
    eta: wp.array[float]
    mean_mirrored: wp.array[float]
    transmitted: wp.array[wp.vec3]
    """Like the next three without elements unless rough surfaces transmit."""
    thin_walled: wp.array[wp.bool]
    metallic: wp.array[float]
    metal: wp.array[wp.vec3]
    rescattered: wp.array[wp.vec3]
    """Like the next five without elements unless there are layers, or rough metals are compensated."""
    coat: wp.array[float]
    coat_alpha: wp.array[float]
    sheen: wp.array[wp.vec3]
    sheen_alpha: wp.array[float]
    sheen_curve: wp.array[wp.vec4]
    weight: wp.array[float]
    occlusion: wp.array[float]
    shadow_only: wp.array[wp.bool]
    spawn_point: wp.array[wp.vec3]
    """Origin of the shadow rays; without elements in frames without shadow rays, as what follows."""
    spawn_t_min: wp.array[float]
    """Distance along them within which Gaussians of the same layer do not block, scene units."""
    geometric_normal: wp.array[wp.vec3]
    """Of Gaussians that of their layer: zero unless they are flat and seen from the front."""
    smooth_height: wp.array[float]


@struct
class Contribution:
    """The unshadowed contribution of a light to the radiance of a ray."""

    direction: wp.vec3
    """From the surface, unit."""
    distance: float
    color: wp.vec3
    """Linear; zero: no shadow ray is needed."""


@struct
class RayRadiance:
    """The radiance of rays: captured display-referred colours, and linear light apart from them."""

    captured: wp.array[wp.vec3]
    """Display-referred sRGB, premultiplied by ``captured_weight``; of an unlit wave the whole radiance."""
    captured_weight: wp.array[float]
    light: wp.array[wp.vec3]
    """Linear: light added to captured colours, or taken if negative, and all light of meshes and environment."""
    alpha: wp.array[float]
    """1 - share of the background."""
    capture_factor: wp.array[wp.vec3]
    """Share of captured colours that shadows leave; without elements if no splat set is shadow-only."""
    captured_all: wp.array[wp.vec3]
    """The captured colour, linear; like the next eight without elements unless paths find what shadow-only
    surfaces receive."""
    captured_part: wp.array[wp.vec3]
    """The part of it that is a shadow-only surface's."""
    received: wp.array[wp.vec3]
    """1 where the next two were found, else 0."""
    unshadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by lights, as it was captured."""
    shadowed: wp.array[wp.vec3]
    """The same with all that was added."""
    emitted_unshadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by the captures around it, as it was captured."""
    emitted_shadowed: wp.array[wp.vec3]
    """The same with all that was added, and what added surfaces emit."""
    ambient: wp.array[wp.vec3]
    """Ambient irradiance of the shadow catcher, see `catcher_change`."""
    open: wp.array[wp.vec3]
    """The part of it that nothing added blocks."""
    reflection: wp.array[wp.vec3]
    """The part of ``light`` from specular bounces; like the next two without elements if the frame lacks this image."""
    albedo: wp.array[wp.vec3]
    """Linear: the surfaces' own colour."""
    emission: wp.array[wp.vec3]
    """Linear: emission and reflected ambient light."""


@struct
class WaveData:
    """A wave of rays, in a 1-element array: kernels that shade take it by reference.

    By value, compilers copy all of these arrays' descriptors for each ray, which costs more than the shading itself.
    """

    from_camera: int
    """1: the rays are the first ones, not reflected or refracted."""
    traces_paths: int
    """1: paths go on behind it in one direction each, which add what is infinitely far."""
    may_branch: int
    """1: smooth meshes send rays on where these are worth following."""
    rays: RayData
    meshes: MeshHits
    gaussians: GaussianHits
    interactions: Interactions
    radiance: RayRadiance
    path_weights: wp.array[float]
    """Largest share of a ray's colour in its pixel."""
    weights: wp.array[wp.vec3]
    """Share of a ray's colour in that of the ray it branches off; without elements in the first wave."""
    media: wp.array[wp.vec4i]
    """The media that a ray has entered, as ``Boundary``; without elements: none."""
    unentered: wp.array[int]
    """1 for mesh instances which a ray from the camera leaves that has not entered them; without elements in other
    waves, and in scenes without media."""
    spawns_lobes: int
    """1: rough surfaces send on a ray within their highlights."""
    sees_environment: wp.array[wp.bool]
    """Whether a ray sees the environment and the background; without elements if all do."""
    branches: wp.array[int]
    """How many rays go on, 0 or 1: element ``ray`` is the reflected ray, ``stride + ray`` the refracted one, and
    ``2 stride + ray`` that of a highlight, in frames that have such rays."""
    branch_ends: wp.array[int]
    """Inclusive sum of these: one more than the place of the branch's ray in the next wave."""


@struct
class CatcherIrradiance:
    """Irradiance of shadow-only surfaces; without elements in frames without them."""

    unshadowed: wp.array[wp.vec3]
    """Unshadowed."""
    shadowed: wp.array[wp.vec3]
    """Shadowed."""
    open: wp.array[wp.vec3]
    """Sum over ambient rays of the share that nothing blocks."""
    reflectance: wp.array[wp.vec3]
    """Captured radiance over the irradiance that it was captured in."""


@struct
class PathVertex:
    """A surface of a path, as the choice of a light reads it."""

    position: wp.vec3
    """World space."""
    normal: wp.vec3
    """Unit, on the side of the viewer."""
    importance: float
    """About the irradiance that all lights give it."""


@struct
class LightCrossing:
    """Where a ray meets a light."""

    t: float
    """Distance; inf: it does not."""
    radiance: wp.vec3
    pdf: float
    """With which samples of the light have this direction, per steradian."""


@struct
class LightChoice:
    """One of the lights, chosen at random."""

    number: int
    """-1: no light shines here."""
    probability: float
