"""What of the options that were given a frame does not use: said in a line, for nobody should wait for an effect."""

from __future__ import annotations

from collections.abc import Iterator

import lumisplat as ls
from lumisplat.cli.options.common import given_options
from lumisplat.cli.options.lighting import LightOptions
from lumisplat.cli.options.tracing import TraceOptions

_OF_SAMPLES = ("samples", "seed", "no_jitter")
_OF_SHADOW_RAYS = ("kernel_degree", "min_response")
_OF_SHADOWS = ("shadow_method", "shadow_hits", "shadow_offset", "shadow_offset_absolute", "shadow_threshold")


def unused_options(
    config: ls.RenderConfig, scene: ls.Scene, raster: list[str], trace: TraceOptions, light: LightOptions
) -> Iterator[str]:
    """A line for each reason why options are not used.

    Args:
        config: Settings of the frame.
        scene: What it shows.
        raster: Options of the rasteriser that were given.
        trace: Options of rays.
        light: Options of light.
    """
    lit = bool(scene.lights) if config.lighting is None else config.lighting
    shadowed = lit and config.shadows is not ls.Shadows.OFF
    if config.pipeline is ls.Pipeline.TRACE and raster:
        yield f"not used by --pipeline trace: {', '.join(raster)} (they are of --pipeline raster and hybrid)"
    if config.pipeline is ls.Pipeline.RASTER:
        used: tuple[str, ...] = ()
        if lit or config.raster.strategy is ls.RasterStrategy.STOCHASTIC:
            used += _OF_SAMPLES
        if shadowed:
            used += _OF_SHADOW_RAYS
            used += ("hit_distance",) if config.shadow_rays.method is ls.ShadowMethod.FIRST_HITS else ()
        unused = [option for option in given_options(trace) if option not in given_options(trace, used)]
        if unused:
            yield f"not used by --pipeline raster: {', '.join(unused)} (they are of --pipeline trace and hybrid)"
    if not lit:
        unused = [option for option in given_options(light) if option != "--lighting"]
        if unused:
            why = "--lighting is off" if config.lighting is False else "no lights: --lighting on has one at the camera"
            yield f"not used in an unlit frame: {', '.join(unused)} ({why})"
    elif not shadowed:
        unused = given_options(light, (*_OF_SHADOWS, "shadow_color"))
        if unused:
            yield f"not used without shadows: {', '.join(unused)} (--shadows hard or soft has some)"
