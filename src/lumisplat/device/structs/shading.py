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
    """A light of any type, world space; which fields count depends on the type."""

    kind: int
    """Type of the light: LIGHT_POINT and so on, see device/light/light.py."""
    position: wp.vec3
    direction: wp.vec3
    """Unit vector: axis of a spot, travel direction of a directional light, normal of a rectangle or disk."""
    power: wp.vec3
    """Intensity of the light per colour channel, linear Rec.709, in a unit that depends on the type of light.

    Candela for point lights and spots, lux for directional lights and the headlight, radiance for rectangles and disks.
    For the environment it is the factor of the image's radiance."""
    edge_u: wp.vec3
    edge_v: wp.vec3
    range: float
    """Distance at which a point light or spot has faded to 0, scene units; inf: it never does.

    For directional lights and environments: distance up to which objects cast shadows."""
    radius: float
    """Radius of a point light, spot or disk, scene units; angular radius of a directional light, radians."""
    inner: float
    """1 - cosine of the half angle of a spot's inner cone; the spot has its full intensity within this cone."""
    outer: float
    """1 - cosine of the half angle of a spot's outer cone; the spot is dark outside this cone.

    1 - cosine keeps digits for narrow cones, which the cosine itself would lose."""
    casts_shadow: int
    visible: int
    """1: rays of path tracing can hit the light's shape, a rectangle, disk or sphere. 0: it is only sampled."""


@struct
class EnvironmentData:
    """The environment map and its CDF tables for importance sampling by brightness."""

    exists: int
    """1: the scene has an environment; 0: it has none, and the other fields do not count."""
    visible: int
    """1: camera rays see the environment."""
    world_from_environment: wp.mat33
    """Rotation from the axes of the environment's image to world axes."""
    power: wp.vec3
    """Factor, per channel, by which the image's radiance is multiplied."""
    mean: float
    """Mean luminance of the environment over all directions."""
    texels: wp.array[wp.vec3]
    width: int
    height: int
    row_ends: wp.array[float]
    """Marginal CDF over image rows: fraction of the image's light in this row and all rows above."""
    column_ends: wp.array[float]
    """Conditional CDF of each row: fraction of the row's light in this texel and all texels left of it."""


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
    """Sample points are moved off the triangle by ``lift * across``, so that shadow rays to them do not hit the
    triangle."""
    inside: wp.vec3
    """Smallest barycentric weight of sample points, per corner; points nearer to an edge could lie behind an adjacent
    wall."""


@struct
class EmitterData:
    """Emissive triangles of all meshes, and the CDF that samples them by power."""

    ends: wp.array[float]
    """CDF over emissive triangles: fraction of the power in this triangle and all before it; empty: no mesh is
    emissive."""
    triangles: wp.array[EmitterTriangle]
    instances: wp.array[int]
    """Index of the mesh instance that each emissive triangle belongs to."""
    first: wp.array[int]
    """Index of the first emissive triangle of each mesh instance; -1: the instance is not emissive."""
    power: float
    """Sum of luminance times area over all emissive triangles."""
    center: wp.vec3
    """Centre of a sphere that contains most emissive triangles, world space."""
    radius: float


@struct
class LightSample:
    """A sampled direction from a surface towards a light, and the light arriving from there."""

    direction: wp.vec3
    """Unit direction from the surface towards the light, world space."""
    distance: float
    """Distance from the surface to the sampled point of the light; inf: the light is infinitely far away."""
    irradiance: wp.vec3
    """Unshadowed irradiance from the sampled direction on a surface that faces it.

    If the direction is random, it is a Monte Carlo estimate, already divided by the pdf."""
    pdf: float
    """Pdf of the sampled direction, per steradian; 0 if the light has only one direction (delta light)."""


