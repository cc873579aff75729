"""Data of trees and of the rays that traverse them: nodes, settings of rays, packets, and the hits that rays keep."""

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.structs import struct
from lumisplat.device.structs.scene import GaussianData, MeshData, MeshInstanceData, SplatInstanceData

Children = wp.types.vector(length=NODE_WIDTH, dtype=wp.float32)

ChildLinks = wp.types.vector(length=NODE_WIDTH, dtype=wp.int32)

NO_CHILD: int = wp.constant(2**31 - 1)
"""Link of an empty child."""

FAR: float = wp.constant(wp.float32(1.0e30))
"""Stands for infinity where arithmetic goes on with it: the end of rays, the corners of empty boxes."""

WORLD = wp.constant(-1)
"""In place of an instance: the tree is that over the instances, in world space."""


@struct
class Particle:
    """A Gaussian as rays hit it, 64 bytes: one cache line."""

    canonical_from_object: wp.mat33
    """Inverse of rotation times scale."""
    mean: wp.vec3
    """Object space."""
    log_opacity: float
    reach2: float
    """Squared canonical distance beyond which it is ignored; negative: it never counts."""
    index: int
    """In its asset."""
    largest_scale: float
    """Object space."""


@struct
class Box:
    """Axis-aligned box; inverted where there is nothing."""

    low: wp.vec3
    high: wp.vec3


@struct
class Node:
    """A node of a bounding volume hierarchy: the boxes of its children, one lane each."""

    low_x: Children
    low_y: Children
    low_z: Children
    high_x: Children
    high_y: Children
    high_z: Children
    link: ChildLinks
    """Child node, or ~place of an item in the order of the tree; NO_CHILD and an inverted box where there is none."""


HIT_PEAK: int = wp.constant(0)
"""Gaussians are hit where they respond most."""

HIT_HULL: int = wp.constant(1)
"""They are hit where rays enter their ellipsoid."""

HIT_MEAN: int = wp.constant(2)
"""They are ordered by where their mean projects onto the ray, and lie where they respond most."""


@struct
class AssetBvh:
    """A Gaussian set as rays hit it."""

    nodes: wp.array[Node]
    """The root first."""
    particles: wp.array[Particle]
    """In the order of the tree."""
    gaussians: GaussianData


@struct
class MeshTriangle:
    """A triangle as rays hit it, object space."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    face: int
    """Its number in its mesh."""


@struct
class TriangleBvh:
    """The triangles of some meshes as rays hit them, each mesh by a tree of its own."""

    nodes: wp.array[Node]
    """The roots first."""
    triangles: wp.array[MeshTriangle]
    """In the order of the trees."""


@struct
class MeshBvh:
    """What rays traverse to find meshes: a tree over the instances, whose leaves stand for trees of triangles."""

    tlas_nodes: wp.array[Node]
    """Top level: the tree over the instances, the root first."""
    tlas_order: wp.array[int]
    """The instance at each place of its order."""
    assets: wp.array[TriangleBvh]
    instances: wp.array[MeshInstanceData]
    meshes: MeshData


@struct
class SceneBvh:
    """What rays traverse: a tree over the instances, whose leaves stand for the trees of their assets."""

    tlas_nodes: wp.array[Node]
    """Top level: the tree over the instances, the root first."""
    instances: wp.array[SplatInstanceData]
    assets: wp.array[AssetBvh]
    packet_radius: float
    """Rays that start farther apart than this are not traced together, world space."""
    footprint: float
    """The largest of the instances'."""
    hit_distance: int
    """HIT_MEAN if that is any instance's, else that of all."""


DRAWS_NONE: int = wp.constant(0)
"""Gaussians absorb their share of a ray."""

DRAWS_PER_RAY: int = wp.constant(1)
"""Rays are blocked wholly or not at all: where their transmittance falls to a number that is drawn for each."""

DRAWS_SHARED: int = wp.constant(2)
"""The same, by a number for each Gaussian, which all rays of a sample share."""


@struct
class ShadowData:
    """Settings of shadow rays, in a 1-element array."""

    hits: int
    """How many of the nearest Gaussians count; read by shadows by first hits only."""
    draws: int
    """One of the constants above."""
    acceptance_scale: float
    """Of random numbers, 0..1: below 1, rays are blocked sooner."""
    hit_distance: int
    """HIT_PEAK or HIT_HULL, which decides the first ones."""
    transmittance_min: float
    """A transmittance up to this counts as black."""
    threshold: float
    """A transmittance up to this counts as black, too, and the rest is stretched to 0..1."""
    color_strength: float
    offset: float
    """Scales of a Gaussian within which it does not shadow a surface of Gaussians."""
    offset_absolute: float
    """Added to that, scene units."""
    seed: wp.uint32
    sample: int
    """Its number, which draws that rays share depend on."""


STRATEGY_SORTED: int = wp.constant(0)

STRATEGY_HIT: int = wp.constant(1)

STRATEGY_PASS: int = wp.constant(2)


@struct
class TraceData:
    """Settings of the ray tracer, in a 1-element array."""

    strategy: int
    """One of the constants above."""
    hits_per_pass: int
    """Of the stochastic pass."""
    hit_buffer_size: int
    """How many of its nearest hits a ray keeps sorted while it traverses the trees."""
    ellipsoid_normal: int
    """1: normals are those of that ellipsoid."""
    transmittance_min: float
    depth_iso_transmittance: float
    acceptance_scale: float
    sh_degree: int
    """Highest that is evaluated."""
    offset: float
    """Largest scales of a Gaussian beyond which it counts, even before a ray's ``t_min``; FAR: not before that."""
    offset_absolute: float
    """Added to that, scene units."""


# --- Packets: rays that traverse the trees together, the nodes that wait for them, and the hits they keep ---


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
class PacketTree:
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
class HitList:
    """Hits of one ray, sorted, in its own slots of an array of Hit."""

    begin: int
    """First slot of the ray."""
    head: int
    """Slot of the first hit; those before it were blended."""
    tail: int
    """The slot after the last hit."""
