"""Traces rays through Gaussians (Moenne-Loccoz et al. 2024, 3D Gaussian Ray Tracing)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import NormalMethod, RenderConfig, TraceConfig, TraceStrategy
from lumisplat.constants import (
    HIT_BUFFER_CPU,
    HIT_BUFFER_CUDA,
    PACKET_RAYS,
    RAY_BANDS_PER_THREAD,
    TRAVERSE_STACK,
    TRAVERSE_STACK_SMALL,
)
from lumisplat.device.structs.bvh import (
    FAR,
    STRATEGY_HIT,
    STRATEGY_PASS,
    STRATEGY_SORTED,
    CandidateLists,
    SceneBvh,
    TraceData,
)
from lumisplat.device.structs.rays import EXTRA_FIELDS, MEAN_FIELDS, GaussianHits, RayData
from lumisplat.math.arrays import IntArray, Rows
from lumisplat.renderer.scene.bvh_scene import SplatSets
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace import (
    eye_color_kernels,
    gaussian_trace_kernels,
    stochastic_hit_kernels,
    tile_trace_kernels,
)
from lumisplat.renderer.trace.tile_trace_kernels import SETS_ALL, SETS_CAPTURED, SETS_RELIT
from lumisplat.renderer.trees.ray_order import RAY_ORDER_MODULES, ray_order
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table, device_array
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.struct_tables import table_dtype

_STRATEGIES = {
    TraceStrategy.SORTED: STRATEGY_SORTED,
    TraceStrategy.STOCHASTIC_HIT: STRATEGY_HIT,
    TraceStrategy.STOCHASTIC_PASS: STRATEGY_PASS,
}

_SETS = {SplatSets.ALL: SETS_ALL, SplatSets.CAPTURED: SETS_CAPTURED, SplatSets.RELIT: SETS_RELIT}


EYE_COLOR_RAYS_MIN = 0.25
"""Rays from one eye share the colours of Gaussians, evaluated once for all Gaussians of the scene, if there are at
least this many rays per Gaussian. A ray into a capture blends 8 to 15 Gaussians, a ray beside it none."""


@dataclass(frozen=True, slots=True)
class RayLists:
    """The Gaussians that the camera rays of each image tile may hit, in the structs that kernels read."""

    lists: CandidateLists
    scene: SceneBvh
    """Instances, Gaussians and colours of the scene; has no BVH."""
    ray_count: int
    """Number of rays of all tiles, including those outside the image."""


class GaussianTracer:
    """Traces rays through Gaussians.

    Args:
        launcher: Runs the kernel.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
        name: Prefix of the names of the buffers that hold the settings.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, name: str = "trace") -> None:
        self._launcher, self._buffers = launcher, buffers
        self._lanes = 1 if launcher.is_parallel else PACKET_RAYS
        stacks = (TRAVERSE_STACK_SMALL, TRAVERSE_STACK)
        self._kernels = {stack: trace_kernel_of(launcher, stack=stack) for stack in stacks}
        self._tile_kernel = tile_trace_kernels.tile_trace_kernel(self._lanes)
        self._is_stochastic_hit = config.trace.strategy is TraceStrategy.STOCHASTIC_HIT
        self._settings = buffers.get(f"{name}.settings", TraceData, 1)
        table = trace_table(launcher, config.trace)
        assign_table(self._settings, table)
        self._settings_bounced = buffers.get(f"{name}.settings_bounced", TraceData, 1)
        table["offset"] = config.shadow_rays.offset
        table["offset_absolute"] = config.shadow_rays.offset_absolute
        assign_table(self._settings_bounced, table)

    def tile_modules(self) -> list[KernelModule]:
        """Returns the modules of the kernels that trace camera rays through lists of tiles."""
        return [self._tile_kernel.module]

    def modules(self, *, bounced: bool) -> list[KernelModule]:
        """Returns the modules of the kernels that traverse BVHs; ``bounced`` is as in `find`."""
        by_ray = [stochastic_hit_kernels, *RAY_ORDER_MODULES] if bounced and self._is_stochastic_hit else []
        return [self._kernels[TRAVERSE_STACK_SMALL].module, eye_color_kernels, *by_ray]

    def find(
        self,
        scene: DeviceScene,
        rays: RayData,
        limits: wp.array[float],
        name: str,
        *,
        bounced: bool,
        from_eye: bool = False,
        sets: SplatSets = SplatSets.ALL,
        profiles: DeviceArray | None = None,
        marked: DeviceArray | None = None,
        lists: RayLists | None = None,
    ) -> GaussianHits:
        """Returns what each ray hits among Gaussians up to its limit: blended colour, transmittance and surface.

        Args:
            scene: The device scene, synced for rays.
            rays: The rays; their number is a multiple of ``PACKET_RAYS``.
            limits: Distances at which rays end, such as those of the nearest meshes.
            name: Name of the buffers that hold the result.
            bounced: Whether the rays start at surfaces. Each ray then skips the Gaussians of its surface, as shadow
                rays do.
            from_eye: Whether all rays start at the eye of the scene's camera.
            sets: Splat sets that the rays can hit.
            profiles: ``HitProfiles`` that receive every single hit; None: hits are only blended.
            marked: The scene's splat instances with changed relit flags; radiance of flagged instances is accumulated
                separately. None: the scene's instances unchanged.
            lists: Gaussians that the rays, those of all pixels of a camera, may hit by tiles of the image; None: the
                rays traverse the BVHs.
        """
        count = len(rays.t_max)
        settings = self._settings_bounced if bounced else self._settings
        separates_relit = marked is not None or (scene.plan.mixes_sets and sets is SplatSets.ALL)
        hits = self._buffers.struct(name, GaussianHits, count, MEAN_FIELDS if separates_relit else EXTRA_FIELDS)
        if scene.gaussian_count == 0 and profiles is None:
            return without_hits(hits)
        run, bands = self._launcher.run_banded, RAY_BANDS_PER_THREAD * self._launcher.threads
        if lists is not None:
            inputs = _SETS[sets], lists.lists, lists.scene, rays, limits, hits
            run(self._tile_kernel, lists.ray_count // self._lanes, settings, *inputs, bands=bands)
            return hits
        bvh = scene.bvh.data(scene.splat_instances if marked is None else marked, sets)
        if bounced and self._is_stochastic_hit:
            order = ray_order(self._launcher, self._buffers, rays, scene.bvh.extent)
            run(
                stochastic_hit_kernels.find_stochastic_hits,
                count,
                order,
                settings,
                bvh,
                rays,
                limits,
                hits,
                bands=bands,
            )
            return hits
        if from_eye and not self._is_stochastic_hit and count >= EYE_COLOR_RAYS_MIN * scene.gaussian_count:
            names = "trace.eye_colors", "trace.eye_normals"
            shared = [self._buffers.get(name, wp.vec3, scene.gaussian_count) for name in names]
            run(eye_color_kernels.find_eye_colors, scene.gaussian_count, scene.camera, settings, bvh, None, *shared)
            bvh.eye_colors, bvh.eye_normals = shared
        run(
            self._kernels[scene.bvh.stack],
            count // self._lanes,
            *(settings, bvh, rays, limits, hits, profiles),
            bands=bands,
        )
        return hits


def without_hits(hits: GaussianHits) -> GaussianHits:
    """Fills the hits of rays through a scene without Gaussians: no hits, full transmittance."""
    for field in (hits.color, hits.normal, hits.hits):
        device_array(field).zero_()
    device_array(hits.transmittance).fill_(1.0)
    device_array(hits.depth).fill_(math.inf)
    device_array(hits.gaussian).fill_(-1)
    return hits


def trace_kernel_of(launcher: Launcher, *, stack: int = TRAVERSE_STACK_SMALL) -> Any:
    """Returns the tracing kernel for a device, with a stack of at least ``stack`` nodes."""
    if launcher.is_parallel:
        return gaussian_trace_kernels.gaussian_trace_kernel(1, stack)
    return gaussian_trace_kernels.gaussian_trace_kernel(PACKET_RAYS)


def trace_table(launcher: Launcher, config: TraceConfig) -> np.ndarray:
    """Returns the tracer's settings as a table with one row, for kernels."""
    row = table = np.zeros(1, dtype=table_dtype(TraceData))
    is_hit = config.strategy is TraceStrategy.STOCHASTIC_HIT
    hit_buffer_size = HIT_BUFFER_CUDA if launcher.is_parallel else HIT_BUFFER_CPU
    is_sorted = config.strategy is TraceStrategy.SORTED
    row["strategy"] = _STRATEGIES[config.strategy]
    row["hits_per_pass"] = config.hits_per_pass
    row["hit_buffer_size"] = 1 if is_hit else hit_buffer_size
    row["ellipsoid_normal"] = config.normal_method is NormalMethod.ELLIPSOID
    # Ending early would bias a stochastic ray: it ends at a transmittance of 0 only.
    row["transmittance_min"] = config.transmittance_min if is_sorted else 0.0
    # A stochastic hit is a surface, whatever the threshold.
    row["depth_iso_transmittance"] = 0.5 if is_hit else config.depth_iso_transmittance
    row["acceptance_scale"] = config.acceptance_scale
    row["sh_degree"] = config.sh_degree
    row["offset"] = FAR
    return table


def packet_ranges(counts: IntArray, most: int) -> Iterator[tuple[int, int, int]]:
    """Yields ranges of rays and the number of hits in each range.

    A range has at most ``most`` hits, unless the smallest possible range has more. Ranges consist of whole packets on
    CPUs and whole warps on CUDA, so that rays traced together stay together.

    Args:
        counts: Number of hits of each ray.
        most: Largest number of hits of a range.
    """
    edges = np.append(np.arange(0, len(counts), 2 * PACKET_RAYS), len(counts))
    before: Rows = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])[edges]
    begin, parts = 0, len(edges) - 1
    while begin < parts:
        end = max(int(np.searchsorted(before, int(before[begin]) + most, side="right")) - 1, begin + 1)
        found = int(before[end] - before[begin])
        if found:
            yield int(edges[begin]), int(edges[end]), found
        begin = end
