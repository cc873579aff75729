"""Gradients of light probes equal central differences: of irradiance, of relit colours, and of captured probes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.sh import sh_basis
from lumisplat.relighting import probe_gradients
from support.oracles import probe_oracle as oracle
from support.scenes.raster_scenes import random_gaussians
from support.scenes.sphere import sphere_quadrature, unit

STEP = 1e-5
NORMALS = unit(1, 7) * np.linspace(0.5, 3.0, 7)[:, None]


def differences(loss: Callable[[np.ndarray], float], at: np.ndarray) -> np.ndarray:
    """Returns central differences of a loss by each element of an array."""
    found = np.zeros(at.shape)
    for index in np.ndindex(*at.shape):
        step = np.zeros(at.shape)
        step[index] = STEP
        found[index] = (loss(at + step) - loss(at - step)) / (2.0 * STEP)
    return found


def captured() -> ls.Gaussians:
    """Returns seven Gaussians of degree 1: one of them black, one almost."""
    gaussians = random_gaussians(3, 7, 1)
    sh = gaussians.sh.copy()
    sh[0, 0], sh[1, 0] = -3.0, -1.7
    return replace(gaussians, sh=sh)


@pytest.mark.parametrize("degree", [0, 3, 4])
def test_gradients_of_irradiance_equal_central_differences(degree: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """By coefficients and normals of any length, over several batches of normals; irradiance is the integral."""
    monkeypatch.setattr(probe_gradients, "NORMALS_AT_ONCE", 3)
    probe, upstream = oracle.some_probe(2, degree), np.random.default_rng(4).normal(size=NORMALS.shape)
    result = ls.gradients.probe_irradiance(probe, NORMALS)
    directions, weights = sphere_quadrature(200)
    lobes = weights * np.maximum(NORMALS @ directions.T, 0.0) / np.linalg.norm(NORMALS, axis=1, keepdims=True)
    integral = lobes @ (sh_basis(directions, degree) @ probe.coefficients)
    np.testing.assert_allclose(result.irradiance, integral, atol=1e-4)
    np.testing.assert_allclose(result.irradiance, probe.irradiance(NORMALS), atol=1e-5)

    def loss(coefficients: np.ndarray, normals: np.ndarray) -> float:
        changed = ls.gradients.probe_irradiance(ls.avatars.EnvironmentProbe(coefficients), normals)
        return float((upstream * changed.irradiance).sum())

    by_coefficients, by_normals = result.gradients(upstream)
    expected = differences(lambda changed: loss(changed, NORMALS), probe.coefficients)
    np.testing.assert_allclose(by_coefficients, expected, atol=1e-8)
    expected = differences(lambda changed: loss(probe.coefficients, changed), NORMALS)
    assert np.abs(expected).max() > 0.1 or degree == 0
    np.testing.assert_allclose(by_normals, expected, atol=1e-8)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"gamma": 0.6},
        {"gamma": 1000.0},
        {"scale_max": 0.9},
        {"exponent": 2.5, "gamma": 1.5},
        {"exponent": 7.3, "rows": 24},
    ],
)
def test_gradients_of_relit_gaussians_equal_central_differences_of_the_float64_reference(
    settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By coefficients, normals and captured SH, over several batches of normals; some factors are clipped."""
    monkeypatch.setattr(probe_gradients, "NORMALS_AT_ONCE", 3)
    config, probe, gaussians = ls.config.RelightConfig(**settings), oracle.some_probe(2), captured()
    upstream = np.random.default_rng(5).normal(size=gaussians.sh.shape)
    result = ls.gradients.relit_gaussians(gaussians, probe, NORMALS, config)
    sh = gaussians.sh.astype(np.float64)
    np.testing.assert_allclose(
        result.gaussians.sh, oracle.relit_sh(sh, probe.coefficients, NORMALS, config), 1e-5, 1e-5
    )
    start = {"coefficients": probe.coefficients, "normals": NORMALS, "sh": sh}
    for (name, values), found in zip(start.items(), result.gradients(upstream), strict=True):

        def loss(changed: np.ndarray, name: str = name) -> float:
            given = start | {name: changed}
            return float(
                (upstream * oracle.relit_sh(given["sh"], given["coefficients"], given["normals"], config)).sum()
            )

        expected = differences(loss, values)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max(), err_msg=name)


def test_clipped_factors_of_light_have_gradients_of_0() -> None:
    """Surfaces that receive no light, or more than ``scale_max``, have no gradient by light and normal."""
    gaussians, probe = captured(), oracle.some_probe()
    upstream = np.ones(gaussians.sh.shape)
    for brightness in (-1.0, 5.0):
        coefficients = 0.1 * probe.coefficients
        coefficients[0] = brightness * np.sqrt(4.0 * np.pi)
        flat = ls.avatars.EnvironmentProbe(coefficients)
        for exponent in (1.0, 3.0):
            config = ls.config.RelightConfig(exponent=exponent)
            found = ls.gradients.relit_gaussians(gaussians, flat, NORMALS, config).gradients(upstream)
            assert not found[0].any() and not found[1].any()
            assert found[2].any() == (brightness > 0.0)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE])
