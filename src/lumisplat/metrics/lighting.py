"""Metrics of how well the light on an avatar agrees with the light of the scene (docs/method/relighting.md#metrics).

No ground truth is needed. Avatar and scene are `LitPoints`, or Gaussians from which points are made. Only the part of
the scene within a radius of the mean of the avatar's points counts.
docs/adr/0015-lighting-metrics-with-fixed-scale.md lists the choices that the paper leaves open.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import check_whole, is_number, quoted
from lumisplat.config.setting import frozen, given
from lumisplat.constants import HUBER_WIDTH, MAD_PER_DEVIATION, SH_C0
from lumisplat.errors import ConfigError, SceneError, check_shapes
from lumisplat.math.arrays import Doubles, FloatArray, float_array, host_array, normalise_rows, refuse_rows, to_floats
from lumisplat.math.color import decode_srgb, lab, luminance
from lumisplat.math.sh import sh_basis
from lumisplat.metrics.images import import_extra
from lumisplat.scene.checks import take_scene_fields
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance

IRRADIANCE_SH_DEGREE = 3
"""SH degree L of the irradiance that PAA-Y and APF-Y fit (Mir et al. 2026, section 4.1)."""

NEIGHBOURHOOD_RADIUS = 1.5
"""Distance from an avatar's centre within which the scene is compared, metres: the middle of the 1 to 2 m of Mir et
al. 2026, section 4.1."""

TRIMMED_SHARE = 0.05
"""Fraction of the points that a robust fit leaves out: those with the largest residuals (Mir et al. 2026, section
4.1)."""

HUBER_WIDTH_MIN = 0.05
"""Smallest width of the Huber loss, as a relative residual: 8-bit colours are no more exact, so smaller residuals
never count as outliers.
"""

FIT_STEPS_MAX = 100
"""Largest number of reweighting steps of the robust fit; about ten suffice to reach `FIT_TOLERANCE`."""

FIT_TOLERANCE = 1e-9
"""Change of the coefficients in a step, relative to the largest coefficient, at which the robust fit ends."""

IRRADIANCE_SMOOTHNESS = 1e-3
"""Weight per sample of the penalty l (l + 1) c^2 on an SH coefficient c of degree l of irradiance. It keeps irradiance
smooth in directions without normals. With normals in all directions, the penalty shrinks coefficients by about 4 to
20 %, those of higher degrees more. A smaller weight leaves noise. For an evenly lit floor, with 3000 normals within
0.2 of upright and scales log-normal by 0.5, PAA-Y from constant light is 0.12 to 0.20, and 0.3 to 0.45 with a tenth of
the weight."""

IRRADIANCE_FLOOR = 0.1
"""Lower bound of the irradiance by which residuals are divided, as a fraction of the mean luminance. Darker values are
mostly noise and the camera's black level."""

CHROMATICITY_SAMPLES_MAX = 2000
"""Largest number of Gaussians that NCM-ab uses on each side; of more, a random sample is used. Optimal transport
between so many takes half a second, between four times as many half a minute."""

Lit = Gaussians | SplatInstance | Scene
"""Types that `LitPoints.of` accepts."""


