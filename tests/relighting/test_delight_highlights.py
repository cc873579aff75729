"""Roughness from highlights: tables against the books' equations, and surfaces whose roughness is known."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants.delight import BIN_RINGS, BIN_SECTORS, ROUGHNESS_GRID, ROUGHNESS_UNKNOWN
from lumisplat.constants.materials import SPREAD_SHARE
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.delight.albedo_fit import Light
from lumisplat.relighting.delight.incident import Incident
from lumisplat.relighting.delight.lobes import Lobes, bin_samples, bins_of, frames_of, kept_by_harmonics
from lumisplat.relighting.delight.roughness_fit import RoughnessFit, arriving_light
from lumisplat.relighting.delight.sky_cells import SkyCells
from lumisplat.scene.sampling.blue_noise import cross_pairs
from support.oracles import bsdf_oracle

Z = np.array([0.0, 0.0, 1.0])


def material(alpha: float) -> bsdf_oracle.Material:
    """A white dielectric of ior 1.5."""
    return {
        "model": "pbr", "alpha": alpha, "specular": [0.04], "grazing": 1.0, "dielectric": 1.0, "eta": 1.0 / 1.5,
        "diffuse": [1.0],
    }  # fmt: skip


@pytest.fixture(scope="module")
def lobes() -> Lobes:
    """Tables for captures of degree 3."""
    return Lobes.of(3)


def test_tables_are_the_books_equations(lobes: Lobes) -> None:
    """Both parts, each roughness: means over a bin's directions, weighted by cosines, in float64."""
    samples = bin_samples()
    spread = SPREAD_SHARE**2 * 2.0 * np.pi / (samples.shape[0] * samples.shape[1])
    cosines = samples[..., 2]
    rows = np.arange(0, len(samples), 7)
    for number, roughness in enumerate(ROUGHNESS_GRID):
        view, light = lobes.views[::5, None, None], samples[None, rows]
        wide = float(np.sqrt(roughness**4 + spread))
        highlight = np.pi * bsdf_oracle.pbr_specular(material(wide), Z, view, light)[..., 0]
        matt = np.pi * bsdf_oracle.pbr_diffuse(material(roughness**2), Z, view, light)[..., 0]
        for found, values in ((lobes.highlight, highlight), (lobes.matt, matt)):
            expected = (values * cosines[rows]).sum(axis=-1) / cosines[rows].sum(axis=-1)
            assert np.allclose(found[number, ::5][:, rows], expected, rtol=2e-4, atol=2e-5)


