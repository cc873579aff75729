"""Stochastic strategies have the mean of sorting, and each sample is one of the possible outcomes."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from statistics import NormalDist

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from support.compare.backends import renderer_of
from support.oracles import raster_oracle as oracles, trace_oracle
from support.oracles.particle_oracle import world_of
from support.oracles.trace_oracle import background_of, camera_rays, outcomes_on, trace
from support.scenes.trace_scenes import Case, changed_rays, copies, small_camera, stochastic_cases, trace_config
from support.twins import TWINS

HIT, PASS = ls.config.TraceStrategy.STOCHASTIC_HIT, ls.config.TraceStrategy.STOCHASTIC_PASS
CASES = {case.name: case for case in stochastic_cases()}
DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
"""Devices whose statistics are tested; one test compares the random numbers of all other backends with the CPU's."""
SEEDS = range(4)
"""Fixed seeds, so that a test always fails or always passes."""
FAMILY_ERROR = 1e-3
"""Probability that a correct renderer fails a comparison, over all its values."""

strategies = pytest.mark.parametrize("strategy", [HIT, PASS], ids=lambda strategy: strategy.value)
devices = pytest.mark.parametrize("device", DEVICES)


def random_case(name: str, strategy: ls.config.TraceStrategy, **changes: object) -> Case:
    """Returns a case with a stochastic strategy and every sample at the centre of its pixel."""
    case = CASES[name]
    return replace(case, config=changed_rays(case.config, strategy=strategy, jitter=False, **changes))


def samples_of(case: Case) -> int:
    """Returns the samples per seed; fewer for cases with many waves of rays."""
    return 32 if any(one.mesh.material.is_smooth for one in case.scene.meshes) else 128


@cache
def frames_of(name: str, strategy: ls.config.TraceStrategy, device: str) -> list[ls.Frame]:
    """Returns one frame per seed."""
    case = random_case(name, strategy)
    config = replace(case.config, samples=samples_of(case))
    return [renderer_of(device, replace(config, seed=seed)).render(case.scene, case.camera) for seed in SEEDS]


@cache
def twin_of(name: str, strategy: ls.config.TraceStrategy) -> dict[str, np.ndarray]:
    """Returns the expectation and variance of a case by the twin."""
    case = random_case(name, strategy)
    return TWINS.result(trace_oracle.render, case.scene, case.camera, case.config)


def critical_z(tests: int) -> float:
    """Returns the two-sided critical value for ``tests`` simultaneous tests, corrected after Sidak (1967)."""
    each = 1.0 - (1.0 - FAMILY_ERROR) ** (1.0 / tests)
    return NormalDist().inv_cdf(1.0 - 0.5 * each)


def excess(mean: np.ndarray, expected: np.ndarray, variance: np.ndarray, count: int, most: float) -> np.ndarray:
    """Returns how far beyond chance means of ``count`` samples are from their expectation, shaped like ``mean``.

    Samples lie in 0..``most``. Rare ones skew the mean: its third central moment is at most ``most`` times the
    variance, which the expansion of Cornish and Fisher (1938) converts to a tolerance.
    """
    z = critical_z(mean.size)
    room = z * np.sqrt(variance / count) + most * (z * z - 1.0) / (6.0 * count)
    return np.abs(mean - expected) - room - 1e-5


def pooled_excess(mean: np.ndarray, expected: np.ndarray, variance: np.ndarray, count: int, most: float) -> np.ndarray:
    """Returns the excess of the mean over all P independent pixels of arrays (P, ...), which detects small errors."""
    pixels = len(mean)
    return excess(mean.mean(axis=0), expected.mean(axis=0), variance.mean(axis=0), count * pixels, most)


def brightest(case: Case) -> float:
    """Returns an upper bound of the colours of a case's rays, from all Gaussians in a thousand directions."""
    directions = oracles.normalized(np.random.default_rng(0).normal(size=(1000, 3)))
    basis = oracles.sh_basis(directions)
    every = [one.gaussians.sh.astype(float) for one in case.scene.splats]
    return max(1.0, *(1.05 * np.einsum("dk,nkc->dnc", basis[:, : sh.shape[1]], sh).max() + 0.5 for sh in every))


