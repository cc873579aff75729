"""Shadow catchers: one meaning in all pipelines, and layers from which other programs composite them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import OpenEXR
import pytest

import lumisplat as ls
from lumisplat.baking.gaussian_views import CatcherLight
from lumisplat.demo.shapes import sphere
from lumisplat.math.color import decode_srgb
from support.compare.backends import BACKENDS, renderer_of

RADIUS, HEIGHT = 0.5, 0.4
SHARE = RADIUS**2 / (RADIUS**2 + HEIGHT**2)
"""Fraction of a cosine-weighted hemisphere that the disc hides from the point below it."""
SUN = ls.LightDirectional((0, -1, 0), color=(1.0, 0.8, 0.5), intensity=2.0)
PIPELINES = pytest.mark.parametrize("pipeline", list(ls.Pipeline), ids=lambda one: one.value)


def floor(color: float = 0.5, ambient: float | None = None) -> ls.SplatInstance:
    """Returns a level sheet at y = 0, 8 units wide, that emits a captured grey."""
    plane = ls.Mesh([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], [[0, 1, 2], [0, 2, 3]])
    sheet = ls.gaussians_from_mesh(plane, 6000)
    sh = np.full((6000, 1, 3), (color - 0.5) / 0.28209479177387814, np.float32)
    sheet = replace(sheet, sh=sh, albedo=None, roughness=None, metallic=None)
    material = None if ambient is None else ls.MaterialSimple(ambient=(ambient,) * 3)
    return ls.SplatInstance(sheet, material=material, shadow_catcher=True)


def disc(albedo: float = 0.0) -> ls.Mesh:
    """Returns a level disc with many corners above the origin."""
    angles = np.linspace(0.0, 2.0 * np.pi, 129)[:-1]
    rim = np.stack([RADIUS * np.cos(angles), np.full(128, HEIGHT), RADIUS * np.sin(angles)], axis=1)
    faces = [[0, 1 + k, 1 + (k + 1) % 128] for k in range(128)]
    material = ls.MaterialPbr(base_color=(albedo,) * 3, specular=0.0, roughness=1.0)
    return ls.Mesh(np.concatenate([[[0.0, HEIGHT, 0.0]], rim]), np.array(faces), material=material)


def below() -> ls.Camera:
    """Returns a camera on the floor below the disc, where an equal fraction of all directions is hidden."""
    return ls.Camera.look_at((0.0, 0.3, 0.0), (0, 0, 0), (0, 0, 1), width=16, height=16, fov_y=0.02)


def rendered(scene: ls.Scene, camera: ls.Camera, pipeline: ls.Pipeline, **settings: object) -> ls.Frame:
    """Renders a frame with its shadow ratio; a real-time frame is the last of several, which are averaged."""
    config = ls.RenderConfig(pipeline=pipeline, aovs=("shadow_ratio",), background=None)
    renderer = ls.create_renderer(replace(config, **settings), "cpu", threads=2)
    for _ in range(31 if pipeline is ls.Pipeline.REALTIME else 0):
        renderer.render(scene, camera)
    return renderer.render(scene, camera)


@PIPELINES
@pytest.mark.parametrize("ambient", [None, 0.2])
def test_shadow_of_the_sun_on_a_shadow_catcher_does_not_remove_ambient_light(
    pipeline: ls.Pipeline, ambient: float | None
) -> None:
    """Below a disc, the ratio is the unblocked ambient irradiance over the sum of ambient irradiance and sun."""
    scene = ls.Scene([floor(0.3, ambient)], [disc()], [SUN])
    frame = rendered(scene, below(), pipeline)
    given = np.pi * (0.5 if ambient is None else ambient)
    expected = given * (1.0 - SHARE) / (given + SUN.intensity * np.array(SUN.color))
    assert frame.shadow_ratio is not None
    np.testing.assert_allclose(frame.shadow_ratio.mean(axis=(0, 1)), expected, rtol=0.04)


@PIPELINES
def test_environment_light_of_a_scene_replaces_the_default_ambient_on_shadow_catchers(pipeline: ls.Pipeline) -> None:
    """The shadow ratio is the unblocked fraction of the environment over the sum of environment and sun."""
    environment = ls.LightEnvironment(color=(0.5, 0.6, 0.8), visible=False)
    frame = rendered(ls.Scene([floor(0.3)], [disc()], [SUN, environment]), below(), pipeline)
    given = np.pi * np.array(environment.color)
    expected = given * (1.0 - SHARE) / (given + SUN.intensity * np.array(SUN.color))
    assert frame.shadow_ratio is not None
    np.testing.assert_allclose(frame.shadow_ratio.mean(axis=(0, 1)), expected, rtol=0.05)


def test_real_time_objects_block_ambient_light_on_a_shadow_catcher_that_captures_alone_light() -> None:
    """Below a disc the ratio is the visible fraction of directions, though the scene has no light."""
    frame = rendered(ls.Scene([floor(0.3)], [disc()]), below(), ls.Pipeline.REALTIME)
    assert frame.shadow_ratio is not None
    np.testing.assert_allclose(frame.shadow_ratio.mean(), 1.0 - SHARE, rtol=0.02)


@PIPELINES
def test_shadow_catcher_keeps_captured_light_that_scene_lights_cannot_explain(pipeline: ls.Pipeline) -> None:
    """A floor reflects no more than it receives, so that light missing from the scene must exist, and remains."""
    dim = replace(SUN, color=(1, 1, 1), intensity=0.2)
    frame = rendered(ls.Scene([floor(0.9, ambient=0.0)], [disc()], [dim]), below(), pipeline)
    received = np.pi * decode_srgb(np.float32(0.9))
    assert frame.shadow_ratio is not None
    np.testing.assert_allclose(frame.shadow_ratio.mean(), 1.0 - 0.2 / received, rtol=0.02)


def view() -> ls.Camera:
    """Returns a camera that sees a ball on the floor and its shadow."""
    return ls.Camera.look_at((1.2, 1.4, 2.2), (0.3, 0.1, 0), (0, 1, 0), width=96, height=72, fov_y=0.7)


def ball() -> ls.MeshInstance:
    """Returns a red ball on the floor."""
    material = ls.MaterialPbr(base_color=(0.7, 0.1, 0.1), roughness=0.6)
    return ls.MeshInstance(replace(sphere(0.4), material=material), position=(0.0, 0.4, 0.0))


def channels(path: Path, name: str, letters: str) -> npt.NDArray[np.float64]:
    """Returns some channels of a layer, as read by OpenEXR's reference library."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = file.channels()
        return np.stack([found[f"{name}{letter}"].pixels for letter in letters], axis=-1).astype(np.float64)


