"""Data of paths of light: where each stands, and where it goes on. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.rays import RayData
from lumisplat.device.structs.shading import Contribution

LEAVES_RECEIVER: float = wp.constant(-1.0)
"""In place of a density: the ray leaves a shadow-only surface, whose lights all count by their own samples."""


@struct
class PathData:
    """The paths of a wave, one element a ray."""

    root: wp.array[int]
    """The ray of the first wave that the path began with."""
    throughput: wp.array[wp.vec3]
    """Factor of what the ray sees in the colour of that ray."""
    density: wp.array[float]
    """With which the direction of the ray was sampled, per steradian; 0: it was the only one; LEAVES_RECEIVER."""
    position: wp.array[wp.vec3]
    """Of the surface where the ray begins, as ``PathVertex``."""
    normal: wp.array[wp.vec3]
    importance: wp.array[float]
    is_specular: wp.array[wp.bool]
    """Whether all surfaces before were smooth: the path shows what the camera sees in mirrors."""
    receives: wp.array[wp.bool]
    """Whether it brings what a shadow-only surface receives, in place of what its first ray sees."""
    diffuse: wp.array[wp.vec3]
    """Share of what it brings that the first surface has scattered diffusely; without elements in frames without
    layers."""
    media: wp.array[wp.vec4i]
    """The media that the ray has entered, as ``Boundary``; without elements in scenes without media."""


@struct
class PathSteps:
    """Where the paths of a wave go on, one element a ray: a ray of the next wave."""

    goes_on: wp.array[int]
    """0: the path ends here, and the other fields are undefined."""
    places: wp.array[int]
    """Inclusive sum of these: one more than the place of the ray in the next wave."""
    rays: RayData
    """Their origins, directions and widths; its other fields are without elements."""
    paths: PathData
    """All but their roots."""


@struct
class PathShadowRays:
    """Shadow rays of a wave of paths, and what lights contribute along them.

    Element ``ray`` leads from the surface to a sampled light; element ``stride + ray``, if there are so many, is the
    ray itself up to a light that it shows.
    """

    rays: RayData
    """Active where the light has a shadow."""
    contributions: wp.array[wp.vec3]
    """Without shadows."""
    opaque: wp.array[wp.bool]
    """Whether glass blocks the ray: towards lights that rays find through it."""
    skips: wp.array[wp.bool]
    """Whether it passes shadow-only sets: from one of them."""
    media: wp.array[wp.vec4i]
    """Those at its origin, as ``Boundary``, unless glass blocks it; without elements where none absorbs."""
    lights: wp.array[int]
    """Number of the light."""
    diffuse: wp.array[wp.vec3]
    """As of `PathData`, after this surface; without elements in frames without layers."""
    sent: wp.array[wp.vec3]
    """What the light alone would contribute, by its own samples; without elements unless frames ask for ``lights``."""
    reaching: wp.array[wp.vec3]
    """The same, less what the medium absorbs on a way that glass ends; so, too."""


PART_DIRECT_DIFFUSE: int = wp.constant(0)
PART_INDIRECT_DIFFUSE: int = wp.constant(1)
PART_DIRECT_GLOSSY: int = wp.constant(2)
PART_INDIRECT_GLOSSY: int = wp.constant(3)
PART_EMISSION: int = wp.constant(4)
PARTS: int = wp.constant(5)


@struct
class PathImages:
    """What paths bring, added up for the ray of the first wave that each began with; linear.

    Layers have no elements unless the frame asks for them.
    """

    light: wp.array[wp.vec3]
    """All of it."""
    parts: wp.array[wp.vec3]
    """By PART_DIRECT_DIFFUSE and so on: row after row of one element a ray, like the next ones."""
    bounces: wp.array[wp.vec3]
    """By how often surfaces have scattered it: at most once more than paths bounce."""
    lights_sent: wp.array[wp.vec3]
    """By light: what the first surface would reflect of it, unshadowed, by samples of the light alone."""
    lights_arrived: wp.array[wp.vec3]
    """What arrives of these samples."""
    lights_total: wp.array[wp.vec3]
    """All of each light; the last row is what shines and is no light."""
    received: wp.array[wp.vec3]
    """1 where a path finds the next two, else 0."""
    sent: wp.array[wp.vec3]
    """Irradiance of shadow catchers by lights, as captured; without elements in frames without such sets."""
    arrived: wp.array[wp.vec3]
    """The same with all that was added."""
    own_sent: wp.array[wp.vec3]
    """Irradiance of shadow catchers by the captures around them, as captured."""
    own_arrived: wp.array[wp.vec3]
    """The same with all that was added, and what added surfaces emit."""
    ambient: wp.array[wp.vec3]
    """Ambient irradiance of shadow catchers."""
    open: wp.array[wp.vec3]
    """The part of it that nothing added blocks."""


@struct
class PathStep:
    """Where one path goes on, before chance ends it; without weight: nowhere."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    layer_normal: wp.vec3
    """Of the surface, as of ``RayData``."""
    path_length: float
    """Behind the origin, to the unfolded eye, scene units, as of its ray; 0 where a surface has scattered the path:
    what it receives does not depend on who looks."""
    spread: float
    weight: wp.vec3
    """Factor of the throughput, but for the probability of the branch."""
    density: float
    """With which the direction was sampled, per steradian; 0: it is the only one."""
    diffuse: wp.vec3
    """Share of the weight that is diffuse."""
    media: wp.vec4i
    """Those that its ray has entered, as ``Boundary``."""


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
    density: float
    """With which samples of the light have this direction, per steradian."""


@struct
class LightChoice:
    """One of the lights, chosen at random."""

    number: int
    """-1: no light shines here."""
    probability: float


@struct
class SampledLight:
    """What one sample of a light contributes at a surface of a path."""

    contribution: Contribution
    """Weighted against what the path's own ray meets of the light."""
    sent: wp.vec3
    """Its colour, unweighted."""


@struct
class Branch:
    """One of the ways on which a path may go on."""

    kind: int
    """BRANCH_NONE and so on."""
    probability: float


BRANCH_NONE: int = wp.constant(-1)
BRANCH_SPLATS: int = wp.constant(0)
"""Scattered by the surface of the Gaussians."""
BRANCH_MESH: int = wp.constant(1)
"""Scattered by the mesh."""
BRANCH_REFLECTED: int = wp.constant(2)
"""Reflected by a smooth mesh."""
BRANCH_REFRACTED: int = wp.constant(3)
"""Refracted by it."""
