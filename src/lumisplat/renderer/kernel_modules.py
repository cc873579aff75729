"""Which kernel modules a plan needs: only those are compiled at a first use."""

from __future__ import annotations

from lumisplat.config import REALTIME_AOVS, RasterStrategy, RenderConfig
from lumisplat.device.structs.bvh import DRAWS_SHARED
from lumisplat.renderer.film import adaptive_kernels, film_kernels, lit_picture_kernels, picture_kernels
from lumisplat.renderer.gi import (
    antialiasing_kernels,
    light_grid_kernels,
    lobe_kernels,
    radiance_cache_kernels,
    radiance_cache_tiles_kernels,
    screen_probe_kernels,
    screen_probe_light_kernels,
)
from lumisplat.renderer.integrators import path_kernels
from lumisplat.renderer.light import direct_light_kernels, surface_kernels, unshadowed_light_kernels
from lumisplat.renderer.raster import (
    binning_kernels,
    mean_surface_kernels,
    mesh_pixel_kernels,
    mesh_raster_kernels,
    mesh_tile_kernels,
    relit_splat_kernels,
    splat_block_kernels,
    splat_pixel_kernels,
    splat_raster_kernels,
    splat_tile_kernels,
)
from lumisplat.renderer.realtime import (
    a_trous_filter_kernels,
    bounced_light_kernels,
    gbuffer_kernels,
    indirect_light_kernels,
    kept_kernels,
    mirror_kernels,
    pixel_light_kernels,
    temporal_filter_kernels,
)
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow import incoherent_shadow_kernels, mesh_shadow_kernels, stochastic_bvh_kernels
from lumisplat.renderer.shadow.shadow_rays import draws_of, shadow_kernel_of
from lumisplat.renderer.trace import (
    camera_ray_kernels,
    mesh_trace_kernels,
    path_gaussians_kernels,
    specular_wave_kernels,
    stochastic_hit_kernels,
)
from lumisplat.renderer.trace.gaussian_trace import trace_kernel_of
from lumisplat.renderer.trees import box_tree_kernels, gaussian_bvh_kernels, ray_order_kernels
from lumisplat.runtime.launcher import KernelModule, Launcher


def frame_modules(plan: FramePlan, launcher: Launcher, config: RenderConfig) -> list[KernelModule]:
    """The kernel modules of a frame; those that take long to compile first, so that no thread ends with one alone."""
    modules: list[KernelModule] = []
    if plan.traces_rays:
        modules += [trace_kernel_of(launcher).module]
    if plan.is_sampled:
        modules += [surface_kernels]
    if plan.casts_shadows:
        modules += gaussian_shadow_modules(launcher, config) if plan.splat_shadows.exist else []
        modules += [mesh_shadow_kernels] if plan.has_meshes else []
    if plan.traces_paths:
        modules += [path_kernels, path_gaussians_kernels, ray_order_kernels, stochastic_hit_kernels]
        modules += [incoherent_shadow_kernels] if plan.casts_shadows and plan.splat_shadows.exist else []
    if plan.has_history:
        modules += [*realtime_modules(), *[antialiasing_kernels] * plan.jitters]
        modules += [*[kept_kernels] * bool(plan.aovs & {*REALTIME_AOVS})]
    if plan.spawns_shadow_rays and (plan.has_history or not plan.traces_paths):
        modules += [direct_light_kernels]
    modules += [gaussian_bvh_kernels] if plan.follows_rays else []
    modules += [box_tree_kernels] if plan.follows_rays or (plan.is_sampled and plan.has_meshes) else []
    if plan.has_unshadowed:
        modules += [unshadowed_light_kernels]
    if plan.rasterises:
        modules += raster_modules(plan, launcher, config)
    if plan.max_bounces and (plan.has_history or not plan.traces_paths):
        modules += [specular_wave_kernels, *[mirror_kernels] * plan.has_history]
    if plan.is_sampled:
        modules += [camera_ray_kernels, film_kernels, *[adaptive_kernels] * plan.adapts]
    if plan.traces_rays:
        modules += [mesh_trace_kernels]
    if launcher.is_cuda:
        modules += picture_modules(plan)
    return modules


def picture_modules(plan: FramePlan) -> list[KernelModule]:
    """The kernel modules that encode the picture of a frame."""
    return [lit_picture_kernels if plan.is_lit else picture_kernels]


def realtime_modules() -> list[KernelModule]:
    """The kernel modules of frames that have a history, but for those that other frames need as well."""
    modules: list[KernelModule] = [bounced_light_kernels, pixel_light_kernels, gbuffer_kernels, indirect_light_kernels]
    modules += [temporal_filter_kernels, a_trous_filter_kernels]
    modules += [screen_probe_kernels, screen_probe_light_kernels]
    return [*modules, light_grid_kernels, lobe_kernels, radiance_cache_kernels, radiance_cache_tiles_kernels]


def raster_modules(plan: FramePlan, launcher: Launcher, config: RenderConfig) -> list[KernelModule]:
    """The kernel modules of rasterised primary hits."""
    blended = splat_block_kernels if config.raster.strategy is RasterStrategy.SORTED else splat_pixel_kernels
    modules: list[KernelModule] = [blended if launcher.is_parallel else splat_tile_kernels]
    modules += [splat_raster_kernels, binning_kernels]
    if plan.mixes_sets:
        modules += [relit_splat_kernels]
    if plan.shows_means:
        modules += [mean_surface_kernels]
    if "hits" in plan.aovs and not launcher.is_parallel:
        modules += [splat_pixel_kernels]  # those of tiles do not count
    if plan.has_meshes:
        modules += [mesh_pixel_kernels if launcher.is_parallel else mesh_tile_kernels, mesh_raster_kernels]
    return modules


def transmittance_modules(launcher: Launcher) -> list[KernelModule]:
    """The kernel modules of transmittance along rays."""
    shadow_modules = [*gaussian_shadow_modules(launcher, RenderConfig()), mesh_shadow_kernels]
    return [camera_ray_kernels, gaussian_bvh_kernels, box_tree_kernels, *shadow_modules]


def gaussian_shadow_modules(launcher: Launcher, config: RenderConfig) -> list[KernelModule]:
    """The kernel modules of shadow rays through Gaussians."""
    modules: list[KernelModule] = [shadow_kernel_of(launcher, config).module]
    if draws_of(config) == DRAWS_SHARED:
        modules += [stochastic_bvh_kernels]
    return modules
