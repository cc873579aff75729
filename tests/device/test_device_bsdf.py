"""Tests of the BSDFs: published equations, reciprocity, energy conservation and importance sampling."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from lumisplat.device.material.bsdf import BsdfSample
from lumisplat.device.structs.shading import BSDF_PBR, BSDF_SIMPLE, Bsdf
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from support.compare.chi_square import LIMIT, chi_square_z
from support.oracles.bsdf_oracle import Array, Material, evaluate, fresnel, ggx, mirrored, mirrored_share, pdf
from support.probes import probe_light_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]

# An orthonormal frame aligned with no coordinate axis: the normal and two tangents.
NORMAL = np.array([2.0, -3.0, 6.0]) / 7.0
ALONG = np.array([6.0, -2.0, -3.0]) / 7.0
ACROSS = np.cross(NORMAL, ALONG)


def pbr(
    alpha: float, diffuse: float = 0.8, specular: float = 0.04, grazing: float = 1.0, tint: bool = False
) -> Material:
    """Returns an oracle material of the metallic-roughness model with GGX ``alpha`` and a dielectric diffuse part."""
    channels = np.array([1.0, 0.6, 0.3]) if tint else np.ones(3)
    ratio = math.sqrt(specular / grazing) if grazing > 0.0 else 0.0
    return {
        "model": "pbr",
        "diffuse": diffuse * channels,
        "specular": specular * channels,
        "grazing": grazing,
        "alpha": alpha,
        "shininess": 0.0,
        "dielectric": grazing,
        "eta": (1.0 - ratio) / (1.0 + ratio),
    }


def half_metal(alpha: float, share: float = 0.5) -> Material:
    """Returns a white material whose metallic value is ``share``."""
    specular, grazing = 0.04 * (1.0 - share) + share, 1.0
    return pbr(alpha, 1.0 - share, 0.04) | {"specular": np.full(3, specular), "grazing": grazing}


def simple(shininess: float, diffuse: float = 0.5, specular: float = 0.3, tint: bool = False) -> Material:
    """Returns an oracle material of the simple (Phong) model."""
    return pbr(0.0, diffuse, specular, 0.0, tint) | {"model": "simple", "shininess": shininess}


def rows(material: Material, count: int) -> npt.NDArray[Any]:
    """Returns ``count`` copies of the material as rows of ``Bsdf``."""
    table = np.zeros(count, dtype=table_dtype(Bsdf))
    table["model"] = BSDF_SIMPLE if material["model"] == "simple" else BSDF_PBR
    for name in ("diffuse", "specular", "grazing", "alpha", "shininess", "dielectric", "eta"):
        table[name] = material[name]
    table["mean_mirrored"] = mirrored_share(material, None)
    return table


def on_device(
    material: Material, normals: Array, views: Array, lights: Array, device: str = "cpu"
) -> tuple[Array, Array]:
    """Evaluates the BSDF on the device: values, shape (N, 3), and pdfs, shape (N,)."""
    count = len(lights)
    inputs = [wp.array(rows(material, count), dtype=Bsdf, device=device)]
    for vectors in (normals, views, lights):
        given = np.broadcast_to(vectors, (count, 3)).astype(np.float32)
        inputs.append(wp.array(given, dtype=wp.vec3, device=device))
    values, pdfs = wp.zeros(count, dtype=wp.vec3, device=device), wp.zeros(count, dtype=float, device=device)
    Launcher(device, threads=1).run(probe_light_kernels.probe_bsdf, count, *inputs, values, pdfs)
    return values.numpy().astype(np.float64), pdfs.numpy().astype(np.float64)


def sample_directions(
    material: Material, view: Array, randoms: npt.NDArray[Any], device: str = "cpu"
) -> npt.NDArray[Any]:
    """Samples directions on the device for the normal ``NORMAL``, with their weights and pdfs."""
    count = len(randoms)
    normals, views = (np.broadcast_to(v, (count, 3)).astype(np.float32) for v in (NORMAL, view))
    inputs = [wp.array(rows(material, count), dtype=Bsdf, device=device)]
    inputs += [wp.array(v, dtype=wp.vec3, device=device) for v in (normals, views, randoms.astype(np.float32))]
    samples = wp.zeros(count, dtype=BsdfSample, device=device)
    Launcher(device, threads=1).run(probe_light_kernels.probe_bsdf_samples, count, *inputs, samples)
    return samples.numpy()


def unit(vectors: Array) -> Array:
    """Normalises the vectors."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def direction(cos: npt.ArrayLike, azimuth: npt.ArrayLike) -> Array:
    """Returns directions at the given cosine of the angle to ``NORMAL`` and the given azimuth in radians."""
    cos, azimuth = np.asarray(cos)[..., None], np.asarray(azimuth)[..., None]
    return cos * NORMAL + np.sqrt(1.0 - cos * cos) * (np.cos(azimuth) * ALONG + np.sin(azimuth) * ACROSS)


