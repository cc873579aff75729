"""One scene in all pipelines, region by region: objects and a sun on a captured floor."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from support.scenes.path_scenes import diffuse

MATERIALS = {
    "matte": ls.MaterialPbr(base_color=(0.2, 0.16, 0.12), roughness=1.0, specular=0.0),
    "rough metal": ls.MaterialPbr(base_color=(0.9, 0.7, 0.3), metallic=1.0, roughness=0.3),
    "mirror": ls.MaterialPbr(base_color=(0.9, 0.9, 0.9), metallic=1.0, roughness=0.0),
    "glass": ls.MaterialPbr(base_color=(1.0, 1.0, 1.0), transmission=1.0, roughness=0.0),
}
CAMERA = ls.Camera.look_at((0, 1.6, 4.2), (0, 0.2, 0), (0, 1, 0), width=192, height=96, fov_y=0.5)


def floor(level: float, *, catches: bool) -> ls.SplatInstance:
    """Returns a level sheet at y = 0, 8 units wide, that emits a captured grey."""
    plane = ls.Mesh([[-4, 0, 4], [4, 0, 4], [4, 0, -4], [-4, 0, -4]], [[0, 1, 2], [0, 2, 3]])
    sheet = ls.gaussians_from_mesh(plane, 6000)
    sh = np.full((6000, 1, 3), (level - 0.5) / 0.28209479177387814, np.float32)
    sheet = replace(sheet, sh=sh, albedo=None, roughness=None, metallic=None)
    return ls.SplatInstance(sheet, shadow_catcher=catches)


@cache
def scene(level: float, *, catches: bool) -> ls.Scene:
    """Returns four balls on the floor, in sunlight from the upper left."""
    balls = [
        ls.MeshInstance(replace(sphere(0.35, rows=48, columns=96), material=material), position=(x, 0.35, 0.0))
        for x, material in zip((-1.7, -0.45, 0.45, 1.35), MATERIALS.values(), strict=True)
    ]
    return ls.Scene([floor(level, catches=catches)], balls, [ls.LightDirectional((0.4, -1, -0.5), intensity=3.0)])


def within(mask: npt.NDArray[np.bool_], reach: int = 2) -> npt.NDArray[np.bool_]:
    """Returns the pixels of a mask that are farther than ``reach`` from all other pixels."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(~mask, reach), (2 * reach + 1, 2 * reach + 1))
    return np.logical_not(around.any(axis=(2, 3)))


@cache
def rendered(pipeline: ls.Pipeline, level: float, *, catches: bool, lights_only: bool = False) -> ls.Frame:
    """Renders with the pipeline's defaults, or without bounces and captured light; in real time, a late frame."""
    config = ls.RenderConfig(pipeline=pipeline, aovs=("shadow_ratio",))
    if lights_only:
        config = replace(config, max_bounces=0, capture_gain=-16.0)
    renderer = ls.create_renderer(config, "cpu", threads=2)
    for _ in range(23 if pipeline is ls.Pipeline.REALTIME else 0):
        renderer.render(scene(level, catches=catches), CAMERA)
    return renderer.render(scene(level, catches=catches), CAMERA)


@pytest.fixture(scope="module")
def dark() -> dict[ls.Pipeline, ls.Frame]:
    """Returns frames of objects so dark that bounced light, which only paths and real time trace, is small."""
    return {pipeline: rendered(pipeline, 0.2, catches=True) for pipeline in ls.Pipeline}


def test_diffuse_ball_and_its_shadow_are_equally_bright_in_all_five_pipelines(
    dark: dict[ls.Pipeline, ls.Frame],
) -> None:
    """The lit side of the ball, and the floor in full shadow, half shadow and light agree within 5 %."""
    truth = dark[ls.Pipeline.PATH]
    assert truth.shadow_ratio is not None
    on_floor = within(truth.instance_index == 0)
    under_matte = on_floor & (truth.position[..., 0] < -1.0)
    darkness = truth.shadow_ratio.mean(axis=2)
    regions = {
        "ball": within(truth.instance_index == 1) & (truth.normal[..., 1] > 0.3),
        "shadow": within(under_matte & (darkness < 0.35), 1),
        "near": under_matte & (darkness > 0.8) & (darkness < 0.97),
        "free": under_matte & (darkness > 0.97),
    }
    for name, region in regions.items():
        assert region.sum() > 10, name
        means = {pipeline.value: round(float(frame.color[region].mean()), 5) for pipeline, frame in dark.items()}
        assert max(means.values()) / min(means.values()) < 1.05, (name, means)


