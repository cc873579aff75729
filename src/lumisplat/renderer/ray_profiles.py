"""The Gaussians on any rays, one by one, and the first surfaces there."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import RenderConfig, TraceStrategy
from lumisplat.device.structs.camera import ListedRays
from lumisplat.device.structs.rays import HitProfiles, RayData
from lumisplat.math.arrays import Doubles, FloatArray, IntArray, Rows
from lumisplat.renderer.given_rays import RAY_BATCH, GivenRays, batches, whole_packets
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.camera_rays import CameraRays
from lumisplat.renderer.trace.gaussian_trace import GaussianTracer, packet_ranges
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_tracer import MeshTracer
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array, grown_capacity
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.scene import Scene

PROFILE_ROWS = 2**22
"""Hits of a query that are on the device at once: 64 MiB, unless rays that are followed together have more."""


@dataclass(frozen=True, slots=True, eq=False)
class RayProfile:
    """The Gaussians on N rays, M in all: ray by ray, each in the order in which a sorted ray blends them.

    A ray ends behind the Gaussian at which its transmittance falls to ``TraceConfig.transmittance_min``, or before the
    first mesh.
    """

    first: Rows
    """Row of each ray's first Gaussian, and M at the end, (N + 1,)."""
    t: FloatArray
    """Distance at which the ray hits the Gaussian, as ``TraceConfig.hit_distance`` says, scene units, (M,); ascending
    on each ray."""
    alpha: FloatArray
    """Share of the light from behind that the Gaussian blocks, 0..0.99, (M,)."""
    transmittance: FloatArray
    """Share of the light from behind that reaches the ray's origin, 0..1, (M,)."""
    gaussian_index: IntArray
    """The Gaussian, within its own instance, (M,)."""
    instance_index: IntArray
    """Its splat instance, in scene order, (M,)."""

    def __repr__(self) -> str:
        return f"RayProfile(rays={len(self)}, hits={len(self.t)})"

    def __len__(self) -> int:
        return len(self.first) - 1

    def rows(self, ray: int) -> slice:
        """The rows of a ray, from 0: ``profile.alpha[profile.rows(3)]``."""
        return slice(int(self.first[ray]), int(self.first[ray + 1]))


@dataclass(frozen=True, slots=True, eq=False)
class PixelProfile:
    """One ray of each of N pixels of a camera, and all that it meets."""

    gaussians: RayProfile
    """Of Gaussians as wide as the pixels make them; pixels without a ray meet none."""
    mesh_distance: FloatArray
    """Of the nearest mesh, scene units, (N,); inf: there is none."""
    origins: Doubles
    """Where rays start, world space, (N, 3); undefined without a ray."""
    directions: FloatArray
    """Unit vectors, (N, 3); 0 where a pixel has no ray."""


