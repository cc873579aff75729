"""Base class of integrators whose samples depend on no earlier sample."""

from __future__ import annotations

from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import RayWave


class SampleIntegrator:
    """Has the defaults of integrators that store nothing from sample to sample."""

    parity = 0
    """Set of arrays that a sample uses; all samples use set 0."""

    def graph_key(self, scene: DeviceScene) -> object:
        """Returns values that a recorded CUDA graph of `shade` contains; a graph recorded with others is stale."""
        return None

    def is_complete(self, plan: FramePlan) -> bool:
        """Returns whether all rays of the last `shade` were followed; if not, draw the sample again."""
        return True

    def finish(self, scene: DeviceScene, plan: FramePlan, wave: RayWave) -> None:
        """Ends a sample that is complete; changes nothing."""