@pytest.mark.deep
def test_direct_light_on_a_bright_floor_is_equal_in_all_five_pipelines() -> None:
    """Without bounces and captured light, the lit side of a ball, its shadow and the lit floor agree within 5 %."""
    frames = {pipeline: rendered(pipeline, 0.75, catches=True, lights_only=True) for pipeline in ls.Pipeline}
    truth = frames[ls.Pipeline.HYBRID]
    assert truth.shadow_ratio is not None
    darkness = truth.shadow_ratio.mean(axis=2)
    under_matte = within(truth.instance_index == 0) & (truth.position[..., 0] < -1.0)
    regions = {
        "ball": within(truth.instance_index == 1) & (truth.normal[..., 1] > 0.3),
        "shadow": within(under_matte & (darkness < 0.6), 1),
        "free": under_matte & (darkness > 0.97),
    }
    for name, region in regions.items():
        assert region.sum() > 10, name
        means = {pipeline.value: round(float(frame.color[region].mean()), 5) for pipeline, frame in frames.items()}
        assert max(means.values()) / min(means.values()) < 1.05, (name, means)


def test_bounced_light_is_equal_in_all_pipelines_that_trace_bounces() -> None:
    """A matte ball that a bright floor lights from below agrees within 5 %."""
    with_bounces = [rendered(pipeline, 0.75, catches=True) for pipeline in (ls.Pipeline.PATH, ls.Pipeline.REALTIME)]
    without = rendered(ls.Pipeline.HYBRID, 0.75, catches=True)
    ball = within(without.instance_index == 1)
    path, realtime = (float(frame.color[ball].mean()) for frame in with_bounces)
    assert realtime == pytest.approx(path, rel=0.05)
    below = ball & (without.normal[..., 1] < -0.2)
    assert with_bounces[0].color[below].mean() > 3.0 * without.color[below].mean()


@pytest.mark.parametrize("number", [2, 3, 4], ids=["rough metal", "mirror", "glass"])
def test_reflections_are_equal_in_all_pipelines_that_trace_rays(number: int) -> None:
    """With default settings, reflections of a capture that catches no shadows agree within 5 %.

    Real-time mirrors are left out: they show rough metals without their reflections.
    """
    left_out = {ls.Pipeline.RASTER} | ({ls.Pipeline.REALTIME} if number == 3 else set())
    followed = [one for one in ls.Pipeline if one not in left_out]
    frames = {pipeline: rendered(pipeline, 0.5, catches=False) for pipeline in followed}
    region = within(frames[ls.Pipeline.TRACE].instance_index == number)
    means = {pipeline: float(frame.color[region].mean()) for pipeline, frame in frames.items()}
    assert region.sum() > 200
    assert max(means.values()) / min(means.values()) < 1.05, means


@pytest.mark.parametrize(
    "pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID, ls.Pipeline.PATH], ids=lambda one: one.value
)
def test_frames_of_default_samples_antialias_meshes_and_leave_captures_unchanged(pipeline: ls.Pipeline) -> None:
    """Edges of a ball have intermediate values; pixels that show only the capture have the bits of the unlit frame."""
    environment = ls.LightEnvironment(color=(0.3, 0.3, 0.3), visible=False)
    lit = ls.Scene([floor(0.8, catches=False)], [replace(sphere(0.5, rows=32), material=diffuse(0.02))], [environment])
    camera = CAMERA.scaled(240)
    frame = ls.render(lit, camera, ls.RenderConfig(pipeline=pipeline), device="cpu")
    unlit = ls.Pipeline.RASTER if pipeline is ls.Pipeline.HYBRID else ls.Pipeline.TRACE
    config = ls.RenderConfig(pipeline=unlit, lighting=False)
    plain = ls.render(ls.Scene(lit.splats), camera, config, device="cpu")
    assert frame.captured_weight is not None and frame.captured is not None
    mixed = (frame.captured_weight > 0.1) & (frame.captured_weight < 0.9)
    assert mixed.sum() > 20
    alone = within(frame.captured_weight == 1.0, 1)
    assert alone.sum() > 10000
    np.testing.assert_array_equal(frame.captured[alone], plain.color[alone])
