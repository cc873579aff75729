"""Gaussians bound to a rig, or to the triangles of a surface: they deform with it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, IntArray, read_only_view
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.animation.bindings import (
    FaceBinding,
    GaussianBinding,
    bind_to_bones,
    bind_to_faces,
    bind_to_joints,
    bind_to_triangles,
)
from lumisplat.scene.animation.deformation import deform, dots, principal_axes
from lumisplat.scene.animation.rig import Rig, RigPose
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians, merge_gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.ops.mesh_sampling import SurfaceSamples, sample_surfaces
from lumisplat.scene.ops.normals import estimate_normals

RIG_HIDDEN_AREA = 1e-4
"""Gaussians become transparent if their triangle's posed area is below this fraction of its rest area. The triangle is
then scaled to a hundredth, or so flat that float32 loses its normal."""

_Floats = npt.NDArray[np.floating]

_SHORT_NORMAL = 1e-6
"""Length of an interpolated normal below which its direction is rounding noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Binding:
    """Attachment of N Gaussians to T triangles of one surface.

    The frame of a triangle has the columns (first edge, second edge, normal); at rest the normal has length 1.
    """

    corners: IntArray
    """Vertex indices of the T triangles that hold Gaussians, shape (T, 3)."""
    areas: FloatArray
    """Twice the area of each of the T triangles in the rest pose, square scene units, shape (T,)."""
    triangles: IntArray
    """Index, 0..T-1, of the triangle to which each of the N Gaussians is bound, shape (N,)."""
    weights: FloatArray
    """Barycentric coordinates of each Gaussian's centre in its triangle, shape (N, 3)."""
    in_frame: FloatArray
    """Rest pose of each Gaussian in coordinates of its triangle's frame, shape (N, 3, 3). Columns: two wide axes times
    their scales, and the centre relative to the triangle's first corner."""

    def frames(self, positions: _Floats) -> tuple[FloatArray, FloatArray]:
        """Returns the frames (edges and normal) of the T triangles in a pose, and their areas relative to rest.

        The length of the normal is the square root of the area ratio, so that a uniform scale of the surface scales the
        frame uniformly.

        Args:
            positions: Posed positions of all V vertices of the surface, shape (V, 3).

        Returns:
            Frames, shape (T, 3, 3), and area ratios, shape (T,).
        """
        a, b, c = positions[self.corners].swapaxes(0, 1)
        first, second = b - a, c - a
        cross = np.cross(first, second)
        doubled = np.linalg.norm(cross, axis=1)
        growth = doubled / self.areas
        normals = np.divide(cross, doubled[:, None], out=np.zeros_like(cross), where=doubled[:, None] > 0.0)
        frames = np.stack([first, second, np.sqrt(growth)[:, None] * normals], axis=2)
        return frames.astype(np.float32), growth.astype(np.float32)


def bind_surface(mesh: Mesh, samples: SurfaceSamples) -> Binding:
    """Binds disc Gaussians that were sampled on ``mesh`` (`sample_surface`) to the triangles on which they lie."""
    used, triangles = np.unique(samples.faces, return_inverse=True)
    corners = mesh.indices[used]
    a, b, c = mesh.positions.astype(np.float64)[corners].swapaxes(0, 1)
    cross = np.cross(b - a, c - a)
    areas = np.linalg.norm(cross, axis=1)
    frame_from_world = np.linalg.inv(np.stack([b - a, c - a, cross / areas[:, None]], axis=2))[triangles]
    gaussians = samples.gaussians
    scales = gaussians.scales.astype(np.float64)
    axes = matrices_from_quaternions(gaussians.rotations_wxyz) * scales[:, None, :]
    in_frame = frame_from_world @ axes
    in_frame[:, :, 2] = 0.0
    in_frame[:, :2, 2] = samples.weights[:, 1:]
    return Binding(
        corners=read_only_view(corners),
        areas=read_only_view(areas.astype(np.float32)),
        triangles=read_only_view(triangles.astype(np.int32)),
        weights=read_only_view(samples.weights.astype(np.float32)),
        in_frame=read_only_view(in_frame.astype(np.float32)),
    )


