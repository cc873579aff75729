"""Materials in lit frames: the effect of each value and texture on a surface, calculated by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.math.color import decode_srgb, encode_srgb
from support.kinds import present
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import flat_sh, front_camera

FACING = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
"""Light under which a diffuse surface that faces the view shows its albedo."""
PIPELINES = DIRECT
MATT = ls.MaterialPbr(specular=0.0, roughness=1.0)


def wall(material: ls.MaterialPbr | ls.MaterialSimple, depth: float = 2.0) -> ls.Mesh:
    """Returns a square that fills the view, with an upright texture."""
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]) * depth
    positions = np.column_stack([corners, np.full(4, depth)])
    uvs = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return ls.Mesh(positions, [[0, 2, 1], [0, 3, 2]], uvs=uvs, material=material)


def curtain(rows: int = 9, depth: float = 2.0, opacity: float = 0.95, **extras: np.ndarray) -> ls.Gaussians:
    """Returns flat Gaussians that fill the view in several layers; pixels transmit less than a thousandth."""
    x, y = np.meshgrid(*[np.linspace(-1.6, 1.6, rows) * 0.5 * depth] * 2)
    layers = [np.column_stack([x.ravel(), y.ravel(), np.full(x.size, depth + 0.01 * k)]) for k in range(3)]
    means = np.concatenate(layers)
    count = len(means)
    scales = np.tile([0.25 * depth, 0.25 * depth, 0.002], (count, 1))
    colors = extras.pop("colors", np.tile([0.7, 0.5, 0.3], (count, 1)))
    wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    filled = {name: np.broadcast_to(values, (count, *np.shape(values))) for name, values in extras.items()}
    return replace(ls.Gaussians(means, wxyz, scales, np.full(count, opacity), flat_sh(colors)), **filled)


def lit(scene: ls.Scene, pipeline: ls.Pipeline = ls.Pipeline.TRACE, **settings: object) -> ls.Frame:
    """Renders a small lit frame from the front."""
    config = replace(ls.RenderConfig(pipeline=pipeline, lighting=True), **settings)
    return ls.render(scene, front_camera(24, 18, 30.0), config, device="cpu")


def middle(frame: ls.Frame) -> np.ndarray:
    """Returns the mean linear colour of the pixels around the centre, shape (3,)."""
    return frame.color[7:11, 10:14].mean(axis=(0, 1))


def texture(*rgb: int) -> np.ndarray:
    """Returns a texture of one colour."""
    return np.full((2, 2, 3), rgb, np.uint8)


def diffuse(**changes: object) -> ls.MaterialPbr:
    """Returns a white diffuse material."""
    return replace(ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=1.0, specular=0.0), **changes)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_emissive_material_is_visible_with_all_lights_disabled(pipeline: ls.Pipeline) -> None:
    """Emission is multiplied by its decoded texture, and reflected light is added to it."""
    dark = replace(FACING, enabled=False)
    emissive = replace(diffuse(), emissive=(2.0, 1.0, 0.5), emissive_texture=texture(255, 128, 0))
    seen = middle(lit(ls.Scene(meshes=[wall(emissive)], lights=[dark]), pipeline))
    expected = np.array([2.0, 1.0, 0.5]) * decode_srgb(np.array([255, 128, 0]) / 255.0)
    np.testing.assert_allclose(seen, expected, rtol=2e-6)
    added = middle(lit(ls.Scene(meshes=[wall(emissive)], lights=[FACING]), pipeline))
    np.testing.assert_allclose(added, expected + 1.0, rtol=1e-4)


@pytest.mark.parametrize("lights", [1, 3])
@pytest.mark.parametrize("pipeline", PIPELINES)
def test_ambient_light_is_added_once_for_any_number_of_lights(lights: int, pipeline: ls.Pipeline) -> None:
    """The law holds for meshes and for splats."""
    material = ls.MaterialSimple(emissive=(0, 0, 0), ambient=(0.3, 0.2, 0.1), diffuse=(0.5, 0.5, 0.5))
    each = replace(FACING, intensity=np.pi / lights)
    of_mesh = ls.Scene(meshes=[wall(replace(material, base_color=(0.6, 0.6, 0.6)))], lights=[each] * lights)
    np.testing.assert_allclose(middle(lit(of_mesh, pipeline)), 0.6 * np.array([0.8, 0.7, 0.6]), rtol=1e-4)
    splat_shadows = ls.Scene(splats=[ls.SplatInstance(curtain(), material=material)], lights=[each] * lights)
    shadowless = lit(splat_shadows, pipeline, shadows=ls.Shadows.OFF)
    albedo = decode_srgb(np.array([0.7, 0.5, 0.3]))
    np.testing.assert_allclose(middle(shadowless), albedo * [0.8, 0.7, 0.6], rtol=5e-3)


def test_metallic_roughness_texture_multiplies_roughness_and_metallic_of_its_material() -> None:
    """Green is roughness and blue metallic; a texture looks like a material with the multiplied factors."""
    light = ls.LightDirectional((0.1, 0.05, 1.0), intensity=2.0)
    plain = ls.MaterialPbr(base_color=(0.9, 0.6, 0.3), roughness=0.8 * 0.4, metallic=0.8)
    mapped = replace(plain, roughness=0.8, metallic=1.0, metallic_roughness_texture=texture(0, 102, 204))
    seen = [middle(lit(ls.Scene(meshes=[wall(m)], lights=[light]))) for m in (mapped, plain)]
    np.testing.assert_allclose(seen[0], seen[1], rtol=1e-5)


def test_smooth_texels_of_a_rough_material_reflect_the_environment_without_mirror_rays() -> None:
    """Only smooth materials spawn mirror rays, so that smooth texels of rough materials have a highlight instead."""
    spotless = ls.MaterialPbr(
        base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=1.0, metallic_roughness_texture=texture(0, 0, 255)
    )
    environment = ls.LightEnvironment(color=(0.2, 0.3, 0.4), visible=False)
    seen = middle(lit(ls.Scene(meshes=[wall(spotless)], lights=[environment]), shadows=ls.Shadows.OFF, samples=4))
    np.testing.assert_allclose(seen, [0.2, 0.3, 0.4], rtol=0.02)


def test_normal_texture_tilts_the_normal_right_by_red_and_up_by_green() -> None:
    """The brightness changes with the cosine of the tilt, which scales with the strength of the texture."""
    up = ls.LightDirectional((0.0, 1.0, 1.0), intensity=np.pi)  # from above: y of the camera points down
    right = ls.LightDirectional((-1.0, 0.0, 1.0), intensity=np.pi)
    leaning_up, leaning_right = texture(128, 204, 230), texture(204, 128, 230)
    for light, helping, other in ((up, leaning_up, leaning_right), (right, leaning_right, leaning_up)):
        for texels, scale in ((helping, 1.0), (other, 1.0), (helping, 0.5)):
            local = 2.0 * texels[0, 0] / 255.0 - 1.0
            normal = np.array([scale * local[0], -scale * local[1], -local[2]])
            normal /= np.linalg.norm(normal)
            toward = -np.array(light.direction)
            material = diffuse(normal_texture=texels, normal_scale=scale)
            seen = middle(lit(ls.Scene(meshes=[wall(material)], lights=[light])))
            np.testing.assert_allclose(seen, normal @ toward, rtol=1e-4)


def test_occlusion_texture_dims_environment_light_and_no_other_light() -> None:
    """The strength of the texture scales the dimming; other lights are not dimmed."""
    hidden = texture(51, 0, 0)
    environment = ls.LightEnvironment(visible=False)
    for strength, share in ((1.0, 0.2), (0.5, 0.6)):
        material = diffuse(occlusion_texture=hidden, occlusion_strength=strength)
        seen = middle(lit(ls.Scene(meshes=[wall(material)], lights=[environment]), samples=64))
        np.testing.assert_allclose(seen, share, rtol=0.02)
        np.testing.assert_allclose(middle(lit(ls.Scene(meshes=[wall(material)], lights=[FACING]))), 1.0, rtol=1e-4)


@pytest.mark.parametrize("pipeline", [*PIPELINES, ls.Pipeline.PATH, ls.Pipeline.REALTIME])
@pytest.mark.parametrize("stores", [True, False], ids=["own values", "captured colour"])
def test_material_multiplies_what_a_relit_set_has(stores: bool, pipeline: ls.Pipeline) -> None:
    """Base colour, roughness and metallic are factors on own values; a material without them leaves these unchanged.

    Without own values, base colour is a factor on the decoded captured colour, and the others are the values.
    """
    light = ls.LightDirectional((0.15, 0.0, 1.0), intensity=3.0)
    albedo, tint = np.array([0.2, 0.6, 0.4]), np.array([0.5, 1.0, 0.25])

    def seen(albedo: np.ndarray, finish: float, **material: object) -> np.ndarray:
        own = {"albedo": albedo, "roughness": np.float32(finish), "metallic": np.float32(finish)}
        capture = curtain(**own) if stores else curtain(colors=np.tile(encode_srgb(albedo), (243, 1)))
        if not stores:
            material = {"roughness": finish, "metallic": finish} | material
        splats = ls.SplatInstance(capture, material=ls.MaterialPbr(**cast(Any, material)))
        settings = {"samples": 1} if pipeline is ls.Pipeline.PATH else {}
        return middle(lit(ls.Scene(splats=[splats], lights=[light]), pipeline, shadows=ls.Shadows.OFF, **settings))

    product = seen(tint * albedo, 0.35)
    edited = {"base_color": tint, "roughness": 0.5 if stores else 0.35, "metallic": 0.5 if stores else 0.35}
    factors = seen(albedo, 0.7, **edited)
    np.testing.assert_allclose(factors, product, rtol=2e-3)
    plain = seen(albedo, 0.7)
    assert np.abs(plain - factors).max() > 0.1 * plain.max()
    neutral = {"base_color": 1.0} | ({"roughness": 1.0, "metallic": 1.0} if stores else {})
    np.testing.assert_array_equal(seen(albedo, 0.7, **neutral), plain)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_albedo_of_a_relit_capture_is_its_decoded_picture(pipeline: ls.Pipeline) -> None:
    """Colours that differ along a ray are blended as captured, and decoded afterwards."""
    colors = np.repeat([[0.9, 0.8, 0.1], [0.1, 0.2, 0.9], [0.5, 0.5, 0.5]], 81, axis=0)
    capture, camera = curtain(opacity=0.6, colors=colors), front_camera(24, 18, 30.0)
    order = ls.TraceConfig(hit_distance=ls.config.HitDistance.MEAN)
    config = ls.RenderConfig(pipeline=pipeline, lighting=False, trace=order)
    picture = ls.render(ls.Scene([capture]), camera, config, device="cpu").color[7:11, 10:14]
    splats = ls.SplatInstance(capture, material=MATT)
    frame = lit(ls.Scene(splats=[splats], lights=[FACING]), pipeline, aovs=("albedo",), trace=order)
    np.testing.assert_allclose(present(frame.albedo)[7:11, 10:14], decode_srgb(picture), rtol=5e-3)


def test_tint_of_one_set_does_not_reach_the_sets_behind_it() -> None:
    """Each Gaussian has the tint of its own set, also where several sets share a pixel."""
    veil, wall = curtain(opacity=0.5, albedo=np.full(3, 0.5)), curtain(depth=2.2, albedo=np.full(3, 0.9))
    veil = veil.subset(np.arange(81))
    light = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)

    def seen(material: ls.MaterialPbr, albedo: float) -> np.ndarray:
        front = replace(veil, albedo=np.full((81, 3), albedo))
        sets = [ls.SplatInstance(front, material=material), ls.SplatInstance(wall, material=MATT)]
        return middle(lit(ls.Scene(splats=sets, lights=[light]), ls.Pipeline.RASTER, shadows=ls.Shadows.OFF))

    np.testing.assert_allclose(seen(replace(MATT, base_color=0.2), 0.5), seen(MATT, 0.1), rtol=1e-3)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_relit_gaussians_use_their_stored_albedo_roughness_and_metallic(pipeline: ls.Pipeline) -> None:
    """Albedo replaces the captured colour in sets that emit nothing."""
    light = ls.LightDirectional((0.15, 0.0, 1.0), intensity=3.0)
    stored = {"albedo": np.array([0.2, 0.6, 0.4]), "roughness": np.float32(0.35), "metallic": np.float32(0.7)}
    without_material = curtain(colors=np.tile(encode_srgb(np.array([0.2, 0.6, 0.4])), (243, 1)))
    matched = ls.MaterialPbr(roughness=0.35, metallic=0.7)
    other = ls.MaterialPbr()
    scenes = [
        ls.Scene(splats=[ls.SplatInstance(capture, material=material)], lights=[light])
        for capture, material in ((curtain(**stored), other), (without_material, matched))
    ]
    seen = [middle(lit(scene, pipeline, shadows=ls.Shadows.OFF)) for scene in scenes]
    np.testing.assert_allclose(seen[0], seen[1], rtol=2e-3)
    emissive = ls.SplatInstance(curtain(**stored), material=replace(other, emissive=(1.0, 1.0, 1.0)))
    glowing = lit(ls.Scene(splats=[emissive], lights=[replace(light, enabled=False)]), pipeline)
    np.testing.assert_allclose(middle(glowing), decode_srgb(np.array([0.7, 0.5, 0.3])), rtol=5e-3)


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_relit_gaussians_are_shaded_with_their_stored_normals(pipeline: ls.Pipeline) -> None:
    """Stored normals are turned towards the viewer.

    The curtain just fills the view: on a wider one, turned normals would be near the horizon at its sides, where they
    are bent (test_stored_normals.py).
    """
    tilted, narrow = np.array([0.6, 0.0, -0.8]), np.array([0.4, 0.4, 1.0])
    toward = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
    for sign in (1.0, -1.0):
        wide = curtain(normals=sign * tilted, albedo=np.array([1.0, 1.0, 1.0]))
        capture = replace(wide, means=narrow * wide.means, scales=narrow * wide.scales)
        splats = ls.SplatInstance(capture, material=diffuse())
        frame = lit(ls.Scene(splats=[splats], lights=[toward]), pipeline, shadows=ls.Shadows.OFF)
        np.testing.assert_allclose(frame.normal[9, 12], tilted, atol=1e-5)
        np.testing.assert_allclose(middle(frame), 0.8, rtol=5e-3)
    unlit = ls.render(ls.Scene(splats=[capture]), front_camera(24, 18, 30.0), device="cpu")
    assert unlit.normal[9, 12] @ tilted < 0.9  # unlit frames show the Gaussians' planes


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_sh_degree_limit_of_one_gaussian_set_does_not_change_other_sets(pipeline: ls.Pipeline) -> None:
    """Degree 0 drops the view-dependent part of the colours of one set only."""
    capture = curtain()
    sh = np.concatenate([capture.sh, np.full((capture.count, 3, 3), 0.2, np.float32)], axis=1)
    viewed = replace(capture, sh=sh)
    camera = front_camera(24, 18, 30.0)
    config = ls.RenderConfig(pipeline=pipeline)
    plain, capped, full = (
        ls.render(ls.Scene(splats=[ls.SplatInstance(g, sh_degree=degree)]), camera, config, device="cpu").color
        for g, degree in ((capture, 3), (viewed, 0), (viewed, 3))
    )
    np.testing.assert_array_equal(plain, capped)
    assert np.abs(full - plain).max() > 0.05


@pytest.mark.parametrize("pipeline", PIPELINES)
def test_captured_colour_of_faint_splats_is_equal_for_emissive_and_reflecting_materials(pipeline: ls.Pipeline) -> None:
    """A layer below the iso-opacity threshold has the same captured part if its set reflects as if it only emits."""
    veil = curtain(rows=3, opacity=0.04)
    background = (0.2, 0.4, 0.6)
    emissive = lit(ls.Scene(splats=[veil], lights=[FACING]), pipeline, background=background)
    assert 0.05 < emissive.alpha.max() < 0.25
    reflecting = ls.SplatInstance(veil, material=ls.MaterialSimple(emissive=(1, 1, 1), diffuse=(0.1, 0.1, 0.1)))
    both = lit(ls.Scene(splats=[reflecting], lights=[FACING]), pipeline, background=background)
    np.testing.assert_array_equal(both.alpha, emissive.alpha)
    np.testing.assert_array_equal(both.captured, emissive.captured)


def test_light_behind_a_triangle_adds_nothing_although_shading_normals_lean_towards_it() -> None:
    """The light adds nothing, however far the shading normals lean towards it."""
    plain = wall(diffuse())
    leaning = replace(plain, normals=np.tile([0.0, -0.9, -0.4359], (4, 1)))
    below = ls.LightDirectional((0.0, 1.0, -0.1), intensity=10.0)
    assert middle(lit(ls.Scene(meshes=[leaning], lights=[below]), shadows=ls.Shadows.OFF)).max() == 0.0


def test_mean_light_of_stochastic_hits_on_relit_splats_equals_that_of_sorted_blending() -> None:
    """Samples that hit single Gaussians are lit over black and over white."""
    capture = curtain(rows=5, opacity=0.35)
    splats = ls.SplatInstance(capture, material=ls.MaterialSimple(emissive=(0, 0, 0), diffuse=(1, 1, 1)))
    scene = ls.Scene(splats=[splats], lights=[replace(FACING, direction=(0.0, 0.3, 1.0))])
    chance = ls.TraceConfig(strategy=ls.config.TraceStrategy.STOCHASTIC_HIT)
    for background in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), None):
        common = {"shadows": ls.Shadows.OFF, "background": background, "jitter": False}
        exact = lit(scene, **common)
        mean = lit(scene, trace=chance, samples=256, **common)
        assert 0.6 < exact.alpha.mean() < 0.99
        np.testing.assert_allclose(mean.color.mean(axis=(0, 1)), exact.color.mean(axis=(0, 1)), rtol=0.03)
        np.testing.assert_allclose(mean.premultiplied().mean(), exact.premultiplied().mean(), rtol=0.03)


@pytest.mark.parametrize("pipeline", PIPELINES)
@pytest.mark.parametrize("samples", [1, 32])
def test_shadow_on_a_capture_with_sub_pixel_stripes_is_equally_dark_at_1_and_32_samples(
    samples: int, pipeline: ls.Pipeline
) -> None:
    """The capture has stripes narrower than pixels; a shadow removes the same fraction for any sample count."""
    x = np.linspace(-1.7, 1.7, 341)
    means = np.column_stack([x, np.zeros(341), np.full(341, 2.0)])
    scales = np.tile([0.009, 3.0, 0.002], (341, 1))
    colors = np.where(np.arange(341)[:, None] % 4 < 2, 0.95, 0.05) * np.ones(3)
    wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (341, 1))
    stripes = ls.SplatInstance(
        ls.Gaussians(means, wxyz, scales, np.full(341, 0.99), flat_sh(colors)),
        material=ls.MaterialSimple(ambient=(0.0, 0.0, 0.0)),
        shadow_catcher=True,
    )
    sun = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
    source = ls.LightDirectional((0.0, 0.0, 1.0), intensity=0.5 * np.pi, casts_shadow=False)
    screen = np.array([[-9.0, -9.0, -3.0], [9.0, -9.0, -3.0], [9.0, 9.0, -3.0], [-9.0, 9.0, -3.0]])
    blocker = ls.Mesh(screen, [[0, 2, 1], [0, 3, 2]])
    settings = {"samples": samples, "jitter": True}
    free = lit(ls.Scene(splats=[stripes], lights=[sun, source]), pipeline, **settings)
    dark = lit(ls.Scene(splats=[stripes], meshes=[blocker], lights=[sun, source]), pipeline, **settings)
    # A third of the light passes through the blocker.
    np.testing.assert_allclose(dark.color.mean() / free.color.mean(), 1.0 / 3.0, rtol=0.03)


def test_pipelines_other_than_path_render_rough_glass_as_diffusely_reflecting() -> None:
    """The transmitted fraction becomes diffuse reflection, so that no energy is lost."""
    frosted = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), roughness=0.4, transmission=1.0)
    plain = replace(frosted, transmission=0.0)
    seen = [middle(lit(ls.Scene(meshes=[wall(m)], lights=[FACING]))) for m in (frosted, plain)]
    np.testing.assert_allclose(seen[0], seen[1], rtol=1e-6)
