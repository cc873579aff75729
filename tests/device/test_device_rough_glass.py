"""Tests of rough glass: values, energy conservation, reciprocity and importance sampling."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from lumisplat.device.structs.shading import BSDF_PBR, Bsdf
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.compare.chi_square import LIMIT, chi_square_z
from support.oracles.bsdf_oracle import ggx, smith
from support.probes import probe_light_kernels
from support.probes.bsdf_rows import UP, Doubles, direction, samples_of

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
ETAS = (1.0 / 1.5, 1.5, 1.0 / 1.3)


def glass(
    alpha: float, eta: float, *, thin: bool = False, color: float = 1.0, diffuse: float = 0.0, metallic: float = 0.0
) -> npt.NDArray[Any]:
    """Returns a rough glass as one row of ``Bsdf``."""
    row = table = np.zeros(1, dtype=table_dtype(Bsdf))
    row["model"], row["alpha"], row["eta"], row["dielectric"] = BSDF_PBR, alpha, eta, 1.0
    row["grazing"], row["specular"] = 1.0, ((1.0 - eta) / (1.0 + eta)) ** 2
    row["transmitted"], row["thin_walled"], row["diffuse"] = color * (1.0 - metallic), thin, diffuse
    row["metallic"], row["metal"] = metallic, metallic * color
    return table


def on_device(table: npt.NDArray[Any], view: Doubles, lights: Doubles) -> tuple[Doubles, Doubles]:
    """Evaluates the BSDF on the device: values of the middle channel, shape (N,), and pdfs, shape (N,)."""
    count = len(lights)
    inputs = [wp.array(np.repeat(table, count), dtype=Bsdf, device="cpu")]
    for vectors in (UP, view, lights):
        given = np.broadcast_to(vectors, (count, 3)).astype(np.float32)
        inputs.append(wp.array(given, dtype=wp.vec3, device="cpu"))
    values, pdfs = wp.zeros(count, dtype=wp.vec3, device="cpu"), wp.zeros(count, dtype=float, device="cpu")
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_bsdf, count, *inputs, values, pdfs)
    return values.numpy()[:, 1].astype(np.float64), pdfs.numpy().astype(np.float64)


def sphere(rows: int, columns: int) -> tuple[Doubles, float]:
    """Returns the centres of equal-area cells over the sphere, shape (rows, columns, 3), and their solid angle."""
    z = 1.0 - 2.0 * (np.arange(rows) + 0.5) / rows
    azimuth = 2.0 * np.pi * (np.arange(columns) + 0.5) / columns
    return direction(z[:, None], azimuth[None, :]), 4.0 * np.pi / (rows * columns)


def walter(alpha: float, eta: float, view: Doubles, light: Doubles) -> float:
    """Returns the BSDF by Walter et al. 2007, equations 16 and 21, for radiance over the squared index, in float64."""
    cos_view, cos_light = view[2], light[2]
    half = view + light if cos_light > 0.0 else -(eta * view + light)
    half = half / np.linalg.norm(half) * np.sign(half[2])
    to_view, to_light = view @ half, light @ half
    if to_view <= 0.0 or (to_light > 0.0) != (cos_light > 0.0):
        return 0.0
    beyond2 = 1.0 - eta**2 * (1.0 - to_view**2)
    mirrored = 1.0
    if beyond2 > 0.0:
        beyond = np.sqrt(beyond2)
        across, along = (
            (eta * to_view - beyond) / (eta * to_view + beyond),
            (to_view - eta * beyond) / (to_view + eta * beyond),
        )
        mirrored = 0.5 * (across**2 + along**2)
    angles = (np.arccos(abs(c)) for c in (cos_view, cos_light))
    shape = float(ggx(np.arccos(half[2]), alpha)) * np.prod([float(smith(a, alpha)) for a in angles])
    if cos_light > 0.0:
        return mirrored * shape / (4.0 * cos_view * cos_light)
    cosines = abs(to_view * to_light / (cos_view * cos_light))
    return cosines * (1.0 - mirrored) * shape / (eta * to_view + to_light) ** 2


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("alpha", [0.1, 0.5])
def test_bsdf_values_of_rough_glass_match_the_equations_of_walter_2007(alpha: float, eta: float) -> None:
    """Reflection and transmission match the paper's equations for light that arrives from outside and from inside."""
    view, (lights, _) = direction(0.7, 0.4), sphere(24, 24)
    lights = lights.reshape(-1, 3).astype(np.float32).astype(np.float64)
    values, _ = on_device(glass(alpha, eta), view, lights)
    expected = np.array([walter(alpha, eta, view, light) for light in lights])
    assert (expected > 0.0).mean() > 0.3
    np.testing.assert_allclose(values, expected, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("inside", [False, True])
def test_bsdf_values_of_rough_glass_match_mitsuba(number: int, inside: bool) -> None:
    """The tool make_mitsuba_glass_reference stored them; Mitsuba does not divide radiance by the squared index."""
    with np.load(REFERENCE / "mitsuba_rough_dielectric.npz") as stored:
        views, lights, expected = stored["views"], stored["lights"], stored["values"][number, int(inside)]
        alpha, ior = float(stored["alphas"][number]), float(stored["ior"])
    eta = ior if inside else 1.0 / ior
    values = np.array(
        [on_device(glass(alpha, eta), view, light[None])[0][0] for view, light in zip(views, lights, strict=True)]
    )
    values *= np.abs(lights[:, 2]) * np.where(lights[:, 2] > 0.0, 1.0, eta**2)
    assert (expected > 1e-3).sum() > 25
    np.testing.assert_allclose(values, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("thin", [False, True])
@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("alpha", [0.2, 0.6])
def test_rough_glass_bsdf_is_reciprocal(alpha: float, eta: float, thin: bool) -> None:
    """Reflection is symmetric in view and light; so is transmission divided by the squared index behind the surface."""
    rng = np.random.default_rng(2)
    for _ in range(40):
        one, other = (direction(rng.uniform(0.2, 1.0), rng.uniform(0.0, 6.0)) for _ in range(2))
        forth, _ = on_device(glass(alpha, eta, thin=thin), one, other[None])
        back, _ = on_device(glass(alpha, eta, thin=thin), other, one[None])
        np.testing.assert_allclose(forth, back, rtol=2e-4, atol=1e-6)
        # The view from behind flips the normal, so both directions are mirrored at the surface.
        below = other * [1.0, 1.0, -1.0]
        forth, _ = on_device(glass(alpha, eta, thin=thin), one, below[None])
        behind = eta if thin else 1.0 / eta
        back, _ = on_device(glass(alpha, behind, thin=thin), other, (one * [1.0, 1.0, -1.0])[None])
        np.testing.assert_allclose(forth, back * (1.0 if thin else eta**-2), rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("thin", [False, True])
@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("alpha", [0.01, 0.1, 0.3, 1.0])
@pytest.mark.parametrize("cosine", [1.0, 0.7, 0.3])
def test_rough_glass_bsdf_conserves_energy(alpha: float, eta: float, thin: bool, cosine: float) -> None:
    """Smooth clear glass passes or reflects nearly all light; only the loss of single scattering is missing.

    Coloured glass loses the absorbed part of the transmission.
    """
    for changes in ({}, {"metallic": 0.5}, {"diffuse": 0.0, "color": 0.5}):
        weights = samples_of(glass(alpha, eta, thin=thin, **changes), direction(cosine, 0.3), 40_000)["weight"][:, 1]
        assert weights.mean() <= 1.0 + 4.0 * weights.std() / 200.0 + 1e-4
        assert weights.max() < 1.1
        if not changes and alpha <= 0.1:
            assert weights.mean() > (0.97 if cosine >= 0.7 else 0.88)
        if "color" in changes and eta < 1.0 and alpha <= 0.1 and cosine >= 0.7:
            np.testing.assert_allclose(weights.mean(), 0.5 + 0.5 * _mirrored(cosine, eta), atol=0.015)


def _mirrored(cosine: float, eta: float) -> float:
    beyond = np.sqrt(1.0 - eta**2 * (1.0 - cosine**2))
    across, along = (eta * cosine - beyond) / (eta * cosine + beyond), (cosine - eta * beyond) / (cosine + eta * beyond)
    return float(0.5 * (across**2 + along**2))


def chi_square(sampled: npt.NDArray[Any], assumed: npt.NDArray[Any], view: Doubles) -> float:
    """Returns the chi-square z-score of directions sampled for ``sampled`` against the pdf of ``assumed``."""
    rows, columns, fine, count = 24, 12, 24, 200_000
    found = samples_of(sampled, view, count)
    valid = found["pdf"] > 0.0
    d = found["direction"][valid].astype(np.float64)
    row = np.clip(((1.0 - d[:, 2]) / 2.0 * rows).astype(int), 0, rows - 1)
    column = (np.arctan2(d[:, 1], d[:, 0]) % (2.0 * np.pi) / (2.0 * np.pi) * columns).astype(int) % columns
    counts = np.bincount(row * columns + column, minlength=rows * columns).astype(np.float64)
    cells, size = sphere(rows * fine, columns * fine)
    _, pdfs = on_device(assumed, view, cells.reshape(-1, 3))
    sums = pdfs.reshape(rows, fine, columns, fine).sum(axis=(1, 3)).ravel()
    expected = count * size * sums
    assert expected.sum() < 1.003 * count
    counts, expected = np.append(counts, count - valid.sum()), np.append(expected, max(count - expected.sum(), 0.0))
    return chi_square_z(counts, expected)


@pytest.mark.parametrize("thin", [False, True])
@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize(("alpha", "cosine"), [(0.25, 0.8), (0.5, 0.3), (1.0, 1.0)])
def test_directions_sampled_from_rough_glass_follow_the_pdf(
    alpha: float, cosine: float, eta: float, thin: bool
) -> None:
    """The chi-square test covers the sphere, with and without a diffuse part; rejected samples are one more bin."""
    for diffuse in (0.0, 0.5):
        table = glass(alpha, eta, thin=thin, diffuse=diffuse)
        assert abs(chi_square(table, table, direction(cosine, 2.0))) < LIMIT


def test_chi_square_test_of_rough_glass_rejects_wrong_materials() -> None:
    """The chi-square test rejects a slightly different roughness and a slightly different index."""
    view = direction(0.8, 2.0)
    assert chi_square(glass(0.25, 1.0 / 1.5), glass(0.27, 1.0 / 1.5), view) > LIMIT
    assert chi_square(glass(0.25, 1.0 / 1.5), glass(0.25, 1.0 / 1.45), view) > LIMIT


def test_bsdf_values_of_rough_glass_are_finite_for_extreme_directions() -> None:
    """Values and weights stay finite for grazing directions and for indices of 0.05, 1 and 20."""
    ends = np.array([[1.0, 0.0, 1e-7], [-1.0, 0.0, 1e-7], [1.0, 0.0, -1e-7], [0, 0, 1], [0, 0, -1], [0.6, 0, -0.8]])
    for eta in (1.0, 0.9999, 1.0001, 0.05, 20.0):
        for alpha in (1e-30, 1e-4, 1.0):
            for thin in (False, True):
                for view in ends:
                    for found in on_device(glass(alpha, eta, thin=thin), view, ends):
                        assert np.isfinite(found).all() and (found >= 0.0).all()
                    weights = samples_of(glass(alpha, eta, thin=thin), view, 200)["weight"]
                    assert np.isfinite(weights).all()
