"""Binds given Gaussians to a rig: by skinning weights, by the nearest triangles of its meshes, or by its bones.

Each binding returns one affine map for each Gaussian and pose of the rig, from the pose in which the Gaussians were
given.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.spatial import cKDTree

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, FloatArray, IntArray, box_text, float_array
from lumisplat.scene.animation.rig import Rig, RigPose, Skeleton

TRIANGLE_CANDIDATES = 16
"""Number of the nearest sample points of a surface whose triangles are compared for the nearest one."""

SAMPLES_PER_EDGE_MAX = 32
"""Largest number of intervals into which a triangle's edges are divided to sample it."""

BONE_BLEND = 1.0
"""Width of the zone in which two joints share Gaussians, relative to the thickness of the nearer limb."""

BONE_ROUNDS = 4
"""Number of times that Gaussians are assigned to bones and the thickness of each limb is measured."""

SKELETON_RATIO_MAX = 4.0
"""Largest ratio of the sizes of a skeleton and of the Gaussians around it; above it, they have different units."""

SKELETON_MARGIN = 0.25
"""Distance from the box of the Gaussians, relative to its diagonal, up to which a joint may be outside."""

SKELETON_INSIDE_MIN = 0.5
"""Smallest share of a skeleton's joints that must be so near to the Gaussians."""

_BOX_QUANTILES = (0.01, 0.99)
"""Shares of the Gaussians between which their box is measured, along each axis: a few far ones do not count."""


@dataclass(frozen=True, slots=True, eq=False)
class JointBinding:
    """Binds N Gaussians to J joints by weights: linear blend skinning."""

    nodes: IntArray
    """Index of each joint's node in the skeleton, shape (J,)."""
    node_from_rest: Doubles
    """For each joint, the inverse of its transform in the pose in which the Gaussians are given, shape (J, 4, 4)."""
    weights: FloatArray
    """Weight of each joint for each Gaussian, at least 0, rows of sum 1, shape (N, J)."""

    def maps(self, rig: Rig, pose: RigPose) -> Doubles:
        """Returns the affine map of each Gaussian to a pose of the rig, shape (N, 3, 4)."""
        moved = pose.world_from_node[self.nodes] @ self.node_from_rest
        rows = moved[:, :3].reshape(len(moved), 12).astype(np.float64)
        return (self.weights.astype(np.float64) @ rows).reshape(-1, 3, 4)


@dataclass(frozen=True, slots=True, eq=False)
class TriangleBinding:
    """Binds N Gaussians to a rig's surface: each follows its nearest point and the triangles around that point.

    The triangles that meet at a vertex are blended by area, and the three vertices of the nearest triangle by the
    barycentric coordinates of the nearest point. Neighbouring Gaussians therefore move alike, also across edges.
    """

    corners: IntArray
    """Vertex indices of the T triangles of all meshes of the rig, shape (T, 3)."""
    rest_from_frame: Doubles
    """Inverse of each triangle's frame in the pose in which the Gaussians are given, shape (T, 3, 3)."""
    rest_areas: Doubles
    """Twice the area of each triangle in that pose, shape (T,)."""
    blend: Any
    """Weight of each triangle for each Gaussian, sparse, shape (N, T); rows sum to 1."""
    nearest: Any
    """Weight of each vertex in the surface point nearest to each Gaussian, sparse, shape (N, V); rows sum to 1."""
    points: Doubles
    """Surface point nearest to each Gaussian in the pose in which it is given, shape (N, 3)."""

    def maps(self, rig: Rig, pose: RigPose) -> Doubles:
        """Returns the affine map of each Gaussian to a pose of the rig, shape (N, 3, 4)."""
        positions = posed_vertices(rig, pose)
        frames = triangle_frames(positions, self.corners, self.rest_areas)
        moved = (frames @ self.rest_from_frame).reshape(-1, 9)
        linear = (self.blend @ moved).reshape(-1, 3, 3)
        shift = self.nearest @ positions - np.einsum("nij,nj->ni", linear, self.points)
        return np.concatenate([linear, shift[:, :, None]], axis=2)


