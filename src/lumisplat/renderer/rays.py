"""Ray queries: traces rays of a caller or of a camera's pixels, and lists the Gaussians that rays hit."""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import Pipeline, RenderConfig, ShadowConfig, TraceStrategy
from lumisplat.constants import PACKET_RAYS
from lumisplat.device.structs.camera import FilmData, ListedRays
from lumisplat.device.structs.rays import HitProfiles, RayData
from lumisplat.errors import SceneError
from lumisplat.frame.profile_plot import profile_plot
from lumisplat.math.arrays import Doubles, FloatArray, IntArray, Rows, host_array
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers, pixel_sums
from lumisplat.renderer.integrators.integrators import Integrators
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import ON_ALL, FramePlan
from lumisplat.renderer.shadow.shadow_rays import ShadowRays
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.renderer.trace.camera_rays import CameraRays
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer, packet_ranges
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import MeshTracer, RayTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array, grown_capacity, rows_of
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.scene.scene import Scene

_log = logging.getLogger("lumisplat")

RAY_BATCH = 2**20
"""Largest number of rays of a query that are on the device at once, about 200 MiB."""

_INPUTS = {"origins": wp.vec3, "directions": wp.vec3, "ends": wp.float32, "starts": wp.float32}

PROFILE_ROWS = 2**22
"""Largest number of hits of a ray query that are listed on the device at once, 64 MiB. A single packet of rays may
exceed this number, because its rays must be traced together."""


@dataclass(frozen=True, slots=True, eq=False)
class RayProfile:
    """The Gaussians that rays hit: ray by ray, on each ray in the order in which sorted blending composites them.

    A ray ends after the Gaussian at which the ray's transmittance falls to ``TraceConfig.transmittance_min``, or at the
    first mesh.
    """

    first: Rows
    """Row of each ray's first Gaussian, and at the end the total number of rows, shape (rays + 1,)."""
    t: FloatArray
    """Hit distance of each Gaussian as ``TraceConfig.hit_distance`` defines it, scene units, one per row; ascending on
    a ray."""
    alpha: FloatArray
    """Alpha of each Gaussian, 0..0.99, one per row: the fraction of light from behind that the Gaussian blocks."""
    transmittance: FloatArray
    """Transmittance from just behind each Gaussian to the ray's origin, 0..1, one per row."""
    gaussian_index: IntArray
    """Index of each Gaussian within its instance, one per row."""
    instance_index: IntArray
    """Index of each Gaussian's splat instance, in scene order, one per row."""

    def __repr__(self) -> str:
        return f"RayProfile(rays={len(self)}, hits={len(self.t)})"

    def __len__(self) -> int:
        return len(self.first) - 1

    def rows(self, ray: int) -> slice:
        """Returns the rows of one ray, rays counted from 0: ``profile.alpha[profile.rows(3)]``."""
        return slice(int(self.first[ray]), int(self.first[ray + 1]))


@dataclass(frozen=True, slots=True, eq=False)
class PixelProfile:
    """One ray for each of N camera pixels, with all its hits. Pixels of a distorting lens may have no ray."""

    gaussians: RayProfile
    """Gaussians on the rays, widened by the pixel footprint; pixels without a ray have none."""
    mesh_distance: FloatArray
    """Distance of the nearest mesh on each of N rays, scene units, (N,); inf: no mesh."""
    origins: Doubles
    """World-space origin of each of N rays, (N, 3); undefined for pixels without a ray."""
    directions: FloatArray
    """World-space unit direction of each of N rays, (N, 3); 0 for pixels without a ray."""


