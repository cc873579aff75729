"""Backward pass of ray tracing, from gradients at rays to gradients of the Gaussians that the rays hit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import RAY_BANDS_PER_THREAD
from lumisplat.device.gaussian.hit_gradient import RayMotion
from lumisplat.device.structs.bvh import TraceData
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, HitGradients, PixelGradient, RayGradient
from lumisplat.device.structs.rays import HitProfiles, RayData
from lumisplat.errors import ConfigError
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.gradients import ray_backward_kernels as kernels
from lumisplat.renderer.gradients.arrays import (
    RayGradients,
    SplatGradients,
    by_background,
    given_array,
    gradient_of_asset,
    host_values,
    set_gradient,
)
from lumisplat.renderer.gradients.pose import pose_of_rays_gradient
from lumisplat.renderer.rays import RayHits, RayLoader, batches
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer, packet_ranges, trace_table
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table, device_array, grown_capacity
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.primitives import prefix_sum, sort_pairs
from lumisplat.scene.camera import Camera
from lumisplat.scene.scene import Scene

BACKWARD_HITS = 2**22
"""Largest number of hits whose gradients are on the device at once, 44 bytes each, together 180 MiB. The hits of a
single packet of rays may exceed this number."""

Struct = TypeVar("Struct")


@dataclass(frozen=True, slots=True)
class RaySums:
    """Gradients with respect to the Gaussians that rays hit, accumulated on the device over batches of rays."""

    gaussians: list[GaussianGradient]
    """Gradients with respect to the parameters of the Gaussians, one struct of arrays for each Gaussian set."""
    weights: DeviceArray
    """Blending weight of each Gaussian of the scene, summed over rays; Gaussians are listed instance by instance."""
    largest: DeviceArray
    """Largest blending weight of each Gaussian of the scene on any ray; Gaussians are listed instance by instance."""
    motions: DeviceArray
    """Gradients (``RayMotion``) with respect to rigid motions of rays. Each Gaussian of the scene has one, for the
    rays that hit the Gaussian."""


@dataclass(frozen=True, slots=True)
class _Rays:
    """A batch of rays, consisting of whole ray packets."""

    rays: RayData
    limits: DeviceArray
    """Distance at which each ray ends, such as at the nearest mesh."""
    gradient: RayGradient
    counts: DeviceArray
    """Number of Gaussians that each ray hits."""
    found: int
    """Number of Gaussians that all rays hit, the sum of ``counts``."""


@dataclass(frozen=True, slots=True)
class TracedFrame:
    """Inputs of the backward pass of a traced frame with one ray a pixel: the frame's inputs and primary hits."""

    scene: Scene
    camera: Camera
    hits: PrimaryHits

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.camera.height, self.camera.width


@dataclass(frozen=True, slots=True, eq=False)
class UpstreamGradient:
    """Gradients of the loss with respect to the radiance and transmittance of a caller's rays."""

    radiance: FloatArray
    """Gradient with respect to the radiance of each of N rays, (N, 3)."""
    transmittance: FloatArray
    """Gradient with respect to the transmittance of each of N rays, (N,)."""

    @classmethod
    def of(cls, count: int, radiance: npt.ArrayLike, transmittance: npt.ArrayLike | None) -> UpstreamGradient:
        """Checks and converts a caller's gradients at ``count`` rays; None stands for gradients of 0.

        Raises:
            SceneError: A shape does not fit, or a value is not finite.
        """
        by_radiance = given_array("dL_dradiance", radiance, (count, 3))
        if transmittance is None:
            return cls(by_radiance, np.zeros(count, np.float32))
        return cls(by_radiance, given_array("dL_dtransmittance", transmittance, (count,)))


