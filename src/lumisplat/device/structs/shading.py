"""Structs of light transport: lights, BSDFs, materials, interactions and radiance of rays."""

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
    """Type of the light: LIGHT_POINT and so on, see device/light/light.py."""
    position: wp.vec3
    direction: wp.vec3
    """Unit vector: axis of a spot, travel direction of a directional light, normal of a rectangle or disk."""
    power: wp.vec3
    """Linear Rec.709 intensity; its unit depends on the type of light.

    Candela for point lights and spots, lux for directional lights and the headlight, radiance for rectangles and disks,
    factor of the image for the environment."""
    edge_u: wp.vec3
    edge_v: wp.vec3
    range: float
    """Distance at which the light of a point light or spot ends; inf: it does not end.

    For infinitely distant lights, it is the largest distance at which objects block them."""
    radius: float
    """Radius of a point light, spot or disk, scene units; angular radius of a directional light, radians."""
    inner: float
    """1 - cosine of the angle from a spot's axis within which it has its full intensity."""
    outer: float
    """1 - cosine of the angle from a spot's axis beyond which the spot is dark.

    Angles are stored as 1 - cosine, because the cosines themselves would lose digits for narrow cones."""
    casts_shadow: int
    visible: int
    """1: path rays can hit the light, as a flat shape or a sphere."""


@struct
class EnvironmentData:
    """The environment map and its tables for importance sampling by brightness."""

    exists: int
    """0: there is no environment."""
    visible: int
    """1: camera rays see the environment."""
    world_from_environment: wp.mat33
    """Rotation of the environment."""
    power: wp.vec3
    """Factor of the image's radiance."""
    mean: float
    """Mean luminance of the environment over all directions."""
    texels: wp.array[wp.vec3]
    width: int
    height: int
    row_ends: wp.array[float]
    """Marginal CDF over the rows of the image: fraction of the light up to the end of each row."""
    column_ends: wp.array[float]
    """Conditional CDF within each row of the image: fraction of the row's light up to the end of each texel."""


@struct
class EmitterTriangle:
    """An emissive triangle, world space."""

    corner: wp.vec3
    edge1: wp.vec3
    edge2: wp.vec3
    """Second edge; both edges start at ``corner``."""
    across: wp.vec3
    """Cross product of the edges; its length is twice the triangle's area."""
    lift: float
    """Factor of ``across`` by which sample points are lifted off the triangle, so that shadow rays do not hit it."""
    inside: wp.vec3
    """Smallest barycentric weights of sample points; points closer to an edge could lie behind an adjacent wall."""


@struct
class EmitterData:
    """Emissive triangles of all meshes, and the CDF that samples them by power."""

    ends: wp.array[float]
    """Cumulative fraction of the power up to the end of each triangle; empty: no mesh is emissive."""
    triangles: wp.array[EmitterTriangle]
    instances: wp.array[int]
    """Mesh instance of each triangle."""
    first: wp.array[int]
    """First emissive triangle of each mesh instance; -1: the instance is not emissive."""
    power: float
    """Sum of luminance times area over all emissive triangles."""
    center: wp.vec3
    """Centre of a sphere that contains most emissive triangles, world space."""
    radius: float


@struct
class LightSample:
    """A sampled direction from a surface towards a light, and the light arriving from there."""

    direction: wp.vec3
    """Unit direction away from the surface."""
    distance: float
    """Distance to the light; inf: infinitely far."""
    irradiance: wp.vec3
    """Unshadowed irradiance of a surface facing the light; a Monte Carlo estimate if the sample is random."""
    pdf: float
    """Probability density of the direction, per steradian; 0 for a light with a single direction (delta light)."""


