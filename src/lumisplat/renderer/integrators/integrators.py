"""What computes the radiance of rays: one of two ways, by the plan of the frame."""

from __future__ import annotations

from lumisplat.config import RenderConfig
from lumisplat.renderer.integrators.paths import PathIntegrator
from lumisplat.renderer.integrators.whitted import WhittedIntegrator
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher

Integrator = PathIntegrator | WhittedIntegrator


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

    def of(self, plan: FramePlan) -> Integrator:
        """The one that a frame needs."""
        return self._paths if plan.traces_paths else self._whitted
