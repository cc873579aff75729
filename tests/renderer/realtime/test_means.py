"""Sample weights of temporal means whose samples depend on the means of other frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from lumisplat.runtime.buffers import device_array
from support.oracles.means_oracle import mean_weight
from support.probes.probe_means_kernels import probe_weights

Doubles = npt.NDArray[np.float64]


def device_weights(counts: npt.ArrayLike, history: float) -> Doubles:
    """Returns the weights that kernels give to means of the given numbers of samples."""
    numbers = np.asarray(counts, np.float32)
    given = [wp.array(values, dtype=float, device="cpu") for values in (numbers, np.full_like(numbers, history))]
    found = wp.zeros(len(numbers), dtype=float, device="cpu")
    wp.launch(probe_weights, len(numbers), inputs=[*given, found], device="cpu")
    return device_array(found).numpy().astype(np.float64)


def sample_weights(count: int, history: float) -> Doubles:
    """Returns the weight of each of ``count`` samples in the final mean, oldest first."""
    shares = 1.0 / (device_weights(np.minimum(np.arange(count), history), history) + 1.0)
    retained = np.cumprod(np.append(1.0, 1.0 - shares[:0:-1]))[::-1]
    return shares * retained


@pytest.mark.parametrize("history", [1.0, 4.0, 32.0])
def test_weights_of_samples_in_temporal_means_match_the_float64_reference(history: float) -> None:
    """The numbers of samples are whole, or fractions as outdated means have."""
    counts = np.arange(81) / 2.0
    for offset in (0.0, 4e-4):
        expected = [mean_weight(count, history) for count in counts + offset]
        np.testing.assert_allclose(device_weights(counts + offset, history), expected, rtol=1e-5)


def test_temporal_mean_of_few_samples_weights_the_nth_in_proportion_to_n() -> None:
    """The variance is a third higher than with equal weights."""
    for count in (1, 2, 5, 100):
        weights = sample_weights(count, 1e4)
        np.testing.assert_allclose(weights, np.arange(1, count + 1) / (count * (count + 1) / 2), rtol=1e-5)
    assert 100 * np.sum(sample_weights(100, 1e4) ** 2) == pytest.approx(4.0 / 3.0, rel=0.01)


@pytest.mark.parametrize("history", [1, 4, 8])
def test_temporal_mean_of_full_history_weights_a_new_sample_by_1_over_its_length(history: int) -> None:
    """Older samples fade by the factor 1 - 1 / history."""
    before, after = (sample_weights(count, history) for count in (3 * history, 3 * history + 1))
    assert after[-1] == pytest.approx(1.0 / history, rel=1e-6)
    np.testing.assert_allclose(after[:-1], before * (1.0 - 1.0 / history), rtol=1e-5)
    assert after.sum() == pytest.approx(1.0, rel=1e-6)
