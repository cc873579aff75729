"""Traces shadow rays for their transmittance through Gaussians and meshes (docs/method/shadows.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import HitDistance, RenderConfig, ShadowMethod
from lumisplat.constants import PACKET_RAYS, RAY_BANDS_PER_THREAD, TILE_BANDS_PER_THREAD, TRAVERSE_STACK_SMALL
from lumisplat.device.structs.bvh import (
    DRAWS_NONE,
    DRAWS_PER_RAY,
    DRAWS_SHARED,
    HIT_HULL,
    HIT_PEAK,
    AssetBvh,
    Node,
    ShadowData,
)
from lumisplat.device.structs.rays import RayData
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import ON_ALL, SplatShadows
from lumisplat.renderer.shadow import gaussian_shadow_kernels, mesh_shadow_kernels, stochastic_bvh_kernels
from lumisplat.renderer.trees.ray_order import RAY_ORDER_MODULES, ray_order
from lumisplat.runtime.buffers import Buffers, DeviceArray, assign_table
from lumisplat.runtime.launcher import KernelModule, Launcher
from lumisplat.runtime.struct_tables import table_dtype

SHRINK_RAYS_PER_GAUSSIAN = 2.0
"""The BVHs of a stochastic sample are shrunk to the parts of Gaussians that block light if the sample has more shadow
rays per Gaussian than this, counting inactive rays. In a capture that is all surface, shrinking pays off from one ray
per Gaussian on; if rays cross many Gaussians, it pays off far earlier."""

SHRINK_INSTANCES_MAX = 8
"""The BVH of an asset is shrunk only if the asset has at most this many instances, because the shrunk BVH must be
valid for all of them.
"""


class ShadowRays:
    """Traces shadow rays from points to lights.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings, which stay the same for the lifetime of the object.
        name: Name of the buffers.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig, name: str = "shadow") -> None:
        self._launcher, self._buffers, self._name = launcher, buffers, name
        self._lanes = 1 if launcher.is_parallel else PACKET_RAYS
        self._config = config
        self._draws = draws_of(config)
        self._stochastic_bvh = StochasticBvh(launcher, buffers, name)
        self._table = shadow_table(config)
        self._settings = buffers.get(f"{name}.settings", ShadowData, 1)
        assign_table(self._settings, self._table)

    def modules(self, splat_shadows: SplatShadows, *, has_meshes: bool, incoherent: bool = False) -> list[KernelModule]:
        """Returns the kernel modules of shadow rays; arguments are as for `trace`."""
        modules: list[KernelModule] = [mesh_shadow_kernels] if has_meshes else []
        if not splat_shadows.exist:
            return modules
        if self._draws == DRAWS_SHARED:
            modules += [stochastic_bvh_kernels]
        if self._traces_one_by_one(incoherent=incoherent):
            return [gaussian_shadow_kernels, *RAY_ORDER_MODULES, *modules]
        return [shadow_kernel_of(self._launcher, self._config).module, *modules]

    def begin_sample(self, sample: int) -> None:
        """Begins a sample: stochastic shadows draw new random numbers for each sample."""
        if self._draws != DRAWS_NONE:
            self._table["sample"] = sample
            assign_table(self._settings, self._table)
            self._stochastic_bvh.begin_sample()

    def trace(
        self,
        scene: DeviceScene,
        rays: RayData,
        skips: wp.array[wp.bool] | None,
        name: str,
        *,
        opaque: wp.array[wp.bool] | None = None,
        media: wp.array[wp.vec4i] | None = None,
        splat_shadows: SplatShadows = ON_ALL,
        incoherent: bool = False,
    ) -> DeviceArray:
        """Returns the transmittance of each ray up to ``t_max``: linear, per channel, 0..1, as wp.vec3.

        Args:
            scene: The scene, prepared for rays.
            rays: Rays from the points to the lights, a multiple of ``PACKET_RAYS``. Meshes block from the origin on,
                Gaussians from ``t_min`` on. ``t_max`` is the light's distance, inf for a light at infinity. The result
                of inactive rays is undefined.
            skips: Whether each ray passes through shadow catchers. None: no ray does.
            name: Name of the buffer that holds the result.
            opaque: Whether glass blocks each ray. None: glass blocks no ray.
            media: Media around the origins, wp.vec4i encoded as in ``Boundary``. None: all origins are in air.
            incoherent: Whether rays have unrelated origins and directions, and are therefore traced one by one through
                Gaussians.
            splat_shadows: Which surfaces Gaussians may cast shadows on. If none, the scene needs no BVHs of Gaussians.
        """
        count, run = len(rays.t_max), self._launcher.run_banded
        light = self._buffers.get(name, wp.vec3, count)
        if skips is None:
            skips = self._buffers.get(f"{self._name}.skips", wp.bool, count)
            skips.zero_()
        limits = self._past_meshes(scene, rays, skips, light, opaque=opaque, media=media, splat_shadows=splat_shadows)
        if not splat_shadows.exist:
            return light
        bvh = scene.bvh.data(scene.splat_instances)
        if self._draws == DRAWS_SHARED and (
            assets := self._stochastic_bvh.assets(scene, self._settings, ray_count=count)
        ):
            bvh.assets = assets
        bands = RAY_BANDS_PER_THREAD * self._launcher.threads
        if self._traces_one_by_one(incoherent=incoherent):
            order = ray_order(self._launcher, self._buffers, rays, scene.bvh.extent)
            kernel = gaussian_shadow_kernels.shadow_ray_by_ray
            run(kernel, count, *(order, self._settings, bvh, rays, limits, skips, light), bands=bands)
            return light
        kernel = shadow_kernel_of(self._launcher, self._config, stack=scene.bvh.stack)
        run(kernel, count // self._lanes, *(self._settings, bvh, rays, limits, skips, light), bands=bands)
        return light

    def _traces_one_by_one(self, *, incoherent: bool) -> bool:
        """Returns whether rays are traced through Gaussians one by one instead of in packets."""
        return incoherent and self._config.shadow_rays.method is not ShadowMethod.FIRST_HITS

    def _past_meshes(
        self,
        scene: DeviceScene,
        rays: RayData,
        skips: wp.array[wp.bool],
        light: DeviceArray,
        *,
        opaque: wp.array[wp.bool] | None,
        media: wp.array[wp.vec4i] | None,
        splat_shadows: SplatShadows,
    ) -> wp.array[Any]:
        """Writes the transmittance of meshes to ``light``; returns how far along each ray Gaussians may block light."""
        count = len(rays.t_max)
        if scene.mesh_instances.shape[0] == 0:
            light.fill_(1.0)
            return rays.t_max
        limits = self._buffers.get(f"{self._name}.limits", wp.float32, count)
        meshes_only = not splat_shadows.on_shadow_catchers
        shadows = mesh_shadow_kernels.MeshShadows()
        shadows.skips, shadows.light, shadows.limits = skips, light, limits
        if opaque is not None:
            shadows.opaque = opaque
        if media is not None:
            shadows.media = media
        self._launcher.run_banded(
            mesh_shadow_kernels.shadow_by_meshes,
            -(-count // self._lanes),
            *(self._lanes, meshes_only, scene.mesh_bvh, rays, shadows),
            bands=TILE_BANDS_PER_THREAD * self._launcher.threads,
        )
        return limits


def shadow_kernel_of(launcher: Launcher, config: RenderConfig, *, stack: int = TRAVERSE_STACK_SMALL) -> Any:
    """Returns a device's kernel of coherent shadow rays through Gaussians, with stacks of at least ``stack`` nodes."""
    kernel_of = gaussian_shadow_kernels.shadow_kernel
    if config.shadow_rays.method is ShadowMethod.FIRST_HITS:
        kernel_of = gaussian_shadow_kernels.first_hits_shadow_kernel
    return kernel_of(1, stack) if launcher.is_parallel else kernel_of(PACKET_RAYS)


def draws_of(config: RenderConfig) -> int:
    """Returns which random numbers shadows use: DRAWS_NONE (none), DRAWS_PER_RAY, or DRAWS_SHARED by all rays."""
    if config.shadow_rays.method is not ShadowMethod.STOCHASTIC:
        return DRAWS_NONE
    return DRAWS_SHARED if config.shadow_rays.shared_draws else DRAWS_PER_RAY


def shadow_table(config: RenderConfig) -> np.ndarray:
    """Returns the settings of shadow rays as a table with one row, for kernels."""
    row = table = np.zeros(1, dtype=table_dtype(ShadowData))
    row["draws"] = draws_of(config)
    row["acceptance_scale"] = config.shadow_rays.acceptance_scale
    is_first = config.shadow_rays.method is ShadowMethod.FIRST_HITS
    row["hits"] = config.shadow_rays.hits
    row["hit_distance"] = HIT_HULL if is_first and config.shadow_rays.hit_distance is HitDistance.HULL else HIT_PEAK
    row["transmittance_min"] = config.shadow_rays.transmittance_min
    row["threshold"] = config.shadow_rays.transmittance_threshold
    row["color_strength"] = config.shadow_rays.color_strength
    row["offset"] = config.shadow_rays.offset
    row["offset_absolute"] = config.shadow_rays.offset_absolute
    row["seed"] = config.seed
    return table


class StochasticBvh:
    """BVHs that are shrunk for one stochastic sample of shadows; its rays share one random number per Gaussian.

    In such a sample, each Gaussian is either absent or an opaque ellipsoid. The ellipsoid ends where alpha falls below
    the Gaussian's random number, mostly far inside the Gaussian's hull, so only a fraction of the rays hit its shrunk
    box. Shrinking only saves time: hits are decided by the random numbers.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, name: str) -> None:
        self._launcher, self._buffers, self._name = launcher, buffers, name
        self._whole: DeviceArray | None = None
        """Table of the assets with their original BVHs, before shrinking; None: nothing was shrunk yet."""
        self._assets: DeviceArray | None = None
        self._is_fresh = False
        self._rays = 0
        """Number of shadow rays traced in the current sample so far."""

    def begin_sample(self) -> None:
        """Begins another sample: BVHs shrunk for the previous sample are no longer used."""
        self._is_fresh, self._rays = False, 0

    def assets(self, scene: DeviceScene, settings: DeviceArray, *, ray_count: int) -> DeviceArray | None:
        """Returns the assets to trace in the current sample; their BVHs are shrunk once enough rays are traced."""
        original = scene.bvh.assets
        if original is self._whole and self._is_fresh:
            return self._assets
        self._rays += ray_count
        if self._rays < SHRINK_RAYS_PER_GAUSSIAN * scene.gaussian_count:
            return original
        nodes = self._shrunk_nodes(scene, settings)
        self._assets, self._whole, self._is_fresh = self._upload(scene, nodes), original, True
        return self._assets

    def _shrunk_nodes(self, scene: DeviceScene, settings: DeviceArray) -> list[DeviceArray]:
        nodes: list[DeviceArray] = []
        for number, (asset, cached) in enumerate(zip(scene.assets, scene.bvh.cached, strict=True)):
            bvh = cached.bvh
            if asset.instance_ids.shape[0] > SHRINK_INSTANCES_MAX:
                nodes.append(bvh.nodes)
                continue
            nodes.append(self._buffers.get(f"{self._name}.nodes{number}", Node, bvh.nodes.shape[0]))
            for first, count in reversed(bvh.levels):
                self._launcher.run_banded(
                    stochastic_bvh_kernels.shrink_nodes,
                    count,
                    *(first, settings, asset.instance_ids, scene.splat_instances, bvh.particles, bvh.nodes, nodes[-1]),
                )
        return nodes

    def _upload(self, scene: DeviceScene, nodes: list[DeviceArray]) -> DeviceArray:
        rows: list[AssetBvh] = []
        for cached, shrunk in zip(scene.bvh.cached, nodes, strict=True):
            row = AssetBvh()
            row.nodes, row.particles, row.gaussians = shrunk, cached.bvh.particles, cached.data
            rows.append(row)
        return self._buffers.table(f"{self._name}.assets", AssetBvh, rows)
