"""Densification clones, splits, relocates and prunes Gaussians."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lumisplat.config import Densification, TrainConfig
from lumisplat.training.densify import (
    DensifyStats,
    cloned_and_split,
    densified,
    grown,
    pruned,
    relocated,
    relocation,
    reset_opacities,
)
from lumisplat.training.parameters import NAMES, TrainedParameters
from support.oracles.particle_oracle import response

CONFIG = TrainConfig(densification=Densification.ADAPTIVE, cap=100)


def parameters(opacities: list[float], scales: list[float] | None = None) -> TrainedParameters:
    """Returns Gaussians with the given opacities and scales, and optimiser moments of 1."""
    count, rng = len(opacities), np.random.default_rng(1)
    o = np.array(opacities)
    scales = scales or [0.1] * count
    found = TrainedParameters.new(
        {
            "means": rng.normal(size=(count, 3)).astype(np.float32),
            "rotations": rng.normal(size=(count, 4)).astype(np.float32),
            "log_scales": np.repeat(np.log(scales)[:, None], 3, axis=1).astype(np.float32),
            "logits": np.log(o / (1.0 - o)).astype(np.float32),
            "sh": rng.normal(size=(count, 4, 3)).astype(np.float32),
        }
    )
    for part in (found.first, found.second):
        for name in NAMES:
            part[name][:] = 1.0
    return found


@pytest.mark.parametrize("count", [2, 3, 10, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.3, 0.9])
@pytest.mark.parametrize("degree", [2, 0, 1, 5])
def test_copies_of_a_relocated_gaussian_together_render_like_the_single_original(
    count: int, opacity: float, degree: int
) -> None:
    """Alpha at the centre and the integral of alpha along a line are equal (equation 9 of Kheradmand et al. 2024)."""
    each, factor = relocation(np.array([opacity]), np.array([count]), degree)
    assert each[0] >= 0.005, "a relocated Gaussian is below the minimum opacity"
    if 1.0 - (1.0 - opacity) ** (1.0 / count) < 0.005:
        assert each[0] == 0.005
    if each[0] > 0.005:
        assert 1.0 - (1.0 - each[0]) ** count == pytest.approx(opacity)
    x = np.linspace(-60.0, 60.0, 1_000_001)
    many = 1.0 - (1.0 - each[0] * response(np.abs(x / factor[0]), degree)) ** count
    one = opacity * response(np.abs(x), degree)
    if each[0] > 0.005:
        assert many.sum() == pytest.approx(one.sum(), rel=1e-5)


def test_densification_relocates_dead_gaussians_onto_living_ones() -> None:
    """The number of Gaussians stays; moments of sources and copies are zero; other Gaussians are unchanged."""
    before, after = parameters([0.9, 0.001, 0.5, 0.002]), parameters([0.9, 0.001, 0.5, 0.002])
    after = relocated(after, TrainConfig(), np.random.default_rng(0))
    assert after.count == 4 and (after.opacities > 0.005).all()
    for dead in (1, 3):
        source = next(i for i in (0, 2) if (after.values["means"][dead] == after.values["means"][i]).all())
        assert after.opacities[dead] == pytest.approx(after.opacities[source])
        assert not after.first["means"][dead].any() and not after.second["logits"][source]
    unchanged = [i for i in (0, 2) if after.first["means"][i].any()]
    for i in unchanged:
        assert all((after.values[name][i] == before.values[name][i]).all() for name in NAMES)


def test_densification_adds_a_twentieth_of_the_gaussians_up_to_the_cap() -> None:
    """A hundred Gaussians become 105, or fewer if ``cap`` is smaller."""
    rng = np.random.default_rng(0)
    assert grown(parameters([0.5] * 100), TrainConfig(cap=1000), rng).count == 105
    assert grown(parameters([0.5] * 100), TrainConfig(cap=102), rng).count == 102
    assert grown(parameters([0.5] * 100), TrainConfig(cap=100), rng).count == 100


def test_densification_clones_small_gaussians_of_large_gradient_and_splits_large_ones() -> None:
    """A split Gaussian is replaced by two smaller ones inside it."""
    before = parameters([0.5] * 4, [0.001, 0.001, 0.5, 0.5])
    record = DensifyStats(100, 1.0, np.array([1.0, 0.0, 1.0, 0.0]), np.zeros(4))
    after = cloned_and_split(before, record, CONFIG, np.random.default_rng(0))
    assert after.count == 4 + 1 + 1
    positions = after.values["means"]
    assert (positions == before.values["means"][0]).all(axis=1).sum() == 2, "no clone is at the position of its source"
    assert not (positions == before.values["means"][2]).all(axis=1).any(), "the split Gaussian is still present"
    halves = np.flatnonzero(np.isclose(after.scales[:, 0], 0.5 / 1.6, rtol=1e-5))
    assert halves.size == 2 and np.linalg.norm(positions[halves] - before.values["means"][2], axis=1).max() < 4 * 0.5
    strongest = cloned_and_split(
        before, record, TrainConfig(densification=Densification.ADAPTIVE, cap=5), np.random.default_rng(0)
    )
    assert strongest.count == 5, "there are more Gaussians than the cap"


def test_densification_clones_or_splits_gaussians_whose_normal_has_a_large_gradient() -> None:
    """Normal gradients count only with ``grow_turn``; at the cap, the largest excess over a threshold comes first."""
    before = parameters([0.5] * 4, [0.001, 0.001, 0.5, 0.5])
    record = DensifyStats(100, 1.0, np.array([1e-3, 0.0, 0.0, 0.0]), np.array([0.0, 0.9, 0.0, 0.1]))
    settings = {"densification": Densification.ADAPTIVE, "normals": 0.05}

    def after(**more: float) -> TrainedParameters:
        config = TrainConfig(**settings, **{"cap": 100, **more})  # pyright: ignore[reportArgumentType]
        return cloned_and_split(before, record, config, np.random.default_rng(0))

    sizes = lambda one: sorted(np.round(one.scales[:, 0], 4))  # noqa: E731
    assert sizes(after()) == [0.001, 0.001, 0.001, 0.5, 0.5], "without grow_turn: a clone of the first"
    assert sizes(after(grow_turn=0.5)) == [0.001, 0.001, 0.001, 0.001, 0.5, 0.5], "a clone of the second, too"
    assert sizes(after(grow_turn=0.05)) == [0.001] * 4 + [0.3125, 0.3125, 0.5], "and the last is split"
    assert sizes(after(grow_turn=0.5, cap=5)) == [0.001, 0.001, 0.001, 0.5, 0.5]
    positions = after(grow_turn=0.5, cap=5).values["means"]
    assert (positions == before.values["means"][1]).all(axis=1).sum() == 2, "the largest excess comes first"


def test_densification_prunes_transparent_and_oversized_gaussians() -> None:
    """The remaining Gaussians keep their order; with an infinite extent, no size is too large."""
    after = pruned(parameters([0.5, 0.001, 0.5, 0.4], [0.01, 0.01, 5.0, 0.02]), extent=1.0)
    np.testing.assert_allclose(after.opacities, [0.5, 0.4], rtol=1e-5)
    assert pruned(parameters([0.5], [5.0]), extent=math.inf).count == 1


def test_opacity_reset_in_training_caps_opacities_and_zeroes_their_adam_moments() -> None:
    """Opacities above 0.01 become 0.01, and lower opacities stay."""
    after = parameters([0.9, 0.006])
    reset_opacities(after)
    np.testing.assert_allclose(after.opacities, [0.01, 0.006], rtol=1e-4)
    assert not after.first["logits"].any() and after.first["means"].any()


@pytest.mark.parametrize("kind", list(Densification))
def test_densification_with_equal_seeds_gives_equal_gaussians(kind: Densification) -> None:
    """Another seed gives another result."""
    config = TrainConfig(densification=kind, cap=200)
    record = DensifyStats(100, 1.0, np.linspace(0.0, 2e-3, 100), np.zeros(100))
    ones = [
        densified(parameters([0.5, 0.003] * 50, [0.1] * 100), record, config, np.random.default_rng(seed))
        for seed in (0, 0, 1)
    ]
    assert all((ones[0].values[name] == ones[1].values[name]).all() for name in NAMES)
    same = ones[0].count == ones[2].count and (ones[0].values["means"] == ones[2].values["means"]).all()
    assert not same
