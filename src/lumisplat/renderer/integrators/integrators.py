"""What computes the radiance of rays: one of three ways, by the plan of the frame."""

from __future__ import annotations

from functools import partial

from lumisplat.config import RenderConfig
from lumisplat.renderer.integrators.paths import PathIntegrator
from lumisplat.renderer.integrators.whitted import WhittedIntegrator
from lumisplat.renderer.realtime.realtime import RealtimeIntegrator
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher

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
        self._whitted = WhittedIntegrator(launcher, buffers, config, tracer)
        self._paths = PathIntegrator(launcher, buffers, config, tracer)
        # Made by the first frame in real time: it has arrays of its own, and launches kernels that are loaded by then.
        self._realtime: RealtimeIntegrator | None = None
        self._make_realtime = partial(RealtimeIntegrator, launcher, buffers, config, tracer)

    def of(self, plan: FramePlan) -> Integrator:
        """The one that a frame needs."""
        if plan.has_history:
            self._realtime = self._realtime or self._make_realtime()
            return self._realtime
        return self._paths if plan.traces_paths else self._whitted

    def forget(self) -> None:
        """Drops all that frames have found for later ones."""
        if self._realtime is not None:
            self._realtime.forget()
