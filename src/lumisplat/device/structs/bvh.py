"""Structs of ray tracing: BVH nodes, ray tracer settings, packets of rays, traversal stacks and hits."""

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.structs import struct
from lumisplat.device.structs.raster import TileRect
from lumisplat.device.structs.scene import GaussianData, MeshData, MeshInstanceData, SplatInstanceData

Children = wp.types.vector(length=NODE_WIDTH, dtype=wp.float32)

ChildLinks = wp.types.vector(length=NODE_WIDTH, dtype=wp.int32)

NO_CHILD: int = wp.constant(2**31 - 1)
"""Value of ``Node.link`` for an unused child of a BVH node that has fewer than NODE_WIDTH children."""

FAR: float = wp.constant(wp.float32(1.0e30))
"""1e30, a finite stand-in for infinity: the end of unbounded rays. Empty boxes have low corners at FAR, high ones at
-FAR."""

WORLD = wp.constant(-1)
"""Instance index, -1, of the top-level BVH over all splat instances; its boxes and rays are in world space."""


@struct
class Particle:
    """A Gaussian prepared for ray intersection; 64 bytes, one cache line."""

    canonical_from_object: wp.mat33
    """Inverse of rotation times scale: maps object space to the space where the Gaussian is a unit sphere."""
    mean: wp.vec3
    """Mean of the Gaussian, object space."""
    log_opacity: float
    reach2: float
    """Squared distance from the mean, in standard deviations, up to which rays hit the Gaussian; negative: rays never
    hit it."""
    index: int
    """Index of the Gaussian in its asset; the asset's order differs from the order of the BVH."""
    largest_scale: float
    """Largest of the three standard deviations, object space."""


@struct
class Box:
    """Axis-aligned bounding box; an empty box is inverted (low above high)."""

    low: wp.vec3
    high: wp.vec3


@struct
class Node:
    """A BVH node: the boxes of its children, as vectors with one lane for each child, and the children's links."""

    low_x: Children
    low_y: Children
    low_z: Children
    high_x: Children
    high_y: Children
    high_z: Children
    link: ChildLinks
    """For each child, the index of a node (>= 0); or, for a leaf, ``~index`` (< 0) of a Gaussian, triangle or
    instance.

    Leaves index the arrays that are sorted in BVH order. An empty child has the link NO_CHILD and an inverted box."""


HIT_PEAK: int = wp.constant(0)
"""Hit distance of a ray and a Gaussian: the point on the ray where the Gaussian's response is largest."""

HIT_HULL: int = wp.constant(1)
"""Hit distance of a ray and a Gaussian: the point where the ray enters the Gaussian's bounding ellipsoid."""

HIT_MEAN: int = wp.constant(2)
"""Hit distance of a ray and a Gaussian: the projection of the Gaussian's mean onto the ray.

It only sorts hits. The depth of the iso-opacity surface is taken where the Gaussian's response is largest."""


@struct
class AssetBvh:
    """The BVH of one Gaussian asset."""

    nodes: wp.array[Node]
    """Nodes of the BVH, the root first."""
    particles: wp.array[Particle]
    """Gaussians of the asset in the order of the BVH's leaves; ``Node.link`` indexes this array."""
    gaussians: GaussianData


@struct
class Candidate:
    """A Gaussian that camera rays may hit, as the lists of image tiles refer to it; 16 bytes."""

    blocks: TileRect
    """Squares of ``RAY_BLOCK_PX`` pixels, counted from the corner of the image, whose rays may hit the Gaussian."""
    floor: float
    """Lower bound of the distance by which hits of the Gaussian are sorted, on any camera ray; lists are sorted by it.
    """
    instance: int
    """Index of the Gaussian's splat instance."""


@struct
class CandidateLists:
    """The Gaussians that the camera rays of each image tile may hit.

    ``candidates`` and ``particles`` have one element for each Gaussian, counted over all splat instances.
    """

    starts: wp.array[int]
    """Index in ``items`` of the first candidate of each tile; the last element is the length of ``items``."""
    items: wp.array[int]
    """Indices of the candidates of each tile, tile after tile, sorted by ``Candidate.floor``."""
    candidates: wp.array[Candidate]
    particles: wp.array[Particle]
    blocks_x: int
    """Number of squares of ``RAY_BLOCK_PX`` pixels, the rays of a packet, across the image."""
    blocks_y: int
    tiles_x: int
    """Number of tiles across the image."""


@struct
class TriangleLeaf:
    """A leaf of a mesh's BVH: up to NODE_WIDTH triangles, object space, one in each lane of the vectors.

    All corners of an unused lane are at one point, so that no ray hits it.
    """

    a_x: Children
    a_y: Children
    a_z: Children
    b_x: Children
    b_y: Children
    b_z: Children
    c_x: Children
    c_y: Children
    c_z: Children
    face: ChildLinks
    """Index of each triangle in its mesh; -1: the lane is unused."""