def test_gradients_of_captured_probes_equal_central_differences(pipeline: ls.Pipeline) -> None:
    """By the parameters of Gaussians and by the position, within the hundredths that edges of footprints contribute."""
    rng = np.random.default_rng(6)
    quaternions = rng.normal(size=(4, 4))
    gaussians = ls.Gaussians(
        [[3.0, 0.0, 0.5], [-2.5, 1.0, 0.0], [0.0, -3.0, 1.0], [0.3, 0.2, 2.5]],
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        rng.uniform(0.4, 1.0, (4, 3)),
        rng.uniform(0.6, 0.98, 4),
        rng.normal(0.0, 0.4, (4, 4, 3)),
    )
    config = ls.RenderConfig(background=(0.2, 0.3, 0.1), pipeline=pipeline)
    position, weights = np.array([0.1, -0.2, 0.15]), rng.normal(size=(9, 3))
    renderer = ls.DifferentiableRenderer(config, "cpu")

    def loss(at: np.ndarray, **changed: np.ndarray) -> float:
        scene = ls.Scene([replace(gaussians, **changed)])
        probe = ls.avatars.EnvironmentProbe.capture(scene, at, 2, renderer=renderer)
        return float((weights * probe.coefficients).sum())

    result = ls.gradients.captured_probe(ls.Scene([gaussians]), position, 2, renderer)
    ordinary = ls.avatars.EnvironmentProbe.capture(ls.Scene([gaussians]), position, 2, config=config, device="cpu")
    np.testing.assert_array_equal(result.probe.coefficients, ordinary.coefficients)
    (found,), by_position = result.gradients(weights)
    for name, error in (("means", 0.03), ("rotations_wxyz", 0.03), ("scales", 0.03), ("opacities", 0.01), ("sh", 1e-4)):
        values, gradient = getattr(gaussians, name), getattr(found, name)
        step = 2e-3 * gradient / np.linalg.norm(gradient)
        expected = (loss(position, **{name: values + step}) - loss(position, **{name: values - step})) / 4e-3
        assert np.linalg.norm(gradient) == pytest.approx(expected, rel=error), name
    expected = [(loss(position + step) - loss(position - step)) / 4e-3 for step in 2e-3 * np.eye(3)]
    np.testing.assert_allclose(by_position, expected, atol=0.006 * np.abs(found.means).sum())
    np.testing.assert_allclose(by_position, -found.means.sum(axis=0), atol=1e-6)  # only what is between them counts


def test_gradients_of_captured_probes_sum_the_instances_of_a_set() -> None:
    """A set that is placed twice has one gradient, the sum of those of two sets."""
    gaussians = captured()
    moved = np.eye(4)
    moved[:3, 3] = 1.0, -2.0, 0.5
    renderer, weights = ls.DifferentiableRenderer(device="cpu"), np.random.default_rng(8).normal(size=(4, 3))
    scenes = [
        ls.Scene([ls.SplatInstance(first), ls.SplatInstance(second, moved)])
        for first, second in ((gaussians, gaussians), (gaussians, replace(gaussians)))
    ]
    (both,), by_position = ls.gradients.captured_probe(scenes[0], (0, 0, 0), 1, renderer).gradients(weights)
    (one, other), expected = ls.gradients.captured_probe(scenes[1], (0, 0, 0), 1, renderer).gradients(weights)
    assert np.abs(other.sh).max() > 1e-4 and np.abs(one.sh).max() > 1e-4
    np.testing.assert_allclose(both.sh, one.sh + other.sh, atol=1e-7)
    np.testing.assert_allclose(by_position, expected, atol=1e-6)


def test_gradients_of_probes_refuse_arguments_that_do_not_fit() -> None:
    """Shapes, types and settings are named in one line."""
    probe, gaussians = oracle.some_probe(), captured()
    unlit = ls.DifferentiableRenderer(ls.RenderConfig(background=None), "cpu")
    calls: list[tuple[Callable[[], object], type[Exception], str]] = [
        (lambda: ls.gradients.probe_irradiance(probe, NORMALS[0]), ls.SceneError, "normals"),
        (lambda: ls.gradients.probe_irradiance(probe, 0.0 * NORMALS), ls.SceneError, "of zero length"),
        (lambda: ls.gradients.probe_irradiance(cast(Any, gaussians), NORMALS), ls.SceneError, "EnvironmentProbe, got"),
        (lambda: ls.gradients.probe_irradiance(probe, NORMALS).gradients(NORMALS[1:]), ls.SceneError, r"\(6, 3\)"),
        (lambda: ls.gradients.relit_gaussians(gaussians, probe, NORMALS[1:]), ls.SceneError, "normals"),
        (lambda: ls.gradients.relit_gaussians(cast(Any, probe), probe, NORMALS), ls.SceneError, "takes Gaussians, got"),
        (lambda: ls.gradients.captured_probe(ls.Scene(), (0, 0), renderer=unlit), ls.ConfigError, "background"),
        (lambda: ls.gradients.captured_probe(ls.Scene(), (0, 0)), ls.SceneError, "position"),
    ]
    for call, kind, problem in calls:
        with pytest.raises(kind, match=problem):
            call()
