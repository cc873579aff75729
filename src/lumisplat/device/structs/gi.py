"""Data of global illumination in real time: surfaces, and what lights them. One struct is one noun of the method."""

import warp as wp

from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.rays import RayData


@struct
class SurfacePixels:
    """The surfaces of one kind, Gaussians' or meshes', that the pixels of a frame show: its G-buffer.

    One element a pixel, row by row.
    """

    share: wp.array[float]
    """How much of the pixel they are, 0..1; 0: there is none, and the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World space."""
    normal: wp.array[wp.vec3]
    """Shading normal, unit, towards the viewer."""
    distance: wp.array[float]
    """From the eye, scene units."""
    extent: wp.array[float]
    """How far the surface may be from where it is said to be, scene units: the largest scale of its Gaussian; 0 for
    meshes."""
    albedo: wp.array[wp.vec3]
    """Share of even light that it reflects diffusely to the viewer, linear."""
    glossy_albedo: wp.array[wp.vec3]
    """Share that its highlight reflects."""
    alpha: wp.array[float]
    """Width of the highlight, as of ``Bsdf``."""
    previous: wp.array[wp.vec3]
    """Where the point of the surface was in the frame before, world space; NaN: it was not there."""


@struct
class InstanceMotion:
    """Where an instance was in the frame before: one a splat or mesh instance, in the order of the scene's."""

    is_known: int
    """0: it was not there."""
    deforms: int
    """1: its Gaussians or vertices have moved on their own."""
    before_from_now: wp.mat33
    """Where points of the world that move with it were; linear part."""
    before_from_now_offset: wp.vec3
    before_from_object: wp.mat33
    """World of the frame before from object; linear part."""
    before_from_object_offset: wp.vec3
    means: wp.array[wp.vec3]
    """Those of its Gaussians then, object space; like the next two without elements unless it deforms."""
    rotations: wp.array[wp.quat]
    positions: wp.array[wp.vec3]
    """Those of the vertices then, where ``MeshData`` has those of now."""


@struct
class LightHistory:
    """Light of surfaces of one kind as means over frames, one element a pixel, row by row.

    Each surface has two values, diffuse and glossy as ``SurfaceLight``: moments are those of two luminances.
    """

    frames: wp.array[float]
    """In the means; 0: there is no history."""
    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    moments: wp.array[wp.vec4]
    """Means of the luminance and of its square; diffuse, then glossy."""


@struct
class PixelHistory:
    """One element of `LightHistory`."""

    frames: float
    diffuse: wp.vec3
    glossy: wp.vec3
    moments: wp.vec4


@struct
class ShownPixels:
    """What the pixels of a frame show, before and while it is averaged with the frames before; row by row."""

    color: wp.array[wp.vec3]
    """Linear radiance."""
    motion: wp.array[wp.vec3]
    """In pixels, of the surface that ends the pixel or of the background, and its distance; NaN: it was not there."""
    instance: wp.array[int]
    """Of that surface, as ``FirstSurface``; -1: the background."""
    place: wp.array[wp.vec2]
    """Where the pixel was in the frame before, in pixels from the centre of the first."""
    weight: wp.array[float]
    """Of this frame in the mean, 0..1; 1: there is no history."""


@struct
class LightChange:
    """How the light of a few neighbouring pixels differs from their histories."""

    sampled: float
    """Sum of the luminances of the samples."""
    expected: float
    """Sum of those of the histories."""
    variance: float
    """Of the first sum."""
    brighter: float
    """Pixels whose sample is brighter than their history."""
    count: float
    """Pixels."""
    lowest: float
    """Luminance of the darkest sample, of pixels with short histories, too; inf: there is none."""
    highest: float
    """That of the brightest one."""


@struct
class FilteredLight:
    """Light of surfaces of one kind as means over pixels, one element a pixel, row by row."""

    diffuse: wp.array[wp.vec3]
    glossy: wp.array[wp.vec3]
    variance: wp.array[wp.vec2]
    """Of the luminance of each."""


@struct
class ShownHistory:
    """What pixels have shown as means over frames, one element a pixel, row by row."""

    frames: wp.array[float]
    """In the mean; 0: there is no history."""
    color: wp.array[wp.vec3]
    """Linear radiance."""
    sample: wp.array[float]
    """Luminance of the last frame's sample."""
    change: wp.array[float]
    """Mean of the squared differences between the luminances of successive samples."""
    instance: wp.array[int]
    """Of the nearest surface that the 3 x 3 pixels around showed in the last frame, as ``FirstSurface``; -1: none."""


@struct
class PixelLight:
    """One light sample a ray of the first wave, for one of its two surfaces."""

    slot: wp.array[int]
    """Which of the ray's interactions it lights: 0, Gaussians, or 1, a mesh; -1: neither."""
    diffuse: wp.array[wp.vec3]
    """Unshadowed radiance that the surface, as if it were all of the pixel, reflects diffusely; linear."""
    glossy: wp.array[wp.vec3]
    """The rest of what it reflects."""


@struct
class SurfaceLight:
    """What surfaces of one kind receive and reflect, one element a pixel, row by row."""

    is_sampled: wp.array[wp.bool]
    """Whether there is a sample in this frame; if not, the other fields are undefined."""
    diffuse: wp.array[wp.vec3]
    """Diffusely reflected radiance over the albedo, linear."""
    glossy: wp.array[wp.vec3]
    """Radiance reflected otherwise, linear."""


