"""Settings of lights that are estimated from a capture, and of the light of avatars in it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from lumisplat.config.checks import check_flag, check_kind, check_range, check_whole
from lumisplat.config.relighting import RelightConfig
from lumisplat.config.renamed import refuse_renamed
from lumisplat.config.shadow_maps import DeepShadowConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class LightEstimationConfig:
    """Settings of `estimate_lights`.

    Lengths that are None follow from the extent of the scene: ``radius`` if that is given, else the distance from the
    character within which 98 % of the Gaussians lie.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    radius: float | None = None
    """Gaussians farther from the character's centre are ignored, scene units, 1e-6..1e9; None: 1.5 extents."""
    viewpoint_distance: float | None = None
    """Distance of the four outer viewpoints from the character's centre, scene units, 1e-6..1e9; None: a tenth of the
    extent."""
    emitter_size: float | None = None
    """Largest size of a compact emitter, scene units, 1e-6..1e9; None: a twelfth of the extent. Gaussians nearer to the
    character's centre than this are no lights."""
    separation: float | None = None
    """Least distance between two lights, scene units, 1e-6..1e9; None: three times ``emitter_size``."""
    compactness: float = 0.5
    """Share of its score by which a light must exceed its surroundings, 0..1; at 0, bright walls and windows count as
    lights, too."""
    weakest: float = 0.05
    """Gaussians whose score is below this share of the best are no lights, 0..1."""
    evidence: float = 0.05
    """Share of the light on surfaces around, beyond what smooth surroundings explain, that a light must explain, 0..1;
    twice that for what is low or broad. At 0, what is bright counts as a light, whether it lights anything or not."""
    irradiance: float = math.pi
    """Irradiance that all lights together give a surface at the character's centre which faces each of them,
    1e-6..1e6: with pi, white paper is white."""

    def __post_init__(self) -> None:
        for name in ("radius", "viewpoint_distance", "emitter_size", "separation"):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name), 1e-6, 1e9)
        check_range("compactness", self.compactness, 0.0, 1.0)
        check_range("weakest", self.weakest, 0.0, 1.0)
        check_range("evidence", self.evidence, 0.0, 1.0)
        check_range("irradiance", self.irradiance, 1e-6, 1e6)


@refuse_renamed
@dataclass(frozen=True, slots=True, kw_only=True)
class AvatarLightingConfig:
    """Settings of an `AvatarLighter`.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    shadows: bool = True
    """Whether actors darken the captured scene."""
    shadow_map: DeepShadowConfig = field(default_factory=DeepShadowConfig)
    """Settings of the deep shadow map of each light."""
    direct: float = 0.7
    """Share of a receiver's light that comes from the lights, 0..1: the rest is never in shadow. With 1 and one light,
    shadows are as in Mir et al. (2026), black where no light passes."""
    relight: bool = True
    """Whether actors take on the light of the place where they are."""
    sun_on_actors: bool = True
    """Whether suns that are given light actors made of Gaussians, too, with the irradiance that they have (pi: white
    paper that faces them is white), where the scene does not block them, and beyond what the probe holds of them."""
    transfer: RelightConfig = field(default_factory=RelightConfig)
    """How a probe's light changes the colours of actors."""
    light_count: int = 3
    """Lights that are estimated if none are given, 1..64."""
    estimation: LightEstimationConfig = field(default_factory=LightEstimationConfig)
    """How lights are estimated."""

    def __post_init__(self) -> None:
        check_flag("shadows", self.shadows)
        check_kind("shadow_map", self.shadow_map, DeepShadowConfig)
        check_range("direct", self.direct, 0.0, 1.0)
        check_flag("relight", self.relight)
        check_flag("sun_on_actors", self.sun_on_actors)
        check_kind("transfer", self.transfer, RelightConfig)
        check_whole("light_count", self.light_count, 1, 64)
        check_kind("estimation", self.estimation, LightEstimationConfig)
