"""Any rays through a scene: their radiance and hits, and their transmittance."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import Pipeline, RenderConfig, ShadowConfig, TraceStrategy
from lumisplat.device.structs.camera import FilmData
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers, pixel_sums
from lumisplat.renderer.given_rays import GivenRays, batches
from lumisplat.renderer.integrators.integrators import Integrators
from lumisplat.renderer.ray_profiles import RayProfile
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import ON_ALL, FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers, rows_of
from lumisplat.runtime.launcher import KernelModule, Launcher

_log = logging.getLogger("lumisplat")


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """Radiance and hits of N rays."""

    radiance: FloatArray
    """Of all that the ray hits, in ``color_space``, without a background or an environment behind it, (N, 3)."""
    transmittance: FloatArray
    """Share of a background behind the ray, 0..1, (N,); 0 if the ray hits a mesh, also one of clear glass: what is seen
    through it is in ``radiance``."""
    depth: FloatArray
    """Distance to the iso-opacity surface, scene units, (N,); inf: there is none."""
    normal: FloatArray
    """World space, unit, against the ray, (N, 3); zero: nothing is hit."""
    gaussian_index: IntArray
    """Gaussian at the surface, within its own instance, (N,); -1: none."""
    instance_index: IntArray
    """Instance at the surface, (N,): splat instances in scene order, then mesh instances; -1: none."""
    color_space: str = "srgb"
    """Of the radiance: ``srgb``, display-referred, or ``linear`` if it is lit."""
    profile: RayProfile | None = None
    """The Gaussians on the rays one by one; None: they were not asked for."""

    def __repr__(self) -> str:
        depths = self.depth[np.isfinite(self.depth)]
        between = f", depth={depths.min():.4g}..{depths.max():.4g}" if depths.size else ""
        return f"RayHits(rays={len(self)}, hits={depths.size}{between}, color_space={self.color_space!r})"

    def __len__(self) -> int:
        return len(self.depth)


class RayQueries:
    """Traces rays in batches, so that memory does not grow with their number.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of the rays.
        integrators: Compute their radiance.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        config: RenderConfig,
        tracer: RayTracer,
        integrators: Integrators,
    ) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._tracer, self._integrators = tracer, integrators
        self._rays = GivenRays(launcher, buffers)
        exact = ShadowConfig(transmittance_min=config.trace.transmittance_min)
        self._transmittance = ShadowRays(launcher, buffers, replace(config, shadow_rays=exact), "transmit")

    def transmittance_modules(self) -> list[KernelModule]:
        """The kernel modules of `transmittance`, but for hierarchies."""
        return [*self._transmittance.modules(ON_ALL, has_meshes=True), *self._rays.modules()]

    def query(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        origins: FloatArray,
        directions: FloatArray,
        offsets: FloatArray | None = None,
        *,
        ends: FloatArray | None = None,
    ) -> RayHits:
        """Radiance and hits of rays; ``directions`` are unit vectors.

        Args:
            scene: Up to date for rays.
            plan: Of the scene.
            origins: Shape (N, 3).
            directions: Likewise.
            offsets: Of rays that leave Gaussians: distances within which those as large do not count, as of shadow
                rays, shape (N,); None: all Gaussians count.
            ends: Distances beyond which nothing is seen, shape (N,); None: all is.
        """
        parts: list[dict[str, npt.NDArray[Any]]] = []
        nonfinite = 0
        starts, bounced = _starts(origins, offsets), offsets is not None
        far = np.full(len(origins), np.inf, np.float32) if ends is None else ends
        for first, batch in batches(origins, directions, far, starts):
            images, count = self._query_batch(scene, plan, first, batch, bounced=bounced)
            parts.append(images)
            nonfinite += count
        if nonfinite:
            _log.warning(
                "%d samples of %d rays were not finite and are black: colours, lights or positions are too large",
                nonfinite,
                len(origins),
            )
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return RayHits(
            radiance=joined["color"],
            transmittance=np.float32(1.0) - joined["alpha"],
            depth=joined["depth"],
            normal=joined["normal"],
            gaussian_index=joined["gaussian"],
            instance_index=joined["instance"],
            color_space="linear" if plan.is_lit else "srgb",
        )

    def transmittance(
        self,
        scene: DeviceScene,
        origins: FloatArray,
        directions: FloatArray,
        distances: FloatArray,
        offsets: FloatArray | None = None,
    ) -> FloatArray:
        """Transmittance up to ``distances``, (N,); 0 if below the lowest one that counts. ``offsets`` as of `query`."""
        parts: list[FloatArray] = []
        scene.begin_sample(0)
        for first, batch in batches(origins, directions, distances, _starts(origins, offsets)):
            count, rays = len(batch[0]), self._rays.allocate(len(batch[0]))
            self._rays.load(scene, first, count, self._rays.upload(batch), rays)
            opaque = self._buffers.get("rays.opaque", wp.bool, len(rays.t_max))
            opaque.fill_(True)
            light = self._transmittance.trace(scene, rays, None, "rays.transmittance", opaque=opaque)
            parts.append(light.numpy()[:count, 0].copy())
        return np.concatenate(parts)

    def _query_batch(
        self, scene: DeviceScene, plan: FramePlan, first: int, batch: list[FloatArray], *, bounced: bool
    ) -> tuple[dict[str, npt.NDArray[Any]], int]:
        """Images of one row of rays, and how many samples were not finite."""
        # Given rays are not jittered: without random numbers, all samples are equal.
        is_random = plan.is_lit or self._config.trace.strategy is not TraceStrategy.SORTED
        samples = plan.samples if is_random else 1
        count, rays = len(batch[0]), self._rays.allocate(len(batch[0]))
        inputs = self._rays.upload(batch)
        pixels = PixelBuffers.of(self._buffers, (len(rays.t_max), 1))
        finite = self._buffers.get("rays.count", wp.int32, len(rays.t_max))
        finite.zero_()
        row = FilmData()
        row.pixels, row.count = pixels.data, finite
        if samples > 1:
            row.sums, sums = pixel_sums(self._buffers, len(rays.t_max), is_lit=False)
            sums.zero_()
        film = self._buffers.upload("rays.film", FilmData, rows_of([row]))
        for sample in range(samples):
            scene.begin_sample(sample)
            self._rays.load(scene, first, count, inputs, rays)
            hits = self._tracer.find_hits(scene, rays, "rays", bounced=bounced)
            wave = self._integrators.of(plan).shade(scene, plan, hits, sample)
            if plan.is_lit:
                self._launcher.run_banded(film_kernels.merge_captured, wave.count, wave.data)
            self._launcher.run_banded(film_kernels.add_samples, wave.count, scene.shading, wave.data, film)
        if samples > 1:
            self._launcher.run_banded(film_kernels.average_samples, len(rays.t_max), film)
        images = {name: image[0, :count] for name, image in pixels.download().items()}
        return images, samples * count - int(finite.numpy()[:count].sum(dtype=np.int64))


def _starts(origins: FloatArray, offsets: FloatArray | None) -> FloatArray:
    """Where Gaussians begin to count, shape (N,)."""
    return np.zeros(len(origins), np.float32) if offsets is None else offsets


def tracing(config: RenderConfig | None) -> RenderConfig:
    """The settings with a pipeline of rays: that of paths, or the ray tracer."""
    config = config or RenderConfig()
    return config if config.pipeline.traces_paths else replace(config, pipeline=Pipeline.TRACE)
