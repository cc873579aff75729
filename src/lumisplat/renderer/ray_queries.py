"""Any rays through a scene: their radiance and hits, and their transmittance."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import Pipeline, RenderConfig, ShadowConfig, TraceStrategy
from lumisplat.constants import PACKET_RAYS
from lumisplat.device.structs.film import FilmData
from lumisplat.device.structs.rays import RayData
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.integrators.integrators import Integrators
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.renderer.trace.ray_tracer import RayTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray, grown_capacity, rows_of
from lumisplat.runtime.launcher import Launcher

RAY_BATCH = 2**20
"""Rays of a query that are on the device at once: some 200 MiB."""

_log = logging.getLogger("lumisplat")
_INPUTS = ("origins", "directions", "distances")


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
        exact = ShadowConfig(transmittance_min=config.trace.transmittance_min)
        self._transmittance = ShadowRays(launcher, buffers, replace(config, shadow_rays=exact), "transmit")

    def query(self, scene: DeviceScene, plan: FramePlan, origins: FloatArray, directions: FloatArray) -> RayHits:
        """Radiance and hits of rays; ``directions`` are unit vectors."""
        parts: list[dict[str, npt.NDArray[Any]]] = []
        nonfinite = 0
        distances = np.full(len(origins), np.inf, np.float32)
        for first, batch in _batches(origins, directions, distances):
            images, count = self._query_batch(scene, plan, first, batch)
            parts.append(images)
            nonfinite += count
        if nonfinite:
            _log.warning("%d samples of %d rays were not finite and are black", nonfinite, len(origins))
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
        self, scene: DeviceScene, origins: FloatArray, directions: FloatArray, distances: FloatArray
    ) -> FloatArray:
        """Transmittance up to ``distances``, (N,); 0 if below the lowest one that counts."""
        parts: list[FloatArray] = []
        scene.begin_sample(0, is_last=True)
        for first, batch in _batches(origins, directions, distances):
            count, rays = len(batch[0]), self._rays(len(batch[0]))
            self._load(scene, first, count, self._upload(batch), rays)
            opaque = self._buffers.get("rays.opaque", wp.bool, len(rays.t_max))
            opaque.fill_(True)
            light = self._transmittance.trace(scene, rays, None, "rays.transmittance", opaque=opaque)
            parts.append(light.numpy()[:count, 0].copy())
        return np.concatenate(parts)

    def _query_batch(
        self, scene: DeviceScene, plan: FramePlan, first: int, batch: list[FloatArray]
    ) -> tuple[dict[str, npt.NDArray[Any]], int]:
        """Images of one row of rays, and how many samples were not finite."""
        # Given rays are not jittered: without random numbers, all samples are equal.
        is_random = plan.is_lit or self._config.trace.strategy is not TraceStrategy.SORTED
        samples = plan.samples if is_random else 1
        count, rays = len(batch[0]), self._rays(len(batch[0]))
        inputs = self._upload(batch)
        pixels = PixelBuffers.of(self._buffers, (len(rays.t_max), 1))
        nonfinite = self._buffers.get("rays.nonfinite", wp.int32, len(rays.t_max))
        nonfinite.zero_()
        row = FilmData()
        row.pixels, row.nonfinite = pixels.data, nonfinite
        film = self._buffers.upload("rays.film", FilmData, rows_of([row]))
        for sample in range(samples):
            scene.begin_sample(sample, is_last=sample == samples - 1)
            self._load(scene, first, count, inputs, rays)
            hits = self._tracer.find_hits(scene, rays, "rays")
            wave = self._integrators.of(plan).shade(scene, plan, hits, sample)
            if plan.is_lit:
                self._launcher.run_banded(film_kernels.merge_captured, wave.count, wave.data)
            self._launcher.run_banded(film_kernels.add_samples, wave.count, scene.shading, wave.data, film)
        images = {name: image[0, :count] for name, image in pixels.download().items()}
        return images, int(nonfinite.numpy()[:count].sum())

    def _rays(self, count: int) -> RayData:
        # A few array sizes instead of one per call.
        return self._buffers.struct("rays.rays", RayData, whole_packets(grown_capacity(count)))

    def _upload(self, batch: list[FloatArray]) -> list[DeviceArray]:
        arrays: list[DeviceArray] = []
        for name, dtype, values in zip(_INPUTS, (wp.vec3, wp.vec3, wp.float32), batch, strict=True):
            array = self._buffers.get(f"rays.{name}", dtype, grown_capacity(len(values)))
            if len(values):
                array[: len(values)].assign(values)
            arrays.append(array)
        return arrays

    def _load(self, scene: DeviceScene, first: int, count: int, inputs: list[DeviceArray], rays: RayData) -> None:
        self._launcher.run_banded(
            camera_ray_kernels.load_rays, len(rays.t_max), first, count, scene.sample, *inputs, rays
        )


def _batches(*arrays: FloatArray) -> Iterator[tuple[int, list[FloatArray]]]:
    """Consecutive rows of all arrays, and the index of the first."""
    for first in range(0, max(len(arrays[0]), 1), RAY_BATCH):
        yield first, [array[first : first + RAY_BATCH] for array in arrays]


def whole_packets(count: int) -> int:
    """The next multiple of a packet's rays."""
    return -(-count // PACKET_RAYS) * PACKET_RAYS


def checked_rays(origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Origins and unit directions, float32, shape (N, 3) each; one origin, shape (3,), is that of all.

    Raises:
        SceneError: A shape does not fit, an origin is not finite, or a direction is not finite or has no length.
    """
    start, along = _numbers("origins", origins), _rows("directions", directions)
    start = np.broadcast_to(start, along.shape) if start.shape == (3,) else _rows("origins", start)
    if start.shape != along.shape:
        raise SceneError(f"{len(start)} origins and {len(along)} directions: a ray has one of each")
    limit = float(np.finfo(np.float32).max)
    for name, values, largest in (("origins", start, limit), ("directions", along, np.inf)):
        bad = int(np.count_nonzero(~(np.isfinite(values) & (np.abs(values) <= largest)).all(axis=1)))
        if bad:
            raise SceneError(f"{bad} of {len(values)} ray {name} are not finite: leave these rays out")
    # In two steps, as the squares of large and small components overflow and underflow.
    largest = np.abs(along).max(axis=1, keepdims=True, initial=0.0)
    empty = int(np.count_nonzero(largest == 0.0))
    if empty:
        raise SceneError(f"{empty} of {len(along)} ray directions have no length: leave these rays out")
    along = along / largest
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return start.astype(np.float32), along.astype(np.float32)


def checked_distances(distances: npt.ArrayLike, count: int) -> FloatArray:
    """One distance a ray, float32, shape (N,).

    Raises:
        SceneError: They are not one number or one a ray, or some are NaN or negative.
    """
    values = _numbers("max_distance", distances)
    if values.shape not in ((), (count,)):
        raise SceneError(f"max_distance has shape {values.shape}, expected one number or ({count},), one a ray")
    bad = int(np.count_nonzero(~(values >= 0.0)))
    if bad:
        raise SceneError(f"{bad} of {values.size} values of max_distance are negative or NaN")
    return np.broadcast_to(values, (count,)).astype(np.float32)


def _rows(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    rows = _numbers(name, values)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise SceneError(f"ray {name} have shape {rows.shape}, expected (N, 3)")
    return rows


def _numbers(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        if np.iscomplexobj(values):
            raise TypeError
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise SceneError(f"{name} are not numbers: {type(values).__name__}") from None


def tracing(config: RenderConfig | None) -> RenderConfig:
    """The settings with a pipeline of rays: that of paths, or the ray tracer."""
    config = config or RenderConfig()
    return config if config.pipeline is Pipeline.PATH else replace(config, pipeline=Pipeline.TRACE)
