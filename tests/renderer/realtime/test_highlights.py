"""Lights in highlights of real-time frames: samples by light and by highlight, their choice, and pixel footprints."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.scene.lights import Light
from support.probes.probe_highlight_kernels import probe_facets
from support.scenes.light_scenes import metal, parallelogram
from support.scenes.path_scenes import diffuse, paths, quad

DOWN = ls.Camera.look_at((0, 0.5, 0), (0, 0, 0), (0, 0, -1), width=24, height=16, fov_y=0.02)
"""Looks straight down; the highlight of a horizontal plate lies straight above."""

SHAPES: dict[str, tuple[list[ls.Mesh], list[Light]]] = {
    "rect": ([], [ls.LightRect((0.0, 1.0, 0.0), (2, 0, 0), (0, 0, 2), intensity=1.0)]),
    "disk": ([], [ls.LightDisk((0.0, 1.0, 0.0), (0, -1, 0), 1.0, intensity=1.0)]),
    "sphere": ([], [ls.LightSphere((0.0, 2.0, 0.0), 1.0, intensity=1.0)]),
    "spot": ([], [ls.LightSpot((0, 2, 0), (0, -1, 0), intensity=np.pi, inner_angle=1.0, outer_angle=1.2, radius=1.0)]),
    "sun": ([], [ls.LightDirectional((0.0, -1.0, 0.0), intensity=np.pi * np.sin(0.5) ** 2, angle=0.5)]),
    "mesh": ([quad((-1.0, 1.0, -1.0), (2, 0, 0), (0, 0, 2), diffuse(0.5, 1.0))], []),
    "two": (
        [],
        [
            ls.LightRect((-0.5, 1.0, 0.0), (1, 0, 0), (0, 0, 2), intensity=1.0),
            ls.LightRect((0.5, 1.0, 0.0), (1, 0, 0), (0, 0, 2), intensity=1.0),
        ],
    ),
}
"""Lights of radiance 1 that cover the highlight."""


def plate(roughness: float) -> ls.Mesh:
    """Returns a horizontal plate of white metal, which reflects all light."""
    return parallelogram((-2, 0, -2), (0, 0, 4), (4, 0, 0), metal(roughness))


def glossy(scene: ls.Scene, frames: int, camera: ls.Camera = DOWN) -> np.ndarray:
    """Returns direct light in highlights, not averaged over pixels: the mean over frames of each, shape (H, W)."""
    settings = ls.config.RealtimeConfig(filter=ls.config.FilterConfig(passes=0, frames=frames), antialiasing=False)
    config = ls.RenderConfig(
        pipeline=ls.Pipeline.REALTIME,
        max_bounces=0,
        realtime=settings,
        aovs=("direct_glossy",),
        shadows=ls.Shadows.SOFT,
    )
    renderer = ls.create_renderer(config, device="cpu")
    *_, frame = (renderer.render(scene, camera) for _ in range(frames))
    return np.asarray(frame.direct_glossy, np.float64)[..., 1]


@pytest.mark.parametrize("name", SHAPES)
def test_light_that_fills_a_narrow_highlight_shows_its_radiance_without_fireflies(name: str) -> None:
    """The light covers a hundred times the solid angle of the highlight, which samples of it alone would rarely hit."""
    meshes, lights = SHAPES[name]
    found = glossy(ls.Scene((), [plate(0.1), *meshes], lights), 16)
    assert found.mean() == pytest.approx(1.0, abs=0.02)
    assert found.std() < (0.4 if name == "two" else 0.1)


@pytest.mark.parametrize("roughness", [0.1, 0.3, 0.6])
@pytest.mark.parametrize("kind", ["rect", "mesh"])
def test_light_beside_the_centre_of_a_highlight_reflects_half_of_it(kind: str, roughness: float) -> None:
    """Light and highlight sample the half of the highlight that the light covers, with weights that add up to one."""
    for side in (-1.0, 1.0):
        rect = ls.LightRect((20.0 * side, 1.0, 0.0), (40, 0, 0), (0, 0, 80), intensity=1.0)
        panel = quad((20.0 * side - 20.0, 1.0, -40.0), (40, 0, 0), (0, 0, 80), diffuse(0.5, 1.0))
        lit = ([panel], []) if kind == "mesh" else ([], [rect])
        scene = ls.Scene((), [plate(roughness), *lit[0]], lit[1])
        layer = paths(scene, DOWN, 256, 1, aovs=("direct_glossy",)).direct_glossy
        truth = np.asarray(layer)[..., 1].mean()
        assert truth == pytest.approx(0.5, abs=0.1)
        assert glossy(scene, 64).mean() == pytest.approx(truth, rel=0.03)


@pytest.mark.parametrize("alpha", [0.0025, 0.04, 0.3])
@pytest.mark.parametrize("footprint", [1e-6, 1e-4, 1e-2])
def test_microfacets_of_a_pixel_are_normalized_and_near_the_mean_over_its_normals(
    alpha: float, footprint: float
) -> None:
    """In the space of slopes, D is compared with a convolution of GGX and a Gaussian of the footprint's variance."""
    radii = np.geomspace(1e-5, 1e3, 4000)
    halves = np.stack([radii, 0.0 * radii, np.ones_like(radii)], axis=1) / np.hypot(radii, 1.0)[:, None]
    values = wp.zeros(len(radii), dtype=float)
    inputs = alpha, footprint, wp.array(halves.astype(np.float32), dtype=wp.vec3)
    wp.launch(probe_facets, len(radii), inputs, [values])
    density = values.numpy().astype(np.float64) / np.hypot(radii, 1.0) ** 4
    assert np.trapezoid(density * 2.0 * np.pi * radii, radii) == pytest.approx(1.0, rel=2e-3)
    rng = np.random.default_rng(1)
    offsets = np.sqrt(0.5 * footprint) * rng.normal(size=(200_000, 2))
    for slope in np.sqrt(alpha**2 + footprint) * np.array([0.0, 0.5, 1.0, 3.0]):
        squares = (offsets[:, 0] - slope) ** 2 + offsets[:, 1] ** 2
        mean = np.mean(alpha**2 / (np.pi * (alpha**2 + squares) ** 2))
        found = np.interp(slope, radii, density)
        assert found == pytest.approx(mean, rel=0.5, abs=0.03 / (alpha**2 + footprint))
