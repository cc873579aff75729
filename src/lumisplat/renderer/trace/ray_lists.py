"""Lists of the Gaussians that camera rays may hit, by tiles of the image."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.device.structs.bvh import CandidateLists, SceneBvh


@dataclass(frozen=True, slots=True)
class RayLists:
    """The Gaussians that the camera rays of each tile may hit, in the structs that kernels read."""

    lists: CandidateLists
    scene: SceneBvh
    """Instances, Gaussians and colours of the scene; has no BVH."""
    ray_count: int
    """Number of rays of all tiles, including those outside the image."""
