"""Layers of path traced frames: their sum is the frame, and each contains what its name says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.config.render import PATH_PARTS
from support.scenes.lit_scene import ENVIRONMENT, LIGHTS, camera, scene
from support.scenes.path_scenes import cube_without_ceiling, diffuse, paths, quad, wide_sheet

ALL = (*PATH_PARTS, "bounces", "lights", "albedo")


def rooms() -> ls.Scene:
    """Returns relit and emissive Gaussians, meshes, a mirror, glass, an environment, lights, and a visible light."""
    light = ls.LightSphere((0.3, 0.6, -0.4), 0.15, intensity=3.0, name="ball")
    return scene(*LIGHTS, ENVIRONMENT, light)


@pytest.mark.parametrize("shown", ["all", "shadow-only"])
def test_layers_of_path_traced_frames_add_up_to_the_frame(shown: str) -> None:
    """Three sums agree to 1e-5: the five light parts, bounces plus captures, and lights plus captures."""
    lit = rooms()
    if shown == "shadow-only":
        lit = replace(lit, splats=[replace(one, material=None, shadow_catcher=True) for one in lit.splats])
    frame: Any = paths(lit, camera(), 4, 3, aovs=ALL)
    captured = frame.color - frame.light
    parts = sum(getattr(frame, name).astype(np.float64) for name in PATH_PARTS)
    np.testing.assert_allclose(np.maximum(parts, 0.0), frame.color, rtol=1e-5, atol=1e-5)
    changed = frame.emission - captured - frame.bounces[0]
    if shown == "all":  # in other scenes, this is the light that shadows take from captures
        np.testing.assert_allclose(changed, 0.0, atol=1e-5)
    np.testing.assert_allclose(frame.bounces.sum(0) + changed + captured, frame.color, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(frame.light_total.sum(0), frame.bounces.sum(0), rtol=1e-5, atol=1e-5)


def test_requesting_layers_does_not_change_a_path_traced_frame() -> None:
    """The bits are equal with and without layers."""
    plain, layered = (paths(rooms(), camera(), 2, 3, aovs=aovs) for aovs in ((), ALL))
    np.testing.assert_array_equal(plain.color, layered.color)


def test_path_traced_room_of_diffuse_walls_has_no_glossy_light() -> None:
    """The room is a cube under a panel; all direct light on the floor is the panel's."""
    panel = quad((0, 1, 0), (1, 0, 0), (0, 0, 1), diffuse(0.5, 1.0))
    room = ls.Scene(meshes=[*cube_without_ceiling(diffuse(0.5)), panel])
    down = ls.Camera.look_at((0.5, 0.5, 0.5), (0.5, 0.0, 0.5), (0, 0, 1), width=16, height=16, fov_y=0.01)
    frame: Any = paths(room, down, 128, 6, aovs=ALL)
    direct = 0.5 / np.pi * np.pi * 0.239456 * np.pi  # albedo / pi times the irradiance at the floor's centre
    assert not frame.direct_glossy.any() and not frame.indirect_glossy.any() and not frame.emission.any()
    np.testing.assert_allclose(frame.direct_diffuse.mean(), direct / np.pi, rtol=0.01)
    np.testing.assert_allclose(frame.bounces[1], frame.direct_diffuse, rtol=1e-6)
    np.testing.assert_allclose(frame.indirect_diffuse.mean(), 0.5 / np.pi * 1.2416 - direct / np.pi, rtol=0.02)