@frozen
class LitPoints:
    """N points on lit surfaces, with normals and colours, which lighting metrics compare.

    Arrays become read-only float32; normals are normalised.

    Raises:
        SceneError: There is no point, shapes do not match, values are not finite, or a colour is negative.
    """

    positions: FloatArray = given(converter=to_floats)
    """Positions of N points in world space, metres, shape (N, 3)."""
    normals: FloatArray = given(converter=to_floats)
    """Unit normals of N points, world space, shape (N, 3)."""
    rgb: FloatArray = given(converter=to_floats)
    """Colours of N points, linear Rec.709, white 1, at least 0, shape (N, 3)."""

    def __post_init__(self) -> None:
        take_scene_fields(self)
        check_shapes(positions=(self.positions, "N 3"), normals=(self.normals, "N 3"), rgb=(self.rgb, "N 3"))
        if self.count == 0:
            raise SceneError("zero points: there is no light to compare")
        refuse_rows("rgb", "negative", np.asarray((self.rgb < 0.0).any(axis=1)))
        object.__setattr__(self, "normals", normalise_rows("normals", self.normals))

    @classmethod
    def of(cls, subject: Lit, *, around: npt.ArrayLike | None = None, radius: float | None = None) -> LitPoints:
        """Makes points from the Gaussians of a set, an instance or a scene, in world space.

        Colours are those of SH degree 0, the mean over all directions, decoded to linear light. Normals are the set's
        stored normals, or the result of `estimate_normals` if it has none.

        Args:
            subject: Gaussians, an instance, or a scene, whose splat instances all count; meshes do not.
            around: World-space point, shape (3,). Only Gaussians near the point are used, and estimated normals are
                flipped towards it, like the walls of a room around a person. None: all Gaussians, with outward normals.
            radius: Largest distance from ``around``, metres; required if ``around`` is given.

        Raises:
            ConfigError: ``radius`` is not above 0.
            SceneError: There are no Gaussians, or none is near enough (the message gives the distance of the nearest
                one), or ``around`` is not a point.
        """
        ball = None if around is None else _Ball.of(around, radius)
        parts = list(_instances(subject))
        if not parts:
            raise SceneError("the scene has no Gaussians: there is no light to compare")
        selections = [np.ones(part.gaussians.count, np.bool_) if ball is None else ball.holds(part) for part in parts]
        if ball is not None and not any(rows.any() for rows in selections):
            nearest = min(float(ball.distances(part).min()) for part in parts)
            listed = ", ".join(f"{value:.3g}" for value in ball.center.tolist())
            raise SceneError(
                f"no Gaussian of the scene is within {ball.radius:g} of the avatar's centre ({listed}), the nearest is "
                f"{nearest:.3g} away: check the position of the avatar, and that the unit is metres"
            )
        made = [_points(part, rows, ball) for part, rows in zip(parts, selections, strict=True) if rows.any()]
        positions, normals, colors = (np.concatenate(arrays) for arrays in zip(*made, strict=True))
        return cls(positions, normals, colors)

    @property
    def count(self) -> int:
        """Number of points, N."""
        return self.positions.shape[0]

    @property
    def luminance(self) -> npt.NDArray[np.float64]:
        """CIE Y of the colour of each of N points, linear, white 1, shape (N,)."""
        return luminance(self.rgb)


def check_radius(radius: object) -> float:
    """Returns ``radius``; raises a `ConfigError` unless it is a finite number above 0."""
    if not is_number(radius) or not 0.0 < radius < np.inf:
        raise ConfigError(f"radius is {quoted(radius)}, expected metres above 0")
    return radius


class _Ball(NamedTuple):
    """Ball around the avatar's centre; only Gaussians of the scene inside of it are compared with the avatar."""

    center: Doubles
    radius: float

    @classmethod
    def of(cls, center: npt.ArrayLike, radius: object) -> _Ball:
        checked = check_radius(radius)
        point = float_array("around", center).astype(np.float64)
        check_shapes(around=(point, "3"))
        return cls(point, checked)

    def distances(self, instance: SplatInstance) -> Doubles:
        """Returns the distances of an instance's N means from the centre, shape (N,)."""
        return np.linalg.norm(instance.world_means - self.center, axis=1)

    def holds(self, instance: SplatInstance) -> npt.NDArray[np.bool_]:
        """Returns which of an instance's N means are inside the ball, shape (N,)."""
        return self.distances(instance) <= self.radius


def _instances(subject: object) -> Iterator[SplatInstance]:
    if isinstance(subject, Scene):
        yield from subject.splats
    elif isinstance(subject, SplatInstance):
        yield subject
    elif isinstance(subject, Gaussians):
        yield SplatInstance(subject)
    else:
        raise SceneError(f"lighting metrics take Gaussians or LitPoints, got a {type(subject).__name__}")


