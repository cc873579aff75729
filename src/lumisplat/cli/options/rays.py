"""Options of rays: samples, mirrors and glass, and how rays hit Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.options.command import Flag
from lumisplat.cli.options.settings import Changes, setting, without_none

PipelineName = Literal["raster", "trace", "hybrid", "path", "realtime"]
_ADAPTIVE = {"auto": None, "on": True, "off": False}
QualityName = Literal["preview", "balanced", "high"]
StrategyName = Literal["sorted", "stochastic-hit", "stochastic-pass"]


@dataclass(frozen=True, kw_only=True)
class RayOptions:
    """Settings of `lumisplat.TraceConfig` and `lumisplat.ResponseConfig`, and of the samples of a frame."""

    strategy: Annotated[StrategyName | None, setting("{sorted,stochastic-hit,stochastic-pass}", "sorted")] = None
    """sorted: all Gaussians on a ray in order, without noise. stochastic-hit: a random one of them, the fastest.
    stochastic-pass: a random few of them. --samples average the noise."""
    samples: Annotated[int | Literal["auto"] | None, setting("N", "auto")] = None
    """Rays a pixel; more of them smooth edges and average noise. auto: 64 paths; else as many as random light needs, 16
    under an environment (8 for captures alone) and for soft shadows of lights that have a size, else 1."""
    time: Annotated[float | Literal["off"] | None, setting("SECONDS", "off")] = None
    """Take samples for so long, for each frame; --samples are then the most of them."""
    noise: Annotated[float | Literal["off"] | None, setting("0..1", "off")] = None
    """Take samples until 95 % of the pixels have at most this relative error, such as 0.02; --samples are then the most
    of them. Noisy pixels get more of them than others, see --adaptive."""
    adaptive: Annotated[Literal["auto", "on", "off"] | None, setting("{auto,on,off}", "auto")] = None
    """Whether noisy pixels have more samples than others, with --pipeline trace and path; auto: with --noise."""
    seed: Annotated[int | None, setting("N", "0")] = None
    """Another one gives other noise, the same one the same image."""
    max_bounces: Annotated[int | Literal["auto"] | None, setting("N", "auto")] = None
    """Reflections and refractions that a ray follows, or bounces of a path: 0 is direct light. auto: 3, of paths 8."""
    primary: Annotated[Literal["particle", "iso"] | None, setting("{particle,iso}", "particle")] = None
    """What paths meet first where the camera sees relit Gaussians. particle: one of them, drawn by opacity. iso: their
    blended surface, as in the other pipelines."""
    quality: Annotated[QualityName | None, setting("{preview,balanced,high}", "balanced")] = None
    """Of frames in real time. preview: the quickest. high: more probes, and light averaged over more frames. Settings
    of the scene file that differ from the defaults stay."""
    glossy_reflections: Flag = False
    """Let rough surfaces reflect what is around them, not lights alone. Default: where there is a rough metal."""
    no_glossy_reflections: Flag = False
    """Let rough metals reflect lights and the environment alone: less noise, and fewer samples by default."""
    kernel_degree: Annotated[int | None, arg(metavar="0..5", help_behavior_hint="")] = None
    """Shape of the Gaussians: 0 linear, 2 Gaussian, 4 as NVIDIA trains for rays. Without: as each capture says."""
    min_response: Annotated[float | None, setting("0..0.97", "0.0")] = None
    """Gaussians end where their response times opacity falls to this, if they do not at 1/255 before."""
    hit_distance: Annotated[
        Literal["auto", "mean", "peak", "hull"] | None, setting("{auto,mean,peak,hull}", "auto")
    ] = None
    """Where a ray hits a Gaussian, which decides what hides what. mean: at its centre, as captures are trained. peak:
    at its largest response, better for large ones that cross. hull: where the ray enters it. auto: mean for what is
    as captured, peak for what is relit. peak and hull also decide which Gaussians are the first for --shadow-method
    first-hits."""
    normals: Annotated[Literal["plane", "ellipsoid"] | None, setting("{plane,ellipsoid}", "plane")] = None
    """Normal of a Gaussian: of its plane of largest density, or of its ellipsoid where the ray enters."""
    acceptance_scale: Annotated[float | None, setting("0.001..1", "1.0")] = None
    """Of stochastic-hit: below 1 it accepts sooner, which is faster and too opaque."""
    no_adaptive_clamping: Flag = False
    """--min-response limits the response alone, not the response times the opacity."""
    hits_per_pass: Annotated[Literal[4, 8, 16, 32] | None, setting("{4,8,16,32}", "16")] = None
    """Gaussians that a ray collects at once."""
    no_jitter: Flag = False
    """All samples through the centre of the pixel: edges stay hard."""

    def changes(self) -> Changes:
        """The settings that were given."""
        hit_distance = ls.HitDistance(self.hit_distance) if self.hit_distance not in (None, "auto") else None
        frame = {
            "samples": None if self.samples == "auto" else self.samples,
            "glossy_reflections": self._glossy(),
            "jitter": False if self.no_jitter else None,
            "seed": self.seed,
            "max_bounces": None if self.max_bounces == "auto" else self.max_bounces,
        }
        groups = {
            "trace": {
                "strategy": self.strategy and ls.TraceStrategy(self.strategy),
                "hits_per_pass": self.hits_per_pass,
                "hit_distance": hit_distance,
                "normal_method": self.normals and ls.NormalMethod(self.normals),
                "acceptance_scale": self.acceptance_scale,
            },
            "path": {"primary": self.primary and ls.PathPrimary(self.primary)},
            "realtime": {"quality": self.quality and ls.RealtimeQuality(self.quality)},
            "response": {
                "kernel_degree": self.kernel_degree,
                "min_response": self.min_response,
                "adaptive_clamping": False if self.no_adaptive_clamping else None,
            },
            "shadow_rays": {"hit_distance": None if hit_distance is ls.HitDistance.MEAN else hit_distance},
        }
        changes = without_none(frame) | {name: without_none(group) for name, group in groups.items()}
        if self.samples == "auto":
            changes["samples"] = None
        for setting_name, value in (("time_limit", self.time), ("noise", self.noise)):
            if value is not None:
                changes[setting_name] = None if value == "off" else value
        if self.adaptive is not None:
            changes["adaptive"] = _ADAPTIVE[self.adaptive]
        if self.hit_distance == "auto":
            changes["trace"]["hit_distance"] = None
        return changes

    def _glossy(self) -> bool | None:
        """Whether glossy reflections were asked for; None: neither option was given.

        Raises:
            ConfigError: Both were.
        """
        if self.glossy_reflections and self.no_glossy_reflections:
            raise ls.ConfigError("--glossy-reflections and --no-glossy-reflections do not go together")
        return True if self.glossy_reflections else False if self.no_glossy_reflections else None


RayGroup = Annotated[RayOptions, arg(name="ray"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""
