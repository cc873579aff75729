"""Settings of light in captures: deep shadow maps, relighting, estimated lights and materials, and avatars."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

from lumisplat.config.checks import Range
from lumisplat.config.setting import Length, Seed, Share, take_fields


class Absorption(Enum):
    """Absorption per length of a Gaussian with a given opacity (docs/method/deep_shadow_maps.md#absorption).

    The optical depth is ``tau = -ln(1 - opacity)``, the precision matrix ``A`` and the scales ``s``. ``MASS`` and
    ``DIAGONAL``, called ``mass`` and ``diag`` by Mir et al. 2026, use the covariance in place of the precision. Both
    are one formula, as ``sqrt(det(covariance))`` is the product of the scales.
    """

    SIMPLE = "simple"
    """Optical depth ``tau = -ln(1 - opacity)`` per unit of length: wide Gaussians absorb more."""
    AVERAGE = "avg"
    """``tau sqrt(tr(A) / 3) / sqrt(2 pi)`` with ``tau = -ln(1 - opacity)`` and the precision matrix ``A``: about the
    splat's own opacity, whatever its size."""
    MASS = "mass"
    """``tau / ((2 pi)^(3/2) sqrt(det(covariance)))`` with ``tau = -ln(1 - opacity)``: equal mass for all, so that
    small Gaussians are black."""
    DIAGONAL = "diag"
    """``tau / ((2 pi)^(3/2) s_x s_y s_z)`` with ``tau = -ln(1 - opacity)`` and the scales ``s``: equals ``MASS``."""


class AtlasLayout(Enum):
    """How the directions around a point light are laid out in the atlas of a deep shadow map."""

    OCTAHEDRAL = "octahedral"
    """One square: the octahedral map of the sphere, without seams."""
    CUBEMAP = "cubemap"
    """Six faces of a cube, with about as many texels together as the one square of ``OCTAHEDRAL``."""


class ReceiverSampling(Enum):
    """Points at which a deep shadow map is read for a Gaussian that receives shadow."""

    CENTER = "center"
    """Mean of the Gaussian."""
    STENCIL = "stencil"
    """Mean of the Gaussian, and one scale along each axis to both sides: 7 points."""
    MONTE_CARLO = "monte-carlo"
    """Random points of the Gaussian, ``samples`` of them, which depend on its index and ``seed`` alone."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeepShadowConfig:
    """Settings of a deep Gaussian shadow map.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    layout: AtlasLayout = AtlasLayout.OCTAHEDRAL
    """Layout of the directions around a point light; a directional light has a planar map instead."""
    resolution: Annotated[int, Range(8, 8192, step=8)] = 2048
    """Width and height of the square map, texels; the six faces of ``CUBEMAP`` have about as many texels together.
    Lights with an extent take 0.7 times as many across."""
    bins: Annotated[int, Range(1, 4096)] = 256
    """Number of distance bins, K, which are of equal size from 0 to ``max_distance``."""
    max_distance: Length | None = None
    """Distance at which the last bin ends: from a point light or, with a directional light, from a plane in front of
    the receivers. None: behind all receivers, or without receivers, behind all casters."""
    absorption: Absorption = Absorption.AVERAGE
    """Formula from a Gaussian's opacity to its absorption per length."""
    strength: Annotated[float, Range(0.0, 100.0)] = 1.0
    """Factor kappa that multiplies the absorption of all casters; 0 casts no shadows."""
    region: bool = True
    """Computes only the texels and bins that the receivers look up; otherwise the whole map. Lights with an extent take
    those that casters cover."""
    region_radius: Length | None = None
    """Receivers farther than this from the casters' bounding box, along x, y or z, stay lit. A `DeepShadowMap` only
    fits its texels to the others, so such a receiver is still shadowed where it looks up their texels. None: no limit.
    """
    culling: bool = True
    """Lists the casters that the rays of each tile of the map can hit; otherwise each ray tests all casters."""
    sampling: ReceiverSampling = ReceiverSampling.MONTE_CARLO
    """Points of a Gaussian that receives shadow at which the map is read."""
    samples: Annotated[int, Range(1, 1024)] = 8
    """Number of random points per Gaussian that receives shadow at which ``MONTE_CARLO`` reads the map. Lights with an
    extent take four rays for each."""
    seed: Seed = 0
    """Seed of the points of ``MONTE_CARLO``."""

    __post_init__ = take_fields


class NormalEstimate(Enum):
    """Source of the normals of Gaussians."""

    AUTO = "auto"
    """The set's own ``normals``, or without them `SMALLEST_AXIS`."""
    SMALLEST_AXIS = "smallest-axis"
    """Thinnest axis of each Gaussian: sharp, but noisy where Gaussians are round."""
    PCA = "pca"
    """Normal of the plane through neighbouring means, weighted by opacity and distance: smooth, but blunt at edges."""
    SMOOTH = "smooth"
    """Thinnest axes, averaged over neighbours on the same side: the smoothest, for highlights on captures."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelightConfig:
    """Settings of the transfer of a light probe's radiance to Gaussians (docs/method/relighting.md#transfer).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    exponent: Annotated[float, Range(0.1, 64.0)] = 1.0
    """Exponent q of the cosine lobe about the normal that gathers light: 1 is matt, more is glossier."""
    scale_max: Annotated[float, Range(0.0, 1000.0)] = 4.0
    """Upper bound t_max of the factor by which light multiplies a Gaussian's colour, before ``gamma``."""
    gamma: Annotated[float, Range(0.0, 1000.0)] | None = None
    """Linear factor of all light: at 1, an environment of radiance 1 (display white) leaves colours unchanged. None:
    `AvatarLighter` estimates it for each actor, so that the actor is as bright as its surroundings; `relight` takes 1.
    """
    normals: NormalEstimate = NormalEstimate.AUTO
    """Source of the normals, if none are given."""
    rows: Annotated[int, Range(8, 128)] = 16
    """Rows of the latitude-longitude grid, twice as wide as high, over which light is summed. With 16 rows, the sum is
    within 1 % of that over a fine grid, for probes of degree 3 and any exponent."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class DelightConfig:
    """Settings of the separation of a capture into materials and light (docs/method/delighting.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    cells: Annotated[int, Range(4, 32)] = 12
    """Cells along each side of the map of directions in which the light at each Gaussian is traced."""
    inside: bool | None = None
    """Treats the capture as taken from its inside, like a room. None: only if more than a tenth of the Gaussians do not
    see the environment from either side."""
    matt: bool = False
    """Assumes that the materials that will relight the capture are matt (``MaterialPbr(specular=0)``), so that all
    captured colour comes from the albedo, and no roughness is estimated. Otherwise the specular reflection of a default
    `MaterialPbr` is not part of the albedo."""
    seed: Seed = 0
    """Seed of the rays, and of the random pairs of Gaussians whose albedos are compared."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class LightEstimationConfig:
    """Settings of `estimate_lights`.

    Lengths that are None follow from the extent of the scene. The extent is ``radius`` if that is given, else the
    distance from the character within which 98 % of the Gaussians lie.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    radius: Length | None = None
    """Distance from the character's centre beyond which Gaussians are ignored; it also is the extent in the defaults of
    the other lengths. None: 1.5 times the extent of the scene, the distance within which 98 % of the Gaussians lie."""
    viewpoint_distance: Length | None = None
    """Distance from the character's centre to four viewpoints around it, from which, as from the centre, the brightness
    of Gaussians is evaluated. None: a tenth of the extent (see ``radius``)."""
    emitter_size: Length | None = None
    """Largest size of an emitter that counts as compact. Gaussians nearer to the character's centre than this are no
    lights. None: a twelfth of the extent (see ``radius``)."""
    separation: Length | None = None
    """Smallest distance between two lights. None: three times ``emitter_size``."""
    compactness: Share = 0.5
    """Smallest contrast of a compact light: 1 minus the score (brightness) of the Gaussians around it over its own.
    Lights that are not compact, such as bright walls and windows, need twice the ``evidence``, and are no lights where
    ``evidence`` is 0. At 0, every light counts as compact."""
    weakest: Share = 0.05
    """Smallest score (brightness) of a Gaussian that may be a light, as a fraction of the highest score."""
    evidence: Share = 0.05
    """Smallest fraction of the luminance variance of nearby surfaces, left by a smooth environment and earlier lights,
    that a light explains. Lights that are not above the character, or not compact, must explain twice as much. At 0,
    anything bright and compact counts as a light, whether or not it lights surfaces."""
    irradiance: Annotated[float, Range(1e-6, 1e6)] = math.pi
    """Irradiance that the estimated lights together give a surface at the character's centre that faces each of them.
    With pi, white paper is display white. An `AvatarLighter` ignores it: its lights give the fraction ``direct`` of the
    light that it measures there."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class AvatarLightingConfig:
    """Settings of an `AvatarLighter`.

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    shadows: bool = True
    """Casts shadows of actors and of the scene's meshes onto the captured scene."""
    shadow_map: DeepShadowConfig = field(default_factory=DeepShadowConfig)
    """Settings of the deep shadow map of each light."""
    direct: Share = 0.7
    """Fraction of the light on the captured scene that comes from the lights; the rest is never in shadow. With 1 and
    one light, shadows equal those of Mir et al. (2026): black where no light passes."""
    relight: bool = True
    """Relights actors by the light at their position."""
    lights_on_actors: bool = True
    """Lights actors made of Gaussians by given lights, too, with the lights' own irradiance (pi: white paper that faces
    them is display white). The scene can block lights, and actors shadow each other and themselves; the part of a light
    that the light probe already holds is not added again."""
    transfer: RelightConfig = field(default_factory=RelightConfig)
    """Settings of the transfer of a light probe's radiance to actors."""
    light_count: Annotated[int, Range(1, 64)] = 3
    """Largest number of lights that are estimated if none are given. Where no light is found, one sun is estimated."""
    estimation: LightEstimationConfig = field(default_factory=LightEstimationConfig)
    """Settings of the estimated lights."""

    __post_init__ = take_fields
