"""Lit frames: their parts add up, and do not depend on backend, order or number of steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from lumisplat.math.color import decode_srgb
from support.compare.backends import BACKENDS, renderer_of
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, config, scene
from support.scenes.pipelines import DIRECT, SAMPLED
from support.scenes.raster_scenes import front_camera, one_gaussian, random_gaussians, similarity


def checked(image: np.ndarray | None) -> np.ndarray:
    """Returns the image, which must exist and be finite."""
    assert image is not None
    assert np.isfinite(image).all()
    return image


@pytest.mark.parametrize("pipeline", DIRECT)
def test_layers_of_a_lit_frame_add_up_to_its_colour(pipeline: ls.Pipeline) -> None:
    """Colour is captured radiance plus light; light is emission, the shadowed light of each light, and reflections."""
    # With several samples, captured colours are averaged in display values and light linearly, so sums would differ.
    settings = config(pipeline, samples=1, aovs=all_aovs(), background=(0.0, 0.0, 0.0))
    frame = ls.render(scene(*LIGHTS, ENVIRONMENT), camera(), settings, device="cpu")
    weight = checked(frame.captured_weight)[..., None]
    straight = np.divide(checked(frame.captured), weight, out=np.zeros_like(frame.color), where=weight > 0.0)
    captured = weight * decode_srgb(straight)
    light = checked(frame.light)
    np.testing.assert_allclose(frame.color, np.maximum(captured + light, 0.0), atol=2e-6)

    assert frame.light_names == ("bulb", "light1", "light2", "sky")
    direct, shadow = checked(frame.light_direct), checked(frame.light_shadow)
    assert direct.shape == shadow.shape == (4, 32, 48, 3)
    assert (shadow >= 0.0).all() and (shadow <= 1.0).all()
    assert (shadow[2] == 1.0).all(), "it casts no shadow"
    assert shadow[:2].min() == 0.0 and direct[:, 12:].max() > 0.1
    arrived = (direct * shadow).sum(axis=0)
    total = checked(frame.emission) + checked(frame.reflection) + arrived
    np.testing.assert_allclose(frame.color, total, atol=3e-5)
    assert checked(frame.reflection).max() > 0.1


def all_aovs() -> tuple[str, ...]:
    """Returns the names of all light images."""
    return ("albedo", "emission", "reflection", "lights", "hits")


@pytest.mark.parametrize("shadows", list(ls.Shadows))
@pytest.mark.parametrize("pipeline", SAMPLED)
def test_lit_frames_do_not_depend_on_cuda_schedule_graphs_or_thread_count(
    pipeline: ls.Pipeline, shadows: ls.Shadows
) -> None:
    """CUDA's schedule runs on the CPU; one renderer repeats its frames to the bit."""
    settings = config(pipeline, shadows=shadows, samples=2, background=None)
    frames = [renderer_of(backend, settings).render(scene(*LIGHTS, ENVIRONMENT), camera()) for backend in BACKENDS]
    single = ls.create_renderer(settings, "cpu", threads=1)
    for frame in (
        single.render(scene(*LIGHTS, ENVIRONMENT), camera()),
        single.render(scene(*LIGHTS, ENVIRONMENT), camera()),
    ):
        np.testing.assert_array_equal(frame.color, frames[0].color)
    for frame in frames[1:]:
        assert np.abs(frame.color - frames[0].color).max(axis=2).mean() < 1e-4
        # Rounding moves edges, and changes random decisions there.
        assert np.mean(np.abs(frame.color - frames[0].color).max(axis=2) > 1e-3) < 0.01


def test_resumed_lit_frames_equal_uninterrupted_ones() -> None:
    """Two plus three samples equal five in every image of every pipeline."""
    for pipeline in SAMPLED:
        settings = config(pipeline, shadows=ls.Shadows.SOFT, samples=5)
        at_once = ls.render(scene(*LIGHTS, ENVIRONMENT), camera(), settings, device="cpu")
        first = ls.render(scene(*LIGHTS, ENVIRONMENT), camera(), replace(settings, samples=2), device="cpu")
        renderer = ls.create_renderer(replace(settings, samples=3), "cpu")
        resumed = renderer.render(scene(*LIGHTS, ENVIRONMENT), camera(), resume=first)
        assert resumed.samples == at_once.samples == 5
        for name in ("color", "captured", "captured_weight", "light", "alpha", "depth", "normal"):
            np.testing.assert_array_equal(getattr(resumed, name), getattr(at_once, name), name)