@dataclass(frozen=True, slots=True, eq=False)
class FaceBinding:
    """Binds each of N Gaussians to the frame of one given triangle, as GaussianAvatars does (Qian et al. 2024, 3.2).

    A triangle's frame is a rotation (its first edge, its normal, and their cross product) and a scale (the mean of the
    edge and the height over it) about its centre.
    """

    corners: IntArray
    """Vertex indices of the T triangles that hold Gaussians, shape (T, 3)."""
    triangles: IntArray
    """Index, 0..T-1, of the triangle of each Gaussian, shape (N,)."""
    frame_from_rest: Doubles
    """Inverse of each triangle's frame in the pose in which the Gaussians are given, shape (T, 4, 4)."""

    def maps(self, rig: Rig, pose: RigPose) -> Doubles:
        """Returns the affine map of each Gaussian to a pose of the rig, shape (N, 3, 4)."""
        moved = local_frames(posed_vertices(rig, pose)[self.corners]) @ self.frame_from_rest
        return moved[self.triangles, :3]


GaussianBinding = JointBinding | TriangleBinding | FaceBinding


def bind_to_joints(rig: Rig, rest: RigPose, weights: npt.ArrayLike, count: int) -> JointBinding:
    """Binds ``count`` Gaussians to joints by given weights.

    Args:
        rig: The rig.
        rest: Pose in which the Gaussians are given.
        weights: Shape (N, J): J is the number of joints of the rig's skin, or of all nodes of its skeleton.
        count: N.

    Raises:
        SceneError: The shape does not fit, a weight is negative or not finite, or all weights of a Gaussian are 0.
    """
    given = float_array("weights", weights)
    every = np.arange(len(rig.skeleton.parents), dtype=np.int32)
    skins = {part.nodes.tobytes(): part.nodes for surface in rig.surfaces for part in surface.parts}
    allowed = {len(nodes): nodes for nodes in (every, *(skins.values() if len(skins) == 1 else ()))}
    if given.ndim != 2 or len(given) != count or given.shape[1] not in allowed:
        expected = " or ".join(f"({count}, {joints})" for joints in allowed)
        raise SceneError(f"weights has shape {given.shape}, expected {expected}: Gaussians x joints of the rig")
    if (given < 0.0).any():
        raise SceneError(f"weights has {given.min():g}, expected numbers of at least 0")
    sums = given.sum(axis=1, keepdims=True)
    if not (sums > 0.0).all():
        raise SceneError(f"weights of Gaussian {int(sums.argmin())} are all 0: no joint moves it")
    nodes = allowed[given.shape[1]]
    return JointBinding(nodes, np.linalg.inv(rest.world_from_node[nodes]).astype(np.float64), given / sums)


def bind_to_bones(rig: Rig, rest: RigPose, points: Doubles) -> JointBinding:
    """Binds Gaussians to the bones of a skeleton by distance.

    A bone runs from a joint to each of its children; a joint without children gets a bone as long as the one that
    leads to it. Each bone is a capsule as thick as the median distance of its Gaussians, so that the bone of a thin arm
    does not take Gaussians of the trunk; a Gaussian belongs to the capsule whose surface is nearest, or in which it is
    deepest. Its parent, children and siblings in the skeleton take a smooth share near a joint.

    Args:
        rig: The rig.
        rest: Pose in which the Gaussians are given.
        points: Means of the N Gaussians in the space of the pose, shape (N, 3).

    Raises:
        SceneError: The skeleton is much larger or smaller than the Gaussians, or stands elsewhere.
    """
    skeleton = rig.skeleton
    count = len(skeleton.parents)
    joints = rest.world_from_node[:, :3, 3]
    _check_stands_in(joints, points)
    distances = _bone_distances(skeleton, joints, points)
    thickness = np.zeros(count)
    for _ in range(BONE_ROUNDS):
        owner = np.argmin(distances - thickness, axis=1)
        thickness = np.array([np.median(distances[owner == k, k]) if (owner == k).any() else 0.0 for k in range(count)])
    outside = distances - thickness
    owner = np.argmin(outside, axis=1)
    further = outside - outside[np.arange(len(points)), owner][:, None]
    reach = np.maximum(BONE_BLEND * thickness[owner], np.finfo(float).tiny)[:, None]
    share = 1.0 - np.minimum(further / reach, 1.0)
    weights = np.where(_neighbouring(skeleton)[owner], share * share * (3.0 - 2.0 * share), 0.0)
    return bind_to_joints(rig, rest, weights, len(points))


