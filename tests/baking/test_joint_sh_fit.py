"""Tests the joint SH fit of a bake against NumPy, and against the SH from which its rays were computed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.baking.joint_sh_fit import Blend, Pixels, hits_light, refitted_sh
from lumisplat.constants import SH_C0
from lumisplat.math.sh import sh_basis
from lumisplat.runtime.launcher import Launcher
from support.scenes.path_scenes import ball, diffuse

GAUSSIANS, RAYS, CONTRIBUTIONS_PER_RAY = 20, 3000, 3


def pixels(rng: np.random.Generator, colors: np.ndarray | None = None) -> Pixels:
    """Returns rays from random directions that each blend three Gaussians."""
    directions = rng.standard_normal((RAYS * CONTRIBUTIONS_PER_RAY, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return Pixels(
        colors=np.zeros((RAYS, 3)) if colors is None else colors,
        noise=0.0,
        ray=np.repeat(np.arange(RAYS), CONTRIBUTIONS_PER_RAY),
        gaussian=rng.integers(0, GAUSSIANS, RAYS * CONTRIBUTIONS_PER_RAY),
        weight=np.tile([0.5, 0.3, 0.2], RAYS),
        direction=directions.astype(np.float32),
    )


def test_sh_colours_blended_along_rays_match_numpy_and_gathering_is_the_transpose() -> None:
    """Rays show the weighted sum of their Gaussians' colours. For SH a and errors e, <blend(a), e> = <a, gather(e)>."""
    rng = np.random.default_rng(0)
    some = pixels(rng)
    sh, errors = rng.normal(0.0, 0.3, (GAUSSIANS, 16, 3)), rng.normal(size=(RAYS, 3))
    blend = Blend(some, GAUSSIANS, 16, Launcher("cpu"))
    colors = np.einsum("sk,skc->sc", sh_basis(some.direction.astype(np.float64), 3), sh[some.gaussian])
    expected = (
        (some.weight[:, None] * np.maximum(colors + 0.5, 0.0)).reshape(RAYS, CONTRIBUTIONS_PER_RAY, 3).sum(axis=1)
    )
    np.testing.assert_allclose(blend.pixel_colors(sh), expected, atol=1e-5)
    forward, back = (blend.blend(sh) * errors).sum(), (sh * blend.gather(errors)).sum()
    np.testing.assert_allclose(forward, back, rtol=1e-4)


def test_joint_sh_fit_recovers_the_true_sh_from_noiseless_rays() -> None:
    """The fit starts a tenth off; pixels are matched, and errors at least halve."""
    rng = np.random.default_rng(1)
    some = pixels(rng)
    truth = rng.normal(0.0, 0.05, (GAUSSIANS, 16, 3))
    blend = Blend(some, GAUSSIANS, 16, Launcher("cpu"))
    start = truth + rng.normal(0.0, 0.1, truth.shape)
    exact = Pixels(blend.pixel_colors(truth), 0.0, some.ray, some.gaussian, some.weight, some.direction)
    found = refitted_sh(blend, exact, start, np.zeros(GAUSSIANS))
    assert np.abs(found - truth).mean() < 0.5 * np.abs(start - truth).mean()
    assert (
        np.square(blend.pixel_colors(found) - exact.colors).mean()
        < 0.01 * np.square(blend.pixel_colors(start) - exact.colors).mean()
    )


def noisy(rng: np.random.Generator, truth: np.ndarray, rays: int) -> tuple[Blend, Pixels]:
    """Returns rays that each blend three Gaussians, with unreported noise of 0.1 on their colours."""
    some = pixels(rng)
    contributions = CONTRIBUTIONS_PER_RAY * rays
    some = replace(
        some,
        colors=some.colors[:rays],
        **{name: getattr(some, name)[:contributions] for name in ("ray", "gaussian", "weight", "direction")},
    )
    blend = Blend(some, GAUSSIANS, 16, Launcher("cpu"))
    return blend, replace(some, colors=blend.pixel_colors(truth) + rng.normal(0.0, 0.1, (rays, 3)))