def test_resuming_an_unlit_frame_with_lighting_or_a_lit_one_without_is_refused() -> None:
    """An unlit frame cannot be resumed as a lit one, nor the reverse."""
    unlit = ls.render(scene(), camera(), config(lighting=False), device="cpu")
    bright = ls.render(scene(), camera(), config(), device="cpu")
    for settings, frame in ((config(), unlit), (config(lighting=False), bright)):
        with pytest.raises(ls.ConfigError, match="cannot resume"):
            ls.create_renderer(settings, "cpu").render(scene(), camera(), resume=frame)


def test_frames_are_lit_by_default_if_the_scene_has_lights_or_meshes() -> None:
    """Captures alone are unlit, or lit by a headlight if lighting=True."""
    dark = replace(scene(), lights=())
    captures = replace(dark, meshes=())
    assert ls.render(scene(), camera(), config(), device="cpu").color_space == "linear"
    assert ls.render(dark, camera(), config(), device="cpu").color_space == "linear"
    assert ls.render(captures, camera(), config(), device="cpu").light is None
    assert ls.render(scene(), camera(), config(lighting=False), device="cpu").color_space == "srgb"
    assert checked(ls.render(dark, camera(), config(lighting=True), device="cpu").light).max() > 0.1


def test_soft_shadows_of_16_samples_have_less_than_0_4_times_the_noise_of_one() -> None:
    """The error of 16 samples of an area light is less than 0.4 times that of one sample."""
    source = replace(LIGHTS[0], radius=0.3)
    renderers = [ls.create_renderer(config(shadows=ls.Shadows.SOFT, samples=n), "cpu") for n in (1, 16, 256)]
    one, some, many = (renderer.render(scene(source), camera()).color for renderer in renderers)
    errors = [np.sqrt(np.mean((image - many) ** 2)) for image in (one, some)]
    assert errors[0] > 2.5 * errors[1] > 0.0


def test_mean_of_many_stochastic_splat_samples_converges_to_the_blend_of_sorted_splats() -> None:
    """Unlit frames without jitter converge to the blend of all sorted splats."""
    captures = replace(scene(), meshes=(), lights=())
    exact = ls.render(captures, camera(), config(ls.Pipeline.RASTER), device="cpu")
    chance = ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC)
    errors = []
    for samples in (16, 256):
        settings = config(ls.Pipeline.RASTER, raster=chance, jitter=False, samples=samples)
        errors.append(
            np.sqrt(np.mean((ls.render(captures, camera(), settings, device="cpu").color - exact.color) ** 2))
        )
    assert errors[1] < 0.012
    assert 3.0 < errors[0] / errors[1] < 5.0, "16 times the samples, a quarter of the noise"


def test_frames_of_stochastic_splats_do_not_depend_on_scene_order_or_schedule() -> None:
    """Sets are listed in another order, and pixels are processed one by one."""
    chance = ls.RasterConfig(strategy=ls.config.RasterStrategy.STOCHASTIC)
    settings = config(ls.Pipeline.RASTER, raster=chance, samples=3)
    frames = [renderer_of(backend, settings).render(scene(), camera()) for backend in BACKENDS]
    for frame in frames[1:]:
        assert np.mean(np.abs(frame.color - frames[0].color).max(axis=2) > 1e-4) < 0.01
    assert np.unique(frames[0].alpha[frames[0].depth < np.inf]).size <= 4  # each sample covers a pixel, or not