def pairs(count: int, alpha: float, seed: int) -> tuple[Array, Array, Array]:
    """Returns normals, views and lights, each of shape (count, 3).

    The pairs cover random, grazing, near-mirror, mirror, perpendicular and equal directions.
    """
    rng = np.random.default_rng(seed)
    normals = unit(rng.normal(size=(count, 3)))
    views, lights = (unit(rng.normal(size=(count, 3))) for _ in range(2))
    kind = np.arange(count) % 6
    for vectors, chosen in ((views, kind == 1), (lights, (kind == 1) | (kind == 2))):
        flat = unit(np.cross(normals, vectors))
        cos = 10.0 ** rng.uniform(-6.0, -1.0, count)[:, None]
        vectors[chosen] = unit(flat + cos * normals)[chosen]
    near = unit(mirrored(normals, views) + alpha * rng.normal(size=(count, 3)))
    lights[kind == 3] = near[kind == 3]
    lights[kind == 4] = mirrored(normals, views)[kind == 4]
    lights[kind == 5] = views[kind == 5]
    views[::30], lights[::60] = normals[::30], normals[::60]
    single = [np.asarray(vectors, dtype=np.float32).astype(np.float64) for vectors in (normals, views, lights)]
    return single[0], single[1], single[2]


MATERIALS = [
    *(pbr(alpha) for alpha in (0.0, 1e-30, 1e-6, 1e-4, 0.01, 0.09, 0.25, 0.6, 1.0)),
    *(pbr(alpha, diffuse=0.0, specular=0.9, tint=True) for alpha in (1e-6, 0.01, 0.25, 1.0)),
    pbr(0.25, specular=0.0, grazing=0.0, tint=True),
    pbr(0.25, specular=0.3, grazing=0.5, tint=True),
    pbr(0.04, diffuse=0.0, specular=0.0),
    half_metal(0.3),
    *(simple(shininess, tint=True) for shininess in (0.0, 1.0, 32.0, 10_000.0)),
    simple(20.0, diffuse=1.0, specular=1.0),
    simple(20.0, specular=0.0),
    simple(20.0, diffuse=0.0),
]


# --- Published equations ---


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("number", range(len(MATERIALS)))
def test_bsdf_values_and_pdfs_match_the_float64_oracle(number: int, device: str) -> None:
    """BSDF values and pdfs match the float64 oracle within what rounding the directions to float32 allows."""
    material = MATERIALS[number]
    normals, views, lights = pairs(3000, material["alpha"], number)
    values, pdfs = on_device(material, normals, views, lights, device)
    expected = evaluate(material, normals, views, lights), pdf(material, normals, views, lights)
    spread = [np.zeros_like(part) for part in expected]
    rng = np.random.default_rng(1)
    for _ in range(12):
        moved = [unit(vectors + 1.2e-7 * rng.normal(size=vectors.shape)) for vectors in (normals, views, lights)]
        for i, part in enumerate((evaluate(material, *moved), pdf(material, *moved))):
            spread[i] = np.maximum(spread[i], np.abs(part - expected[i]))
    for found, wanted, rounding in zip((values, pdfs), expected, spread, strict=True):
        assert np.isfinite(found).all()
        bound = (2e-5 + 4e-7 * material["shininess"]) * wanted + 5.0 * rounding + 1e-9
        np.testing.assert_array_less(np.abs(found - wanted) / bound, 1.0)
    if material["alpha"] > 1e-3:  # rounding would otherwise exceed the values
        assert np.median((spread[0] / np.maximum(values, 1e-30))[values > 0.0]) < 1e-4


