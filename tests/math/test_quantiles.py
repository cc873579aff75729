"""Weighted quantiles."""

from __future__ import annotations

import numpy as np
import pytest

from lumisplat.math.arrays import weighted_quantile

RNG = np.random.default_rng(8)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.5, 0.95, 1.0])
def test_weighted_quantiles_of_equal_weights_equal_numpy_quantiles(share: float) -> None:
    """Equal weights give NumPy's quantile, whatever the weight."""
    values = RNG.normal(size=37)
    found = weighted_quantile(values, np.full(37, 0.25), share)
    assert found == pytest.approx(float(np.quantile(values, share)), rel=1e-12)


def test_half_of_the_weight_lies_below_the_weighted_median() -> None:
    """Half of the weight lies below the median, up to half the weight of one value."""
    values, weights = RNG.normal(size=2000), RNG.uniform(0.0, 3.0, 2000) ** 2
    for share in (0.1, 0.5, 0.95):
        found = weighted_quantile(values, weights, share)
        assert abs(weights[values < found].sum() / weights.sum() - share) < weights.max() / weights.sum()


def test_weighted_quantiles_ignore_values_of_zero_weight() -> None:
    """A value of weight 0 is ignored, whether it is the smallest, the largest or between."""
    values, weights = np.array([-9.0, 1.0, 1.5, 2.0, 9.0]), np.array([0.0, 1.0, 0.0, 1.0, 0.0])
    assert [weighted_quantile(values, weights, share) for share in (0.0, 0.5, 1.0)] == pytest.approx([1.0, 1.5, 2.0])
    assert weighted_quantile(values, np.array([0.0, 0.0, 0.0, 0.0, 2.0]), 0.3) == 9.0