@pytest.mark.parametrize("strategy", [ls.config.TraceStrategy.STOCHASTIC_HIT, ls.config.TraceStrategy.STOCHASTIC_PASS])
def test_stochastic_splat_samples_are_lit_one_by_one_and_then_averaged(strategy: ls.config.TraceStrategy) -> None:
    """On thin surfaces, the mean of lit samples is close to the lit sorted frame."""
    settings = config(trace=ls.TraceConfig(strategy=strategy), shadows=ls.Shadows.OFF, samples=64, jitter=False)
    exact = replace(settings, trace=ls.TraceConfig(), samples=1)
    floor = replace(scene(), meshes=(), splats=scene().splats[:1])
    samples, one = (ls.render(floor, camera(), each, device="cpu") for each in (settings, exact))
    inside = one.alpha > 0.995
    relative = np.abs(samples.color - one.color)[inside] / one.color[inside].mean()
    assert inside.sum() > 200 and relative.mean() < 0.05


def test_mirror_reflects_lights_and_shadows_like_a_mirrored_camera() -> None:
    """A plane mirror shows the image of a mirrored camera, including lights and shadows."""
    silver = ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), metallic=1.0, roughness=0.0)
    pane = ls.Mesh(
        np.array([[-9.0, -9, 0], [9, -9, 0], [9, 9, 0], [-9, 9, 0]]), [[0, 1, 2], [0, 2, 3]], material=silver
    )
    source = ls.LightPoint((0.5, 1.5, 2.0), intensity=8.0)
    paper = ls.MaterialPbr(base_color=(0.9, 0.5, 0.3), roughness=0.6)
    ball, floor = replace(sphere(0.4, rows=12, columns=20), material=paper), pane_below()
    meshes = [ls.MeshInstance(ball, similarity(offset=(0.0, 0.4, 1.6))), floor]
    toy = ls.SplatInstance(
        ls.gaussians_from_mesh(ball, 900, seed=1), similarity(offset=(0.9, 0.4, 1.5)), material=paper
    )
    eye, target = np.array([0.3, 0.9, 4.0]), np.array([0.1, 0.5, 0.0])
    view = ls.Camera.look_at(tuple(eye), tuple(target), width=40, height=30, fov_y=0.5)
    seen = ls.render(ls.Scene([toy], [*meshes, pane], [source]), view, config(), device="cpu")
    flip = np.diag([1.0, 1.0, -1.0])
    behind = ls.Camera.look_at(tuple(flip @ eye), tuple(flip @ target), width=40, height=30, fov_y=0.5)
    direct = ls.render(ls.Scene([toy], meshes, [source]), behind, config(), device="cpu").color[:, ::-1]
    alone = np.isclose(seen.depth, ls.render(ls.Scene([], [pane]), view, config(), device="cpu").depth, rtol=1e-4)
    assert alone.sum() > 300
    difference = np.abs(seen.color - direct)[alone].max(axis=1)
    assert np.mean(difference > 0.02 * direct.max()) < 0.04  # edges


def pane_below() -> ls.MeshInstance:
    """Returns a floor in front of the mirror."""
    corners = np.array([[-3.0, 0.0, 0.1], [3.0, 0.0, 0.1], [3.0, 0.0, 6.0], [-3.0, 0.0, 6.0]])
    return ls.MeshInstance(ls.Mesh(corners, [[0, 2, 1], [0, 3, 2]], material=ls.MaterialPbr(specular=0.0)))


def test_trace_rays_returns_the_linear_colours_of_the_lit_frame() -> None:
    """The radiance excludes the background."""
    view = camera()
    thin = ls.TraceConfig(dilation=0.0)  # rays of queries have no footprint
    frame = ls.render(scene(), view, config(background=(0.0, 0.0, 0.0), trace=thin), device="cpu")
    directions = view.ray_directions().reshape(-1, 3) @ view.world_from_camera[:3, :3].T
    hits = ls.trace_rays(scene(), view.eye, directions, config(background=(0.0, 0.0, 0.0)), device="cpu")
    assert hits.color_space == "linear"
    # Frames blend edges of captures with the background in display values; ray queries have no background.
    solid = (frame.alpha > 0.9999).ravel()
    assert solid.mean() > 0.25
    np.testing.assert_allclose(hits.radiance[solid], frame.color.reshape(-1, 3)[solid], atol=5e-4)
    white = ls.trace_rays(scene(), view.eye, directions, config(background=(1.0, 1.0, 1.0)), device="cpu")
    empty = hits.transmittance == 1.0
    assert empty.any() and (white.radiance[empty] == 0.0).all()


