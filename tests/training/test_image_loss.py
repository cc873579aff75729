"""The image loss and its gradients agree with SciPy's filters in float64 and central differences."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy.ndimage import correlate1d

from lumisplat.device.structs.camera import PixelData
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.training.losses import ImageLoss, Loss

SIZE = 23, 17
"""Width and height in pixels, so small that the SSIM window of 11 pixels can reach across two borders at once."""
SSIM, ALPHA, ENTROPY = 0.3, 0.7, 0.4

Wanted = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]
"""Colour, pixel weights and alpha of a target image."""


def images(seed: int = 0, channels: int | None = 3) -> np.ndarray:
    """Returns random values 0..1."""
    shape = (SIZE[1], SIZE[0]) if channels is None else (SIZE[1], SIZE[0], channels)
    return np.random.default_rng(seed).uniform(size=shape).astype(np.float32)


def differentiate(
    color: np.ndarray,
    alpha: np.ndarray,
    wanted: Wanted,
    threads: int | None = None,
    size: tuple[int, int] = SIZE,
    parallel: bool | None = None,
) -> tuple[Loss, np.ndarray, np.ndarray]:
    """Returns the loss of a frame, and its gradient with respect to colour and alpha."""
    launcher, buffers = Launcher("cpu", threads, parallel=parallel), Buffers("cpu")
    loss = ImageLoss(launcher, buffers, ssim=SSIM, alpha=ALPHA, entropy=ENTROPY)
    pixels = PixelData()
    pixels.color = buffers.upload("color", wp.vec3, color.astype(np.float32).reshape(-1, 3))
    pixels.alpha = buffers.upload("alpha", wp.float32, alpha.astype(np.float32).reshape(-1))
    gradient = loss.differentiate(size, pixels, loss.load(*wanted))
    arrays = gradient.color, gradient.alpha
    by_color, by_alpha = (np.array(array.numpy()) for array in arrays)  # pyright: ignore[reportUnknownMemberType]
    return loss.read(size), by_color.reshape(color.shape), by_alpha.reshape(alpha.shape)


def blurred(values: np.ndarray) -> np.ndarray:
    """Blurs by the window of SSIM; SciPy's "reflect" mirrors at the outer edges of border pixels, as the kernels do."""
    window = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    for axis in (0, 1):
        values = correlate1d(values, window / window.sum(), axis=axis, mode="reflect")
    return values


