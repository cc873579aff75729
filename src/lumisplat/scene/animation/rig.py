"""Rigs: meshes that joints deform, and the clips that move the joints.

A vertex moves with the weighted mean of its joints' matrices (linear blend skinning, glTF 2.0 section 3.7.3).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import Doubles, FloatArray, IntArray, finite_array, read_only_view, refuse_rows
from lumisplat.math.transforms import (
    is_mirroring,
    matrices_from_quaternions,
    multiply_quaternions,
    slerp,
    transform_normals_each,
    transform_points_each,
)
from lumisplat.scene.animation.keyframes import check_time, checked_times
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh, check_triangles

_Floats = npt.NDArray[np.floating]


class Channel(Enum):
    """Kind of node property that a clip animates."""

    TRANSLATION = "translation"
    """Translation of the node relative to its parent, shape (3,)."""
    ROTATION = "rotation"
    """Rotation of the node relative to its parent, unit quaternion wxyz, shape (4,)."""
    SCALE = "scale"
    """Scale factors of the node along its x, y and z axis, shape (3,)."""
    WEIGHTS = "weights"
    """Weights of the T morph targets of the node's mesh, shape (T,)."""


class Interpolation(Enum):
    """How a track's values between two keys are computed (glTF 2.0 appendix C)."""

    STEP = "STEP"
    LINEAR = "LINEAR"
    """Linear interpolation between two keys; slerp for rotations."""
    CUBICSPLINE = "CUBICSPLINE"
    """Cubic Hermite spline with the tangents that the file stores."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Animation of one property (channel) of one node: values of C numbers at K key times."""

    node: int
    channel: Channel
    interpolation: Interpolation
    times: Doubles
    """Times of the K keys, seconds, not decreasing, shape (K,)."""
    values: Doubles
    """Values of the animated property at the K keys, C numbers each, shape (K, C)."""
    tangents: Doubles | None = None
    """Incoming and outgoing tangents at each key of a cubic spline, value units per second, shape (K, 2, C); None if
    values are interpolated linearly."""

    def at(self, time: float) -> Doubles:
        """Returns the interpolated value at a time, shape (C,); beyond the first or last key, the value of that key.

        Args:
            time: Seconds of the clip.
        """
        before = int(np.searchsorted(self.times, time, side="right")) - 1
        if before < 0 or before + 1 >= self.times.size or self.interpolation is Interpolation.STEP:
            return self._normalise(self.values[max(before, 0)])
        first, second = self.values[before], self.values[before + 1]
        span = float(self.times[before + 1] - self.times[before])
        share = (time - float(self.times[before])) / span
        if self.tangents is not None:
            square, cube = share * share, share * share * share
            value = (2.0 * cube - 3.0 * square + 1.0) * first + (3.0 * square - 2.0 * cube) * second
            value = value + span * (cube - 2.0 * square + share) * self.tangents[before, 1]
            return self._normalise(value + span * (cube - square) * self.tangents[before + 1, 0])
        if self.channel is Channel.ROTATION:
            return slerp(first, second, share)
        return (1.0 - share) * first + share * second

    def _normalise(self, value: Doubles) -> Doubles:
        """Scales an interpolated rotation to length 1, which splines do not keep; returns other values as given."""
        return value / np.linalg.norm(value) if self.channel is Channel.ROTATION else value


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """A named animation of a rig: tracks, each for one property of one node."""

    name: str
    tracks: tuple[Track, ...]

    @property
    def duration(self) -> float:
        """Time of the last key of all tracks, seconds."""
        return max((float(track.times[-1]) for track in self.tracks), default=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Skeleton:
    """Hierarchy of N nodes with their rest transforms. A node scales a point, then rotates, then translates it."""

    parents: tuple[int | None, ...]
    """For each of N nodes, the index of its parent node; None for a root."""
    order: tuple[int, ...]
    """Indices of all N nodes, sorted so that every parent comes before its children."""
    translations: Doubles
    """Translation of each node relative to its parent in the rest pose, shape (N, 3)."""
    rotations_wxyz: Doubles
    """Rotation of each node relative to its parent in the rest pose, unit quaternions, scalar first, shape (N, 4)."""
    scales: Doubles
    """Scale factors of each node along its axes in the rest pose, shape (N, 3)."""
    matrices: Mapping[int, Doubles]
    """Matrices ``parent_from_node`` by node index, only of nodes that a file gives as a matrix instead of translation,
    rotation and scale; clips do not move these nodes."""
    names: tuple[str, ...] = ()
    """Name of each of the N nodes, by which motion of other files is matched; empty if nodes have no names."""

    def world_from_node(self, clip: Clip | None = None, time: float = 0.0) -> Doubles:
        """Returns the transforms of all N nodes to world space, shape (N, 4, 4).

        Args:
            clip: Animation clip to apply; None: the rest pose.
            time: Time of the clip in seconds.
        """
        columns = {
            Channel.TRANSLATION: self.translations.copy(),
            Channel.ROTATION: self.rotations_wxyz.copy(),
            Channel.SCALE: self.scales.copy(),
        }
        for track in clip.tracks if clip else ():
            if track.channel is not Channel.WEIGHTS:
                columns[track.channel][track.node] = track.at(time)
        local = np.tile(np.eye(4), (len(self.parents), 1, 1))
        rotations = matrices_from_quaternions(columns[Channel.ROTATION])
        local[:, :3, :3] = rotations * columns[Channel.SCALE][:, None, :]
        local[:, :3, 3] = columns[Channel.TRANSLATION]
        for node, matrix in self.matrices.items():
            local[node] = matrix
        world = local.copy()
        for node in self.order:
            parent = self.parents[node]
            if parent is not None:
                world[node] = world[parent] @ local[node]
        return world


def blend_matrices(matrices: _Floats, joints: npt.NDArray[np.integer], weights: _Floats) -> npt.NDArray[np.float64]:
    """Returns each vertex's skinning matrix, the weighted mean of its joints' matrices, shape (V, 3, 4).

    Args:
        matrices: ``world_from_bind`` of each of J joints: pose times inverse bind matrix, shape (J, 4, 4).
        joints: Indices of the K joints that move each vertex, shape (V, K).
        weights: Weights of the vertex's joints, any sum but 0, shape (V, K).
    """
    rows = np.ascontiguousarray(matrices[:, :3])
    blended = np.zeros((len(joints), 3, 4))
    for k in range(joints.shape[1]):
        used = np.flatnonzero(weights[:, k])
        blended[used] += weights[used, k, None, None] * rows[joints[used, k]]
    return blended / weights.sum(axis=1, dtype=np.float64)[:, None, None]


@dataclass(frozen=True, slots=True, eq=False)
class MorphTargets:
    """Blend shapes: T targets that offset V vertices, multiplied by weights and added."""

    node: int
    """Index of the skeleton node whose ``WEIGHTS`` channel a clip animates to blend these targets."""
    weights: Doubles
    """Weights of the T morph targets at rest, shape (T,)."""
    positions: FloatArray
    """Offset of each of V vertices by each of T morph targets, shape (T, V, 3)."""
    normals: FloatArray | None
    """Offset of each vertex normal by each morph target, shape (T, V, 3); None: normals do not change."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseShapes:
    """Pose blend shapes: vertex offsets that are linear in the rotation matrices of J joints (SMPL, equation 9).

    A joint whose axes are those of its parent, as in the bind pose, contributes no offset.
    """

    nodes: IntArray
    """For each of the J joints, the index of its node in the skeleton, shape (J,)."""
    parents: IntArray
    """For each of the J joints, the index of the node relative to which it rotates, shape (J,)."""
    offsets: FloatArray
    """Offset of each of V vertices by each entry of the J rotation matrices minus the identity, row by row, shape
    (9 J, V, 3)."""

    def at(self, world_from_node: Doubles) -> FloatArray:
        """Returns the offsets of the V vertices, shape (V, 3), for nodes that are only rotated and translated."""
        world = world_from_node[:, :3, :3]
        local = np.swapaxes(world[self.parents], 1, 2) @ world[self.nodes]
        entries = (local - np.eye(3)).reshape(-1).astype(np.float32)
        return (entries @ self.offsets.reshape(entries.size, -1)).reshape(self.offsets.shape[1:])


@dataclass(frozen=True, slots=True, eq=False)
class RigPart:
    """One skinned mesh: V vertices in the bind pose, and J joints; each vertex is moved by up to K of the joints."""

    positions: FloatArray
    """Vertex positions in the bind pose, before morph targets and pose blend shapes, shape (V, 3)."""
    normals: FloatArray | None
    """Vertex normals in the bind pose, shape (V, 3); None: the posed mesh is shaded flat."""
    nodes: IntArray
    """For each of the J joints, the index of its node in the skeleton, shape (J,)."""
    joint_from_bind: Doubles
    """Inverse bind matrices: for each joint, from the bind pose to the joint's space, shape (J, 4, 4)."""
    joints: IntArray
    """Indices of the joints that move each vertex, 0..J-1, shape (V, K)."""
    weights: FloatArray
    """Skinning weight of each vertex's K joints, non-negative with a positive sum, shape (V, K)."""
    morphs: MorphTargets | None = None
    pose_shapes: PoseShapes | None = None
    """Blend shapes that correct the skin where joints bend; None: linear blend skinning alone."""

    def matrices(self, world_from_node: Doubles) -> Doubles:
        """Returns each of V vertices' matrix from the bind pose to the world, shape (V, 3, 4), for posed nodes."""
        return blend_matrices(world_from_node[self.nodes] @ self.joint_from_bind, self.joints, self.weights)

    def pose_vertices(self, pose: RigPose) -> tuple[Doubles, Doubles | None]:
        """Returns world-space positions and normals of V vertices in a pose, (V, 3) each; normals have any length.

        The normals are None if the part has none.
        """
        positions: npt.NDArray[np.floating] = self.positions
        normals: npt.NDArray[np.floating] | None = self.normals
        if self.morphs is not None:
            weights = pose.morph_weights.get(self.morphs.node, self.morphs.weights)
            used = np.flatnonzero(
                weights[: len(self.morphs.positions)]
            )  # weights beyond the targets that were read have no effect
            positions = positions + np.tensordot(weights[used], self.morphs.positions[used], 1)
            if normals is not None and self.morphs.normals is not None:
                normals = normals + np.tensordot(weights[used], self.morphs.normals[used], 1)
        if self.pose_shapes is not None:
            positions = positions + self.pose_shapes.at(pose.world_from_node)
        matrices = self.matrices(pose.world_from_node)
        if normals is not None:
            normals = transform_normals_each(matrices, normals)
        return transform_points_each(matrices, positions), normals


@dataclass(frozen=True, slots=True, eq=False)
class RigSurface:
    """One mesh of a rig: triangles of one material over the vertices of several `RigPart`, joined in order."""

    parts: tuple[RigPart, ...]
    indices: IntArray
    """Triangles, shape (F, 3), counter-clockwise seen from outside in the rest pose."""
    material: Material
    uvs: FloatArray | None
    colors: FloatArray | None
    name: str
    _usable_indices: dict[bytes, IntArray] = field(default_factory=dict[bytes, IntArray], init=False, repr=False)
    """Cache of one entry: the triangles that have an area in a pose. The key is the mask that selects them, as bytes.
    """

    def pose_vertices(self, pose: RigPose) -> tuple[Doubles, Doubles | None]:
        """Returns world-space positions and normals of all V vertices in a pose, (V, 3) each; normals have any length.

        The normals are None if a part has none.
        """
        moved = [part.pose_vertices(pose) for part in self.parts]
        normals = [normals for _, normals in moved if normals is not None]
        positions = np.concatenate([positions for positions, _ in moved])
        return positions, np.concatenate(normals) if len(normals) == len(moved) else None

    def mesh(self, pose: RigPose) -> Mesh | None:
        """Returns the mesh in a pose, without triangles that the pose flattens to area 0; None if none is left."""
        moved, normals = self.pose_vertices(pose)
        positions = read_only_view(moved.astype(np.float32))
        usable = check_triangles(positions, self.indices).usable
        if not usable.any():
            return None
        return Mesh(
            positions,
            self.indices if usable.all() else self._select(usable),
            normals=None if normals is None else read_only_view(_normalise(normals)),
            uvs=self.uvs,
            material=self.material,
            colors=self.colors,
            name=self.name,
        )

    def _select(self, usable: npt.NDArray[np.bool_]) -> IntArray:
        """Returns the triangles that a mask selects; a repeated mask gives the same array object, so caches match."""
        key = usable.tobytes()
        if key not in self._usable_indices:
            self._usable_indices.clear()
            self._usable_indices[key] = read_only_view(self.indices[usable])
        return self._usable_indices[key]


@dataclass(frozen=True, slots=True, eq=False)
class RigPose:
    """Node transforms and morph-target weights of a rig at one time."""

    world_from_node: Doubles
    """Transforms of the N nodes to world space, shape (N, 4, 4)."""
    morph_weights: dict[int, Doubles]
    """Weights of morph targets by node index, only for nodes with weights that the clip animates."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Meshes bound to a hierarchy of joints, with animations by name; made by `load_rig`, or by `of_joints`.

    Vertices are moved by their morph targets and pose blend shapes, then by linear blend skinning (glTF 2.0 section
    3.7.3). All poses are in the world space of the file, y up and +z towards the viewer.

    Raises:
        SceneError: A mesh has no triangles at rest, or has values that are not finite.
    """

    skeleton: Skeleton
    surfaces: tuple[RigSurface, ...]
    animations: tuple[Clip, ...]
    meshes: tuple[Mesh, ...] = field(init=False)
    """Meshes in the rest pose, one per material, posed by the file's node transforms, as `load` returns them."""

    def __post_init__(self) -> None:
        rest = RigPose(self.skeleton.world_from_node(), {})
        meshes = [mesh for surface in self.surfaces if (mesh := surface.mesh(rest)) is not None]
        if len(meshes) < len(self.surfaces):
            raise SceneError("the rig has no triangles at rest")
        object.__setattr__(self, "meshes", tuple(meshes))

    @classmethod
    def of_joints(
        cls,
        joints: Mapping[str, tuple[str | None, npt.ArrayLike]],
        times: npt.ArrayLike | None = None,
        rotations_wxyz: npt.ArrayLike | None = None,
        root_positions: npt.ArrayLike | None = None,
    ) -> Rig:
        """Makes a rig without meshes, to which `bind_gaussians` binds given Gaussians, and a clip named ``motion``.

        Args:
            joints: J joints by name: the name of the parent, which comes first, and the position in the pose of the
                Gaussians, world space, shape (3,). The parent of the root is None.
            times: Times of the clip's keys, seconds, increasing, shape (T,); None: no clip.
            rotations_wxyz: Rotation of each joint from that pose, world space, at these times, shape (T, J, 4).
            root_positions: Position of the root joint at these times, shape (T, 3); None: it stays.

        Raises:
            SceneError: There is not one root, a parent is unknown or comes later, shapes do not match, times do not
                increase, a rotation has zero length, or a clip lacks times or rotations.
        """
        names = list(joints)
        parents: list[int | None] = []
        for k, (name, (parent, _)) in enumerate(joints.items()):
            if parent is not None and parent not in names[:k]:
                raise SceneError(f"joint {name!r} has the parent {parent!r}, expected the name of an earlier joint")
            parents.append(None if parent is None else names.index(parent))
        if parents.count(None) != 1:
            raise SceneError(f"joints have {parents.count(None)} roots, expected one joint whose parent is None")
        positions = finite_array(
            "positions", np.array([position for _, position in joints.values()], np.float64), np.float64
        )
        check_shapes(positions=(positions, "J 3"))
        count = len(names)
        above = np.array([0 if parent is None else parent for parent in parents])
        is_root = np.array([parent is None for parent in parents])[:, None]
        skeleton = Skeleton(
            parents=tuple(parents),
            order=tuple(range(count)),
            translations=np.where(is_root, positions, positions - positions[above]),
            rotations_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            scales=np.ones((count, 3)),
            matrices={},
            names=tuple(names),
        )
        if times is None or rotations_wxyz is None:
            if times is not None or rotations_wxyz is not None or root_positions is not None:
                raise SceneError(
                    "times and rotations_wxyz make a clip, with root_positions: give both, or none of them"
                )
            return cls(skeleton, (), ())
        keys = checked_times(times, len(np.atleast_1d(times)))
        world = finite_array("rotations_wxyz", rotations_wxyz, np.float64)
        check_shapes(times=(keys, "T"), joints=(positions, "J 3"), rotations_wxyz=(world, "T J 4"))
        for name, turns in zip(names, world.swapaxes(0, 1), strict=True):
            refuse_rows(f"rotations_wxyz of joint {name!r}", "of zero length", ~turns.any(axis=1))
        tracks: list[Track] = []
        for k, parent in enumerate(parents):
            local = world[:, k]
            if parent is not None:
                inverse = world[:, parent] * (1.0, -1.0, -1.0, -1.0)
                local = np.stack([multiply_quaternions(a, b[None])[0] for a, b in zip(inverse, local, strict=True)])
            local = local / np.linalg.norm(local, axis=1, keepdims=True)
            tracks.append(Track(k, Channel.ROTATION, Interpolation.LINEAR, keys, local))
        if root_positions is not None:
            moved = finite_array("root_positions", root_positions, np.float64)
            check_shapes(times=(keys, "T"), root_positions=(moved, "T 3"))
            tracks.append(Track(parents.index(None), Channel.TRANSLATION, Interpolation.LINEAR, keys, moved))
        return cls(skeleton, (), (Clip("motion", tuple(tracks)),))

    def __repr__(self) -> str:
        faces = sum(len(surface.indices) for surface in self.surfaces)
        return f"Rig(meshes={len(self.surfaces)}, faces={faces}, clips={list(self.clips)})"

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of the animation clips, in the file's order; a clip without a name is named by its number."""
        return tuple(clip.name for clip in self.animations)

    @property
    def mesh(self) -> Mesh:
        """Mesh in the rest pose, for a rig with one mesh.

        Raises:
            SceneError: The rig has several meshes; `meshes` returns all of them.
        """
        self._refuse_several("meshes")
        return self.meshes[0]

    def duration(self, clip: str | None = None) -> float:
        """Returns the time of a clip's last key in seconds.

        Args:
            clip: Name of the clip; None: the first.

        Raises:
            SceneError: The rig has no clips, or none of that name; the message lists the clips.
        """
        found = self._clip(clip)
        if found is None:
            raise SceneError("the rig has no clips")
        return found.duration

    def pose(self, time: float, clip: str | None = None) -> Mesh:
        """Returns the mesh at a time of a clip, for a rig with one mesh; see `poses`.

        Raises:
            SceneError: The rig has several meshes or no clip of that name, the time is not finite, or all triangles of
                the mesh have lost their area at that time.
        """
        self._refuse_several("poses(time)")
        found = self.poses(time, clip)
        if not found:
            raise SceneError(f"the rig has no triangles at {time:g} s: its clip scales it to zero")
        return found[0]

    def poses(self, time: float, clip: str | None = None) -> tuple[Mesh, ...]:
        """Returns the meshes at a time of a clip, with normals if the file has them.

        Args:
            time: Seconds; the pose is constant before the first key and after the last one.
            clip: Name of the clip; None: the first one, or the rest pose if the rig has no clips.

        Returns:
            One mesh per material. Triangles without area in the pose are left out, and so are meshes that the clip
            scales to zero.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        pose = self.pose_at(time, clip)
        meshes = (surface.mesh(pose) for surface in self.surfaces)
        return tuple(mesh for mesh in meshes if mesh is not None)

    def pose_at(self, time: float, clip: str | None = None) -> RigPose:
        """Returns the state of the rig at a time; see `poses`.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        check_time(time)
        found = self._clip(clip)
        tracks = found.tracks if found else ()
        weights = {track.node: track.at(time) for track in tracks if track.channel is Channel.WEIGHTS}
        return RigPose(self.skeleton.world_from_node(found, time), weights)

    def _clip(self, name: str | None) -> Clip | None:
        """Returns a clip by name; for None, the first clip, or None if the rig has no clips."""
        if name is None:
            return self.animations[0] if self.animations else None
        for clip in self.animations:
            if clip.name == name:
                return clip
        listed = ", ".join(map(repr, self.clips))
        raise SceneError(f"the rig has no clip {name!r}" + (f", it has {listed}" if listed else ", nor any other"))

    def _refuse_several(self, other: str) -> None:
        if len(self.surfaces) > 1:
            raise SceneError(f"the rig has {len(self.surfaces)} meshes of different materials: use rig.{other}")


def join_triangles(parts: list[RigPart], indices: list[IntArray], skeleton: Skeleton) -> IntArray:
    """Joins triangles of several parts into one array of indices into their concatenated vertices, shape (F, 3).

    Args:
        parts: Parts of one surface.
        indices: Triangles of each part, shape (F, 3); the triangles of a part that is mirrored at rest are reversed.
        skeleton: Gives the rest pose.
    """
    world_from_node = skeleton.world_from_node()
    shifted: list[npt.NDArray[np.integer]] = []
    first = 0
    for part, triangles in zip(parts, indices, strict=True):
        outwards = triangles[:, ::-1] if is_mirroring(part.matrices(world_from_node)) else triangles
        shifted.append(outwards + first)
        first += len(part.positions)
    return read_only_view(np.concatenate(shifted).astype(np.int32))


def _normalise(normals: Doubles) -> FloatArray:
    """Scales normals to length 1; normals of length 0 stay 0, and `Mesh` replaces them by face normals."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0).astype(np.float32)