@PIPELINES
def test_exr_layers_matte_and_ratio_composited_over_the_photograph_equal_the_frame(
    pipeline: ls.Pipeline, tmp_path: Path
) -> None:
    """``matte`` over the plate equals the frame; where only the capture shows, plate times ``ratio`` does, too."""
    sun = replace(SUN, direction=(0.7, -1.0, -0.3))
    captured = replace(floor(0.6), gaussians=replace(floor().gaussians, sh=_checkered(floor().gaussians)))
    scene = ls.Scene([captured], [ball()], [sun])
    samples = {"jitter": False} | ({} if pipeline is ls.Pipeline.REALTIME else {"samples": 16})
    frame = rendered(scene, view(), pipeline, **samples)
    frame.save(tmp_path / "lit.exr")
    unlit = ls.Pipeline.RASTER if pipeline in (ls.Pipeline.HYBRID, ls.Pipeline.REALTIME) else pipeline
    config = ls.RenderConfig(pipeline=unlit, lighting=False, background=None)
    ls.render(ls.Scene(scene.splats), view(), config, device="cpu").save(tmp_path / "plate.exr")
    plate = channels(tmp_path / "plate.exr", "", "RGB")
    image, alpha = channels(tmp_path / "lit.exr", "", "RGB"), channels(tmp_path / "plate.exr", "", "A")
    ratio, matte = (
        channels(tmp_path / "lit.exr", "shadow_ratio.", "RGB"),
        channels(tmp_path / "lit.exr", "shadow_matte.", "RGBA"),
    )
    whole = alpha[..., 0] > 0.999
    beside = whole & (frame.instance_index == 0) & _far_from(frame.instance_index == 1)
    assert beside.sum() > 1000 and (ratio[beside] < 0.7).sum() > 100
    np.testing.assert_allclose((plate * ratio)[beside], image[beside], rtol=2e-3, atol=1e-4)
    over = matte[..., :3] + (1.0 - matte[..., 3:]) * plate
    away = whole & (beside | _far_from(frame.instance_index != 1))
    assert (away & ~beside).sum() > 300
    np.testing.assert_allclose(over[away], image[away], rtol=2e-3, atol=1e-3)
    assert np.abs(over - image)[whole].mean() < 4e-3  # edges, too
    untouched = beside & (ratio == 1.0).all(axis=2)
    np.testing.assert_array_equal(matte[untouched], 0.0)


