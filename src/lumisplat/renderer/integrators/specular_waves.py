"""Host pass: what rays see, mirrors and glass included.

Rays go out in waves: those that leave the smooth surfaces of one wave are the next. Colours come back the other way,
from the last wave to the first, so that every element is written by one item, whatever the number of threads.

The equations are in docs/method/materials.md#smooth-surfaces.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import warp as wp

from lumisplat.device.structs.rays import GaussianHits, RayData
from lumisplat.device.structs.shading import RayColors
from lumisplat.renderer.integrators import specular_wave_kernels as kernels
from lumisplat.renderer.light import direct_light_kernels
from lumisplat.renderer.raster.binning import grown_capacity
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.trace.mesh_trace import MeshTracer
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher

Trace = Callable[[RayData], GaussianHits]
"""What the Gaussians before their meshes give rays. The arrays may be the same at each call."""


Light = Callable[[RayWave, int, bool], None]
"""Writes the colours of a wave, by its number, and, where it may branch, its branches."""


class SpecularWaves:
    """Follows rays from mesh to mesh.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        mesh_hits: Finds what reflected and refracted rays meet.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, mesh_hits: MeshTracer) -> None:
        self._launcher, self._buffers, self._mesh_hits = launcher, buffers, mesh_hits

    def resolve(
        self,
        scene: DeviceScene,
        met: PrimaryHits,
        *,
        trace: Trace,
        bounces: int,
        light: Light | None = None,
        reflection: Any = None,
        darkens: bool = False,
    ) -> Any:
        """The colour that each ray sees, over the mesh or the background behind the Gaussians.

        Where meshes are smooth, the host looks at how many rays go on: such a frame cannot be captured as a graph.

        Args:
            scene: After ``sync_rays``.
            met: The rays, and what they met. Where there is no ray, the colour is black.
            trace: The same for the rays that go on.
            bounces: How often a ray may go on; beyond, it sees the background.
            light: Lights what rays meet; None: surfaces show their own colour.
            reflection: If lit, receives what reflected and refracted rays bring, linear, beside what ``light`` wrote.
            darkens: If lit, whether there are sets that are only darkened.

        Returns:
            Display-referred colours, or what ``light`` returned for these rays.
        """
        waves = [self._wave(0, met, light)]
        waves[0].path_weights.fill_(1.0)
        while count := self._scatter(scene, waves[-1], len(waves) - 1, light, may_branch=len(waves) <= bounces):
            waves.append(self._next_wave(scene, waves[-1], len(waves), count, trace=trace, light=light))
        nothing = self._buffers.get("bounce.nothing", wp.vec3, 0)
        for near, far in reversed(list(itertools.pairwise(waves))):
            links = (near.branches, near.branch_ends, far.weights, far.colors)
            if light is None:
                self._launcher.run_banded(kernels.gather_branches, near.count, *links, near.colors)
            else:
                kept = nothing if reflection is None or near is not waves[0] else reflection
                self._launcher.run_banded(
                    direct_light_kernels.gather_lit, near.count, darkens, *links, near.colors.light, kept
                )
        return waves[0].colors

    def _scatter(self, scene: DeviceScene, wave: RayWave, number: int, light: Light | None, *, may_branch: bool) -> int:
        """Colours without branches; how many rays go on."""
        may_branch = may_branch and scene.has_smooth_meshes and wave.count > 0
        if light is not None:
            light(wave, number, may_branch)
        else:
            self._launcher.run_banded(
                kernels.scatter_rays,
                wave.count,
                *(may_branch, scene.camera, scene.mesh_instances, scene.placements, scene.mesh_data),
                *(wave.met.rays, wave.met.hits, wave.met.radiance, wave.path_weights, wave.colors, wave.branches),
            )
        if not may_branch:
            return 0
        wp.utils.array_scan(wave.branches, wave.branch_ends, inclusive=True)
        return int(wave.branch_ends[-1:].numpy()[0])

    def _next_wave(
        self, scene: DeviceScene, wave: RayWave, number: int, count: int, *, trace: Trace, light: Light | None
    ) -> RayWave:
        capacity = grown_capacity(count)  # a few sizes of arrays instead of one a frame; what is not used is no ray
        rays = self._buffers.struct(f"bounce.rays{number % 2}", RayData, capacity)
        rays.t_max.fill_(float("-inf"))
        weights = self._buffers.get(f"bounce.{number}.weights", wp.vec3, capacity)
        path_weights = self._buffers.get(f"bounce.path_weights{number % 2}", wp.float32, capacity)
        self._launcher.run_banded(
            kernels.spawn_rays,
            wave.branches.shape[0],
            *(
                light is not None,
                scene.mesh_instances,
                scene.placements,
                scene.mesh_data,
                wave.met.rays,
                wave.met.hits,
                wave.met.radiance,
            ),
            *(wave.path_weights, wave.branches, wave.branch_ends, rays, weights, path_weights),
        )
        hits = self._mesh_hits.find(scene, rays, "bounce.hits")
        return self._wave(number, PrimaryHits(rays, hits, trace(rays)), light)

    def _wave(self, number: int, met: PrimaryHits, light: Light | None) -> RayWave:
        count, get = met.count, self._buffers.get
        colors: Any = (
            get(f"bounce.{number}.colors", wp.vec3, count)
            if light is None
            else self._buffers.struct(f"bounce.{number}.lit", RayColors, count)
        )
        return RayWave(
            met,
            path_weights=get(f"bounce.path_weights{number % 2}", wp.float32, count),
            weights=get(f"bounce.{number}.weights", wp.vec3, count if number else 0),
            colors=colors,
            branches=get(f"bounce.{number}.branches", wp.int32, 2 * count),
            branch_ends=get(f"bounce.{number}.branch_ends", wp.int32, 2 * count),
        )