class RayProfiles:
    """Follows rays that blend all Gaussians in order, whatever the strategy of the settings.

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
        self._rays = GivenRays(launcher, buffers)
        self._camera_rays = CameraRays(launcher, buffers)

    def query(self, scene: DeviceScene, asked: Scene, origins: FloatArray, directions: FloatArray) -> RayProfile:
        """The profile of rays; ``directions`` are unit vectors.

        Hits are counted first, and then written by so many rays at a time that the device holds a bounded number.

        Args:
            scene: The scene on the device, synced.
            asked: The same as the caller has it.
            origins: World space, (N, 3).
            directions: Likewise.
        """
        found = self._hits(scene, origins, directions)
        counts = np.concatenate([device_array(hits.gaussians.hits).numpy()[:count].copy() for count, hits in found])
        return self._written(scene, asked, counts, lambda rays: self._given(scene, origins[rays], directions[rays]))

    def query_pixels(
        self, scene: DeviceScene, asked: Scene, places: IntArray, sample: int, offset: tuple[float, float]
    ) -> PixelProfile:
        """Of the rays by which a camera's pixels are sampled, which are as wide as the pixels.

        Args:
            scene: As for `query`, with the camera.
            asked: As for `query`.
            places: Of the rays among those of all pixels, (N,).
            sample: Number of the sample, from which its place on the lens follows.
            offset: Position of the sample in its pixels, 0..1.
        """
        scene.begin_sample(sample)
        rays = self._started(scene, places, sample, offset)
        found = self._find(scene, rays)
        count = len(places)
        active, hits = (
            device_array(values).numpy()[:count].copy() for values in (rays.is_active, found.gaussians.hits)
        )
        distance = np.where(device_array(found.meshes.face).numpy() >= 0, device_array(found.meshes.t).numpy(), np.inf)
        mesh_distance = np.where(active, distance[:count], np.inf).astype(np.float32)
        origins, directions = (device_array(ends).numpy()[:count].copy() for ends in (rays.origin, rays.direction))
        origins = origins + scene.frame.origin
        directions[~active] = 0.0
        profile = self._written(
            scene, asked, np.where(active, hits, 0), lambda part: self._started(scene, places[part], sample, offset)
        )
        return PixelProfile(profile, mesh_distance, origins, directions)

    def surface_distances(self, scene: DeviceScene, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Distance of the first surface on each ray, as the depth of a frame, (N,); inf: there is none."""
        parts: list[FloatArray] = []
        for count, hits in self._hits(scene, origins, directions):
            found = (hits.gaussians.depth, hits.meshes.t)
            depth, mesh = (device_array(distances).numpy()[:count] for distances in found)
            parts.append(np.where(np.isfinite(depth), depth, mesh))
        return np.concatenate(parts)

    def _hits(
        self, scene: DeviceScene, origins: FloatArray, directions: FloatArray
    ) -> Iterator[tuple[int, PrimaryHits]]:
        """What rays hit, batch by batch, and how many they are; the arrays are those of the last batch."""
        scene.begin_sample(0)
        for first, batch in batches(origins, directions, np.full(len(origins), np.inf, np.float32)):
            rays = self._rays.allocate(len(batch[0]))
            self._rays.load(scene, first, len(batch[0]), self._rays.upload(batch), rays)
            yield len(batch[0]), self._find(scene, rays)

    def _find(self, scene: DeviceScene, rays: RayData, profiles: DeviceArray | None = None) -> PrimaryHits:
        """What rays hit; ``profiles`` receives the hits one by one."""
        meshes = self._meshes.find(scene, rays, "profile.meshes")
        gaussians = self._gaussians.find(scene, rays, meshes.t, "profile.gaussians", bounced=False, profiles=profiles)
        return PrimaryHits(rays, meshes, gaussians)

    def _given(self, scene: DeviceScene, origins: FloatArray, directions: FloatArray) -> RayData:
        """Rays of a caller."""
        rays = self._rays.allocate(len(origins))
        inputs = self._rays.upload([origins, directions, np.full(len(origins), np.inf, np.float32)])
        self._rays.load(scene, 0, len(origins), inputs, rays)
        return rays

    def _started(self, scene: DeviceScene, places: IntArray, sample: int, offset: tuple[float, float]) -> RayData:
        """Rays of a camera's pixels, as of `query_pixels`."""
        count = whole_packets(grown_capacity(len(places)))
        listed = self._buffers.struct("profile.listed", ListedRays, count)
        padded = np.full(count, -1, np.int32)
        padded[: len(places)] = places
        device_array(listed.place).assign(padded)
        device_array(listed.sample).fill_(sample)
        device_array(listed.offset).assign(np.full((count, 2), offset, np.float32))
        return self._camera_rays.start(scene, listed)

    def _written(
        self, scene: DeviceScene, asked: Scene, counts: IntArray, start: Callable[[slice], RayData]
    ) -> RayProfile:
        """The profile of rays that have so many hits; ``start`` starts some of them once more."""
        first = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
        parts = [
            self._rows(scene, start(slice(begin, end)), first[begin : end + 1] - first[begin])
            for begin, end in ranges(counts)
        ]
        joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        firsts = np.cumsum([0, *(instance.gaussians.count for instance in asked.splats)])
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
        """The hits of rays whose first rows are known, and how many there are, by the names of `HitProfiles`."""
        count = int(first[-1])
        held = self._buffers.struct("profile.rows", HitProfiles, grown_capacity(count), ("first",))
        held.first = self._buffers.get("profile.first", wp.int32, len(rays.t_max) + 1)
        device_array(held.first)[: len(first)].assign(first.astype(np.int32))
        table: DeviceArray = self._buffers.table("profile.table", HitProfiles, [held])
        self._find(scene, rays, table)
        names = ("t", "alpha", "transmittance", "gaussian")
        return {name: device_array(getattr(held, name)).numpy()[:count].copy() for name in names}


def ranges(counts: IntArray) -> Generator[tuple[int, int]]:
    """Ranges of consecutive rays that together have no more hits than the device is to hold; at least an empty one.

    Args:
        counts: Hits of each ray.
    """
    if not counts.any():
        yield 0, 0
    for first in range(0, len(counts), RAY_BATCH):
        for begin, end, _ in packet_ranges(counts[first : first + RAY_BATCH], PROFILE_ROWS):
            yield first + begin, first + end
