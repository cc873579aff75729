"""PAA-Y, APF-Y and NCM-ab (docs/method/relighting.md#metrics) under known light."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment, minimize
from scipy.spatial.transform import Rotation

import lumisplat as ls
from lumisplat.math.color import encode_srgb, lab, luminance
from lumisplat.math.sh import sh_basis
from lumisplat.metrics.lighting import fit_irradiance, robust_fit
from support.scenes.raster_scenes import random_gaussians

METRICS = (ls.metrics.paa_y, ls.metrics.apf_y, ls.metrics.ncm_ab)
Y00, Y10 = math.sqrt(1.0 / (4.0 * math.pi)), math.sqrt(3.0 / (4.0 * math.pi))


def all_around(count: int = 4000) -> np.ndarray:
    """Returns unit vectors evenly spread over the sphere (a Fibonacci lattice)."""
    step = np.arange(count) + 0.5
    z, rotation = 1.0 - 2.0 * step / count, step * math.pi * (3.0 - math.sqrt(5.0))
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(rotation), across * np.sin(rotation), z], axis=1)


def points(rgb, normals: np.ndarray | None = None) -> ls.metrics.LitPoints:
    """Returns points within 0.5 m around the origin, in grey or colours."""
    normals = all_around() if normals is None else normals
    colors = np.asarray(rgb, np.float64)
    colors = np.repeat(colors[:, None], 3, axis=1) if colors.ndim == 1 and len(colors) == len(normals) else colors
    return ls.metrics.LitPoints(0.5 * normals, normals, np.broadcast_to(colors, (len(normals), 3)))


def lit_from(direction, share: float, normals: np.ndarray | None = None) -> np.ndarray:
    """Returns the irradiance 0.2 (1 + share cos) of light from a direction."""
    normals = all_around() if normals is None else normals
    return 0.2 * (1.0 + share * normals @ np.asarray(direction, np.float64))


def test_light_metric_paa_y_matches_hand_computed_values():
    """E = 1 + a n_z has c = (1 / Y00, a / Y10), scaled so that the absolute values sum to 1.

    a = 0.5: 3.5449 and 0.5 / 0.48860 = 1.0233, so (0.776, 0.224). Constant light is (1, 0), and PAA-Y 0.224 + 0.224.
    Light from below only changes the sign of c_10: 2 x 0.224, the same value, because the norm is L1. Light from x has
    another coefficient: 2 x 0.224 again. The penalty changes all of these by a few hundredths at most.
    """
    band = 0.5 / Y10
    expected = 2.0 * band / (1.0 / Y00 + band)
    assert expected == pytest.approx(0.448, abs=1e-4)
    above = points(lit_from((0, 0, 1), 0.5))
    for other in (np.full(4000, 0.3), lit_from((0, 0, -1), 0.5), lit_from((1, 0, 0), 0.5)):
        assert ls.metrics.paa_y(above, points(other)) == pytest.approx(expected, abs=0.02)
    assert ls.metrics.paa_y(above, above) == 0.0


def test_irradiance_fit_recovers_all_16_sh_coefficients(monkeypatch):
    """The coefficients are exact without the smoothness penalty, and a little smoother with the penalty."""
    rng = np.random.default_rng(1)
    true = np.concatenate([[4.0], rng.uniform(-0.3, 0.3, 15)])
    normals = all_around()
    luminances = sh_basis(normals, 3) @ true
    fit = fit_irradiance(normals, luminances)
    np.testing.assert_allclose(fit.scales * fit.at(normals), luminances, rtol=1e-12)
    assert fit.scales.min() >= 0.0
    left = [
        np.abs(fit.coefficients[first:end]).sum() / np.abs(true[first:end]).sum() for first, end in ((0, 1), (9, 16))
    ]
    assert 0.75 < left[1] / left[0] < 0.95
    monkeypatch.setattr("lumisplat.metrics.lighting.IRRADIANCE_SMOOTHNESS", 1e-12)
    exact = fit_irradiance(normals, luminances)
    np.testing.assert_allclose(exact.coefficients, true / np.abs(true).sum(), atol=1e-8)
    assert np.ptp(exact.scales) < 1e-6 * exact.scales.mean()


def test_albedo_that_varies_over_points_does_not_change_their_fitted_irradiance():
    """Albedos independent of the normals add noise only; outliers and dark spots change nothing."""
    rng = np.random.default_rng(2)
    clean = lit_from((0, 0, 1), 0.5)
    reference = points(clean)
    patchy = points(clean * np.exp(rng.normal(0.0, 0.5, 4000)))
    assert ls.metrics.paa_y(patchy, reference) < 0.2 < ls.metrics.paa_y(points(np.full(4000, 0.2)), reference)
    painted = points(clean * rng.choice([0.02, 1.0], 4000, p=[0.3, 0.7]))
    assert ls.metrics.paa_y(painted, reference) < 0.1
    glints = clean.copy()
    glints[rng.choice(4000, 160, replace=False)] = 50.0
    assert ls.metrics.paa_y(points(glints), reference) < 0.01


def test_robust_irradiance_fit_minimises_hubers_loss():
    """The coefficients are those that a general optimiser finds for the loss of the remaining rows."""
    rng = np.random.default_rng(3)
    design = np.stack([rng.uniform(0, 2, 400), np.ones(400)], axis=1)
    values = design @ [0.7, 0.2] + 0.05 * rng.standard_t(2, 400)

    def fitted(kept: np.ndarray) -> np.ndarray:
        """Minimises Huber's loss, alternating between its width and the coefficients."""
        best = np.array([1.0, 0.0])
        for _ in range(30):
            width = 1.345 * np.median(np.abs(values - design @ best)[kept]) / 0.6745

            def loss(x: np.ndarray, width: float = width) -> float:
                rest = np.abs(values - design @ x)[kept]
                return float(np.where(rest <= width, 0.5 * rest**2, width * (rest - 0.5 * width)).sum())

            best = minimize(loss, best, method="BFGS", options={"gtol": 1e-9}).x
        return best

    distance = np.abs(values - design @ fitted(np.full(400, True)))
    expected = fitted(distance < np.sort(distance)[380])
    np.testing.assert_allclose(robust_fit(design, values), expected, atol=1e-6)
    assert np.abs(robust_fit(design, values) - np.linalg.lstsq(design, values)[0]).max() > 1e-3


