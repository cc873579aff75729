"""Decimation preserves mass, mean, covariance and colour, and looks better than dropping Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.scene.editing.decimate import areas, log_determinants, mixtures, moments_of, shapes
from support.kinds import expect_kind, present
from support.scenes.raster_scenes import random_gaussians
from support.scenes.sphere import sphere_quadrature, unit


def covariances(gaussians: ls.Gaussians) -> np.ndarray:
    """Returns covariances, shape (N, 3, 3), float64."""
    axes = matrices_from_quaternions(gaussians.rotations_wxyz) * gaussians.scales[:, None, :].astype(np.float64)
    return axes @ axes.transpose(0, 2, 1)


def test_area_of_a_gaussian_in_decimation_is_its_mean_silhouette_over_all_directions() -> None:
    """The closed form is the root mean square of sqrt(n adj(C) n) over all directions n, for a covariance C."""
    gaussians = random_gaussians(2, count=20, scale_range=(0.01, 2.0))
    directions, weights = sphere_quadrature(8)
    adjugates = np.linalg.inv(covariances(gaussians)) * np.linalg.det(covariances(gaussians))[:, None, None]
    squares = np.einsum("ki,nij,kj->nk", directions, adjugates, directions)
    expected = np.sqrt(3.0 * squares @ weights / weights.sum())
    np.testing.assert_allclose(areas(moments_of(gaussians).covariances), expected, rtol=1e-6)


def test_gaussian_to_which_a_capture_is_decimated_has_mass_mean_and_covariance_of_all() -> None:
    """NumPy computes mass, mean, covariance, SH and materials of the mixture."""
    rng = np.random.default_rng(7)
    normals = unit(5, 40)
    normals[:, 2] = np.abs(normals[:, 2])
    extra = {"normals": normals, "albedo": rng.random((40, 3)), "roughness": rng.random(40)}
    gaussians = random_gaussians(3, count=40, degree=2, extent=(0.1, 0.1, 0.1), scale_range=(0.3, 0.6), **extra)
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.02)
    one = ls.editing.decimate(gaussians, 1)
    shapes_ = covariances(gaussians)
    size = np.sqrt([0.5 * (np.trace(c) ** 2 - np.trace(c @ c)) for c in shapes_])  # the trace of the adjugate
    mass = gaussians.opacities * size
    weights = mass / mass.sum()
    mean = weights @ gaussians.means.astype(np.float64)
    offsets = gaussians.means - mean
    covariance = np.einsum("n,nij->ij", weights, shapes_ + offsets[:, :, None] * offsets[:, None, :])
    np.testing.assert_allclose(one.means[0], mean, atol=1e-5)
    np.testing.assert_allclose(covariances(one)[0], covariance, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(one.sh[0], np.einsum("n,nkc->kc", weights, gaussians.sh), atol=1e-6)
    covered = np.sqrt(0.5 * (np.trace(covariance) ** 2 - np.trace(covariance @ covariance)))
    np.testing.assert_allclose(one.opacities[0], mass.sum() / covered, rtol=1e-4)
    assert one.opacities[0] < 1.0
    normal = weights @ normals
    np.testing.assert_allclose(present(one.normals)[0], normal / np.linalg.norm(normal), atol=1e-5)
    np.testing.assert_allclose(present(one.albedo)[0], weights @ extra["albedo"], atol=1e-6)
    np.testing.assert_allclose(present(one.roughness)[0], weights @ extra["roughness"], atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 57, 299, 300])
def test_decimation_preserves_mass_mean_and_covariance_of_the_capture(count: int) -> None:
    """The number of Gaussians is exactly the requested one."""
    gaussians = random_gaussians(4, count=300, degree=1, scale_range=(0.2, 0.9))
    gaussians = replace(gaussians, opacities=gaussians.opacities * 0.01)  # merged opacities stay below 1
    fewer = ls.editing.decimate(gaussians, count)
    assert (fewer.count, fewer.sh_degree) == (count, 1)
    everything = np.zeros(300, np.intp)
    whole, left = moments_of(gaussians), moments_of(fewer)
    before, after = mixtures(whole, everything, 1), mixtures(left, everything[:count], 1)
    np.testing.assert_allclose(after.masses, before.masses, rtol=1e-5)
    np.testing.assert_allclose(after.means, before.means, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(after.covariances, before.covariances, rtol=1e-4, atol=1e-5)


def test_decimated_discs_of_a_plane_stay_flat_and_in_the_plane() -> None:
    """Adjacent discs merge to larger discs with the plane's normal and the original thickness."""
    x, y = np.meshgrid(np.arange(32.0), np.arange(32.0))
    means = np.column_stack([x.ravel(), y.ravel(), np.full(1024, 5.0)])
    scales = np.tile([0.7, 0.7, 1e-4], (1024, 1))
    plane = ls.Gaussians(means, np.tile([1, 0, 0, 0], (1024, 1)), scales, np.full(1024, 0.9), np.zeros((1024, 1, 3)))
    fewer = ls.editing.decimate(plane, 100)
    assert fewer.scales.min(axis=1).max() < 1.1e-4
    np.testing.assert_allclose(np.abs(ls.estimate_normals(fewer)), np.tile([0, 0, 1], (100, 1)), atol=1e-3)
    np.testing.assert_allclose(fewer.means[:, 2], 5.0, atol=1e-5)