def _check_stands_in(joints: Doubles, points: Doubles) -> None:
    """Raises a `SceneError` unless most of J joints, (J, 3), are among N points, (N, 3), and as far apart as these."""
    low, high = np.quantile(points, _BOX_QUANTILES, axis=0)
    size, own_size = float(np.linalg.norm(high - low)), float(np.linalg.norm(np.ptp(joints, axis=0)))
    if min(size, own_size) == 0.0:
        return
    ratio = own_size / size
    if max(ratio, 1.0 / ratio) > SKELETON_RATIO_MAX:
        found = f"the skeleton is {ratio:.3g} times as large as the Gaussians ({own_size:.4g} and {size:.4g} units)"
        raise SceneError(
            f"{found}: bring them to one unit by ls.transform(gaussians, scale=...), by lumisplat convert --scale, or "
            "by other positions of the joints"
        )
    margin = SKELETON_MARGIN * size
    inside = ((joints >= low - margin) & (joints <= high + margin)).all(axis=1)
    if inside.mean() < SKELETON_INSIDE_MIN:
        own, theirs = box_text(joints.min(axis=0), joints.max(axis=0)), box_text(low, high)
        raise SceneError(
            f"the skeleton, in {own}, stands beside the Gaussians, in {theirs}: move or turn them by "
            "ls.transform(gaussians, translation=..., rotation_degrees=...), or give other positions of the joints"
        )


def _bone_distances(skeleton: Skeleton, joints: Doubles, points: Doubles) -> Doubles:
    """Returns the distance of N points from the bones of each of J joints, shape (N, J); inf for joints without bones.

    Args:
        skeleton: The hierarchy of the joints.
        joints: Positions of the joints, shape (J, 3).
        points: Points, shape (N, 3).
    """
    found = np.full((len(points), len(joints)), np.inf)
    has_child = {parent for parent in skeleton.parents if parent is not None}
    for k, parent in enumerate(skeleton.parents):
        if parent is not None:
            found[:, parent] = np.minimum(found[:, parent], _segment_distance(points, joints[parent], joints[k]))
        if k not in has_child:
            along = joints[k] - joints[parent] if parent is not None else np.zeros(3)
            found[:, k] = _segment_distance(points, joints[k], joints[k] + along)
    return found


def _segment_distance(points: Doubles, start: Doubles, end: Doubles) -> Doubles:
    """Returns the distance of N points, (N, 3), from the segment between two points, (3,) each."""
    along = end - start
    square = float(along @ along)
    share = np.clip((points - start) @ along / square, 0.0, 1.0) if square > 0.0 else np.zeros(len(points))
    return np.linalg.norm(points - start - share[:, None] * along, axis=1)


def _neighbouring(skeleton: Skeleton) -> npt.NDArray[np.bool_]:
    """Returns which joints are the same, parent and child, or children of one parent, shape (J, J)."""
    parents = np.array([-1 if parent is None else parent for parent in skeleton.parents])
    is_child = parents[:, None] == np.arange(len(parents))
    siblings = (parents[:, None] == parents) & (parents[:, None] >= 0)
    return is_child | is_child.T | siblings | np.eye(len(parents), dtype=bool)


def bind_to_triangles(rig: Rig, rest: RigPose, points: Doubles) -> TriangleBinding:
    """Binds Gaussians to the nearest points of the rig's meshes.

    Args:
        rig: The rig, with meshes.
        rest: Pose in which the Gaussians are given.
        points: Means of the N Gaussians in the space of the pose, shape (N, 3).
    """
    positions = posed_vertices(rig, rest)
    corners = all_triangles(rig)
    a, b, c = positions[corners].swapaxes(0, 1)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners, areas = corners[areas > 0.0].astype(np.int32), areas[areas > 0.0]
    triangles, barycentric = nearest_on_triangles(positions[corners], points)
    rows = np.repeat(np.arange(len(points)), 3)
    nearest = sparse.csr_array(
        (barycentric.ravel(), (rows, corners[triangles].ravel())), shape=(len(points), len(positions))
    )
    # Vertices at one position, as along texture seams, count as one.
    _, welded = np.unique(positions.astype(np.float32), axis=0, return_inverse=True)
    welded = welded.reshape(-1)
    count = int(welded.max()) + 1
    incident = sparse.csr_array(
        (np.repeat(areas, 3), (welded[corners].ravel(), np.repeat(np.arange(len(corners)), 3))),
        shape=(count, len(corners)),
    )
    incident = sparse.diags_array(1.0 / np.maximum(incident.sum(axis=1), np.finfo(float).tiny)) @ incident
    at_welded = sparse.csr_array((np.ones(len(welded)), (np.arange(len(welded)), welded)), shape=(len(welded), count))
    return TriangleBinding(
        corners=corners,
        rest_from_frame=np.linalg.inv(triangle_frames(positions, corners, areas)).astype(np.float64),
        rest_areas=areas,
        blend=sparse.csr_array(nearest @ at_welded @ incident),
        nearest=nearest,
        points=nearest @ positions,
    )