def test_bsdf_values_at_normal_incidence_match_closed_forms() -> None:
    """The closed forms are albedo / pi, the GGX highlight F0 / (4 pi alpha^2) and Phong's (n + 2) / (2 pi)."""
    straight = NORMAL[None]
    matte, _ = on_device(pbr(0.5, diffuse=0.6, specular=0.0, grazing=0.0), NORMAL, straight, straight)
    np.testing.assert_allclose(matte[0], 0.6 / math.pi, rtol=1e-6)
    metal, picked = on_device(pbr(0.5, diffuse=0.0, specular=0.7), NORMAL, straight, straight)
    np.testing.assert_allclose(metal[0], 0.7 / math.pi, rtol=1e-5)
    assert picked[0] == pytest.approx(1.0 / math.pi, rel=1e-5)
    phong, picked = on_device(simple(4.0, diffuse=0.0, specular=0.5), NORMAL, straight, straight)
    np.testing.assert_allclose(phong[0], 1.5 / math.pi, rtol=1e-5)
    assert picked[0] == pytest.approx(2.5 / math.pi, rel=1e-5)
    # Diffuse and specular that exceed 1 in sum are scaled down: 1 + 1 becomes 1/2 + 1/2.
    both, _ = on_device(simple(4.0, diffuse=1.0, specular=1.0), NORMAL, straight, straight)
    np.testing.assert_allclose(both[0], 0.5 * (1.0 + 3.0) / math.pi, rtol=1e-5)