@pytest.mark.parametrize(
    "pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID, ls.Pipeline.TRACE], ids=lambda one: one.value
)
def test_exr_light_layers_of_a_frame_with_shadow_catchers_add_up_to_the_frame(
    pipeline: ls.Pipeline, tmp_path: Path
) -> None:
    """Emission, direct light times shadow, and reflection are read by OpenEXR and sum to the frame."""
    sun = replace(SUN, direction=(0.7, -1.0, -0.3), name="sun")
    lights = [sun, ls.LightPoint((-1, 1.5, 1), intensity=4.0, name="bulb")]
    captured = replace(floor(0.6), gaussians=replace(floor().gaussians, sh=_checkered(floor().gaussians)))
    aovs = ("emission", "reflection", "lights", "shadow_ratio")
    frame = rendered(ls.Scene([captured], [ball()], lights), view(), pipeline, aovs=aovs, samples=1, jitter=False)
    frame.save(tmp_path / "lit.exr")
    layers = {
        name: channels(tmp_path / "lit.exr", f"{name}.", "RGB")
        for name in (
            *("emission", "reflection", "light.sun.direct", "light.sun.shadow"),
            *("light.bulb.direct", "light.bulb.shadow"),
        )
    }
    total = layers["emission"] + layers["reflection"]
    for light in ("sun", "bulb"):
        total += layers[f"light.{light}.direct"] * layers[f"light.{light}.shadow"]
    image = channels(tmp_path / "lit.exr", "", "RGB")
    assert frame.shadow_ratio is not None and (frame.shadow_ratio < 0.6).any()
    np.testing.assert_allclose(total, image, atol=1e-4)
    on_floor = frame.instance_index == 0
    assert layers["emission"].min() > -1e-5
    assert layers["light.sun.direct"][on_floor].mean() > 0.05
    assert layers["light.sun.shadow"][on_floor].min() < 0.01


def _checkered(gaussians: ls.Gaussians) -> npt.NDArray[np.float32]:
    """Returns SH coefficients of a floor of two greys, in squares one unit wide."""
    places = np.floor(gaussians.means[:, [0, 2]]).astype(int).sum(axis=1) % 2
    return np.where(places[:, None, None] == 0, -0.6, 0.8).repeat(3, axis=2).astype(np.float32)


