"""Captures of translucent Gaussians, as training makes them: normals come from views, and light from noisy colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.relighting.albedo_fit import (
    AlbedoPairFit,
    EnvironmentCells,
    Light,
    albedo_pairs,
    initial_light,
    with_white_balance,
)
from lumisplat.relighting.incident import neighbours_of
from lumisplat.relighting.irradiance import Irradiance
from lumisplat.relighting.seen_normals import normals_from_around
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer

UNLIT = ls.RenderConfig(pipeline=ls.Pipeline.RASTER, lighting=False)


@pytest.fixture(scope="module")
def tilted_ball() -> tuple[ls.Gaussians, np.ndarray]:
    """Returns a ball of translucent Gaussians that are tilted by about 40 degrees, and its true normals."""
    ball = ls.gaussians_from_mesh(ls.sphere(1.0), 3000)
    rotations = ball.rotations_wxyz + np.random.default_rng(2).normal(0.0, 0.2, (ball.count, 4))
    tilted = (rotations / np.linalg.norm(rotations, axis=1, keepdims=True)).astype(np.float32)
    opacities = np.full(ball.count, 0.6, np.float32)
    bare = replace(ball, rotations_wxyz=tilted, opacities=opacities, normals=None, albedo=None, roughness=None)
    return bare, np.asarray(ball.normals, np.float64)


def angles(normals: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Returns angles between unit vectors, degrees."""
    return np.degrees(np.arccos(np.clip((normals * true).sum(axis=1), -1.0, 1.0)))


def test_views_around_a_ball_show_its_normals_although_its_gaussians_are_tilted(
    tilted_ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """The mean error falls to less than half of that of the Gaussians' own axes; no normal points inwards."""
    ball, true = tilted_ball
    axes = ls.estimate_normals(ball, "smallest-axis").astype(np.float64)
    found = normals_from_around(
        ball, axes, DifferentiableRenderer(UNLIT, "cpu"), lambda row, towards: np.inf, rng=np.random.default_rng(0)
    )
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-6)
    assert angles(axes, true).mean() > 20.0
    assert angles(found, true).mean() < 10.0
    assert (angles(found, true) < 90.0).mean() > 0.99


def test_delight_takes_the_normals_of_a_translucent_capture_from_views(
    tilted_ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """Normals of translucent Gaussians are right, those of opaque ones are their axes; given ones are kept."""
    ball, true = tilted_ball
    config = ls.config.DelightConfig(cells=4, matt=True)
    opaque = replace(ball, opacities=np.full(ball.count, 0.99, np.float32))
    given = replace(ball, normals=-true.astype(np.float32))
    errors = [angles(np.asarray(ls.delight(one, config, device="cpu").normals), true) for one in (ball, opaque, given)]
    assert np.mean(errors[0]) < 12.0
    assert np.mean(errors[1]) > 24.0
    assert np.min(errors[2]) > 179.0


def test_delight_of_a_translucent_capture_gives_equal_bits_for_any_number_of_threads(
    tilted_ball: tuple[ls.Gaussians, np.ndarray],
) -> None:
    """One and two threads give equal normals and albedo."""
    config = ls.config.DelightConfig(cells=4, matt=True)
    one, two = (ls.delight(tilted_ball[0], config, device="cpu", threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(one.normals, two.normals)
    np.testing.assert_array_equal(one.albedo, two.albedo)


def test_light_is_found_from_pairs_of_translucent_gaussians_although_their_hues_vary() -> None:
    """Light from one side is found with an error below 0.1, logarithm, where pairs of opaque ones leave 0.3."""
    rng, cells = np.random.default_rng(4), EnvironmentCells.even(4)
    ball = ls.gaussians_from_mesh(ls.sphere(1.0), 2000)
    normals = np.asarray(ball.normals, np.float64)
    white = np.maximum(normals @ cells.directions.T, 0.0) * cells.solid_angles / np.pi
    incident = Irradiance(np.zeros((2000, 3)), white.astype(np.float32), np.zeros((2000, 0), np.float32))
    true = np.exp(1.5 * cells.directions[:, :1]) * np.ones(3)
    outgoing = 0.3 * np.exp(rng.normal(0.0, 0.12, (2000, 3))) * incident.total(true, np.zeros((0, 3)))
    near, errors = neighbours_of(ball), {}
    for opaque in (False, True):
        pairs, widths = albedo_pairs(near, np.arange(2000), 24_000, np.random.default_rng(0), opaque=opaque)
        light = AlbedoPairFit(outgoing, incident, pairs, widths, cells).solved(initial_light(outgoing, incident))
        errors[opaque] = np.log(
            incident.total(light.environment, light.emitters) / incident.total(true, np.zeros((0, 3)))
        ).std()
    assert errors[False] < 0.1
    assert errors[True] > 0.3


def test_white_balance_makes_the_median_irradiance_grey_and_keeps_its_level() -> None:
    """An orange light becomes grey, with the geometric mean of its channels."""
    rng = np.random.default_rng(1)
    incident = Irradiance(np.zeros((400, 3)), rng.random((400, 9), np.float32), np.zeros((400, 0), np.float32))
    orange = Light(rng.uniform(0.5, 2.0, (9, 1)) * (1.6, 1.0, 0.5), np.zeros((0, 3)))
    before = incident.total(orange.environment, orange.emitters)
    grey = with_white_balance(orange, incident)
    after = incident.total(grey.environment, grey.emitters)
    np.testing.assert_allclose(after, np.prod(before, axis=1, keepdims=True) ** (1.0 / 3.0) * np.ones(3), rtol=1e-5)
