"""Direct light of real-time frames: closed forms, layers, and pixels with two surfaces."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config.render import PATH_PARTS
from lumisplat.scene.lights import Light
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, scene
from support.scenes.path_scenes import (
    assert_is,
    cube_without_ceiling,
    diffuse,
    irradiance,
    paths,
    quad,
    wide_sheet,
)

DOWN = ls.Camera.look_at((0, 0.5, 0.01), (0, 0, 0), (0, 0, -1), width=24, height=16, fov_y=0.02)
FLOOR = quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), diffuse(0.5))
PANEL = 0.239456
"""Form factor of the unit square at distance 1 above a point."""


def sequence(scene: ls.Scene, camera: ls.Camera, frames: int, max_bounces: int, **changes: Any) -> Any:
    """Returns the last frame of a sequence."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=max_bounces)
    renderer = ls.create_renderer(replace(config, **changes), device="cpu")
    for _ in range(frames - 1):
        renderer.render(scene, camera)
    return renderer.render(scene, camera)


def half_environment() -> ls.LightEnvironment:
    """Returns an environment of radiance 1 on one side of the plane x = 0."""
    around = np.arange(64) < 32
    return ls.LightEnvironment(np.broadcast_to(around[None, :, None], (32, 64, 3)).astype(np.float32))


IRRADIANCES: dict[str, tuple[list[ls.Mesh], list[Light], float]] = {
    "point": ([], [ls.LightPoint((0.0, 2.0, 0.0), intensity=3.0)], 0.75),
    "rect": ([], [ls.LightRect((0.0, 1.0, 0.0), (1, 0, 0), (0, 0, 1), intensity=1.0)], np.pi * PANEL),
    "disk": ([], [ls.LightDisk((0.0, 1.0, 0.0), (0, -1, 0), 0.75, intensity=1.0)], np.pi * 0.36),
    "mesh": ([quad((-0.5, 1.0, -0.5), (1, 0, 0), (0, 0, 1), diffuse(0.5, 1.0))], [], np.pi * PANEL),
    "environment": ([], [half_environment()], 0.5 * np.pi),
    "two lights": (
        [],
        [ls.LightPoint((0.0, 2.0, 0.0), intensity=3.0), ls.LightPoint((0.0, 1.0, 0.0), intensity=0.2)],
        0.95,
    ),
}


@pytest.mark.parametrize("name", IRRADIANCES)
def test_realtime_mean_irradiance_of_a_floor_matches_the_closed_form(name: str) -> None:
    """Over 256 frames without spatial filter, the irradiance differs from the closed form by noise only."""
    meshes, lights, truth = IRRADIANCES[name]
    settings = ls.RealtimeConfig(filter=ls.config.FilterConfig(frames=256, passes=0))
    lit_scene = ls.Scene(meshes=[FLOOR, *meshes], lights=lights)
    assert_is(irradiance(sequence(lit_scene, DOWN, 256, 0, realtime=settings), 0.5), truth)


def test_dim_environment_beside_a_bright_light_causes_no_fireflies_in_real_time() -> None:
    """The bright light gets most samples; samples of the environment in a grazing highlight must not be bright."""
    environment = ls.LightEnvironment(color=(1.0, 1.0, 1.0), intensity=0.1, visible=False)
    floor = quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), replace(diffuse(0.5), roughness=0.5, specular=1.0))
    slanted = ls.Camera.look_at((0, 0.3, 1.9), (0, 0, 0), (0, 1, 0), width=48, height=32, fov_y=0.1)
    settings = ls.RealtimeConfig(antialiasing=False, filter=ls.config.FilterConfig(frames=1, passes=0))
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, max_bounces=0, aovs=("direct_glossy",), realtime=settings)
    renderer = ls.create_renderer(config, device="cpu")
    lit_scene = ls.Scene(meshes=[floor], lights=[environment, ls.LightPoint((0.0, 2.0, 1.9), intensity=20.0)])
    samples = np.array([renderer.render(lit_scene, slanted).direct_glossy for _ in range(64)])[..., 0]
    bright: Any = paths(lit_scene, slanted, 256, 0, aovs=("direct_glossy",))
    truth = bright.direct_glossy[..., 0]
    assert samples.mean(dtype=np.float64) == pytest.approx(truth.mean(dtype=np.float64), rel=0.03)
    assert samples.max() < 80.0 * truth.mean()  # 450 by samples of the environment alone