def expected(color: np.ndarray, alpha: np.ndarray, wanted: Wanted) -> float:
    """Returns the loss in float64: equation 7 of Kerbl et al. 2023, with the SSIM of Wang et al. 2004."""
    y, weight, wanted_alpha = wanted
    y = y.astype(np.float64)
    x = color if weight is None else y + weight[..., None] * (color - y)
    mx, my = blurred(x), blurred(y)
    vx, vy, cov = blurred(x * x) - mx**2, blurred(y * y) - my**2, blurred(x * y) - mx * my
    ssim = (2 * mx * my + 1e-4) * (2 * cov + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    share = np.ones(alpha.shape) if weight is None else weight.astype(np.float64)
    error = (1.0 - SSIM) * share[..., None] * np.abs(color - y) + SSIM * (1.0 - ssim)
    total = error.sum() / (3.0 * share.sum())
    if wanted_alpha is None:
        return float(total)
    covered = np.clip(alpha, 1e-6, 1.0 - 1e-6)
    entropy = -wanted_alpha * np.log(covered) - (1.0 - wanted_alpha) * np.log(1.0 - covered)
    return float(total + (share * (ALPHA * np.abs(alpha - wanted_alpha) + ENTROPY * entropy)).sum() / share.sum())


@pytest.mark.parametrize("kind", ["plain", "masked", "transparent", "both"])
def test_image_loss_and_its_gradient_match_float64(kind: str) -> None:
    """Gradients are compared inside the image, at its borders and in a corner."""
    color, alpha, image = images(1).astype(np.float64), images(2, None).astype(np.float64), images(3)
    weight = images(4, None) if kind in ("masked", "both") else None
    wanted = image, weight, images(5, None) if kind in ("transparent", "both") else None
    found, by_color, by_alpha = differentiate(color, alpha, wanted)
    assert found.total == pytest.approx(expected(color, alpha, wanted), abs=1e-6)
    scale, step = np.abs(by_color).mean(), 1e-5
    for y, x, channel in ((0, 0, 0), (16, 22, 2), (0, 11, 1), (8, 11, 0), (9, 3, 2)):
        moved = [color.copy(), color.copy()]
        moved[0][y, x, channel] += step
        moved[1][y, x, channel] -= step
        slope = (expected(moved[0], alpha, wanted) - expected(moved[1], alpha, wanted)) / (2.0 * step)
        assert by_color[y, x, channel] == pytest.approx(slope, abs=2e-5 * float(scale))
    if wanted[2] is None:
        assert not by_alpha.any()
    else:
        share = np.ones(alpha.shape) if weight is None else weight
        slope = ALPHA * np.sign(alpha - wanted[2]) + ENTROPY * ((1.0 - wanted[2]) / (1.0 - alpha) - wanted[2] / alpha)
        np.testing.assert_allclose(by_alpha, share * slope / share.sum(), rtol=1e-4, atol=1e-7)


def test_cross_entropy_loss_of_correct_alpha_0_or_1_is_finite_with_zero_gradient() -> None:
    """Wrong alpha of exactly 0 or 1 has a large, finite cross entropy and a gradient towards the target."""
    wanted = (images(2, None) > 0.5).astype(np.float32)
    right, _, by_alpha = differentiate(images(1), wanted, (images(3), None, wanted))
    assert 0.0 <= right.entropy < 1e-5 and not by_alpha.any()
    wrong, _, by_alpha = differentiate(images(1), 1.0 - wanted, (images(3), None, wanted))
    assert wrong.entropy == pytest.approx(-np.log(1e-6), rel=5e-3)
    assert (np.sign(by_alpha) == np.where(wanted > 0.5, -1.0, 1.0)).all()


def test_image_loss_gives_masked_pixels_no_gradient() -> None:
    """The frame may show anything where the mask is black, without a change of the loss."""
    image, weight = images(3), np.zeros((SIZE[1], SIZE[0]), np.float32)
    weight[:, :9] = 1.0
    one, two = images(1), images(1)
    two[:, 9:] = images(8)[:, 9:]
    alpha = images(2, None)
    first, by_one, by_alpha = differentiate(one, alpha, (image, weight, images(5, None)))
    second, by_two, _ = differentiate(two, alpha, (image, weight, images(5, None)))
    assert first == second and not by_one[:, 9:].any() and not by_alpha[:, 9:].any() and by_alpha[:, :9].any()
    whole = differentiate(one[:, :9], alpha[:, :9], (image[:, :9], None, None), size=(9, SIZE[1]))[0]
    assert first.squared == pytest.approx(whole.squared, rel=1e-5), "the mean is over unmasked pixels"
    np.testing.assert_array_equal(by_one, by_two)


def test_image_loss_of_equal_images_is_zero_with_zero_gradient() -> None:
    """SSIM is 1; gradients are 0 up to rounding."""
    image = images(3)
    found, by_color, _ = differentiate(image, images(2, None), (image, None, None))
    assert found.l1 == 0.0 and found.ssim == pytest.approx(1.0, abs=1e-5) and np.abs(by_color).max() < 1e-6


def test_image_loss_has_the_same_bits_on_any_number_of_threads() -> None:
    """One thread sums each row, so the order of additions is fixed."""
    results = [differentiate(images(1), images(2, None), (images(3), None, None), threads) for threads in (1, 2, 5)]
    for other in results[1:]:
        assert other[0] == results[0][0]
        np.testing.assert_array_equal(other[1], results[0][1])


def test_image_loss_summed_by_pixels_equals_the_loss_summed_by_rows() -> None:
    """CUDA kernels process single pixels, and CPU kernels rows."""
    wanted = images(3), images(4, None), images(5, None)
    rows, pixels = (differentiate(images(1), images(2, None), wanted, parallel=parallel) for parallel in (False, True))
    for row, pixel in zip(rows[1:], pixels[1:], strict=True):
        np.testing.assert_allclose(pixel, row, rtol=0.0, atol=1e-7 * float(np.abs(row).max()) + 1e-12)
    for name in ("l1", "squared", "ssim", "alpha", "total"):
        assert getattr(pixels[0], name) == pytest.approx(getattr(rows[0], name), rel=1e-6)
