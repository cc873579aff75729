"""Settings of light in captures: deep shadow maps, relighting, lights that are estimated, and the light of avatars."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import Range
from lumisplat.config.setting import Length, Seed, Share, take_fields


class Absorption(Enum):
    """How a Gaussian's opacity becomes absorption per length (docs/method/deep_shadow_maps.md#absorption).

    With optical depth ``tau = -ln(1 - opacity)``, precision ``A`` and scales ``s``. ``MASS`` and ``DIAGONAL``, the
    paper's ``mass`` and ``diag``, have the covariance in place of the precision, and are one formula, as
    ``sqrt(det(covariance))`` is the product of the scales.
    """

    SIMPLE = "simple"
    """``tau``: wide Gaussians absorb more."""
    AVERAGE = "avg"
    """``tau sqrt(tr(A) / 3) / sqrt(2 pi)``: about the splat's own opacity, whatever its size."""
    MASS = "mass"
    """``tau / ((2 pi)^(3/2) sqrt(det(covariance)))``: the same mass for all, so that small Gaussians are black."""
    DIAGONAL = "diag"
    """``tau / ((2 pi)^(3/2) s_x s_y s_z)``: as ``MASS``."""


class AtlasLayout(Enum):
    """How the directions around a light are laid out in a deep shadow map."""

    OCTAHEDRAL = "octahedral"
    """One square, without seams."""
    CUBEMAP = "cubemap"
    """Six faces, with as many texels in all."""


class ReceiverSampling(Enum):
    """Where a deep shadow map is read for a Gaussian that receives shadow."""

    CENTER = "center"
    """At its mean."""
    STENCIL = "stencil"
    """At its mean and one scale along each axis, 7 points."""
    MONTE_CARLO = "monte-carlo"
    """At ``samples`` random points of it, which depend on its index and ``seed`` alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeepShadowConfig:
    """Settings of a deep Gaussian shadow map.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    layout: AtlasLayout = AtlasLayout.OCTAHEDRAL
    """How directions are laid out; a map of parallel light is a plane instead."""
    resolution: Annotated[int, Range(8, 8192, step=8)] = 2048
    """Texels across and down."""
    bins: Annotated[int, Range(1, 4096)] = 256
    """Bins of distance from the light, K, evenly from 0 to ``max_distance``."""
    max_distance: Length | None = None
    """Distance at which the bins end; None: behind all receivers, or without receivers, behind
    all casters."""
    absorption: Absorption = Absorption.AVERAGE
    """How opacity becomes absorption."""
    strength: Annotated[float, Range(0.0, 100.0)] = 1.0
    """Factor kappa of the absorption."""
    region: bool = True
    """Whether only the texels and bins that receivers read are tabulated."""
    region_radius: Length | None = None
    """Receivers farther than this from the box around the casters along x, y or z are left out:
    they stay lit, except where a map that is used by itself holds the texels of nearer receivers. None: none is left
    out."""
    culling: bool = True
    """Whether each tile has a list of the casters that its rays can hit, instead of testing all of them."""
    sampling: ReceiverSampling = ReceiverSampling.MONTE_CARLO
    """Where the map is read for a receiver."""
    samples: Annotated[int, Range(1, 1024)] = 8
    """Points at which the map is read for a receiver, with ``MONTE_CARLO``."""
    seed: Seed = 0
    """Seed of these points."""

    __post_init__ = take_fields


