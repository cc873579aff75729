"""Host pass: parts of rays as frames show them, and the Gaussians there (docs/method/relighting.md#baking)."""

from __future__ import annotations

from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.ray_profiles import RayProfile
from lumisplat.renderer.ray_queries import RayHits
from lumisplat.renderer.renderer import Renderer
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.scene.scene import Scene


class FrameRays(Renderer):
    """A renderer that shows rays up to where they end, and lists what they meet in the order of its settings."""

    def shown(self, scene: Scene, origins: FloatArray, directions: FloatArray, ends: FloatArray) -> RayHits:
        """What rays show before these distances, shape (N,); directions are unit vectors."""
        return self._queries.query(self._scene, self._ready(scene), origins, directions, ends=ends)

    def met(self, scene: Scene, origins: FloatArray, directions: FloatArray) -> RayProfile:
        """The Gaussians on rays, one by one; directions are unit vectors."""
        self._ready(scene)
        return self._profiles.query(self._scene, scene, origins, directions)

    def _ready(self, scene: Scene) -> FramePlan:
        plan = self._sync_rays(scene)
        self._load(self._modules(plan))
        return plan
