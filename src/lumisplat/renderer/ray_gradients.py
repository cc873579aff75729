"""Derivatives of a number by the Gaussians that any rays hit: ``ray_gradients``."""

from __future__ import annotations

import numpy.typing as npt

from lumisplat.config import RenderConfig
from lumisplat.renderer.gradients.results import RayGradients
from lumisplat.renderer.ray_queries import tracing
from lumisplat.renderer.splat_gradients import DifferentiableRenderer
from lumisplat.scene.scene import Scene


def ray_gradients(
    scene: Scene,
    origins: npt.ArrayLike,
    directions: npt.ArrayLike,
    dL_dradiance: npt.ArrayLike,
    dL_dtransmittance: npt.ArrayLike | None = None,
    *,
    config: RenderConfig | None = None,
    device: str = "auto",
) -> RayGradients:
    """Derivatives of a number by the Gaussians of a scene, given those by what any rays show of it, unlit.

    Rays are those of `lumisplat.trace_rays`; for more than one call, a `lumisplat.DifferentiableRenderer` keeps what
    they share::

        shown = ls.trace_rays(scene, origins, directions, ls.RenderConfig(lighting=False))
        gradients = ls.gradients.ray_gradients(scene, origins, directions, 2.0 * (shown.radiance - photographs))

    Args:
        scene: What they hit.
        origins: World space, shape (N, 3), or (3,) for all rays.
        directions: World space, of any length, shape (N, 3).
        dL_dradiance: Its derivatives by ``RayHits.radiance``, display-referred sRGB, shape (N, 3); arrays as of
            `lumisplat.DifferentiableRenderer.gradients`.
        dL_dtransmittance: Its derivatives by ``RayHits.transmittance``, shape (N,); None: 0.
        config: Settings; None: the defaults. The pipeline is always ``TRACE``.
        device: As of `lumisplat.create_renderer`.

    Raises:
        ConfigError: Another strategy, more samples or lights are asked for, or meshes send rays on.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: As of `lumisplat.trace_rays`; or a shape does not fit, or a value is not finite.
    """
    renderer = DifferentiableRenderer(tracing(config), device)
    return renderer.ray_gradients(scene, origins, directions, dL_dradiance, dL_dtransmittance)
