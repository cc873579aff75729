"""Frames that are stopped at any time do not change later frames."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import OPAQUE_BLOCK
from support.scenes.raster_scenes import front_camera, random_gaussians

LIT = ls.Scene(
    [ls.SplatInstance(random_gaussians(1, count=200), material=ls.MaterialPbr())],
    [ls.MeshInstance(ls.box(0.5), position=(0.3, 0.0, 4.0))],
    [ls.LightPoint((0.0, -2.0, 1.0), intensity=9.0, radius=0.2), ls.LightEnvironment(intensity=0.3)],
)
CAMERA = front_camera(width=96, height=64)


def after(count: int) -> Callable[[], bool]:
    """Returns a stop function that returns True from the given call on."""
    asked = itertools.count(1)
    return lambda: next(asked) >= count


def renderer(pipeline: ls.Pipeline) -> ls.Renderer:
    """Returns a renderer with soft shadows on two threads, so that work is split into ranges."""
    config = ls.RenderConfig(pipeline=pipeline, shadows=ls.Shadows.SOFT, samples=2)
    return ls.create_renderer(config, "cpu", threads=2)


@pytest.mark.parametrize("pipeline", [ls.Pipeline.RASTER, ls.Pipeline.HYBRID, ls.Pipeline.TRACE, ls.Pipeline.PATH])
def test_frame_stopped_at_any_moment_does_not_change_later_frames(pipeline: ls.Pipeline) -> None:
    """Wherever a frame was stopped, the next frame and a resumed frame have the bits of a new renderer."""
    expected = renderer(pipeline).render(LIT, CAMERA)
    for count in (1, 2, 7, 30, 90):
        used = renderer(pipeline)
        with pytest.raises(ls.errors.StoppedError):
            used.render(LIT, CAMERA, stop=after(count))
        np.testing.assert_array_equal(used.render(LIT, CAMERA).color, expected.color)
    with pytest.raises(ls.errors.StoppedError):
        used.render(LIT, CAMERA, resume=expected, stop=after(20))
    again = renderer(pipeline).render(LIT, CAMERA, resume=expected)
    np.testing.assert_array_equal(used.render(LIT, CAMERA, resume=expected).color, again.color)


def test_unlit_raster_frame_stopped_at_any_moment_does_not_change_later_frames() -> None:
    """Such frames skip samples and film; the viewer stops them, too, when a camera that has paused moves on."""
    unlit = ls.Scene([random_gaussians(1, count=200)], LIT.meshes)
    expected = ls.create_renderer(device="cpu", threads=2).render(unlit, CAMERA)
    for count in (1, 2, 7, 20):
        used = ls.create_renderer(device="cpu", threads=2)
        with pytest.raises(ls.errors.StoppedError):
            used.render(unlit, CAMERA, stop=after(count))
        np.testing.assert_array_equal(used.render(unlit, CAMERA).color, expected.color)


def test_frame_is_complete_if_the_stop_function_returns_false() -> None:
    """The stop function is called many times during the frame."""
    asked: list[bool] = []
    frame = renderer(ls.Pipeline.HYBRID).render(LIT, CAMERA, stop=lambda: bool(asked.append(True)))
    assert len(asked) > 20
    np.testing.assert_array_equal(frame.color, renderer(ls.Pipeline.HYBRID).render(LIT, CAMERA).color)


def test_path_frame_of_meshes_can_be_stopped_within_a_sample_on_one_thread() -> None:
    """One kernel follows all paths of a sample; its launch is cut into bands, and the frame may stop after each."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=1)
    asked: list[bool] = []
    ls.create_renderer(config, "cpu", threads=1).render(
        ls.Scene(meshes=LIT.meshes, lights=LIT.lights), CAMERA, stop=lambda: bool(asked.append(True))
    )
    assert len(asked) > 2 * CAMERA.width * CAMERA.height // OPAQUE_BLOCK


def test_realtime_frames_ignore_the_stop_function() -> None:
    """Real-time frames depend on one another and are always finished."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME)
    frames = [ls.create_renderer(config, "cpu").render(LIT, CAMERA, stop=stop) for stop in (None, lambda: True)]
    np.testing.assert_array_equal(frames[0].color, frames[1].color)
