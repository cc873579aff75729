"""Functions of one call: each creates a renderer, uses it once and drops it."""

from __future__ import annotations

import math

import numpy.typing as npt

from lumisplat.config import RenderConfig
from lumisplat.config.checks import check_whole
from lumisplat.constants import SAMPLES_MAX
from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.checks import checked_config
from lumisplat.renderer.rays import RayHits, tracing
from lumisplat.renderer.renderer import create_renderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene

WARM_UP_FRAMES = 32
"""Frames of a view that stands still, of which the last is shown: as many as direct light is averaged over."""


def render(
    scene: Scene,
    camera: Camera,
    config: RenderConfig | None = None,
    *,
    frames: int | None = None,
    device: str = "auto",
) -> Frame:
    """Renders one frame with a renderer of its own; for several frames, ``create_renderer`` keeps what they share.

    With ``Pipeline.REALTIME`` it is the last one of a sequence that stands still, in which light finds its way.

    Args:
        scene: What to draw.
        camera: From where.
        config: Settings; None: the defaults.
        frames: Of ``Pipeline.REALTIME`` alone, the length of the sequence; None: 32, as on the command line.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig, ``frames`` is below 1, or given with another pipeline.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: As for ``Renderer.render``.
    """
    is_sequence = checked_config(config).pipeline.is_sequence
    if frames is not None:
        if not is_sequence:
            raise ConfigError("frames is of Pipeline.REALTIME: samples make frames of other pipelines better")
        check_whole("frames", frames, 1, SAMPLES_MAX)
    renderer = create_renderer(config, device)
    for _ in range((frames or WARM_UP_FRAMES) - 1 if is_sequence else 0):
        renderer.render(scene, camera)
    return renderer.render(scene, camera)


def trace_rays(
    scene: Scene,
    origins: npt.ArrayLike,
    directions: npt.ArrayLike,
    config: RenderConfig | None = None,
    *,
    profile: bool = False,
    device: str = "auto",
) -> RayHits:
    """Traces any rays through a scene, mirrors and glass included.

    Rays are traced in batches, so that memory does not grow with their number; neighbours in the arrays that are
    neighbours in space are traced together, and faster. For many calls on one scene, ``create_renderer`` with
    ``Pipeline.TRACE`` and its ``trace_rays`` keep what they share.

    Args:
        scene: What they hit.
        origins: World space, shape (N, 3), or (3,) for all rays.
        directions: World space, of any length, shape (N, 3).
        config: Settings; None: the defaults. ``background`` is seen in mirrors only.
        profile: Whether to list the Gaussians on each ray up to the first mesh, in ``RayHits.profile``: exact and
            in order, whatever the strategy. The result has 20 bytes a Gaussian; device memory stays bounded.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: A shape does not fit, a value is not finite or a direction has no length; the message counts them.
    """
    renderer = create_renderer(tracing(checked_config(config)), device)
    return renderer.trace_rays(scene, origins, directions, profile=profile)


def focused(
    scene: Scene, camera: Camera, x: int, y: int, config: RenderConfig | None = None, *, device: str = "auto"
) -> Camera:
    """The camera with what one of its pixels shows in focus: ``focus_distance`` follows, all else stays.

    The surface is that of the frame's depth at this pixel, without the lens. For a frame to blur what is not in focus,
    the camera needs an ``aperture``, and the frame a pipeline of rays.

    Args:
        scene: What the camera looks at.
        camera: The camera.
        x: Column of the pixel, from 0.
        y: Row of the pixel, from 0.
        config: Settings; None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: There is no such pixel, or it shows no surface.
    """
    return create_renderer(tracing(checked_config(config)), device).focused(scene, camera, x, y)


def transmittance(
    scene: Scene,
    origins: npt.ArrayLike,
    directions: npt.ArrayLike,
    max_distance: npt.ArrayLike = math.inf,
    *,
    config: RenderConfig | None = None,
    device: str = "auto",
) -> FloatArray:
    """Transmittance along rays, from their origins to ``max_distance``.

    The product of 1 - alpha over all Gaussians on the way, 0 if below ``config.trace.transmittance_min``, or if a mesh
    of any material is on the way.

    Args:
        scene: What blocks them.
        origins: World space, shape (N, 3), or (3,) for all rays.
        directions: World space, of any length, shape (N, 3).
        max_distance: Scene units, one number or one a ray, shape (N,).
        config: Settings; None: the defaults.
        device: As for ``create_renderer``.

    Returns:
        Transmittances 0..1, shape (N,).

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: There is no such device, or it is out of memory.
        SceneError: As for ``trace_rays``, or a distance is negative or NaN.
    """
    return create_renderer(tracing(checked_config(config)), device).transmittance(
        scene, origins, directions, max_distance
    )
