"""Frames with values from closed forms, for the renderer and its float64 twin."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import SH_C0
from support.compare.backends import BACKENDS, renderer_of
from support.oracles import raster_oracle as oracles
from support.scenes.raster_scenes import front_camera, joined, one_gaussian, random_gaussians, rotation

Drawn = SimpleNamespace | ls.Frame
Draw = Callable[..., Drawn]
CENTRE = (24, 32)
NO_DILATION = ls.RenderConfig(raster=ls.RasterConfig(dilation=0.0))


@pytest.fixture(params=["twin", *BACKENDS])
def draw(request: pytest.FixtureRequest) -> Draw:
    """Returns a function that draws Gaussians with the twin or with one backend of the renderer."""

    def call(gaussians: ls.Gaussians, camera: ls.Camera, config: ls.RenderConfig | None = None) -> Drawn:
        scene = ls.Scene([gaussians])
        if request.param == "twin":
            return SimpleNamespace(**oracles.render(scene, camera, config))
        return renderer_of(request.param, config).render(scene, camera)

    return call


def centred_camera() -> ls.Camera:
    """Returns a camera whose optical axis passes through the centre of pixel (24, 32)."""
    return front_camera(cx=32.5, cy=24.5)


@pytest.mark.parametrize("opacity", [0.004, 0.1, 0.5, 0.98])
def test_rasterised_alpha_at_the_mean_of_a_gaussian_is_its_opacity(draw: Draw, opacity: float) -> None:
    """The colour at the pixel centre is the colour of the Gaussian times alpha."""
    frame = draw(one_gaussian(opacity=opacity, color=(0.9, 0.5, 0.1)), centred_camera())
    assert frame.alpha[CENTRE] == pytest.approx(opacity, rel=1e-4)
    assert frame.color[CENTRE] == pytest.approx(opacity * np.array([0.9, 0.5, 0.1]), rel=1e-4)


@pytest.mark.parametrize(("opacity", "alpha"), [(1.0, 0.99), (0.995, 0.99), (1.0 / 256.0, 0.0)])
def test_rasterised_alpha_is_at_most_0_99_and_is_set_to_0_below_1_255(draw: Draw, opacity: float, alpha: float) -> None:
    """The bounds 0.99 and 1/255 are those of Kerbl et al. 2023."""
    frame = draw(one_gaussian(opacity=opacity), centred_camera())
    assert frame.alpha[CENTRE] == pytest.approx(alpha, abs=1e-6)
    assert frame.alpha.max() == pytest.approx(alpha, abs=1e-6)


def test_nearer_gaussian_is_blended_over_the_farther_one_for_any_order_in_the_scene(draw: Draw) -> None:
    """The background shows behind both Gaussians."""
    near = one_gaussian((0.0, 0.0, 3.0), opacity=0.6, color=(1.0, 0.0, 0.2))
    far = one_gaussian((0.0, 0.0, 5.0), opacity=0.5, color=(0.0, 1.0, 0.4))
    for gaussians in (joined(near, far), joined(far, near)):
        frame = draw(gaussians, centred_camera(), ls.RenderConfig(background=(0.1, 0.2, 1.0)))
        expected = (
            0.6 * np.array([1.0, 0.0, 0.2]) + 0.4 * 0.5 * np.array([0.0, 1.0, 0.4]) + 0.2 * np.array([0.1, 0.2, 1.0])
        )
        assert frame.color[CENTRE] == pytest.approx(expected, abs=1e-5)
        assert frame.alpha[CENTRE] == pytest.approx(0.8, abs=1e-5)


def test_projected_variance_of_a_gaussian_includes_the_dilation(draw: Draw) -> None:
    """One pixel from the mean, the response is exp(-1 / (2 v)); v = (f s / z)^2 + 0.3 for focal length f, scale s."""
    frame = draw(one_gaussian((0.0, 0.0, 4.0), 0.1, 0.8), centred_camera())
    variance = (60.0 * 0.1 / 4.0) ** 2 + 0.3
    for dy, dx in ((0, 1), (-2, 0), (1, -3)):
        expected = 0.8 * np.exp(-0.5 * (dx * dx + dy * dy) / variance)
        assert frame.alpha[24 + dy, 32 + dx] == pytest.approx(expected, rel=2e-4)


def test_footprint_of_a_splat_ends_where_its_alpha_is_1_255(draw: Draw) -> None:
    """The ellipse extends exactly to alpha 1/255, without a cut at three standard deviations."""
    gaussians = one_gaussian((0.0, 0.0, 4.0), 0.25, 0.9)
    frame = draw(gaussians, centred_camera())
    y, x = np.mgrid[:48, :64] - np.array(CENTRE)[:, None, None]
    alpha = 0.9 * np.exp(-0.5 * (x * x + y * y) / ((60.0 * 0.25 / 4.0) ** 2 + 0.3))
    inside = alpha >= 1.0 / 255.0
    sure = np.abs(alpha * 255.0 - 1.0) > 1e-3
    assert np.array_equal((frame.alpha > 0.0)[sure], inside[sure])
    assert inside[24, :32].argmax() < 32 - 3 * 3.8, "the example must reach beyond three standard deviations"
    np.testing.assert_allclose(frame.alpha[sure], np.where(inside, alpha, 0.0)[sure], atol=1e-5)


def test_blending_stops_before_transmittance_falls_below_its_minimum(draw: Draw) -> None:
    """The Gaussian that would reduce the transmittance to 1e-4 is dropped, and so are all behind it."""
    colors = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0)]
    opacities = [0.9, 0.95, 0.985, 0.5]  # T: 0.1, 0.005, 0.000075 (dropped), then 0.0025 would have been fine.
    layers = [
        one_gaussian((0.0, 0.0, 3.0 + i), 0.3, a, c) for i, (a, c) in enumerate(zip(opacities, colors, strict=True))
    ]
    frame = draw(joined(*layers), centred_camera())
    assert frame.alpha[CENTRE] == pytest.approx(0.995, abs=1e-5)
    assert frame.color[CENTRE] == pytest.approx([0.9, 0.095, 0.0], abs=1e-5)


def test_negative_sh_colour_is_drawn_as_black(draw: Draw) -> None:
    """A negative SH sum does not darken the colours behind the Gaussian."""
    dark = one_gaussian((0.0, 0.0, 3.0), opacity=0.5, color=(-4.0, 0.2, 0.2))
    frame = draw(joined(dark, one_gaussian((0.0, 0.0, 5.0), opacity=0.5, color=(0.8, 0.0, 0.0))), centred_camera())
    assert frame.color[CENTRE] == pytest.approx([0.25 * 0.8, 0.1, 0.1], abs=1e-5)


@pytest.mark.parametrize(
    ("coefficient", "direction", "factor"),
    [(1, (0, 1, 0), -1), (2, (0, 0, 1), 1), (3, (1, 0, 0), -1), (1, (0, -1, 0), 1), (3, (0, 0, 1), 0)],
)
def test_sh_coefficients_of_degree_1_have_the_signs_of_kerbl_et_al(
    draw: Draw, coefficient: int, direction: tuple[float, ...], factor: float
) -> None:
    """Seen along an axis, a coefficient of degree 1 adds sqrt(3 / 4 pi) or its negative."""
    sh = np.zeros((1, 4, 3))
    sh[0, coefficient] = 0.3
    gaussians = ls.Gaussians([[0, 0, 0]], [[1, 0, 0, 0]], [[0.2] * 3], [0.9], sh)
    up = (0.0, 0.0, 1.0) if direction[2] == 0 else (0.0, 1.0, 0.0)
    camera = ls.Camera.look_at(-4.0 * np.array(direction), (0, 0, 0), up, width=65, height=49)
    color = draw(gaussians, camera).color[CENTRE] / 0.9
    assert color == pytest.approx(0.5 + factor * 0.3 * np.sqrt(3.0 / (4.0 * np.pi)), abs=2e-5)


def test_sh_coefficient_of_degree_0_gives_the_base_colour_of_a_gaussian(draw: Draw) -> None:
    """The colour is the first coefficient times Y_00, plus one half."""
    gaussians = ls.Gaussians([[0, 0, 4]], [[1, 0, 0, 0]], [[0.2] * 3], [0.5], [[[1.0, 0.0, -1.0]]])
    expected = 0.5 * np.maximum(0.5 + SH_C0 * np.array([1.0, 0.0, -1.0]), 0.0)
    assert draw(gaussians, centred_camera()).color[CENTRE] == pytest.approx(expected, abs=1e-5)


def test_antialiased_sub_pixel_gaussian_has_a_summed_alpha_equal_to_its_area(draw: Draw) -> None:
    """For a Gaussian far smaller than a pixel, the summed alpha is the Gaussian's area, not that of the dilation."""
    scale, depth, opacity = 0.02, 4.0, 0.9
    frame = draw(one_gaussian((0.0, 0.0, depth), scale, opacity, antialiased=True), front_camera(focal=120.0))
    variance = (120.0 * scale / depth) ** 2
    compensated = opacity * variance / (variance + 0.3)
    assert frame.alpha.max() < compensated
    reach = 1.0 - 1.0 / 255.0 / compensated  # the fraction of the integral inside alpha = 1/255
    assert frame.alpha.sum() == pytest.approx(2.0 * np.pi * opacity * variance * reach, rel=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_alpha_of_a_distant_anisotropic_gaussian_equals_its_line_integral(draw: Draw, seed: int) -> None:
    """Alpha is the opacity times the line integral along the pixel's ray, normalised to a maximum of 1."""
    source = random_gaussians(seed, 1, scale_range=(0.1, 1.0))
    gaussians = ls.Gaussians([[0, 0, 0]], source.rotations_wxyz, source.scales, [0.9], source.sh)
    distance = 4000.0
    turn = rotation((1.0, -2.0, 0.7), 0.9 + seed)
    pose = turn.copy()
    pose[:3, 3] = (0.0, 0.0, distance)
    focal = distance * 8.0  # 8 pixels a unit
    camera = ls.Camera(width=41, height=31, fx=focal, fy=focal, cx=20.5, cy=15.5, camera_from_world=pose)
    frame = draw(gaussians, camera, NO_DILATION)

    axes = oracles.rotation_from_quaternion(gaussians.rotations_wxyz.astype(np.float64))[0]
    inverse_covariance = axes / gaussians.scales[0].astype(np.float64) ** 2 @ axes.T
    x, y = (np.arange(41) - 20) / 8.0, (np.arange(31) - 15) / 8.0
    t = np.linspace(-10.0, 10.0, 2001)
    points = np.stack(np.broadcast_arrays(x[None, :, None], y[:, None, None], t), axis=-1) @ turn[:3, :3]
    density = np.exp(-0.5 * np.einsum("yxti,ij,yxtj->yxt", points, inverse_covariance, points))
    expected = 0.9 * density.sum(axis=-1) / density.sum(axis=-1).max()
    sure = np.abs(expected * 255.0 - 1.0) > 0.05
    np.testing.assert_allclose(frame.alpha[sure], np.where(expected >= 1.0 / 255.0, expected, 0.0)[sure], atol=2e-3)
    assert (expected > 0.1).sum() > 20


def test_front_to_back_blending_equals_back_to_front_blending(draw: Draw) -> None:
    """Blending the splats from the back with the over operator gives equal colours up to float32 rounding."""
    gaussians = random_gaussians(60, 80, degree=1)
    camera = front_camera()
    config = ls.RenderConfig(background=(0.3, 0.6, 0.9), raster=ls.RasterConfig(transmittance_min=0.0))
    frame = draw(gaussians, camera, config)
    splats = oracles.project(ls.Scene([gaussians]), camera, config.raster)
    image = np.tile([0.3, 0.6, 0.9], (48, 64, 1))
    whole = slice(0, 48), slice(0, 64)
    band = np.zeros((48, 64), bool)
    for i in reversed(range(len(splats.depth_z))):
        alpha = np.minimum(splats.opacity[i] * oracles.response(splats, i, whole), 0.99)
        band |= np.abs(alpha * 255.0 - 1.0) < 2e-3
        alpha = np.where(alpha >= 1.0 / 255.0, alpha, 0.0)[..., None]
        image = alpha * splats.color[i] + (1.0 - alpha) * image
    np.testing.assert_allclose(frame.color[~band], image[~band], atol=1e-5)
    assert band.mean() < 0.1
