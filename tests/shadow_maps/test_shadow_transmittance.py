"""Gradients of shadow transmittance equal central differences, and its values equal quadrature and shadow maps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config import Absorption, DeepShadowConfig
from lumisplat.math.transforms import matrices_from_quaternions

LIGHT = np.array([0.3, -3.0, 0.2])
SUN = ls.LightDirectional((-0.1, 1.0, 0.2))
WEIGHTS = np.array([1.0, -0.5, 2.0, 0.7, 0.4])
POINTS = np.array([[0.1, 1.0, 0.0], [0.0, 0.1, 0.1], [-0.3, 2.0, 0.4], [0.5, -0.2, 0.0], [1.5, 1.0, 2.0]])
"""Points behind, within and beside the casters."""


def loss(gaussians: ls.Gaussians, light: object, config: DeepShadowConfig) -> float:
    """Returns the transmittances at the points, weighted."""
    return float(WEIGHTS @ ls.gradients.shadow_transmittance(gaussians, light, POINTS, config).transmittance)


def casters() -> ls.Gaussians:
    """Returns five Gaussians between the light and the points, one of them around the light."""
    rng = np.random.default_rng(2)
    means = np.concatenate([rng.normal(0.0, 0.3, (4, 3)), [[0.3, -3.1, 0.4]]])
    quaternions = rng.normal(size=(5, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    scales = np.concatenate([rng.uniform(0.1, 0.6, (4, 3)), [[9.0, 8.0, 7.0]]])
    return ls.Gaussians(means, quaternions, scales, rng.uniform(0.3, 0.95, 5), np.zeros((5, 1, 3)))


@pytest.mark.parametrize("light", [LIGHT, SUN], ids=["point", "parallel"])
@pytest.mark.parametrize("absorption", list(Absorption))
def test_shadow_transmittance_equals_the_integral_of_the_absorption(absorption: Absorption, light: object) -> None:
    """The midpoint rule over the segment, with the method page's formulas; parallel light starts 50 units away."""
    gaussians, config = casters(), DeepShadowConfig(absorption=absorption, strength=0.4)
    found = ls.gradients.shadow_transmittance(gaussians, light, POINTS, config).transmittance
    scales = gaussians.scales.astype(np.float64)
    factor = {
        Absorption.SIMPLE: np.ones(5),
        Absorption.AVERAGE: np.sqrt((scales**-2).mean(axis=1) / (2 * np.pi)),
    }.get(absorption, (2 * np.pi) ** -1.5 / scales.prod(axis=1))
    beta = -0.4 * np.log(1.0 - gaussians.opacities.astype(np.float64)) * factor
    turned = matrices_from_quaternions(gaussians.rotations_wxyz) * scales[:, None]
    precision = np.linalg.inv(turned @ turned.transpose(0, 2, 1))
    u = (np.arange(1000) + 0.5) / 1000
    for value, point in zip(found, POINTS, strict=True):
        start = point - 50.0 * np.array(SUN.direction) if light is SUN else LIGHT
        offset = start + u[:, None, None] * (point - start) - gaussians.means
        exponent = np.einsum("uni,nij,unj->un", offset, precision, offset)
        depth = np.linalg.norm(point - start) * (np.exp(-0.5 * exponent) @ beta).mean()
        assert value == pytest.approx(np.exp(-depth), rel=1e-4)


def test_casters_with_an_origin_stand_there() -> None:
    """Means are relative to the origin of a capture."""
    moved = replace(casters(), means=casters().means - np.array([5.0, 0.0, 0.0], np.float32), origin=(5.0, 0.0, 0.0))
    found = [ls.gradients.shadow_transmittance(one, LIGHT, POINTS).transmittance for one in (casters(), moved)]
    np.testing.assert_allclose(*found, rtol=1e-5)
    assert found[0].min() < 0.9


