"""`relight` scales captured colours by a probe, by equations 9 and 10 of Mir et al."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.demo import shapes
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.relighting.probe_transfer import light_scales
from support.oracles.probe_oracle import some_probe, transfer_scales
from support.scenes.raster_scenes import front_camera, one_gaussian, random_gaussians, similarity
from support.scenes.sphere import unit


def display_colors(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns display-referred colours without view dependence, shape (N, 3)."""
    return SH_C0 * gaussians.sh[:, 0] + 0.5


@pytest.mark.parametrize(
    "settings",
    [
        {"exponent": 2.0},
        {"exponent": 7.3, "rows": 24},
        {"exponent": 2.0, "scale_max": 0.8},
        {"exponent": 2.0, "rows": 8},
        {"exponent": 0.5},
    ],
)
def test_factors_by_which_relight_scales_colours_match_the_equations_of_mir_et_al(settings: dict) -> None:
    """There are more normals than one batch holds, and some lie along the axes."""
    config = ls.config.RelightConfig(**settings)
    normals = np.concatenate([np.eye(3), -np.eye(3), unit(1, 2500)])
    twin = transfer_scales(some_probe().coefficients, normals, config)
    np.testing.assert_allclose(light_scales(some_probe(), 7.0 * normals, config), twin, atol=1e-5)
    assert (twin == 0.0).any() or config.exponent < 7.0


def test_relight_with_exponent_1_scales_colours_by_irradiance_over_pi() -> None:
    """The closed form is exact, and the limit of the paper's sum over a latitude-longitude grid."""
    probe, normals = ls.avatars.EnvironmentProbe(np.abs(some_probe().coefficients)), unit(2, 200)
    exact = np.clip(probe.irradiance(normals) / np.pi, 0.0, 1e3)
    config = ls.config.RelightConfig(scale_max=1e3)
    np.testing.assert_allclose(light_scales(probe, normals, config), exact, rtol=1e-5)
    for rows, most in ((16, 0.02), (64, 0.0015)):
        assert (
            np.abs(transfer_scales(probe.coefficients, normals, replace(config, rows=rows)) - exact).max()
            < most * exact.max()
        )


@pytest.mark.parametrize("exponent", [2.0, 8.0, 64.0])
def test_colour_factors_of_relight_from_16_grid_rows_are_within_1_percent_of_those_from_128(exponent: float) -> None:
    """The reference is a grid of 128 rows, for any exponent and any normal."""
    probe, normals = some_probe(), unit(3, 400)
    rough, fine = (
        light_scales(probe, normals, ls.config.RelightConfig(exponent=exponent, rows=rows, scale_max=1e3))
        for rows in (16, 128)
    )
    assert np.abs(rough - fine).max() < 0.01 * fine.max()


@pytest.mark.parametrize("settings", [{}, {"exponent": 3.7}, {"exponent": 64.0}, {"rows": 61}])
def test_relighting_by_constant_radiance_1_changes_no_bit(settings: dict) -> None:
    """The scales are exactly 1 for any exponent and grid."""
    gaussians = random_gaussians(4, 1500, 3)
    even = np.zeros((16, 3))
    even[0] = np.sqrt(4.0 * np.pi)
    relit = ls.relight(gaussians, ls.avatars.EnvironmentProbe(even), ls.config.RelightConfig(**settings), unit(5, 1500))
    assert relit is gaussians


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE])
def test_relighting_by_a_captured_white_environment_changes_nothing(pipeline: ls.Pipeline) -> None:
    """A probe of a white background, rendered and fitted, gives scales of exactly 1."""
    config = ls.RenderConfig(pipeline=pipeline, background=(1.0, 1.0, 1.0))
    scene = ls.Scene([one_gaussian((0.0, 0.0, 2.0), color=(1.0, 1.0, 1.0), opacity=1e-3)])
    probe = ls.avatars.EnvironmentProbe.capture(scene, (0, 0, 0), config=config, device="cpu")
    gaussians = random_gaussians(6, 300, 1)
    np.testing.assert_array_equal(ls.relight(gaussians, probe).sh, gaussians.sh)


def test_gamma_setting_of_relight_multiplies_the_linear_light() -> None:
    """Constant radiance L with gamma g multiplies linear colours by L g."""
    gaussians = random_gaussians(7, 200)
    colors = display_colors(gaussians)
    seen = colors > 0.01
    for level, gamma in ((1.0, 0.5), (0.25, 1.0), (0.25, 4.0), (1.0, 0.0)):
        probe = ls.avatars.EnvironmentProbe.fit(unit(8, 100), np.full((100, 3), level), degree=0)
        relit = display_colors(ls.relight(gaussians, probe, ls.config.RelightConfig(gamma=gamma)))
        expected = encode_srgb(level * gamma * decode_srgb(colors.astype(np.float64)))
        np.testing.assert_allclose(relit[seen], expected[seen], atol=1e-5)


def test_relighting_scales_each_colour_channel_separately() -> None:
    """Red light removes green and blue."""
    probe = ls.avatars.EnvironmentProbe.fit(unit(9, 100), np.tile([[0.5, 0.0, 0.0]], (100, 1)), degree=0)
    relit = display_colors(ls.relight(one_gaussian(color=(0.8, 0.8, 0.8)), probe))
    np.testing.assert_allclose(relit, [[encode_srgb(0.5 * decode_srgb(np.array(0.8))), 0.0, 0.0]], atol=1e-5)


