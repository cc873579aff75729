"""Tests of the order of a camera's rays."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.device.camera.pixels import pixel_of_ray


@pytest.mark.parametrize(("width", "height"), [(1, 1), (4, 4), (5, 3), (9, 6), (16, 1)])
def test_every_pixel_has_exactly_one_ray_in_the_camera_ray_order(width: int, height: int) -> None:
    """Groups of 4 x 4 pixels cover the image; pixels of a group beyond the image lie to its right or below it."""
    count = 16 * (-(-width // 4)) * (-(-height // 4))
    pixels = np.array([pixel_of_ray(width, ray) for ray in range(count)])
    assert len(np.unique(pixels, axis=0)) == count
    inside = (pixels < [width, height]).all(axis=1)
    assert inside.sum() == width * height


def test_camera_rays_are_ordered_in_groups_of_4_by_4_pixels() -> None:
    """Rays 0 to 15 are the rows of the first 4 x 4 group; the next group lies to the right, then below."""
    pixels = np.array([pixel_of_ray(6, ray) for ray in (0, 1, 4, 15, 16, 32)])
    np.testing.assert_array_equal(pixels, [[0, 0], [1, 0], [0, 1], [3, 3], [4, 0], [0, 4]])
