"""Data of packets: rays that traverse the trees together, and the lists of what they still visit and blend."""

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.structs.declare import struct
from lumisplat.device.structs.scene import SplatInstanceData


@struct
class Slabs:
    """The bound of a packet of rays, made ready to be cut with boxes.

    Six planes, up and down along three axes. As the packet widens, each bounds t by ``b * factor + term``, b being its
    distance from the box's plane: from above (far) where the packet leaves the slab through it, from below (near)
    where it comes in. Factors and terms of the bound that a plane does not give make it void.
    """

    low: wp.vec3
    """Lower corner of a box around the origins."""
    high: wp.vec3
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
    """The rays of a packet, one lane each; arrays on the stack of a thread."""

    origin: wp.array(dtype=float, ndim=2)
    """x, y and z, and the lane; in the space of the packet's place."""
    direction: wp.array(dtype=float, ndim=2)
    t_min: wp.array(dtype=float)
    limit: wp.array(dtype=float)
    """End of the ray; -FAR: it is not of the packet, or opaque."""
    t_max: wp.array(dtype=float)
    """End of the ray at the packet's place; -FAR: it does not see the Gaussians there."""


@struct
class PacketPlace:
    """Where a packet of rays is in the trees of a scene."""

    number: int
    """The instance whose tree it traverses, or WORLD or NOWHERE."""
    instance: SplatInstanceData
    """That instance."""
    slabs: Slabs
    """The bound of its rays, in the space of the instance."""


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
    """Whose tree it is of, or WORLD."""


@struct
class Hit:
    """Where a ray hits a Gaussian."""

    t: float
    alpha: float
    index: int
    """Among all Gaussians of the scene."""


@struct
class HitList:
    """Sorted hits of one ray, in its slots of an array of Hit."""

    begin: int
    """The first slot."""
    head: int
    """The first hit; what was before it has been blended."""
    tail: int
    """Behind the last hit."""
