"""Sample rays of a bake compared with lit frames: sorting by peaks, segments, and division by reflected colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.baking import joint_sh_fit
from lumisplat.baking.joint_sh_fit import HitGaussians, JointShFit, Pixels, reflected_colors, wanted_segments
from lumisplat.baking.sample_rays import SampleRays
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb, encode_srgb
from support.scenes.path_scenes import ball, diffuse

MATTE = ls.MaterialPbr(metallic=0.0, roughness=1.0, specular=0.0)
DIRECT = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=4, max_bounces=0)
TRACE = replace(DIRECT, pipeline=ls.Pipeline.TRACE)
SKY = ls.LightEnvironment(color=(0.5, 0.5, 0.5), visible=False)


def patched_ball(*, shines: bool) -> ls.SplatInstance:
    """Returns a small ball, half white and half dark, by albedo, or by captured emission beside a uniform albedo."""
    gaussians = ls.gaussians_from_mesh(ball(1.0, diffuse(1.0), rows=16), 100)
    colors = np.where(gaussians.means[:, 1:2] < -0.1, (0.4, 0.02, 0.01), (0.8, 0.8, 0.8)).astype(np.float32)
    if not shines:
        return ls.SplatInstance(replace(gaussians, albedo=colors), material=MATTE)
    sh = ((encode_srgb(colors) - 0.5) / SH_C0)[:, None].astype(np.float32)
    even = np.full_like(colors, 0.5)
    return ls.SplatInstance(replace(gaussians, sh=sh, albedo=even), material=replace(MATTE, emissive=(0.2, 0.2, 0.2)))


def pixels_of(scene: ls.Scene, config: ls.RenderConfig, monkeypatch: pytest.MonkeyPatch) -> Pixels:
    """Returns the pixels of the sample rays of a bake."""
    found: list[Pixels] = []
    pixels = JointShFit.pixels

    def noted(self: JointShFit, rays: SampleRays, count: int) -> Pixels:
        found.append(pixels(self, rays, count))
        return found[-1]

    monkeypatch.setattr(JointShFit, "pixels", noted)
    ls.bake(scene, config, degree=0, directions=8, device="cpu")
    return found[0]


@pytest.mark.parametrize("shines", [False, True])
def test_colours_that_a_bake_samples_at_colour_edges_match_rendered_frames(
    shines: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Path tracing hits a white or a dark Gaussian at random; the mean is compared with a blend of sorted hits.

    If hits were sorted by means of Gaussians, as viewers do, rays across edges would be some hundredths too bright.
    With the albedo of Gaussians that emit captured colours, edges would keep their noise.
    """
    scene = ls.Scene([patched_ball(shines=shines)], lights=[SKY])
    shown = pixels_of(scene, DIRECT, monkeypatch)
    monkeypatch.setattr(joint_sh_fit, "denoised_by_rays", lambda halves, found, *_: halves / np.maximum(found, 1e-12))
    truth = pixels_of(scene, replace(DIRECT, samples=48), monkeypatch)
    green = reflected_colors(scene.splats[0])[:, 1]
    total = np.bincount(truth.ray, truth.weight)
    mean = np.bincount(truth.ray, truth.weight * green[truth.gaussian]) / total
    spread = np.bincount(truth.ray, truth.weight * np.abs(green[truth.gaussian] - mean[truth.ray])) / total
    across = spread > 0.2 * green.max()
    assert across.sum() > 50
    errors = (shown.colors - truth.colors)[across, 1]
    # Within three standard errors of the mean, and no noisier than with this seed (0.042 and 0.044). With the albedo of
    # emissive Gaussians, values are 0.007 and 0.065; without denoising, the noise is 0.13 and 0.14.
    assert abs(errors.mean()) < 3.0 * errors.std() / np.sqrt(errors.size)
    assert np.sqrt(np.square(errors).mean()) < 0.046