@struct
class Bsdf:
    """Parameters of the BSDF at a surface point."""

    model: int
    """BSDF_SIMPLE or BSDF_PBR."""
    diffuse: wp.vec3
    """Diffuse albedo; for BSDF_PBR before the specular reflection is subtracted."""
    specular: wp.vec3
    """BSDF_SIMPLE: albedo of the highlight. BSDF_PBR: reflectance at normal incidence."""
    grazing: float
    """BSDF_PBR: reflectance at grazing incidence."""
    alpha: float
    """BSDF_PBR: GGX alpha, roughness squared; 0: a smooth surface, whose specular reflection is traced as bounces."""
    shininess: float
    """BSDF_SIMPLE: Phong exponent of the highlight."""
    dielectric: float
    """BSDF_PBR: strength of the dielectric reflection; light that is not reflected reaches the diffuse lobe."""
    eta: float
    """BSDF_PBR: index of refraction on the viewer's side over the index behind the surface."""
    mean_mirrored: float
    """BSDF_PBR: fraction of constant illumination from the hemisphere that the dielectric reflects specularly."""
    transmitted: wp.vec3
    """Rough BSDF_PBR: fraction of the entering light that is transmitted.

    Zero means no transmission; ``thin_walled``, ``metallic`` and ``metal`` are then undefined."""
    thin_walled: bool
    """True if transmitted light passes straight through; false if it is refracted."""
    metallic: float
    metal: wp.vec3
    """Reflectance of the metal at normal incidence, times ``metallic``."""
    rescattered: wp.vec3
    """Rough BSDF_PBR: fraction of the single-scattering energy loss that multiple scattering returns; zero: none."""
    coat: float
    """Strength of the clearcoat."""
    coat_alpha: float
    """GGX alpha of the clearcoat."""
    sheen: wp.vec3
    """Colour of the sheen; zero: no sheen."""
    sheen_alpha: float
    """Roughness of the sheen, squared."""
    sheen_curve: wp.vec4
    """Sheen albedo: polynomial coefficients of its logarithm in the cosine."""


@struct
class CatcherLight:
    """Irradiance of a shadow catcher in one channel; fields as in `lumisplat.baking.gaussian_views.CatcherLight`."""

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
    """A material; one for each splat or mesh instance, in the order of the scene's instances."""

    model: int
    """BSDF_SIMPLE or BSDF_PBR."""
    emits_capture_only: int
    """1: splats emit their captured colours and reflect no light."""
    keeps_capture: int
    """1: splats emit their captured colours and add the light that they reflect."""
    shadow_catcher: int
    """1: splats are shadow catchers: they show captured colours, darkened where lights are blocked."""
    emissive: wp.vec3
    double_sided: int
    """1: triangles also emit from their back sides."""
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
    """Fraction of constant hemispherical illumination that a smooth dielectric with the material's ``ior`` reflects."""
    transmission: float
    thin_walled: int
    compensates: int
    """1: rough metals are compensated for the energy loss of single scattering."""
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
    """Attributes of an asset's Gaussians that shading reads; empty arrays: the asset lacks them."""

    means: wp.array[wp.vec3]
    scales: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]


@struct
class ShadingSettings:
    """Settings of shading, in a 1-element array."""

    is_lit: int
    """0: all surfaces show their unlit, display-referred colour."""
    background: wp.vec3
    """Display-referred sRGB colour behind the scene; black if there is no background."""
    camera_sees: int
    """Light that camera rays see behind the scene: SEES_BACKGROUND, SEES_ENVIRONMENT or SEES_NOTHING."""
    light_count: int
    absorbs: int
    """1: a medium inside some mesh absorbs light."""
    soft: int
    """1: lights are sampled over their extent (soft shadows)."""
    more_draws: int
    """Number of extra directions in which each interaction samples an environment that casts no shadow."""
    changes_shadows: int
    """1: light samples and scattered rays cannot be combined by MIS.

    Shadow rays then use a threshold or a tint that the scattered rays do not use."""
    capture_gain: float
    """Factor of the captured radiance where it lights other surfaces; direct views of the capture are unchanged."""
    shadow_offset: float
    """Distance from a surface of Gaussians within which Gaussians do not shadow it, in multiples of their largest
    scale."""
    shadow_offset_absolute: float
    """Distance in scene units, added to ``shadow_offset`` times the largest scale."""


@struct
class ShadingScene:
    """Scene data that shading reads."""

    settings: wp.array[ShadingSettings]
    sample: wp.array[SampleData]
    splats: wp.array[SplatInstanceData]
    attributes: wp.array[SplatAttributes]
    """Attributes of each Gaussian asset."""
    mesh_instances: wp.array[MeshInstanceData]
    meshes: MeshData
    materials: wp.array[MaterialData]
    """Materials of the splat instances, then of the mesh instances."""
    lights: wp.array[LightData]
    environment: EnvironmentData
    emitters: EmitterData


