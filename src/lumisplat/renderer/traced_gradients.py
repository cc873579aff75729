"""Derivatives of what rays show, of a frame or given ones, from arrays of the host to arrays of the host."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config import RenderConfig
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.errors import ConfigError
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.given_rays import GivenRays, batches
from lumisplat.renderer.gradients.given_arrays import given_array
from lumisplat.renderer.gradients.ray_backward import RayBackward
from lumisplat.renderer.gradients.ray_pose import pose_of_rays_gradient
from lumisplat.renderer.gradients.results import (
    RayGradients,
    SplatGradients,
    by_background,
    host_values,
    set_gradient,
)
from lumisplat.renderer.ray_queries import RayHits
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class TracedFrame:
    """What a frame of one ray a pixel was drawn from."""

    scene: Scene
    camera: Camera
    hits: PrimaryHits

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.camera.height, self.camera.width


@dataclass(frozen=True, slots=True, eq=False)
class GivenGradient:
    """Derivatives by what given rays show."""

    radiance: FloatArray
    """Shape (N, 3)."""
    transmittance: FloatArray
    """Shape (N,)."""

    @classmethod
    def of(cls, count: int, radiance: npt.ArrayLike, transmittance: npt.ArrayLike | None) -> GivenGradient:
        """Those that a caller gives; transmittance None: 0.

        Raises:
            SceneError: A shape does not fit, or a value is not finite.
        """
        by_radiance = given_array("dL_dradiance", radiance, (count, 3))
        if transmittance is None:
            return cls(by_radiance, np.zeros(count, np.float32))
        return cls(by_radiance, given_array("dL_dtransmittance", transmittance, (count,)))


class TracedGradients:
    """Goes back from what rays have shown.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings of sorted rays.
        tracer: Finds the hits of rays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, tracer: RayTracer) -> None:
        self._buffers, self._tracer = buffers, tracer
        self._backward = RayBackward(launcher, buffers, config)
        self._rays = GivenRays(launcher, buffers)

    def modules(self) -> list[KernelModule]:
        """The kernel modules."""
        return self._backward.modules()

    def of_frame(
        self, scene: DeviceScene, frame: TracedFrame, by_color: FloatArray, gradient: PixelGradient, *, pose: bool
    ) -> SplatGradients:
        """Derivatives by what a frame was drawn from.

        Args:
            scene: As it was drawn.
            frame: The frame.
            by_color: Derivatives by its colour, shape (H, W, 3).
            gradient: The same on the device, and those by its alpha.
            pose: Whether to differentiate by the camera's pose, too.
        """
        pixels = PixelBuffers.of(self._buffers, scene.image_size).data
        sums = self._backward.begin(scene)
        by_rays = self._backward.start_pixels(scene.image_size, frame.hits.count, pixels, gradient)
        self._backward.add(scene, frame.hits, by_rays, sums)
        instances = frame.scene.splats
        by_pose = pose_of_rays_gradient(sums.motions, instances, frame.camera) if pose else None
        none = np.zeros((0, 2), np.float32)
        return SplatGradients(
            sets=tuple(map(set_gradient, sums.gaussians)),
            background=by_background(by_color, 1.0 - host_values(pixels.alpha)),
            camera_from_world=None if by_pose is None else np.vstack([by_pose, np.zeros(4)]),
            centers=none,
            centers_absolute=none,
            weights=host_values(sums.weights),
        )

    def of_rays(
        self, scene: DeviceScene, rays: tuple[FloatArray, FloatArray], shown: RayHits, given: GivenGradient
    ) -> RayGradients:
        """Derivatives by what given rays have hit.

        Args:
            scene: As they have met it.
            rays: Their origins and unit directions, world space, shape (N, 3) each.
            shown: What they show.
            given: Derivatives by that.
        """
        behind = (given.radiance * shown.radiance).sum(axis=1) + given.transmittance * shown.transmittance
        sums = self._backward.begin(scene)
        scene.begin_sample(0)
        for first, batch in batches(*rays, np.full(len(behind), np.inf, np.float32)):
            count = len(batch[0])
            on_device = self._rays.allocate(count)
            self._rays.load(scene, first, count, self._rays.upload(batch), on_device)
            hits = self._tracer.find_hits(scene, on_device, "rays")
            rows = slice(first, first + count)
            by_rays = self._backward.start_rays(hits.count, given.radiance[rows], behind[rows])
            self._backward.add(scene, hits, by_rays, sums)
        return RayGradients(tuple(map(set_gradient, sums.gaussians)), host_values(sums.weights))


def check_traced(scene: Scene) -> None:
    """Refuses frames of rays that have more in them than what follows from rays through Gaussians.

    Raises:
        ConfigError: A mesh sends rays on.
    """
    for instance in scene.meshes:
        if instance.mesh.material.sends_rays_on:
            raise ConfigError(
                "what mirrors, glass and meshes that blend show has no gradients: take materials that are rough and "
                "opaque"
            )