def _points(
    instance: SplatInstance, rows: npt.NDArray[np.bool_], ball: _Ball | None
) -> tuple[Doubles, npt.NDArray[np.floating], npt.NDArray[np.floating]]:
    """Returns world-space positions, normals and linear colours of the Gaussians of an instance that ``rows`` selects.

    With ``ball``, estimated normals point towards its centre.
    """
    selected = instance.gaussians if rows.all() else instance.gaussians.subset(rows)
    positions = instance.world_means[rows]
    object_normals = selected.normals
    if object_normals is None:
        from lumisplat.scene.ops.normals import estimate_normals

        object_normals = estimate_normals(selected)
    # The similarity rotates normals; its scale is removed when they are normalised.
    normals = object_normals @ instance.transform[:3, :3].T
    if selected.normals is None and ball is not None:
        away = np.einsum("ij,ij->i", normals, ball.center - positions) < 0.0
        normals = np.where(away[:, None], -normals, normals)
    display = np.maximum(SH_C0 * selected.sh[:, 0].astype(np.float64) + 0.5, 0.0)
    return positions, normals, decode_srgb(display)


Points = LitPoints | Lit


def paa_y(avatar: Points, scene: Points, *, radius: float = NEIGHBOURHOOD_RADIUS) -> float:
    """Returns the probe-avatar agreement in luminance: L1 distance between irradiance on the avatar and on the scene.

    ``PAA-Y = ||c_avatar - c_scene||_1``, where c are the 16 SH coefficients of irradiance (L = 3) that explain
    luminance by normals, ``Y_i = alpha_i E(n_i; c)``. Each c is scaled to ``||c||_1 = 1``, because only the product of
    c and alpha can be determined. The fit uses Huber's loss and trims 5 %. Source: Mir et al. 2026, section 4.1 (1).

    Args:
        avatar: Points or Gaussians of the avatar, world space.
        scene: Points or Gaussians of the scene.
        radius: Distance from the avatar's centre within which the scene counts, metres.

    Returns:
        0..2, without unit, the lower the better; 0 if the lights differ at most in intensity.

    Raises:
        ConfigError: ``radius`` is not above 0.
        SceneError: No part of the scene is near, or there are too few points, or only black ones.
    """
    figure, nearby = _sides(avatar, scene, radius)
    found = fit_irradiance(figure.normals, figure.luminance, "avatar points")
    wanted = fit_irradiance(nearby.normals, nearby.luminance, "scene points near the avatar")
    return float(np.abs(found.coefficients - wanted.coefficients).sum())


def apf_y(avatar: Points, scene: Points, *, radius: float = NEIGHBOURHOOD_RADIUS) -> float:
    """Returns the avatar photometric fit: the error of predicting the avatar's luminance from the scene's light.

    ``APF-Y = mean |Y_a - (s E(n_a; c_scene) + b)|`` over all points of the avatar, with c_scene as in `paa_y`, and s
    and b fitted to the avatar with the same robust loss. Source: Mir et al. 2026, section 4.1 (2).

    Args:
        avatar: Points or Gaussians of the avatar, world space.
        scene: Points or Gaussians of the scene.
        radius: Distance from the avatar's centre within which the scene counts, metres.

    Returns:
        At least 0, in luminance (white is 1), the lower the better. The value grows with the brightness and the
        contrast of the avatar's own colours, so compare values of one avatar only.

    Raises:
        ConfigError: ``radius`` is not above 0.
        SceneError: No part of the scene is near, or there are too few points, or only black ones.
    """
    figure, nearby = _sides(avatar, scene, radius)
    light = fit_irradiance(nearby.normals, nearby.luminance, "scene points near the avatar")
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
    """Returns the chromaticity neighbourhood match: the 1-Wasserstein (earth mover's) distance between colour casts.

    The distance is between the (a*, b*) of the avatar's points and those of the scene's points near it, in CIE L*a*b*
    under D65. All points have the same weight; POT solves the transport exactly. Source: Mir et al. 2026, section 4.1
    (3).

    Args:
        avatar: Points or Gaussians of the avatar, world space.
        scene: Points or Gaussians of the scene.
        radius: Distance from the avatar's centre within which the scene counts, metres.
        samples: Largest number of points of the avatar and of the scene, 1 to 20,000; of more, a random sample is drawn
            without replacement. Two samples of the same colours are not at distance 0: samples of 2000, from colours
            with an RMS distance of 10 Delta E from their mean, are about 0.75 apart.
        seed: Seed of the samples, 0..2^32 - 1. Arrays of the same length, such as an avatar's points before and after
            relighting, are sampled at the same rows.

    Returns:
        At least 0, in units of Delta E_ab, the lower the better.

    Raises:
        ConfigError: A setting is out of range.
        SceneError: No part of the scene is near.
        MissingExtraError: POT is not installed.
    """
    check_whole("samples", samples, 1, 20_000)
    check_whole("seed", seed, 0, 2**32 - 1)
    figure, nearby = _sides(avatar, scene, radius)
    found, wanted = (lab(_draw(side.rgb, samples, seed))[:, 1:] for side in (figure, nearby))
    distances = np.hypot(*np.moveaxis(found[:, None] - wanted[None], -1, 0))
    # The network simplex needs far fewer pivots; the limit is for the worst case.
    return float(np.asarray(import_extra("ot", "ncm_ab").emd2([], [], distances, numItermax=100_000_000)))


