"""Tests of clearcoat, sheen and the energy compensation of rough metals: energy, reciprocity and sampling."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.device.structs.shading import Bsdf
from lumisplat.math.reflectance import albedo_curve, sheen_albedo
from lumisplat.runtime.launcher import Launcher
from support.compare.chi_square import LIMIT, chi_square_z
from support.probes import probe_light_kernels
from support.probes.bsdf_rows import UP, Doubles, bsdf_row, direction, samples_of

WHITE = (1.0, 1.0, 1.0)
PAINT = ls.MaterialPbr(base_color=WHITE, roughness=0.6)
METAL = ls.MaterialPbr(base_color=WHITE, roughness=0.7, metallic=1.0)
COATS = {
    "coat on paint": {"clearcoat": 1.0, "clearcoat_roughness": 0.2},
    "rough coat": {"clearcoat": 0.7, "clearcoat_roughness": 0.8},
    "sheen": {"sheen_color": WHITE, "sheen_roughness": 0.4},
    "fine sheen": {"sheen_color": (0.9, 0.5, 0.2), "sheen_roughness": 0.1},
    "both": {"clearcoat": 1.0, "clearcoat_roughness": 0.3, "sheen_color": WHITE, "sheen_roughness": 0.7},
}


def on_device(row: npt.NDArray[Any], view: Doubles, lights: Doubles) -> tuple[Doubles, Doubles]:
    """Evaluates the BSDF on the device: values, shape (N, 3), and pdfs, shape (N,)."""
    count = len(lights)
    inputs = [wp.array(np.repeat(row, count), dtype=Bsdf, device="cpu")]
    for vectors in (UP, view, lights):
        inputs.append(wp.array(np.broadcast_to(vectors, (count, 3)).astype(np.float32), dtype=wp.vec3, device="cpu"))
    values, pdfs = wp.zeros(count, dtype=wp.vec3, device="cpu"), wp.zeros(count, dtype=float, device="cpu")
    Launcher("cpu", threads=1).run(probe_light_kernels.probe_bsdf, count, *inputs, values, pdfs)
    return values.numpy().astype(np.float64), pdfs.numpy().astype(np.float64)


def albedo(row: npt.NDArray[Any], cosine: float) -> tuple[float, float]:
    """Returns the reflected fraction of a constant environment's light (middle channel) and its standard error."""
    weights = samples_of(row, direction(cosine, 0.3), 60_000)["weight"][:, 1].astype(np.float64)
    return float(weights.mean()), float(weights.std() / np.sqrt(len(weights)))


@pytest.mark.parametrize("base", [PAINT, METAL], ids=["paint", "metal"])
@pytest.mark.parametrize("layers", COATS.values(), ids=COATS.keys())
def test_clearcoat_and_sheen_conserve_energy_in_a_white_furnace(layers: dict[str, Any], base: ls.MaterialPbr) -> None:
    """Reflected light never exceeds the incident light; coated white paint still reflects more than 90 % of it."""
    row = bsdf_row(replace(base, **layers))
    for cosine in (1.0, 0.8, 0.5, 0.2, 0.05):
        mean, error = albedo(row, cosine)
        assert mean <= 1.003 + 4.0 * error, cosine
        if base is PAINT and "sheen_color" not in layers and cosine >= 0.5:
            assert mean > 0.9


@pytest.mark.parametrize("layers", COATS.values(), ids=COATS.keys())
def test_bsdf_with_clearcoat_and_sheen_is_reciprocal(layers: dict[str, Any]) -> None:
    """Swapping view and light leaves the value unchanged."""
    row = bsdf_row(replace(PAINT, **layers))
    rng = np.random.default_rng(1)
    for _ in range(60):
        one, other = (direction(rng.uniform(0.02, 1.0), rng.uniform(0.0, 6.0)) for _ in range(2))
        forth, back = on_device(row, one, other[None])[0], on_device(row, other, one[None])[0]
        np.testing.assert_allclose(forth, back, rtol=2e-4)


