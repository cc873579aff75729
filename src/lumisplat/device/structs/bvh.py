"""Structs of ray tracing: BVH nodes, ray tracer settings, packets of rays, traversal stacks and hits."""

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.structs import struct
from lumisplat.device.structs.scene import GaussianData, MeshData, MeshInstanceData, SplatInstanceData

Children = wp.types.vector(length=NODE_WIDTH, dtype=wp.float32)

ChildLinks = wp.types.vector(length=NODE_WIDTH, dtype=wp.int32)

NO_CHILD: int = wp.constant(2**31 - 1)
"""Link of an empty child of a node."""

FAR: float = wp.constant(wp.float32(1.0e30))
"""Finite stand-in for infinity in arithmetic: the end of unbounded rays and the corners of empty boxes."""

WORLD = wp.constant(-1)
"""Instance index that stands for the top-level BVH over all instances, whose space is world space."""


@struct
class Particle:
    """A Gaussian prepared for ray intersection; 64 bytes, one cache line."""

    canonical_from_object: wp.mat33
    """Inverse of rotation times scale: maps object space to the space where the Gaussian is a unit sphere."""
    mean: wp.vec3
    """Mean in object space."""
    log_opacity: float
    reach2: float
    """Squared canonical distance beyond which rays ignore the Gaussian; negative: rays ignore it at any distance."""
    index: int
    """Index of the Gaussian in its asset."""
    largest_scale: float
    """Largest of the three standard deviations, object space."""


@struct
class Box:
    """Axis-aligned bounding box; an empty box is inverted (low above high)."""

    low: wp.vec3
    high: wp.vec3


@struct
class Node:
    """A BVH node, which stores the boxes of its children as vectors with one lane for each child."""

    low_x: Children
    low_y: Children
    low_z: Children
    high_x: Children
    high_y: Children
    high_z: Children
    link: ChildLinks
    """Index of each child node or, for a leaf, ~index of its Gaussian, triangle or instance in BVH order.

    An empty child has the link NO_CHILD and an inverted box."""


HIT_PEAK: int = wp.constant(0)
"""The hit distance is where the Gaussian responds most along the ray."""

HIT_HULL: int = wp.constant(1)
"""The hit distance is where the ray enters the bounding ellipsoid of the Gaussian."""

HIT_MEAN: int = wp.constant(2)
"""Hits are ordered by the projection of the Gaussian's mean onto the ray.

The surface of a hit lies where the Gaussian responds most along the ray."""


@struct
class AssetBvh:
    """The BVH of one Gaussian asset."""

    nodes: wp.array[Node]
    """Nodes of the BVH, the root first."""
    particles: wp.array[Particle]
    """Gaussians in BVH order."""
    gaussians: GaussianData


@struct
class MeshTriangle:
    """A triangle prepared for ray intersection, object space."""

    a: wp.vec3
    b: wp.vec3
    c: wp.vec3
    face: int
    """Index of the triangle in its mesh."""


@struct
class TriangleBvh:
    """BVHs of several meshes, one tree for each mesh."""

    nodes: wp.array[Node]
    """Nodes of all trees, the roots first."""
    triangles: wp.array[MeshTriangle]
    """Triangles of all meshes, in the order of the trees' leaves."""


@struct
class MeshBvh:
    """The two-level BVH of all mesh instances: the leaves of the top-level tree refer to trees of triangles."""

    tlas_nodes: wp.array[Node]
    """Nodes of the top-level tree over the mesh instances, the root first."""
    tlas_order: wp.array[int]
    """Index of the mesh instance at each leaf of the top-level tree."""
    assets: wp.array[TriangleBvh]
    instances: wp.array[MeshInstanceData]
    meshes: MeshData


@struct
class SceneBvh:
    """The two-level BVH of all splat instances: the leaves of the top-level tree refer to the BVHs of their assets."""

    tlas_nodes: wp.array[Node]
    """Nodes of the top-level tree over the splat instances, the root first."""
    instances: wp.array[SplatInstanceData]
    assets: wp.array[AssetBvh]
    packet_radius: float
    """Largest distance between the origins of rays that share a packet, world space."""
    footprint: float
    """Largest ``SplatInstanceData.footprint`` of all instances, in pixel widths."""
    hit_distance: int
    """HIT_MEAN if any instance uses HIT_MEAN; else HIT_PEAK or HIT_HULL, which all instances then share."""


DRAWS_NONE: int = wp.constant(0)
"""Shadow rays are attenuated by the alpha of each Gaussian; no random numbers are drawn."""

DRAWS_PER_RAY: int = wp.constant(1)
"""Shadow rays are blocked as a whole once their transmittance falls to one random number drawn for each ray."""

DRAWS_SHARED: int = wp.constant(2)
"""Shadow rays are blocked by random Gaussians: one random number for each Gaussian, shared by all rays of a sample."""


@struct
class ShadowData:
    """Settings of shadow rays, in a 1-element array."""

    hits: int
    """Number of nearest Gaussians that attenuate a ray; used only by shadows of first hits."""
    draws: int
    """DRAWS_NONE, DRAWS_PER_RAY or DRAWS_SHARED."""
    acceptance_scale: float
    """Factor, 0..1, that the random numbers of blocking are multiplied by; below 1, more rays are blocked."""
    hit_distance: int
    """HIT_PEAK or HIT_HULL: the distance that orders the first hits."""
    transmittance_min: float
    """Transmittance at or below which a shadow is fully black."""
    threshold: float
    """Transmittance at or below which a shadow is black; transmittances above it are rescaled to 0..1."""
    color_strength: float
    offset: float
    """Distance from a surface of Gaussians, in multiples of a Gaussian's largest scale, within which the Gaussian does
    not shadow that surface."""
    offset_absolute: float
    """Distance in scene units, added to ``offset`` times the largest scale."""
    seed: wp.uint32
    sample: int
    """Index of the sample, which selects the random numbers that all shadow rays of the sample share."""