def test_light_from_rough_metal_is_in_glossy_layers_and_visible_lights_are_in_emission() -> None:
    """The floor is rough metal, and the camera sees a light directly."""
    metal = ls.MaterialPbr(base_color=(1, 1, 1), metallic=1.0, roughness=0.4)
    floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0), metal)
    light = ls.LightSphere((0.0, 0.8, 0.0), 0.2, intensity=4.0)
    above = ls.Camera.look_at((0.1, 0.5, 0.1), (0, 0, 0), (0, 0, 1), width=8, height=8, fov_y=0.2)
    frame: Any = paths(ls.Scene(meshes=[floor], lights=[light]), above, 16, 2, aovs=ALL)
    assert not frame.direct_diffuse.any() and frame.direct_glossy.mean() > 0.1 and not frame.emission.any()
    upwards = ls.Camera.look_at((0.0, 0.1, 0.0), (0, 1, 0), (0, 0, 1), width=8, height=8, fov_y=0.1)
    seen: Any = paths(ls.Scene(meshes=[floor], lights=[light]), upwards, 1, 2, aovs=ALL)
    np.testing.assert_allclose(seen.emission, seen.color)
    np.testing.assert_allclose(seen.light_total[0], seen.color)


def test_layer_of_a_light_equals_the_frame_of_the_scene_with_no_other_light() -> None:
    """The means agree, with shadows and bounces."""
    room = cube_without_ceiling(diffuse(0.7))
    screen = quad((0.4, 0.2, 0.4), (0.2, 0, 0), (0, 0, 0.2), diffuse(0.2))
    lights = [
        ls.LightPoint((0.5, 0.8, 0.5), intensity=0.4, name="top"),
        ls.LightPoint((0.2, 0.4, 0.3), intensity=0.2, color=(1.0, 0.4, 0.2), name="side"),
    ]
    view = ls.Camera.look_at((0.5, 0.6, 0.1), (0.5, 0.0, 0.6), width=24, height=18, fov_y=1.2)
    both: Any = paths(ls.Scene(meshes=[*room, screen], lights=lights), view, 256, 4, aovs=("lights",))
    assert both.light_names == ("top", "side")
    for number, light in enumerate(lights):
        alone: Any = paths(ls.Scene(meshes=[*room, screen], lights=[light]), view, 256, 4, aovs=("lights",))
        direct = both.light_direct[number] * both.light_shadow[number]
        np.testing.assert_allclose(
            direct.mean((0, 1)), (alone.light_direct * alone.light_shadow)[0].mean((0, 1)), rtol=0.02
        )
        np.testing.assert_allclose(both.light_total[number].mean((0, 1)), alone.light_total[0].mean((0, 1)), rtol=0.03)


@pytest.mark.parametrize("roughness", [0.3, 0.0])
def test_shadow_layer_of_metal_is_1_where_nothing_blocks_the_light(roughness: float) -> None:
    """Rough metal gets light samples without loss; in a mirror, only rays that hit the light bring its light."""
    metal = ls.MaterialPbr(base_color=(1, 1, 1), metallic=1.0, roughness=roughness)
    floor = quad((-3, 0, -3), (0, 0, 6), (6, 0, 0), metal)
    light = ls.LightSphere((0.0, 1.0, -1.5), 0.5, intensity=3.0)
    view = ls.Camera.look_at((0, 0.5, 1.0), (0, 0, 0), width=16, height=12, fov_y=0.5)
    frame: Any = paths(ls.Scene(meshes=[floor], lights=[light]), view, 128, 0, aovs=("lights", "bounces"))
    np.testing.assert_allclose(frame.light_shadow, 1.0, atol=1e-5)
    assert frame.light_total[0].mean() > 0.3
    if roughness > 0.0:
        np.testing.assert_allclose(frame.light_direct[0].mean(), frame.bounces[1].mean(), rtol=0.03)
    else:
        assert not frame.light_direct.any()


def test_layers_of_the_path_pipeline_are_refused_in_other_pipelines() -> None:
    """The message names the pipeline; layers of other pipelines are refused in path tracing as well."""
    with pytest.raises(ls.ConfigError, match=r"Pipeline\.HYBRID has no bounces among its aovs: Pipeline\.PATH does"):
        ls.render(rooms(), camera(), ls.RenderConfig(pipeline=ls.Pipeline.HYBRID, aovs=("bounces",)), device="cpu")
    with pytest.raises(ls.ConfigError, match=r"Pipeline\.PATH has no reflection among its aovs: Pipeline\.HYBRID does"):
        ls.render(rooms(), camera(), ls.RenderConfig(pipeline=ls.Pipeline.PATH, aovs=("reflection",)), device="cpu")