@struct
class Bsdf:
    """Parameters of the BSDF at a surface point."""

    model: int
    """Reflection model: BSDF_SIMPLE (Phong) or BSDF_PBR (metallic-roughness)."""
    diffuse: wp.vec3
    """Albedo of the diffuse lobe. In BSDF_PBR, only light that is not reflected specularly reaches this lobe."""
    specular: wp.vec3
    """BSDF_SIMPLE: albedo of the highlight. BSDF_PBR: reflectance at normal incidence."""
    grazing: float
    """BSDF_PBR: reflectance at grazing incidence."""
    alpha: float
    """BSDF_PBR: GGX alpha, roughness squared. 0: smooth; its mirror reflection is traced by rays and not part of the
    BSDF."""
    shininess: float
    """BSDF_SIMPLE: Phong exponent of the highlight."""
    dielectric: float
    """BSDF_PBR: factor of a dielectric's Fresnel reflection; the light that is not reflected reaches the diffuse lobe.
    """
    eta: float
    """BSDF_PBR: index of refraction on the viewer's side over the index behind the surface."""
    mean_mirrored: float
    """BSDF_PBR: fraction of uniform hemispherical illumination that the dielectric reflects specularly."""
    transmitted: wp.vec3
    """BSDF_PBR, rough surface: fraction, per channel, of the light entering the surface that passes through it.

    Zero means that none does; ``thin_walled``, ``metallic`` and ``metal`` are then undefined."""
    thin_walled: bool
    """True if transmitted light passes straight through; false if it is refracted."""
    metallic: float
    metal: wp.vec3
    """Reflectance of the metal at normal incidence, times ``metallic``."""
    rescattered: wp.vec3
    """BSDF_PBR, rough metal: fraction of the energy lost by single scattering that multiple scattering adds; zero:
    none."""
    coat: float
    """Strength of the clearcoat layer, 0..1; 0: no clearcoat."""
    coat_alpha: float
    """GGX alpha of the clearcoat."""
    sheen: wp.vec3
    """Colour of the sheen; zero: no sheen."""
    sheen_alpha: float
    """Roughness of the sheen, squared."""
    sheen_curve: wp.vec4
    """Coefficients of a polynomial in the cosine of the view; exp(polynomial) is the albedo of white sheen."""


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
    """Reflection model: BSDF_SIMPLE (Phong) or BSDF_PBR (metallic-roughness)."""
    emits_capture_only: int
    """1: a splat set that shows its captured colours unchanged and reflects no light, as in all unlit frames."""
    keeps_capture: int
    """1: a splat set that shows its captured colours, and also reflects light if its material does; 0: the set is
    relit."""
    shadow_catcher: int
    """1: a splat set that is a shadow catcher: its captured colours, darkened where added objects block light."""
    emissive: wp.vec3
    double_sided: int
    """1: triangles emit from both sides; 0: only from their front sides."""
    ambient: wp.vec3
    diffuse: wp.vec3
    specular: wp.vec3
    shininess: float
    metallic: float
    roughness: float
    specular_strength: float
    """BSDF_PBR: factor of the Fresnel reflection of the dielectric."""
    ior: float
    fresnel_mean: float
    """Fraction of uniform hemispherical illumination that a smooth dielectric with the material's ``ior`` reflects.
    """
    transmission: float
    thin_walled: int
    compensates: int
    """1: rough metals also reflect the energy that single scattering loses (Kulla and Conty 2017)."""
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
    """Attributes of one asset's Gaussians that shading reads; an array is empty if the asset lacks the attribute."""

    means: wp.array[wp.vec3]
    scales: wp.array[wp.vec3]
    normals: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]


@struct
class ShadingSettings:
    """Settings of shading, in a 1-element array."""

    is_lit: int
    """1: the scene's lights are computed. 0: splats and meshes show their captured or base colours, display-referred.
    """
    background: wp.vec3
    """Display-referred sRGB colour behind the scene; black if the frame has a transparent background."""
    camera_sees: int
    """Result of a camera ray that hits nothing: SEES_BACKGROUND, SEES_ENVIRONMENT or SEES_NOTHING (transparent)."""
    light_count: int
    absorbs: int
    """1: some mesh contains a medium that absorbs light, so that transmittance must be computed along rays."""
    soft: int
    """1: lights with an extent are sampled over it (soft shadows); 0: at their centres (hard shadows)."""
    more_draws: int
    """An environment without shadows is sampled in ``1 + more_draws`` directions at each surface point."""
    changes_shadows: int
    """1: shadow rays use a threshold or tint that scattered rays do not; MIS of light samples with scattered rays is
    off."""
    capture_gain: float
    """Factor of splats' captured radiance when it lights other surfaces; camera and mirror rays see the radiance
    unchanged."""
    shadow_offset: float
    """A Gaussian casts no shadow on a surface of Gaussians nearer than ``shadow_offset`` times its largest scale."""
    shadow_offset_absolute: float
    """Distance in scene units that is added to ``shadow_offset`` times a Gaussian's largest scale."""