STRATEGY_SORTED: int = wp.constant(0)

STRATEGY_HIT: int = wp.constant(1)

STRATEGY_PASS: int = wp.constant(2)


@struct
class TraceData:
    """Settings of the ray tracer, in a 1-element array."""

    strategy: int
    """STRATEGY_SORTED, STRATEGY_HIT or STRATEGY_PASS."""
    hits_per_pass: int
    """Hits that one pass of STRATEGY_PASS blends."""
    hit_buffer_size: int
    """Number of nearest hits that a ray stores, sorted, while it traverses the BVH (the k of a k-buffer)."""
    ellipsoid_normal: int
    """1: the normal of a hit is that of the Gaussian's bounding ellipsoid where the ray enters the ellipsoid."""
    transmittance_min: float
    depth_iso_transmittance: float
    acceptance_scale: float
    sh_degree: int
    """Highest SH degree that is evaluated."""
    offset: float
    """Distance along the ray, in multiples of a Gaussian's largest scale, from which the Gaussian counts even before
    ``t_min``.

    With FAR, no Gaussian counts before ``t_min``, the start of the ray."""
    offset_absolute: float
    """Distance in scene units, added to ``offset`` times the largest scale."""


# --- Packets: coherent rays, their bounds, traversal stacks and hit lists ---


@struct
class Slabs:
    """Bounding volume of a packet of rays, prepared for slab tests against boxes.

    Along each axis, one plane bounds the packet from above and one from below. A box plane at coordinate b limits the
    ray distance t to ``b * factor + term``: a far limit where the packet leaves the box, a near limit where it enters.
    A plane that sets no such limit has factor 0 and a term (``void``) of FAR or -FAR.
    """

    low: wp.vec3
    """Lower corner of a box around the ray origins, widened by the footprints of the rays."""
    high: wp.vec3
    slow: wp.vec3
    """Smallest component of the ray directions along each axis, over their squared length; projects means onto the
    rays."""
    fast: wp.vec3
    """Largest component of the ray directions along each axis, over their squared length."""
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
    """The rays of a packet, one lane for each ray; local arrays of a kernel."""

    origin: wp.array(dtype=float, ndim=2)
    """Ray origins in the space of the current tree; rows x, y and z, one column for each lane."""
    direction: wp.array(dtype=float, ndim=2)
    t_min: wp.array[float]
    limit: wp.array[float]
    """Distance up to which the ray is traced; -FAR: the ray is finished, or the lane has no ray."""
    path_length: wp.array[float]
    """Length of the path from the eye to the ray's origin, over all bounces."""
    spread: wp.array[float]
    """Width of the ray's footprint divided by the path length."""
    footprint: wp.array[float]
    """Standard deviation by which the ray widens Gaussians, divided by the path length, in the space of the current
    tree."""
    t_max: wp.array[float]
    """Distance up to which Gaussians of the current tree count on the ray; -FAR: no Gaussian counts."""
    group: int
    """Bit mask of the CUDA threads that traverse in step with this one; 0: none."""


@struct
class PacketTree:
    """The tree of the scene's BVH that a packet currently traverses."""

    number: int
    """Index of the instance that the tree belongs to, or WORLD for the top-level tree."""
    instance: SplatInstanceData
    """Data of instance ``number``; undefined if ``number`` is WORLD."""
    slabs: Slabs
    """Bounding volume of the packet's rays in the space of the tree."""


@struct
class WaitingNode:
    """A stack entry: a node that a packet still has to visit."""

    entry: float
    """Smallest distance at which a ray of the packet may be inside the node's box."""
    floor: float
    """Smallest entry distance of this and all lower stack entries; set only if near nodes are visited first."""
    link: int
    """Index of the node in its tree."""
    instance: int
    """Index of the instance whose tree the node belongs to, or WORLD."""


@struct
class TreeRay:
    """A single ray in the space of a tree."""

    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3
    """Reciprocals of the direction's components, limited to finite values."""
    footprint: float
    """Standard deviation by which the ray widens Gaussians, divided by the path length."""
    path_length: float
    slabs: Slabs
    """Bounding volume of the ray; set only if the ray has a footprint or hits are ordered by means."""


@struct
class WaitingLink:
    """A stack entry: a child of a node that a single ray still has to visit."""

    entry: float
    """Distance at which the ray enters the child's box."""
    link: int
    """Index of the child node, or ~index of the leaf's item, as in ``Node.link``."""


@struct
class Hit:
    """Intersection of a ray with a Gaussian."""

    t: float
    """Distance by which hits are ordered."""
    alpha: float
    index: int
    """Index of the Gaussian among all Gaussians of the scene."""


@struct
class HitList:
    """Sorted hits of one ray, stored in the ray's range of a shared array of Hit."""

    begin: int
    """First slot of the ray's range."""
    head: int
    """Slot of the first stored hit; earlier slots hold hits that were already blended."""
    tail: int
    """Slot after the last stored hit."""
