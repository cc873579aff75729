"""Settings of a frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import Color, DisplayColor, Range, listed_names, refusal, suggestion
from lumisplat.config.gaussians import (
    Projection,
    RasterConfig,
    RasterStrategy,
    ResponseConfig,
    ShadowConfig,
    ShadowMethod,
    TraceConfig,
)
from lumisplat.config.pipelines import READ_BY, READ_IF_LIT, READ_IF_SAMPLED, Pipeline
from lumisplat.config.realtime import RealtimeConfig
from lumisplat.config.setting import Seed, frozen, given, take_fields
from lumisplat.constants import BOUNCES_MAX, SAMPLES_MAX
from lumisplat.errors import ConfigError

CAPTURE_GAIN_MAX = 16.0
"""Largest ``capture_gain``, stops: a factor of 65,536."""


class Shadows(Enum):
    """Whether shadow rays are traced, and to which point of each light."""

    OFF = "off"
    """No shadow rays: light passes through everything."""
    HARD = "hard"
    """Shadow rays to the centre of each light. Path-traced and real-time frames use ``SOFT`` instead."""
    SOFT = "soft"
    """Shadow rays to random points of lights, new ones in each sample. Samples average them to penumbrae."""


class ToneMap(Enum):
    """Mapping from linear light to display colours."""

    NONE = "none"
    """The sRGB curve, clipped at white."""
    NEUTRAL = "neutral"
    """Khronos PBR Neutral, which keeps hues and compresses highlights."""
    AGX = "agx"
    """AgX, a filmic curve that desaturates highlights."""


PATH_PARTS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy", "emission")
"""Layers whose sum is a path-traced frame; of these, other pipelines but real time have only ``emission``."""

EVERY_FRAME = ("color", "alpha", "depth", "depth_z", "normal", "gaussian_index", "instance_index", "position")
"""Layers that every frame has."""

PATH_AOVS = (*PATH_PARTS[:4], "bounces")
"""Layers that path-traced frames can have; real-time frames can have them, too, except ``bounces``."""

REALTIME_AOVS = ("motion", "history", "probes", "cache", "cache_cells")
"""Layers that only real-time frames have: motion of surfaces, and data that the next frame reuses."""

AOVS = (
    *("albedo", "emission", "reflection", "lights", "hits", "variance", "sample_count", "shadow_ratio"),
    *PATH_AOVS,
    *REALTIME_AOVS,
)
"""Layers that a frame has only if ``RenderConfig.aovs`` lists them."""


def _checked_aovs(aovs: str | Iterable[str], name: str = "aovs") -> tuple[str, ...]:
    """Returns names of layers without duplicates, in the order of `AOVS`."""
    names = listed_names(aovs)
    if names is None:
        raise refusal(ConfigError, name, aovs, f"expected some of {', '.join(AOVS)}")
    for aov in names:
        if aov in EVERY_FRAME:
            raise ConfigError(f"{name} has {aov!r}, which every frame has: leave it out")
        if aov not in AOVS:
            raise ConfigError(f"{name} has {aov!r}, {suggestion(aov, AOVS)}")
    return tuple(aov for aov in AOVS if aov in names)  # in fixed order, without duplicates


class PathPrimary(Enum):
    """First surface of a path where the camera sees relit Gaussians."""

    PARTICLE = "particle"
    """One Gaussian with its own normal and material, chosen at random by the opacities of all Gaussians on the ray.
    Later surfaces of the path are chosen in the same way."""
    ISO = "iso"
    """The iso-opacity surface of the other pipelines, with normals and colours blended over the ray. Its depth is
    where the transmittance falls to ``TraceConfig.depth_iso_transmittance``."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PathConfig:
    """Settings of path tracing, read by ``Pipeline.PATH`` (docs/method/paths.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    primary: PathPrimary = PathPrimary.PARTICLE
    """First surface of a path where the camera sees relit Gaussians. Real-time frames approximate paths with ``ISO``.
    """

    __post_init__ = take_fields


@frozen(kw_only=True, eq=True)
class RenderConfig:
    """Settings of a frame.

    The stage that a group is named after reads it, and no other stage does. Pipelines have these stages:

    ===============  =====================  ===========================  =================
    group            ``RASTER``             ``HYBRID``, ``REALTIME``     ``TRACE``, ``PATH``
    ===============  =====================  ===========================  =================
    ``raster``       all visible surfaces   primary hits                 not read
    ``trace``        not read               mirrors and glass            all visible surfaces
    ``response``     shadow rays            mirrored and shadow rays     all rays
    ``shadow_rays``  shadow rays            shadow rays                  shadow rays
    ===============  =====================  ===========================  =================

    Only ``PATH`` reads ``path``. Its paths hit relit Gaussians one at a time, whatever ``trace.strategy`` is, and its
    lights keep their size, whatever ``shadows`` is unless ``OFF``. Only ``REALTIME`` reads ``realtime``; its frames
    have one sample a pixel.

    Choices of this and all other settings accept their value, too: ``pipeline="hybrid"`` equals
    ``pipeline=Pipeline.HYBRID``.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    pipeline: Pipeline = Pipeline.RASTER
    """Algorithm that finds visible surfaces and computes their light."""
    background: Color | None = given(converter=DisplayColor(), default=(0.0, 0.0, 0.0))
    """Display-referred sRGB colour behind the scene, unless a visible environment is there; None makes the frame
    transparent, also in front of an environment. Also accepts ``"#ff8800"``, names such as ``"white"``, and
    ``"transparent"``."""
    raster: RasterConfig = field(default_factory=RasterConfig)
    """Settings of the rasteriser."""
    trace: TraceConfig = field(default_factory=TraceConfig)
    """Settings of the ray tracer."""
    path: PathConfig = field(default_factory=PathConfig)
    """Settings of path tracing."""
    realtime: RealtimeConfig = field(default_factory=RealtimeConfig)
    """Settings of real-time frames."""
    response: ResponseConfig = field(default_factory=ResponseConfig)
    """Response of Gaussians to rays of all kinds."""
    lighting: bool | None = None
    """Illuminates the scene by its lights; a scene without lights has a headlight at the camera. None: if the scene
    has lights or meshes, and always for ``PATH`` and ``REALTIME``; without lights, captures around the meshes replace
    the headlight. With None, rays of ``trace_rays`` have no headlight; they are lit if the scene has lights or, with
    ``PATH``, emits light."""
    shadows: Shadows = Shadows.HARD
    """Shadows of lights in lit frames. Path-traced and real-time frames use ``SOFT`` in place of ``HARD``."""
    shadow_rays: ShadowConfig = field(default_factory=ShadowConfig)
    """Settings of shadow rays."""
    tone_map: ToneMap = ToneMap.NONE
    """Mapping from linear light to display colours in lit frames; pixels that show only a capture stay as captured."""
    aovs: tuple[str, ...] = given(converter=_checked_aovs, default=())
    """Further layers of the frame. Lit frames have ``albedo``, ``emission``, ``reflection``, ``lights``, ``hits``,
    ``variance``, ``sample_count`` and ``shadow_ratio``; unlit frames have ``hits``, ``variance`` and ``sample_count``.
    Path-traced frames have ``direct_diffuse``, ``indirect_diffuse``, ``direct_glossy``, ``indirect_glossy`` and
    ``bounces`` in place of ``reflection``. Real-time frames have all of these but ``reflection``, ``lights``,
    ``variance``, ``sample_count`` and ``bounces``, and also ``motion``, ``history``, ``probes``, ``cache`` and
    ``cache_cells``. A text with commas becomes a tuple."""
    samples: Annotated[int, Range(1, SAMPLES_MAX)] | None = None
    """Samples a pixel, whose mean is the frame; real-time frames always have 1. None: as many as ``time_limit`` or
    ``noise`` need, if given. Otherwise 64 for lit path-traced frames; 16 for an environment, soft shadows of lights
    that have a size, ``glossy_reflections``, or translucent meshes in raster frames; 8 for an environment or
    ``glossy_reflections`` on captures alone; else 1. An unlit, sorted raster frame is exact with one sample and takes
    no more, except with ``UNSCENTED``, which samples antialias."""
    time_limit: Annotated[float, Range(0.0, unit="seconds", above=True)] | None = None
    """Time for the samples of a frame, which takes at least one. ``samples`` limits their number, too, unless None.
    None: no limit."""
    noise: Annotated[float, Range(0.0, 1.0, above=True, below=True)] | None = None
    """Relative error at which sampling stops: 95 % of the pixels are estimated to be below it
    (docs/method/samples.md). ``samples`` limits the number of samples, too, unless None. None: sampling does not depend
    on noise."""
    adaptive: bool | None = None
    """Gives noisy pixels more samples than others, at most ``samples``, from the 17th sample on. Trace and path
    pipelines only. None: if ``noise`` is given."""
    glossy_reflections: bool | None = None
    """Lets rough metals and glossy surfaces reflect the scene in lit trace and hybrid frames, unless ``max_bounces`` is
    0; otherwise they reflect lights and the environment only. Each sample traces one ray from the first surface, and
    several samples average its noise. None: if the scene has a rough metal and another object. Path-traced and
    real-time frames do not read it: there, such surfaces always reflect the scene."""
    capture_gain: Annotated[float, Range(-CAPTURE_GAIN_MAX, CAPTURE_GAIN_MAX, "stops")] = 0.0
    """Brightening of the light that captures cast onto other surfaces, as captured light sources are clipped at
    display white. Captures themselves stay as they are, in mirrors as well. Applies where captures light surfaces: in
    paths, real time, glossy reflections, and on meshes in scenes without lights. `estimate_capture_gain` estimates a
    value."""
    energy_compensation: bool = False
    """Restores the energy that single scattering between the microfacets of rough metals loses, in lit frames. Off as
    in glTF's own viewer: white metal of roughness 1 then reflects half of the light."""
    jitter: bool = True
    """Spreads samples after the first over their pixel, which antialiases; the first goes through its centre. Applies
    in all pipelines wherever ``samples`` does. In scenes with captures that keep their captured colours, only meshes
    are jittered unless ``samples``, ``noise`` or ``time_limit`` is given. In real time, frames are jittered with
    ``realtime.antialiasing``."""
    seed: Seed = 0
    """Seed of all random numbers: the same seed gives the same image."""
    max_bounces: Annotated[int, Range(0, BOUNCES_MAX)] | None = None
    """Bounces of a ray at most. Trace and hybrid pipelines count reflections, refractions and passes through
    translucent meshes, behind which a ray sees the background. The path pipeline counts bounces of any kind, where 0 is
    direct light. The real-time pipeline counts bounces off smooth surfaces; 0 also switches off its indirect light.
    None: 8 in the path pipeline, else 3."""

    __post_init__ = take_fields

    def is_lit(self, *, by_default: bool) -> bool:
        """Returns whether lights illuminate the frames of a scene.

        Args:
            by_default: Whether the scene itself asks for light: `Scene.is_lit_by_default`.
        """
        return by_default or self.pipeline.bounces_light if self.lighting is None else self.lighting

    def unused_settings(self, *, lit: bool) -> dict[str, str]:
        """Returns the settings and groups without effect on frames, each with the condition that would give it one.

        Args:
            lit: Whether frames are lit: `is_lit`.
        """
        unused = {name: _readers(pipelines) for name, pipelines in READ_BY.items() if self.pipeline not in pipelines}
        if not self.pipeline.spawns_rays and not (lit and self.shadows is not Shadows.OFF):
            unused["response"] = "Used where rays are traced: with shadows, or by other pipelines than raster."
        is_exact = self.raster.strategy is RasterStrategy.SORTED and self.raster.projection is Projection.EWA
        if not self.pipeline.spawns_rays and not lit and is_exact:
            unused |= dict.fromkeys(READ_IF_SAMPLED, "Used in lit frames, and by other pipelines than raster.")
        if self.shadows is Shadows.OFF:
            unused["shadow_rays"] = "Used with shadows, hard or soft."
        if self.shadow_rays.method is ShadowMethod.STOCHASTIC and self.shadow_rays.shared_draws:
            names = ("shadow_rays.color_strength", "shadow_rays.transmittance_threshold")
            unused |= dict.fromkeys(names, "Used without shadow_rays.shared_draws, whose rays know no transmittance.")
        if not lit:
            unused |= dict.fromkeys(READ_IF_LIT, "Used in lit frames: add a light, or switch lighting on.")
        return unused


def _readers(pipelines: tuple[Pipeline, ...]) -> str:
    names = [pipeline.value for pipeline in pipelines]
    return f"Used by the pipeline{'s' * (len(names) > 1)} {', '.join(names)}."
