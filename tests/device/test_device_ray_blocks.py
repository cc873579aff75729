"""The order of a camera's rays."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.device.camera.pixels import pixel_of_ray


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4, 4), (5, 3), (9, 6), (16, 1)])
def test_every_pixel_has_one_ray(width: int, height: int) -> None:
    """Whole blocks cover the image, each pixel once, and what lies outside is to the right or below."""
    count = 16 * (-(-width // 4)) * (-(-height // 4))
    pixels = np.array([pixel_of_ray(width, ray) for ray in range(count)])
    assert len(np.unique(pixels, axis=0)) == count
    inside = (pixels < [width, height]).all(axis=1)
    assert inside.sum() == width * height


def test_blocks_are_square_and_row_by_row() -> None:
    """Rays 0 to 15 are the first block's rows; the next block is to the right, then below."""
    pixels = np.array([pixel_of_ray(6, ray) for ray in (0, 1, 4, 15, 16, 32)])
    np.testing.assert_array_equal(pixels, [[0, 0], [1, 0], [0, 1], [3, 3], [4, 0], [0, 4]])
