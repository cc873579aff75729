"""The capture gain scales captured light on objects, and its estimate exposes an object like the capture around it."""

from __future__ import annotations

import numpy as np
import pytest

import lumisplat as ls
from support.scenes.path_scenes import ball, diffuse

SH_C0 = 0.28209479177387814


def shell(color: float, *, half: bool = False) -> ls.SplatInstance:
    """Returns a captured sphere of one grey display value around the origin; ``half`` returns its lower half."""
    gaussians = ls.gaussians_from_mesh(ball(3.0, diffuse(0.5), hollow=True, rows=32), 6000)
    selected = gaussians.means[:, 1] < (0.0 if half else 9.0)
    sh = np.full((int(selected.sum()), 1, 3), (color - 0.5) / SH_C0, np.float32)
    names = ("means", "rotations_wxyz", "scales", "opacities")
    values = {name: getattr(gaussians, name)[selected] for name in names}
    return ls.SplatInstance(ls.Gaussians(**values, sh=sh))


def centre_radiance(pipeline: ls.Pipeline, gain: float, material: ls.MaterialPbr, samples: int = 64) -> np.ndarray:
    """Returns the linear radiance of the image centre, which shows a ball inside the captured grey sphere."""
    scene = ls.Scene([shell(0.5)], [ball(0.5, material, rows=24)])
    camera = ls.Camera.look_at((0, 0, -2), (0, 0, 0), (0, -1, 0), width=16, height=16, fov_y=0.2)
    frames = 32 if pipeline is ls.Pipeline.REALTIME else 1
    given = None if pipeline is ls.Pipeline.REALTIME else samples
    renderer = ls.create_renderer(
        ls.RenderConfig(pipeline=pipeline, capture_gain=gain, samples=given), "cpu", threads=2
    )
    return [renderer.render(scene, camera) for _ in range(frames)][-1].color.mean(axis=(0, 1))


@pytest.mark.parametrize("pipeline", [ls.Pipeline.PATH, ls.Pipeline.REALTIME], ids=["path", "realtime"])
def test_one_stop_of_capture_gain_doubles_captured_light_on_objects(pipeline: ls.Pipeline) -> None:
    """A diffuse ball becomes twice as bright; a mirror shows the capture unchanged, whatever the gain."""
    plain, doubled = (centre_radiance(pipeline, gain, diffuse(0.4)) for gain in (0.0, 1.0))
    np.testing.assert_allclose(doubled / plain, 2.0, rtol=0.03)
    chrome = ls.MaterialPbr(base_color=(1, 1, 1), metallic=1.0, roughness=0.0)
    mirrored = [centre_radiance(pipeline, gain, chrome, 4) for gain in (0.0, 3.0)]
    np.testing.assert_allclose(mirrored[0], mirrored[1], rtol=1e-5)


def test_capture_gain_on_rough_metal_is_equal_in_hybrid_and_path() -> None:
    """Two stops make a rough metal ball four times as bright, and both pipelines show equal radiance."""
    metal = ls.MaterialPbr(base_color=(0.8, 0.6, 0.4), metallic=1.0, roughness=0.4)
    light = ls.LightPoint((0, 0, 2.5), intensity=1e-6)  # hybrid frames without any light are unlit
    camera = ls.Camera.look_at((0, 0, -2), (0, 0, 0), (0, -1, 0), width=16, height=16, fov_y=0.2)
    scene = ls.Scene([shell(0.5)], [ball(0.5, metal, rows=24)], [light])
    found = {
        (pipeline, gain): ls.render(
            scene, camera, ls.RenderConfig(pipeline=pipeline, capture_gain=gain, samples=32), device="cpu"
        ).color.mean(axis=(0, 1))
        for pipeline in (ls.Pipeline.HYBRID, ls.Pipeline.PATH)
        for gain in (0.0, 2.0)
    }
    for pipeline in (ls.Pipeline.HYBRID, ls.Pipeline.PATH):
        np.testing.assert_allclose(found[pipeline, 2.0] / found[pipeline, 0.0], 4.0, rtol=0.02)
    np.testing.assert_allclose(found[ls.Pipeline.HYBRID, 0.0], found[ls.Pipeline.PATH, 0.0], rtol=0.05)


def test_estimated_capture_gain_makes_an_object_as_bright_as_the_capture_around_it() -> None:
    """The gain is one stop inside a captured sphere, and two stops inside half a sphere."""
    inner_ball = ball(0.3, diffuse(0.5), rows=16)
    assert ls.avatars.estimate_capture_gain(ls.Scene([shell(0.5)], [inner_ball]), device="cpu") == pytest.approx(
        1.0, abs=0.11
    )
    assert ls.avatars.estimate_capture_gain(ls.Scene([shell(0.3)], [inner_ball]), device="cpu") == pytest.approx(
        1.0, abs=0.11
    )
    half = ls.Scene([shell(0.5, half=True)], [inner_ball])
    assert ls.avatars.estimate_capture_gain(half, device="cpu") == pytest.approx(2.0, abs=0.11)
    gain = ls.avatars.estimate_capture_gain(ls.Scene([shell(0.5)]), (0.5, 0.0, 0.2), "cpu")
    lit = centre_radiance(ls.Pipeline.PATH, gain, diffuse(0.5))
    np.testing.assert_allclose(lit, ((0.5 + 0.055) / 1.055) ** 2.4, rtol=0.1)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (ls.Scene([], [ball(0.3, diffuse(0.5), rows=8)]), "no unlit capture"),
        (ls.Scene([shell(0.5)]), "give the position"),
    ],
)
def test_estimate_capture_gain_refuses_scenes_without_an_unlit_capture_or_position(
    scene: ls.Scene, message: str
) -> None:
    """A scene without an unlit capture, or without an object and a position, is refused."""
    with pytest.raises(ls.SceneError, match=message):
        ls.avatars.estimate_capture_gain(scene, device="cpu")