def bind_to_faces(rig: Rig, rest: RigPose, triangles: npt.ArrayLike, count: int) -> FaceBinding:
    """Binds ``count`` Gaussians to given triangles.

    Args:
        rig: The rig, with meshes.
        rest: Pose in which the Gaussians are given.
        triangles: Index of the triangle of each Gaussian, in the order of the rig's meshes, shape (N,).
        count: N.

    Raises:
        SceneError: The shape does not fit, or the rig has no such triangle, or one without area.
    """
    index = np.asarray(triangles)
    corners = all_triangles(rig)
    if index.shape != (count,) or index.dtype.kind not in "iu":
        raise SceneError(f"triangles has shape {index.shape} of {index.dtype}, expected whole numbers, ({count},)")
    if count and not (0 <= index.min() and index.max() < len(corners)):
        raise SceneError(
            f"a Gaussian is bound to triangle {int(index.max())}, but the rig has {len(corners)}: it is another mesh "
            "(GaussianAvatars adds teeth to FLAME)"
        )
    used, index = np.unique(index, return_inverse=True)
    frames = local_frames(posed_vertices(rig, rest)[corners[used]])
    flat = used[~(np.linalg.det(frames) > 0.0)]
    if flat.size:
        raise SceneError(
            f"triangle {flat[0]} of the rig has no area in the pose of the Gaussians, but some are bound to it "
            f"({flat.size} such triangles): bind them to others, or repair the mesh"
        )
    return FaceBinding(corners[used], index.astype(np.int32), np.linalg.inv(frames).astype(np.float64))


def local_frames(triangles: Doubles) -> Doubles:
    """Returns ``world_from_local`` of T triangles, (T, 3, 3) each, as `FaceBinding` describes, shape (T, 4, 4)."""
    first, second, third = triangles.swapaxes(0, 1)
    edge, other = second - first, third - first
    base = np.linalg.norm(edge, axis=1, keepdims=True)
    along = edge / np.maximum(base, np.finfo(float).tiny)
    normal = np.cross(along, other)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    across = np.cross(along, normal)
    height = np.abs(np.einsum("ti,ti->t", across, other))
    frames = np.tile(np.eye(4), (len(triangles), 1, 1))
    frames[:, :3, :3] = 0.5 * (base[:, 0] + height)[:, None, None] * np.stack([along, normal, across], axis=2)
    frames[:, :3, 3] = triangles.mean(axis=1)
    return frames


def all_triangles(rig: Rig) -> IntArray:
    """Returns the vertex indices of the triangles of all meshes of a rig, one mesh after the other, shape (T, 3)."""
    counts = [sum(len(part.positions) for part in surface.parts) for surface in rig.surfaces]
    firsts = np.cumsum([0, *counts])
    parts = [surface.indices + first for surface, first in zip(rig.surfaces, firsts, strict=False)]
    return np.concatenate(parts).astype(np.int32)


def posed_vertices(rig: Rig, pose: RigPose) -> Doubles:
    """Returns the vertices of all meshes of a rig in a pose, one mesh after the other, shape (V, 3)."""
    return np.concatenate([surface.pose_vertices(pose)[0] for surface in rig.surfaces])


def triangle_frames(positions: Doubles, corners: IntArray, rest_areas: Doubles) -> Doubles:
    """Returns the frames of T triangles, shape (T, 3, 3): two edges and the normal.

    The length of the normal is the square root of the area relative to ``rest_areas``, so that a uniform scale of the
    surface scales the frame uniformly.
    """
    a, b, c = positions[corners].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    doubled = np.linalg.norm(cross, axis=1)
    normals = cross / np.sqrt(np.maximum(doubled * rest_areas, np.finfo(float).tiny))[:, None]
    return np.stack([b - a, c - a, normals], axis=2)