def test_five_light_layers_and_captured_colours_sum_to_the_realtime_frame() -> None:
    """Requesting the layers does not change the frame."""
    light = ls.LightSphere((0.3, 0.6, -0.4), 0.15, intensity=3.0, name="ball")
    lit = scene(*LIGHTS, ENVIRONMENT, light)
    frame, plain = (sequence(lit, camera(), 3, 3, aovs=aovs) for aovs in (PATH_PARTS, ()))
    np.testing.assert_array_equal(frame.color, plain.color)
    parts = [getattr(frame, name).astype(np.float64) for name in PATH_PARTS]
    assert all(part.any() for part in parts)
    assert (frame.color - frame.light).max() > 0.1
    np.testing.assert_allclose(np.maximum(sum(parts), 0.0), frame.color, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["point", "rect"])
def test_relit_sheet_in_front_of_a_mesh_matches_the_path_tracer_in_real_time(name: str) -> None:
    """The sheet has an opacity of 0.6; each channel is within 1 % of the path tracer."""
    lights: dict[str, Light] = {
        "point": ls.LightPoint((0.5, 0.0, -2.0), intensity=4.0),
        "rect": ls.LightRect((0.0, 0.0, -1.5), (0.5, 0, 0), (0, 0.5, 0), intensity=6.0),
    }
    wall = quad((-3, -3, 1), (0, 6, 0), (6, 0, 0), replace(diffuse(0.5), base_color=(0.9, 0.5, 0.1)))
    lit_scene = ls.Scene([wide_sheet(0.0, 0.6, 0.4)], [wall], [lights[name]])
    front = ls.Camera.look_at((0.0, 0.0, -1.0), (0.0, 0.0, 0.0), width=24, height=16, fov_y=0.02)
    settings = ls.RealtimeConfig(filter=ls.config.FilterConfig(frames=256, passes=0))
    found = sequence(lit_scene, front, 64, 0, realtime=settings).color.mean(axis=(0, 1), dtype=np.float64)
    truth = paths(lit_scene, front, 64, 0, path=ls.PathConfig(primary=ls.config.PathPrimary.ISO))
    truth = truth.color.mean(axis=(0, 1), dtype=np.float64)
    assert truth[0] > 1.15 * truth[2] > 0.0
    np.testing.assert_allclose(found, truth, rtol=0.01)


@pytest.mark.parametrize("light", ["point", "rect"])
def test_light_switched_off_in_real_time_fades_in_8_frames_and_its_bounces_in_24(light: str) -> None:
    """In a box of albedo 0.5, nine tenths of direct light are gone after 8 frames, of indirect light after 24."""
    lights: dict[str, Any] = {
        "point": ls.LightPoint((0.5, 0.8, 0.5), intensity=0.5),
        "rect": ls.LightRect((0.5, 0.99, 0.5), (0.4, 0, 0), (0, 0, 0.4), intensity=4.0),
    }
    room = cube_without_ceiling(diffuse(0.5))
    inside = ls.Camera.look_at((0.5, 0.6, 0.1), (0.5, 0.3, 1.0), width=48, height=32, fov_y=1.0)
    config = ls.RenderConfig(pipeline=ls.Pipeline.REALTIME, aovs=PATH_PARTS)
    renderer = ls.create_renderer(config, device="cpu")
    lit: Any = [renderer.render(ls.Scene(meshes=room, lights=[lights[light]]), inside) for _ in range(32)][-1]
    out = ls.Scene(meshes=room, lights=[replace(lights[light], intensity=0.0)])
    dark: list[Any] = [renderer.render(out, inside) for _ in range(24)]
    for name, frames in (("direct_diffuse", 8), ("indirect_diffuse", 24)):
        before, after = getattr(lit, name).mean(), getattr(dark[frames - 1], name).mean()
        assert before > 0.01
        assert after < 0.1 * before, f"{name}: {after / before}"
