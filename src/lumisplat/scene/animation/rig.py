"""A rig: meshes that joints move, and the clips that move the joints."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, IntArray, handed_over
from lumisplat.math.transforms import is_mirroring, transform_normals, transform_points
from lumisplat.scene.animation.clips import Channel, Clip
from lumisplat.scene.animation.keyframes import check_time
from lumisplat.scene.animation.skeleton import Skeleton
from lumisplat.scene.animation.skinning import blended
from lumisplat.scene.materials import Material
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.triangles import check_triangles

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class MorphTargets:
    """Offsets of vertices that are added by weight."""

    node: int
    """Whose weights a clip changes."""
    weights: _Floats
    """At rest, shape (T,)."""
    positions: FloatArray
    """Shape (T, V, 3)."""
    normals: FloatArray | None
    """Shape (T, V, 3)."""


@dataclass(frozen=True, slots=True, eq=False)
class RigPart:
    """V vertices as they were bound, and the joints that they follow."""

    positions: FloatArray
    """Shape (V, 3)."""
    normals: FloatArray | None
    """Shape (V, 3)."""
    nodes: IntArray
    """Nodes of the J joints, shape (J,)."""
    joint_from_bind: _Floats
    """Inverse bind matrices, shape (J, 4, 4)."""
    joints: IntArray
    """Joints of each vertex, 0..J-1, shape (V, K)."""
    weights: FloatArray
    """Theirs, at least 0 and of a positive sum, shape (V, K)."""
    morphs: MorphTargets | None = None

    def matrices(self, world_from_node: _Floats) -> _Floats:
        """``world_from_bind`` of each vertex, shape (V, 3, 4)."""
        return blended(world_from_node[self.nodes] @ self.joint_from_bind, self.joints, self.weights)

    def posed(self, world_from_node: _Floats, weights: _Floats | None) -> tuple[_Floats, _Floats | None]:
        """Positions and normals (of any length) in the world.

        Args:
            world_from_node: Of the skeleton, shape (N, 4, 4).
            weights: Of the morph targets, shape (T,); None: those at rest.
        """
        positions, normals = self.positions, self.normals
        if self.morphs is not None:
            weights = self.morphs.weights if weights is None else weights
            used = np.flatnonzero(weights)
            positions = positions + np.tensordot(weights[used], self.morphs.positions[used], 1)
            if normals is not None and self.morphs.normals is not None:
                normals = normals + np.tensordot(weights[used], self.morphs.normals[used], 1)
        matrices = self.matrices(world_from_node)
        return transform_points(matrices, positions), None if normals is None else transform_normals(matrices, normals)


@dataclass(frozen=True, slots=True, eq=False)
class RigSurface:
    """Triangles of one material over the vertices of its parts, one part's after the other's."""

    parts: tuple[RigPart, ...]
    indices: IntArray
    """Shape (F, 3), counter-clockwise seen from outside in the pose at rest."""
    material: Material
    uvs: FloatArray | None
    colors: FloatArray | None
    name: str
    _left: dict[bytes, IntArray] = field(default_factory=dict, init=False, repr=False)
    """Triangles of the last pose that lost some, by which were left."""

    def posed(self, pose: RigPose) -> tuple[_Floats, _Floats | None]:
        """Positions and normals (of any length) of all vertices in the world, shape (V, 3) each."""
        moved = [
            part.posed(pose.world_from_node, None if part.morphs is None else pose.morph_weights.get(part.morphs.node))
            for part in self.parts
        ]
        normals = [normals for _, normals in moved if normals is not None]
        positions = np.concatenate([positions for positions, _ in moved])
        return positions, np.concatenate(normals) if len(normals) == len(moved) else None

    def mesh(self, pose: RigPose) -> Mesh | None:
        """The surface as a mesh, without the triangles that have no area in this pose; None where none is left."""
        moved, normals = self.posed(pose)
        positions = handed_over(moved.astype(np.float32))
        usable = check_triangles(positions, self.indices).usable
        if not usable.any():
            return None
        return Mesh(
            positions,
            self.indices if usable.all() else self._some(usable),
            normals=None if normals is None else handed_over(_unit(normals)),
            uvs=self.uvs,
            material=self.material,
            colors=self.colors,
            name=self.name,
        )

    def _some(self, usable: npt.NDArray[np.bool_]) -> IntArray:
        """Triangles by a mask: the same array for poses that lose the same ones, by which a surface is known again."""
        key = usable.tobytes()
        if key not in self._left:
            self._left.clear()
            self._left[key] = handed_over(self.indices[usable])
        return self._left[key]


@dataclass(frozen=True, slots=True, eq=False)
class RigPose:
    """What moves the vertices of a rig at a time."""

    world_from_node: _Floats
    """Shape (N, 4, 4)."""
    morph_weights: dict[int, _Floats]
    """By the node of the mesh, of the nodes whose weights a clip changes."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Meshes bound to a hierarchy of joints, with animations by name; made by `load_rig`.

    A pose is linear blend skinning (glTF 2.0 section 3.7.3) of the vertices after their morph targets. All poses are
    in the file's world space, with its axes (glTF: y up, +z towards the viewer).

    Raises:
        SceneError: A mesh has no triangles at rest, or values that are not finite.
    """

    skeleton: Skeleton
    surfaces: tuple[RigSurface, ...]
    animations: tuple[Clip, ...]
    meshes: tuple[Mesh, ...] = field(init=False)
    """The meshes at rest, one a material: joints where the nodes of the file put them, as `load` shows them."""

    def __post_init__(self) -> None:
        rest = RigPose(self.skeleton.world_from_node(), {})
        meshes = [surface.mesh(rest) for surface in self.surfaces]
        if not meshes or None in meshes:
            raise SceneError("the rig has no triangles at rest")
        object.__setattr__(self, "meshes", tuple(meshes))

    def __repr__(self) -> str:
        faces = sum(len(surface.indices) for surface in self.surfaces)
        return f"Rig(meshes={len(self.surfaces)}, faces={faces}, clips={list(self.clips)})"

    @property
    def clips(self) -> tuple[str, ...]:
        """Names of the clips, in the file's order; those without a name are called by their number."""
        return tuple(clip.name for clip in self.animations)

    @property
    def mesh(self) -> Mesh:
        """The mesh at rest, of a rig that has one only.

        Raises:
            SceneError: It has several: see `meshes`.
        """
        self._refuse_several("meshes")
        return self.meshes[0]

    def duration(self, clip: str | None = None) -> float:
        """Time of the last key of a clip, seconds.

        Args:
            clip: Its name; None: the first.

        Raises:
            SceneError: There is no such clip; lists those there are.
        """
        found = self._clip(clip)
        if found is None:
            raise SceneError("the rig has no clips")
        return found.duration

    def pose(self, time: float, clip: str | None = None) -> Mesh:
        """The mesh at a time of a clip, of a rig that has one only; see `poses`.

        Raises:
            SceneError: The rig has several meshes, there is no such clip, the time is not finite, or nothing is left
                of the mesh at that time.
        """
        self._refuse_several("poses(time)")
        found = self.poses(time, clip)
        if not found:
            raise SceneError(f"the rig has no triangles at {time:g} s: its clip scales it to nothing")
        return found[0]

    def poses(self, time: float, clip: str | None = None) -> tuple[Mesh, ...]:
        """The meshes at a time of a clip, with normals.

        Args:
            time: Seconds; before the first key and after the last the pose holds.
            clip: Its name; None: the first, and the pose at rest if there is none.

        Returns:
            One mesh a material, without those that the clip scales to nothing at that time. Triangles without area
            in a pose are left out of it.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        pose = self.pose_at(time, clip)
        meshes = (surface.mesh(pose) for surface in self.surfaces)
        return tuple(mesh for mesh in meshes if mesh is not None)

    def pose_at(self, time: float, clip: str | None = None) -> RigPose:
        """What moves the vertices at a time; see `poses`.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        check_time(time)
        found = self._clip(clip)
        tracks = found.tracks if found else ()
        weights = {track.node: track.at(time) for track in tracks if track.channel is Channel.WEIGHTS}
        return RigPose(self.skeleton.world_from_node(found, time), weights)

    def _clip(self, name: str | None) -> Clip | None:
        """A clip by name, the first for None."""
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


def joined(parts: list[RigPart], indices: list[IntArray], skeleton: Skeleton) -> IntArray:
    """Triangles over the vertices of all parts, those of mirrored parts turned round, shape (F, 3).

    Args:
        parts: Of one surface.
        indices: Triangles of each, shape (F, 3).
        skeleton: At rest it says what is mirrored.
    """
    world_from_node = skeleton.world_from_node()
    shifted, first = [], 0
    for part, triangles in zip(parts, indices, strict=True):
        turned = triangles[:, ::-1] if is_mirroring(part.matrices(world_from_node)) else triangles
        shifted.append(turned + first)
        first += len(part.positions)
    return handed_over(np.concatenate(shifted).astype(np.int32))


def _unit(normals: _Floats) -> FloatArray:
    """At length 1; those without length stay 0, for `Mesh` to fill."""
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0.0).astype(np.float32)
