"""Gaussians bound to the triangles of a rig, that deform with them."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class RiggedGaussians:
    """Gaussians on the surface of a rig, made by `bind_gaussians`."""

    rig: Rig
    gaussians: Gaussians
    """At rest, in the rig's world space."""

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
        raise NotImplementedError


def bind_gaussians(rig: Rig, count: int | None = None, seed: int = 0) -> RiggedGaussians:
    """Covers a rig with Gaussians that move with its triangles.

    Args:
        rig: Of `load_rig`.
        count: Number of Gaussians; None: as `gaussians_from_mesh`, over all meshes of the rig.
        seed: Seed of the random order.

    Raises:
        SceneError: This is no rig, or ``count`` is out of range.
    """
    raise NotImplementedError