@devices
@strategies
@pytest.mark.parametrize("name", CASES)
def test_mean_of_stochastic_frames_equals_the_expected_value_of_the_oracle(
    name: str, strategy: ls.config.TraceStrategy, device: str
) -> None:
    """Colour and alpha are compared per pixel and over all pixels, also in mirrors and glass."""
    frames, twin = frames_of(name, strategy, device), twin_of(name, strategy)
    count = len(frames) * samples_of(CASES[name])
    for image, most in (("color", brightest(CASES[name])), ("alpha", 1.0)):
        mean = np.stack([getattr(frame, image) for frame in frames]).mean(axis=0, dtype=np.float64)
        expected, variance = twin[image], twin[f"{image}_variance"]
        slack = twin["slack"].reshape(*twin["slack"].shape, *(1,) * (mean.ndim - 2))
        room = excess(mean, expected, variance, count, most) - slack
        worst = np.unravel_index(room.argmax(), room.shape)
        assert room[worst] <= 0.0, (
            f"{image}: {np.count_nonzero(room > 0.0)} means are off, the worst at {worst}: {mean[worst]:.5f} for "
            f"{expected[worst]:.5f}, {room[worst]:.2g} beyond chance"
        )
        sure = twin["slack"] < 1e-4
        assert sure.mean() > 0.5
        off = pooled_excess(mean[sure], expected[sure], variance[sure], count, most)
        assert (off <= 0.0).all(), f"{image}: the mean of all pixels is off, by {off} beyond chance"


@devices
@strategies
@pytest.mark.parametrize("name", CASES)
def test_noise_of_stochastic_frames_equals_the_predicted_variance(
    name: str, strategy: ls.config.TraceStrategy, device: str
) -> None:
    """Frames of different seeds scatter around the expectation like independent samples."""
    frames, twin = frames_of(name, strategy, device), twin_of(name, strategy)
    samples = samples_of(CASES[name])
    scattered = (twin["slack"] < 1e-3) & (twin["color_variance"].min(axis=-1) > 1e-3)
    assert np.count_nonzero(scattered) > 40
    deviation = np.stack([frame.color - twin["color"] for frame in frames])[:, scattered]
    square = deviation**2 / (twin["color_variance"][scattered] / samples)
    assert square.mean() == pytest.approx(1.0, abs=0.2)
    neighbours = (
        deviation[:, 1:]
        * deviation[:, :-1]
        / np.sqrt(twin["color_variance"][scattered][1:] * twin["color_variance"][scattered][:-1] / samples**2)
    )
    assert neighbours.mean() == pytest.approx(0.0, abs=0.2), "pixels must not share their numbers"


@devices
@strategies
@pytest.mark.parametrize("name", ["instances", "mesh", "linear, hull"])
def test_each_stochastic_sample_shows_a_single_gaussian_or_pass_or_the_background(
    name: str, strategy: ls.config.TraceStrategy, device: str
) -> None:
    """All images of a sample agree, and each outcome has its expected frequency."""
    case = random_case(name, strategy)
    world = world_of(case.scene, case.config)
    only_meshes = replace(world_of(replace(case.scene, splats=()), case.config), splat_count=world.splat_count)
    twin = twin_of(name, strategy)
    rays, firsts = camera_rays(case.camera), np.cumsum([0, *(one.gaussians.count for one in case.scene.splats)])
    sure = np.flatnonzero((twin["slack"] < 1e-3) & ~twin["band"])
    assert len(sure) > 0.75 * len(rays)
    shown = [renderer_of(device, replace(case.config, seed=seed)).render(case.scene, case.camera) for seed in range(40)]
    images = {
        name: np.stack([getattr(frame, name) for frame in shown]).reshape(len(shown), len(rays), -1)
        for name in ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")
    }
    expected, counted = [], []
    for i in sure:
        may_show = outcomes_on(world, rays[i])
        gaussian, instance = images["gaussian_index"][:, i, 0], images["instance_index"][:, i, 0]
        index = np.where(gaussian >= 0, gaussian + firsts[instance], -1)
        for j in range(len(may_show.index)):
            at = index == may_show.index[j]
            expected.append(may_show.probability[j])
            counted.append(np.count_nonzero(at))
            np.testing.assert_allclose(images["color"][at, i], np.tile(may_show.color[j], (counted[-1], 1)), atol=2e-4)
            np.testing.assert_allclose(
                images["normal"][at, i], np.tile(may_show.normal[j], (counted[-1], 1)), atol=1e-3
            )
            np.testing.assert_allclose(images["depth"][at, i, 0], may_show.depth[j], atol=1e-4)
            assert (images["alpha"][at, i] == 1.0).all()
        nothing = index < 0
        assert np.isin(index[~nothing], may_show.index).all()
        behind = trace(only_meshes, rays[i], background_of(world))
        np.testing.assert_allclose(images["color"][nothing, i], np.tile(behind.color, (nothing.sum(), 1)), atol=2e-5)
        assert (images["alpha"][nothing, i] == behind.alpha).all()
        assert (instance[nothing] == behind.instance_index).all()
    chance = np.array(expected)
    frequency = np.array(counted) / len(shown)
    assert len(chance) > 100
    assert (excess(frequency, chance, chance * (1.0 - chance), len(shown), 1.0) <= 0.0).all()