def deform_gaussians(
    binding: Binding, scales: _Floats, positions: _Floats, vertex_normals: _Floats | None
) -> tuple[dict[str, _Floats], npt.NDArray[np.bool_]]:
    """Moves N Gaussians with the triangles to which they are bound.

    Args:
        binding: Binding of the Gaussians to the triangles.
        scales: Rest scales, shape (N, 3).
        positions: Posed positions of all V vertices of the surface, shape (V, 3).
        vertex_normals: Posed normals of the vertices, any length, shape (V, 3); None: the triangles are flat.

    Returns:
        New ``means``, ``rotations_wxyz``, ``scales`` and ``normals`` by name; and a mask, shape (N,), of the Gaussians
        whose triangles vanish in this pose, so that they vanish, too.
    """
    frames, growth = binding.frames(positions)
    triangles = binding.triangles
    vanished = growth[triangles] < RIG_HIDDEN_AREA
    moved = frames[triangles] @ binding.in_frame
    first, second = principal_axes(moved[:, :, 0], moved[:, :, 1])
    wide = np.sqrt(np.stack([dots(first, first), dots(second, second)], axis=1))
    wide[vanished] = 1.0
    first, second = first / wide[:, :1], second / wide[:, 1:]
    axes = np.stack([first, second, _crosses(first, second)], axis=2)
    axes[vanished] = np.eye(3)
    thin = scales[:, 2] * np.sqrt(wide[:, 0] * wide[:, 1] / (scales[:, 0] * scales[:, 1]))
    changed = {
        "means": positions[binding.corners[:, 0]].astype(np.float32)[triangles] + moved[:, :, 2],
        "rotations_wxyz": quaternions_from_matrices(axes),
        "scales": np.where(vanished[:, None], scales, np.concatenate([wide, thin[:, None]], axis=1)),
        "normals": _normals(binding, vertex_normals, axes[:, :, 2]),
    }
    return changed, vanished


def _normals(binding: Binding, vertex_normals: _Floats | None, flat: _Floats) -> _Floats:
    """Returns N Gaussians' shading normals, (N, 3), interpolated from vertex normals; ``flat`` if there are none."""
    if vertex_normals is None:
        return flat
    lengths = np.linalg.norm(vertex_normals, axis=1, keepdims=True)
    unit = np.divide(vertex_normals, lengths, out=np.zeros_like(vertex_normals), where=lengths > 0.0)
    at_corners = unit.astype(np.float32)[binding.corners][binding.triangles]
    smooth = (binding.weights[:, None, :] @ at_corners)[:, 0]
    length = np.sqrt(dots(smooth, smooth))[:, None]
    return np.where(length > _SHORT_NORMAL, smooth / np.maximum(length, _SHORT_NORMAL), flat)


def _crosses(first: _Floats, second: _Floats) -> _Floats:
    a, b = first, second
    columns = [a[:, (k + 1) % 3] * b[:, (k + 2) % 3] - a[:, (k + 2) % 3] * b[:, (k + 1) % 3] for k in range(3)]
    return np.stack(columns, axis=1)