@dataclass(frozen=True, slots=True, eq=False)
class RayHits:
    """Radiance and hits of N rays."""

    radiance: FloatArray
    """Radiance of everything that each of N rays hits, in ``color_space``, (N, 3), without a background or environment
    behind the hits."""
    transmittance: FloatArray
    """Weight of a background behind each of N rays, 0..1, (N,). 0 if the ray hits a mesh, even of clear glass:
    ``radiance`` then includes the surfaces visible through the glass."""
    depth: FloatArray
    """Distance of the iso-opacity surface on each of N rays, scene units, (N,); inf: no surface."""
    normal: FloatArray
    """World-space unit normal at the surface of each of N rays, facing the ray's origin, (N, 3); zero: no hit."""
    gaussian_index: IntArray
    """Index of the Gaussian at the surface of each of N rays, counted within the Gaussian's instance, (N,); -1: none.
    """
    instance_index: IntArray
    """Index of the instance at the surface of each of N rays, (N,): splat instances in scene order, then mesh
    instances; -1: none."""
    color_space: str = "srgb"
    """Colour space of ``radiance``: ``srgb`` (display-referred) for unlit queries, ``linear`` for lit queries."""
    profile: RayProfile | None = None
    """List of the Gaussians on the rays; None if it was not requested."""

    def __repr__(self) -> str:
        depths = self.depth[np.isfinite(self.depth)]
        between = f", depth={depths.min():.4g}..{depths.max():.4g}" if depths.size else ""
        return f"RayHits(rays={len(self)}, hits={depths.size}{between}, color_space={self.color_space!r})"

    def __len__(self) -> int:
        return len(self.depth)

    def plot(self, ray: int = 0, *, size: tuple[int, int] = (640, 360)) -> npt.NDArray[np.uint8]:
        """Returns a plot of one ray's Gaussians over distance, sRGB, shape (height, width, 3); needs a ``profile``.

        The blue line is the transmittance, orange stems are alphas, the green line is the surface, at ``depth``.

        Args:
            ray: The ray, counted from 0.
            size: Width and height in pixels, 160 to 8192.

        Raises:
            ConfigError: The size is out of range.
            SceneError: The rays were traced without ``profile=True``.
        """
        if self.profile is None:
            raise SceneError("the hits have no profile to plot: trace_rays(..., profile=True) makes one")
        rows, found = self.profile.rows(ray), self.profile
        return profile_plot(found.t[rows], found.alpha[rows], found.transmittance[rows], float(self.depth[ray]), size)


class RayLoader:
    """Uploads a caller's rays to the device, batch by batch.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the kernel modules that convert a caller's uploaded rays to the tracer's ray arrays."""
        return [camera_ray_kernels]

    def allocate(self, count: int) -> RayData:
        """Returns arrays for ``count`` rays, rounded up to one of a few sizes so that buffers are reused."""
        return self._buffers.struct("rays.rays", RayData, whole_packets(grown_capacity(count)))

    def upload(self, batch: list[FloatArray]) -> list[DeviceArray]:
        """Uploads a batch: origins, directions, end distances, and optional start distances for Gaussians."""
        if len(batch) < len(_INPUTS):
            batch = [*batch, np.zeros(len(batch[0]), np.float32)]
        arrays: list[DeviceArray] = []
        for (name, dtype), values in zip(_INPUTS.items(), batch, strict=True):
            array = self._buffers.get(f"rays.{name}", dtype, grown_capacity(len(values)))
            if len(values):
                array[: len(values)].assign(values)
            arrays.append(array)
        return arrays

    def load(self, scene: DeviceScene, first: int, count: int, inputs: list[DeviceArray], rays: RayData) -> None:
        """Writes ``count`` uploaded rays to the arrays ``rays``, with the random keys of the scene's current sample.

        ``first`` is the index of the batch's first ray among all rays of the query.
        """
        self._launcher.run_banded(
            camera_ray_kernels.load_rays, len(rays.t_max), first, count, scene.sample, *inputs, rays
        )


def batches(*arrays: FloatArray) -> Iterator[tuple[int, list[FloatArray]]]:
    """Splits all arrays into batches of consecutive rows; yields each batch with the index of its first row."""
    for first in range(0, max(len(arrays[0]), 1), RAY_BATCH):
        yield first, [array[first : first + RAY_BATCH] for array in arrays]