def test_coefficients_of_the_robust_irradiance_fit_are_proportional_to_the_values():
    """Values a thousand times as large have coefficients a thousand times as large."""
    rng = np.random.default_rng(4)
    design, values = rng.normal(size=(200, 3)), rng.standard_t(3, 200)
    np.testing.assert_allclose(robust_fit(design, 1000.0 * values), 1000.0 * robust_fit(design, values), rtol=1e-6)


def test_light_metric_apf_y_matches_hand_computed_values():
    """Light with gain and offset is predicted.

    A constant predicts the mean, and leaves 0.2 x 0.5 x E|n_z| = 0.05. The mean of |n_z| over the sphere is 1/2. With
    light from x, E(n; c_scene) is n_x, which is independent of n_z, so 0.05 remains, too.
    """
    avatar = points(lit_from((0, 0, 1), 0.5))
    assert ls.metrics.apf_y(avatar, points(3.0 * lit_from((0, 0, 1), 0.2))) == pytest.approx(0.0, abs=5e-3)
    assert ls.metrics.apf_y(avatar, points(np.full(4000, 0.3))) == pytest.approx(0.05, abs=1e-4)
    assert ls.metrics.apf_y(avatar, points(lit_from((1, 0, 0), 0.5))) == pytest.approx(0.05, abs=1e-3)


def test_luminance_and_lab_match_reference_values():
    """CIE Y has its standard weights; L*a*b* under D65 is checked for red, green, blue, white and two greys."""
    assert luminance([0.5, 0.25, 1.0]) == pytest.approx(0.1063 + 0.1788 + 0.0722)
    expected = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [32.30, 79.19, -107.86], [100.0, 0.0, 0.0]]
    np.testing.assert_allclose(lab([*np.eye(3), np.ones(3)]), expected, atol=0.03)
    # 18 % grey: 116 cbrt(0.18) - 16 = 49.50; below (6/29)^3 the curve is linear: 903.3 x 0.005 = 4.52.
    np.testing.assert_allclose(lab([[0.18] * 3, [0.005] * 3]), [[49.496, 0, 0], [4.5165, 0, 0]], atol=1e-3)


def test_light_metric_ncm_ab_matches_hand_computed_values():
    """Grey against one colour is that colour's chroma; with half of the points in it, half of that.

    Linear (0.2, 0.1, 0.1): X/Xn = 0.1 + 0.1 x 0.4124 / 0.9505 = 0.14339, Y = 0.1 + 0.02126 = 0.12126,
    Z/Zn = 0.1 + 0.1 x 0.0193 / 1.0890 = 0.10177; cube roots 0.52340, 0.49496, 0.46689: a* = 500 x 0.02844 = 14.22,
    b* = 200 x 0.02807 = 5.61; chroma 15.29.
    """
    grey, red = points([0.3, 0.3, 0.3]), points([0.2, 0.1, 0.1])
    assert ls.metrics.ncm_ab(red, grey) == pytest.approx(15.29, abs=0.02)
    half = np.tile([[0.3, 0.3, 0.3], [0.2, 0.1, 0.1]], (500, 1))
    mixed, few = points(half, all_around(1000)), points([0.3, 0.3, 0.3], all_around(700))
    assert ls.metrics.ncm_ab(mixed, few) == pytest.approx(15.29 / 2.0, abs=0.01)
    assert ls.metrics.ncm_ab(mixed, mixed) == pytest.approx(0.0, abs=1e-9)


