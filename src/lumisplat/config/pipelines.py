"""The pipelines: how each finds what the camera sees, how it carries light from there, and which settings it reads."""

from __future__ import annotations

from enum import Enum


class Visibility(Enum):
    """How primary hits are found."""

    RASTERISED = "rasterised"
    TRACED = "traced"


class Integrator(Enum):
    """How light is carried to what the camera sees."""

    DIRECT = "direct"
    """From the lights, without further rays but shadow rays."""
    WHITTED = "whitted"
    """From the lights, also by way of mirrors and glass (Whitted 1980)."""
    PATH = "path"
    """By paths that bounce in all directions (Kajiya 1986)."""
    REALTIME = "realtime"
    """By bounces in all directions that the frames of a sequence share."""


class Pipeline(Enum):
    """How the surfaces that the camera sees are found."""

    RASTER = "raster"
    """Sorted, tiled rasterisation."""
    TRACE = "trace"
    """Rays through the Gaussians themselves, mirrors and glass included."""
    HYBRID = "hybrid"
    """Rasterised first; rays continue from there, for shadows, mirrors and glass."""
    PATH = "path"
    """Paths of light that bounces, in any direction and as often as ``max_bounces`` (docs/method/paths.md)."""
    REALTIME = "realtime"
    """A sequence of rasterised frames in which light bounces: each adds to what those before it have found
    (docs/method/realtime.md)."""

    @property
    def visibility(self) -> Visibility:
        """How primary hits are found."""
        return _RESOLVED[self][0]

    @property
    def integrator(self) -> Integrator:
        """How lit frames carry light; unlit ones of ``PATH`` and ``REALTIME`` are those of `Integrator.WHITTED`."""
        return _RESOLVED[self][1]

    @property
    def rasterises(self) -> bool:
        """Whether primary hits are rasterised; otherwise rays find them."""
        return self.visibility is Visibility.RASTERISED

    @property
    def spawns_rays(self) -> bool:
        """Whether rays find hits to be shaded: primary ones, in mirrors, or after bounces; shadow rays find none."""
        return self.integrator is not Integrator.DIRECT

    @property
    def traces_paths(self) -> bool:
        """Whether each sample of a lit frame is a whole path."""
        return self.integrator is Integrator.PATH

    @property
    def is_differentiable(self) -> bool:
        """Whether unlit frames have derivatives by their Gaussians, from which captures are trained."""
        return self in (Pipeline.RASTER, Pipeline.TRACE)

    @property
    def bounces_light(self) -> bool:
        """Whether light bounces in all directions."""
        return self.integrator in (Integrator.PATH, Integrator.REALTIME)

    @property
    def is_sequence(self) -> bool:
        """Whether each frame adds one sample a pixel to what those before it have found."""
        return self.integrator is Integrator.REALTIME


_RESOLVED = {
    Pipeline.RASTER: (Visibility.RASTERISED, Integrator.DIRECT),
    Pipeline.TRACE: (Visibility.TRACED, Integrator.WHITTED),
    Pipeline.HYBRID: (Visibility.RASTERISED, Integrator.WHITTED),
    Pipeline.PATH: (Visibility.TRACED, Integrator.PATH),
    Pipeline.REALTIME: (Visibility.RASTERISED, Integrator.REALTIME),
}
"""The one place that says what the name of a pipeline means."""

READ_BY: dict[str, tuple[Pipeline, ...]] = {
    "raster": tuple(one for one in Pipeline if one.rasterises),
    "trace": tuple(one for one in Pipeline if one.spawns_rays),
    "trace.strategy": tuple(one for one in Pipeline if one.spawns_rays and not one.traces_paths),
    "path": tuple(one for one in Pipeline if one.traces_paths),
    "realtime": tuple(one for one in Pipeline if one.is_sequence),
    "max_bounces": tuple(one for one in Pipeline if one.spawns_rays),
    "glossy_reflections": tuple(one for one in Pipeline if one.integrator is Integrator.WHITTED),
    "adaptive": tuple(one for one in Pipeline if not one.rasterises),
    **dict.fromkeys(("samples", "noise", "time_limit"), tuple(one for one in Pipeline if not one.is_sequence)),
}
"""The pipelines that read a setting or group of `RenderConfig`; the others are read by all."""

READ_IF_SAMPLED = ("samples", "time_limit", "noise", "seed", "jitter")
"""Settings that frames do not read which are exact with one sample: unlit, sorted and rasterised by ellipses."""

READ_IF_LIT = (
    *("shadows", "shadow_rays", "tone_map", "exposure", "glossy_reflections", "capture_gain", "energy_compensation"),
)
"""Settings that only lit frames read; ``exposure`` is the camera's."""