def test_frames_and_bins_agree() -> None:
    """Frames are rotations that take z to the normals; every sample of a bin is found in it."""
    normals = even_directions(50)
    frames = frames_of(normals)
    assert np.allclose(frames @ np.swapaxes(frames, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(frames), 1.0)
    assert np.allclose(frames @ Z, normals)
    samples = bin_samples()
    numbers = np.repeat(np.arange(len(samples)), samples.shape[1])
    assert np.array_equal(bins_of(samples.reshape(-1, 3)), numbers)


def test_harmonics_keep_what_they_can_show(lobes: Lobes) -> None:
    """Degree 1 comes through to the ridge; a function of degree 6 hardly does; degree 0 keeps the mean alone."""
    low = sh_basis(lobes.views, 1)[:, 1:]
    assert np.abs(kept_by_harmonics(lobes.views, 3) @ low - low).max() < 0.02
    high = np.cos(12.0 * np.arctan2(lobes.views[:, 1], lobes.views[:, 0]))
    assert np.square(kept_by_harmonics(lobes.views, 1) @ high).mean() < 0.1 * np.square(high).mean()
    assert np.allclose(kept_by_harmonics(lobes.views, 0), 1.0 / len(lobes.views))


def test_light_is_sorted_into_the_bins_above_gaussians() -> None:
    """From the sky and from the capture, each cell's irradiance in the bin of its direction; nothing is lost."""
    normals = even_directions(9)
    cells = SkyCells.even(4)
    rng = np.random.default_rng(2)
    cosines = np.maximum(normals @ cells.directions.T, 0.0)
    sky = (cosines * rng.random(cosines.shape)).astype(np.float32)
    by_way = (cosines.T[..., None] * rng.random((16, 9, 3))).astype(np.float16)
    light = Light(rng.random((16, 3)), np.zeros((0, 3)))
    incident = Incident(by_way.sum(axis=0), sky, np.zeros((9, 0), np.float32), cells.directions, by_way)
    arriving = arriving_light(normals, cells, incident, light)
    assert arriving.shape == (9, BIN_RINGS * BIN_SECTORS, 3)
    assert np.allclose(arriving.sum(axis=1), incident.total(light.sky, light.lamps), atol=2e-3)
    local = np.einsum("nij,ki->nkj", frames_of(normals), cells.directions)
    mean = np.einsum("nqc,qk->nk", arriving, bin_samples().mean(axis=1))
    expected = np.einsum("nkc,nkj->nj", sky[..., None] * light.sky + np.swapaxes(by_way, 0, 1), local)
    assert np.abs(mean - expected).max() < 0.12 * np.abs(expected).max()


def glossy(
    roughness: float, degree: int, noise: float = 0.0, count: int = 60
) -> tuple[ls.Gaussians, np.ndarray, np.ndarray]:
    """Gaussians of one material below a bright patch, as the float64 equations show them; normals, light of bins."""
    rng = np.random.default_rng(3)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    samples = bin_samples()
    middle = samples.mean(axis=1) / np.linalg.norm(samples.mean(axis=1), axis=1, keepdims=True)
    patch = middle @ (np.array((0.5, 0.1, 0.86)) / np.linalg.norm((0.5, 0.1, 0.86))) > 0.9
    radiance = np.where(patch, 4.0, 0.25)[:, None, None] * np.ones((1, samples.shape[1], 1))
    solid = 2.0 * np.pi / (samples.shape[0] * samples.shape[1])
    views = even_directions(300)
    views = views[views[:, 2] > 0.0]
    light, flat = samples.reshape(-1, 3), radiance.reshape(-1, 1) * samples.reshape(-1, 3)[:, 2:] * solid
    wide = float(np.sqrt(roughness**4 + SPREAD_SHARE**2 * solid))
    parts = (
        bsdf_oracle.pbr_specular(material(wide), Z, views[:, None], light[None])[..., 0],
        bsdf_oracle.pbr_diffuse(material(roughness**2), Z, views[:, None], light[None])[..., 0],
    )
    highlight, matt = (part @ flat for part in parts)
    shown = encode_srgb(np.clip(np.array((0.5, 0.3, 0.2)) * matt + highlight, 0.0, 1.0))
    sh = np.empty((count, (degree + 1) ** 2, 3))
    for row, frame in enumerate(frames_of(normals)):
        noisy = shown - 0.5 + noise * rng.standard_normal(shown.shape)
        sh[row] = np.linalg.lstsq(sh_basis(-views @ frame.T, degree), noisy, rcond=None)[0]
    arriving = np.zeros((count, len(samples), 3), np.float32)
    arriving[:] = (flat.reshape(*samples.shape[:2], 1).sum(axis=1) / np.pi)[None]
    turns = np.tile((1.0, 0.0, 0.0, 0.0), (count, 1))
    means = rng.random((count, 3))
    plain = ls.Gaussians(means, turns, np.full((count, 3), 0.01), np.ones(count), sh.astype(np.float32))
    return plain, normals, arriving


def found(plain: ls.Gaussians, normals: np.ndarray, arriving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roughness and sureness of Gaussians each by itself."""
    means = plain.means.astype(np.float64)
    fit = RoughnessFit(plain, normals, cross_pairs(means, means, 1e-6), Lobes.of(plain.sh_degree))
    rough = fit.found(arriving)
    return np.asarray(rough.value), np.asarray(rough.sureness)


@pytest.mark.parametrize("roughness", [0.3, 0.5, 0.7])
def test_a_known_roughness_is_found(roughness: float) -> None:
    """From harmonics of degree 3 of what the equations show in any frame; with noise of 1 of 255, too."""
    value, sure = found(*glossy(roughness, 3, 1.0 / 255.0))
    assert np.abs(value - roughness).max() < 0.08
    assert sure.min() > 0.8


def test_what_harmonics_do_not_hold_is_not_claimed() -> None:
    """Degree 0 leaves the prior, to the bit; the sharpest are only said to be sharp; lower degrees are less sure."""
    value, sure = found(*glossy(0.4, 0))
    assert (value == np.float32(ROUGHNESS_UNKNOWN)).all()
    assert sure.max() < 1e-9
    assert found(*glossy(0.15, 3))[0].max() < 0.35
    assert found(*glossy(0.4, 1, 0.02))[1].mean() < found(*glossy(0.4, 3, 0.02))[1].mean()


def test_noise_is_not_taken_for_highlights() -> None:
    """Colours that change with the direction by chance alone make nothing sharp, and nothing sure."""
    plain, normals, arriving = glossy(1.0, 3)
    rng = np.random.default_rng(8)
    sh = plain.sh.copy()
    sh[:, 1:] += 0.1 * rng.standard_normal(sh[:, 1:].shape)
    noisy = ls.Gaussians(plain.means, plain.rotations_wxyz, plain.scales, plain.opacities, sh)
    value, sure = found(noisy, normals, arriving)
    assert np.median(value) > 0.65
    assert np.median(sure) < 0.6
