"""Default numbers of samples per pixel, and warnings about too few samples."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.cli.commands import demo
from lumisplat.demo.shapes import icosphere
from lumisplat.renderer.scene.frame_plan import SAMPLES_OF_ENVIRONMENT_ON_SPLATS, SAMPLES_OF_RANDOM_LIGHT, FramePlan
from support.scenes.pipelines import DIRECT
from support.scenes.raster_scenes import front_camera, random_gaussians

SUN = ls.LightDirectional((0.2, 0.3, 1.0), intensity=3.0)
SOFT_SUN = replace(SUN, angle=0.1)
ENVIRONMENT = ls.LightEnvironment()
MANY, SOME = SAMPLES_OF_RANDOM_LIGHT, SAMPLES_OF_ENVIRONMENT_ON_SPLATS


def ball(radius: float) -> ls.MeshInstance:
    """Returns a ball in front of the camera."""
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return ls.MeshInstance(icosphere(radius), pose)


def scene(*lights: Any, **capture: Any) -> ls.Scene:
    """Returns a capture and a ball, or only the capture if arguments describe it."""
    splats = [ls.SplatInstance(random_gaussians(3, count=60), **capture)]
    return ls.Scene(splats, () if capture else [ball(0.4)], lights)


@pytest.mark.parametrize(
    ("content", "settings", "samples"),
    [
        (scene(), {}, 1),
        (scene(SUN), {}, 1),
        (scene(SOFT_SUN), {}, 1),
        (scene(SUN), {"shadows": ls.Shadows.SOFT}, 1),
        (scene(SOFT_SUN), {"shadows": ls.Shadows.SOFT}, MANY),
        (scene(ls.LightPoint((0, 0, 0), radius=0.1)), {"shadows": ls.Shadows.SOFT}, MANY),
        (scene(ls.LightSphere((0, 0, 0), 0.1)), {"shadows": ls.Shadows.SOFT}, MANY),
        (scene(ls.LightRect((0, 0, 0), (1, 0, 0), (0, 1, 0))), {"shadows": ls.Shadows.SOFT}, MANY),
        (scene(ENVIRONMENT), {}, MANY),
        (scene(ENVIRONMENT), {"shadows": ls.Shadows.OFF}, MANY),
        (scene(ENVIRONMENT), {"lighting": False}, 1),
        (scene(replace(ENVIRONMENT, enabled=False)), {}, 1),
        (scene(ENVIRONMENT, material=ls.MaterialPbr()), {}, SOME),
        (scene(ENVIRONMENT, SOFT_SUN, material=ls.MaterialPbr()), {"shadows": ls.Shadows.SOFT}, MANY),
        (scene(ENVIRONMENT, sh_degree=0), {}, 1),
        (scene(ENVIRONMENT, shadow_catcher=True), {}, 1),
        (scene(ENVIRONMENT), {"samples": 3}, 3),
    ],
)
def test_default_sample_count_exceeds_1_only_if_surfaces_receive_randomly_sampled_light(
    content: ls.Scene, settings: dict[str, Any], samples: int
) -> None:
    """Environments, and lights with an extent under soft shadows, are sampled at random."""
    assert FramePlan.of(ls.RenderConfig(**settings), content).samples == samples


@pytest.mark.parametrize("pipeline", DIRECT)
def test_default_sample_count_leaves_no_black_pixels_in_a_room_with_a_window(
    pipeline: ls.Pipeline, caplog: pytest.LogCaptureFixture
) -> None:
    """With one sample, black pixels lie beside bright ones; with the default number, none are black."""
    image = np.full((16, 32, 3), 0.02, np.float32)
    image[5:9, 12:20] = 12.0
    lit = ls.Scene((), [ball(0.9)], [ls.LightEnvironment(image)])
    config = ls.RenderConfig(pipeline=pipeline, background=(0.0, 0.0, 0.0))
    errors: dict[int | None, float] = {}
    smooth = ls.render(lit, front_camera(32, 24), replace(config, samples=256), device="cpu")
    inside = (smooth.instance_index == 0) & (smooth.color.max(axis=-1) > 0.1)
    for samples in (1, None):
        frame = ls.render(lit, front_camera(32, 24), replace(config, samples=samples), device="cpu")
        errors[samples] = float(np.sqrt(np.mean((frame.color - smooth.color)[inside] ** 2)))
        assert frame.samples == (samples or MANY)
    assert inside.sum() > 50
    assert errors[None] < 0.35 * errors[1]


def test_too_few_samples_log_one_warning_that_names_the_noisy_light(caplog: pytest.LogCaptureFixture) -> None:
    """The warning names a remedy; it is not logged by default, nor once resumed frames have enough samples."""
    camera, soft = front_camera(16, 16), scene(ENVIRONMENT, SOFT_SUN)

    def lines(content: ls.Scene, **settings: Any) -> list[str]:
        caplog.clear()
        renderer = ls.create_renderer(ls.RenderConfig(**settings), "cpu")
        for _ in range(2):
            renderer.render(content, camera)
        return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]

    end = f": set samples to at least {MANY}, or denoise"
    assert lines(scene(ENVIRONMENT), samples=1) == [f"light from the environment is noisy with 1 sample a pixel{end}"]
    (line,) = lines(soft, samples=4, shadows=ls.Shadows.SOFT)
    assert line == f"light from the environment and lights with a size is noisy with 4 samples a pixel{end}"
    assert not lines(scene(ENVIRONMENT))
    assert not lines(scene(SUN), samples=1)
    assert not lines(scene(ENVIRONMENT, material=ls.MaterialPbr()), samples=SOME)
    assert not lines(scene(ENVIRONMENT), samples=MANY)
    half = ls.create_renderer(ls.RenderConfig(samples=MANY // 2), "cpu").render(scene(ENVIRONMENT), camera)
    caplog.clear()
    ls.create_renderer(ls.RenderConfig(samples=MANY // 2), "cpu").render(scene(ENVIRONMENT), camera, resume=half)
    assert not caplog.records


@pytest.mark.parametrize("pipeline", DIRECT, ids=lambda pipeline: pipeline.value)
def test_captured_pixels_beside_noisy_meshes_equal_the_unlit_frame_at_default_samples(pipeline: ls.Pipeline) -> None:
    """An emissive capture is in front of a noisy mesh; pixels without the mesh have the bits of the unlit frame."""
    content = scene(replace(ENVIRONMENT, visible=False))
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 0.0, 9.0
    content = replace(content, meshes=(replace(content.meshes[0], world_from_object=pose),))
    config = ls.RenderConfig(pipeline=pipeline)
    frame = ls.render(content, front_camera(), config, device="cpu")
    alone = ls.render(replace(content, meshes=()), front_camera(), replace(config, lighting=False), device="cpu")
    assert frame.samples == MANY
    assert frame.light is not None and frame.captured_weight is not None
    untouched = (frame.captured_weight == 1.0) & (frame.light == 0.0).all(axis=-1) & (alone.alpha > 0.0)
    assert untouched.mean() > 0.1
    np.testing.assert_array_equal(frame.pixels_srgb()[untouched], alone.pixels_srgb()[untouched])


def test_demo_animation_logs_no_warning_about_too_few_samples(
    caplog: pytest.LogCaptureFixture, tmp_path: Path, monkeypatch: Any
) -> None:
    """The animation has few samples on purpose; other frames of the demo still log the warning."""
    settings = replace(demo._lit_config(), samples=MANY, max_bounces=0)
    monkeypatch.setattr(demo, "_lit_config", lambda: settings)
    monkeypatch.setattr(demo, "_SWING_FRAMES", 2)
    spot = ls.LightSpot((0, -2, 3), (0, 1, 0))
    content = scene(ENVIRONMENT, spot)
    content = replace(content, lights=(spot, *(light for light in content.lights if light is not spot)))

    def start(config: ls.RenderConfig) -> ls.Renderer:
        return ls.create_renderer(config, "cpu")

    list(demo.lit_images(content, front_camera(16, 16), tmp_path, start, lambda label, share: None))
    assert not [record for record in caplog.records if "is noisy" in record.getMessage()]
    start(ls.RenderConfig(samples=1)).render(content, front_camera(16, 16))
    assert [record for record in caplog.records if "is noisy" in record.getMessage()]
