"""Data of packets, the rays that traverse the trees together: the nodes that wait for them, and the hits they keep."""

import warp as wp

from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.scene import SplatInstanceData


@struct
class Slabs:
    """The bound of a packet of rays, made ready to be cut with boxes.

    Six planes, up and down along three axes. As the packet widens, each bounds t by ``b * factor + term``, b being its
    distance from the box's plane: from above (far) where the packet leaves the slab through it, from below (near)
    where it comes in. Where a plane gives no such bound, the factor is 0 and the term, ``void``, is FAR or -FAR.
    """

    low: wp.vec3
    """Lower corner of a box around the origins, widened by the rays' footprints."""
    high: wp.vec3
    slow: wp.vec3
    """Least components of the directions, over their squared length: what they are long where a mean is projected."""
    fast: wp.vec3
    """Largest components, likewise."""
    up_far: wp.vec3
    up_far_void: wp.vec3
    up_near: wp.vec3
    up_near_void: wp.vec3
    down_far: wp.vec3
    down_far_void: wp.vec3
    down_near: wp.vec3
    down_near_void: wp.vec3


@struct
class PacketRays:
    """The rays of a packet, one lane each; local arrays of a kernel."""

    origin: wp.array(dtype=float, ndim=2)
    """x, y and z by lane, in the space of the tree that is traversed."""
    direction: wp.array(dtype=float, ndim=2)
    t_min: wp.array[float]
    limit: wp.array[float]
    """How far the ray is traced; -FAR: no farther, or not at all."""
    path_length: wp.array[float]
    """Length of the path before the origin."""
    spread: wp.array[float]
    """Width of the footprint over the length of the path."""
    footprint: wp.array[float]
    """Standard deviation by which Gaussians are widened over that length, in the space of the tree."""
    t_max: wp.array[float]
    """Gaussians of the tree that is traversed count up to here; -FAR: none does."""
    group: int
    """The threads that traverse in step with this one; 0: none."""


@struct
class PacketPlace:
    """Which of the trees of a scene a packet traverses."""

    number: int
    """The instance whose tree it is, or WORLD."""
    instance: SplatInstanceData
    """That instance; for WORLD, of no meaning."""
    slabs: Slabs
    """The bound of the packet's rays, in the space of the tree."""


@struct
class WaitingNode:
    """A node that a packet still has to visit."""

    entry: float
    """No ray of the packet is in the node's box before this distance."""
    floor: float
    """Least entry of this node and of those below it, on a stack that is visited near first."""
    link: int
    """The node among those of its tree."""
    instance: int
    """The instance whose tree it is of, or WORLD."""


@struct
class TreeRay:
    """A single ray in the space of a tree."""

    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3
    """Of its components, finite."""
    footprint: float
    """Standard deviation by which Gaussians are widened over the length of the path."""
    path_length: float
    slabs: Slabs
    """Its bound; for rays that have a footprint, and for Gaussians that are hit at their means."""


@struct
class WaitingLink:
    """A child of a node that a single ray still has to visit."""

    entry: float
    """Where the ray enters its box."""
    link: int
    """As those of ``Node``."""


@struct
class Hit:
    """Where a ray hits a Gaussian."""

    t: float
    """The distance by which hits are ordered."""
    alpha: float
    index: int
    """Among all Gaussians of the scene."""


@struct
class ParticleHit:
    """Where a single ray hits a Gaussian."""

    t: float
    """The distance by which hits are ordered; FAR: it does not."""
    distance2: float
    """Squared canonical distance at the peak of the response."""
    is_near: bool
    """It is within the offset of the ray: it counts if the Gaussian is of another layer."""


@struct
class HitList:
    """Hits of one ray, sorted, in its own slots of an array of Hit."""

    begin: int
    """First slot of the ray."""
    head: int
    """Slot of the first hit; those before it were blended."""
    tail: int
    """The slot after the last hit."""
