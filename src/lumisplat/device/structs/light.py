"""Data of light: lights, BSDFs, and samples of both. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct

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
class RayAbsorption:
    """What a shadow ray has passed so far."""

    transmittance: float
    """0: it is blocked."""
    floor: float
    """It is blocked as soon as its transmittance falls to this."""
    tint: wp.vec3
    """Sum of linear colours, weighted by alpha."""


@struct
class LightSample:
    """A direction from a surface towards a light, and the light that comes from there."""

    direction: wp.vec3
    """Unit, away from the surface."""
    distance: float
    """inf: infinitely far."""
    irradiance: wp.vec3
    """Unshadowed, of a surface that faces it; an estimate if the sample is random."""
    density: float
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
class BsdfSample:
    """A direction sampled from a BSDF."""

    direction: wp.vec3
    """Unit, away from the surface."""
    weight: wp.vec3
    """BSDF times cosine over density; zero: no direction was found."""
    density: float
    """Per steradian."""


@struct
class CatcherLight:
    """Irradiance of a shadow catcher in one channel, as `lumisplat.baking.gaussian_views.CatcherLight`."""

    sent: float
    change: float
    own_sent: float
    own_change: float
    ambient: float
    blocked: float
    least: float