class NormalEstimate(Enum):
    """Where normals of Gaussians come from."""

    AUTO = "auto"
    """The set's own ``normals``; a set without any uses `SMALLEST_AXIS`."""
    SMALLEST_AXIS = "smallest-axis"
    """Each Gaussian's thinnest axis: sharp, and noisy where Gaussians are round."""
    PCA = "pca"
    """Normal of the plane through the neighbouring means, weighted by opacity and distance: smooth, and blunt at
    edges."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelightConfig:
    """Settings of the transfer of a probe's light to Gaussians (docs/method/relighting.md#transfer).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    exponent: Annotated[float, Range(0.1, 64.0)] = 1.0
    """Exponent q of the cosine lobe about the normal that gathers light: 1 is matt, more is glossier."""
    scale_max: Annotated[float, Range(0.0, 1000.0)] = 4.0
    """Largest factor t_max of a Gaussian's colour, before ``gamma``."""
    gamma: Annotated[float, Range(0.0, 1000.0)] = 1.0
    """Linear factor of all light. At 1, surroundings of radiance 1 (display white) leave colours as they
    are."""
    normals: NormalEstimate = NormalEstimate.AUTO
    """Where normals come from if none are given."""
    rows: Annotated[int, Range(8, 128)] = 16
    """Rows of the latitude-longitude grid, twice as wide as high, over which light is summed: with 16, the sum
    is within 1 % of that over a fine grid, for probes of degree 3 and any exponent."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class DelightConfig:
    """Settings of the separation of a capture into materials and light (docs/method/delighting.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    cells: Annotated[int, Range(4, 32)] = 12
    """The light at each Gaussian is traced in so many times so many cells of all directions."""
    inside: bool | None = None
    """Whether the capture was taken from inside of it, as a room is; None: if a good part of it sees no sky."""
    matt: bool = False
    """Whether the materials that will relight the capture are matt (``MaterialPbr(specular=0)``): then all that it
    shows is of the albedo. Else they are as `MaterialPbr` has them, and what such a surface mirrors is not."""
    seed: Seed = 0
    """Of rays and of which Gaussians are compared."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class LightEstimationConfig:
    """Settings of `estimate_lights`.

    Lengths that are None follow from the extent of the scene: ``radius`` if that is given, else the distance from the
    character within which 98 % of the Gaussians lie.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    radius: Length | None = None
    """Gaussians farther from the character's centre are ignored; None: 1.5 extents."""
    viewpoint_distance: Length | None = None
    """Distance of the four outer viewpoints from the character's centre; None: a tenth of the
    extent."""
    emitter_size: Length | None = None
    """Largest size of a compact emitter; None: a twelfth of the extent. Gaussians nearer to the
    character's centre than this are no lights."""
    separation: Length | None = None
    """Least distance between two lights; None: three times ``emitter_size``."""
    compactness: Share = 0.5
    """Share of its score by which a light must exceed its surroundings; at 0, bright walls and windows count as
    lights, too."""
    weakest: Share = 0.05
    """Gaussians whose score is below this share of the best are no lights."""
    evidence: Share = 0.05
    """Share of the light on surfaces around, beyond what smooth surroundings explain, that a light must explain;
    twice that for what is low or broad. At 0, what is bright counts as a light, whether it lights anything or not."""
    irradiance: Annotated[float, Range(1e-6, 1e6)] = math.pi
    """Irradiance that all lights together give a surface at the character's centre which faces each of them:
    with pi, white paper is white."""

    __post_init__ = take_fields


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
    direct: Share = 0.7
    """Share of a receiver's light that that comes from the lights: the rest is never in shadow. With 1 and one light,
    shadows are as in Mir et al. (2026), black where no light passes."""
    relight: bool = True
    """Whether actors take on the light of the place where they are."""
    sun_on_actors: bool = True
    """Whether suns that are given light actors made of Gaussians, too, with the irradiance that they have (pi: white
    paper that faces them is white), where the scene does not block them, and beyond what the probe holds of them."""
    transfer: RelightConfig = field(default_factory=RelightConfig)
    """How a probe's light changes the colours of actors."""
    light_count: Annotated[int, Range(1, 64)] = 3
    """Lights that are estimated if none are given."""
    estimation: LightEstimationConfig = field(default_factory=LightEstimationConfig)
    """How lights are estimated."""

    __post_init__ = take_fields
