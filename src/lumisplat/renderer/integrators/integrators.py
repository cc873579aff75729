"""Chooses the integrator that computes the radiance of a frame's rays: path tracing, Whitted ray tracing or real-time.

Each integrator is imported and created by the first frame that needs it, because importing the kernels of all three
takes half a second.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from lumisplat.config import RenderConfig
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher

if TYPE_CHECKING:
    from lumisplat.renderer.integrators.paths import PathIntegrator
    from lumisplat.renderer.integrators.whitted import WhittedIntegrator
    from lumisplat.renderer.realtime.realtime import RealtimeIntegrator

    Integrator = PathIntegrator | RealtimeIntegrator | WhittedIntegrator


class Integrators:
    """Creates each of a renderer's integrators when a frame first needs it.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of secondary rays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._arguments = launcher, buffers, config, tracer
        self._whitted: WhittedIntegrator | None = None
        self._paths: PathIntegrator | None = None
        self._realtime: RealtimeIntegrator | None = None

    def of(self, plan: FramePlan) -> Integrator:
        """Returns the integrator that a frame of this plan needs, created at its first use."""
        if plan.has_history:
            from lumisplat.renderer.realtime.realtime import RealtimeIntegrator

            self._realtime = self._realtime or RealtimeIntegrator(*self._arguments)
            return self._realtime
        if plan.traces_paths:
            from lumisplat.renderer.integrators.paths import PathIntegrator

            self._paths = self._paths or PathIntegrator(*self._arguments)
            return self._paths
        from lumisplat.renderer.integrators.whitted import WhittedIntegrator

        self._whitted = self._whitted or WhittedIntegrator(*self._arguments)
        return self._whitted

    def radiance(
        self, scene: DeviceScene, plan: FramePlan, sample: int, find: Callable[[], PrimaryHits], key: object
    ) -> RayWave:
        """Returns rays that are not a frame's, with their radiance, as a wave; CUDA replays a recorded graph.

        Args:
            scene: The device scene, synced.
            plan: Plan of the rays.
            sample: Index of the sample.
            find: Returns the rays and their hits; is recorded, too.
            key: Values other than the scene's that the graph contains.
        """
        integrator, launcher = self.of(plan), self._arguments[0]
        integrator.begin_sample(scene, sample)
        while True:
            of_graph = scene.graph_key, integrator.graph_key(scene), key
            wave = launcher.replay("rays", of_graph, lambda: integrator.shade(scene, plan, find()))
            if integrator.is_complete(plan):
                return wave

    def forget(self) -> None:
        """Drops the history of the real-time integrator, if that integrator exists."""
        if self._realtime is not None:
            self._realtime.forget()