@pytest.mark.parametrize("base", [PAINT, METAL], ids=["paint", "metal"])
@pytest.mark.parametrize("layers", [*COATS.values(), None], ids=[*COATS.keys(), "compensated"])
def test_directions_sampled_from_layered_materials_follow_the_pdf(
    layers: dict[str, Any] | None, base: ls.MaterialPbr
) -> None:
    """The chi-square test covers the hemisphere and counts rejected samples as one more bin."""
    row = bsdf_row(replace(base, **(layers or {})), compensates=layers is None)
    view, rows, columns, fine, count = direction(0.6, 1.0), 12, 12, 24, 100_000
    found = samples_of(row, view, count)
    valid = found["pdf"] > 0.0
    d = found["direction"][valid].astype(np.float64)
    ring = np.clip((d[:, 2] * rows).astype(int), 0, rows - 1)
    column = (np.arctan2(d[:, 1], d[:, 0]) % (2.0 * np.pi) / (2.0 * np.pi) * columns).astype(int) % columns
    counts = np.bincount(ring * columns + column, minlength=rows * columns).astype(np.float64)
    z = (np.arange(rows * fine) + 0.5) / (rows * fine)
    azimuth = 2.0 * np.pi * (np.arange(columns * fine) + 0.5) / (columns * fine)
    pdfs = on_device(row, view, direction(z[:, None], azimuth[None]).reshape(-1, 3))[1]
    size = 2.0 * np.pi / (rows * fine * columns * fine)
    expected = count * size * pdfs.reshape(rows, fine, columns, fine).sum(axis=(1, 3)).ravel()
    counts, expected = np.append(counts, count - valid.sum()), np.append(expected, max(count - expected.sum(), 0.0))
    assert abs(chi_square_z(counts, expected)) < LIMIT


def test_clearcoat_over_black_matches_the_gltf_equation() -> None:
    """A clearcoat over a black base equals the clearcoat term of glTF's KHR_materials_clearcoat."""
    black = replace(PAINT, base_color=(0.0, 0.0, 0.0), specular=0.0)
    view = direction(0.8, 0.0)
    light = direction(0.8, np.pi)
    alpha = 0.3**2
    for strength in (0.5, 1.0):
        row = bsdf_row(replace(black, clearcoat=strength, clearcoat_roughness=0.3))
        value = on_device(row, view, light[None])[0][0, 1]
        masks = 2.0 * 0.8 / (0.8 + np.sqrt(alpha**2 + (1.0 - alpha**2) * 0.64))
        fresnel = 0.04 + 0.96 * 0.2**5
        np.testing.assert_allclose(value, strength * fresnel * masks**2 / (np.pi * alpha**2) / (4.0 * 0.64), rtol=1e-4)


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6, 1.0])
def test_fitted_sheen_curve_approximates_the_sheen_albedo(roughness: float) -> None:
    """The fitted curve stays within a few percent and does not underestimate large albedos."""
    curve = albedo_curve(roughness)
    for cosine in (0.02, 0.1, 0.3, 0.5, 0.8, 1.0):
        truth = sheen_albedo(cosine, roughness**2, steps=500)
        found = np.exp(np.polyval(curve[::-1], cosine))
        assert found >= truth - 0.012
        assert found <= 1.06 * truth + 0.03


@pytest.mark.parametrize("roughness", [0.3, 0.6, 0.8, 1.0])
@pytest.mark.parametrize(("cosine", "least"), [(1.0, 0.9), (0.6, 0.9), (0.342, 0.9), (0.12, 0.87), (0.05, 0.87)])
def test_energy_compensated_rough_metal_reflects_at_least_87_percent(
    roughness: float, cosine: float, least: float
) -> None:
    """Compensated white metal reflects at least 87 % of the light, never more than all, and more than uncompensated."""
    metal = replace(METAL, roughness=roughness)
    mean, error = albedo(bsdf_row(metal, compensates=True), cosine)
    assert least < mean < 1.001 + 4.0 * error
    assert albedo(bsdf_row(metal), cosine)[0] < mean
    gold = replace(metal, base_color=(1.0, 0.77, 0.34))
    compensated, uncompensated = (albedo(bsdf_row(gold, compensates=on), cosine)[0] for on in (True, False))
    assert uncompensated < compensated < mean
