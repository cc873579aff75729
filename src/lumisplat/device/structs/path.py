"""Data of paths of light: where each stands, and where it goes on. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct


@struct
class PathData:
    """The paths of a wave, one element a ray."""

    root: wp.array[int]
    """The ray of the first wave that the path began with."""
    throughput: wp.array[wp.vec3]
    """Factor of what the ray sees in the colour of that ray."""
    density: wp.array[float]
    """With which the direction of the ray was sampled, per steradian; 0: it was the only one."""
    position: wp.array[wp.vec3]
    """Of the surface where the ray begins, as ``PathVertex``."""
    normal: wp.array[wp.vec3]
    importance: wp.array[float]
    is_specular: wp.array[wp.bool]
    """Whether all surfaces before were smooth: the path shows what the camera sees in mirrors."""
    media: wp.array[wp.vec4i]
    """The media that the ray has entered, as ``Boundary``; without elements in scenes without media."""


@struct
class PathSteps:
    """Where the paths of a wave go on, one element a ray: a ray of the next wave, as ``RayData`` and ``PathData``."""

    goes_on: wp.array[int]
    """0: the path ends here, and the other fields are undefined."""
    places: wp.array[int]
    """Inclusive sum of these: one more than the place of the ray in the next wave."""
    origin: wp.array[wp.vec3]
    direction: wp.array[wp.vec3]
    t_min: wp.array[float]
    path_length: wp.array[float]
    spread: wp.array[float]
    throughput: wp.array[wp.vec3]
    density: wp.array[float]
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    importance: wp.array[float]
    is_specular: wp.array[wp.bool]
    media: wp.array[wp.vec4i]


@struct
class PathStep:
    """Where one path goes on, before chance ends it; without weight: nowhere."""

    origin: wp.vec3
    direction: wp.vec3
    t_min: float
    length: float
    """From the last surface to this one, scene units."""
    spread: float
    weight: wp.vec3
    """Factor of the throughput, but for the probability of the branch."""
    density: float
    """With which the direction was sampled, per steradian; 0: it is the only one."""
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