def test_light_metric_ncm_ab_is_the_mean_distance_of_the_cheapest_assignment():
    """Between equally many points, the distance is the mean over the best pairing."""
    rng = np.random.default_rng(5)
    normals = all_around(60)
    sides = [points(rng.uniform(0.05, 1.0, (60, 3)), normals) for _ in range(2)]
    first, second = (lab(side.rgb)[:, 1:] for side in sides)
    cost = np.linalg.norm(first[:, None] - second[None], axis=2)
    assert ls.metrics.ncm_ab(*sides) == pytest.approx(cost[linear_sum_assignment(cost)].mean(), rel=1e-9)


def test_light_metric_ncm_ab_of_a_random_subset_of_points_is_equal_for_equal_seeds():
    """Each seed gives one value, close to that of all points."""
    rng = np.random.default_rng(6)
    normals = all_around(1500)
    first, second = (points(rng.uniform(low, 1.0, (1500, 3)), normals) for low in (0.05, 0.4))
    whole = ls.metrics.ncm_ab(first, second)
    drawn = [ls.metrics.ncm_ab(first, second, samples=300, seed=seed) for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]
    assert drawn == pytest.approx([whole] * 3, rel=0.25)


@pytest.mark.parametrize("metric", METRICS)
def test_light_metrics_do_not_depend_on_the_order_or_common_translation_of_points(metric):
    """Both sides may be moved together; twice the light of the avatar does not change PAA-Y."""
    rng = np.random.default_rng(7)
    normals = all_around(500)
    avatar = points(rng.uniform(0.1, 0.5, (500, 3)) * (1.0 + 0.5 * normals[:, :1]), normals)
    scene = points(rng.uniform(0.1, 0.9, (500, 3)) * (1.0 + 0.5 * normals[:, 2:]), normals)
    value = metric(avatar, scene)
    order = rng.permutation(500)
    shuffled = ls.metrics.LitPoints(avatar.positions[order], avatar.normals[order], avatar.rgb[order])
    moved = [replace(side, positions=side.positions + np.array([3, -2, 8], np.float32)) for side in (shuffled, scene)]
    assert metric(*moved) == pytest.approx(value, rel=1e-5)
    brighter = replace(avatar, rgb=2.0 * avatar.rgb)
    if metric is ls.metrics.paa_y:
        assert metric(brighter, scene) == pytest.approx(value, rel=1e-6)
    if metric is ls.metrics.apf_y:
        assert metric(brighter, scene) == pytest.approx(2.0 * value, rel=1e-6)


@pytest.mark.parametrize("metric", METRICS)
def test_light_metrics_ignore_scene_points_beyond_the_radius_around_the_avatar(metric):
    """Points within the radius change the metrics."""
    normals = all_around(400)
    avatar = points(lit_from((0, 0, 1), 0.5, normals), normals)
    near = points(lit_from((0.6, 0, 0.8), 0.8, normals), normals)
    far = np.random.default_rng(8).uniform(0.1, 0.9, (400, 3)) * (1.0 + normals[:, :1])
    both = ls.metrics.LitPoints(
        np.concatenate([near.positions, near.positions + np.array([1.7, 0, 0])]),
        np.concatenate([near.normals, near.normals]),
        np.concatenate([near.rgb, far]),
    )
    alone = metric(avatar, near)
    assert metric(avatar, both, radius=1.15) == pytest.approx(alone, rel=1e-6)
    assert metric(avatar, both, radius=3.0) != pytest.approx(alone, rel=1e-3)


def splats(colors: np.ndarray, normals: np.ndarray | None, count: int) -> ls.Gaussians:
    """Returns Gaussians of linear colours without view dependence."""
    base = random_gaussians(3, count=count)
    sh = ((encode_srgb(colors) - 0.5) / 0.28209479177387814)[:, None, :]
    return replace(base, sh=sh.astype(np.float32), normals=normals, means=base.means - base.means.mean(axis=0))


def test_points_that_light_metrics_take_from_gaussians_have_linear_world_space_values():
    """Colours are those of SH degree 0."""
    rng = np.random.default_rng(9)
    normals, colors = all_around(50), rng.uniform(0.05, 1.0, (50, 3))
    gaussians = splats(colors, normals, 50)
    rotation = Rotation.from_euler("xyz", [20, 50, -30], degrees=True).as_matrix()
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = 2.0 * rotation, [1.0, 2.0, 3.0]
    got = ls.metrics.LitPoints.of(ls.Scene(splats=[ls.SplatInstance(gaussians, world)]))
    np.testing.assert_allclose(got.positions, gaussians.means @ (2.0 * rotation).T + [1, 2, 3], atol=1e-5)
    np.testing.assert_allclose(got.normals, normals @ rotation.T, atol=1e-6)
    np.testing.assert_allclose(got.rgb, colors, atol=1e-5)
    np.testing.assert_allclose(got.luminance, colors @ [0.2126, 0.7152, 0.0722], atol=1e-5)


