"""Data of light: lights, materials where they meet a ray, and samples of both. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct

LIGHT_POINT = wp.constant(0)
"""Also a sphere."""
LIGHT_SPOT = wp.constant(1)
LIGHT_DIRECTIONAL = wp.constant(2)
LIGHT_RECT = wp.constant(3)
LIGHT_ENVIRONMENT = wp.constant(4)
LIGHT_HEADLIGHT = wp.constant(5)
"""At the eye of the camera, without falloff or shadow: a white surface that faces it looks white."""

BSDF_SIMPLE = wp.constant(0)
BSDF_PBR = wp.constant(1)


@struct
class LightData:
    """A light, world space."""

    kind: int
    """LIGHT_POINT and so on."""
    position: wp.vec3
    direction: wp.vec3
    """Unit: axis of a spot, the way that directional light travels, normal of a rectangle."""
    power: wp.vec3
    """Linear Rec.709: candela of points and spots, lux of directional light, radiance of rectangles, factor of the
    environment's image."""
    edge_u: wp.vec3
    edge_v: wp.vec3
    range: float
    radius: float
    """Of a point or spot, scene units; of directional light, radians."""
    inner: float
    """1 - cosine of the angle from its axis within which a spot is as bright."""
    outer: float
    """The same of the angle at which it is dark: small cones need the digits that a cosine near 1 loses."""
    casts_shadow: int


@struct
class EnvironmentData:
    """The environment's image, and how to pick directions by its brightness."""

    exists: int
    """0: there is none."""
    visible: int
    """1: rays from the camera see it."""
    world_from_environment: wp.mat33
    """Rotation."""
    power: wp.vec3
    """Factor of the image."""
    texels: wp.array(dtype=wp.vec3)
    width: int
    height: int
    row_ends: wp.array(dtype=float)
    """Cumulative share of the light of the rows above the end of each."""
    column_ends: wp.array(dtype=float)
    """The same within each row, of the texels left of the end of each."""


@struct
class LightSample:
    """A direction in which a surface looks for a light, and what comes from there."""

    direction: wp.vec3
    """Unit, away from the surface."""
    distance: float
    """inf: infinitely far."""
    irradiance: wp.vec3
    """Of a surface that faces it, if nothing is in the way; an estimate where the sample is random."""
    density: float
    """Of the direction, per steradian; 0 where it is the only one."""


@struct
class Bsdf:
    """A material at a point of a surface: what it does with light."""

    model: int
    """BSDF_SIMPLE or BSDF_PBR."""
    diffuse: wp.vec3
    """Albedo of the diffuse part; of BSDF_PBR before Fresnel's share is taken off."""
    specular: wp.vec3
    """BSDF_SIMPLE: albedo of the highlight. BSDF_PBR: reflectance at normal incidence."""
    grazing: float
    """BSDF_PBR: reflectance at grazing incidence."""
    alpha: float
    """BSDF_PBR: alpha of the GGX distribution, roughness squared; 0: smooth, the highlight is left to mirrors."""
    shininess: float
    """BSDF_SIMPLE: exponent of the highlight."""


@struct
class BsdfSample:
    """A direction picked by a material."""

    direction: wp.vec3
    """Unit, away from the surface."""
    weight: wp.vec3
    """BSDF times cosine over density; zero: there is no such direction."""
    density: float
    """Per steradian."""
