"""Options that were given and have no effect on a frame: a line says so."""

from __future__ import annotations

from collections.abc import Iterator

import lumisplat as ls
from lumisplat.cli.options.lighting import LightOptions
from lumisplat.cli.options.rays import RayOptions
from lumisplat.cli.options.settings import given_options

_OF_SAMPLES = ("samples", "time", "noise", "seed", "no_jitter")
_OF_SHADOW_RAYS = ("kernel_degree", "min_response", "no_adaptive_clamping")
_OF_PATHS = ("primary",)
_OF_REALTIME = ("quality",)
_REFUSED = ("adaptive",)  # where it is on and has no effect
_NOT_OF_PATHS = ("strategy", "glossy_reflections", "no_glossy_reflections")
_OF_SHADOWS = (
    *("shadow_method", "shadow_hits", "shadow_offset", "shadow_offset_absolute", "shadow_threshold", "shadow_color"),
)


def unused_options(
    config: ls.RenderConfig, scene: ls.Scene, raster: list[str], rays: RayOptions, light: LightOptions
) -> Iterator[str]:
    """A line for each reason why options are not used.

    Args:
        config: Settings of the frame.
        scene: What it shows.
        raster: Options of the rasteriser that were given, as they are typed.
        rays: The options of rays.
        light: The options of light.
    """
    is_path = config.pipeline.traces_paths
    bounces = config.pipeline.bounces_light
    lit = config.is_lit(by_default=scene.is_lit_by_default)
    shadowed = lit and config.shadows is not ls.Shadows.OFF
    if not config.pipeline.rasterises and raster:
        yield not_used(config, raster, "raster and hybrid")
    if not config.pipeline.spawns_rays:
        others = *_OF_PATHS, *_OF_REALTIME, *_REFUSED
        used = given_options(rays, [*_used_by_raster(config, lit=lit, shadowed=shadowed), *others])
        unused = [option for option in given_options(rays) if option not in used]
        if unused:
            yield not_used(config, unused, "trace and hybrid")
    if not is_path and (unused := given_options(rays, _OF_PATHS)):
        yield not_used(config, unused, "path")
    if not config.pipeline.is_sequence and (unused := given_options(rays, _OF_REALTIME)):
        yield not_used(config, unused, "realtime")
    if is_path and (unused := given_options(rays, _NOT_OF_PATHS)):
        yield (
            f"not used by --pipeline path: {', '.join(unused)} (its rays meet one relit Gaussian, by chance, blend "
            "captures that are kept, and reflect what is around)"
        )
    if not lit:
        unused = [option for option in given_options(light) if option != "--lighting"]
        if unused:
            why = "--lighting is off" if config.lighting is False else "no lights: --lighting on has one at the camera"
            yield f"not used in an unlit frame: {', '.join(unused)} ({why})"
    elif bounces and light.shadows == "hard":
        yield f"not used by --pipeline {config.pipeline.value}: --shadows hard (its shadows are soft)"
    elif not shadowed:
        unused = given_options(light, _OF_SHADOWS)
        if unused:
            yield f"not used without shadows: {', '.join(unused)} (--shadows hard or soft has some)"


def not_used(config: ls.RenderConfig, options: list[str], others: str) -> str:
    """That a pipeline does not use options, and which others do."""
    are = "it is" if len(options) == 1 else "they are"
    return f"not used by --pipeline {config.pipeline.value}: {', '.join(options)} ({are} of --pipeline {others})"


def _used_by_raster(config: ls.RenderConfig, *, lit: bool, shadowed: bool) -> list[str]:
    """Fields of `RayOptions` that a rasterised frame uses: those of samples, and those of shadow rays."""
    used: list[str] = []
    raster = config.raster
    if lit or raster.strategy is ls.RasterStrategy.STOCHASTIC or raster.projection is ls.Projection.UNSCENTED:
        used += _OF_SAMPLES
    if shadowed:
        used += _OF_SHADOW_RAYS
    if shadowed and config.shadow_rays.method is ls.ShadowMethod.FIRST_HITS:
        used.append("hit_distance")
    return used
