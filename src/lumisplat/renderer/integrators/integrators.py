"""Integrators compute the radiance of rays: one of three, by the plan of the frame.

Each is imported and made by the first frame that needs it: the kernels of all of them take half a second to import.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from lumisplat.config import RenderConfig
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher

if TYPE_CHECKING:
    from lumisplat.renderer.integrators.paths import PathIntegrator
    from lumisplat.renderer.integrators.whitted import WhittedIntegrator
    from lumisplat.renderer.realtime.realtime import RealtimeIntegrator

    Integrator = PathIntegrator | RealtimeIntegrator | WhittedIntegrator


class Integrators:
    """The integrators of a renderer.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of the rays that they spawn.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._arguments = launcher, buffers, config, tracer
        self._whitted: WhittedIntegrator | None = None
        self._paths: PathIntegrator | None = None
        self._realtime: RealtimeIntegrator | None = None

    def of(self, plan: FramePlan) -> Integrator:
        """The one that a frame needs."""
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

    def forget(self) -> None:
        """Drops all that frames have found for later ones."""
        if self._realtime is not None:
            self._realtime.forget()
