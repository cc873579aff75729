"""Settings of a frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import Color, DisplayColor, Range, listed_names, quoted, suggestion
from lumisplat.config.gaussians import (
    Projection,
    RasterConfig,
    RasterStrategy,
    ResponseConfig,
    ShadowConfig,
    TraceConfig,
)
from lumisplat.config.pipelines import READ_BY, READ_IF_LIT, READ_IF_SAMPLED, Pipeline
from lumisplat.config.realtime import RealtimeConfig
from lumisplat.config.setting import Seed, frozen, given, take_fields
from lumisplat.constants import SAMPLES_MAX
from lumisplat.errors import ConfigError

CAPTURE_GAIN_MAX = 16.0
"""Stops by which the light of captures is brightened at most: 65,536 times."""


class Shadows(Enum):
    """Whether shadow rays are followed, and to which point of a light."""

    OFF = "off"
    """No shadow rays: light passes through everything."""
    HARD = "hard"
    """To the centre of each light; as ``SOFT`` in frames of paths and in real time."""
    SOFT = "soft"
    """To a random point of each light, another one for each sample: penumbrae, once samples average them."""


class ToneMap(Enum):
    """How linear light becomes display colours."""

    NONE = "none"
    """The sRGB curve; what is brighter than white is clipped."""
    NEUTRAL = "neutral"
    """Khronos PBR Neutral: true colours, highlights compressed."""
    AGX = "agx"
    """AgX: filmic, highlights lose their colour."""


PATH_PARTS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy", "emission")
"""Images whose sum is a frame of paths; the other pipelines have the last one."""

EVERY_FRAME = ("color", "alpha", "depth", "depth_z", "normal", "gaussian_index", "instance_index", "position")
"""Images of every frame."""

PATH_AOVS = (*PATH_PARTS[:4], "bounces")
"""Images that only frames of paths have."""

REALTIME_AOVS = ("motion", "history", "probes", "cache", "cache_cells")
"""Images that only frames in real time have: how surfaces have moved, and what frames keep for the next one."""

AOVS = (
    *("albedo", "emission", "reflection", "lights", "hits", "variance", "sample_count", "shadow_ratio"),
    *PATH_AOVS,
    *REALTIME_AOVS,
)
"""Images of a frame that are made only where ``RenderConfig.aovs`` asks for them."""


def _checked_aovs(aovs: str | Iterable[str], name: str = "aovs") -> tuple[str, ...]:
    """Returns names of images, in the order of `AOVS`, each once."""
    names = listed_names(aovs)
    if names is None:
        raise ConfigError(f"{name} is {quoted(aovs)}, expected some of {', '.join(AOVS)}")
    for aov in names:
        if aov in EVERY_FRAME:
            raise ConfigError(f"{name} has {aov!r}, which every frame has: leave it out")
        if aov not in AOVS:
            raise ConfigError(f"{name} has {aov!r}, {suggestion(aov, AOVS)}")
    return tuple(aov for aov in AOVS if aov in names)  # in one order, each once


class PathPrimary(Enum):
    """What paths meet first, where the camera sees relit Gaussians."""

    PARTICLE = "particle"
    """One Gaussian, drawn by the opacities of all, with its own normal and material; as at all later surfaces."""
    ISO = "iso"
    """The surface of the other pipelines: at the depth of ``TraceConfig.depth_iso_transmittance``, with the normals and
    colours of all Gaussians on the ray blended."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathConfig:
    """Settings of paths, read by ``Pipeline.PATH`` (docs/method/paths.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    primary: PathPrimary = PathPrimary.PARTICLE
    """What paths meet first. ``ISO`` is what pipelines in real time can converge to."""

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class RenderConfig:
    """Settings of a frame.

    Each group is read by the stage that it is named after and by no other. Which pipelines have that stage:

    ===============  =====================  ===========================  =================
    group            ``RASTER``             ``HYBRID``, ``REALTIME``     ``TRACE``, ``PATH``
    ===============  =====================  ===========================  =================
    ``raster``       all that is seen       what the camera sees first   not read
    ``trace``        not read               what mirrors and glass show  all that is seen
    ``response``     shadow rays            mirrored and shadow rays     all rays
    ``shadow_rays``  shadow rays            shadow rays                  shadow rays
    ===============  =====================  ===========================  =================

    ``path`` is read by ``PATH`` alone. Its paths meet relit Gaussians one at a time, whatever ``trace.strategy`` says,
    and lights have the size that they have, whatever ``shadows`` says unless it is off. ``realtime`` is read by
    ``REALTIME`` alone, whose frames have one sample a pixel.

    A choice may be given by its value, here and in all other settings: ``pipeline="hybrid"`` is
    ``pipeline=Pipeline.HYBRID``.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    pipeline: Pipeline = Pipeline.RASTER
    """How the surfaces that the camera sees are found."""
    background: Color | None = given(converter=DisplayColor(), default=(0.0, 0.0, 0.0))
    """Display-referred sRGB behind everything; None leaves the frame transparent. Also accepted are
    ``"#ff8800"``, names such as ``"white"``, and ``"transparent"``, which become numbers or None."""
    raster: RasterConfig = field(default_factory=RasterConfig)
    """Settings of the rasteriser."""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """Settings of the ray tracer."""
    path: PathConfig = field(default_factory=PathConfig)
    """Settings of paths."""
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    """Settings of frames in real time."""
    response: ResponseConfig = field(default_factory=ResponseConfig)
    """How Gaussians respond to rays of all kinds."""
    lighting: bool | None = None
    """Whether lights illuminate the scene; a scene without any has a headlight at the camera. None: if it has any, or
    is of meshes alone, which would be flat areas of colour otherwise; ``PATH`` and ``REALTIME`` frames always. Rays of
    ``trace_rays`` have no headlight then, and are lit if the scene has lights or, with ``PATH``, shines."""
    shadows: Shadows = Shadows.HARD
    """Whether lights are blocked by what stands in their way, in lit frames."""
    shadow_rays: ShadowConfig = field(default_factory=ShadowConfig)
    """Settings of shadow rays."""
    tone_map: ToneMap = ToneMap.NONE
    """How lit frames become pictures; pixels that show only a capture stay as captured."""
    aovs: tuple[str, ...] = given(converter=_checked_aovs, default=())
    """Further images of a lit frame: some of ``albedo``, ``emission``, ``reflection``, ``lights``, ``hits``,
    ``variance``, ``sample_count``, ``shadow_ratio``; ``hits``, ``variance`` and ``sample_count`` of an unlit one, too.
    Paths have no ``reflection``, but also ``direct_diffuse``, ``indirect_diffuse``, ``direct_glossy``,
    ``indirect_glossy`` and ``bounces``. Frames in real time have these but ``bounces``, and ``motion``, ``history``,
    ``probes``, ``cache`` and ``cache_cells``. A single name, or several with commas, becomes a tuple."""
    samples: Annotated[int, Range(1, SAMPLES_MAX)] | None = None
    """Samples a pixel, averaged. None: 64 paths; else as many as random light needs, 16 for an environment
    and for soft shadows of lights that have a size, 8 for an environment on splat sets alone; else 1. The unlit, sorted
    raster is exact with one, and takes no more, but with ``UNSCENTED``, which samples antialias."""
    time_limit: Annotated[float, Range(0.0, unit="seconds", above=True)] | None = None
    """Time that the samples of a frame take; ``samples`` is then the most of them, and None as many as
    there is time for, at least one. None: no limit."""
    noise: Annotated[float, Range(0.0, 1.0, above=True, below=True)] | None = None
    """Relative error at which a frame has samples enough: 95 % of its pixels are estimated to be
    below it (docs/method/samples.md). ``samples`` is then the most of them, and None as many as it takes. None: the
    noise ends no frame."""
    adaptive: bool | None = None
    """Whether noisy pixels have more samples than others, ``samples`` being the most: in the trace and path pipelines,
    from the 17th sample on. None: if ``noise`` is given."""
    glossy_reflections: bool | None = None
    """Whether rough metals and glossy surfaces reflect what is around them, in lit frames of the trace and hybrid
    pipelines; without, they reflect lights and the environment only. One ray a sample, from the first surface: noisy,
    samples average it. None: if a rough metal and something else are in the scene. Paths always have it."""
    capture_gain: Annotated[float, Range(-CAPTURE_GAIN_MAX, CAPTURE_GAIN_MAX, "stops")] = 0.0
    """How much the light is brightened that captures shine onto what they light: their light sources are clipped
    at a display's white. What is seen of captures, in mirrors as well, stays as it is. `estimate_capture_gain` finds a
    value. Of frames in which captures light anything: paths, real time, glossy reflections, and meshes in scenes
    without lights."""
    energy_compensation: bool = False
    """Whether rough metals reflect what single scattering between their microfacets loses, in lit frames. Not by
    default, as in glTF's own viewer: white metal of roughness 1 then keeps half of its light."""
    jitter: bool = True
    """Samples after the first spread over their pixel, which antialiases; the first goes through its centre. In all
    pipelines, wherever ``samples`` counts."""
    seed: Seed = 0
    """Of all random numbers: the same seed gives the same image."""
    max_bounces: Annotated[int, Range(0, 64)] | None = None
    """Reflections and refractions that a ray follows, in the trace and hybrid pipelines, beyond which it sees
    the background; in the path pipeline bounces of any kind, beyond which there is no light: 0 is direct light. In real
    time those of reflections, and 0 is direct light, too. None: 3, and 8 in the path pipeline."""

    __post_init__ = take_fields

    def is_lit(self, *, by_default: bool) -> bool:
        """Whether lights light the frames of a scene.

        Args:
            by_default: Whether the scene itself asks for light: `Scene.is_lit_by_default`.
        """
        return by_default or self.pipeline.bounces_light if self.lighting is None else self.lighting

    def unused_settings(self, *, lit: bool) -> dict[str, str]:
        """Returns the settings, and groups of settings, without an effect on frames, each with what would give it one.

        Args:
            lit: Whether frames are lit, as `is_lit` says.
        """
        unused = {name: _readers(pipelines) for name, pipelines in READ_BY.items() if self.pipeline not in pipelines}
        if not self.pipeline.spawns_rays and not (lit and self.shadows is not Shadows.OFF):
            unused["response"] = "Used where rays are followed: with shadows, or by other pipelines than raster."
        is_exact = self.raster.strategy is RasterStrategy.SORTED and self.raster.projection is Projection.EWA
        if not self.pipeline.spawns_rays and not lit and is_exact:
            unused |= dict.fromkeys(READ_IF_SAMPLED, "Used where lights shine, and by other pipelines than raster.")
        if self.shadows is Shadows.OFF:
            unused["shadow_rays"] = "Used with shadows, hard or soft."
        if not lit:
            unused |= dict.fromkeys(READ_IF_LIT, "Used where lights shine: add one, or switch lighting on.")
        return unused


def _readers(pipelines: tuple[Pipeline, ...]) -> str:
    names = [pipeline.value for pipeline in pipelines]
    return f"Used by the pipeline{'s' * (len(names) > 1)} {', '.join(names)}."
