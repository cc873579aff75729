"""Data of Gaussians as rays hit them: the trees that rays traverse, and the settings of those rays."""

import warp as wp

from lumisplat.constants import NODE_WIDTH
from lumisplat.device.structs.declare import struct
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


HIT_NONE: int = wp.constant(0)
HIT_FAR: int = wp.constant(1)
"""A Gaussian is hit beyond the offset of the ray."""
HIT_NEAR: int = wp.constant(2)
"""It is hit within: it counts if it is of another layer."""


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
    hits_kept: int
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