def test_ball_relit_from_one_side_is_brighter_on_that_side() -> None:
    """A ball under light from +x darkens away from +x; a larger exponent darkens it faster."""
    directions = unit(10, 20_000)
    environment = np.where(directions[:, :1] > 0.8, 5.0, 0.1) * np.ones(3)
    probe = ls.avatars.EnvironmentProbe.fit(directions, environment)
    ball = replace(ls.gaussians_from_mesh(shapes.sphere(), 1500), normals=None)
    relit = {q: display_colors(ls.relight(ball, probe, ls.config.RelightConfig(exponent=q)))[:, 0] for q in (1.0, 8.0)}
    x = ball.means[:, 0]
    front, rim, back = x > 0.9, np.abs(x) < 0.1, x < -0.9
    for colors in relit.values():
        assert colors[front].min() > 1.5 * max(colors[rim].max(), colors[back].max())
    assert relit[1.0][rim].mean() > 1.2 * relit[1.0][back].mean() > 0.0
    assert relit[8.0][front].mean() > 1.2 * relit[1.0][front].mean()
    assert np.corrcoef(x, relit[1.0])[0, 1] > 0.9


def test_relighting_an_instance_rotates_normals_by_its_transform() -> None:
    """Translation and scale do not change the colours, and everything but the colours is unchanged."""
    gaussians = ls.gaussians_from_mesh(shapes.torus(), 800)
    pose = similarity((0.3, 1.0, -0.4), 2.0, 7.0, (5.0, -3.0, 1.0))
    instance = ls.SplatInstance(gaussians, pose, ls.MaterialPbr(), name="ring", sh_degree=2, shadow_catcher=True)
    relit = ls.relight(instance, some_probe())
    assert gaussians.normals is not None
    turned = gaussians.normals @ (pose[:3, :3] / 7.0).T
    expected = ls.relight(gaussians, some_probe(), normals=turned)
    np.testing.assert_allclose(relit.gaussians.sh, expected.sh, atol=1e-5)
    assert np.abs(relit.gaussians.sh - ls.relight(gaussians, some_probe()).sh).max() > 0.1
    for name in ("material", "name", "sh_degree", "shadow_catcher"):
        assert getattr(relit, name) == getattr(instance, name)
    np.testing.assert_array_equal(relit.transform, instance.transform)
    for name, values in gaussians.arrays().items():
        if name != "sh":
            assert getattr(relit.gaussians, name) is values


def test_relighting_uses_given_normals_instead_of_stored_ones() -> None:
    """The given normals may have any length."""
    gaussians = ls.gaussians_from_mesh(shapes.sphere(), 300)
    up = np.tile([[0.0, 3.0, 0.0]], (300, 1))
    scale = light_scales(some_probe(), [[0.0, 1.0, 0.0]])[0]
    relit = display_colors(ls.relight(gaussians, some_probe(), normals=up))
    np.testing.assert_allclose(relit, encode_srgb(scale * decode_srgb(display_colors(gaussians))), atol=1e-5)


@pytest.mark.parametrize(("name", "most"), [("relit.ply", 1e-5), ("relit.spz", 0.02)])
def test_saved_relit_capture_renders_like_the_relit_capture(tmp_path, name: str, most: float) -> None:
    """View dependence is preserved, and PLY files keep the colours to the bit."""
    relit = ls.relight(random_gaussians(11, 150, 2), some_probe(), ls.config.RelightConfig(gamma=0.6))
    ls.save(tmp_path / name, relit)
    loaded = ls.load(tmp_path / name)
    assert isinstance(loaded, ls.Gaussians)
    if name == "relit.ply":
        np.testing.assert_array_equal(loaded.sh, relit.sh)
    renderer = ls.create_renderer(None, "cpu")
    shown, again = (renderer.render(ls.Scene([one]), front_camera()).color for one in (relit, loaded))
    np.testing.assert_allclose(again, shown, atol=most)
    assert shown.max() > 0.3


AVATAR, PROBE, CONFIG, PCA = (cast(Any, wrong) for wrong in ("avatar", "probe", {"gamma": 2}, "mean"))
"""Values of wrong types for the arguments of `relight`."""


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: ls.relight(AVATAR, some_probe()), ls.SceneError, "takes Gaussians or a SplatInstance, got a str"),
        (lambda: ls.relight(one_gaussian(), PROBE), ls.SceneError, "expected an EnvironmentProbe, got a str"),
        (lambda: ls.relight(one_gaussian(), some_probe(), CONFIG), ls.ConfigError, "expected a RelightConfig"),
        (
            lambda: ls.relight(one_gaussian(), some_probe(), normals=np.eye(3)),
            ls.SceneError,
            "normals has shape (3, 3)",
        ),
        (lambda: ls.relight(one_gaussian(), some_probe(), normals=[[0, 0, 0]]), ls.SceneError, "1 of 1 are of zero"),
        (lambda: ls.relight(one_gaussian(), some_probe(), normals=[[np.nan, 0, 0]]), ls.SceneError, "1 non-finite"),
        (lambda: ls.config.RelightConfig(exponent=0.0), ls.ConfigError, "exponent is 0.0, expected 0.1 to 64.0"),
        (lambda: ls.config.RelightConfig(scale_max=-1.0), ls.ConfigError, "scale_max is -1.0"),
        (lambda: ls.config.RelightConfig(gamma=np.inf), ls.ConfigError, "gamma is inf"),
        (
            lambda: ls.config.RelightConfig(normals=PCA),
            ls.ConfigError,
            "normals is 'mean', expected 'auto', 'smallest-axis', 'pca' or 'smooth'",
        ),
        (lambda: ls.config.RelightConfig(rows=7), ls.ConfigError, "rows is 7, expected a whole number from 8 to 128"),
    ],
)
def test_relight_refuses_invalid_arguments_with_a_one_line_error(
    call: Callable[[], object], error: type[Exception], message: str
) -> None:
    """The message is one line that names the argument."""
    with pytest.raises(error) as caught:
        call()
    assert message in str(caught.value) and "\n" not in str(caught.value)