def _sides(avatar: Points, scene: Points, radius: float) -> tuple[LitPoints, LitPoints]:
    """Returns the points of the avatar, and those of the scene within ``radius`` of the avatar's mean point."""
    check_radius(radius)
    figure = avatar if isinstance(avatar, LitPoints) else LitPoints.of(avatar)
    center = figure.positions.mean(axis=0, dtype=np.float64)
    if not isinstance(scene, LitPoints):
        return figure, LitPoints.of(scene, around=center, radius=radius)
    distance = np.linalg.norm(scene.positions - center, axis=1)
    near = distance <= radius
    if not near.any():
        raise SceneError(
            f"no point of the scene is within {radius:g} of the avatar's centre, the nearest is {distance.min():.3g} "
            "away: check the position of the avatar, and that the unit is metres"
        )
    return figure, LitPoints(scene.positions[near], scene.normals[near], scene.rgb[near])


def _draw(colors: FloatArray, count: int, seed: int) -> FloatArray:
    """Returns ``count`` rows of ``colors``, drawn at random without replacement; all rows if there are no more."""
    if len(colors) <= count:
        return colors
    return colors[np.random.default_rng(seed).choice(len(colors), count, replace=False)]


COEFFICIENTS = (IRRADIANCE_SH_DEGREE + 1) ** 2
_DEGREES = np.repeat(np.arange(IRRADIANCE_SH_DEGREE + 1), 2 * np.arange(IRRADIANCE_SH_DEGREE + 1) + 1)
"""Degree l of each of the 16 SH coefficients of irradiance."""


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """Irradiance as a function of the normal, with a scale for each of N points; the result of `fit_irradiance`."""

    coefficients: Doubles
    """SH coefficients c of irradiance, shape (16,). The basis functions are real, orthonormal, and in the order of
    captures. The absolute values of c sum to 1."""
    scales: Doubles
    """Scale alpha of each of N points: its luminance over irradiance, at least 0, shape (N,)."""

    def at(self, normals: npt.ArrayLike) -> Doubles:
        """Evaluates the irradiance E for N unit normals, shape (N, 3)."""
        return _basis(normals) @ self.coefficients


def fit_irradiance(normals: npt.ArrayLike, luminance: npt.ArrayLike, name: str = "points") -> Irradiance:
    """Factorises luminance into scales and irradiance, ``Y_i = alpha_i E(n_i; c)``.

    First c is fitted robustly with all scales equal, then the scales follow. With a free scale for each point, any
    positive E would fit exactly; docs/adr/0015-lighting-metrics-with-fixed-scale.md explains this choice of c.

    The fit minimises Huber's loss of the residuals ``alpha_i - 1``, without the 5 % of the points that fit worst. In
    directions without normals, irradiance stays smooth. Scales that are independent of the normals change c by a factor
    only, whatever their distribution.

    Args:
        normals: Unit normals of N points, shape (N, 3).
        luminance: CIE Y, linear, at least 0, shape (N,).
        name: Name of the points in error messages.

    Returns:
        The coefficients c and the scales. Luminance in another unit changes the scales by a factor, and c not at all.

    Raises:
        SceneError: There are fewer points than coefficients, or all are black.
    """
    values = np.asarray(host_array(luminance), np.float64)
    if values.size < COEFFICIENTS:
        raise SceneError(f"{values.size} {name}: fitting irradiance needs {COEFFICIENTS} or more")
    # The mean leaves out the brightest points, because a few could dominate it.
    mean = float(np.sort(values)[: values.size - int(TRIMMED_SHARE * values.size)].mean())
    if not mean > 0.0:
        raise SceneError(f"all {values.size:,} {name} are black: they hold no light to fit")
    basis = _basis(normals)
    penalty = IRRADIANCE_SMOOTHNESS * _DEGREES * (_DEGREES + 1.0)
    fitted = robust_fit(basis, values / mean, penalty, relative_above=IRRADIANCE_FLOOR)
    total = float(np.abs(fitted).sum())
    coefficients = fitted / total
    irradiance = basis @ coefficients
    scales = np.divide(values, irradiance, out=np.zeros_like(values), where=irradiance > 0.0)
    return Irradiance(coefficients, np.maximum(scales, 0.0))


