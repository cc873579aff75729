"""SAE, SM-IoU and BF (docs/method/relighting.md#metrics) on masks with hand-computed values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, strategies as st

import lumisplat as ls

METRICS = (ls.metrics.sae, ls.metrics.sm_iou, ls.metrics.boundary_f)


def square(left: int, top: int, size: int, strength: float = 1.0, shape: tuple[int, int] = (20, 20)) -> np.ndarray:
    """Returns the mask of a square shadow."""
    shadow = np.zeros(shape)
    shadow[top : top + size, left : left + size] = strength
    return shadow


def boundary_pixels(shadow: np.ndarray) -> list[tuple[int, int]]:
    """Finds pixels in shadow next to a lit pixel, one by one."""
    height, width = shadow.shape
    found = []
    for row in range(height):
        for column in range(width):
            around = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
            lit = [
                shadow[position] <= 0.1 for position in around if 0 <= position[0] < height and 0 <= position[1] < width
            ]
            if shadow[row, column] > 0.1 and any(lit):
                found.append((row, column))
    return found


def test_shadow_metric_sae_matches_hand_computed_values():
    """Over the reference's 16 pixels, 8 are 0.2 off and 8 are missed by 0.6: (1.6 + 4.8) / 16 = 0.4.

    Shadow outside of the reference's does not count.
    """
    reference, shadow = square(4, 4, 4, 0.6), square(4, 4, 4, 0.8)
    shadow[6:8] = 0.0
    shadow[15:, 15:] = 1.0
    assert ls.metrics.sae(shadow, reference) == pytest.approx(0.4)


def test_shadow_metric_sm_iou_matches_hand_computed_values():
    """Two squares of 16 pixels, 2 pixels apart along x, share 8: 8 / (16 + 16 - 8) = 1/3."""
    assert ls.metrics.sm_iou(square(4, 4, 4), square(6, 4, 4)) == pytest.approx(1 / 3)
    assert ls.metrics.sm_iou(square(4, 4, 4), square(10, 4, 4)) == 0.0


def test_shadow_metric_boundary_f_matches_hand_computed_values():
    """A square of 6 has a boundary of 20 pixels, one of 12 around it, 3 pixels apart each way, of 44.

    Within 3 pixels all 20 have a neighbour, of the 44 those straight beside the inner ones: 4 x 6 = 24, the corners
    being 3 sqrt(2) away. So P = 1, R = 24 / 44, and BF = 2 (24/44) / (1 + 24/44) = 48/68. Within 2 pixels none has one.
    """
    inner, outer = square(7, 7, 6), square(4, 4, 12)
    assert len(boundary_pixels(inner)) == 20 and len(boundary_pixels(outer)) == 44
    assert ls.metrics.boundary_f(inner, outer, tolerance=3.0) == pytest.approx(48 / 68)
    assert ls.metrics.boundary_f(outer, inner, tolerance=3.0) == pytest.approx(48 / 68)
    assert ls.metrics.boundary_f(inner, outer) == 0.0


def test_shadow_metric_boundary_f_is_1_for_boundaries_apart_by_at_most_the_tolerance():
    """A shadow off by the tolerance has the full score, and a shadow off by one pixel more has a lower score."""
    assert ls.metrics.boundary_f(square(6, 4, 5), square(4, 4, 5)) == 1.0
    assert 0.0 < ls.metrics.boundary_f(square(7, 4, 5), square(4, 4, 5)) < 1.0


@given(
    seed=st.integers(0, 2**32 - 1), tolerance=st.floats(0.0, 4.0), share=st.floats(0.05, 0.95), size=st.integers(1, 9)
)
def test_shadow_metric_boundary_f_matches_brute_force_distances(seed, tolerance, share, size):
    """The reference compares all pairs of boundary pixels."""
    noise = np.random.default_rng(seed).random((2, size, 9))
    shadow, reference = (np.where(noise < share, 1.0, 0.0)[index] for index in range(2))
    ours, theirs = (np.array(boundary_pixels(mask), np.float64).reshape(-1, 2) for mask in (shadow, reference))
    if len(ours) == 0 or len(theirs) == 0:
        expected = float(len(ours) == len(theirs))
    else:
        near = np.linalg.norm(ours[:, None] - theirs[None], axis=2) <= tolerance
        precision, recall = near.any(axis=1).mean(), near.any(axis=0).mean()
        expected = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    assert ls.metrics.boundary_f(shadow, reference, tolerance=tolerance) == pytest.approx(expected)


def test_shadow_strength_equal_to_the_threshold_counts_as_lit():
    """A pixel is in shadow where S > tau."""
    assert ls.metrics.sm_iou(square(4, 4, 4, 0.1), square(4, 4, 4)) == 0.0
    assert ls.metrics.sm_iou(square(4, 4, 4, 0.1), square(4, 4, 4), threshold=0.09) == 1.0
    assert math.isnan(ls.metrics.sae(square(4, 4, 4), square(4, 4, 4, 0.1)))


def test_overlap_of_shadows_is_1_if_both_images_have_none_and_0_if_only_one_has_none():
    """Without a shadow in both images agreement is full, in one image none; an error over no pixels is NaN."""
    nothing, something = np.zeros((20, 20)), square(4, 4, 4)
    assert ls.metrics.sm_iou(nothing, nothing) == ls.metrics.boundary_f(nothing, nothing) == 1.0
    assert ls.metrics.sm_iou(nothing, something) == ls.metrics.boundary_f(nothing, something) == 0.0
    assert ls.metrics.sm_iou(something, nothing) == ls.metrics.boundary_f(something, nothing) == 0.0
    assert ls.metrics.sae(nothing, something) == 1.0
    assert math.isnan(ls.metrics.sae(something, nothing))


def test_shadow_metric_boundary_f_does_not_count_the_image_border_as_a_boundary():
    """A shadow that fills the image has no boundary; a shadow cut by the border has one inside only."""
    full = np.ones((8, 8))
    assert ls.metrics.boundary_f(full, full) == 1.0
    half = np.zeros((8, 8))
    half[:, :4] = 1.0
    assert ls.metrics.boundary_f(half, full) == 0.0
    shifted = np.zeros((8, 8))
    shifted[:, :6] = 1.0
    assert ls.metrics.boundary_f(half, shifted) == 1.0


def test_shadow_metrics_ignore_shadows_outside_the_region():
    """The border of the region is no boundary."""
    shadow, reference = square(4, 4, 4), square(4, 4, 4)
    shadow[:, 12:] = 1.0
    region = np.zeros((20, 20), np.bool_)
    region[2:11, 5:11] = True
    assert ls.metrics.sae(shadow, reference, region=region) == 0.0
    assert ls.metrics.sm_iou(shadow, reference, region=region) == 1.0
    assert ls.metrics.boundary_f(shadow, reference, region=region) == 1.0
    assert ls.metrics.sm_iou(shadow, reference) < 1.0
    # The left edge of the square, x = 4, is outside of the region; its top, right and bottom edges are inside.
    cut = square(4, 4, 4)
    cut[:, 4] = 0.0
    assert ls.metrics.boundary_f(cut, reference, tolerance=0.0, region=region) == 1.0


@pytest.mark.parametrize("metric", METRICS)
def test_shadow_metrics_do_not_change_if_both_images_are_mirrored_or_8_bit(metric):
    """Both images are mirrored, or given as bytes."""
    random = np.random.default_rng(1)
    shadow, reference = random.integers(0, 256, (2, 12, 17)).astype(np.uint8)
    value = metric(shadow, reference)
    assert metric(shadow[::-1], reference[::-1]) == pytest.approx(value)
    assert metric(shadow.T, reference.T) == pytest.approx(value)
    assert metric(shadow / 255.0, reference / 255.0) == pytest.approx(value)
    assert 0.0 <= value <= 1.0


@pytest.mark.parametrize("metric", METRICS)
def test_shadow_metrics_refuse_invalid_arguments_with_a_one_line_error(metric):
    """Shapes, ranges and settings are invalid."""
    shadow = square(4, 4, 4)
    with pytest.raises(ls.SceneError, match="the image is 20 x 20, its reference 20 x 19"):
        metric(shadow, shadow[1:])
    with pytest.raises(ls.SceneError, match=r"expected \(H, W\)"):
        metric(shadow[..., None], shadow)
    with pytest.raises(ls.SceneError, match=r"values outside 0..1"):
        metric(shadow * 2.0, shadow)
    with pytest.raises(ls.SceneError, match="region is float64"):
        metric(shadow, shadow, region=shadow)
    with pytest.raises(ls.ConfigError, match="threshold is 2"):
        metric(shadow, shadow, threshold=2.0)
    with pytest.raises(ls.ConfigError, match="threshold is None"):
        metric(shadow, shadow, threshold=None)
    with pytest.raises(ls.SceneError, match="shadow is not an array of numbers"):
        metric([[0.0], [0.0, 1.0]], shadow)


def test_shadow_metric_boundary_f_refuses_a_negative_tolerance():
    """The range is 0 to 100."""
    with pytest.raises(ls.ConfigError, match="tolerance is -1"):
        ls.metrics.boundary_f(square(1, 1, 2), square(1, 1, 2), tolerance=-1.0)
    with pytest.raises(ls.ConfigError, match="tolerance is None"):
        ls.metrics.boundary_f(square(1, 1, 2), square(1, 1, 2), tolerance=None)  # pyright: ignore[reportArgumentType]