@dataclass(frozen=True, slots=True, eq=False)
class RiggedGaussians:
    """Gaussians that follow a rig; made by `bind_gaussians`. Their number and order never change.

    Gaussians that `bind_gaussians` has sampled are discs in triangles, with fixed barycentric coordinates. The
    triangle's affine map from rest to pose transforms their two wide axes. The transformed axes span an ellipse, and
    its principal axes become the new wide axes. Rotation, stretch and shear in the plane are thus exact; a polar
    decomposition with an area factor would only approximate skin that stretches in one direction. The thin axis is
    perpendicular to the wide ones and scales with the square root of the area ratio. Normals are interpolated between
    the posed vertices. Opacities, colours and materials stay; where a triangle shrinks to nothing, its Gaussians get
    opacity 0.

    Gaussians that were given follow one affine map each, with their covariances, SH and normals.
    """

    rig: Rig
    gaussians: Gaussians
    """Gaussians in the pose in which they were bound, in the rig's world space."""
    bindings: tuple[Binding, ...] | GaussianBinding
    """Binding of given Gaussians; or one binding per surface of the rig, if ``gaussians`` were sampled: they hold the
    Gaussians of the surfaces in the same order."""

    def __repr__(self) -> str:
        return f"RiggedGaussians(count={self.count}, rig={self.rig!r})"

    @property
    def count(self) -> int:
        """Number of Gaussians, the same at all times."""
        return self.gaussians.count

    def at(self, time: float, clip: str | None = None) -> Gaussians:
        """Returns the Gaussians at a time of a clip, in the order of `gaussians`.

        Args:
            time: Seconds; the pose is constant before the first key and after the last one.
            clip: Name of the clip; None: the first one, or the rest pose if the rig has no clips.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        pose = self.rig.pose_at(time, clip)
        if not isinstance(self.bindings, tuple):
            turns = not isinstance(self.bindings, FaceBinding)  # GaussianAvatars trains SH in world space
            return deform(self.gaussians, self.bindings.maps(self.rig, pose), rotates_sh=turns)
        columns: dict[str, list[_Floats]] = {name: [] for name in ("means", "rotations_wxyz", "scales", "normals")}
        masks: list[npt.NDArray[np.bool_]] = []
        first = 0
        for binding, surface in zip(self.bindings, self.rig.surfaces, strict=True):
            positions, normals = surface.pose_vertices(pose)
            rows = slice(first, first + len(binding.triangles))
            first = rows.stop
            moved, vanished = deform_gaussians(binding, self.gaussians.scales[rows], positions, normals)
            masks.append(vanished)
            for name, values in moved.items():
                columns[name].append(values)
        changed = {name: read_only_view(np.concatenate(values)) for name, values in columns.items()}
        vanished = np.concatenate(masks)
        if vanished.any():
            changed["opacities"] = read_only_view(np.where(vanished, np.float32(0.0), self.gaussians.opacities))
        return replace(self.gaussians, **changed)


def bind_gaussians(
    rig: Rig,
    count: int | None = None,
    seed: int = 0,
    *,
    gaussians: Gaussians | None = None,
    weights: npt.ArrayLike | None = None,
    triangles: npt.ArrayLike | None = None,
    pose: RigPose | None = None,
) -> RiggedGaussians:
    """Binds Gaussians to a rig: given ones, or new ones that cover the rig's meshes as `gaussians_from_mesh` does.

    Given Gaussians are a trained avatar in one pose of the rig. They keep their look. They follow

    - joints by ``weights`` (linear blend skinning, as canonical Gaussians of GART, HUGS and ExAvatar do);
    - ``triangles``, each by its own, in whose frames they are given (GaussianAvatars);
    - without either, the nearest triangles of the rig's meshes, blended over the vertices between them;
    - bones by distance, if the rig has no meshes.

    Covariances and normals follow the blended map exactly, SH turn with its rotation. Given Gaussians without normals
    get those of `estimate_normals`, once, so that lit sequences do not flicker.

    Args:
        rig: Rig from `load_rig`.
        count: Number of new Gaussians, at least one per mesh of the rig; None: so many that neighbours are 1/300 of the
            bounding box's diagonal apart, from 1,000 to 1,000,000.
        seed: Seed of the random order of new Gaussians; equal seeds give equal results on the same platform and NumPy
            version.
        gaussians: N Gaussians to bind, in the rig's world space; None: new ones.
        weights: Skinning weights of the Gaussians, at least 0, shape (N, J), J the number of joints of the rig's skin
            or of nodes of its skeleton; rows are scaled to sum 1.
        triangles: Triangle of each Gaussian, an index into those of all meshes of the rig, shape (N,). ``gaussians``
            are then in the frames of these triangles, as in the files of GaussianAvatars.
        pose: Pose of the rig in which ``gaussians`` stand, from `Rig.pose_at`; None: the rest pose.

    Raises:
        SceneError: ``rig`` is not a rig, ``count`` is out of range, an argument applies to given Gaussians only, or
            weights do not fit.
    """
    check_argument("bind_gaussians", rig, Rig, "a Rig of load_rig")
    if isinstance(cast("object", count), Gaussians):
        raise SceneError("bind_gaussians takes a number of new Gaussians: pass given ones as gaussians=")
    if gaussians is None:
        if weights is not None or triangles is not None or pose is not None:
            raise SceneError(
                "bind_gaussians: weights, triangles and pose are those of given Gaussians: pass gaussians=, too"
            )
        if not rig.surfaces:
            raise SceneError("the rig has no meshes to cover with Gaussians: pass gaussians=")
        samples = sample_surfaces(rig.meshes, count, seed)
        bindings = [bind_surface(mesh, one) for mesh, one in zip(rig.meshes, samples, strict=True)]
        return RiggedGaussians(rig, merge_gaussians([one.gaussians for one in samples]), tuple(bindings))
    check_argument("bind_gaussians", gaussians, Gaussians, "Gaussians")
    if count is not None:
        raise SceneError("bind_gaussians: count is the number of new Gaussians, but gaussians are given, too")
    if pose is not None:
        check_argument("bind_gaussians", pose, RigPose, "a pose of the rig", ": rig.pose_at(seconds) makes one")
    rest = RigPose(rig.skeleton.world_from_node(), {}) if pose is None else pose
    points = gaussians.means.astype(np.float64) + np.asarray(gaussians.origin)
    if triangles is not None:
        if weights is not None:
            raise SceneError("bind_gaussians: weights and triangles are both given: choose one of them")
        faces = bind_to_faces(rig, rest, triangles, gaussians.count)
        frames = np.linalg.inv(faces.frame_from_rest).astype(np.float64)[faces.triangles, :3]
        return RiggedGaussians(rig, _with_normals(deform(gaussians, frames, rotates_sh=False)), faces)
    if weights is not None:
        binding: GaussianBinding = bind_to_joints(rig, rest, weights, gaussians.count)
    elif rig.surfaces:
        binding = bind_to_triangles(rig, rest, points)
    else:
        binding = bind_to_bones(rig, rest, points)
    return RiggedGaussians(rig, _with_normals(gaussians), binding)


def _with_normals(gaussians: Gaussians) -> Gaussians:
    """Returns the Gaussians with normals, estimated if they have none."""
    return gaussians if gaussians.normals is not None else replace(gaussians, normals=estimate_normals(gaussians))
