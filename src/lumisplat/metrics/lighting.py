"""Agreement of the light on an avatar with that on its surroundings (docs/method/relighting.md#metrics).

No ground truth is needed. Avatar and scene are `LitPoints`, or Gaussians from which points are made. Only the part of
the scene within a radius of the mean of the avatar's points counts. docs/adr/0015-lighting-metrics.md lists the choices
that the paper leaves open.
"""

from __future__ import annotations

import numpy as np

from lumisplat.config import check_whole
from lumisplat.constants.metrics import CHROMATICITY_SAMPLES_MAX, NEIGHBOURHOOD_RADIUS
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray
from lumisplat.metrics.chromaticity import lab
from lumisplat.metrics.extras import import_extra
from lumisplat.metrics.irradiance_fit import fit_irradiance, robust_fit
from lumisplat.metrics.lit_points import Lit, LitPoints, check_radius

Points = LitPoints | Lit


def paa_y(avatar: Points, scene: Points, *, radius: float = NEIGHBOURHOOD_RADIUS) -> float:
    """Probe-avatar agreement in luminance: L1 distance between the irradiance on the avatar and that on the scene.

    ``PAA-Y = ||c_avatar - c_scene||_1``, where c are the 16 SH coefficients of irradiance (L = 3) that explain
    luminance by normals, ``Y_i = alpha_i E(n_i; c)``. Each c is scaled to ``||c||_1 = 1``, because only its product
    with alpha is known. Huber's loss, 5 % trimmed. Source: Mir et al. 2026, section 4.1 (1).

    Args:
        avatar: Its points or Gaussians, world space.
        scene: Those of the scene.
        radius: How far from the avatar's centre the scene counts, metres.

    Returns:
        0..2, without unit, the lower the better; 0: the same light up to its intensity.

    Raises:
        ConfigError: ``radius`` is not above 0.
        SceneError: No part of the scene is near, or there are too few points, or only black ones.
    """
    figure, surroundings = _sides(avatar, scene, radius)
    own = fit_irradiance(figure.normals, figure.luminance, "avatar points")
    wanted = fit_irradiance(surroundings.normals, surroundings.luminance, "scene points near the avatar")
    return float(np.abs(own.coefficients - wanted.coefficients).sum())


def apf_y(avatar: Points, scene: Points, *, radius: float = NEIGHBOURHOOD_RADIUS) -> float:
    """Avatar photometric fit in luminance: error with which the scene's light predicts the avatar's shading.

    ``APF-Y = mean |Y_a - (s E(n_a; c_scene) + b)|`` over all points of the avatar, with c_scene as in `paa_y`, and s
    and b fitted to the avatar with the same robust loss. Source: Mir et al. 2026, section 4.1 (2).

    Args:
        avatar: Its points or Gaussians, world space.
        scene: Those of the scene.
        radius: How far from the avatar's centre the scene counts, metres.

    Returns:
        At least 0, in luminance (white is 1), the lower the better. It grows with the brightness and the contrast of
        the avatar's own colours: compare values of one avatar only.

    Raises:
        ConfigError: ``radius`` is not above 0.
        SceneError: No part of the scene is near, or there are too few points, or only black ones.
    """
    figure, surroundings = _sides(avatar, scene, radius)
    light = fit_irradiance(surroundings.normals, surroundings.luminance, "scene points near the avatar")
    predictor = light.at(figure.normals)
    design = np.stack([predictor, np.ones_like(predictor)], axis=1)
    observed = figure.luminance
    return float(np.abs(observed - design @ robust_fit(design, observed)).mean())


def ncm_ab(
    avatar: Points,
    scene: Points,
    *,
    radius: float = NEIGHBOURHOOD_RADIUS,
    samples: int = CHROMATICITY_SAMPLES_MAX,
    seed: int = 0,
) -> float:
    """Chromaticity neighbourhood match: the 1-Wasserstein (earth mover's) distance between colour casts.

    The distance between the (a*, b*) of the avatar's points and those of the scene's points near it, in CIE L*a*b*
    under D65. All points have the same weight; POT solves it exactly. Source: Mir et al. 2026, section 4.1 (3).

    Args:
        avatar: Its points or Gaussians, world space.
        scene: Those of the scene.
        radius: How far from the avatar's centre the scene counts, metres.
        samples: Most points per side, 1 to 20,000; if there are more, this many are drawn at random, without
            replacement. Two draws from the same colours are not at distance 0: draws of 2000, from colours with an RMS
            distance of 10 Delta E from their mean, are about 0.75 apart.
        seed: Seed of the draws, 0..2^32 - 1. Sides of the same length, such as an avatar before and after relighting,
            get the same points.

    Returns:
        At least 0, in units of Delta E_ab, the lower the better.

    Raises:
        ConfigError: A setting is out of range.
        SceneError: No part of the scene is near.
        MissingExtraError: POT is not installed.
    """
    check_whole("samples", samples, 1, 20_000)
    check_whole("seed", seed, 0, 2**32 - 1)
    figure, surroundings = _sides(avatar, scene, radius)
    own, wanted = (lab(_draw(side.rgb, samples, seed))[:, 1:] for side in (figure, surroundings))
    distances = np.hypot(*np.moveaxis(own[:, None] - wanted[None], -1, 0))
    # The network simplex needs far fewer pivots; the limit is for the worst case.
    return float(np.asarray(import_extra("ot", "ncm_ab").emd2([], [], distances, numItermax=100_000_000)))


def _sides(avatar: Points, scene: Points, radius: float) -> tuple[LitPoints, LitPoints]:
    """The avatar, and the scene within ``radius`` of the mean of its points."""
    check_radius(radius)
    figure = avatar if isinstance(avatar, LitPoints) else LitPoints.of(avatar)
    center = figure.positions.mean(axis=0, dtype=np.float64)
    if not isinstance(scene, LitPoints):
        return figure, LitPoints.of(scene, around=center, radius=radius)
    distance = np.linalg.norm(scene.positions - center, axis=1)
    near = distance <= radius
    if not near.any():
        raise SceneError(
            f"no point of the scene is within {radius:g} of the avatar, the nearest is {distance.min():.3g}"
        )
    return figure, LitPoints(scene.positions[near], scene.normals[near], scene.rgb[near])


def _draw(colors: FloatArray, count: int, seed: int) -> FloatArray:
    """At most ``count`` rows, drawn at random without replacement."""
    if len(colors) <= count:
        return colors
    return colors[np.random.default_rng(seed).choice(len(colors), count, replace=False)]
