"""Selection of image pairs for feature matching."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.io.training_images.poses import (
    ALL_PAIRS_UP_TO,
    NEXT_FRAMES,
    SIMILAR_IMAGES,
    SIMILARITY_FEATURES,
    compared_pairs,
    largest_features,
    similar_pairs,
)


def walk_features(count: int, period: int, seed: int = 0) -> list[np.ndarray]:
    """Returns noisy features of video frames in which frame k shows the same objects as frame k + period."""
    rng = np.random.default_rng(seed)
    objects = rng.uniform(size=(4 * period, 128)) ** 4
    frames = []
    for k in range(count):
        at = (4 * (k % period) + np.arange(32)) % len(objects)
        features = objects[at] + rng.uniform(0.0, 0.03, (32, 128))
        frames.append(
            (features / np.linalg.norm(features, axis=1, keepdims=True)).astype(np.float32)[rng.permutation(32)]
        )
    return frames


def test_all_pairs_of_few_images_are_selected_without_computing_features() -> None:
    """Every pair is selected whether images are ordered or not, and no features are computed to compare images."""
    for count, ordered in ((2, False), (ALL_PAIRS_UP_TO, False), (2, True), (NEXT_FRAMES, True)):
        pairs = compared_pairs(count, pytest.fail, ordered, lambda fraction: None)
        assert pairs == [(i, j) for i in range(count) for j in range(i + 1, count)]


def test_video_frames_are_matched_with_earlier_views_of_the_same_place() -> None:
    """Frames are paired with the next frames, and with frames of the second round that show the same objects."""
    count, period = 80, 40
    reported: list[float] = []
    pairs = compared_pairs(count, lambda: walk_features(count, period), True, reported.append)
    assert pairs == sorted({*pairs}) and all(i < j for i, j in pairs)
    near = {(i, j) for i in range(count) for j in range(i + 1, count) if j - i <= NEXT_FRAMES}
    assert near <= {*pairs}
    far = {*pairs} - near
    assert {(i, i + period) for i in range(count - period)} <= far
    for i, j in far:  # frames 8 or more apart show different objects
        apart = (j - i) % period
        assert min(apart, period - apart) < 8
    assert len(far) <= count * SIMILAR_IMAGES
    assert reported == sorted(reported) and 0.0 <= reported[0] and reported[-1] <= 1.0


def test_unordered_images_are_matched_with_similar_images() -> None:
    """Pairs without common content are skipped; the order of names does not matter."""
    count, period = 60, 60
    order = np.random.default_rng(3).permutation(count)
    frames = walk_features(count, period)
    pairs = compared_pairs(count, lambda: [frames[k] for k in order], False, lambda fraction: None)
    apart = [(order[j] - order[i]) % period for i, j in pairs]
    assert all(min(a, period - a) < 8 for a in apart)
    assert {(min(i, j), max(i, j)) for i, j in pairs} == {*pairs}
    nearest = dict.fromkeys(range(count), 0)
    for i, j in pairs:
        nearest[i] += 1
        nearest[j] += 1
    assert min(nearest.values()) >= SIMILAR_IMAGES and len(pairs) < count * (count - 1) // 4


def test_images_without_features_are_paired_with_no_other_image() -> None:
    """Empty descriptors are no error."""
    nothing = np.zeros((0, 128), np.float32)
    one = np.eye(1, 128, dtype=np.float32)
    assert similar_pairs([nothing, one, nothing, one], 0, lambda fraction: None) == []
    assert similar_pairs([], 0, lambda fraction: None) == []


def test_largest_features_of_each_image_are_selected_for_image_comparison() -> None:
    """Features are ordered by the size of their shape, affine or not."""
    rng = np.random.default_rng(0)
    count = 3 * SIMILARITY_FEATURES
    size, rotation = rng.permutation(count) + 1.0, rng.uniform(0.0, 6.0, count)
    descriptors = rng.integers(1, 256, (count, 128)).astype(np.uint8)
    x = rng.uniform(size=(count, 2))
    cos, sin = size * np.cos(rotation), size * np.sin(rotation)
    expected = descriptors[np.argsort(-size)[:SIMILARITY_FEATURES]].astype(np.float64)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    for shape in (np.stack([cos, -sin, sin, cos], axis=1), np.stack([size, rotation], axis=1)):
        taken = largest_features(np.concatenate([x, shape], axis=1), descriptors)
        np.testing.assert_allclose(taken, expected, rtol=1e-5)
