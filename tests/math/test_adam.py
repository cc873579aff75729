"""Adam on the host, against the algorithm in its paper."""

from __future__ import annotations

import numpy as np

from lumisplat.math.adam import Adam

RNG = np.random.default_rng(8)


def steps_of_paper(gradients: np.ndarray, rate: float) -> np.ndarray:
    """Computes Algorithm 1 of Kingma and Ba (2015), with the moments as explicit weighted sums."""
    moves: list[np.ndarray] = []
    for t in range(1, len(gradients) + 1):
        first = sum(0.1 * 0.9 ** (t - k) * gradients[k - 1] for k in range(1, t + 1))
        second = sum(0.001 * 0.999 ** (t - k) * gradients[k - 1] ** 2 for k in range(1, t + 1))
        moves.append(-rate * (first / (1.0 - 0.9**t)) / (np.sqrt(second / (1.0 - 0.999**t)) + 1e-15))
    return np.stack(moves)


def test_steps_of_the_adam_optimiser_match_the_equations_of_its_paper() -> None:
    """Every step agrees with the paper, for arrays of any shape."""
    gradients = RNG.normal(size=(12, 5, 3))
    adam = Adam.still((5, 3))
    found = np.stack([adam.step(gradient, 0.02) for gradient in gradients])
    np.testing.assert_allclose(found, steps_of_paper(gradients, 0.02), rtol=1e-10)


def test_adam_bias_correction_of_a_row_counts_only_the_steps_of_that_row() -> None:
    """Bias correction counts the steps of each row, not those of all rows."""
    gradients, rows = RNG.normal(size=(30, 4)), RNG.integers(3, size=30)
    adam = Adam.still((3, 4), by_rows=True)
    found = np.stack([adam.step(gradient, row=int(row)) for gradient, row in zip(gradients, rows, strict=True)])
    for row in range(3):
        np.testing.assert_allclose(found[rows == row], steps_of_paper(gradients[rows == row], 1.0), rtol=1e-10)
