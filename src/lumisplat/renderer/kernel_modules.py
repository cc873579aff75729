"""Which kernel modules a plan needs: only those are imported, and compiled at a first use."""

from __future__ import annotations

from importlib import import_module

from lumisplat.config import REALTIME_AOVS, RasterStrategy, RenderConfig
from lumisplat.device.structs.bvh import DRAWS_SHARED
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.shadow.shadow_rays import draws_of, shadow_kernel_of
from lumisplat.renderer.trace.gaussian_trace import trace_kernel_of
from lumisplat.runtime.launcher import KernelModule, Launcher


def frame_modules(plan: FramePlan, launcher: Launcher, config: RenderConfig) -> list[KernelModule]:
    """The kernel modules of a frame; those that take long to compile first, so that no thread ends with one alone."""
    modules: list[KernelModule] = []
    if plan.traces_rays:
        modules += [trace_kernel_of(launcher).module]
    if plan.is_sampled:
        modules += _kernels("light.surface_kernels")
    if plan.casts_shadows:
        modules += gaussian_shadow_modules(launcher, config) if plan.splat_shadows.exist else []
        modules += _kernels("shadow.mesh_shadow_kernels") if plan.has_meshes else []
    if plan.traces_paths:
        modules += _kernels("integrators.path_kernels", "trace.path_gaussians_kernels")
        modules += _kernels("trees.ray_order_kernels", "trace.stochastic_hit_kernels")
        incoherent = plan.casts_shadows and plan.splat_shadows.exist
        modules += _kernels("shadow.incoherent_shadow_kernels") if incoherent else []
    if plan.has_history:
        modules += realtime_modules()
        modules += _kernels("realtime.captured_light_kernels") if plan.keeps_captures else []
        modules += _kernels("gi.antialiasing_kernels") if plan.jitters else []
        modules += _kernels("realtime.kept_kernels") if plan.aovs & {*REALTIME_AOVS} else []
    if plan.spawns_shadow_rays and (plan.has_history or not plan.traces_paths):
        modules += _kernels("light.direct_light_kernels")
    has_boxes = plan.follows_rays or (plan.is_sampled and plan.has_meshes)
    modules += _kernels("trees.gaussian_bvh_kernels") if plan.follows_rays else []
    modules += _kernels("trees.box_tree_kernels") if has_boxes else []
    if plan.has_unshadowed:
        modules += _kernels("light.unshadowed_light_kernels")
    if plan.rasterises:
        modules += raster_modules(plan, launcher, config)
    if plan.max_bounces and (plan.has_history or not plan.traces_paths):
        modules += _kernels("trace.specular_wave_kernels")
        modules += _kernels("realtime.mirror_kernels") if plan.has_history else []
    if plan.is_sampled:
        modules += _kernels("trace.camera_ray_kernels", "film.film_kernels")
        modules += _kernels("film.adaptive_kernels") if plan.adapts else []
        modules += _kernels("film.catcher_kernels") if plan.has_shadow_only or plan.has_receivers else []
    if plan.traces_rays:
        modules += _kernels("trace.mesh_trace_kernels")
    if launcher.is_cuda:
        modules += picture_modules(plan)
    return modules


def picture_modules(plan: FramePlan) -> list[KernelModule]:
    """The kernel modules that encode the picture of a frame."""
    return _kernels("film.lit_picture_kernels" if plan.is_lit else "film.picture_kernels")


def realtime_modules() -> list[KernelModule]:
    """The kernel modules of frames that have a history, but for those that other frames need as well."""
    passes = ("bounced_light", "pixel_light", "gbuffer", "indirect_light", "temporal_filter", "a_trous_filter")
    light = ("screen_probe", "screen_probe_light", "light_grid", "lobe", "radiance_cache", "radiance_cache_tiles")
    return _kernels(*(f"realtime.{name}_kernels" for name in passes), *(f"gi.{name}_kernels" for name in light))


def raster_modules(plan: FramePlan, launcher: Launcher, config: RenderConfig) -> list[KernelModule]:
    """The kernel modules of rasterised primary hits."""
    if plan.is_unscented:
        return unscented_modules(plan, launcher)
    is_sorted = config.raster.strategy is RasterStrategy.SORTED
    blended = ("splat_block" if is_sorted else "splat_pixel") if launcher.is_parallel else "splat_tile"
    names = [blended, "splat_raster", "binning"]
    if plan.mixes_sets:
        names += ["relit_splat"]
    if plan.shows_means:
        names += ["mean_surface"]
    if "hits" in plan.aovs and not launcher.is_parallel:
        names += ["splat_pixel"]  # those of tiles do not count
    if plan.has_meshes:
        names += ["mesh_pixel" if launcher.is_parallel else "mesh_tile", "mesh_raster"]
    return _kernels(*(f"raster.{name}_kernels" for name in names))


def unscented_modules(plan: FramePlan, launcher: Launcher) -> list[KernelModule]:
    """The kernel modules of primary hits that are rasterised along rays."""
    by_pixel = launcher.is_parallel or plan.mixes_sets or "hits" in plan.aovs
    names = ["ray_splat", "ray_splat_pixel" if by_pixel else "ray_splat_tile"]
    meshes = ("trace.mesh_trace_kernels",) if plan.has_meshes else ()
    return _kernels(*(f"unscented.{name}_kernels" for name in names), "raster.binning_kernels", *meshes)


def gradient_modules(launcher: Launcher) -> list[KernelModule]:
    """The kernel modules of derivatives of unlit raster frames."""
    names = ["splat_backward", "projection_backward", *(["splat_backward_warp"] if launcher.is_parallel else [])]
    return _kernels(*(f"gradients.{name}_kernels" for name in names))


def unscented_gradient_modules(launcher: Launcher) -> list[KernelModule]:
    """The kernel modules of derivatives of frames that are rasterised along rays."""
    names = ["ray_splat_backward", *(["ray_splat_backward_warp"] if launcher.is_parallel else [])]
    return _kernels(*(f"gradients.{name}_kernels" for name in names), "gradients.splat_backward_kernels")


def ray_gradient_modules() -> list[KernelModule]:
    """The kernel modules of derivatives of unlit frames of rays."""
    return _kernels("gradients.ray_backward_kernels")


def feature_modules() -> list[KernelModule]:
    """The kernel modules of further channels of such frames."""
    return _kernels("gradients.feature_kernels")


def transmittance_modules(launcher: Launcher) -> list[KernelModule]:
    """The kernel modules of transmittance along rays."""
    trees = _kernels("trace.camera_ray_kernels", "trees.gaussian_bvh_kernels", "trees.box_tree_kernels")
    shadows = gaussian_shadow_modules(launcher, RenderConfig())
    return [*trees, *shadows, *_kernels("shadow.mesh_shadow_kernels")]


def gaussian_shadow_modules(launcher: Launcher, config: RenderConfig) -> list[KernelModule]:
    """The kernel modules of shadow rays through Gaussians."""
    modules: list[KernelModule] = [shadow_kernel_of(launcher, config).module]
    if draws_of(config) == DRAWS_SHARED:
        modules += _kernels("shadow.stochastic_bvh_kernels")
    return modules


def _kernels(*names: str) -> list[KernelModule]:
    """Modules of kernels, by their names within the renderer."""
    return [import_module(f"lumisplat.renderer.{name}") for name in names]