def test_few_later_rays_do_not_override_many_earlier_rays_in_the_joint_sh_fit() -> None:
    """Gaussians at the border of a part are on few rays of the next part, which count by their number."""
    rng = np.random.default_rng(3)
    truth = rng.normal(0.0, 0.05, (GAUSSIANS, 16, 3))
    many, few = noisy(rng, truth, RAYS), noisy(rng, truth, RAYS // 20)
    first = refitted_sh(*many, np.zeros_like(truth), np.zeros(GAUSSIANS))
    then, overriding = (
        refitted_sh(*few, first, information) for information in (many[1].information(GAUSSIANS), np.zeros(GAUSSIANS))
    )
    off, off_then, off_overriding = (np.square(found - truth).mean() for found in (first, then, overriding))
    assert off_then < 1.05 * off
    assert off_overriding > 2.0 * off


LIGHTS = [
    ls.LightSphere((0.0, 2.0, 0.0), 0.5, intensity=3.0),
    ls.LightRect((0.0, 1.6, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 2.0), intensity=3.0),
    ls.LightDisk((0.0, 1.6, 0.0), (0.0, -1.0, 0.0), 1.0, intensity=3.0),
]
"""Lights above the scene; the flat ones shine downwards."""


@pytest.mark.parametrize("light", LIGHTS)
def test_light_visible_behind_a_gaussian_is_not_baked_into_it(
    light: ls.LightSphere | ls.LightRect | ls.LightDisk,
) -> None:
    """Rays past the edge of a Gaussian hit the light behind it; a black body stays black."""
    black = ls.SplatInstance(ls.gaussians_from_mesh(ball(1.0, diffuse(0.0), rows=16), 60), material=diffuse(0.0))
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=2, max_bounces=0)
    (shown,) = ls.bake(ls.Scene([black], lights=[light]), config, degree=0, device="cpu").splats
    np.testing.assert_allclose(shown.gaussians.sh, -0.5 / SH_C0, atol=1e-4)


def veil() -> ls.SplatInstance:
    """Returns an unlit capture of white glass above the ball."""
    white = ls.gaussians_from_mesh(ls.plane(4.0, 4.0, material=diffuse(1.0)), 60)
    return ls.SplatInstance(replace(white, opacities=np.full_like(white.opacities, 0.1)), position=(0.0, 1.6, 0.0))


@pytest.mark.parametrize("other", [veil(), ls.MeshInstance(ball(0.5, diffuse(0.0, 3.0), rows=8), position=(0, 2, 0))])
def test_colours_of_objects_that_are_not_baked_do_not_enter_gaussians_on_the_same_ray(
    other: ls.SplatInstance | ls.MeshInstance,
) -> None:
    """Rays hit a bright capture or mesh before or beside a Gaussian; a black body stays black."""
    black = ls.SplatInstance(ls.gaussians_from_mesh(ball(1.0, diffuse(0.0), rows=16), 60), material=diffuse(0.0))
    splats, meshes = ([black, other], []) if isinstance(other, ls.SplatInstance) else ([black], [other])
    light = ls.LightDirectional((0.0, -1.0, 0.0))
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=2, max_bounces=0)
    shown = ls.bake(ls.Scene(splats, meshes, [light]), config, degree=0, device="cpu").splats[0]
    np.testing.assert_allclose(shown.gaussians.sh, -0.5 / SH_C0, atol=1e-4)


def test_rays_of_a_bake_hit_lights_exactly_where_path_traced_frames_show_them() -> None:
    """Rays come from above, below and inside of a sphere; disabled or invisible lights are never hit."""
    rng = np.random.default_rng(2)
    origins = (rng.uniform(-1.0, 1.0, (4000, 3)) * (0.6, 2.0, 0.6) + (0.0, 2.0, 0.0)).astype(np.float32)
    directions = rng.standard_normal((4000, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=1)
    for light in LIGHTS:
        found = hits_light([light], origins, directions)
        shown = (
            ls.trace_rays(ls.Scene(lights=[light]), origins, directions, config, device="cpu").radiance.max(axis=1)
            > 0.0
        )
        assert 0.02 < shown.mean() < 0.6
        assert (found == shown).mean() > 0.999
        for unseen in (replace(light, visible=False), replace(light, enabled=False)):
            assert not hits_light([unseen], origins, directions).any()