def test_estimated_normals_of_a_scene_face_the_avatar():
    """Normals of discs on a floor and a ceiling point to the avatar in between."""
    position = np.random.default_rng(10).uniform(-1, 1, (80, 3))
    position[:, 1] = np.where(np.arange(80) % 2, 1.0, -1.0)
    base = random_gaussians(3, count=80)
    room = replace(
        base, means=position, scales=np.tile([0.1, 0.01, 0.1], (80, 1)), rotations_wxyz=np.tile([1, 0, 0, 0], (80, 1))
    )
    got = ls.metrics.LitPoints.of(room, around=(0, 0, 0), radius=2.0)
    np.testing.assert_allclose(
        got.normals, np.stack([0 * position[:, 1], -position[:, 1], 0 * position[:, 1]], 1), atol=1e-5
    )


def test_light_metrics_of_gaussians_instances_and_scenes_equal_those_of_their_points():
    """Gaussians, instances and scenes are accepted."""
    rng = np.random.default_rng(11)
    normals = all_around(300)
    avatar, room = (splats(rng.uniform(low, 1.0, (300, 3)), normals, 300) for low in (0.05, 0.3))
    for metric in METRICS:
        value = metric(ls.metrics.LitPoints.of(avatar), ls.metrics.LitPoints.of(room), radius=2.0)
        assert metric(avatar, ls.Scene(splats=[room]), radius=2.0) == value
        assert metric(ls.SplatInstance(avatar), room, radius=2.0) == value


def test_light_metrics_refuse_invalid_arguments_with_a_one_line_error():
    """Errors are a scene with no point near the avatar, too few or black points, invalid settings and arrays."""
    avatar = points(np.full(4000, 0.2))
    far = replace(avatar, positions=avatar.positions + np.array([9, 0, 0], np.float32))
    with pytest.raises(
        ls.SceneError, match=r"no point of the scene is within 1.5 of the avatar's centre, the nearest is 8.5"
    ):
        ls.metrics.paa_y(avatar, far)
    gaussians = splats(np.full((40, 3), 0.5), None, 40)
    with pytest.raises(
        ls.SceneError, match=r"within 0.001 of the avatar's centre \(.*, the nearest is .* unit is metres"
    ):
        ls.metrics.LitPoints.of(gaussians, around=(100, 0, 0), radius=1e-3)
    with pytest.raises(ls.SceneError, match="15 avatar points: fitting irradiance needs 16 or more"):
        ls.metrics.paa_y(points(np.full(15, 0.2), all_around(15)), avatar)
    with pytest.raises(ls.SceneError, match="all 4,000 avatar points are black"):
        ls.metrics.paa_y(points(np.zeros(4000)), avatar)
    with pytest.raises(ls.ConfigError, match="radius is nan"):
        ls.metrics.apf_y(avatar, avatar, radius=float("nan"))
    with pytest.raises(ls.ConfigError, match="radius is 'wide', expected metres"):
        ls.metrics.paa_y(avatar, avatar, radius="wide")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="around has 1 non-finite"):
        ls.metrics.LitPoints.of(gaussians, around=(np.nan, 0, 0), radius=1.0)
    with pytest.raises(ls.ConfigError, match="samples is 0"):
        ls.metrics.ncm_ab(avatar, avatar, samples=0)
    with pytest.raises(ls.SceneError, match="has no Gaussians"):
        ls.metrics.LitPoints.of(ls.Scene())
    with pytest.raises(ls.SceneError, match="take Gaussians or LitPoints, got a list"):
        ls.metrics.LitPoints.of([gaussians])  # pyright: ignore[reportArgumentType]
    with pytest.raises(ls.SceneError, match="rgb: 1 of 4,000 are negative"):
        points(np.where(np.arange(4000) == 7, -0.1, 0.1))
    with pytest.raises(ls.SceneError, match="zero points"):
        ls.metrics.LitPoints(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3)))


def test_missing_package_pot_is_reported_with_the_pip_command(monkeypatch):
    """The error names the extra."""
    monkeypatch.setitem(sys.modules, "ot", None)
    with pytest.raises(ls.errors.MissingExtraError, match=r"ncm_ab needs .* pip install 'lumisplat\[metrics\]'"):
        ls.metrics.ncm_ab(points(np.full(4000, 0.2)), points(np.full(4000, 0.2)))