def test_decimation_does_not_merge_gaussians_of_different_colours() -> None:
    """Coincident red and blue Gaussians do not merge to purple while other merges are possible."""
    rng = np.random.default_rng(0)
    sh = np.where(np.arange(400)[:, None, None] < 200, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    mixed = ls.Gaussians(
        rng.uniform(0, 1, (400, 3)), np.tile([1, 0, 0, 0], (400, 1)), np.full((400, 3), 0.1), np.full(400, 0.5), sh
    )
    fewer = ls.editing.decimate(mixed, 100)
    purple = np.abs(fewer.sh[:, 0, 0]) < 1.0
    assert np.count_nonzero(purple) <= 5


def test_decimation_merges_a_thousand_equal_gaussians_to_the_same_gaussian() -> None:
    """A thousand copies of one Gaussian, transparent or opaque, merge to the same Gaussian in less than 40 passes."""
    one = random_gaussians(1, count=1, degree=1)
    for opacity in (0.0, 1.0):
        copies = replace(one.subset(np.zeros(1000, np.int64)), opacities=np.full(1000, opacity))
        passes: list[float] = []
        fewer = ls.editing.decimate(copies, 3, progress=passes.append)
        assert fewer.count == 3
        assert len(passes) < 40  # each pass merges many pairs, even if all costs are equal
        np.testing.assert_allclose(fewer.means, np.repeat(one.means, 3, axis=0), atol=1e-6)
        np.testing.assert_allclose(fewer.opacities, opacity, atol=1e-5 if opacity == 0.0 else 0.0)
        np.testing.assert_allclose(np.sort(fewer.scales), np.sort(np.repeat(one.scales, 3, axis=0)), rtol=1e-4)


def test_decimation_is_deterministic_and_reports_progress() -> None:
    """Two runs are identical, and progress grows to 1."""
    gaussians = random_gaussians(9, count=3000)
    progress: list[float] = []
    first, second = ls.editing.decimate(gaussians, 200, progress=progress.append), ls.editing.decimate(gaussians, 200)
    for name, values in first.arrays().items():
        np.testing.assert_array_equal(values, second.arrays()[name])
    assert progress == sorted(progress) and progress[-1] == 1.0 and len(progress) > 4


def test_covariances_convert_to_rotations_and_scales_and_back() -> None:
    """Rotations and scales reproduce the covariances, also of needles and discs."""
    gaussians = random_gaussians(12, count=200, scale_range=(1e-3, 2.0))
    packed = moments_of(gaussians).covariances
    rotations, scales = shapes(packed)
    again = replace(gaussians, rotations_wxyz=rotations, scales=scales)
    np.testing.assert_allclose(covariances(again), covariances(gaussians), rtol=1e-4, atol=1e-6)
    expected = np.linalg.slogdet(covariances(gaussians))[1]
    np.testing.assert_allclose(log_determinants(packed), expected, atol=0.01)


@pytest.mark.parametrize(("share", "better"), [(0.25, 6.0), (0.10, 6.0)])
def test_decimation_gives_a_higher_psnr_than_keeping_random_or_the_most_opaque_gaussians(
    data_dir: Path, share: float, better: float
) -> None:
    """The decimated biker is closer to the original than equally many Gaussians chosen at random or by opacity."""
    biker = expect_kind(ls.Gaussians, ls.load(data_dir / "splats" / "biker.spz"))
    count = int(biker.count * share)
    passes: list[float] = []
    merged = ls.editing.decimate(biker, count, progress=passes.append)
    assert len(passes) <= 4.0 * math.log2(1.0 / share)  # each pass removes a sixth of the Gaussians or more
    chosen = np.random.default_rng(0).choice(biker.count, count, replace=False)
    opaque = np.argsort(-biker.opacities, kind="stable")[:count]
    low, high = np.quantile(biker.means, (0.05, 0.95), axis=0)
    middle, size = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    camera = ls.Camera.look_at(
        middle + size * np.array([0.7, -0.6, -2.2]), middle, (0, -1, 0), width=480, height=360, fov_y=0.8
    )
    renderer = ls.create_renderer(ls.RenderConfig(background=(0.5, 0.5, 0.5)), "cpu")

    def picture(gaussians: ls.Gaussians) -> np.ndarray:
        return np.clip(renderer.render(ls.Scene(splats=[gaussians]), camera).color, 0.0, 1.0)

    whole = picture(biker)
    decibels = [ls.metrics.psnr(picture(one), whole) for one in (merged, biker.subset(chosen), biker.subset(opaque))]
    assert decibels[0] > max(decibels[1:]) + better