def test_light_that_overflows_float32_is_dropped_and_counted() -> None:
    """Values beyond float32 are dropped, and the frame's statistics count them."""
    blinding = ls.MaterialPbr(emissive=(3e38, 3e38, 3e38), emissive_texture=None)
    source = ls.LightPoint((0.0, 1.0, -1.0), intensity=1e30)
    ball = ls.MeshInstance(
        replace(sphere(0.4, rows=6, columns=8), material=blinding), similarity(offset=(0.0, 0.4, 0.5))
    )
    frame = ls.render(ls.Scene([], [ball, ball], [source]), camera(), config(), device="cpu")
    checked(frame.color)
    assert frame.stats is not None
    assert frame.stats.nonfinite_count > 20


def test_moving_a_light_between_frames_uploads_no_gaussians_or_meshes() -> None:
    """A renderer follows lights between frames, and renders unlit frames once there are no lights."""
    renderer = ls.create_renderer(config(ls.Pipeline.HYBRID), "cpu")
    assets = scene()
    left, right = (replace(assets, lights=[ls.LightPoint((x, 1.5, 0.0), intensity=5.0)]) for x in (-1.0, 1.0))
    frames = [renderer.render(each, camera()) for each in (left, right, left)]
    np.testing.assert_array_equal(frames[0].color, frames[2].color)
    assert np.abs(frames[0].color - frames[1].color).max() > 0.05
    unlit = renderer.render(replace(assets, lights=(), meshes=()), camera())
    assert unlit.light is None
    allocations = renderer._buffers.allocations
    renderer.render(left, camera())
    renderer.render(replace(assets, lights=()), camera())
    assert renderer._buffers.allocations == allocations


@pytest.mark.parametrize("pipeline", DIRECT)
def test_renderer_does_not_use_the_roughness_of_one_capture_for_the_next(pipeline: ls.Pipeline) -> None:
    """A renderer that switches to another capture gives the frame of a new renderer."""
    settings, view = ls.RenderConfig(pipeline=pipeline), front_camera()
    warm = ls.create_renderer(settings, "cpu")
    shown: list[np.ndarray] = []
    for roughness in (0.1, 0.9, 0.3, 0.7):
        # Scenes are temporary, so that a later scene may have the memory address of an earlier one.
        shown.append(warm.render(glossy(roughness), view).color)
        np.testing.assert_array_equal(
            shown[-1], ls.create_renderer(settings, "cpu").render(glossy(roughness), view).color
        )
    assert np.abs(shown[0] - shown[1]).max() > 0.01


def glossy(roughness: float) -> ls.Scene:
    """Returns a capture whose Gaussians all have the given roughness, relit by one light."""
    gaussians = random_gaussians(5, count=60, roughness=np.full(60, roughness, np.float32))
    source = ls.LightDirectional((0.2, 0.3, 1.0), intensity=3.0, casts_shadow=False)
    return ls.Scene([ls.SplatInstance(gaussians, material=ls.MaterialPbr())], lights=[source])


def test_disabled_lights_add_no_light_to_the_frame() -> None:
    """Disabled lights only remove the headlight."""
    rect = ls.LightRect((0.0, 2.0, 0.5), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), intensity=3.0)
    ball = ls.LightSphere((0.5, 2.0, 0.5), 0.2, intensity=5.0)
    kinds = (*LIGHTS, ENVIRONMENT, rect, ball)
    off = [replace(light, enabled=False) for light in kinds]
    without = ls.render(scene(LIGHTS[0]), camera(), config(), device="cpu")
    with_them = ls.render(scene(*off[1:4], LIGHTS[0], *off[4:]), camera(), config(), device="cpu")
    np.testing.assert_allclose(with_them.color, without.color, atol=1e-6)


