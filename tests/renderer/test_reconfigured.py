"""Renderers whose settings change: frames equal those of a new renderer, and assets stay on the device."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.raster_scenes import front_camera, random_gaussians

LIT = ls.Scene(
    [ls.SplatInstance(random_gaussians(1, count=200), material=ls.MaterialPbr())],
    [
        ls.MeshInstance(ls.box(0.5), position=(0.3, 0.0, 4.0)),
        ls.MeshInstance(replace(ls.box(0.3), material=ls.MaterialPbr(emissive=(3, 2, 1))), position=(-0.6, 0, 3.5)),
    ],
    [ls.LightPoint((0.0, -2.0, 1.0), intensity=9.0, radius=0.2), ls.LightEnvironment(intensity=0.3)],
)
CAMERA = front_camera(width=96, height=64)
BASE = ls.RenderConfig(samples=2)
IMAGES = ("color", "alpha", "depth", "normal", "gaussian_index", "instance_index")

SETTINGS: dict[str, dict[str, Any]] = {
    "raster": {},
    "tone map": {"tone_map": ls.ToneMap.NEUTRAL},
    "hybrid": {"pipeline": ls.Pipeline.HYBRID, "shadows": ls.Shadows.SOFT},
    "another seed": {"pipeline": ls.Pipeline.HYBRID, "shadows": ls.Shadows.SOFT, "seed": 5},
    "smaller bounds": {"pipeline": ls.Pipeline.TRACE, "response": ls.config.ResponseConfig(min_response=0.3)},
    "trace": {"pipeline": ls.Pipeline.TRACE},
    "linear kernels": {"pipeline": ls.Pipeline.TRACE, "response": ls.config.ResponseConfig(kernel_degree=0)},
    "paths": {"pipeline": ls.Pipeline.PATH},
    "transparent": {"pipeline": ls.Pipeline.PATH, "background": None, "jitter": False},
    "real time": {"pipeline": ls.Pipeline.REALTIME, "samples": None},
    "real time, finer": {
        "pipeline": ls.Pipeline.REALTIME,
        "samples": None,
        "realtime": ls.RealtimeConfig(quality=ls.config.RealtimeQuality.HIGH),
    },
    "unlit": {"lighting": False, "samples": None},
    "unscented": {"raster": ls.RasterConfig(projection=ls.config.Projection.UNSCENTED)},
}


def images_of(renderer: ls.Renderer) -> list[np.ndarray]:
    """Returns all images of the second frame, which depends on the first in real time."""
    renderer.render(LIT, CAMERA)
    frame = renderer.render(LIT, CAMERA)
    return [np.array(getattr(frame, name)) for name in IMAGES]


def test_frame_of_a_reconfigured_renderer_equals_that_of_a_new_renderer() -> None:
    """The bits are equal, there and back through settings of all pipelines."""
    renderer = ls.create_renderer(BASE, "cpu")
    expected: dict[str, list[np.ndarray]] = {}
    for name in [*SETTINGS, *reversed(SETTINGS)]:
        config = replace(BASE, **SETTINGS[name])
        renderer.reconfigure(config)
        assert renderer.config == config
        if name not in expected:
            expected[name] = images_of(ls.create_renderer(config, "cpu"))
        for image, of_new, what in zip(images_of(renderer), expected[name], IMAGES, strict=True):
            np.testing.assert_array_equal(image, of_new, f"{name}: {what}")


def test_reconfiguring_a_renderer_uploads_and_builds_nothing() -> None:
    """Gaussians, meshes and their BVHs are reused, except for BVHs whose bounds change."""
    renderer = ls.create_renderer(replace(BASE, pipeline=ls.Pipeline.HYBRID), "cpu")
    renderer.render(LIT, CAMERA)
    scene = renderer._scene
    assets, tree, faces, triangles = scene.assets[0].data, scene.bvh.cached[0].bvh, scene._meshes.data, scene._mesh_bvh
    renderer.reconfigure(replace(BASE, pipeline=ls.Pipeline.PATH, seed=3))
    renderer.render(LIT, CAMERA)
    scene = renderer._scene
    assert scene.assets[0].data is assets and scene.bvh.cached[0].bvh is tree
    assert scene._meshes.data is faces and scene._mesh_bvh is triangles
    renderer.reconfigure(replace(BASE, pipeline=ls.Pipeline.PATH, response=ls.config.ResponseConfig(min_response=0.3)))
    renderer.render(LIT, CAMERA)
    assert renderer._scene.bvh.cached[0].bvh is not tree


def test_reconfiguring_a_renderer_frees_buffers_of_the_old_settings() -> None:
    """Buffers of a real-time sequence are many times those of a rasterised frame."""
    renderer = ls.create_renderer(BASE, "cpu")
    renderer.render(LIT, CAMERA)
    small = renderer._buffers.bytes
    renderer.reconfigure(replace(BASE, pipeline=ls.Pipeline.REALTIME, samples=None))
    renderer.render(LIT, CAMERA)
    assert renderer._buffers.bytes > 5 * small
    renderer.reconfigure(BASE)
    renderer.render(LIT, CAMERA)
    assert renderer._buffers.bytes == small


def test_reconfiguring_a_renderer_with_refused_settings_leaves_it_unchanged() -> None:
    """No part of refused settings is applied."""
    renderer = ls.create_renderer(BASE, "cpu")
    before = images_of(renderer)
    with pytest.raises(ls.ConfigError):
        renderer.reconfigure("hybrid")  # pyright: ignore[reportArgumentType]
    assert renderer.config == BASE
    for image, same in zip(images_of(renderer), before, strict=True):
        np.testing.assert_array_equal(image, same)


def test_reconfiguring_a_differentiable_renderer_updates_its_gradients() -> None:
    """Gradients equal those of a new renderer; settings without gradients are refused and change nothing."""
    scene = ls.Scene([random_gaussians(1, count=60)])
    raster, trace = (ls.RenderConfig(pipeline=pipeline) for pipeline in (ls.Pipeline.RASTER, ls.Pipeline.TRACE))
    given = np.ones((CAMERA.height, CAMERA.width, 3))
    renderer = ls.DifferentiableRenderer(raster, "cpu")
    renderer.render(scene, CAMERA)
    renderer.reconfigure(trace)
    with pytest.raises(ls.ConfigError, match="render a frame first"):
        renderer.gradients(given)
    fresh = ls.DifferentiableRenderer(trace, "cpu")
    found = []
    for one in (renderer, fresh):
        one.render(scene, CAMERA)
        found.append(one.gradients(given))
    np.testing.assert_array_equal(found[0].sets[0].means, found[1].sets[0].means)
    with pytest.raises(ls.ConfigError):
        renderer.reconfigure(ls.RenderConfig(pipeline=ls.Pipeline.PATH))
    assert renderer.config.pipeline is ls.Pipeline.TRACE


@pytest.mark.parametrize("pipeline", ["raster", "hybrid", "path"])
def test_another_tone_map_or_exposure_is_applied_to_a_frame_without_new_samples(pipeline: str) -> None:
    """The last frame gets another tone map and exposure, from the film on the device or from the frame's arrays."""
    config = replace(BASE, pipeline=ls.Pipeline(pipeline))
    shown = replace(config, tone_map=ls.ToneMap.AGX)
    expected = ls.create_renderer(shown, "cpu").render(LIT, replace(CAMERA, exposure=1.0), encode=True)
    renderer = ls.create_renderer(config, "cpu")
    first = renderer.render(LIT, CAMERA, encode=True)
    renderer.reconfigure(shown)
    by_device = renderer.develop(first, 1.0, encode=True)
    np.testing.assert_array_equal(np.asarray(by_device, np.uint8), np.asarray(expected, np.uint8))
    added = renderer.render(LIT, by_device.camera, resume=by_device)
    assert added.samples == 4
    by_host = renderer.develop(first, 1.0)  # from the frame's arrays: the film holds the samples of another frame
    np.testing.assert_array_equal(by_host.pixels_srgb(), expected.pixels_srgb())
    of_four = ls.create_renderer(replace(shown, samples=4), "cpu").render(LIT, by_device.camera)
    np.testing.assert_array_equal(added.color, of_four.color)


def test_changing_the_tone_map_keeps_the_history_of_a_realtime_sequence() -> None:
    """The next frame has the bits of a sequence whose tone map was never changed."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)
    changed, same = (ls.create_renderer(config, "cpu") for _ in range(2))
    for renderer in (changed, same):
        renderer.render(LIT, CAMERA)
    changed.reconfigure(replace(config, tone_map=ls.ToneMap.NEUTRAL))
    np.testing.assert_array_equal(changed.render(LIT, CAMERA).color, same.render(LIT, CAMERA).color)


def test_frame_with_shadow_catcher_meshes_is_tone_mapped_from_its_images_not_the_film() -> None:
    """The film does not contain the shadows on mesh catchers."""
    catcher = ls.MeshInstance(ls.box(4.0), position=(0.0, 3.0, 4.0), shadow_catcher=True)
    scene = replace(LIT, meshes=(*LIT.meshes, catcher))
    renderer = ls.create_renderer(BASE, "cpu")
    frame = renderer.render(scene, CAMERA)
    np.testing.assert_array_equal(renderer.develop(frame).color, frame.color)