def nearest_on_triangles(triangles: Doubles, points: Doubles) -> tuple[IntArray, Doubles]:
    """Finds the nearest triangle of each point, and the nearest point on it.

    Candidates are the triangles of the nearest sample points of the surface, which are as close together as the median
    edge is long.

    Args:
        triangles: Corners of T triangles, shape (T, 3, 3).
        points: N points, shape (N, 3).

    Returns:
        Index of the triangle of each point, shape (N,), and barycentric coordinates of its nearest point, (N, 3).
    """
    samples, owners = _sample_points(triangles)
    _, found = cKDTree(samples).query(points, k=min(TRIANGLE_CANDIDATES, len(samples)), workers=-1)
    candidates = owners[np.reshape(found, (len(points), -1))]
    best = np.full(len(points), np.inf)
    nearest, barycentric = np.zeros(len(points), np.int32), np.zeros((len(points), 3))
    for column in range(candidates.shape[1]):
        index = candidates[:, column]
        fresh = np.flatnonzero(index != nearest) if column else np.arange(len(points))
        weights = _nearest_barycentric(triangles[index[fresh]], points[fresh])
        offset = np.einsum("nk,nki->ni", weights, triangles[index[fresh]]) - points[fresh]
        distance = np.einsum("ni,ni->n", offset, offset)
        closer = distance < best[fresh]
        rows = fresh[closer]
        best[rows], nearest[rows], barycentric[rows] = distance[closer], index[rows], weights[closer]
    return nearest, barycentric


def _sample_points(triangles: Doubles) -> tuple[Doubles, IntArray]:
    """Returns points on triangles, at most about a median edge apart, shape (M, 3), and the triangle of each, (M,)."""
    edges = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    steps = np.clip(np.ceil(edges / np.median(edges)), 1, SAMPLES_PER_EDGE_MAX).astype(int)
    points: list[Doubles] = []
    owners: list[IntArray] = []
    for count in np.unique(steps):
        rows = np.flatnonzero(steps == count)
        pairs = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)], dtype=np.float64)
        weights = np.column_stack([pairs, count - pairs.sum(axis=1)]) / count
        weights = np.concatenate([weights, np.full((1, 3), 1.0 / 3.0)])
        points.append(np.einsum("mk,tki->tmi", weights, triangles[rows]).reshape(-1, 3))
        owners.append(np.repeat(rows, len(weights)).astype(np.int32))
    return np.concatenate(points), np.concatenate(owners)


def _nearest_barycentric(triangles: Doubles, points: Doubles) -> Doubles:
    """Returns barycentric coordinates of the point of each of N triangles nearest to the N points, shape (N, 3).

    The nearest point is the foot of the perpendicular where that is inside, else the nearest point of the three edges.
    """
    a, b, c = triangles.swapaxes(0, 1)
    first, second, offset = b - a, c - a, points - a
    d11, d12, d22 = (np.einsum("ni,ni->n", u, v) for u, v in ((first, first), (first, second), (second, second)))
    d1, d2 = np.einsum("ni,ni->n", offset, first), np.einsum("ni,ni->n", offset, second)
    area = np.maximum(d11 * d22 - d12 * d12, np.finfo(float).tiny)
    v, w = (d22 * d1 - d12 * d2) / area, (d11 * d2 - d12 * d1) / area
    weights = np.stack([1.0 - v - w, v, w], axis=1)
    outside = np.flatnonzero((weights < 0.0).any(axis=1))
    best = np.full(len(outside), np.inf)
    for k in range(3):
        start, end = triangles[outside, k], triangles[outside, (k + 1) % 3]
        along = end - start
        square = np.maximum(np.einsum("ni,ni->n", along, along), np.finfo(float).tiny)
        share = np.clip(np.einsum("ni,ni->n", points[outside] - start, along) / square, 0.0, 1.0)
        gap = points[outside] - start - share[:, None] * along
        distance = np.einsum("ni,ni->n", gap, gap)
        closer = distance < best
        best = np.minimum(best, distance)
        rows = outside[closer]
        weights[rows] = 0.0
        weights[rows, k], weights[rows, (k + 1) % 3] = 1.0 - share[closer], share[closer]
    return weights