def test_layers_of_resumed_path_traced_frames_equal_uninterrupted_ones() -> None:
    """Two plus two samples have the bits of four in all layers, also with shadow catchers."""
    lit = rooms()
    lit = replace(
        lit, splats=[lit.splats[0], *(replace(one, material=None, shadow_catcher=True) for one in lit.splats[1:])]
    )
    settings = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=2, max_bounces=2, aovs=ALL)
    renderer = ls.create_renderer(settings, "cpu")
    resumed = renderer.render(lit, camera(), resume=renderer.render(lit, camera()))
    whole = ls.render(lit, camera(), replace(settings, samples=4), device="cpu")
    for name in ("color", *PATH_PARTS, "bounces", "light_direct", "light_shadow", "light_total"):
        np.testing.assert_array_equal(getattr(resumed, name), getattr(whole, name), err_msg=name)


def test_file_and_channel_names_of_path_traced_layers_contain_layer_and_light(tmp_path: Path) -> None:
    """EXR channels have the names of layers and lights; a PNG has one more file per layer."""
    frame: Any = paths(rooms(), camera(), 1, 1, aovs=ALL)
    channels = {name.rsplit(".", 1)[0] for name in frame.layers()}
    assert {"direct_glossy", "emission", "bounce.0", "bounce.2", "light.ball.total", "light_other"} <= channels
    frame.save(tmp_path / "a.exr")
    frame.save(tmp_path / "a.png", layers=("direct_diffuse", "bounces", "lights"))
    names = {path.name for path in tmp_path.iterdir()}
    assert {"a.direct_diffuse.png", "a.bounce.0.png", "a.bounce.2.png", "a.light.ball.total.png"} <= names


def test_clearcoat_adds_to_the_glossy_layer_and_its_diffuse_base_to_the_diffuse_layer() -> None:
    """The coat takes its fraction of the diffuse light and adds a highlight; all other light is unchanged."""
    light = ls.LightPoint((0.3, 0.8, 0.0), intensity=2.0)
    above = ls.Camera.look_at((-0.3, 0.8, 0.0), (0, 0, 0), (0, 0, 1), width=8, height=8, fov_y=0.1)
    parts: dict[str, Any] = {}
    for name, albedo in (("red", 0.6), ("black", 0.0)):
        coated = replace(diffuse(albedo), clearcoat=1.0, clearcoat_roughness=0.5)
        floor = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0), coated)
        frame: Any = paths(ls.Scene(meshes=[floor], lights=[light]), above, 1, 0, aovs=ALL)
        parts[name] = np.stack([frame.direct_diffuse, frame.direct_glossy])
    assert not parts["black"][0].any() and parts["black"][1].min() > 0.0
    np.testing.assert_allclose(parts["red"][1], parts["black"][1], rtol=1e-3)
    bare = quad((-1, 0, -1), (0, 0, 2), (2, 0, 0), diffuse(0.6))
    plain: Any = paths(ls.Scene(meshes=[bare], lights=[light]), above, 1, 0, aovs=ALL)
    whole = plain.direct_diffuse
    assert 0.8 < (parts["red"][0] / whole).min() <= (parts["red"][0] / whole).max() < 0.97


def test_emission_of_gaussians_is_not_attributed_to_the_environment() -> None:
    """An emissive sheet in front of a dim environment is counted as light without a light source."""
    material = ls.MaterialPbr(specular=0.0, roughness=1.0, emissive=(3.0, 3.0, 3.0))
    sheet = replace(wide_sheet(0.0, 0.9, 0.5), material=material)
    environment = ls.LightEnvironment(color=(1e-3, 1e-3, 1e-3))
    ahead = ls.Camera.look_at((0, 0, -1), (0, 0, 1), width=8, height=8, fov_y=0.01)
    frame: Any = paths(ls.Scene(splats=[sheet], lights=[environment]), ahead, 64, 0, aovs=ALL)
    assert frame.light_total[0].mean() < 2e-3
    assert frame.light_total[1].mean() > 0.3