def test_ray_segment_of_baked_gaussians_ends_half_way_to_neighbours_that_are_not_baked() -> None:
    """The segment is around the Gaussian of largest weight, and ends before a mesh just behind the last Gaussian."""
    wanted = np.array([0, 1, 1, 0, 1, 1, 1, 0, 0], np.bool_)
    hits = HitGaussians(
        ray=np.array([0, 0, 0, 0, 0, 1, 1, 2, 3]),
        gaussian=np.arange(9),
        weight=np.array([0.01, 0.5, 0.4, 0.01, 0.01, 0.6, 0.3, 0.5, 0.2]),
        t=np.array([1.0, 2.0, 3.0, 5.0, 6.0, 2.0, 4.0, 1.0, 1.0]),
        rays=5,
    )
    begin, end, within = wanted_segments(hits, wanted, np.array([0, 1, 0, 0, 0], np.bool_))
    np.testing.assert_array_equal(within, [0, 1, 1, 0, 0, 1, 1, 0, 0])
    np.testing.assert_allclose(begin, [1.5, 0.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(end, [4.0, 4.0, 0.0, 0.0, 0.0], rtol=2e-4)
    assert end[1] > 4.0


LIGHT = ls.MeshInstance(ball(0.7, diffuse(0.0, 30.0), rows=8), position=(0.0, -1.0, 0.0))
"""Emissive mesh below the sheet."""


def veil() -> ls.SplatInstance:
    """Returns an unlit capture of white glass above the sheet."""
    white = ls.gaussians_from_mesh(ls.plane(0.6, 0.6, material=diffuse(1.0)), 60)
    return ls.SplatInstance(replace(white, opacities=np.full_like(white.opacities, 0.1)), position=(0.0, 1.6, 0.0))


@pytest.mark.parametrize("other", [veil(), LIGHT])
def test_light_sampled_for_a_bake_excludes_captures_and_meshes_that_are_not_baked(
    other: ls.SplatInstance | ls.MeshInstance, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sheet in the sun follows Lambert's law on all rays, also past a white veil and before an emissive mesh.

    Veil and mesh cover less than a hundredth of a ray, but would add as much light as the sheet and more.
    """
    sheet = ls.SplatInstance(ls.gaussians_from_mesh(ls.plane(2.0, 2.0), 150), material=MATTE)
    sheet = replace(sheet, gaussians=replace(sheet.gaussians, albedo=np.full((sheet.gaussians.count, 3), 0.8)))
    splats, meshes = ([sheet, other], []) if isinstance(other, ls.SplatInstance) else ([sheet], [other])
    sun = ls.LightDirectional((1.0, -1.0, 0.0), intensity=0.5)  # the shadow of the veil is beside the sheet
    shown = pixels_of(ls.Scene(splats, meshes, [sun]), TRACE, monkeypatch)
    coverage = np.bincount(shown.ray, shown.weight)
    colors = (shown.colors / coverage[:, None])[coverage > 0.5]
    assert len(colors) > 500
    np.testing.assert_allclose(colors, encode_srgb(0.8 / np.pi * 0.5 * np.sqrt(0.5)), atol=2e-3)


def test_reflected_colour_in_a_bake_is_albedo_plus_white_specular_reflection() -> None:
    """Reflected colours are the albedo, or captured colours of an emissive capture, plus white specular reflection."""
    captured, albedo = np.array([0.2, 0.4, 0.6]), np.array([0.5, 0.3, 0.0])
    gaussians = ls.gaussians_from_mesh(ls.plane(1.0, 1.0), 4)
    sh = np.broadcast_to((captured - 0.5) / SH_C0, (gaussians.count, 1, 3)).astype(np.float32)
    whole = replace(
        gaussians, sh=sh, albedo=np.broadcast_to(albedo, (gaussians.count, 3)).astype(np.float32), metallic=None
    )

    def of(material: ls.MaterialPbr | ls.MaterialSimple, some: ls.Gaussians = whole) -> np.ndarray:
        return reflected_colors(ls.SplatInstance(some, material=material))[0]

    linear = decode_srgb(captured)
    np.testing.assert_allclose(of(MATTE), albedo, rtol=1e-6)
    np.testing.assert_allclose(of(replace(MATTE, emissive=(0.1, 0.1, 0.1))), linear, rtol=1e-5)
    np.testing.assert_allclose(of(MATTE, replace(whole, albedo=None)), linear, rtol=1e-5)
    np.testing.assert_allclose(of(ls.MaterialPbr(ior=1.5)), 0.04 + 0.96 * albedo, rtol=1e-6)
    np.testing.assert_allclose(of(ls.MaterialPbr(metallic=1.0)), albedo, rtol=1e-6)
    metal = replace(whole, metallic=np.ones(whole.count, np.float32))
    np.testing.assert_allclose(of(ls.MaterialPbr(), metal), albedo, rtol=1e-6)
    simple = ls.MaterialSimple(emissive=(0.0, 0.0, 0.0), diffuse=(0.5, 0.5, 0.5), specular=(0.1, 0.1, 0.1))
    np.testing.assert_allclose(of(simple), 0.1 + 0.5 * albedo, rtol=1e-6)
