"""Functions that create a renderer, use it once and release it."""

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
"""Default number of frames in a still real-time sequence. Only the last frame is returned; its direct light is the
mean of up to as many frames.
"""


def render(
    scene: Scene,
    camera: Camera,
    config: RenderConfig | None = None,
    *,
    frames: int | None = None,
    device: str = "auto",
) -> Frame:
    """Renders one frame. For several frames, ``create_renderer`` is faster: it reuses kernels, buffers and assets.

    With ``Pipeline.REALTIME``, the result is the last frame of a still sequence; the lighting converges over the
    sequence.

    Args:
        scene: The scene to render.
        camera: The camera.
        config: Settings; None: the defaults.
        frames: Number of frames of the still sequence, for ``Pipeline.REALTIME`` only; None: 32, as on the command
            line.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig, ``frames`` is below 1, or ``frames`` is given for another pipeline.
        DeviceError: The device does not exist or is out of memory.
        SceneError: As for ``Renderer.render``.
    """
    is_sequence = checked_config(config).pipeline.is_sequence
    if frames is not None:
        if not is_sequence:
            raise ConfigError("frames is for Pipeline.REALTIME only: set samples for other pipelines")
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
    """Traces rays with given origins and directions through a scene, including mirrors and glass.

    Rays are traced in batches, so memory does not grow with their number. Rays that are neighbours in the arrays are
    traced together. This is faster if these rays are close in space, too. For many calls on one scene, use
    ``create_renderer`` with ``Pipeline.TRACE`` and its ``trace_rays``.

    Args:
        scene: The scene to trace.
        origins: World-space origin of each of N rays, shape (N, 3), or one origin for all rays, shape (3,).
        directions: World-space direction of each ray, of any length, shape (N, 3).
        config: Settings; None: the defaults. ``background`` is visible in mirrors only.
        profile: Whether to list the Gaussians on each ray up to the first mesh in ``RayHits.profile``. The list is
            exact and sorted, whatever ``config.trace.strategy`` is. It takes 20 bytes of host memory per listed
            Gaussian; device memory stays bounded.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: The device does not exist or is out of memory.
        SceneError: A shape does not fit, a value is not finite, or a direction has no length; the message says how
            many.
    """
    renderer = create_renderer(tracing(checked_config(config)), device)
    return renderer.trace_rays(scene, origins, directions, profile=profile)


def focused(
    scene: Scene, camera: Camera, x: int, y: int, config: RenderConfig | None = None, *, device: str = "auto"
) -> Camera:
    """Returns the camera focused on the surface at one pixel; all fields but ``focus_distance`` are unchanged.

    The surface is at the frame's depth at that pixel, traced through a pinhole. Defocus blur also needs an ``aperture``
    and a ray-traced pipeline.

    Args:
        scene: The scene that the camera sees.
        camera: The camera.
        x: Column of the pixel, from 0.
        y: Row of the pixel, from 0.
        config: Settings; None: the defaults.
        device: As for ``create_renderer``.

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: The device does not exist or is out of memory.
        SceneError: The pixel is outside the image, or shows no surface.
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
    """Returns the transmittance along rays from their origins to ``max_distance``.

    Transmittance is the product of 1 - alpha over all Gaussians on the segment. The result is 0 where the product is
    below ``config.trace.transmittance_min``, or where a mesh of any material is on the segment.

    Args:
        scene: The scene that blocks the rays.
        origins: World-space origin of each of N rays, shape (N, 3), or one origin for all rays, shape (3,).
        directions: World-space direction of each ray, of any length, shape (N, 3).
        max_distance: Distance at which the segment ends, scene units: one number, or one per ray, shape (N,).
        config: Settings; None: the defaults.
        device: As for ``create_renderer``.

    Returns:
        Transmittance of each ray, 0..1, shape (N,).

    Raises:
        ConfigError: ``config`` is no RenderConfig.
        DeviceError: The device does not exist or is out of memory.
        SceneError: As for ``trace_rays``, or a distance is negative or NaN.
    """
    return create_renderer(tracing(checked_config(config)), device).transmittance(
        scene, origins, directions, max_distance
    )
