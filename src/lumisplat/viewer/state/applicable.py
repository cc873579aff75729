"""Which settings and views have an effect on what is shown: controls of the others are disabled, or hidden."""

from __future__ import annotations

import lumisplat as ls

_LIT = "Used where lights shine: add one, or switch lighting on."
_SHADOWED = "Used with shadows, hard or soft."
_SORTED = "Projection unscented goes with strategy sorted alone."
_ISO = "Projection unscented goes with surface iso alone."
_UNSCENTED = "Unscented goes with the pipelines raster and hybrid, strategy sorted and surface iso alone."
_BOUNCED = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy")
"""Views of light that pipelines have in which it bounces."""
_OF_SEQUENCES = ("motion", "history", "probes", "cache", "cache_cells")
"""Views of what frames in real time keep for the next ones."""
_OF_LIGHT = ("shadow", "emission", *_BOUNCED, *_OF_SEQUENCES)
_BOUNCES = (ls.Pipeline.PATH, ls.Pipeline.REALTIME)


def is_lit(config: ls.RenderConfig, scene: ls.Scene) -> bool:
    """Whether frames of a scene are lit."""
    if config.lighting is not None:
        return config.lighting
    return scene.is_lit_by_default or config.pipeline in _BOUNCES


def shown_views(config: ls.RenderConfig, *, lit: bool) -> tuple[str, ...]:
    """Returns what pages may show: ``color``, and those of `lumisplat.Frame.VIEWS` that such frames have.

    Args:
        config: The settings.
        lit: Whether frames are lit.
    """
    lacking: set[str] = set()
    if not lit:
        lacking.update(_OF_LIGHT)
    elif config.pipeline not in _BOUNCES:
        lacking.update(_BOUNCED)
    if config.pipeline is ls.Pipeline.REALTIME:
        lacking.add("shadow")
    else:
        lacking.update(_OF_SEQUENCES)
    return ("color", *(view for view in ls.Frame.VIEWS if view not in lacking))


def unused_settings(config: ls.RenderConfig, *, lit: bool) -> dict[str, str]:
    """Returns the settings, and groups of settings, without an effect on frames, each with what would give it one.

    Args:
        config: The settings.
        lit: Whether frames are lit.
    """
    pipeline, of = config.pipeline, ls.Pipeline
    pipelines = {
        "raster": (of.RASTER, of.HYBRID, of.REALTIME),
        "trace": (of.TRACE, of.HYBRID, of.PATH, of.REALTIME),
        "path": (of.PATH,),
        "realtime": (of.REALTIME,),
        "max_bounces": (of.TRACE, of.HYBRID, of.PATH, of.REALTIME),
        "glossy_reflections": (of.TRACE, of.HYBRID),
        "adaptive": (of.TRACE, of.PATH),
        **dict.fromkeys(("samples", "noise", "time_limit"), (of.RASTER, of.TRACE, of.HYBRID, of.PATH)),
    }
    unused = {name: _of(users) for name, users in pipelines.items() if pipeline not in users}
    if config.shadows is ls.Shadows.OFF:
        unused["shadow_rays"] = _SHADOWED
    if not lit:
        of_light = ("shadows", "shadow_rays", "tone_map", "exposure", "glossy_reflections")
        of_light = (*of_light, "capture_gain", "energy_compensation")
        unused |= dict.fromkeys(of_light, _LIT)
    return unused | _excluded(config)


def _excluded(config: ls.RenderConfig) -> dict[str, str]:
    """Returns the settings whose other choices would be refused beside the rest, each with what excludes them."""
    raster, excluded = config.raster, dict[str, str]()
    is_sorted, is_iso = raster.strategy is ls.RasterStrategy.SORTED, raster.surface is ls.GaussianSurface.ISO
    if raster.projection is ls.Projection.UNSCENTED:
        excluded |= {"raster.strategy": _SORTED} if is_sorted else {}
        excluded |= {"raster.surface": _ISO} if is_iso else {}
    elif config.pipeline is ls.Pipeline.REALTIME or not is_sorted or not is_iso:
        excluded["raster.projection"] = _UNSCENTED
    return excluded


def _of(pipelines: tuple[ls.Pipeline, ...]) -> str:
    names = [pipeline.value for pipeline in pipelines]
    return f"Used by the pipeline{'s' * (len(names) > 1)} {', '.join(names)}."
