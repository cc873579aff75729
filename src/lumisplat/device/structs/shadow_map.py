"""Data of deep shadow maps. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class Casters:
    """Gaussians that block light, world space."""

    means: wp.array(dtype=wp.vec3)
    rotations: wp.array(dtype=wp.quat)
    """World from Gaussian."""
    scales: wp.array(dtype=wp.vec3)
    """Standard deviations."""
    opacities: wp.array(dtype=float)


@struct
class Occluder:
    """A Gaussian as its optical depth along a ray needs it (docs/method/deep_shadow_maps.md#optical-depth)."""

    offset: wp.vec3
    """From the light to its mean, world space."""
    canonical_from_world: wp.mat33
    """Inverse of rotation times scale: the precision A is its transpose times itself."""
    absorption: float
    """Amplitude beta, per scene unit; 0: it absorbs nothing."""
    radius2: float
    """Squared distance from its mean beyond which its optical depth is negligible, scene units."""


@struct
class Passage:
    """A ray through one Gaussian."""

    depth: float
    """Optical depth of the whole line."""
    peak: float
    """Distance along the ray at which it absorbs most, scene units; behind the light if negative."""
    sharpness: float
    """sqrt(a / 2) of docs/method/deep_shadow_maps.md#optical-depth, per scene unit."""


@struct
class Footprint:
    """What of an atlas an occluder covers: where its optical depth is not negligible.

    For a point light, in the plane that touches the unit sphere in its direction (the gnomonic projection); for
    parallel light, in the plane across the light.
    """

    extent: int
    """NOTHING, SOMETHING or EVERYTHING."""
    direction: wp.vec3
    """From the light, unit."""
    cosine: float
    """Of the angle between it and the circular cone around the caster."""
    sine: float
    first: wp.vec3
    """An axis of the plane: the longer one of the occluder's shadow."""
    second: wp.vec3
    low: wp.vec2
    """From where along the two axes."""
    high: wp.vec2


@struct
class Cell:
    """A square of texels, and what surrounds it."""

    axis: wp.vec3
    """Unit, to the middle of a cone; of parallel light, the middle itself, from the light's origin."""
    cosine: float
    """Of half the cone's angle; below 0, the cell is not bounded."""
    sine: float
    """Of parallel light, the cell's radius, scene units."""
    parent: int
    """The cell, of those twice narrowed down before, that it lies in."""


@struct
class Column:
    """The bins of a texel that are tabulated."""

    first: int
    """Bin."""
    count: int
    """0: none, nothing is in the way."""
    offset: int
    """Of its first bin in the table."""


@struct
class Table:
    """The tabulated transmittances of an atlas."""

    slots: wp.array(dtype=int)
    """Of each tile of the atlas, where its columns are; -1: nowhere, nothing is in the way."""
    columns: wp.array(dtype=Column)
    """Those of a slot's texels follow one another."""
    values: wp.array(dtype=float)
    """Of each column, from its first bin on."""


@struct
class Receivers:
    """Gaussians that look at a shadow map, world space; points, if only ``means`` is there."""

    means: wp.array(dtype=wp.vec3)
    rotations: wp.array(dtype=wp.quat)
    """World from Gaussian."""
    scales: wp.array(dtype=wp.vec3)


@struct
class Shade:
    """What surrounds all that casters can darken."""

    axis: wp.vec3
    """Unit, of a cone from the light; of parallel light, a point on the axis of a cylinder, from the atlas's origin."""
    radius: float
    """Half the cone's angle, radians; of parallel light, scene units."""


@struct
class Look:
    """Where receivers look."""

    pattern: int
    """CENTER, STENCIL or RANDOM."""
    count: int
    """Points a receiver."""
    seed: wp.uint32
