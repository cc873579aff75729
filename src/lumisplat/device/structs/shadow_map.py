"""Data of deep shadow maps. One struct is one noun of the method (docs/method/deep_shadow_maps.md)."""

import warp as wp

from lumisplat.device.structs.declare import struct

OCTAHEDRAL: int = wp.constant(0)
CUBEMAP: int = wp.constant(1)
PARALLEL: int = wp.constant(2)

NOTHING: int = wp.constant(0)
SOMETHING: int = wp.constant(1)
EVERYTHING: int = wp.constant(2)

CENTER: int = wp.constant(0)
STENCIL: int = wp.constant(1)
RANDOM: int = wp.constant(2)


@struct
class Atlas:
    """A light and the space around it, cut into texels and bins.

    It has one face, or six for a cubemap, of ``size`` by ``size`` texels. Texels are numbered tile by tile.
    """

    layout: int
    """OCTAHEDRAL, CUBEMAP or PARALLEL."""
    size: int
    """Texels across a face, a multiple of ``TILE``."""
    origin: wp.vec3
    """The light; of parallel light, the corner of texel (0, 0)."""
    axes: wp.mat33
    """World from light, of parallel light: columns are the atlas's x and y and the way light travels."""
    texel_length: float
    """Of parallel light, scene units."""
    bins: int
    bin_length: float
    """Scene units."""


@struct
class AtlasPoint:
    """A point in an atlas."""

    face: int
    x: float
    """Texels; centres are whole numbers."""
    y: float
    distance: float
    """From the light, scene units."""


@struct
class LightRay:
    """The ray through a texel's centre."""

    origin: wp.vec3
    direction: wp.vec3
    """Unit."""


@struct
class Casters:
    """Gaussians that block light, world space."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """World from Gaussian."""
    scales: wp.array[wp.vec3]
    """Standard deviations."""
    opacities: wp.array[float]


@struct
class Occluder:
    """A caster as its optical depth along a ray needs it (docs/method/deep_shadow_maps.md#optical-depth)."""

    offset: wp.vec3
    """From the light to its mean, world space."""
    canonical_from_world: wp.mat33
    """Inverse of rotation times scale: the precision A is its transpose times itself."""
    absorption: float
    """Amplitude beta, per scene unit; 0: it absorbs nothing."""
    radius2: float
    """Squared distance from its mean beyond which its optical depth is negligible, scene units."""


@struct
class DepthProfile:
    """Optical depth of one occluder along a ray: an error function of the distance."""

    total: float
    """Optical depth of the whole line."""
    peak: float
    """Distance along the ray at which it absorbs most, scene units; behind the light if negative."""
    sharpness: float
    """sqrt(a / 2) of docs/method/deep_shadow_maps.md#optical-depth, per scene unit."""


@struct
class Footprint:
    """The part of an atlas where an occluder's optical depth is not negligible.

    For a point light, in the plane that touches the unit sphere in its direction (the gnomonic projection); for
    parallel light, in the plane across the light.
    """

    extent: int
    """NOTHING: no part. SOMETHING: the part below. EVERYTHING: all of it."""
    direction: wp.vec3
    """From the light, unit."""
    cosine: float
    """Of the angle between it and the circular cone around the caster."""
    sine: float
    first: wp.vec3
    """An axis of the plane: the longer one of the occluder's shadow."""
    second: wp.vec3
    low: wp.vec2
    """Where it begins along the two axes."""
    high: wp.vec2
    """Where it ends."""


@struct
class Cell:
    """A square of texels, and a bound of the rays through it: a cone, or for parallel light a cylinder."""

    axis: wp.vec3
    """Unit, to the middle of the cone; of parallel light, the middle itself, from the light's origin."""
    cosine: float
    """Of half the cone's angle; below 0 the cone is wider than a half space and bounds nothing."""
    sine: float
    """Of half the cone's angle; of parallel light, the cylinder's radius, scene units."""
    parent: int
    """Number of the list, among those given for culling, whose casters may intersect this cell."""


@struct
class CasterLists:
    """Lists of casters, one after another."""

    ends: wp.array[int]
    """Where each list ends and the next one begins."""
    items: wp.array[int]
    """Numbers of casters, ascending in each list."""


@struct
class Column:
    """The bins of a texel that are tabulated."""

    first: int
    """Number of the first bin."""
    count: int
    """0: no bin, the texel is lit at all distances."""
    offset: int
    """Of the first bin in the table."""


@struct
class Table:
    """The tabulated transmittances of an atlas."""

    slots: wp.array[int]
    """Slot of each tile of the atlas; -1: none of its texels has a column, they are lit."""
    columns: wp.array[Column]
    """Those of a slot's texels follow one another."""
    values: wp.array[float]
    """Transmittances of each column, bin by bin."""


@struct
class Receivers:
    """Gaussians that a shadow map is sampled for, world space."""

    means: wp.array[wp.vec3]
    rotations: wp.array[wp.quat]
    """World from Gaussian."""
    scales: wp.array[wp.vec3]
    """Standard deviations; 0: a point."""


@struct
class ShadowBound:
    """A cone from the light, or for parallel light a cylinder, around all that casters can darken."""

    extent: int
    """NOTHING: no shadow. SOMETHING: within the bound below. EVERYTHING: not bounded."""
    axis: wp.vec3
    """Unit, of the cone; of the cylinder, a point on its axis, from the atlas's origin."""
    radius: float
    """Half the cone's angle, radians; of the cylinder, scene units."""


@struct
class FootprintSampling:
    """The points of a receiver's footprint at which the map is sampled."""

    pattern: int
    """CENTER, STENCIL or RANDOM."""
    count: int
    """Points a receiver."""
    seed: wp.uint32