@struct
class SplatSurface:
    """Surface of the Gaussians in front of the nearest mesh on a ray, and their captured colours."""

    instance: int
    """Index of the surface's instance or, without a surface, of the first Gaussian's; -1: no Gaussian on the ray."""
    gaussian: int
    """Index in its asset of the Gaussian whose appearance lights change; -1: none."""
    depth: float
    """Distance of the surface along the ray, scene units."""
    is_mean: bool
    """True if the surface is the weighted mean of all relit Gaussians on the ray."""
    transmittance: float
    captured: wp.vec3
    """Captured colour, display-referred sRGB, premultiplied by ``weight``.

    If nothing else lies behind the Gaussians, the colour is composited over the background."""
    weight: float
    """Fraction of the ray's colour that is captured colour."""
    captured_share: float
    """Blending weight of the Gaussians that show their captured colour."""
    albedo: wp.vec3
    """Linear, non-premultiplied base colour of the Gaussians that lights change."""
    share: float
    """Blending weight of the Gaussians that lights change."""


@struct
class Interaction:
    """Interaction of a ray with a surface: all data about the ray and the surface that lighting reads."""

    exists: bool
    """True if there is a surface that reflects light."""
    position: wp.vec3
    """Position, world space."""
    normal: wp.vec3
    """Shading normal, world space, unit, on the side of ``wo``."""
    horizon_normal: wp.vec3
    """Normal of the plane below which no light arrives; world space, unit, on the side of ``wo``.

    It is the interpolated normal without the normal map, or the triangle's normal if the mesh has no vertex normals."""
    geometric_normal: wp.vec3
    """Normal of the triangle, world space, unit, on the side of ``wo``; for Gaussians the shading normal."""
    smooth_height: float
    """Height of a mesh's smooth surface above its triangle along ``horizon_normal``, scene units."""
    wo: wp.vec3
    """Outgoing direction, unit: back along the ray."""
    bsdf: Bsdf
    weight: float
    """Weight of the reflected light in the ray's colour."""
    occlusion: float
    """Fraction of the environment's light that arrives (ambient occlusion)."""
    shadow_catcher: bool
    """True if the surface is a shadow catcher: it reflects no light and is only darkened where lights are blocked."""


@struct
class Interactions:
    """Interactions of a wave of rays, two for each ray: written once and read by every light.

    The first half of each array holds the surfaces of the Gaussians, one for each ray; the second half the meshes
    behind the Gaussians. Fields are as in ``Interaction``.
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
    """``Bsdf.transmitted`` of each interaction.

    The arrays ``transmitted``, ``thin_walled``, ``metallic`` and ``metal`` are empty unless rough surfaces transmit."""
    thin_walled: wp.array[wp.bool]
    metallic: wp.array[float]
    metal: wp.array[wp.vec3]
    rescattered: wp.array[wp.vec3]
    """``Bsdf.rescattered`` of each interaction.

    The arrays from ``rescattered`` to ``sheen_curve`` are empty unless there is clearcoat, sheen or an
    energy-compensated rough metal."""
    coat: wp.array[float]
    coat_alpha: wp.array[float]
    sheen: wp.array[wp.vec3]
    sheen_alpha: wp.array[float]
    sheen_curve: wp.array[wp.vec4]
    weight: wp.array[float]
    occlusion: wp.array[float]
    shadow_catcher: wp.array[wp.bool]
    spawn_point: wp.array[wp.vec3]
    """Origin of shadow rays.

    The ``spawn`` arrays and ``geometric_normal`` are empty in frames without shadow rays."""
    spawn_t_min: wp.array[float]
    """Distance along shadow rays within which Gaussians of the surface's own layer do not block, scene units."""
    geometric_normal: wp.array[wp.vec3]
    """Unit normal of the triangle or, for Gaussians, of their layer; on the side of the ray.

    The normal is zero for Gaussians that are not flat or are seen from behind."""
    smooth_height: wp.array[float]


@struct
class Contribution:
    """Unshadowed contribution of a light to the radiance of a ray."""

    direction: wp.vec3
    """Direction from the surface, unit."""
    distance: float
    color: wp.vec3
    """Linear contribution; zero: no shadow ray is needed."""