def _far_from(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Returns the mask of pixels that have no pixel of ``mask`` within two pixels."""
    padded = np.pad(mask, 2)
    return np.logical_not(np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).any(axis=(2, 3)))


@pytest.mark.parametrize("pipeline", [ls.Pipeline.HYBRID, ls.Pipeline.TRACE], ids=["hybrid", "trace"])
def test_shadow_on_a_shadow_catcher_is_not_lighter_in_edge_pixels_of_objects(pipeline: ls.Pipeline) -> None:
    """In pixels at an edge, samples that hit the object do not lighten the shadow that the other samples find."""
    sun = replace(SUN, color=(1, 1, 1))
    below_all = replace(disc(), positions=disc().positions * np.array([4.0, 1.0, 4.0]))
    edge = replace(disc(), positions=disc().positions * np.array([0.2, 0.5, 0.2]) + np.array([0.1, 0.0, 0.0]))
    camera = ls.Camera.look_at((0.0, 0.35, 0.0), (0, 0, 0), (0, 0, 1), width=24, height=24, fov_y=0.5)
    scene = ls.Scene([floor(0.5, ambient=0.4)], [below_all, edge], [sun])
    frame = rendered(scene, camera, pipeline, samples=32, shadow_rays=ls.ShadowConfig())
    assert frame.shadow_ratio is not None and frame.captured_weight is not None
    mixed = (frame.captured_weight > 0.3) & (frame.captured_weight < 0.7)
    clear = frame.captured_weight > 0.99
    assert mixed.sum() > 5 and clear.sum() > 100
    assert frame.shadow_ratio[mixed].mean() < frame.shadow_ratio[clear].max()


def test_shadow_catcher_gains_or_loses_no_more_light_than_it_is_known_to_receive() -> None:
    """Given ambient light limits the light measured from captures; else measured light or the minimum counts."""
    one = dict.fromkeys(
        ("unshadowed", "change", "emitted_unshadowed", "emitted_change", "ambient", "blocked", "least"), np.zeros(1)
    )

    def change(**values: float) -> float:
        light = CatcherLight(**(one | {name: np.array([value]) for name, value in values.items()}))
        changed, received = light.change_and_received()
        return float(changed[0] / received[0])

    assert change(unshadowed=2.0, change=-2.0, ambient=1.0, blocked=0.5) == pytest.approx(-2.5 / 3.0)
    assert change(emitted_unshadowed=4.0, emitted_change=-1.0) == pytest.approx(-0.25)
    assert change(emitted_unshadowed=4.0, emitted_change=-1.0, least=8.0) == pytest.approx(-0.125)
    # Captures emit more than the given ambient light: their light counts only up to that amount.
    assert change(
        unshadowed=1.0, emitted_unshadowed=4.0, emitted_change=-2.0, ambient=1.0, blocked=0.7
    ) == pytest.approx(-0.25)
    # Captures emit less than the given ambient light: the rest comes equally from all directions.
    assert change(
        unshadowed=1.0, emitted_unshadowed=1.0, emitted_change=-1.0, ambient=2.0, blocked=1.0
    ) == pytest.approx(-1.5 / 3.0)


def floaters(depth: float = 0.12, seed: int = 5) -> ls.SplatInstance:
    """Returns a captured floor without a surface: semi-transparent floaters up to ``depth`` around y = 0."""
    random, count = np.random.default_rng(seed), 12000
    means = random.uniform((-0.8, -depth, -0.6), (0.8, depth, 0.6), (count, 3))
    wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
    sh = np.full((count, 1, 3), 0.4, np.float32)
    capture = ls.Gaussians(means, wxyz, np.full((count, 3), 0.008), random.uniform(0.3, 0.95, count), sh)
    return ls.SplatInstance(capture, shadow_catcher=True)


def shadow_of_a_disc(catcher: ls.SplatInstance, pipeline: ls.Pipeline) -> npt.NDArray[np.float32]:
    """Returns the shadow ratio, shape (H, W), of a disc in slanting sunlight on y = 0, seen from above."""
    sun = ls.LightDirectional((1.0, -1.0, 0.0), intensity=3.0)
    lid = replace(disc(), positions=disc().positions * np.array([0.6, 1.0, 0.6]) + np.array([-0.8, 0.4, 0.0]))
    camera = ls.Camera.look_at((0, 3.0, 0.01), (0, 0, 0), (0, 0, -1), width=160, height=120, fov_y=0.3)
    frame = rendered(ls.Scene([catcher], [lid], [sun]), camera, pipeline)
    assert frame.shadow_ratio is not None
    return frame.shadow_ratio.mean(axis=2)


def sharp_steps(ratio: npt.NDArray[np.float32]) -> int:
    """Returns the number of pixels whose ratio differs from the right neighbour's by half of the shadow's depth."""
    return int((np.abs(np.diff(ratio, axis=1)) > 0.3).sum())


@pytest.mark.parametrize(
    "pipeline", [ls.Pipeline.RASTER, ls.Pipeline.TRACE, ls.Pipeline.PATH], ids=lambda one: one.value
)
def test_shadow_on_a_shadow_catcher_of_scattered_floaters_is_smoothed(pipeline: ls.Pipeline) -> None:
    """Shadows on single floaters lie apart; the frame shows their mean, dark in the middle and unshadowed far away."""
    ratio = shadow_of_a_disc(floaters(), pipeline)
    assert sharp_steps(ratio) < 20
    assert ratio[50:70, 70:90].max() < 0.5
    assert ratio[:, 130:].min() > 0.85


def test_hard_shadow_on_an_opaque_shadow_catcher_keeps_sharp_edges() -> None:
    """Pixels at the edge are fully lit or fully shadowed, without smoothing."""
    ratio = shadow_of_a_disc(floor(0.6), ls.Pipeline.HYBRID)
    rows = (ratio < 0.6).any(axis=1).sum()
    assert rows > 70 and sharp_steps(ratio) >= 2 * rows - 4


def test_smoothed_shadows_on_shadow_catchers_do_not_depend_on_the_schedule() -> None:
    """Bits are equal for any number of threads and for graphs; CUDA's schedule rounds differently."""
    camera = ls.Camera.look_at((0, 3.0, 0.01), (0, 0, 0), (0, 0, -1), width=80, height=60, fov_y=0.3)
    lid = replace(disc(), positions=disc().positions * np.array([0.6, 1.0, 0.6]))
    scene = ls.Scene([floaters()], [lid], [ls.LightDirectional((0.5, -1.0, 0.0), intensity=3.0)])
    config = ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, aovs=("emission", "lights", "shadow_ratio"))
    frames = [ls.create_renderer(config, "cpu", threads=threads).render(scene, camera).arrays() for threads in (1, 3)]
    frames += [renderer_of(backend, config).render(scene, camera).arrays() for backend in BACKENDS[1:]]
    mixed = (frames[0]["shadow_ratio"] > 0.5) & (frames[0]["shadow_ratio"] < 0.8)
    assert mixed.sum() > 100
    for name in ("color", "shadow_ratio", "emission", "light_direct"):
        np.testing.assert_array_equal(frames[1][name], frames[0][name], name)
        for frame in frames[2:]:
            np.testing.assert_allclose(frame[name], frames[0][name], atol=2e-6, err_msg=name)
