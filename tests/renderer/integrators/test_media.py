"""Light inside meshes: absorption, thin walls, and nested media, compared with closed forms."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import encode_srgb
from support.scenes.media_scenes import AHEAD, CLEAR, TRACED, color, slab
from support.scenes.path_scenes import ball, quad

LIT, GREY, BLUE, DARK = (
    ls.MaterialPbr(base_color=(0.0, 0.0, 0.0), specular=0.0, emissive=emissive)
    for emissive in ((1.0, 1.0, 1.0), (0.5, 0.5, 0.5), (0.0, 0.25, 1.0), (0.0, 0.0, 0.0))
)
ENVIRONMENT = ls.LightEnvironment(color=(1.0, 1.0, 1.0))


def reflectance(before: float, behind: float) -> float:
    """Returns the Fresnel reflectance at normal incidence between two media."""
    return ((before - behind) / (before + behind)) ** 2


@TRACED
@pytest.mark.parametrize("behind", ["sky", "mesh"])
def test_transmittance_of_a_glass_slab_follows_beers_law(pipeline: ls.Pipeline, behind: str) -> None:
    """Transmittance is colour^(thickness / distance), for light of an environment or an emitter."""
    inside = replace(CLEAR, attenuation_color=(0.2, 0.5, 1.0), attenuation_distance=0.7)
    if behind == "sky":
        scene = ls.Scene(meshes=[slab(0.0, 1.0, inside)], lights=[ENVIRONMENT])
        truth = np.array([0.2, 0.5, 1.0]) ** (1.0 / 0.7)
    else:
        light = quad((-9, -9, 0.4), (18, 0, 0), (0, 18, 0), GREY)
        scene = ls.Scene(meshes=[slab(0.0, 1.0, inside), light])
        truth = 0.5 * np.array([0.2, 0.5, 1.0]) ** (0.4 / 0.7)
    np.testing.assert_allclose(color(scene, pipeline, 4), truth, rtol=2e-5)


def test_absorption_in_unlit_frames_multiplies_display_encoded_colours() -> None:
    """The transmittance is sRGB-encoded before it multiplies displayed colours, as tints are."""
    inside = replace(CLEAR, attenuation_color=(0.2, 0.5, 1.0), attenuation_distance=1.0)
    settings = ls.RenderConfig(pipeline=ls.Pipeline.TRACE, background=(0.5, 0.5, 0.5), lighting=False)
    frame = ls.render(ls.Scene(meshes=[slab(0.0, 1.0, inside)]), AHEAD, settings, device="cpu")
    truth = 0.5 * encode_srgb(np.array([0.2, 0.5, 1.0]))
    np.testing.assert_allclose(frame.color[4, 8], truth, atol=1e-5)


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
@pytest.mark.parametrize("place", ["beyond", "within"])
def test_shadow_rays_through_absorbing_glass_are_tinted_by_its_transmittance(pipeline: ls.Pipeline, place: str) -> None:
    """The light is behind the glass or inside it."""
    inside = replace(CLEAR, attenuation_color=(0.2, 0.5, 1.0), attenuation_distance=1.0)
    floor = quad((-9, -9, 0.0), (0, 18, 0), (18, 0, 0), ls.MaterialPbr(roughness=1.0, specular=0.0))
    light = ls.LightPoint((0.0, 0.0, -6.0 if place == "beyond" else -4.5), intensity=50.0)
    glass = slab(-5.0, -4.0, inside)
    without, within = (
        color(ls.Scene(meshes=meshes, lights=[light]), pipeline, 1, max_bounces=0)
        for meshes in ([floor], [floor, glass])
    )
    backend = 1.0 if place == "beyond" else 0.5
    np.testing.assert_allclose(within / without, np.array([0.2, 0.5, 1.0]) ** backend, rtol=1e-3)


@TRACED
def test_thin_walled_pane_reflects_once_and_does_not_refract(pipeline: ls.Pipeline) -> None:
    """One pane reflects like one surface, and transmits the tinted rest straight, for any index of refraction."""
    pane = ls.MaterialPbr(base_color=(0.9, 0.6, 0.3), roughness=0.0, transmission=1.0, ior=1.8, thin_walled=True)
    meshes = [
        quad((-9, -9, 0.0), (18, 0, 0), (0, 18, 0), pane),
        quad((-9, -9, 1.0), (18, 0, 0), (0, 18, 0), GREY),
        quad((-9, -9, -4.0), (18, 0, 0), (0, 18, 0), BLUE),
    ]
    mirrored = reflectance(1.0, 1.8)
    truth = mirrored * np.array([0.0, 0.25, 1.0]) + (1.0 - mirrored) * 0.5 * np.array([0.9, 0.6, 0.3])
    found = color(ls.Scene(meshes=meshes), pipeline, 256 if pipeline is ls.Pipeline.PATH else 1)
    np.testing.assert_allclose(found, truth, rtol=0.01 if pipeline is ls.Pipeline.PATH else 1e-4)


@TRACED
def test_thin_walled_pane_does_not_shift_objects_behind_it(pipeline: ls.Pipeline) -> None:
    """An edge seen at an angle stays in place behind the pane."""
    halves = [
        quad((-9, -9, 2.0), (9, 0, 0), (0, 18, 0), LIT),
        quad((0, -9, 2.0), (9, 0, 0), (0, 18, 0), DARK),
    ]
    thin = replace(CLEAR, ior=1.5, specular=0.0, thin_walled=True)
    view = ls.Camera.look_at((2.0, 0, -2.0), (0.0, 0, 2.0), width=32, height=4, fov_y=0.05)
    settings = ls.RenderConfig(pipeline=pipeline, samples=1, lighting=True, jitter=False)
    shown = [
        ls.render(ls.Scene(meshes=meshes), view, settings, device="cpu").color
        for meshes in (halves, [*halves, quad((-9, -9, 0.0), (18, 0, 0), (0, 18, 0), thin)])
    ]
    assert 0.2 < shown[0].mean() < 0.8
    assert (shown[1] != shown[0]).any(axis=2).sum() <= 4  # of 128 edge pixels


@TRACED
@pytest.mark.parametrize(("water_priority", "ice_priority", "in_ice"), [(0, 0, 1.0), (0, 1, 2.0), (1, 0, 1.0)])
def test_medium_of_higher_priority_applies_where_two_media_overlap(
    pipeline: ls.Pipeline, water_priority: int, ice_priority: int, in_ice: float
) -> None:
    """Ice is half in water: the overlap is the medium of higher priority or, at equal priority, the one entered last.

    The absorption shows which medium applies to which path; a specular strength of 0 removes reflections.
    """
    water = replace(CLEAR, ior=1.33, specular=0.0, attenuation_color=(0.5, 1.0, 1.0), attenuation_distance=1.0)
    ice = replace(CLEAR, ior=1.31, specular=0.0, attenuation_color=(1.0, 0.25, 1.0), attenuation_distance=1.0)
    sea = slab(0.0, 2.0, replace(water, priority=water_priority))
    berg = slab(-1.0, 1.0, replace(ice, priority=ice_priority))
    found = color(ls.Scene(meshes=[sea, berg], lights=[ENVIRONMENT]), pipeline, 4)
    rtol = 0.01 if pipeline is ls.Pipeline.PATH else 1e-4  # Russian roulette adds noise
    np.testing.assert_allclose(found, [0.5 ** (3.0 - in_ice), 0.25**in_ice, 1.0], rtol=rtol)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, pytest.param(ls.Pipeline.PATH, marks=pytest.mark.deep)])
@pytest.mark.parametrize("priority", [1, pytest.param(-1, marks=pytest.mark.deep)])
def test_surface_between_two_media_reflects_by_the_indices_of_both(pipeline: ls.Pipeline, priority: int) -> None:
    """Two overlapping bodies have three surfaces, each with the Fresnel reflectance of the media on both sides.

    For multiple reflections between parallel surfaces, 1 over the transmitted fraction is 1 + sum R / (1 - R) over the
    reflectances R.
    """
    indices = (1.0, 1.31, 1.6, 1.0)
    bodies = [slab(-1.0, 1.0, replace(CLEAR, ior=1.31, priority=priority)), slab(0.0, 2.0, replace(CLEAR, ior=1.6))]
    light = quad((-9, -9, 3.0), (18, 0, 0), (0, 18, 0), LIT)
    is_path = pipeline is ls.Pipeline.PATH
    found = color(ls.Scene(meshes=[*bodies, light]), pipeline, 1024 if is_path else 1, max_bounces=8)
    mirrored = [reflectance(before, behind) for before, behind in itertools.pairwise(indices)]
    truth = 1.0 / (1.0 + sum(r / (1.0 - r) for r in mirrored))
    np.testing.assert_allclose(found, truth, rtol=3e-3)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_glass_ball_inside_a_ball_of_equal_glass_is_invisible(pipeline: ls.Pipeline) -> None:
    """A ball of air inside the glass ball is visible."""
    glass = replace(CLEAR, ior=1.5)
    view = ls.Camera.look_at((0, 0, -3), (0, 0, 0), width=24, height=24, fov_y=0.5)
    environment = np.zeros((16, 32, 3), np.float32)
    environment[:, ::4] = 1.0
    outer = ball(0.6, glass, rows=24)
    shown = [
        ls.render(
            ls.Scene(meshes=[outer, *inner], lights=[ls.LightEnvironment(environment)]),
            view,
            ls.RenderConfig(pipeline=pipeline, samples=1, seed=3, max_bounces=6),
            device="cpu",
        ).color
        for inner in ([], [ball(0.3, glass, rows=24)], [ball(0.3, CLEAR, rows=24)])
    ]
    if pipeline is ls.Pipeline.TRACE:
        np.testing.assert_allclose(shown[1], shown[0], atol=2e-2)
        assert np.abs(shown[2] - shown[0]).mean() > 0.05
    else:
        np.testing.assert_allclose(shown[1].mean(), shown[0].mean(), rtol=0.1)


@TRACED
def test_glass_mesh_with_inward_facing_triangles_logs_one_warning(
    pipeline: ls.Pipeline, caplog: pytest.LogCaptureFixture
) -> None:
    """The warning names the mesh; closed meshes that face outwards log nothing."""
    good = ball(0.5, replace(CLEAR, ior=1.5), rows=12)
    bad = ball(0.5, replace(CLEAR, ior=1.5), hollow=True, rows=12)
    settings = ls.RenderConfig(pipeline=pipeline, samples=2)
    with caplog.at_level("WARNING", logger="lumisplat"):
        renderer = ls.create_renderer(settings, "cpu")
        renderer.render(ls.Scene(meshes=[good], lights=[ENVIRONMENT]), AHEAD)
        assert "without entering it" not in caplog.text
        for _ in range(2):
            renderer.render(ls.Scene(meshes=[ls.MeshInstance(bad, name="drop")], lights=[ENVIRONMENT]), AHEAD)
    assert caplog.text.count("rays leave the inside of mesh 'drop' without entering it") == 1


@pytest.mark.parametrize("distance", [0.0, -1.0, float("nan"), "far"])
def test_material_refuses_invalid_attenuation_distances(distance: Any) -> None:
    """One message states the expected values."""
    with pytest.raises(ls.SceneError, match=r"attenuation_distance is .*, expected a number above 0, or inf"):
        ls.MaterialPbr(attenuation_distance=distance)


@pytest.mark.parametrize("value", [(0.5, -0.1, 1.0), (float("nan"), 1.0, 1.0), (2.0, 1.0, 1.0), float("inf")])
def test_material_refuses_attenuation_colours_outside_0_to_1(value: Any) -> None:
    """Negative values, values above 1 and NaN are refused."""
    with pytest.raises(ls.SceneError, match=r"attenuation_color is .*, expected three numbers in 0\.\.1"):
        ls.MaterialPbr(attenuation_color=value)