@struct
class ShadingScene:
    """All scene data that shading reads: instances, materials, lights, environment and emissive triangles."""

    settings: wp.array[ShadingSettings]
    sample: wp.array[SampleData]
    splats: wp.array[SplatInstanceData]
    attributes: wp.array[SplatAttributes]
    """For each Gaussian asset, the attributes of its Gaussians that shading reads."""
    mesh_instances: wp.array[MeshInstanceData]
    meshes: MeshData
    materials: wp.array[MaterialData]
    """Materials of the splat instances, then of the mesh instances."""
    lights: wp.array[LightData]
    environment: EnvironmentData
    emitters: EmitterData


@struct
class SplatSurface:
    """The Gaussians on a ray as one surface that lights change, and the captured colours that the ray shows as well.

    The Gaussians are those in front of the nearest mesh.
    """

    instance: int
    """Index of the surface's splat instance; without a surface, of the frontmost Gaussian's instance; -1: no Gaussian.
    """
    gaussian: int
    """Index, in its asset, of the Gaussian that stands for the lit surface; -1: lights change none of the ray's
    Gaussians."""
    depth: float
    """Distance along the ray at which the surface is lit, scene units; inf: no surface."""
    is_mean: bool
    """True: depth and material are weighted means of all relit Gaussians on the ray. False: they are those of the
    iso-opacity surface."""
    transmittance: float
    captured: wp.vec3
    """Captured colour that the ray shows, display-referred sRGB, premultiplied by ``weight``.

    If neither a mesh nor an environment lies behind the Gaussians, the background is included."""
    weight: float
    """Fraction of the ray that ``captured`` covers: its alpha, 0..1."""
    captured_share: float
    """Sum of the blending weights of those Gaussians on the ray that show their captured colour."""
    albedo: wp.vec3
    """Linear base colour, not premultiplied, of those Gaussians on the ray that lights change."""
    share: float
    """Sum of the blending weights of those Gaussians on the ray that lights change."""


@struct
class Interaction:
    """Surface point that a ray hits: position, normals, BSDF and all else that lighting reads."""

    exists: bool
    """False: the ray hits no surface that reflects light, and all other fields are undefined."""
    position: wp.vec3
    """Position of the surface point, world space."""
    normal: wp.vec3
    """Shading normal, world space, unit, on the side of ``wo``."""
    horizon_normal: wp.vec3
    """Unit normal of the plane below which no light arrives, world space, on the side of ``wo``.

    On a mesh, it is the interpolated vertex normal without the normal map, or the triangle's normal if there are no
    vertex normals; on Gaussians, the shading normal."""
    geometric_normal: wp.vec3
    """Unit normal of the hit triangle or, for Gaussians, the shading normal; world space, on the side of ``wo``."""
    smooth_height: float
    """Height above the flat triangle, scene units, of the smooth surface that the vertex normals describe; 0 for
    Gaussians.

    It is measured along ``horizon_normal``. Shadow rays may start that high, which hides the triangles in shadow edges.
    """
    wo: wp.vec3
    """Unit direction from the surface back along the ray, world space."""
    bsdf: Bsdf
    weight: float
    """Fraction of the ray that the surface stands for; the surface's reflected light adds to the ray's radiance by it.
    """
    occlusion: float
    """Fraction of the environment's light that reaches the surface, from the material's ambient occlusion texture; 1
    without a texture."""
    shadow_catcher: bool
    """True if the surface is a shadow catcher: it reflects no light and is only darkened where lights are blocked."""


