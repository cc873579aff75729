"""Runs screen probes over several frames; a function answers their rays, so neither scene nor tracer is needed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import warp as wp

import lumisplat as ls
from lumisplat.config import ProbeConfig
from lumisplat.renderer.realtime.screen_probes import ScreenProbes
from lumisplat.renderer.scene.motion import in_size_of, previous_image
from lumisplat.runtime.buffers import Buffers, device_array
from lumisplat.runtime.launcher import Launcher
from support.scenes.gi_surfaces import Doubles, VisibleSurfaces, camera_rows

Tracer = Callable[[Doubles, Doubles], tuple[Doubles, Doubles]]
"""Maps origins and directions to radiance, shape (N, 3), and hit distances."""


class ProbeSequence:
    """Runs screen probes frame by frame.

    Args:
        tracer: Answers the probes' rays.
        threads: CPU threads.
        **settings: Fields of `ProbeConfig`; tiles are 16 pixels wide by default.
    """

    def __init__(self, tracer: Tracer, threads: int = 1, **settings: float) -> None:
        self.tracer = tracer
        self.launcher = Launcher("cpu", threads=threads)
        config = ProbeConfig(**{"tile": 16, **settings})  # pyright: ignore[reportArgumentType]
        self.probes = ScreenProbes(self.launcher, Buffers("cpu"), config)
        self.frame = 0
        self._before: ls.Camera | None = None
        self.rays: tuple[Doubles, Doubles] = np.zeros((0, 3)), np.zeros((0, 3))

    def place(self, surfaces: VisibleSurfaces) -> None:
        """Places the probes of a frame, its first step."""
        camera = surfaces.camera
        before = self._before or camera
        self.probes.begin(camera.image_size, self.frame, before.image_size, previous_image(before, camera))
        self.probes.place(surfaces.upload(), camera_rows(camera), camera_rows(in_size_of(camera, before)))
        self._before = camera

    def trace(self) -> None:
        """Traces the rays of the frame, and adds their radiance to the probes."""
        rays = self.probes.rays()
        active = device_array(rays.is_active).numpy()
        origins = device_array(rays.origin).numpy()[active].astype(float)
        directions = device_array(rays.direction).numpy()[active].astype(float)
        self.rays = origins, directions
        radiance, distance = np.full((len(active), 3), np.nan), np.full(len(active), np.nan)
        radiance[active], distance[active] = self.tracer(origins, directions)
        self.probes.update(
            wp.array(radiance.astype(np.float32), dtype=wp.vec3, device="cpu"),
            wp.array(distance.astype(np.float32), dtype=float, device="cpu"),
        )

    def render(self, surfaces: VisibleSurfaces) -> Doubles:
        """Returns irradiance in the next frame, shape (pixels, 3)."""
        self.place(surfaces)
        self.trace()
        self.frame += 1
        return self.look_up(surfaces)

    def look_up(self, surfaces: VisibleSurfaces) -> Doubles:
        """Returns irradiance of surfaces from the probes of the last frame."""
        return self.probes.irradiance(surfaces.upload()).numpy().astype(np.float64)


def constant(radiance: npt.ArrayLike, distance: float = 1.0) -> Tracer:
    """Returns a tracer that finds the same radiance and distance everywhere."""

    def trace(origins: Doubles, directions: Doubles) -> tuple[Doubles, Doubles]:
        return np.broadcast_to(radiance, directions.shape), np.full(len(directions), distance)

    return trace