class RayBackward:
    """Computes gradients of the loss with respect to Gaussians from the loss's gradients at rays.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings of rays with sorted blending.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._given = RayLoader(launcher, buffers)
        self._tracer = GaussianTracer(launcher, buffers, config, "backward.trace")
        self._settings = buffers.get("backward.settings", TraceData, 1)
        assign_table(self._settings, trace_table(launcher, config.trace))

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def of_frame(
        self, scene: DeviceScene, frame: TracedFrame, by_color: FloatArray, gradient: PixelGradient, *, pose: bool
    ) -> SplatGradients:
        """Returns the gradients with respect to the inputs of a frame.

        Args:
            scene: The scene on the device, as it was drawn.
            frame: The frame.
            by_color: Gradients with respect to the colour of the frame, shape (H, W, 3).
            gradient: Gradients with respect to colour and alpha of the frame, on the device.
            pose: Whether to differentiate with respect to the camera pose, too.
        """
        pixels = PixelBuffers.of(self._buffers, scene.image_size).data
        sums = self.begin(scene)
        by_rays = self.start_pixels(scene.image_size, frame.hits.count, pixels, gradient)
        self.add(scene, frame.hits, by_rays, sums)
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
        self,
        scene: DeviceScene,
        tracer: RayTracer,
        rays: tuple[FloatArray, FloatArray],
        results: RayHits,
        given: UpstreamGradient,
    ) -> RayGradients:
        """Returns the gradients with respect to the Gaussians that a caller's N rays hit.

        Args:
            scene: The scene on the device, as it was traced.
            tracer: Finds the hits of the rays once more.
            rays: Local origins and unit directions of the rays, shape (N, 3) each.
            results: Radiance and transmittance of the rays.
            given: Gradients with respect to radiance and transmittance of the rays.
        """
        behind = (given.radiance * results.radiance).sum(axis=1) + given.transmittance * results.transmittance
        sums = self.begin(scene)
        scene.begin_sample(0)
        for first, batch in batches(*rays, np.full(len(behind), np.inf, np.float32)):
            count = len(batch[0])
            on_device = self._given.allocate(count)
            self._given.load(scene, first, count, self._given.upload(batch), on_device)
            hits = tracer.find_hits(scene, on_device, "rays")
            rows = slice(first, first + count)
            by_rays = self.start_rays(hits.count, given.radiance[rows], behind[rows])
            self.add(scene, hits, by_rays, sums)
        return RayGradients(tuple(map(set_gradient, sums.gaussians)), host_values(sums.weights))

    def start_pixels(
        self, size: tuple[int, int], count: int, pixels: PixelData, gradient: PixelGradient
    ) -> RayGradient:
        """Converts gradients at pixels to gradients at a camera's rays.

        Args:
            size: Width and height of the image, pixels.
            count: Number of rays.
            pixels: Colours and alphas of the pixels.
            gradient: Gradients with respect to the colours and alphas of the pixels.
        """
        out = self._buffers.struct("backward.rays", RayGradient, count)
        self._launcher.run_banded(kernels.start_pixels, count, *size, pixels, gradient, out)
        return out

    def start_rays(self, count: int, color: FloatArray, behind: FloatArray) -> RayGradient:
        """Uploads gradients at N rays of a caller, padded to ``count`` rays.

        Args:
            count: Number of rays on the device; rays beyond the caller's get gradients of 0.
            color: Gradients with respect to the colours of the rays, shape (N, 3).
            behind: For each ray, dL/dradiance . radiance + dL/dtransmittance * transmittance, shape (N,).
        """
        out = self._buffers.struct("backward.rays", RayGradient, count)
        missing = count - len(color)
        device_array(out.color).assign(np.pad(color, ((0, missing), (0, 0))))
        device_array(out.behind).assign(np.pad(behind, (0, missing)))
        return out

    def begin(self, scene: DeviceScene) -> RaySums:
        """Returns gradients of all Gaussians of a scene, initialised to 0."""
        get, count = self._buffers.get, scene.gaussian_count
        sums = RaySums(
            [gradient_of_asset(self._buffers, asset, number) for number, asset in enumerate(scene.assets)],
            get("backward.weights", wp.float32, count),
            get("backward.largest", wp.float32, count),
            get("backward.motions", RayMotion, count),
        )
        for array in (sums.weights, sums.largest, sums.motions):
            array.zero_()
        for out in sums.gaussians:
            for array in (out.means, out.rotations, out.scales, out.opacities, out.sh):
                device_array(array).zero_()
        return sums

    def add(self, scene: DeviceScene, hits: PrimaryHits, gradient: RayGradient, sums: RaySums) -> None:
        """Adds the gradients of the Gaussians that rays hit, in batches that fit into device memory.

        Args:
            scene: The scene on the device, as it was traced.
            hits: The rays and their hits.
            gradient: Gradients at the rays.
            sums: Receives the gradients.
        """
        counts = device_array(hits.gaussians.hits)
        for begin, end, found in packet_ranges(counts.numpy(), BACKWARD_HITS):
            rows = slice(begin, end)
            part = _Rays(
                _rows_of(RayData, hits.rays, rows),
                device_array(hits.meshes.t)[rows],
                _rows_of(RayGradient, gradient, rows),
                counts[rows],
                found,
            )
            self._add(scene, part, sums)

    def _add(self, scene: DeviceScene, part: _Rays, sums: RaySums) -> None:
        """Adds the gradients of the Gaussians that one batch of rays hit."""
        run, stage, found = self._launcher.run_banded, self._launcher.stage, part.found
        bands = RAY_BANDS_PER_THREAD * self._launcher.threads
        with stage("backward: hits"):
            profiles = self._profiles(scene, part)
        capacity = grown_capacity(found)
        rows = self._buffers.struct("backward.hits", HitGradients, capacity)
        keys, order = (self._buffers.get(f"backward.{name}", wp.int32, 2 * capacity) for name in ("keys", "order"))
        bvh = scene.bvh.data(scene.splat_instances)
        with stage("backward: rays"):
            inputs = (self._settings, bvh, part.rays, part.gradient, part.counts, profiles, rows, keys, order)
            run(kernels.replay_rays, len(part.counts), *inputs, bands=bands)
        with stage("backward: sort"):
            sort_pairs(keys, order, found, bits=max(scene.gaussian_count.bit_length(), 1))
            begins, ends = (
                self._buffers.get(f"backward.{name}", wp.int32, scene.gaussian_count) for name in ("begins", "ends")
            )
            begins.zero_()
            ends.zero_()
            run(kernels.find_runs, found, found, keys, begins, ends)
        with stage("backward: Gaussians"):
            for asset, out in zip(scene.assets, sums.gaussians, strict=True):
                shared_inputs = (self._settings, scene.splat_instances, asset.instance_ids, asset.data)
                run(
                    kernels.gather_gaussians,
                    asset.gaussians.count,
                    *(
                        *shared_inputs,
                        part.rays,
                        part.gradient,
                        rows,
                        order,
                        begins,
                        ends,
                        sums.weights,
                        sums.largest,
                        sums.motions,
                        out,
                    ),
                    bands=bands,
                )

    def _profiles(self, scene: DeviceScene, part: _Rays) -> HitProfiles:
        """Traces the rays of a batch once more, and lists their hits one by one."""
        profiles = self._buffers.struct("backward.profiles", HitProfiles, grown_capacity(part.found), ("first",))
        first = self._buffers.get("backward.first", wp.int32, len(part.counts) + 1)
        first[:1].zero_()
        prefix_sum(part.counts, first[1:], inclusive=True)
        profiles.first = first
        table: DeviceArray = self._buffers.table("backward.profile_table", HitProfiles, [profiles])
        self._tracer.find(scene, part.rays, part.limits, "backward.gaussians", bounced=False, profiles=table)
        return profiles


def _rows_of(struct_type: type[Struct], arrays: Struct, rows: slice) -> Struct:
    """Returns a struct whose arrays are the given slice of each array of another struct."""
    struct: Any = struct_type
    view = struct_type()
    for name, _ in struct.vars.items():
        setattr(view, name, getattr(arrays, name)[rows])
    return view


def check_traced(scene: Scene) -> None:
    """Refuses scenes with meshes that reflect, refract or blend: the backward pass does not follow rays past meshes.

    Raises:
        ConfigError: The material of a mesh reflects, refracts or blends.
    """
    for instance in scene.meshes:
        if instance.mesh.material.sends_rays_on:
            raise ConfigError(
                "mirrors, glass and blended meshes have no gradients: use rough, opaque materials for all meshes"
            )
