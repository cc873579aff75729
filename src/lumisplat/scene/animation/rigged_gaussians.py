"""Gaussians that are bound to the triangles of a rig and deform with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import read_only_view
from lumisplat.scene.animation.binding import Binding, bind_surface, deform_gaussians
from lumisplat.scene.animation.rig import Rig
from lumisplat.scene.checks import check_argument
from lumisplat.scene.gaussians import Gaussians, merge_gaussians
from lumisplat.scene.sampling.multi_mesh_sampling import sample_surfaces

_Floats = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class RiggedGaussians:
    """Gaussians on the surface of a rig that follow its triangles; made by `bind_gaussians`.

    Each Gaussian keeps its barycentric coordinates. Its two wide axes are transformed by the triangle's affine map from
    rest to pose, and the principal axes of the ellipse that they then span become its new wide axes. So rotation,
    stretch and shear in the plane are exact; the rotation of a polar decomposition with a factor for the area is only
    close where skin stretches in one direction. The thin axis is perpendicular to both and scales with the square root
    of the area's factor. Normals are interpolated between those of the posed vertices. Opacities, colours and materials
    stay; where a triangle shrinks to nothing, its Gaussians get opacity 0. Number and order never change.
    """

    rig: Rig
    gaussians: Gaussians
    """At rest, in the rig's world space."""
    bindings: tuple[Binding, ...]
    """One binding for each surface of the rig, whose Gaussians follow one another."""

    def __repr__(self) -> str:
        return f"RiggedGaussians(count={self.count}, rig={self.rig!r})"

    @property
    def count(self) -> int:
        """Number of Gaussians, the same at all times."""
        return self.gaussians.count

    def at(self, time: float, clip: str | None = None) -> Gaussians:
        """The Gaussians at a time of a clip, in the order of `gaussians`.

        Args:
            time: Seconds; the pose is constant before the first key and after the last one.
            clip: Name of the clip; None: the first one, or the rest pose if the rig has no clips.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        pose = self.rig.pose_at(time, clip)
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


def bind_gaussians(rig: Rig, count: int | None = None, seed: int = 0) -> RiggedGaussians:
    """Covers a rig at rest with Gaussians, as `gaussians_from_mesh` does, that move with its triangles.

    Args:
        rig: A rig from `load_rig`.
        count: Number of Gaussians, at least one for each mesh of the rig; None: so many that neighbours are 1/300 of
            the bounding box's diagonal apart, from 1,000 to 1,000,000.
        seed: Seed of the random order; equal seeds give equal results on the same platform and NumPy version.

    Raises:
        SceneError: ``rig`` is not a rig, or ``count`` is out of range.
    """
    check_argument("bind_gaussians", rig, Rig, "a Rig of load_rig")
    samples = sample_surfaces(rig.meshes, count, seed)
    bindings = [bind_surface(mesh, one) for mesh, one in zip(rig.meshes, samples, strict=True)]
    return RiggedGaussians(rig, merge_gaussians([one.gaussians for one in samples]), tuple(bindings))