@devices
def test_stochastic_acceptance_scale_raises_the_probability_of_a_hit_to_alpha_over_scale(device: str) -> None:
    """Random numbers are scaled, so that a Gaussian is accepted with the probability alpha / scale."""
    case = random_case("overlapping", HIT, acceptance_scale=0.5)
    twin = TWINS.result(trace_oracle.render, case.scene, case.camera, case.config)
    frame = renderer_of(device, replace(case.config, samples=500)).render(case.scene, case.camera)
    args = frame.color.reshape(-1, 3), twin["color"].reshape(-1, 3), twin["color_variance"].reshape(-1, 3), 500
    assert (excess(*args, brightest(case)) <= twin["slack"].reshape(-1, 1)).all()
    assert (pooled_excess(*args, brightest(case)) <= 0.0).all()
    assert twin["alpha"].mean() > 1.1 * twin_of("overlapping", HIT)["alpha"].mean()


@pytest.mark.parametrize("strategy", [HIT, PASS], ids=lambda strategy: strategy.value)
def test_statistical_tests_of_stochastic_frames_reject_slightly_wrong_oracles(
    strategy: ls.config.TraceStrategy,
) -> None:
    """Gaussians 5 % fainter, earlier acceptance, or shortened blending would fail."""
    frames, twin = frames_of("passes of 4", strategy, "cpu"), twin_of("passes of 4", strategy)
    case = random_case("passes of 4", strategy)
    (instance,) = case.scene.splats
    fainter = ls.Scene([replace(instance.gaussians, opacities=0.95 * instance.gaussians.opacities)])
    wrong = [
        trace_oracle.render(fainter, case.camera, case.config)["color"],
        trace_oracle.render(case.scene, case.camera, changed_rays(case.config, strategy=HIT, acceptance_scale=0.95))[
            "color"
        ],
        trace_oracle.render(
            case.scene,
            case.camera,
            changed_rays(case.config, strategy=ls.config.TraceStrategy.SORTED, transmittance_min=0.5),
        )["color"],
    ]
    mean = np.mean([frame.color for frame in frames], axis=0, dtype=np.float64).reshape(-1, 3)
    variance, count = twin["color_variance"].reshape(-1, 3), len(frames) * samples_of(case)
    assert (pooled_excess(mean, twin["color"].reshape(-1, 3), variance, count, brightest(case)) <= 0.0).all()
    for expected in wrong:
        assert (pooled_excess(mean, expected.reshape(-1, 3), variance, count, brightest(case)) > 0.0).any()


@strategies
def test_stochastic_frames_of_equal_seed_are_almost_equal_on_all_backends(
    strategy: ls.config.TraceStrategy, backend: str
) -> None:
    """A seed gives the same image on every backend up to rounding, and another seed another image."""
    case = random_case("instances", strategy)
    config = replace(case.config, samples=8, seed=5)
    expected = renderer_of("cpu", config).render(case.scene, case.camera)
    actual = renderer_of(backend, config).render(case.scene, case.camera)
    off = np.abs(actual.color - expected.color).max(axis=-1) > 1e-5
    assert off.mean() < 0.02, "a random number within rounding of its alpha may decide otherwise, no more"
    other = renderer_of(backend, replace(config, seed=6)).render(case.scene, case.camera)
    assert (np.abs(other.color - expected.color).max(axis=-1) > 1e-3).mean() > 0.3


@strategies
def test_accepted_pass_of_a_stochastic_sample_has_the_colour_of_sorted_tracing(
    strategy: ls.config.TraceStrategy,
) -> None:
    """Nothing is behind the first pass; the colour of the accepted pass is that of sorting, divided by alpha."""
    scene, camera = ls.Scene([copies(12, 173)]), small_camera(8, 6, 8.0)
    config = trace_config(None, strategy=strategy, jitter=False)
    frame = renderer_of("cpu", config).render(scene, camera)
    plain = renderer_of("cpu", trace_config(None, transmittance_min=0.0)).render(scene, camera)
    taken = frame.alpha > 0.0
    assert 0.0 < taken.mean() < 1.0
    assert not frame.color[~taken].any()
    if strategy is PASS:
        np.testing.assert_allclose(frame.color[taken], plain.straight()[taken], atol=1e-4)
    else:
        eyes = oracles.sh_color(scene.splats[0], camera.eye, 3)
        for index, color in zip(frame.gaussian_index[taken], frame.color[taken], strict=True):
            np.testing.assert_allclose(color, eyes[index], atol=1e-5)
