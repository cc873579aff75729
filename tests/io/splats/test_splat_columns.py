"""Decoding of stored columns: refused, dropped and clamped values."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from lumisplat.constants import SCALE_MIN
from lumisplat.errors import FormatError
from lumisplat.io.splats.columns import SplatColumns, columns_from_gaussians, gaussians_from_columns
from support.files.splat_files import capture


def stored(count: int = 10, degree: int = 1) -> SplatColumns:
    """Returns writable columns of a valid capture."""
    columns = columns_from_gaussians(capture(count, degree))
    for name in ("means", "rotations_wxyz", "log_scales", "opacities", "sh"):
        setattr(columns, name, getattr(columns, name).copy())
    return columns


def poisoned() -> SplatColumns:
    """Makes four of ten rows invalid: row 1 has two invalid values, rows 3, 5 and 8 one each."""
    columns = stored()
    columns.means[1, 0] = np.nan
    columns.opacities[1] = np.nan
    columns.log_scales[3, 2] = np.inf
    columns.sh[5, 2, 1] = np.nan
    columns.rotations_wxyz[8] = 0.0
    return columns


def test_error_for_invalid_gaussians_counts_invalid_values_per_property() -> None:
    """The error also names the option that drops invalid Gaussians."""
    with pytest.raises(FormatError) as error:
        gaussians_from_columns("a.ply", poisoned())
    message = str(error.value)
    for part in (
        "a.ply: ",
        "1 NaN or infinite values in x",
        "in opacity",
        "in scale_2",
        "in f_rest_4",  # green is the second channel of three coefficients each: 3 + 1
        "1 rotations of zero length",
        "in 4 of 10 Gaussians",
        "--drop-invalid (drop_invalid=True)",
    ):
        assert part in message
    assert "\n" not in message


def test_gaussians_share_the_memory_of_the_columns_read_from_a_file() -> None:
    """Large captures are thus in memory once."""
    columns = stored()
    gaussians = gaussians_from_columns("a.ply", columns)
    assert np.shares_memory(gaussians.sh, columns.sh) and np.shares_memory(gaussians.means, columns.means)
    assert not gaussians.sh.flags.writeable


def test_drop_invalid_removes_only_gaussians_with_invalid_columns(caplog: pytest.LogCaptureFixture) -> None:
    """A log line has their number."""
    with caplog.at_level(logging.WARNING, logger="lumisplat"):
        valid = gaussians_from_columns("a.ply", poisoned(), drop_invalid=True)
    np.testing.assert_array_equal(valid.means, stored().means[[0, 2, 4, 6, 7, 9]])
    assert "dropped 4 of 10 Gaussians" in caplog.text


def test_infinite_opacity_logits_are_accepted_as_opacities_0_and_1(caplog: pytest.LogCaptureFixture) -> None:
    """A log scale of -inf is valid, too, and becomes the smallest scale."""
    columns = stored()
    columns.opacities[:2] = np.inf, -np.inf
    columns.log_scales[2, 1] = -np.inf
    for drop in (False, True):
        gaussians = gaussians_from_columns("a.ply", columns, drop_invalid=drop)
        assert gaussians.count == 10
        np.testing.assert_array_equal(gaussians.opacities[:2], (1.0, 0.0))
        assert gaussians.scales[2, 1] == np.float32(SCALE_MIN)
    assert not caplog.records


def test_infinite_log_scales_and_stored_opacities_are_invalid() -> None:
    """Opacities are stored directly here, not as logits."""
    columns = stored()
    columns.log_scales[2, 1] = np.inf
    with pytest.raises(FormatError, match="1 NaN or infinite values in scale_1"):
        gaussians_from_columns("a.ply", columns)
    columns = replace(stored(), opacities_are_logits=False, opacities=np.full(10, np.inf, np.float32))
    with pytest.raises(FormatError, match="10 NaN or infinite values in opacity"):
        gaussians_from_columns("a.ply", columns)


def test_capture_without_any_valid_gaussian_is_refused_even_with_drop_invalid() -> None:
    """All positions are NaN, so no Gaussian is left."""
    columns = stored(2)
    columns.means[:] = np.nan
    with pytest.raises(FormatError, match="no valid Gaussian is left"):
        gaussians_from_columns("a.ply", columns, drop_invalid=True)


def test_log_scales_that_underflow_become_the_smallest_scale() -> None:
    """The exponential of a log scale of -200 is zero in float32."""
    columns = stored(1)
    columns.log_scales[0] = (-200.0, -50.0, 0.0)
    np.testing.assert_allclose(gaussians_from_columns("a.ply", columns).scales, [[SCALE_MIN, SCALE_MIN, 1.0]])


def test_log_scales_that_overflow_are_refused() -> None:
    """The exponential of a log scale of 100 is infinite, and counted for its property."""
    columns = stored(3)
    columns.log_scales[2, 1] = 100.0
    with pytest.raises(FormatError, match="1 NaN or infinite values in scale_1"):
        gaussians_from_columns("a.ply", columns)


def test_large_logits_become_opacity_0_or_1_without_a_warning() -> None:
    """Logits are -500 and 500, beyond the range of exp."""
    columns = stored(2)
    columns.opacities[:] = (-500.0, 500.0)
    np.testing.assert_array_equal(gaussians_from_columns("a.ply", columns).opacities, [0.0, 1.0])


def test_column_value_out_of_range_gives_an_error_that_names_the_file() -> None:
    """A roughness of 1.5 is refused by `Gaussians`, which has no file name."""
    columns = stored(2)
    columns.roughness = np.array([0.5, 1.5], dtype=np.float32)
    with pytest.raises(FormatError, match=r"a\.ply: roughness"):
        gaussians_from_columns("a.ply", columns)


def test_gaussians_do_not_drift_when_converted_to_file_columns_and_back_many_times() -> None:
    """Values decoded from logarithms and logits do not drift over many conversions."""
    rng = np.random.default_rng(1)
    columns = stored(20_000, degree=0)
    columns.log_scales = rng.uniform(-12.0, -1.0, (20_000, 3)).astype(np.float32)
    columns.opacities = (rng.choice([-1.0, 1.0], 20_000) * rng.uniform(1.0, 15.0, 20_000)).astype(np.float32)
    columns.opacities[:2] = -100.0, 100.0
    first = gaussians_from_columns("a.ply", columns)
    again = gaussians_from_columns("a.ply", columns_from_gaussians(first))
    np.testing.assert_array_equal(again.scales, first.scales)
    np.testing.assert_array_equal(again.opacities[2:], first.opacities[2:])
    np.testing.assert_allclose(again.opacities[:2], first.opacities[:2], atol=3e-9)  # logits end at 20