def whole_packets(count: int) -> int:
    """Rounds a number of rays up to whole packets (groups of rays that are traced together)."""
    return -(-count // PACKET_RAYS) * PACKET_RAYS


def checked_rays(origins: npt.ArrayLike, directions: npt.ArrayLike) -> tuple[Doubles, FloatArray]:
    """Returns the origins (float64) and unit directions (float32) of N rays, shape (N, 3) each.

    One origin of shape (3,) is used for all rays.

    Raises:
        SceneError: A shape does not fit, an origin is not finite, or a direction is not finite or has no length.
    """
    start, along = _numbers("origins", origins), _rows("directions", directions)
    start = np.broadcast_to(start, along.shape) if start.shape == (3,) else _rows("origins", start)
    if start.shape != along.shape:
        raise SceneError(
            f"{len(start)} origins and {len(along)} directions, expected one origin and one direction for each ray"
        )
    limit = float(np.finfo(np.float32).max)
    for name, values, largest in (("origins", start, limit), ("directions", along, np.inf)):
        bad = int(np.count_nonzero(~(np.isfinite(values) & (np.abs(values) <= largest)).all(axis=1)))
        if bad:
            raise SceneError(f"{bad} of {len(values)} ray {name} are not finite: leave these rays out")
    # Normalised in two steps, since squares of large and small components overflow and underflow.
    largest = np.abs(along).max(axis=1, keepdims=True, initial=0.0)
    empty = int(np.count_nonzero(largest == 0.0))
    if empty:
        raise SceneError(f"{empty} of {len(along)} ray directions have no length: leave these rays out")
    along = along / largest
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return start, along.astype(np.float32)


def checked_distances(distances: npt.ArrayLike, count: int) -> FloatArray:
    """Returns one distance for each of ``count`` rays, float32.

    Raises:
        SceneError: The distances are not one number or one per ray, or some are NaN or negative.
    """
    values = _numbers("max_distance", distances)
    if values.shape not in ((), (count,)):
        raise SceneError(f"max_distance has shape {values.shape}, expected one number or ({count},), one a ray")
    bad = int(np.count_nonzero(~(values >= 0.0)))
    if bad:
        raise SceneError(f"{bad} of {values.size} values of max_distance are negative or NaN, expected numbers >= 0")
    return np.broadcast_to(values, (count,)).astype(np.float32)


def _rows(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    rows = _numbers(name, values)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise SceneError(f"ray {name} have shape {rows.shape}, expected (N, 3)")
    return rows


def _numbers(name: str, values: npt.ArrayLike) -> npt.NDArray[np.float64]:
    try:
        read = host_array(values)
        if np.iscomplexobj(read):
            raise TypeError
        return np.asarray(read, dtype=np.float64)
    except (TypeError, ValueError):
        raise SceneError(
            f"{name} are not numbers (got {type(values).__name__}), expected an array of numbers"
        ) from None


class RayQueries:
    """Computes radiance, hits and transmittance of rays in batches, so that memory does not grow with their number.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
        tracer: Finds the hits of the rays.
        integrators: Compute the radiance of the rays.
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
        self._rays = RayLoader(launcher, buffers)
        exact = ShadowConfig(transmittance_min=config.trace.transmittance_min)
        self._transmittance = ShadowRays(launcher, buffers, replace(config, shadow_rays=exact), "transmit")

    def transmittance_modules(self) -> list[KernelModule]:
        """Returns the kernel modules that `transmittance` needs, except for the modules that build BVHs."""
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
        """Returns the radiance and the hits of N rays.

        Args:
            scene: The device scene, synced for rays.
            plan: Plan of the scene.
            origins: Ray origins, local to the device scene, shape (N, 3).
            directions: Unit ray directions, shape (N, 3).
            offsets: For rays that leave Gaussians: a distance along each ray, shape (N,). Gaussians whose peaks are
                nearer are ignored, so that a surface does not hide itself. For Gaussians smaller than those of the
                surface, the distance is shorter. None: no Gaussian is ignored.
            ends: Distance at which each ray ends, shape (N,); None: rays do not end.
        """
        parts: list[dict[str, npt.NDArray[Any]]] = []
        nonfinite = 0
        starts, bounced = _starts(origins, offsets), offsets is not None
        limits = np.full(len(origins), np.inf, np.float32) if ends is None else ends
        for first, batch in batches(origins, directions, limits, starts):
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
        """Returns the transmittance of N rays up to ``distances``, (N,); 0 where it is below ``transmittance_min``.

        The other arguments are as for `query`.
        """
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
        """Renders one batch of rays; returns its images as one row of pixels, and the number of non-finite samples.

        ``first`` is the index of the batch's first ray in the query; ``bounced``: rays start at surfaces, not at a
        camera.
        """
        # A caller's rays are not jittered: if nothing else is random, all samples are equal.
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
            find = partial(self._tracer.find_hits, scene, rays, "rays", bounced=bounced)
            wave = self._integrators.radiance(scene, plan, sample, find, ("rays", len(rays.t_max), bounced))
            if plan.is_lit:
                self._launcher.run_banded(film_kernels.merge_captured, wave.count, wave.data)
            self._launcher.run_banded(film_kernels.add_samples, wave.count, scene.shading, wave.data, film)
        if samples > 1:
            self._launcher.run_banded(film_kernels.average_samples, len(rays.t_max), film)
        images = {name: image[0, :count] for name, image in pixels.download().items()}
        return images, samples * count - int(finite.numpy()[:count].sum(dtype=np.int64))


def _starts(origins: FloatArray, offsets: FloatArray | None) -> FloatArray:
    """Returns ``offsets``, (N,), or zeros for None: on each of N rays, Gaussians nearer than this are ignored."""
    return np.zeros(len(origins), np.float32) if offsets is None else offsets


def tracing(config: RenderConfig | None) -> RenderConfig:
    """Returns the settings with a ray-traced pipeline: ``PATH`` if the settings have it, else ``TRACE``."""
    config = config or RenderConfig()
    return config if config.pipeline.traces_paths else replace(config, pipeline=Pipeline.TRACE)


class RayProfiles:
    """Lists the Gaussians on rays, always by sorted blending, whatever the strategy of the settings.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        exact = replace(config, trace=replace(config.trace, strategy=TraceStrategy.SORTED))
        self._buffers = buffers
        self._meshes = MeshTracer(launcher, buffers)
        self._gaussians = GaussianTracer(launcher, buffers, exact, "profile")
        self._rays = RayLoader(launcher, buffers)
        self._camera_rays = CameraRays(launcher, buffers)

    def query(self, scene: DeviceScene, user_scene: Scene, origins: FloatArray, directions: FloatArray) -> RayProfile:
        """Returns the profile of N rays, that is, the list of Gaussians on them.

        A first pass counts the hits. A second pass writes the hits of a few rays at a time, so that device memory is
        bounded.

        Args:
            scene: The device scene, synced.
            user_scene: The caller's scene, from which the device scene was synced.
            origins: Ray origins, local to the device scene, (N, 3).
            directions: Unit ray directions, (N, 3).
        """
        found = self._hits(scene, origins, directions)
        counts = np.concatenate([device_array(hits.gaussians.hits).numpy()[:count].copy() for count, hits in found])
        return self._profile_of(
            scene, user_scene, counts, lambda rays: self._loaded_rays(scene, origins[rays], directions[rays])
        )

    def query_pixels(
        self, scene: DeviceScene, user_scene: Scene, ray_indices: IntArray, sample: int, offset: tuple[float, float]
    ) -> PixelProfile:
        """Returns the profile of N rays through camera pixels, with Gaussians widened by the pixel footprint.

        Args:
            scene: As for `query`, with the camera.
            user_scene: As for `query`.
            ray_indices: Index of each ray among the rays of all pixels, (N,).
            sample: Index of the sample, which determines where the rays pass the lens.
            offset: Position within each pixel through which its ray passes, 0..1.
        """
        scene.begin_sample(sample)
        rays = self._pixel_rays(scene, ray_indices, sample, offset)
        found = self._find(scene, rays)
        count = len(ray_indices)
        active, hits = (
            device_array(values).numpy()[:count].copy() for values in (rays.is_active, found.gaussians.hits)
        )
        distance = np.where(device_array(found.meshes.face).numpy() >= 0, device_array(found.meshes.t).numpy(), np.inf)
        mesh_distance = np.where(active, distance[:count], np.inf).astype(np.float32)
        origins, directions = (device_array(ends).numpy()[:count].copy() for ends in (rays.origin, rays.direction))
        origins = origins + scene.frame.origin
        directions[~active] = 0.0
        profile = self._profile_of(
            scene,
            user_scene,
            np.where(active, hits, 0),
            lambda part: self._pixel_rays(scene, ray_indices[part], sample, offset),
        )
        return PixelProfile(profile, mesh_distance, origins, directions)

    def surface_distances(self, scene: DeviceScene, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Returns the distance of the first surface on N rays, defined as a frame's ``depth``, (N,); inf: none."""
        parts: list[FloatArray] = []
        for count, hits in self._hits(scene, origins, directions):
            found = (hits.gaussians.depth, hits.meshes.t)
            depth, mesh = (device_array(distances).numpy()[:count] for distances in found)
            parts.append(np.where(np.isfinite(depth), depth, mesh))
        return np.concatenate(parts)

    def _hits(
        self, scene: DeviceScene, origins: FloatArray, directions: FloatArray
    ) -> Iterator[tuple[int, PrimaryHits]]:
        """Yields each batch's number of rays and their hits; each batch overwrites the arrays of the previous batch."""
        scene.begin_sample(0)
        for first, batch in batches(origins, directions, np.full(len(origins), np.inf, np.float32)):
            rays = self._rays.allocate(len(batch[0]))
            self._rays.load(scene, first, len(batch[0]), self._rays.upload(batch), rays)
            yield len(batch[0]), self._find(scene, rays)

    def _find(self, scene: DeviceScene, rays: RayData, profiles: DeviceArray | None = None) -> PrimaryHits:
        """Returns the hits of rays, and writes the Gaussians that they hit to ``profiles`` if given."""
        meshes = self._meshes.find(scene, rays, "profile.meshes")
        gaussians = self._gaussians.find(scene, rays, meshes.t, "profile.gaussians", bounced=False, profiles=profiles)
        return PrimaryHits(rays, meshes, gaussians)

    def _loaded_rays(self, scene: DeviceScene, origins: FloatArray, directions: FloatArray) -> RayData:
        """Uploads a caller's rays without end, and returns the tracer's arrays of these rays."""
        rays = self._rays.allocate(len(origins))
        inputs = self._rays.upload([origins, directions, np.full(len(origins), np.inf, np.float32)])
        self._rays.load(scene, 0, len(origins), inputs, rays)
        return rays

    def _pixel_rays(
        self, scene: DeviceScene, ray_indices: IntArray, sample: int, offset: tuple[float, float]
    ) -> RayData:
        """Returns the tracer's arrays of rays through camera pixels; arguments as for `query_pixels`."""
        count = whole_packets(grown_capacity(len(ray_indices)))
        listed = self._buffers.struct("profile.listed", ListedRays, count)
        padded = np.full(count, -1, np.int32)
        padded[: len(ray_indices)] = ray_indices
        device_array(listed.ray).assign(padded)
        device_array(listed.sample).fill_(sample)
        device_array(listed.offset).assign(np.full((count, 2), offset, np.float32))
        return self._camera_rays.start(scene, listed)

    def _profile_of(
        self, scene: DeviceScene, user_scene: Scene, counts: IntArray, start: Callable[[slice], RayData]
    ) -> RayProfile:
        """Returns the profile of rays with known numbers of hits, ``counts``; ``start`` makes a slice's rays again."""
        first = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        parts = [
            self._rows(scene, start(slice(begin, end)), first[begin : end + 1] - first[begin])
            for begin, end in profile_ranges(counts)
        ]
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        firsts = np.cumsum([0, *(instance.gaussians.count for instance in user_scene.splats)])
        instances = np.searchsorted(firsts, joined["gaussian"], side="right") - 1
        return RayProfile(
            first=first,
            t=joined["t"],
            alpha=joined["alpha"],
            transmittance=joined["transmittance"],
            gaussian_index=(joined["gaussian"] - firsts[instances]).astype(np.int32),
            instance_index=instances.astype(np.int32),
        )

    def _rows(self, scene: DeviceScene, rays: RayData, first: Rows) -> dict[str, npt.NDArray[Any]]:
        """Returns the listed hits of rays, by field of `HitProfiles`; ``first`` is the row of each ray's first hit."""
        count = int(first[-1])
        profiles = self._buffers.struct("profile.rows", HitProfiles, grown_capacity(count), ("first",))
        profiles.first = self._buffers.get("profile.first", wp.int32, len(rays.t_max) + 1)
        device_array(profiles.first)[: len(first)].assign(first.astype(np.int32))
        table: DeviceArray = self._buffers.table("profile.table", HitProfiles, [profiles])
        self._find(scene, rays, table)
        names = ("t", "alpha", "transmittance", "gaussian")
        return {name: device_array(getattr(profiles, name)).numpy()[:count].copy() for name in names}


def profile_ranges(counts: IntArray) -> Generator[tuple[int, int]]:
    """Yields ranges (first, end) of consecutive rays, each with few enough hits to be listed on the device together.

    At least one range is yielded: an empty range if no ray hits anything.

    Args:
        counts: Number of hits of each ray.
    """
    if not counts.any():
        yield 0, 0
    for first in range(0, len(counts), RAY_BATCH):
        for begin, end, _ in packet_ranges(counts[first : first + RAY_BATCH], PROFILE_ROWS):
            yield first + begin, first + end