@struct
class RayRadiance:
    """Radiance of rays: display-referred captured colours, and linear light in separate arrays."""

    captured: wp.array[wp.vec3]
    """Captured colour, display-referred sRGB, premultiplied by ``captured_weight``.

    In an unlit wave, it is the whole radiance."""
    captured_weight: wp.array[float]
    light: wp.array[wp.vec3]
    """Linear light of meshes and the environment, plus changes of captured colours.

    The changes are negative where added objects block light."""
    alpha: wp.array[float]
    """1 - weight of the background."""
    capture_factor: wp.array[wp.vec3]
    """Fraction of the captured colour that remains after shadows; empty if no splat set is a shadow catcher."""
    captured_all: wp.array[wp.vec3]
    """Linear captured colour.

    The arrays from ``captured_all`` to ``open`` are empty unless path tracing measures light on shadow catchers."""
    captured_part: wp.array[wp.vec3]
    """Part of ``captured_all`` that a shadow catcher contributes."""
    received: wp.array[wp.vec3]
    """1 where the path measured the irradiance of a shadow catcher, else 0."""
    unshadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by lights, without the added objects."""
    shadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by lights, with all added objects."""
    emitted_unshadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by the radiance of surrounding captures, without the added objects."""
    emitted_shadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by surrounding captures, with all added objects and the light that they emit."""
    ambient: wp.array[wp.vec3]
    """Ambient irradiance of the shadow catcher."""
    open: wp.array[wp.vec3]
    """Part of ``ambient`` that no added object blocks."""
    reflection: wp.array[wp.vec3]
    """Part of ``light`` from specular bounces; empty unless the frame has this light layer."""
    albedo: wp.array[wp.vec3]
    """Linear base colour of the surfaces; empty unless the frame has this layer."""
    emission: wp.array[wp.vec3]
    """Linear emission plus reflected ambient light; empty unless the frame has this layer."""


@struct
class WaveData:
    """A wave of rays, in a 1-element array, which shading kernels take by reference.

    By value, compilers would copy the descriptors of all arrays for each ray, which costs more than the shading itself.
    """

    from_camera: int
    """1: the rays are camera rays, not reflected or refracted ones."""
    traces_paths: int
    """1: the path integrator continues each path behind this wave with one ray.

    The path integrator, instead of this wave's shading, then adds the light of the environment."""
    may_branch: int
    """1: smooth meshes spawn reflected and refracted rays where their weight is large enough."""
    rays: RayData
    meshes: MeshHits
    gaussians: GaussianHits
    interactions: Interactions
    radiance: RayRadiance
    path_weights: wp.array[float]
    """Largest channel of each ray's weight in its pixel."""
    weights: wp.array[wp.vec3]
    """Weight of each ray in the colour of its parent ray; empty in the first wave."""
    media: wp.array[wp.vec4i]
    """Media that each ray is inside of: mesh instance indices plus one; empty: no ray is in a medium."""
    unentered: wp.array[int]
    """1 for mesh instances that a camera ray leaves without having entered them.

    The array is empty in other waves and in scenes without media."""
    spawns_lobes: int
    """1: rough surfaces spawn one ray inside their highlight."""
    sees_environment: wp.array[wp.bool]
    """True if the ray sees the environment and the background; empty if all rays do."""
    branches: wp.array[int]
    """Number of rays, 0 or 1, of each kind that each ray spawns.

    The array has one section per kind, each with one element per ray: reflected rays, refracted rays and, in frames
    that have them, rays within highlights."""
    branch_ends: wp.array[int]
    """Inclusive prefix sum of ``branches``: one more than the index of the spawned ray in the next wave."""


@struct
class CatcherIrradiance:
    """Irradiance of shadow catchers; empty arrays in frames without them."""

    unshadowed: wp.array[wp.vec3]
    """Irradiance without shadows of added objects."""
    shadowed: wp.array[wp.vec3]
    """Irradiance with shadows of added objects."""
    open: wp.array[wp.vec3]
    """Sum of the transmittances of the ambient rays that start at the shadow catcher."""
    reflectance: wp.array[wp.vec3]
    """Captured radiance over the irradiance that the surface received while it was captured."""


@struct
class PathVertex:
    """A surface point of a path, reduced to what light selection needs."""

    position: wp.vec3
    """Position, world space."""
    normal: wp.vec3
    """Normal, unit, on the viewer's side."""
    importance: float
    """Estimated irradiance by all lights."""


@struct
class LightCrossing:
    """Intersection of a ray with a light."""

    t: float
    """Distance along the ray; inf: the ray misses the light."""
    radiance: wp.vec3
    pdf: float
    """Pdf with which sampling the light would choose this direction, per steradian."""


@struct
class LightChoice:
    """A randomly selected light."""

    number: int
    """Index of the light; -1: no light contributes here."""
    probability: float
