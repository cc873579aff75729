"""Options of the ray tracer, and what of the options a pipeline does not use."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, arg

import lumisplat as ls
from lumisplat.cli.options import Flag

_log = logging.getLogger("lumisplat")

PipelineName = Literal["raster", "trace"]
StrategyName = Literal["sorted", "stochastic-hit", "stochastic-pass"]


@dataclass(frozen=True, kw_only=True)
class TraceOptions:
    """Settings of `lumisplat.TraceConfig` and of the rays of a frame, under the same names."""

    strategy: StrategyName = "sorted"
    """sorted: all Gaussians on a ray in order, without noise. stochastic-hit: one of them by chance, the fastest.
    stochastic-pass: a few of them by chance. Chance averages out over --samples."""
    samples: Annotated[int, arg(metavar="N")] = 1
    """Rays a pixel; more antialias, and take out the noise of chance."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Another one gives other noise, the same one the same image."""
    max_bounces: Annotated[int, arg(metavar="N")] = 3
    """Reflections and refractions that a ray follows."""
    kernel_degree: Annotated[int | None, arg(metavar="0..5", help_behavior_hint="")] = None
    """Shape of the Gaussians: 0 linear, 2 Gaussian, 4 as NVIDIA trains for rays. Without: as each capture says."""
    min_response: Annotated[float, arg(metavar="0..0.97")] = 0.0
    """Gaussians end where their response times opacity falls to this, if they do not at 1/255 before."""
    hit_distance: Literal["peak", "hull"] = "peak"
    """Where a ray hits a Gaussian: at its largest response, or where it enters it."""
    normals: Literal["plane", "ellipsoid"] = "plane"
    """Normal of a Gaussian: of its plane of largest density, or of its ellipsoid where the ray enters."""
    hits_per_pass: Literal[4, 8, 16, 32] = 16
    """Gaussians that a ray collects at once."""
    no_jitter: Flag = False
    """All samples through the centre of the pixel: edges stay hard."""

    def config(self, *, sh_degree: int, transmittance_min: float) -> ls.TraceConfig:
        """The settings of the ray tracer.

        Raises:
            ConfigError: A value is out of its range.
        """
        return ls.TraceConfig(
            strategy=ls.TraceStrategy(self.strategy),
            hits_per_pass=self.hits_per_pass,
            kernel_degree=self.kernel_degree,
            min_response=self.min_response,
            hit_distance=ls.HitDistance(self.hit_distance),
            normal_method=ls.NormalMethod(self.normals),
            sh_degree=sh_degree,
            transmittance_min=transmittance_min,
            jitter=not self.no_jitter,
        )

    def given(self) -> list[str]:
        """The options that are not at their defaults, as they are typed."""
        return [f"--{f.name.replace('_', '-')}" for f in fields(self) if getattr(self, f.name) != f.default]


TraceGroup = Annotated[TraceOptions, arg(name="ray tracer"), OmitArgPrefixes]
"""A field of a command that shows its options in a group of their own."""


def warn_unused(options: Iterable[str], pipeline: PipelineName) -> None:
    """Logs one line about options that were given and that ``pipeline`` does not use, if there are any."""
    listed = ", ".join(options)
    if listed:
        other = "trace" if pipeline == "raster" else "raster"
        _log.warning("not used by --pipeline %s: %s (they are of --pipeline %s)", pipeline, listed, other)
