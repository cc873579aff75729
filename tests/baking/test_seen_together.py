"""Harmonics that are changed by what blends of Gaussians show: against NumPy, and harmonics that are known."""

from __future__ import annotations

import numpy as np

from lumisplat.baking.seen_together import Blend, Pixels, changed_to_fit
from lumisplat.math.sh import sh_basis
from lumisplat.runtime.launcher import Launcher

GAUSSIANS, RAYS, SIGHTS = 20, 3000, 3


def pixels(rng: np.random.Generator, colors: np.ndarray | None = None) -> Pixels:
    """Rays that see three Gaussians each, from anywhere."""
    directions = rng.standard_normal((RAYS * SIGHTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Pixels(
        colors=np.zeros((RAYS, 3)) if colors is None else colors,
        noise=0.0,
        ray=np.repeat(np.arange(RAYS), SIGHTS),
        gaussian=rng.integers(0, GAUSSIANS, RAYS * SIGHTS),
        weight=np.tile([0.5, 0.3, 0.2], RAYS),
        direction=directions.astype(np.float32),
    )


def test_blends_are_those_of_numpy_and_errors_go_back_by_their_transpose() -> None:
    """Each ray shows the weighted sum of its Gaussians' colours; <blend(a), e> = <a, gather(e)>."""
    rng = np.random.default_rng(0)
    some = pixels(rng)
    sh, errors = rng.normal(0.0, 0.3, (GAUSSIANS, 16, 3)), rng.normal(size=(RAYS, 3))
    blend = Blend(some, GAUSSIANS, 16, Launcher("cpu"))
    colors = np.einsum("sk,skc->sc", sh_basis(some.direction.astype(np.float64), 3), sh[some.gaussian])
    expected = (some.weight[:, None] * np.maximum(colors + 0.5, 0.0)).reshape(RAYS, SIGHTS, 3).sum(axis=1)
    np.testing.assert_allclose(blend.show(sh), expected, atol=1e-5)
    forward, back = (blend.blend(sh) * errors).sum(), (sh * blend.gather(errors)).sum()
    np.testing.assert_allclose(forward, back, rtol=1e-4)


def test_harmonics_that_are_known_are_found_again() -> None:
    """From a start that is off by a tenth, by rays without noise: pixels are met, and errors fall by half and more."""
    rng = np.random.default_rng(1)
    some = pixels(rng)
    truth = rng.normal(0.0, 0.05, (GAUSSIANS, 16, 3))
    blend = Blend(some, GAUSSIANS, 16, Launcher("cpu"))
    start = truth + rng.normal(0.0, 0.1, truth.shape)
    known = Pixels(blend.show(truth), 0.0, some.ray, some.gaussian, some.weight, some.direction)
    found = changed_to_fit(blend, known, start)
    assert np.abs(found - truth).mean() < 0.5 * np.abs(start - truth).mean()
    assert (
        np.square(blend.show(found) - known.colors).mean() < 0.01 * np.square(blend.show(start) - known.colors).mean()
    )
