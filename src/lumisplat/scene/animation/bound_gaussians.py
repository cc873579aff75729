"""Gaussians bound to the triangles of a rig, that deform with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import handed_over
from lumisplat.scene.animation.binding import Binding, bind_surface, deformed
from lumisplat.scene.animation.rig import Rig
from lumisplat.scene.gaussians import Gaussians, merged
from lumisplat.scene.sampling.meshes_sampling import sample_surfaces

_Floats = npt.NDArray[np.floating]


@dataclass(frozen=True, slots=True, eq=False)
class RiggedGaussians:
    """Gaussians on the surface of a rig, made by `bind_gaussians`, that follow its triangles.

    Each Gaussian keeps its barycentric place. Its two wide axes, as vectors, go through the triangle's affine map from
    rest to pose, and the principal axes of the ellipse that they then span are its new ones: rotation, stretch and
    shear in the plane are exact, to which the rotation of a polar decomposition and a factor for the area come only
    close where skin stretches one way. The thin axis is square to both and scales with the square root of the area's
    factor. Normals are interpolated between those of the posed vertices. Opacities, colours and materials stay; where
    a triangle shrinks to nothing, its Gaussians have opacity 0. There are always as many, in the same order.
    """

    rig: Rig
    gaussians: Gaussians
    """At rest, in the rig's world space."""
    bindings: tuple[Binding, ...]
    """One for each surface of the rig; its Gaussians follow one another."""

    def __repr__(self) -> str:
        return f"RiggedGaussians(count={self.count}, rig={self.rig!r})"

    @property
    def count(self) -> int:
        """Number of Gaussians, the same at all times."""
        return self.gaussians.count

    def at(self, time: float, clip: str | None = None) -> Gaussians:
        """The Gaussians at a time of a clip, in the order of `gaussians`.

        Args:
            time: Seconds; before the first key and after the last the pose holds.
            clip: Its name; None: the first, and the pose at rest if there is none.

        Raises:
            SceneError: There is no such clip, or the time is not finite.
        """
        pose = self.rig.pose_at(time, clip)
        columns: dict[str, list[_Floats]] = {name: [] for name in ("means", "rotations_wxyz", "scales", "normals")}
        hidden, first = [], 0
        for binding, surface in zip(self.bindings, self.rig.surfaces, strict=True):
            positions, normals = surface.posed(pose)
            rows = slice(first, first + len(binding.triangles))
            first = rows.stop
            moved, vanished = deformed(binding, self.gaussians.scales[rows], positions, normals)
            hidden.append(vanished)
            for name, values in moved.items():
                columns[name].append(values)
        changed = {name: handed_over(np.concatenate(values)) for name, values in columns.items()}
        vanished = np.concatenate(hidden)
        if vanished.any():
            changed["opacities"] = handed_over(np.where(vanished, np.float32(0.0), self.gaussians.opacities))
        return replace(self.gaussians, **changed)


def bind_gaussians(rig: Rig, count: int | None = None, seed: int = 0) -> RiggedGaussians:
    """Covers a rig at rest with Gaussians, as `gaussians_from_mesh` does, that move with its triangles.

    Args:
        rig: Of `load_rig`.
        count: Number of Gaussians, at least one for each mesh of the rig; None: as many as put neighbours 1/300 of
            the bounding box's diagonal apart, from 1,000 to 1,000,000.
        seed: Seed of the random order; equal seeds give equal results on the same platform and NumPy version.

    Raises:
        SceneError: This is no rig, or ``count`` is out of range.
    """
    if not isinstance(rig, Rig):
        raise SceneError(f"bind_gaussians takes a Rig of load_rig, got a {type(rig).__name__}")
    samples = sample_surfaces(rig.meshes, count, seed)
    bindings = [bind_surface(mesh, one) for mesh, one in zip(rig.meshes, samples, strict=True)]
    return RiggedGaussians(rig, merged([one.gaussians for one in samples]), tuple(bindings))
