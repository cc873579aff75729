"""Which settings and views have an effect on what is shown: controls of the others are disabled, or hidden."""

from __future__ import annotations

import lumisplat as ls

_SORTED = "Projection unscented goes with strategy sorted alone."
_ISO = "Projection unscented goes with surface iso alone."
_UNSCENTED = "Unscented goes with the pipelines raster and hybrid, strategy sorted and surface iso alone."
_BOUNCED = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy")
"""Views of light that pipelines have in which it bounces."""
_OF_SEQUENCES = ("motion", "history", "probes", "cache", "cache_cells")
"""Views of what frames in real time keep for the next ones."""
_OF_LIGHT = ("shadow", "emission", *_BOUNCED, *_OF_SEQUENCES)


def shown_views(config: ls.RenderConfig, *, lit: bool) -> tuple[str, ...]:
    """Returns what pages may show: ``color``, and those of `lumisplat.Frame.VIEWS` that such frames have.

    Args:
        config: The settings.
        lit: Whether frames are lit.
    """
    lacking: set[str] = set()
    if not lit:
        lacking.update(_OF_LIGHT)
    elif not config.pipeline.bounces_light:
        lacking.update(_BOUNCED)
    if config.pipeline.is_sequence:
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
    return config.unused_settings(lit=lit) | _excluded(config)


def _excluded(config: ls.RenderConfig) -> dict[str, str]:
    """Returns the settings whose other choices would be refused beside the rest, each with what excludes them."""
    raster, excluded = config.raster, dict[str, str]()
    is_sorted, is_iso = (
        raster.strategy is ls.config.RasterStrategy.SORTED,
        raster.surface is ls.config.GaussianSurface.ISO,
    )
    if raster.projection is ls.config.Projection.UNSCENTED:
        excluded |= {"raster.strategy": _SORTED} if is_sorted else {}
        excluded |= {"raster.surface": _ISO} if is_iso else {}
    elif config.pipeline.is_sequence or not is_sorted or not is_iso:
        excluded["raster.projection"] = _UNSCENTED
    return excluded