def test_visible_environment_fills_the_background_and_appears_in_mirrors() -> None:
    """The environment is rotated as specified; an invisible one shows neither in the background nor in mirrors."""
    image = np.zeros((8, 16, 3), np.float32)
    image[:, 8:] = (1.0, 0.5, 0.25)  # right of the middle: +x
    right, empty = ls.LightEnvironment(image), ls.Mesh([[0, 0, -9.0], [1e-3, 0, -9], [0, 1e-3, -9]], [[0, 1, 2]])
    for pipeline in DIRECT:
        for eye, expected in (((1.0, 0.0, 0.0), (1.0, 0.5, 0.25)), ((-1.0, 0.0, 0.0), (0.0, 0.0, 0.0))):
            view = ls.Camera.look_at((0, 0, 0), eye, width=8, height=8, fov_y=0.2)
            seen = ls.render(ls.Scene([], [empty], [right]), view, config(pipeline), device="cpu")
            np.testing.assert_allclose(seen.color, np.broadcast_to(expected, seen.color.shape), atol=1e-6)
            assert (seen.alpha == 1.0).all()
            hidden = replace(right, visible=False)
            behind = ls.render(ls.Scene([], [empty], [hidden]), view, config(pipeline), device="cpu")
            np.testing.assert_allclose(behind.color[0, 0], decode_srgb(np.array([0.1, 0.2, 0.3])), rtol=1e-5)
            assert (behind.alpha == 0.0).all()


@pytest.mark.parametrize("pipeline", DIRECT)
def test_transparent_lit_frames_of_captures_have_premultiplied_colours(pipeline: ls.Pipeline) -> None:
    """Half coverage of a grey gives half of the light of the grey, for every material and pipeline."""
    veil = one_gaussian(mean=(0.0, 0.0, 0.0), scale=(3.0, 3.0, 0.01), opacity=0.5, color=(0.5, 0.5, 0.5))
    view = ls.Camera.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), width=16, height=16, fov_y=0.1)
    sun = ls.LightDirectional((0.0, 0.0, 1.0), intensity=np.pi)
    paper = ls.MaterialSimple(emissive=(0, 0, 0), diffuse=(1, 1, 1))
    for material in (None, paper):
        for strategy in (ls.config.RasterStrategy.SORTED, ls.config.RasterStrategy.STOCHASTIC):
            chance = strategy is ls.config.RasterStrategy.STOCHASTIC
            settings = config(
                pipeline,
                background=None,
                shadows=ls.Shadows.OFF,
                samples=64 if chance else 1,
                raster=ls.RasterConfig(strategy=strategy),
            )
            given = ls.Scene([ls.SplatInstance(veil, material=material)], lights=[sun])
            frame = ls.render(given, view, settings, device="cpu")
            assert frame.alpha.mean() == pytest.approx(0.5, abs=0.02)
            linear = frame.alpha[..., None] * decode_srgb(np.full(3, 0.5))
            np.testing.assert_allclose(frame.color, linear, rtol=2e-3, atol=1e-6)
            np.testing.assert_allclose(frame.premultiplied(), linear, rtol=2e-3, atol=1e-6)
            np.testing.assert_allclose(frame.pixels_srgb()[..., :3], 0.5, atol=1e-3)


def test_transparent_fisheye_frames_are_premultiplied_at_the_edge_of_the_image_circle() -> None:
    """In pixels of which only some samples have a ray, the captured part does not exceed the coverage."""
    fisheye = ls.Camera(
        width=32, height=32, fx=5.0, fy=5.0, cx=16.0, cy=16.0, camera_from_world=np.eye(4), model=ls.CameraModel.FISHEYE
    )
    behind = one_gaussian(mean=(0.0, 0.0, -4.0), scale=2.0, opacity=0.9, color=(0.5, 0.5, 0.5))
    settings = config(background=None, samples=8, lighting=True)
    frame = ls.render(ls.Scene([ls.SplatInstance(behind)]), fisheye, settings, device="cpu")
    assert checked(frame.captured_weight).max() > 0.5
    assert (checked(frame.captured_weight) <= frame.alpha + 1e-5).all()
