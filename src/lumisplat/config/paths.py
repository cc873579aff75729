"""Settings of paths of light."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from lumisplat.config.checks import take_enum


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

    def __post_init__(self) -> None:
        take_enum(self, "primary", PathPrimary)
