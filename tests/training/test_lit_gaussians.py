"""Single Gaussians are shaded by incident radiance, and gradients of their radiance are exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import warp as wp

from lumisplat.device.structs.gradients import SplatGradient
from lumisplat.device.structs.raster import TileRect
from lumisplat.math.color import encode_srgb
from lumisplat.math.sh import even_directions
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.runtime.struct_tables import table_dtype
from lumisplat.training.lit_gaussians import IncidentRadiance, LitGaussians, Materials
from support.oracles.bsdf_oracle import evaluate
from support.oracles.lit_gaussian_oracle import Lit, lit_view, radiance
from support.scenes.sphere import sphere_quadrature, unit

COUNT, DIRECTIONS = 150, 48
EYE = np.array([0.3, -0.4, 9.0])


def some(seed: int = 0, directions: int = DIRECTIONS, brightest: float = 0.4) -> Lit:
    """Returns random materials and light; all but a few Gaussians face the eye."""
    rng = np.random.default_rng(seed)
    normals = unit(seed + 1, COUNT)
    normals[:-20, 2] = np.abs(normals[:-20, 2]) + 0.5
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Lit(
        means=rng.uniform(-1.0, 1.0, (COUNT, 3)),
        normals=normals,
        albedo=rng.uniform(0.05, 0.9, (COUNT, 3)),
        roughness=rng.uniform(0.3, 1.0, COUNT),
        metallic=0.0,
        directions=even_directions(directions),
        environment=rng.uniform(0.0, brightest, (directions, 3)),
        open=rng.uniform(size=(COUNT, directions)),
        seen=rng.uniform(0.0, 0.1, (COUNT, directions, 3)),
        spread=0.09 * 4.0 * np.pi / directions,
    )


class Shown:
    """Shaded Gaussians on the device."""

    def __init__(self, lit: Lit) -> None:
        self.launcher = Launcher("cpu", 2)
        self.buffers = Buffers(self.launcher.device)
        incident = IncidentRadiance(lit.directions, lit.open.astype(np.float32), lit.seen.astype(np.float32))
        self.gaussians = LitGaussians(self.launcher, self.buffers, lit.means, incident, metal=lit.metallic == 1.0)
        self.sh = self.buffers.get("test.sh", wp.vec3, len(lit.means))
        self.gaussians.shade(Materials(lit.albedo, lit.roughness, lit.normals, lit.environment), EYE, self.sh)

    def by_radiance(self, given: np.ndarray) -> Materials:
        """Returns the gradient with respect to materials, given that with respect to display-referred colours."""
        rects, splats = (np.zeros(len(given), table_dtype(struct)) for struct in (TileRect, SplatGradient))
        rects["x1"], rects["y1"], splats["color"] = 1, 1, given
        arrays: list[Any] = [
            wp.array(table, dtype=struct, device="cpu")
            for table, struct in ((rects, TileRect), (splats, SplatGradient))
        ]
        self.gaussians.decode(*arrays)
        return self.gaussians.differentiate()


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_radiance_of_shaded_gaussians_matches_float64(metallic: float) -> None:
    """Display-referred colours are clipped at white."""
    lit = replace(some(brightest=4.0), metallic=metallic)
    shown, expected = Shown(lit), radiance(lit, EYE)
    np.testing.assert_allclose(shown.gaussians.radiance, expected, rtol=2e-4, atol=1e-6)
    color = np.asarray(shown.sh.numpy()) * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(color, encode_srgb(np.minimum(expected, 1.0)), atol=1e-4)
    assert (expected > 1.0).any() and (expected < 1.0).any()


def test_gaussian_viewed_from_below_its_plane_shows_what_the_mirrored_eye_would_see() -> None:
    """The radiance equals the radiance seen from the eye's mirror image above the Gaussian's plane."""
    lit = some(2)
    directions = EYE - lit.means
    heights = (directions * lit.normals).sum(axis=1, keepdims=True)
    assert (heights < -1.0).any()
    above = replace(lit, means=lit.means + 2.0 * np.minimum(heights, 0.0) * lit.normals)
    np.testing.assert_allclose(Shown(lit).gaussians.radiance, Shown(above).gaussians.radiance, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_shading_summed_over_directions_converges_to_the_hemisphere_integral(metallic: float) -> None:
    """The reference integrates `pbr_eval` under a smooth environment."""
    lit = replace(some(directions=1024), seen=np.zeros((COUNT, 1024, 3)), open=np.ones((COUNT, 1024)))

    def environment(directions: np.ndarray) -> np.ndarray:
        return (1.0 + 0.5 * directions[:, :1] + 0.3 * directions[:, 1:2] * directions[:, 2:]) * (0.3, 0.4, 0.5)

    lit = replace(
        lit, metallic=metallic, environment=environment(lit.directions), roughness=np.maximum(lit.roughness, 0.5)
    )
    found = Shown(lit).gaussians.radiance
    directions, weights = sphere_quadrature(120)
    for i in range(0, 40, 4):
        view = lit_view(lit.normals[i], EYE - lit.means[i])
        metal = lit.metallic
        material = {"model": "pbr", "diffuse": (1.0 - metal) * lit.albedo[i], "grazing": 1.0}
        material |= {"specular": 0.04 * (1.0 - metal) + metal * lit.albedo[i]}
        material |= {"dielectric": 1.0, "eta": 1.0 / 1.5, "alpha": lit.roughness[i] ** 2}
        normals, views = (np.broadcast_to(one, directions.shape) for one in (lit.normals[i], view))
        reflected = evaluate(material, normals, views, directions) * (directions @ lit.normals[i])[:, None]
        expected = (
            weights[:, None]
            * np.where((directions @ lit.normals[i] > 0.0)[:, None], reflected, 0.0)
            * environment(directions)
        ).sum(axis=0)
        np.testing.assert_allclose(found[i], expected, rtol=0.01)


def slope(of: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """Returns central differences."""
    return (of(step) - of(-step)) / (2.0 * step)


def encoded_slope(linear: np.ndarray) -> np.ndarray:
    """Returns the derivative of the sRGB encoding."""
    return slope(lambda h: encode_srgb(linear + h), 1e-6)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("name", ["albedo", "roughness", "environment"])
def test_gradients_of_shading_for_materials_match_central_differences(name: str, metallic: float) -> None:
    """The reference is float64, along random directions in the space of parameters."""
    lit, rng = replace(some(3), metallic=metallic), np.random.default_rng(4)
    given = rng.normal(size=(COUNT, 3))
    found = getattr(Shown(lit).by_radiance(given), name)
    linear = given * encoded_slope(radiance(lit, EYE))
    values = getattr(lit, name)

    def changed(step: np.ndarray, h: float) -> np.ndarray:
        return (linear * radiance(replace(lit, **{name: values + h * step}), EYE)).sum(axis=1)

    steps = rng.normal(size=(3, *values.shape))
    if name == "environment":
        for step in steps:
            expected = slope(partial(changed, step), 1e-5).sum()
            assert (found * step).sum() == pytest.approx(expected, rel=1e-3, abs=1e-4)
    else:
        for step in steps:
            expected = slope(partial(changed, step), 1e-5)
            change = (found * step).reshape(COUNT, -1).sum(axis=1)
            np.testing.assert_allclose(change, expected, rtol=2e-3, atol=5e-4)


def test_gradients_of_shading_for_normals_match_central_differences() -> None:
    """Gradients are compared along tangents, for Gaussians that face the eye."""
    lit, rng = some(5), np.random.default_rng(6)
    given = rng.normal(size=(COUNT, 3))
    found = Shown(lit).by_radiance(given).normals
    linear = given * encoded_slope(radiance(lit, EYE))
    tangents = np.cross(lit.normals, unit(7, COUNT))

    def changed(h: float) -> np.ndarray:
        normals = lit.normals + h * tangents
        return (
            linear * radiance(replace(lit, normals=normals / np.linalg.norm(normals, axis=1, keepdims=True)), EYE)
        ).sum(1)

    expected = slope(changed, 1e-5)
    faces = np.einsum("ij,ij->i", EYE - lit.means, lit.normals) > 0.2 * np.linalg.norm(EYE - lit.means, axis=1)
    assert faces.sum() > 100
    np.testing.assert_allclose((found * tangents).sum(axis=1)[faces], expected[faces], rtol=5e-3, atol=5e-4)


def test_gaussians_shaded_brighter_than_white_get_no_gradients_that_brighten_them() -> None:
    """A gradient that would brighten clipped Gaussians is 0."""
    lit = replace(some(8), environment=np.full((DIRECTIONS, 3), 9.0), open=np.ones((COUNT, DIRECTIONS)))
    shown = Shown(lit)
    bright = shown.gaussians.radiance.min(axis=1) > 1.0
    assert bright.sum() > 50
    assert (shown.by_radiance(-np.ones((COUNT, 3))).albedo[bright] == 0.0).all()
    assert (shown.by_radiance(np.ones((COUNT, 3))).albedo[bright] > 0.0).all()
