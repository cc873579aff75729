"""R3DG's estimator, which ours is compared with, against its formulas and against differences."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from bench.relightable import r3dg_light
from bench.relightable.r3dg import EVEN_SKY, GREY_LIGHT, R3dgFit

import lumisplat as ls
from lumisplat.math.directions import panorama_directions
from lumisplat.math.sh import sh_basis
from lumisplat.training.views import TrainingView
from support.scenes.lit_sphere import ball, matte, photographed

Array = np.ndarray


def even(ways: Array) -> Array:
    """The same radiance from everywhere."""
    return np.full((len(ways), 3), 0.8)


@pytest.fixture(scope="module")
def fit(tmp_path_factory: pytest.TempPathFactory) -> R3dgFit:
    """Of a small ball, with materials and light that are all different."""
    capture = matte(ball(150), np.array([0.5, 0.4, 0.3]), even)
    folder = photographed(tmp_path_factory.mktemp("r3dg"), capture, count=3, size=24)
    views = [TrainingView.of(photograph) for photograph in ls.io.load_photographs(folder).training]
    normals = capture.means / np.linalg.norm(capture.means, axis=1, keepdims=True)
    made = R3dgFit(capture, normals.astype(np.float64), views, "cpu", directions=12)
    rng, now = np.random.default_rng(3), made.parameters
    now.albedo += rng.normal(size=now.albedo.shape)
    now.roughness += 0.5 * rng.normal(size=now.roughness.shape)
    now.local += 0.1 * rng.normal(size=now.local.shape)
    return made


def their_highlight(normal: Array, view: Array, light: Array, roughness: float) -> float:
    """Their microfacet term, written out in float64."""
    half = (view + light) / np.linalg.norm(view + light)
    normal = normal if normal @ view > 0.0 else -normal
    n_v, n_l, n_h, v_h = (np.clip(a @ b, 1e-6, 1.0) for a, b in zip(
        (normal, normal, normal, view), (view, light, half, half), strict=True
    ))  # fmt: skip
    squared, k = roughness**4, (roughness**2 + 2.0 * roughness + 1.0) / 8.0
    fresnel = 0.04 + 0.96 * 2.0 ** ((-5.55473 * v_h - 6.98316) * v_h)
    below = 4.0 * np.pi * (n_h**2 * (squared - 1.0) + 1.0) ** 2 * (n_v * (1 - k) + k) * (n_l * (1 - k) + k)
    return float(fresnel * squared / np.clip(below, 1e-6, 4.0 * np.pi))


def test_gaussians_show_what_their_rendering_equation_says(fit: R3dgFit) -> None:
    """The mean over directions of (albedo / pi + highlight) (V sky + max(local, 0)) 2 pi cos, in float64."""
    shading: Any = fit._shading  # pyright: ignore[reportPrivateUsage]
    now, view = fit.parameters, fit._views[0]  # pyright: ignore[reportPrivateUsage]
    fit.differentiate(view)
    shown = 0.5 + 0.28209479177387814 * shading._shown.sh.numpy()
    means, normals = shading._materials.means.numpy(), shading._materials.normals.numpy()
    albedo, roughness = now.albedo_value, now.roughness_value
    sky = fit._lookups @ r3dg_light.softplus(now.sky)  # pyright: ignore[reportPrivateUsage]
    arriving = np.asarray(sky).reshape(shading.ways.shape)
    for i in range(0, len(means), 7):
        to_eye = view.camera.eye - means[i]
        to_eye /= np.linalg.norm(to_eye)
        local = np.maximum(sh_basis(shading.ways[i], 3) @ now.local[i], 0.0)
        total = np.zeros(3)
        for way, light in zip(shading.ways[i], arriving[i] + local, strict=True):
            reflected = albedo[i] / np.pi + their_highlight(normals[i], to_eye, way, roughness[i])
            total += 2.0 * np.pi / len(shading.ways[i]) * max(normals[i] @ way, 0.0) * reflected * light
        np.testing.assert_allclose(shown[i], total, rtol=2e-4, atol=1e-5)


def total_loss(fit: R3dgFit, view: TrainingView) -> float:
    """What is minimised, from its definition."""
    loss, _ = fit.differentiate(view)
    light = fit._shading.diffuse_light  # pyright: ignore[reportPrivateUsage]
    greyness = np.abs(light - light.mean(axis=1, keepdims=True)).mean()
    image = r3dg_light.softplus(fit.parameters.sky).reshape(16, 32, 3)
    variation = np.square(np.diff(image, axis=0)).mean() + np.square(np.diff(image, axis=1)).mean()
    return loss.total + GREY_LIGHT * greyness + EVEN_SKY * variation


@pytest.mark.parametrize("name", ["albedo", "roughness", "local", "sky"])
def test_derivatives_are_those_of_the_loss(fit: R3dgFit, name: str) -> None:
    """Along the derivative itself, by central differences."""
    view = fit._views[1]  # pyright: ignore[reportPrivateUsage]
    gradient = getattr(fit.differentiate(view)[1], name)
    way = gradient / np.linalg.norm(gradient)
    values, step = getattr(fit.parameters, name), {"local": 2e-3}.get(name, 2e-2)
    losses: list[float] = []
    for sign in (1.0, -1.0):
        setattr(fit.parameters, name, values + sign * step * way)
        losses.append(total_loss(fit, view))
    setattr(fit.parameters, name, values)
    assert (losses[0] - losses[1]) / (2.0 * step) == pytest.approx(np.linalg.norm(gradient), rel=0.02)


def test_their_map_and_their_directions() -> None:
    """Lookups are bilinear between corners that are poles and the seam; directions are above 10 degrees."""
    picture = np.random.default_rng(0).random((512, 3))
    ways = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    found = r3dg_light.Lookups.of(ways, np.ones(3, np.float32)).matrix @ picture
    image = picture.reshape(16, 32, 3)
    np.testing.assert_allclose(found[0], image[0, 15:17].mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found[1], image[15, 15:17].mean(axis=0), rtol=1e-6)
    np.testing.assert_allclose(found[2], image[7:9, 15:17].mean(axis=(0, 1)), rtol=1e-6)
    around = panorama_directions(8, 16).reshape(-1, 3)
    assert np.ptp(r3dg_light.Lookups.of(around, np.ones(128, np.float32)).matrix @ np.ones(512)) < 1e-6
    normals = around[::7]
    made = r3dg_light.hemispheres(normals, 64, np.random.default_rng(0))
    sines = np.einsum("nsc,nc->ns", made, normals)
    assert sines.min() == pytest.approx(np.sin(np.radians(10.0))) and sines.max() == pytest.approx(1.0)
    np.testing.assert_allclose(np.linalg.norm(made, axis=2), 1.0)
