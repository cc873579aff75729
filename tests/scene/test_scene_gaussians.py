"""`Gaussians` accepts valid values, and refuses invalid ones with clear messages."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.kinds import present
from support.scenes.raster_scenes import random_gaussians


def fields(**changes: Any) -> dict[str, Any]:
    """Returns the arguments of two valid Gaussians."""
    return {
        "means": np.zeros((2, 3)),
        "rotations_wxyz": np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        "scales": np.ones((2, 3)),
        "opacities": np.full(2, 0.5),
        "sh": np.zeros((2, 4, 3)),
    } | changes


def test_arrays_of_gaussians_become_read_only_float32() -> None:
    """Any input becomes read-only float32, and the caller's arrays stay writable."""
    means = np.ones((2, 3), dtype=np.float32)
    gaussians = ls.Gaussians(**fields(means=means, opacities=[0, 1]))
    assert gaussians.count == 2 and gaussians.sh_degree == 1
    for name in ("means", "rotations_wxyz", "scales", "opacities", "sh"):
        assert getattr(gaussians, name).dtype == np.float32
        with pytest.raises(ValueError, match="read-only"):
            getattr(gaussians, name)[0] = 1.0
    means[0] = np.nan
    assert (gaussians.means == 1.0).all()


def test_read_only_arrays_of_gaussians_are_not_copied() -> None:
    """Read-only arrays are used directly, so that a large capture is in memory once."""
    sh = np.zeros((2, 4, 3), dtype=np.float32)
    sh.flags.writeable = False
    assert np.shares_memory(ls.Gaussians(**fields(sh=sh)).sh, sh)


def test_fields_of_gaussians_cannot_be_assigned() -> None:
    """A Gaussian set cannot be edited in place."""
    with pytest.raises(dataclasses.FrozenInstanceError):
        random_gaussians(0, 3).means = np.zeros((3, 3))  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("scale", [1.0, 1e-30, 1e30, -2.0])
def test_gaussians_normalise_quaternions_of_any_length(scale: float) -> None:
    """Quaternions may have any length above 0, however small or large."""
    rotations = scale * np.array([[1.0, 2.0, -3.0, 4.0], [0.0, 0.0, 1.0, 0.0]])
    unit = ls.Gaussians(**fields(rotations_wxyz=rotations)).rotations_wxyz
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, rtol=1e-6)
    np.testing.assert_allclose(unit[0] / unit[0, 0], [1.0, 2.0, -3.0, 4.0], rtol=1e-6)


def test_normalising_quaternions_and_normals_twice_changes_no_bits() -> None:
    """Unit quaternions and normals keep their bits, so that subsets and round trips do not drift."""
    once = dataclasses.replace(random_gaussians(3, 2000), normals=np.random.default_rng(0).normal(size=(2000, 3)))
    twice = once.subset(np.arange(2000))
    np.testing.assert_array_equal(twice.rotations_wxyz, once.rotations_wxyz)
    np.testing.assert_array_equal(twice.normals, once.normals)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": np.zeros((3, 3))}, r"has shape \(\d, \d\), expected .* with N = \d from"),
        ({"means": np.zeros((2, 2))}, r"means has shape \(2, 2\), expected \(N, 3\)"),
        ({"means": [[0, 0, np.nan], [0, np.inf, 0]]}, r"means has 2 non-finite values out of 6, the first at \[0, 2\]"),
        ({"means": "abc"}, "means is not an array of numbers"),
        ({"rotations_wxyz": [[1, 0, 0, 0], [0, 0, 0, 0]]}, "rotations_wxyz: 1 of 2 are of zero length.*index 1"),
        ({"scales": [[1, 1, 1], [1, 0, 1]]}, "scales: 1 of 2 are not positive"),
        ({"opacities": [0.5, 1.01]}, "opacities: 1 of 2 are outside 0..1"),
        ({"opacities": [-0.1, 2.0]}, "opacities: 2 of 2"),
        ({"sh": np.zeros((2, 5, 3))}, "5 coefficients, expected 1, 4, 9 or 16"),
        ({"kernel_degree": 6}, "kernel_degree is 6, expected a whole number from 0 to 5"),
        ({"kernel_degree": -1}, "kernel_degree is -1"),
        ({"kernel_degree": 2.0}, "kernel_degree is 2.0"),
        ({"kernel_degree": True}, "kernel_degree is True"),
        ({"sh": np.zeros((2, 3))}, r"sh has shape \(2, 3\), expected \(N, K, 3\)"),
        ({"normals": [[0, 0, 1], [0, 0, 0]]}, "normals: 1 of 2 are of zero length"),
        ({"albedo": np.full((2, 3), 1.5)}, "albedo: 2 of 2 are outside"),
        ({"roughness": np.zeros(3)}, r"roughness has shape \(3,\)"),
        ({"metallic": [0.0, np.nan]}, "metallic has 1 non-finite"),
    ],
)
def test_error_for_an_invalid_array_of_gaussians_names_the_property(changes: dict[str, Any], message: str) -> None:
    """The error names the property, the number of invalid values and what was expected, in one line."""
    with pytest.raises(ls.SceneError, match=message) as caught:
        ls.Gaussians(**fields(**changes))
    assert "\n" not in str(caught.value)


def test_a_set_of_zero_gaussians_is_refused() -> None:
    """Zero Gaussians are an error, not an empty image."""
    empty = fields(**{name: values[:0] for name, values in fields().items()})
    with pytest.raises(ls.SceneError, match="zero Gaussians"):
        ls.Gaussians(**empty)


def test_gaussians_refuse_values_that_overflow_float32() -> None:
    """A double that overflows float32 is refused instead of becoming infinite."""
    with pytest.raises(ls.SceneError, match="non-finite"):
        ls.Gaussians(**fields(means=np.full((2, 3), 1e300)))


def test_subset_of_gaussians_keeps_the_given_order_and_metadata() -> None:
    """Rows are selected in the given order; flags and comments are preserved."""
    gaussians = dataclasses.replace(
        random_gaussians(1, 5, degree=2, antialiased=True), roughness=np.linspace(0, 1, 5), comments=("made",)
    )
    picked = gaussians.subset(np.array([3, 1]))
    assert picked.count == 2 and picked.antialiased and picked.comments == ("made",)
    np.testing.assert_array_equal(picked.means, gaussians.means[[3, 1]])
    np.testing.assert_array_equal(picked.roughness, present(gaussians.roughness)[[3, 1]])
    assert gaussians.subset(np.arange(5) == 2).means.tolist() == gaussians.means[2:3].tolist()


def test_bounds_of_gaussians_enclose_their_means() -> None:
    """The bounds are the axis-aligned box of the means."""
    low, high = random_gaussians(2, 50, center=(1.0, 2.0, 3.0), extent=(1.0, 1.0, 1.0)).bounds()
    assert (low >= [0, 1, 2]).all() and (high <= [2, 3, 4]).all() and (low < high).all()