@pytest.mark.parametrize("number", range(len(MATERIALS)))
def test_bsdf_values_are_reciprocal_in_view_and_light_direction(number: int) -> None:
    """Swapping view and light leaves the value unchanged."""
    normals, views, lights = pairs(6000, MATERIALS[number]["alpha"], 7)
    forward, _ = on_device(MATERIALS[number], normals, views, lights)
    swapped, _ = on_device(MATERIALS[number], normals, lights, views)
    np.testing.assert_allclose(forward, swapped, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("number", range(len(MATERIALS)))
def test_bsdf_values_and_pdfs_are_zero_below_the_horizon(number: int) -> None:
    """The BSDF returns no samples for a view below the surface either."""
    material = MATERIALS[number]
    normals, views, lights = pairs(6000, material["alpha"], 8)
    values, pdfs = on_device(material, normals, views, lights)
    below = (np.sum(normals * views, axis=1) < -1e-6) | (np.sum(normals * lights, axis=1) < -1e-6)
    assert below.sum() > 1000
    assert not values[below].any()
    assert not pdfs[below].any()
    assert not sample_directions(material, -NORMAL, np.random.default_rng(0).random((50, 3)))["pdf"].any()


@pytest.mark.parametrize("number", range(len(MATERIALS)))
def test_bsdf_values_and_samples_are_finite_for_extreme_directions(number: int) -> None:
    """Values and samples stay finite for opposite, tangential and zero vectors and for random numbers of 0 and 1."""
    material = MATERIALS[number]
    special = [NORMAL, ALONG, -ALONG, unit(ALONG + 1e-8 * NORMAL), unit(-ALONG + 1e-8 * NORMAL), ALONG + 1e-25 * NORMAL]
    special += [unit(ALONG + 1e-3 * NORMAL), unit(-ALONG + 1e-3 * NORMAL), np.zeros(3), -NORMAL]
    views, lights = (np.array(side) for side in zip(*((v, w) for v in special for w in special), strict=True))
    for found in on_device(material, NORMAL, views, lights):
        assert np.isfinite(found).all()
        assert (found >= 0.0).all()
    # Along the z axis, the smallest cosines are exact.
    up, low = np.array([0.0, 0.0, 1.0]), np.array([[1.0, 0.0, 1e-25], [1.0, 0.0, 1e-12], [1.0, 0.0, 1e-4]])
    for view in low:
        for found in on_device(material, up, view, np.concatenate([low, low * [-1.0, 1.0, 1.0]])):
            assert np.isfinite(found).all()
    ends = np.array([0.0, 0.5, 1.0 - 2.0**-24, 1.0])
    randoms = np.stack(np.meshgrid(ends, ends, ends), axis=-1).reshape(-1, 3)
    for view in special:
        samples = sample_directions(material, view, randoms)
        for name in ("direction", "weight", "pdf"):
            assert np.isfinite(samples[name]).all()
        np.testing.assert_allclose(np.linalg.norm(samples["direction"], axis=1), 1.0, atol=1e-5)
        assert (samples["weight"] >= 0.0).all()


# --- Energy under a constant environment ---


def reflected(material: Material, view: Array, steps: int = 96) -> float:
    """Returns the fraction of a constant environment's light that is reflected to ``view`` (middle channel).

    Integrates by quadrature over the hemisphere of lights, without GGX highlights, which may be narrower than the
    steps.
    """
    centers = (np.arange(steps) + 0.5) / steps
    cos, azimuth = np.meshgrid(centers, 2.0 * np.pi * centers, indexing="ij")
    lights = direction(cos, azimuth).reshape(-1, 3)
    values, _ = on_device(material, NORMAL, view[None], lights)
    if material["alpha"] > 0.0:
        values -= on_device(material | {"diffuse": np.zeros(3)}, NORMAL, view[None], lights)[0]
    return float((values[:, 1] * cos.ravel()).mean() * 2.0 * np.pi)


def highlighted(material: Material, view: Array, steps: int = 96) -> float:
    """Returns the fraction of light that the GGX highlight alone reflects to ``view`` (middle channel).

    Integrates by quadrature over the microfacet normals, which resolves highlights of any width.
    """
    alpha = material["alpha"]
    centers = (np.arange(steps) + 0.5) / steps
    share, azimuth = np.meshgrid(centers, 2.0 * np.pi * centers, indexing="ij")
    theta = np.arctan(alpha * np.sqrt(share / (1.0 - share)))
    half = direction(np.cos(theta), azimuth).reshape(-1, 3)
    to_half = half @ view
    lights = 2.0 * to_half[:, None] * half - view
    values, _ = on_device(material, NORMAL, view[None], lights)
    # The solid angle of the light is that of the microfacet normals times 4 cos; their pdf is D cos.
    spread = ggx(theta.ravel(), alpha) * np.cos(theta.ravel())
    shone = values[:, 1] * np.maximum(lights @ NORMAL, 0.0) * 4.0 * np.maximum(to_half, 0.0) / spread
    return float(shone.mean())


COSINES = (1.0, 0.9, 0.62, 0.4, 0.2, 0.1, 0.05)


@pytest.mark.parametrize("alpha", [0.004, 0.01, 0.03, 0.09, 0.14, 0.25, 0.5, 1.0])
def test_pbr_bsdf_conserves_energy_in_a_white_furnace(alpha: float) -> None:
    """Reflected light never exceeds the incident light; common dielectrics reflect at least 97 % of it."""
    for specular, grazing in ((0.0, 1.0), (0.04, 1.0), (0.2, 1.0), (0.7, 1.0), (0.25, 0.25), (0.04, 0.5)):
        for cos in COSINES:
            view = direction(cos, 0.3)
            total = highlighted(pbr(alpha, 0.0, specular, grazing), view)
            total += reflected(pbr(alpha, 1.0, specular, grazing), view)
            assert total <= 1.0003, (specular, grazing, cos)
            assert total >= (0.97 if specular <= 0.04 and cos >= 0.1 else 0.9), (specular, grazing, cos)


@pytest.mark.parametrize("cos", COSINES)
def test_metal_of_reflectance_1_and_small_roughness_reflects_all_light(cos: float) -> None:
    """A reflectance of 1 at small roughness reflects all light."""
    if cos > 0.1:
        assert highlighted(pbr(0.01, 0.0, 1.0), direction(cos, 1.0)) == pytest.approx(1.0, abs=0.01)
    assert highlighted(pbr(1e-4, 0.0, 1.0), direction(cos, 1.0)) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("cos", COSINES)
def test_mirror_and_diffuse_reflection_of_a_smooth_white_dielectric_add_up_to_1(cos: float) -> None:
    """The specular reflection, which the BSDF leaves to mirror rays, and the white diffuse part add up to 1."""
    mirror = float(fresnel(np.array(cos), 1.0 / 1.5))
    total = mirror + reflected(pbr(0.0, 1.0, 0.04), direction(cos, 1.0), 200)
    assert total == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("cos", COSINES[:-2])
@pytest.mark.parametrize("alpha", [0.01, 0.09, 0.25, 1.0])
def test_albedo_of_a_partial_metal_is_linear_in_the_metallic_factor(alpha: float, cos: float) -> None:
    """The albedo of a half metal is the weighted mean of white metal and white paint."""
    view = direction(cos, 0.3)
    paint = highlighted(pbr(alpha, 0.0), view) + reflected(pbr(alpha, 1.0), view)
    metal = highlighted(pbr(alpha, 0.0, 1.0), view)
    for share in (0.2, 0.5, 0.9):
        both = half_metal(alpha, share)
        total = highlighted(both | {"diffuse": np.zeros(3)}, view) + reflected(both, view)
        assert total == pytest.approx(share * metal + (1.0 - share) * paint, abs=1e-5)
        assert total <= 1.0003


def test_diffuse_bsdf_reflects_exactly_its_albedo() -> None:
    """The PBR and the simple model reflect their diffuse colour when they have no highlight."""
    for material in (pbr(0.3, 0.7, 0.0, 0.0), simple(8.0, 0.7, 0.0)):
        for cos in COSINES:
            assert reflected(material, direction(cos, 0.1), 8) == pytest.approx(0.7, abs=1e-6)


@pytest.mark.parametrize("shininess", [0.0, 1.0, 10.0, 60.0])
def test_simple_material_bsdf_conserves_energy(shininess: float) -> None:
    """The highlight of the simple model reflects its full strength at normal incidence; the total never exceeds 1."""
    for cos in COSINES:
        view = direction(cos, 0.3)
        assert reflected(simple(shininess, 0.4, 0.6), view, 200) <= 1.001
        assert reflected(simple(shininess, 1.0, 1.0), view, 200) <= 1.001
    assert reflected(simple(shininess, 0.0, 0.6), NORMAL, 200) == pytest.approx(0.6, rel=5e-3)


# --- Importance sampling ---


def bins(axis: Array, alpha: float, rings: int, sectors: int, fine: int) -> tuple[Array, Array]:
    """Returns fine^2 directions in each of rings * sectors bins around ``axis``, and each direction's solid angle.

    The shapes are (rings * sectors, fine^2, 3) and (rings * sectors, fine^2). Bins near the axis are narrower, to
    resolve a lobe of width ``alpha``.
    """
    count = rings * fine
    s = ((np.arange(count) + 0.5) / count).reshape(rings, 1, fine, 1)
    azimuth = 2.0 * np.pi * ((np.arange(sectors * fine) + 0.5) / (sectors * fine)).reshape(1, sectors, 1, fine)
    theta = 2.0 * np.arctan(alpha * s / (1.0 - s))
    slope = 2.0 * alpha / ((1.0 - s) ** 2 + (alpha * s) ** 2)
    size = np.sin(theta) * slope / count * 2.0 * np.pi / (sectors * fine) + 0.0 * azimuth
    first = unit(np.cross(axis, ALONG + 0.1 * NORMAL))
    second = np.cross(axis, first)
    vectors = np.cos(theta)[..., None] * axis + np.sin(theta)[..., None] * (
        np.cos(azimuth)[..., None] * first + np.sin(azimuth)[..., None] * second
    )
    return vectors.reshape(rings * sectors, fine * fine, 3), size.reshape(rings * sectors, fine * fine)


def bin_of(directions: Array, axis: Array, alpha: float, rings: int, sectors: int) -> npt.NDArray[np.int64]:
    """Returns the index of the bin that contains each direction."""
    first = unit(np.cross(axis, ALONG + 0.1 * NORMAL))
    second = np.cross(axis, first)
    x, y, z = directions @ first, directions @ second, directions @ axis
    tangent = np.tan(0.5 * np.arctan2(np.hypot(x, y), z)) / alpha
    ring = np.minimum((tangent / (1.0 + tangent) * rings).astype(np.int64), rings - 1)
    sector = np.minimum((np.arctan2(y, x) % (2.0 * np.pi) / (2.0 * np.pi) * sectors).astype(np.int64), sectors - 1)
    return ring * sectors + sector


def chi_square_of_samples(material: Material, assumed: Material, cos: float, alpha: float) -> float:
    """Returns the chi-square z-score of directions sampled for ``material`` against the pdf of ``assumed``."""
    view = direction(cos, 2.0)
    axis = unit(mirrored(NORMAL, view))
    count, rings, sectors, fine = 200_000, 20, 12, 20
    samples = sample_directions(material, view, np.random.default_rng(5).random((count, 3), dtype=np.float32))
    valid = samples["pdf"] > 0.0
    assert (samples["direction"][valid] @ NORMAL > -1e-6).all()
    vectors, size = bins(axis, alpha, rings, sectors, fine)
    _, pdfs = on_device(assumed, NORMAL, view[None], vectors.reshape(-1, 3))
    expected = count * (pdfs.reshape(size.shape) * size).sum(axis=1)
    found = bin_of(samples["direction"][valid].astype(np.float64), axis, alpha, rings, sectors)
    counts = np.bincount(found, minlength=rings * sectors).astype(np.float64)
    # The pdf excludes directions below the horizon; their samples count as one more bin.
    assert expected.sum() < 1.002 * count
    counts, expected = np.append(counts, count - valid.sum()), np.append(expected, max(count - expected.sum(), 0.0))
    return chi_square_z(counts, expected)


@pytest.mark.parametrize("cos", [1.0, 0.7, 0.3, 0.05])
@pytest.mark.parametrize(
    "material",
    [
        *(pbr(roughness**2) for roughness in (0.1, 0.3, 0.6, 1.0)),
        *(pbr(roughness**2, diffuse=0.0, specular=0.8, tint=True) for roughness in (0.1, 0.3, 0.6, 1.0)),
        pbr(0.0),
        simple(0.0),
        simple(5.0),
        simple(300.0, diffuse=0.2),
        simple(40.0, diffuse=0.0),
    ],
    ids=lambda m: f"{m['model']}-{m['alpha']:.2g}-{m['shininess']:.0f}-{max(m['diffuse']):.1f}",
)
def test_directions_sampled_from_the_bsdf_follow_its_pdf(material: Material, cos: float) -> None:
    """The chi-square test covers the whole sphere and counts rejected samples as one more bin."""
    narrow = material["alpha"] if material["model"] == "pbr" else 1.0 / math.sqrt(material["shininess"] + 1.0)
    alpha = float(np.clip(2.0 * narrow, 0.02, 1.0)) if narrow > 0.0 else 1.0
    assert abs(chi_square_of_samples(material, material, cos, alpha)) < LIMIT


def test_chi_square_test_of_bsdf_samples_rejects_wrong_pdfs() -> None:
    """The chi-square test rejects a slightly wider highlight and a slightly different diffuse fraction."""
    metal = pbr(0.09, diffuse=0.0)
    assert chi_square_of_samples(metal, pbr(0.1, diffuse=0.0), 0.7, 0.2) > LIMIT
    assert chi_square_of_samples(pbr(0.09), pbr(0.09, diffuse=0.6), 0.3, 0.2) > LIMIT


@pytest.mark.parametrize("number", [4, 6, 8, 10, 12, 14, 17, 19])
def test_bsdf_sample_weight_is_value_times_cosine_over_pdf(number: int) -> None:
    """The mean weight is the light reflected under a constant environment of radiance 1."""
    material = MATERIALS[number]
    view = direction(0.6, 0.4)
    samples = sample_directions(material, view, np.random.default_rng(6).random((100_000, 3), dtype=np.float32))
    valid = samples[samples["pdf"] > 0.0]
    values, pdfs = on_device(material, NORMAL, view[None], valid["direction"])
    cosines = valid["direction"].astype(np.float64) @ NORMAL.astype(np.float32).astype(np.float64)
    clear = cosines > 1e-3
    np.testing.assert_allclose(valid["pdf"], pdfs, rtol=1e-6)
    expected = (values * (cosines / pdfs)[:, None])[clear]
    np.testing.assert_allclose(valid["weight"][clear], expected, rtol=1e-3, atol=1e-6)
    assert not samples["weight"][samples["pdf"] <= 0.0].any()
    mean = samples["weight"][:, 1].mean(dtype=np.float64)
    error = float(samples["weight"][:, 1].std()) / math.sqrt(len(samples))
    if material["model"] == "simple":
        furnace = reflected(material, view, 300)
    else:
        furnace = reflected(material, view, 200)
        furnace += highlighted(material | {"diffuse": np.zeros(3)}, view, 200)
    assert mean == pytest.approx(furnace, abs=LIMIT * error + 2e-3)