@struct
class TriangleBvh:
    """BVHs of several meshes in shared arrays, one tree for each mesh."""

    nodes: wp.array[Node]
    """Nodes of the trees of all meshes: first the root of each tree, then all other nodes."""
    leaves: wp.array[TriangleLeaf]
    """Leaves of the trees of all meshes."""


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
    """Rays may share a packet only if their origins are at most this far apart, world space."""
    footprint: float
    """Largest standard deviation by which rays widen the Gaussians of any splat instance, in pixel widths."""
    hit_distance: int
    """HIT_MEAN if any splat instance uses HIT_MEAN; else HIT_PEAK or HIT_HULL, whichever all instances use."""
    eye_colors: wp.array[wp.vec3]
    """Display-referred colour of each Gaussian of the scene, as seen from the eye where all rays start.

    Empty if rays start anywhere; they then evaluate the colours of the Gaussians that they hit."""
    eye_normals: wp.array[wp.vec3]
    """World-space unit normal of each Gaussian's max-density plane, towards the eye; as long as ``eye_colors``.

    Zero: the normal is not that of this plane, and depends on the ray."""


DRAWS_NONE: int = wp.constant(0)
"""Each Gaussian attenuates a shadow ray by ``1 - alpha``; no random numbers are drawn."""

DRAWS_PER_RAY: int = wp.constant(1)
"""Stochastic shadows: each ray has one random number, and is blocked as soon as its transmittance falls to this
number."""

DRAWS_SHARED: int = wp.constant(2)
"""Stochastic shadows: each Gaussian has one random number for all rays of a sample, and is opaque if it is below
alpha.
"""


@struct
class ShadowData:
    """Settings of shadow rays, in a 1-element array."""

    hits: int
    """With ``ShadowMethod.FIRST_HITS``: number of nearest Gaussians that attenuate a shadow ray; other methods ignore
    it."""
    draws: int
    """Random numbers of shadow rays: DRAWS_NONE, DRAWS_PER_RAY or DRAWS_SHARED."""
    acceptance_scale: float
    """Stochastic shadows: a Gaussian blocks rays with probability ``min(alpha / acceptance_scale, 1)``; above 0, at
    most 1."""
    hit_distance: int
    """Distance by which ``ShadowMethod.FIRST_HITS`` finds the nearest Gaussians: HIT_PEAK or HIT_HULL."""
    transmittance_min: float
    """Without stochastic shadows: a shadow ray ends as blocked once its transmittance falls to this value."""
    threshold: float
    """Artistic threshold T: a shadow is black at transmittances up to T, and ``(transmittance - T) / (1 - T)`` above.
    """
    color_strength: float
    offset: float
    """A Gaussian casts no shadow on a surface of Gaussians nearer than ``offset`` times its largest scale.

    Gaussians of another layer than the surface's always cast shadows."""
    offset_absolute: float
    """Distance in scene units that is added to ``offset`` times a Gaussian's largest scale."""
    seed: wp.uint32
    sample: int
    """Index of the pixel sample; with DRAWS_SHARED, it selects the random numbers that all shadow rays share."""


STRATEGY_SORTED: int = wp.constant(0)

STRATEGY_HIT: int = wp.constant(1)

STRATEGY_PASS: int = wp.constant(2)


@struct
class TraceData:
    """Settings of the ray tracer, in a 1-element array."""

    strategy: int
    """How hits are found and blended: STRATEGY_SORTED, STRATEGY_HIT (one random hit) or STRATEGY_PASS (random after k
    hits)."""
    hits_per_pass: int
    """STRATEGY_PASS: number of nearest hits that are blended before the ray ends or continues at random."""
    hit_buffer_size: int
    """Number of nearest hits that a ray stores, sorted, while it traverses the BVH (the k of a k-buffer)."""
    ellipsoid_normal: int
    """1: a hit has the normal of the Gaussian's bounding ellipsoid at the point where the ray enters. 0: it has the
    Gaussian's normal."""
    transmittance_min: float
    depth_iso_transmittance: float
    acceptance_scale: float
    sh_degree: int
    """Highest SH degree, 0 to 3, at which the colours of hit Gaussians are evaluated."""
    offset: float
    """Rays that start at a surface may hit a Gaussian from ``offset`` times its largest scale on, even before
    ``t_min``.

    Camera rays use FAR: every Gaussian can then be hit from ``t_min`` on only."""
    offset_absolute: float
    """Distance in scene units that is added to ``offset`` times a Gaussian's largest scale."""