@struct
class LobeRays:
    """Rays within the highlights of what pixels show, at most one a square of 2 x 2 pixels; squares row by row."""

    pixel: wp.array[int]
    """The pixel of the square whose surface sends a ray."""
    slot: wp.array[int]
    """Which of its surfaces: 0, Gaussians, or 1, a mesh; -1: there is no ray."""
    ray: wp.array[int]
    """Number of the ray."""
    weight: wp.array[wp.vec3]
    """Of what the ray sees, in what the highlight reflects over its albedo."""
    seen: wp.array[wp.vec3]
    """Radiance, one element a ray; linear."""


@struct
class LightGrid:
    """Of many lights, the few among which the surfaces of a cell of the world choose (docs/method/realtime.md)."""

    cell_of: wp.array[int]
    """The cell of each ray's surface, -1: it has none; without elements: all surfaces choose among all lights."""
    numbers: wp.array[int]
    """Numbers of the lights of each cell, `GRID_LIGHTS` and one more; -1: there are no more."""
    chances: wp.array[float]
    """The probability of each to be among those of its cell; of the one more 0: nothing chooses it."""


@struct
class EmitterBox:
    """A box around Gaussians of a capture that is sampled as a light, world space."""

    center: wp.vec3
    box_from_world: wp.mat33
    """Rotation."""
    half: wp.vec3
    """Half its edges, scene units."""
    power: float
    """About the luminance times the area of what is in it; above 0."""


@struct
class BouncedRays:
    """What rays that leave surfaces see, but for the light that the surfaces which they meet reflect."""

    seen: wp.array[wp.vec3]
    """Radiance of captures, and of what shines and is no light; linear."""
    share: wp.array[wp.vec3]
    """Of the surface that the ray meets, in the radiance of the ray; 0: it meets none."""
    sampled: wp.array[wp.vec3]
    """Radiance that this surface reflects of a sampled light, unshadowed; linear."""


@struct
class OnwardRays:
    """Rays of `BouncedRays` that go on at smooth surfaces; without elements where there are none."""

    rays: RayData
    """Where the next wave begins; a ray that has met its surface is not active."""
    goes_on: wp.array[int]
    """1: the ray is active."""
    way: wp.array[float]
    """Its length before, scene units."""
    mirrored: wp.array[int]
    """1: a mirror has reflected it, in whose light it sees lamps."""
    weights: wp.array[wp.vec3]
    """Share of what it sees in the radiance of the first one."""
    media: wp.array[wp.vec4i]
    """The media that it has entered, as ``Boundary``; without elements: none."""


# --- Screen probes (docs/method/realtime.md#screen-probes) ---


@struct
class ProbeGrid:
    """How probes lie on the pixels of a frame. Lives in a 1-element array.

    Probe ``t`` is that of tile ``t``, row by row; those behind the tiles' are adaptive ones.
    """

    width: int
    height: int
    tile: int
    """Side of a tile, pixels."""
    tiles_x: int
    tiles_y: int
    adaptive: int
    """Most adaptive probes."""
    cells: int
    """Cells along a side of a probe's map."""
    history: float
    """Most samples that a cell's mean counts for."""
    offset: float
    """Scales of a Gaussian within which Gaussians do not block the rays of its probe."""
    frame: int
    has_history: int
    """0: the frame before is another sequence's."""
    seed: wp.uint32


@struct
class ProbeData:
    """Probes: where they are, and what is known of them; one element each."""

    is_placed: wp.array[int]
    """1: the probe exists; 0: the other fields are undefined."""
    position: wp.array[wp.vec3]
    """World space."""
    pixel: wp.array[wp.vec2]
    """Where the frame shows it: the centre of a pixel."""
    normal: wp.array[wp.vec3]
    """Of the surface, unit, towards the viewer."""
    distance: wp.array[float]
    """From the eye, scene units."""
    extent: wp.array[float]
    """As of `SurfacePixels`: 0 for meshes."""
    source: wp.array[int]
    """Probe of the frame before that it continues; -1: none."""
    rounds: wp.array[int]
    """How often it has been refreshed."""
    refreshed: wp.array[int]
    """Last frame in which it was; undefined if never."""


@struct
class ProbeCells:
    """The cells of all probes, probe after probe, each row by row."""

    radiance: wp.array[wp.vec3]
    """Mean, linear."""
    nearness: wp.array[float]
    """Mean of one over the distance to what is seen; 0: the sky."""
    samples: wp.array[float]
    """How many samples the means count for; 0: they are undefined."""


@struct
class ProbeLight:
    """What pixels look up: the cells of probes, filtered and without gaps, and their harmonics."""

    exists: wp.array[int]
    """1: the probe has light; one element a probe."""
    radiance: wp.array[wp.vec3]
    """Of cells, as `ProbeCells`."""
    harmonics: wp.array[wp.vec3]
    """Nine coefficients a probe, of the order of ``lumisplat.math.sh``."""


@struct
class TileNeeds:
    """The pixels of a tile that no probe covers, and where another one should be; one element a tile."""

    uncovered: wp.array[int]
    """How many of the pixels that are looked at."""
    pixel: wp.array[int]
    """Where it should be."""
    source: wp.array[int]
    """As of `ProbeData`."""


@struct
class ProbePlace:
    """A pixel for a probe."""

    pixel: int
    """-1: there is none."""
    source: int
    """As of `ProbeData`."""
    uncovered: int
    """As of `TileNeeds`; 0 where nobody asks."""


@struct
class Match:
    """A probe of the frame before, and how far a point is from it."""

    probe: int
    """-1: none."""
    distance: float
    """Scene units; more for one that should rather not be continued."""


@struct
class Ballot:
    """What probes say of a pixel, weighted."""

    total: wp.vec3
    weight: float