@pytest.mark.parametrize("light", [LIGHT, ls.LightSphere(LIGHT, 0.5), SUN], ids=["point", "sphere", "parallel"])
def test_shadow_transmittance_equals_a_fine_deep_shadow_map(light: object) -> None:
    """A map of many texels and bins has the same values up to its interpolation; a sphere counts as its centre."""
    gaussians = casters().subset(np.arange(4))
    config = DeepShadowConfig(resolution=1024, bins=512)
    shadow = ls.DeepShadowMap.build(gaussians, SUN if light is SUN else LIGHT, POINTS, config, device="cpu")
    exact = ls.gradients.shadow_transmittance(gaussians, light, POINTS, config).transmittance
    assert exact.min() < 0.5
    np.testing.assert_allclose(shadow.transmittance(POINTS), exact, atol=2e-3)


@pytest.mark.parametrize("light", [LIGHT, SUN], ids=["point", "parallel"])
@pytest.mark.parametrize("absorption", [Absorption.SIMPLE, Absorption.AVERAGE, Absorption.MASS])
def test_gradients_of_shadow_transmittance_equal_central_differences(absorption: Absorption, light: object) -> None:
    """By each parameter of each Gaussian; the large Gaussian's short segments take quadrature."""
    gaussians, config = casters(), DeepShadowConfig(absorption=absorption, strength=0.4)
    found, _ = ls.gradients.shadow_transmittance(gaussians, light, POINTS, config).gradients(WEIGHTS)
    for name in ("means", "rotations_wxyz", "scales", "opacities"):
        values = getattr(gaussians, name)
        expected = np.zeros(values.shape)
        for index in np.ndindex(*values.shape):
            ends = []
            for step in (1e-3, -1e-3):
                moved = values.copy()
                moved[index] += step
                ends.append((loss(replace(gaussians, **{name: moved}), light, config), float(moved[index])))
            expected[index] = (ends[0][0] - ends[1][0]) / (ends[0][1] - ends[1][1])
        assert np.abs(expected).max() > 1e-4
        np.testing.assert_allclose(getattr(found, name), expected, atol=2e-4 * np.abs(expected).max(), err_msg=name)
    assert found.sh.shape == gaussians.sh.shape and not found.sh.any()


@pytest.mark.parametrize(
    ("start", "light_at"),
    [(LIGHT, lambda position: position), (np.array(SUN.direction), ls.LightDirectional)],
    ids=["position", "direction"],
)
def test_gradient_of_shadow_transmittance_by_the_light_equals_central_differences(
    start: np.ndarray, light_at: Callable[[np.ndarray], object]
) -> None:
    """By the position of a point light, and by the direction of parallel light, which is normalised after each step."""
    gaussians, config = casters(), DeepShadowConfig(strength=0.4)
    result = ls.gradients.shadow_transmittance(gaussians, light_at(start), POINTS, config)
    ends = [[loss(gaussians, light_at(start + sign * step), config) for sign in (1, -1)] for step in 1e-5 * np.eye(3)]
    expected = np.subtract(*np.transpose(ends)) / 2e-5
    assert np.abs(expected).max() > 0.05
    np.testing.assert_allclose(result.gradients(WEIGHTS)[1], expected, atol=1e-7)


def test_shadow_transmittance_refuses_points_without_a_direction() -> None:
    """Shapes are checked, too."""
    for arguments, problem in (
        ((casters(), LIGHT, [LIGHT]), "points has one at the light"),
        ((casters(), LIGHT[:2], POINTS), "light_position"),
        ((casters(), LIGHT, POINTS[:, :2]), r"points has shape \(5, 2\)"),
    ):
        with pytest.raises(ls.SceneError, match=problem):
            ls.gradients.shadow_transmittance(*arguments)
    with pytest.raises(ls.SceneError, match=r"dL_dtransmittance has shape \(2,\), expected \(5,\)"):
        ls.gradients.shadow_transmittance(casters(), LIGHT, POINTS).gradients([1.0, 2.0])
