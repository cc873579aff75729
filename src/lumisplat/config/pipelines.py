"""Pipelines: how each finds visible surfaces and computes their light, and which settings it reads."""

from __future__ import annotations

from dataclasses import fields
from enum import Enum

from lumisplat.config.gaussians import TraceConfig


class Visibility(Enum):
    """Method that finds primary hits."""

    RASTERISED = "rasterised"
    TRACED = "traced"


class Integrator(Enum):
    """Method that computes the light at primary hits."""

    DIRECT = "direct"
    """Direct light of the lights, with shadow rays and no further rays."""
    WHITTED = "whitted"
    """Direct light of the lights, also by way of mirrors and glass (Whitted 1980)."""
    PATH = "path"
    """Paths that bounce in all directions (Kajiya 1986)."""
    REALTIME = "realtime"
    """Indirect light from probes and caches that the frames of a sequence share."""


class Pipeline(Enum):
    """Algorithm that finds visible surfaces and computes their light."""

    RASTER = "raster"
    """Sorted, tiled rasterisation, with direct light."""
    TRACE = "trace"
    """Rays through the Gaussians, with mirrors and glass."""
    HYBRID = "hybrid"
    """Rasterised first hits, from which rays continue for shadows, mirrors and glass."""
    PATH = "path"
    """Path tracing, with bounces in all directions up to ``max_bounces`` (docs/method/paths.md)."""
    REALTIME = "realtime"
    """Rasterised frames of a sequence with indirect light, which each frame refines (docs/method/realtime.md)."""

    @property
    def visibility(self) -> Visibility:
        """Method that finds primary hits."""
        return _RESOLVED[self][0]

    @property
    def integrator(self) -> Integrator:
        """Method that lights frames; unlit frames of ``PATH`` and ``REALTIME`` use `Integrator.WHITTED`."""
        return _RESOLVED[self][1]

    @property
    def rasterises(self) -> bool:
        """True if primary hits are rasterised, False if rays find them."""
        return self.visibility is Visibility.RASTERISED

    @property
    def spawns_rays(self) -> bool:
        """True if rays find hits that are shaded: primary hits, reflections or bounces. Shadow rays do not count."""
        return self.integrator is not Integrator.DIRECT

    @property
    def traces_paths(self) -> bool:
        """True if each sample of a lit frame is a path."""
        return self.integrator is Integrator.PATH

    @property
    def is_differentiable(self) -> bool:
        """True if unlit frames have gradients with respect to their Gaussians, which training needs."""
        return self in (Pipeline.RASTER, Pipeline.TRACE)

    @property
    def bounces_light(self) -> bool:
        """True if lit frames have indirect light that bounces off diffuse surfaces."""
        return self.integrator in (Integrator.PATH, Integrator.REALTIME)

    @property
    def is_sequence(self) -> bool:
        """True if each frame adds one sample a pixel to the light that earlier frames have found."""
        return self.integrator is Integrator.REALTIME


_RESOLVED = {
    Pipeline.RASTER: (Visibility.RASTERISED, Integrator.DIRECT),
    Pipeline.TRACE: (Visibility.TRACED, Integrator.WHITTED),
    Pipeline.HYBRID: (Visibility.RASTERISED, Integrator.WHITTED),
    Pipeline.PATH: (Visibility.TRACED, Integrator.PATH),
    Pipeline.REALTIME: (Visibility.RASTERISED, Integrator.REALTIME),
}
"""Visibility and integrator of each pipeline, the only place that defines them."""

READ_BY: dict[str, tuple[Pipeline, ...]] = {
    "raster": tuple(one for one in Pipeline if one.rasterises),
    **{
        f"trace.{field.name}": tuple(one for one in Pipeline if one.spawns_rays)
        for field in fields(TraceConfig)
        if field.name not in ("hit_distance", "normal_method")  # the rasteriser reads these two
    },
    "trace.strategy": tuple(one for one in Pipeline if one.spawns_rays and not one.traces_paths),
    "path": tuple(one for one in Pipeline if one.traces_paths),
    "realtime": tuple(one for one in Pipeline if one.is_sequence),
    "max_bounces": tuple(one for one in Pipeline if one.spawns_rays),
    "glossy_reflections": tuple(one for one in Pipeline if one.integrator is Integrator.WHITTED),
    "adaptive": tuple(one for one in Pipeline if not one.rasterises),
    **dict.fromkeys(("samples", "noise", "time_limit"), tuple(one for one in Pipeline if not one.is_sequence)),
}
"""Pipelines that read a setting or group of `RenderConfig`; settings without an entry are read by all."""

READ_IF_SAMPLED = ("samples", "time_limit", "noise", "seed", "jitter")
"""Settings without effect on frames that are exact with one sample: unlit, sorted and rasterised as ellipses."""

READ_IF_LIT = (
    *("shadows", "shadow_rays", "tone_map", "exposure", "glossy_reflections", "capture_gain", "energy_compensation"),
)
"""Settings that only lit frames read; ``exposure`` is a field of the camera."""
