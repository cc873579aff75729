"""Whether an avatar is lit as its surroundings are, without ground truth (docs/method/relighting.md#metrics).

An avatar and a scene are `LitPoints`, or Gaussians, from which those are made. The scene is looked at within a radius
of the mean of the avatar's points. docs/adr/0015-lighting-metrics.md has what the paper leaves open.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.config import check_whole
from lumisplat.constants import CHROMATICITY_SAMPLES_MAX, NEIGHBOURHOOD_RADIUS
from lumisplat.errors import MissingExtraError, SceneError
from lumisplat.metrics.chromaticity import lab
from lumisplat.metrics.irradiance import fit_irradiance, robust_fit
from lumisplat.metrics.lit_points import Lit, LitPoints, check_radius

Points = LitPoints | Lit


def paa_y(avatar: Points, scene: Points, *, radius: float = NEIGHBOURHOOD_RADIUS) -> float:
    """Probe-avatar agreement in luminance: the L1 distance between the light that the avatar tells of and the scene's.

    ``PAA-Y = ||c_avatar - c_scene||_1``, where c are the 16 SH coefficients of irradiance (L = 3) that explain
    luminance by normals, ``Y_i = alpha_i E(n_i; c)``; each c is scaled so that ``||c||_1 = 1``, for only the product
    with alpha is known. Huber's loss, 5 % trimmed. Source: Mir et al. 2026, section 4.1 (1).

    Args:
        avatar: Its points or Gaussians, world space.
        scene: Those of the scene.
        radius: How far from the avatar's centre the scene counts, metres.

    Returns:
        0..2, without unit, the lower the better; 0: the same light, up to its strength.

    Raises:
        ConfigError: ``radius`` is not above 0.
        SceneError: No part of the scene is near, or there are too few points, or only black ones.
    """
    figure, surroundings = _sides(avatar, scene, radius)
    own = fit_irradiance(figure.normals, figure.luminance, "avatar points")
    wanted = fit_irradiance(surroundings.normals, surroundings.luminance, "scene points near the avatar")
    return float(np.abs(own.coefficients - wanted.coefficients).sum())


def apf_y(avatar: Points, scene: Points, *, radius: float = NEIGHBOURHOOD_RADIUS) -> float:
    """Avatar photometric fit in luminance: how far the scene's light is from predicting the avatar's shading.

    ``APF-Y = mean |Y_a - (s E(n_a; c_scene) + b)|`` over all of the avatar's points, with c_scene as in `paa_y`, and s
    and b fitted to the avatar by the same robust loss. Source: Mir et al. 2026, section 4.1 (2).

    Args:
        avatar: Its points or Gaussians, world space.
        scene: Those of the scene.
        radius: How far from the avatar's centre the scene counts, metres.

    Returns:
        0 and more, in luminance (white is 1), the lower the better. It grows with the avatar's brightness, and with the
        contrast of its own colours: compare it for one avatar only.

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

    Between the (a*, b*) of the avatar's points and those of the scene's near it, each point with the same weight, in
    CIE L*a*b* under D65; solved exactly by POT. Source: Mir et al. 2026, section 4.1 (3).

    Args:
        avatar: Its points or Gaussians, world space.
        scene: Those of the scene.
        radius: How far from the avatar's centre the scene counts, metres.
        samples: Points of each side, 1 to 20,000; where there are more, as many are drawn at random, without
            replacement. Two draws of the same colours are not at distance 0: draws of 2000, of colours 10 Delta E from
            their mean (RMS), are about 0.75 apart.
        seed: Of the draws, 0..2^32 - 1: the same points are drawn of sides of the same length, such as an avatar
            before and after relighting.

    Returns:
        0 and more, in units of Delta E_ab, the lower the better.

    Raises:
        ConfigError: A setting is out of range.
        SceneError: No part of the scene is near.
        MissingExtraError: POT is not installed.
    """
    check_whole("samples", samples, 1, 20_000)
    check_whole("seed", seed, 0, 2**32 - 1)
    figure, surroundings = _sides(avatar, scene, radius)
    try:
        import ot
    except ImportError:
        raise MissingExtraError("ncm_ab", "metrics") from None
    own, wanted = (lab(_drawn(side.rgb, samples, seed))[:, 1:] for side in (figure, surroundings))
    apart = np.hypot(*np.moveaxis(own[:, None] - wanted[None], -1, 0))
    # The network simplex ends long before: this many pivots are for the worst case.
    return float(np.asarray(ot.emd2([], [], apart, numItermax=100_000_000)))


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


def _drawn(colors: npt.NDArray, count: int, seed: int) -> npt.NDArray:
    if len(colors) <= count:
        return colors
    return colors[np.random.default_rng(seed).choice(len(colors), count, replace=False)]