def robust_fit(
    design: Doubles, values: Doubles, penalty: Doubles | None = None, *, relative_above: float | None = None
) -> Doubles:
    """Finds coefficients x with ``design @ x`` close to ``values``, by Huber's loss without the worst 5 % of rows.

    Rows are left out once, by their residuals from a Huber fit to all rows. If they were chosen again in every step,
    the remaining rows would be those that happen to agree with an early fit. Huber's width follows the median residual,
    so that the fit scales with the values.

    Args:
        design: N rows for K coefficients, shape (N, K).
        values: Values to match, shape (N,).
        penalty: Weight of each squared coefficient relative to the mean loss over the rows, shape (K,); None: no
            penalty.
        relative_above: If given, residuals are divided by the fitted value or by this number, whichever is larger; for
            values that vary by factors. None: residuals are differences.

    Returns:
        The coefficients x, shape (K,); the smallest solution if there are several.
    """
    ridge = np.diag(np.zeros(int(design.shape[1])) if penalty is None else penalty)
    found = _huber_fit(
        design, values, ridge, relative_above, _weighted_fit(design, values, np.ones_like(values), ridge)
    )
    dropped = int(TRIMMED_SHARE * values.size)
    if not dropped:
        return found
    distance, _ = _residuals(design, values, found, relative_above)
    rows = np.sort(np.argpartition(distance, values.size - dropped)[: values.size - dropped])
    return _huber_fit(design[rows], values[rows], ridge, relative_above, found)


def _huber_fit(
    design: Doubles, values: Doubles, ridge: Doubles, relative_above: float | None, start: Doubles
) -> Doubles:
    """Minimises Huber's loss plus a ridge penalty, by iteratively reweighted least squares from ``start``."""
    found = start
    smallest = FIT_TOLERANCE * max(float(np.abs(values).max()), np.finfo(np.float64).tiny)
    if relative_above is not None:
        smallest = HUBER_WIDTH_MIN
    for _ in range(FIT_STEPS_MAX):
        distance, unit = _residuals(design, values, found, relative_above)
        width = max(HUBER_WIDTH * float(np.median(distance)) / MAD_PER_DEVIATION, smallest)
        weights = width / np.maximum(distance, width) / unit**2
        before, found = found, _weighted_fit(design, values, weights, ridge)
        if np.abs(found - before).max() <= FIT_TOLERANCE * np.abs(found).max():
            break
    return found


def _residuals(
    design: Doubles, values: Doubles, found: Doubles, relative_above: float | None
) -> tuple[Doubles, Doubles | float]:
    """Returns the absolute residuals of the fitted coefficients, ``|values - fitted| / unit``, and the unit.

    The unit is the fitted value, at least ``relative_above``; 1 if that is None.
    """
    fitted = design @ found
    unit = 1.0 if relative_above is None else np.maximum(fitted, relative_above)
    return np.abs(values - fitted) / unit, unit


def _weighted_fit(design: Doubles, values: Doubles, weights: Doubles, ridge: Doubles) -> Doubles:
    weighted = design * weights[:, None]
    # The penalty scales with the weights, so that the smoothness does not depend on the quality of the fit.
    matrix: Doubles = design.T @ weighted + weights.sum() * ridge
    right: Doubles = weighted.T @ values
    return np.linalg.lstsq(matrix, right)[0].astype(np.float64)


def _basis(normals: npt.ArrayLike) -> Doubles:
    return sh_basis(normals, IRRADIANCE_SH_DEGREE).astype(np.float64)
