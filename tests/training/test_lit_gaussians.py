"""Gaussians that reflect light each by itself, and the derivatives of what they show."""

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
    """Materials, all but a few of which face the eye, under any light."""
    rng = np.random.default_rng(seed)
    normals = unit(seed + 1, COUNT)
    normals[:-20, 2] = np.abs(normals[:-20, 2]) + 0.5
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Lit(
        means=rng.uniform(-1.0, 1.0, (COUNT, 3)),
        normals=normals,
        albedo=rng.uniform(0.05, 0.9, (COUNT, 3)),
        roughness=rng.uniform(0.3, 1.0, COUNT),
        directions=even_directions(directions),
        sky=rng.uniform(0.0, brightest, (directions, 3)),
        open=rng.uniform(size=(COUNT, directions)),
        seen=rng.uniform(0.0, 0.1, (COUNT, directions, 3)),
        spread=0.09 * 4.0 * np.pi / directions,
    )


class Shown:
    """The same on the device."""

    def __init__(self, lit: Lit) -> None:
        self.launcher = Launcher("cpu", 2)
        self.buffers = Buffers(self.launcher.device)
        incident = IncidentRadiance(lit.directions, lit.open.astype(np.float32), lit.seen.astype(np.float32))
        self.gaussians = LitGaussians(self.launcher, self.buffers, lit.means, incident)
        self.sh = self.buffers.get("test.sh", wp.vec3, len(lit.means))
        self.gaussians.shade(Materials(lit.albedo, lit.roughness, lit.normals, lit.sky), EYE, self.sh)

    def by_radiance(self, given: np.ndarray) -> Materials:
        """Derivatives by materials, given those by display-referred colours."""
        rects, splats = (np.zeros(len(given), table_dtype(struct)) for struct in (TileRect, SplatGradient))
        rects["x1"], rects["y1"], splats["color"] = 1, 1, given
        arrays: list[Any] = [
            wp.array(table, dtype=struct, device="cpu")
            for table, struct in ((rects, TileRect), (splats, SplatGradient))
        ]
        self.gaussians.decode(*arrays)
        return self.gaussians.differentiate()


def test_radiance_is_that_of_the_books() -> None:
    """Against the float64 statement; display-referred, it is at most white."""
    lit = some(brightest=4.0)
    shown, expected = Shown(lit), radiance(lit, EYE)
    np.testing.assert_allclose(shown.gaussians.radiance, expected, rtol=2e-4, atol=1e-6)
    color = np.asarray(shown.sh.numpy()) * 0.28209479177387814 + 0.5
    np.testing.assert_allclose(color, encode_srgb(np.minimum(expected, 1.0)), atol=1e-4)
    assert (expected > 1.0).any() and (expected < 1.0).any()


def test_from_below_it_shows_what_a_mirror_there_would_show() -> None:
    """As frames have it of normals up to 30 degrees beyond the horizon: to an eye as far above, each shows the same."""
    lit = some(2)
    ways = EYE - lit.means
    heights = (ways * lit.normals).sum(axis=1, keepdims=True)
    assert (heights < -1.0).any()
    above = replace(lit, means=lit.means + 2.0 * np.minimum(heights, 0.0) * lit.normals)
    np.testing.assert_allclose(Shown(lit).gaussians.radiance, Shown(above).gaussians.radiance, rtol=1e-4, atol=1e-6)


def test_directions_are_a_quadrature_of_the_material() -> None:
    """Of what `pbr_eval` reflects of a smooth sky, over the hemisphere."""
    lit = replace(some(directions=1024), seen=np.zeros((COUNT, 1024, 3)), open=np.ones((COUNT, 1024)))
    sky = lambda ways: (1.0 + 0.5 * ways[:, :1] + 0.3 * ways[:, 1:2] * ways[:, 2:]) * (0.3, 0.4, 0.5)  # noqa: E731
    lit = replace(lit, sky=sky(lit.directions), roughness=np.maximum(lit.roughness, 0.5))
    found = Shown(lit).gaussians.radiance
    ways, weights = sphere_quadrature(120)
    for i in range(0, 40, 4):
        view = lit_view(lit.normals[i], EYE - lit.means[i])
        material = {"model": "pbr", "diffuse": lit.albedo[i], "specular": [0.04] * 3, "grazing": 1.0}
        material |= {"dielectric": 1.0, "eta": 1.0 / 1.5, "alpha": lit.roughness[i] ** 2}
        normals, views = (np.broadcast_to(one, ways.shape) for one in (lit.normals[i], view))
        reflected = evaluate(material, normals, views, ways) * (ways @ lit.normals[i])[:, None]
        expected = (
            weights[:, None] * np.where((ways @ lit.normals[i] > 0.0)[:, None], reflected, 0.0) * sky(ways)
        ).sum(axis=0)
        np.testing.assert_allclose(found[i], expected, rtol=0.01)


def slope(of: Callable[[float], np.ndarray], step: float) -> np.ndarray:
    """Central differences."""
    return (of(step) - of(-step)) / (2.0 * step)


def encoded_slope(linear: np.ndarray) -> np.ndarray:
    """Derivative of the encoding."""
    return slope(lambda h: encode_srgb(linear + h), 1e-6)


@pytest.mark.parametrize("name", ["albedo", "roughness", "sky"])
def test_derivatives(name: str) -> None:
    """Against central differences of the float64 statement, in a random direction of all of it."""
    lit, rng = some(3), np.random.default_rng(4)
    given = rng.normal(size=(COUNT, 3))
    found = getattr(Shown(lit).by_radiance(given), "environment" if name == "sky" else name)
    linear = given * encoded_slope(radiance(lit, EYE))
    values = getattr(lit, name)

    def changed(way: np.ndarray, h: float) -> np.ndarray:
        return (linear * radiance(replace(lit, **{name: values + h * way}), EYE)).sum(axis=1)

    ways = rng.normal(size=(3, *values.shape))
    if name == "sky":
        for way in ways:
            expected = slope(partial(changed, way), 1e-5).sum()
            assert (found * way).sum() == pytest.approx(expected, rel=1e-3, abs=1e-4)
    else:
        for way in ways:
            expected = slope(partial(changed, way), 1e-5)
            change = (found * way).reshape(COUNT, -1).sum(axis=1)
            np.testing.assert_allclose(change, expected, rtol=2e-3, atol=5e-4)


def test_derivatives_by_normals_of_what_faces_the_eye() -> None:
    """Along tangents, where the view is not mirrored, and no direction crosses the horizon."""
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


def test_white_hears_only_that_it_should_be_darker() -> None:
    """A Gaussian above white is as good as one that is white; Gaussians that were not drawn hear nothing."""
    lit = replace(some(8), sky=np.full((DIRECTIONS, 3), 9.0), open=np.ones((COUNT, DIRECTIONS)))
    shown = Shown(lit)
    bright = shown.gaussians.radiance.min(axis=1) > 1.0
    assert bright.sum() > 50
    assert (shown.by_radiance(-np.ones((COUNT, 3))).albedo[bright] == 0.0).all()
    assert (shown.by_radiance(np.ones((COUNT, 3))).albedo[bright] > 0.0).all()