@struct
class Interactions:
    """Surface points that a wave of rays hits, two for each ray, as arrays with the fields of ``Interaction``.

    With n rays, element i is the surface of the Gaussians on ray i, and element n + i the mesh behind them. The arrays
    are written once and read for every light.
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

    ``transmitted``, ``thin_walled``, ``metallic`` and ``metal`` are empty if the scene has no rough glass."""
    thin_walled: wp.array[wp.bool]
    metallic: wp.array[float]
    metal: wp.array[wp.vec3]
    rescattered: wp.array[wp.vec3]
    """``Bsdf.rescattered`` of each interaction.

    The arrays from ``rescattered`` to ``sheen_curve`` are empty if no material has clearcoat or sheen, and rough metals
    are not energy-compensated."""
    coat: wp.array[float]
    coat_alpha: wp.array[float]
    sheen: wp.array[wp.vec3]
    sheen_alpha: wp.array[float]
    sheen_curve: wp.array[wp.vec4]
    weight: wp.array[float]
    occlusion: wp.array[float]
    shadow_catcher: wp.array[wp.bool]
    spawn_point: wp.array[wp.vec3]
    """Origin of shadow rays from each interaction, world space.

    ``spawn_point``, ``spawn_t_min`` and ``geometric_normal`` are empty in frames without shadow rays."""
    spawn_t_min: wp.array[float]
    """Distance along a shadow ray, scene units; nearer Gaussians do not block the ray if they are of the layer where
    it starts."""
    geometric_normal: wp.array[wp.vec3]
    """Unit normal, world space, on the side of the arriving ray: of the hit triangle, or of the layer of flat
    Gaussians.

    It is zero if the Gaussian at the surface is not flat or is seen from behind."""
    smooth_height: wp.array[float]


@struct
class Contribution:
    """Radiance that an unshadowed light adds to a ray at a surface, with direction and length of the shadow ray."""

    direction: wp.vec3
    """Unit direction of the shadow ray, from the surface towards the light."""
    distance: float
    color: wp.vec3
    """Linear radiance that the light adds to the ray if nothing blocks it; zero: no shadow ray is needed."""


@struct
class RayRadiance:
    """Radiance of a wave of rays; display-referred captured colour and linear light are in separate arrays."""

    captured: wp.array[wp.vec3]
    """Captured colour, display-referred sRGB, premultiplied by ``captured_weight``.

    In an unlit frame, it holds all colours of the ray, including meshes and background."""
    captured_weight: wp.array[float]
    light: wp.array[wp.vec3]
    """Linear light of meshes, environment and relit splats, and changes of captured colours.

    Changes are negative where added objects block light from the captured colours."""
    alpha: wp.array[float]
    """1 - transmittance of the Gaussians; 1 if a mesh or an environment that the camera sees lies behind them."""
    capture_factor: wp.array[wp.vec3]
    """Factor of the captured colour per channel: below 1 in new shadows; empty if no splat set is a shadow catcher."""
    captured_all: wp.array[wp.vec3]
    """Linear captured colour of each ray.

    All arrays from ``captured_all`` to ``open`` are empty unless path tracing measures light on shadow catchers."""
    captured_part: wp.array[wp.vec3]
    """The part of each ray's linear captured colour that comes from a shadow catcher."""
    received: wp.array[wp.vec3]
    """1 if the path of the ray measured the irradiance of a shadow catcher, else 0; equal in all channels."""
    unshadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by the scene's lights as if the added objects were absent."""
    shadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by the scene's lights with all added objects present."""
    emitted_unshadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by surrounding splats' captured colours, without added objects."""
    emitted_shadowed: wp.array[wp.vec3]
    """Irradiance of the ray's shadow catcher by captured colours and by the added objects, which emit and block light.
    """
    ambient: wp.array[wp.vec3]
    """Ambient irradiance of the ray's shadow catcher, as the scene specifies it, without added objects."""
    open: wp.array[wp.vec3]
    """Part of the shadow catcher's ambient irradiance that no added object blocks."""
    reflection: wp.array[wp.vec3]
    """Part of ``light`` that mirror reflection and refraction contribute; empty unless the frame outputs this light
    layer."""
    albedo: wp.array[wp.vec3]
    """Linear base colour of the surfaces on the ray; empty unless the frame outputs the albedo layer."""
    emission: wp.array[wp.vec3]
    """Linear emission plus reflected ambient light on the ray; empty unless the frame outputs the emission layer."""


