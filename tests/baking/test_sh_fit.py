"""SH fits of viewed colours: exact where they can be, smooth in unviewed directions, stable under noise."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.baking.bake import fit_sh
from lumisplat.baking.bake_denoising import angularly_denoised
from lumisplat.baking.sample_rays import on_visible_sides, random_rotations, rotated_directions, view_weights
from lumisplat.math.sh import even_directions, sh_basis

N, D = 50, 32


def directions(count: int = D) -> np.ndarray:
    """Returns D view directions of each of N Gaussians, shape (N, D, 3)."""
    return rotated_directions(count, random_rotations(N, np.random.default_rng(0)))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_sh_fit_recovers_sh_from_noiseless_colours(degree: int) -> None:
    """Colours of a degree, viewed from all directions, are fitted except for a small ridge."""
    along = directions(64)
    truth = np.random.default_rng(1).normal(size=(N, (degree + 1) ** 2, 3))
    colors = 0.5 + sh_basis(along, degree) @ truth
    found = fit_sh(along, colors, np.zeros(N), np.ones((N, 64)), degree)
    assert found.shape == truth.shape
    np.testing.assert_allclose(found, truth, atol=0.12 * np.abs(truth).max())
    np.testing.assert_allclose(found[:, 0], truth[:, 0], atol=0.03)


def test_sh_fit_to_views_of_one_side_gives_the_other_side_colours_between_0_and_1() -> None:
    """One side is viewed and matched; colours of the other side do not overshoot."""
    along = directions()
    front = along[..., 2] < 0.0
    colors = np.where(front[..., None], 0.5 + 0.3 * along, 100.0)
    sh = fit_sh(along, colors, np.zeros(N), front.astype(float), 3)
    shown = 0.5 + sh_basis(along, 3) @ sh
    assert np.abs(shown - colors)[front].max() < 0.02
    assert 0.0 < shown.min() and shown.max() < 1.0


def test_sh_fit_does_not_turn_noise_into_view_dependence() -> None:
    """A noisy constant colour is fitted by that colour, with the noise of a mean over all directions."""
    rng = np.random.default_rng(2)
    along = directions()
    noisy = 0.5 + 0.1 * rng.normal(size=(N, D, 3))
    weights = np.ones((N, D))
    shown = 0.5 + sh_basis(along, 3) @ fit_sh(along, noisy, np.full(N, 0.01), weights, 3)
    trusted = 0.5 + sh_basis(along, 3) @ fit_sh(along, noisy, np.zeros(N), weights, 3)
    assert (shown - 0.5).std() < 0.035  # 0.1 / sqrt(32) is 0.018
    assert (trusted - 0.5).std() > 0.06


def test_angular_denoising_of_baked_colours_is_unbiased_and_keeps_view_dependence() -> None:
    """Noise on a diffuse side shrinks to the side's mean; view-dependent radiance stays."""
    rng = np.random.default_rng(3)
    front = directions()[..., 2] < 0.0
    weights = np.ones((N, D))
    even, odd = (np.where(front, 2.0, 0.5)[..., None] + 0.2 * rng.normal(size=(N, D, 3)) for _ in range(2))
    a, b = angularly_denoised(even, odd, weights, front)
    mean = 0.5 * (a + b)
    assert mean[front].std() < 0.6 * (0.5 * (even + odd))[front].std()
    assert abs(mean[front].mean() - 2.0) < 0.01 and abs(mean[~front].mean() - 0.5) < 0.01
    bright = np.where((np.arange(D) % 4 == 0)[None, :, None], 5.0, 0.0) + np.zeros((N, D, 3))
    a, b = angularly_denoised(bright, bright, weights, front)
    np.testing.assert_allclose(a, bright, atol=1e-12)
    np.testing.assert_allclose(b, bright, atol=1e-12)


def test_sums_over_evenly_spread_view_directions_integrate_sh_up_to_degree_3() -> None:
    """The directions sum to nearly 0, and SH are orthonormal over them."""
    for count in (32, 64):
        basis = sh_basis(even_directions(count), 3)
        np.testing.assert_allclose(4.0 * np.pi / count * basis.T @ basis, np.eye(16), atol=0.07)


def test_bake_weights_views_of_visible_lit_and_front_sides_of_a_gaussian_most() -> None:
    """Weights grow with the viewing distance. The darker of two sides has little weight, and a known front has more."""
    front = np.tile([True, True, False, False], (3, 1))
    light = np.ones((3, 4, 3))
    light[1, 2:] = 0.0
    light[2, :2] = 0.0
    distance = np.tile([2.0, 1.0, 1.0, 2.0], (3, 1))
    unknown = view_weights(front, light, distance, has_front=False)
    np.testing.assert_allclose(unknown[0], distance[0])
    assert unknown[1, 2:].max() < 0.01 * unknown[1, :2].min()
    assert unknown[2, :2].max() < 0.01 * unknown[2, 2:].min()
    weights = view_weights(front, light, distance, has_front=True)
    assert weights[0, 2:].max() < 0.1 * weights[0, :2].min()
    assert weights[2, :2].max() < 0.2 * weights[2, 2:].min()  # a dark front is the outside of a wall
    dark = view_weights(front, 0.0 * light, 0.0 * distance, has_front=True)
    assert (dark > 0.0).all()


def test_baked_view_directions_on_the_invisible_side_of_a_gaussian_are_mirrored() -> None:
    """View directions on a side without weight are mirrored at the Gaussian's plane.

    With weight on both sides they stay.
    """
    along = directions()
    normals = np.tile([0.0, 0.0, 1.0], (N, 1))
    front = along[..., 2] < 0.0
    only_front = on_visible_sides(along, normals, front.astype(float), front)
    assert (only_front[..., 2] < 0.0).all()
    np.testing.assert_array_equal(only_front[front], along[front])
    np.testing.assert_allclose(only_front[~front], along[~front] * (1.0, 1.0, -1.0))
    assert (on_visible_sides(along, normals, (~front).astype(float), front)[..., 2] > 0.0).all()
    np.testing.assert_array_equal(on_visible_sides(along, normals, np.ones((N, D)), front), along)