# --- Packets: coherent rays, their bounds, traversal stacks and hit lists ---


@struct
class Slabs:
    """Bounding volume of a packet of rays, prepared for slab tests against boxes.

    Along each axis, one plane bounds the packet from above and one from below. A box plane at coordinate b limits the
    ray distance t to ``b * factor + term``. The limit is far where the packet leaves the box, and near where it enters.
    A plane that sets no such limit has factor 0 and a term (``void``) of FAR or -FAR.
    """

    low: wp.vec3
    """Lower corner of a box around the origins of the packet's rays, widened by the rays' footprints."""
    high: wp.vec3
    slow: wp.vec3
    """Smallest direction component of the packet's rays along each axis, divided by the squared length of a direction.

    Its product with a mean's offset from the origin bounds the distance at which the mean projects onto a ray."""
    fast: wp.vec3
    """Largest direction component of the packet's rays along each axis, divided by the squared length of a direction.
    """
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
    """The rays of a packet, one lane for each ray; the arrays are local to the kernel."""

    origin: wp.array(dtype=float, ndim=2)
    """Ray origins in the space of the tree that is being traversed; rows x, y and z, one column for each ray of the
    packet."""
    direction: wp.array(dtype=float, ndim=2)
    t_min: wp.array[float]
    limit: wp.array[float]
    """Distance at which each ray of the packet ends, in every tree; -FAR: the ray is finished, or the lane has no ray.
    """
    path_length: wp.array[float]
    """Length of the path from the eye to the ray's origin, over all bounces."""
    spread: wp.array[float]
    """Width of each ray's footprint divided by the length of the path from the eye."""
    footprint: wp.array[float]
    """Standard deviation by which each ray widens Gaussians, divided by the length of the path from the eye.

    It is in the space of the tree that is being traversed."""
    t_max: wp.array[float]
    """Distance up to which each ray may hit Gaussians of the tree that is being traversed; -FAR: it skips the tree."""
    group: int
    """Bit mask of the CUDA threads that traverse the BVH together, each with its own rays; 0: the thread traverses
    alone."""


@struct
class PacketTree:
    """The tree that a packet is traversing: the top-level tree over all splat instances, or the BVH of one of them."""

    number: int
    """Index of the splat instance whose BVH is being traversed, or WORLD for the top-level tree."""
    instance: SplatInstanceData
    """Data of the splat instance whose BVH is being traversed; undefined in the top-level tree."""
    slabs: Slabs
    """Bounding volume of the packet's rays in the space of the tree."""


@struct
class WaitingNode:
    """Entry of the traversal stack of a packet: a BVH node that the packet still has to visit."""

    entry: float
    """Lower bound of the distance at which any ray of the packet enters the node's box."""
    floor: float
    """Smallest ``entry`` among this stack element and all elements below; undefined if nodes are visited in any order.
    """
    link: int
    """Index of the node among the nodes of its own tree."""
    instance: int
    """Index of the instance whose tree the node belongs to, or WORLD."""


@struct
class TreeRay:
    """A single ray in the space of the BVH that it traverses: world space, or object space of a splat instance."""

    origin: wp.vec3
    direction: wp.vec3
    inverse: wp.vec3
    """``1 / x`` for each component x of the ray's direction, limited to at most 1e30 in magnitude."""
    footprint: float
    """Standard deviation by which the ray widens Gaussians, divided by the path length."""
    path_length: float
    slabs: Slabs
    """Bounding volume of the ray and its footprint; undefined if the ray has no footprint and hits do not use
    HIT_MEAN."""


@struct
class WaitingLink:
    """Entry of the traversal stack of a single ray: a BVH node or leaf that the ray still has to visit."""

    entry: float
    """Distance at which the ray enters the child's box."""
    link: int
    """Index of the node (>= 0) or, for a leaf, ``~index`` of its Gaussian, triangle or instance, as in ``Node.link``.
    """


@struct
class Hit:
    """Intersection of a ray with a Gaussian."""

    t: float
    """Distance along the ray by which hits are sorted from front to back; HIT_PEAK, HIT_HULL and HIT_MEAN define it."""
    alpha: float
    index: int
    """Index of the hit Gaussian, counted over all splat instances of the scene."""


@struct
class HitList:
    """Hits of one ray, sorted from front to back, in the part of a shared array of Hit that belongs to the ray."""

    begin: int
    """Index in the shared array of Hit at which the ray's part begins."""
    head: int
    """Index in the shared array of the nearest hit that is not blended yet."""
    tail: int
    """Index in the shared array after the farthest stored hit; equal to ``head`` if the list is empty."""