@struct
class WaveData:
    """A wave of rays, all of one bounce, with hits and radiance; kernels take it by reference in a 1-element array.

    By value, compilers would copy the descriptors of all arrays for each ray, which costs more than the shading itself.
    """

    from_camera: int
    """1: the wave consists of camera rays; 0: of rays from surfaces."""
    traces_paths: int
    """1: the path integrator traces the wave, continues each path by one ray, and adds the environment's light itself.
    """
    may_branch: int
    """1: smooth meshes spawn reflected and refracted rays if these still contribute enough to the pixel; 0: none are
    spawned."""
    rays: RayData
    meshes: MeshHits
    gaussians: GaussianHits
    interactions: Interactions
    radiance: RayRadiance
    path_weights: wp.array[float]
    """Largest channel of the factor by which each ray's radiance enters the colour of its pixel."""
    weights: wp.array[wp.vec3]
    """Factor, per channel, by which each ray's radiance adds to the colour of the ray that spawned it; empty for
    camera rays."""
    media: wp.array[wp.vec4i]
    """Up to four media that each ray is inside of: mesh instance indices plus one, 0: none; empty if no mesh is a
    medium."""
    unentered: wp.array[int]
    """For each mesh instance, 1 if a camera ray leaves the mesh's medium without having entered it, as from inside
    glass.

    The array is empty for other rays than camera rays and in scenes without media."""
    spawns_lobes: int
    """1: rough surfaces spawn one random ray within their highlight; 0: none."""
    sees_environment: wp.array[wp.bool]
    """False: the ray must not add the environment or background when it escapes. Empty: all rays add it."""
    branches: wp.array[int]
    """Number of rays, 0 or 1, that each ray spawns in three ways: by reflection, by refraction, and within a
    highlight.

    With n rays, the elements are n for reflection, n for refraction and, in frames with highlight rays, n for these."""
    branch_ends: wp.array[int]
    """Inclusive prefix sum of ``branches``; minus one, it is the index of the spawned ray in the next wave."""


@struct
class CatcherIrradiance:
    """Irradiance of shadow catchers by lights and ambient light, one element for each ray; empty without catchers."""

    unshadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by lights as if the added objects were absent."""
    shadowed: wp.array[wp.vec3]
    """Irradiance of the shadow catcher by lights with all added objects present."""
    open: wp.array[wp.vec3]
    """Sum of the transmittances, 0..1 each, of the rays that test how much ambient light reaches the shadow catcher."""
    reflectance: wp.array[wp.vec3]
    """Captured radiance divided by the irradiance that lit the shadow catcher when it was captured."""


@struct
class PathVertex:
    """A surface point of a path, reduced to what the selection of a light needs: position, normal and importance."""

    position: wp.vec3
    """Position of the surface point, world space."""
    normal: wp.vec3
    """Unit normal of the surface point on the viewer's side; zero if light from both sides counts (rough glass)."""
    importance: float
    """Sum over all lights of the estimated irradiance at the surface point. Selection probabilities are divided by it.
    """


@struct
class LightCrossing:
    """Intersection of a ray with the shape of a light: distance, radiance and pdf."""

    t: float
    """Distance along the ray; inf: the ray misses the light."""
    radiance: wp.vec3
    pdf: float
    """Pdf, per steradian, with which sampling the light would have chosen the ray's direction, for MIS."""


@struct
class LightChoice:
    """A light selected at random, and the probability of the selection."""

    number: int
    """Index of the selected light; emissive triangles together are one light after all others. -1: no light
    contributes."""
    probability: float
