"""The kernels for scenes of opaque meshes compute what the kernels for all scenes do, to the bit.

Frames with layers are shaded by the kernels for all scenes, and have the same colours as frames without. CPUs shade 16
paths at a time, and CUDA's schedule shades one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from lumisplat.constants import OPAQUE_BLOCK, TILE_BANDS_PER_THREAD
from lumisplat.demo.shapes import sphere
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.runtime.launcher import Launcher
from support.scenes.path_scenes import diffuse, quad

VIEW = ls.Camera.look_at((0.2, 0.6, 2.6), (0, 0.1, 0), (0, 1, 0), width=48, height=32, fov_y=0.8)
FLOOR = quad((-2, -0.6, -2), (0, 0, 4), (4, 0, 0), diffuse(0.7))
EMITTER = quad((-0.4, 1.5, -0.4), (0.8, 0, 0), (0, 0, 0.8), diffuse(0.0, 4.0))
LIGHTS = (
    ls.LightEnvironment(),
    ls.LightPoint((1.0, 1.5, 1.0), intensity=2.0),
    ls.LightDirectional((0.3, 1.0, 0.5), intensity=1.0),
    ls.LightSphere((-1.0, 0.9, 0.5), 0.2, intensity=3.0),
    ls.LightSphere((1.2, 0.4, 0.5), 0.2, intensity=2.0, visible=False),
)


def texture(*channels: int) -> np.ndarray:
    """Returns a texture of 2 x 2 random texels with these means."""
    texels = np.random.default_rng(3).integers(-40, 41, (2, 2, len(channels))) + channels
    return np.clip(texels, 0, 255).astype(np.uint8)


def body(material: ls.MaterialPbr | ls.MaterialSimple) -> ls.Mesh:
    """Returns a coarse ball with vertex normals and texture coordinates."""
    mesh = sphere(0.6, rows=8, columns=16)
    uvs = mesh.positions[:, :2] + 0.5
    return ls.Mesh(mesh.positions, mesh.indices, normals=mesh.positions / 0.6, uvs=uvs, material=material)


MATERIALS: dict[str, Any] = {
    "plastic": ls.MaterialPbr(base_color=(0.2, 0.5, 0.8), roughness=0.3),
    "metal": ls.MaterialPbr(base_color=(0.9, 0.7, 0.4), roughness=0.2, metallic=1.0),
    "simple": ls.MaterialSimple(diffuse=(0.5, 0.3, 0.2), specular=(0.4, 0.4, 0.4), shininess=30.0),
    "textured": ls.MaterialPbr(
        base_color_texture=texture(120, 180, 60),
        metallic_roughness_texture=texture(0, 90, 120),
        normal_texture=texture(120, 140, 220),
        occlusion_texture=texture(90, 0, 0),
        emissive=(0.3, 0.3, 0.3),
        emissive_texture=texture(90, 40, 40),
    ),
    "cut out": ls.MaterialPbr(
        base_color_texture=texture(200, 90, 90, 120), alpha_mode=ls.AlphaMode.BLEND, roughness=0.5
    ),
}


def shaded(scene: ls.Scene, *, parallel: bool = False, view: ls.Camera = VIEW, **changes: Any) -> list[ls.Frame]:
    """Returns a frame of the kernels for opaque meshes, and one of the kernels for all scenes."""
    frames: list[ls.Frame] = []
    for aovs in ((), ("bounces",)):
        config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=2, max_bounces=4, aovs=aovs, **changes)
        assert FramePlan.of(config, scene).shades_opaque_paths is not bool(aovs)
        frames.append(ls.Renderer(config, Launcher("cpu", threads=2, parallel=parallel)).render(scene, view))
    return frames


def assert_equal(frames: list[ls.Frame]) -> None:
    """Asserts that two frames have the same pixels, and light in many of them."""
    one, other = frames
    assert (one.color.max(axis=-1) > 0.0).mean() > 0.3
    np.testing.assert_array_equal(one.color, other.color)
    np.testing.assert_array_equal(one.alpha, other.alpha)


@pytest.mark.parametrize("material", MATERIALS)
def test_opaque_meshes_are_shaded_as_in_scenes_of_any_kind(material: str) -> None:
    """The scene has lights of several kinds and an emissive mesh, with vertex normals and without."""
    assert_equal(shaded(ls.Scene(meshes=[body(MATERIALS[material]), FLOOR, EMITTER], lights=LIGHTS)))


@pytest.mark.parametrize("parallel", [False, True], ids=["CPU's schedule", "CUDA's schedule"])
def test_moved_meshes_of_all_materials_are_shaded_alike_from_inside_and_outside(parallel: bool) -> None:
    """Rays of one block hit turned, stretched and mirrored meshes, with and without vertex normals."""
    turned = np.array([[0.3, -0.5, 0.0, -0.6], [0.5, 0.3, 0.1, 0.3], [0.0, 0.1, -0.7, 0.1], [0.0, 0.0, 0.0, 1.0]])
    moved: list[ls.MeshInstance] = []
    for number, material in enumerate(MATERIALS.values()):
        placed = turned.copy()
        placed[:3, 3] += 0.5 * (number % 3), 0.4 * (number // 3), 0.2 * number
        moved.append(ls.MeshInstance(body(material), placed))
    around = ls.MeshInstance(FLOOR, np.diag([1.5, -1.0, 0.7, 1.0]))
    shell = ls.MeshInstance(body(MATERIALS["plastic"]), np.diag([6.0, 7.0, -8.0, 1.0]))
    view = ls.Camera.look_at((0.2, 0.6, 2.6), (0, 0.1, 0), (0, 1, 0), width=37, height=23, fov_y=0.8)
    scene = ls.Scene(meshes=[*moved, around, shell, EMITTER], lights=LIGHTS[1:])
    assert_equal(shaded(scene, parallel=parallel, view=view))


@pytest.mark.parametrize(
    ("lights", "changes"),
    [
        ((), {"background": (0.2, 0.4, 0.6)}),
        (LIGHTS[1:2], {"background": None}),
        (LIGHTS[:1], {"shadows": ls.Shadows.OFF}),
        (LIGHTS, {"parallel": True}),
        ((ls.LightEnvironment(visible=False), *LIGHTS[3:]), {"shadow_rays": ls.ShadowConfig(color_strength=0.5)}),
    ],
    ids=["headlight", "transparent background", "no shadows", "CUDA's schedule", "tinted shadows"],
)
def test_opaque_meshes_are_shaded_alike_with_all_settings(lights: tuple[Any, ...], changes: dict[str, Any]) -> None:
    """What camera rays show, MIS and shadow rays depend on these settings."""
    assert_equal(shaded(ls.Scene(meshes=[body(MATERIALS["plastic"]), FLOOR], lights=lights), **changes))


@pytest.mark.parametrize(
    "other",
    [
        body(ls.MaterialPbr(roughness=0.0)),
        body(ls.MaterialPbr(roughness=0.4, transmission=0.5)),
        body(ls.MaterialPbr(clearcoat=0.5)),
        body(ls.MaterialPbr(sheen_color=(0.0, 0.1, 0.0))),
    ],
    ids=["mirror", "glass", "clearcoat", "sheen"],
)
def test_scenes_with_other_materials_are_shaded_by_the_kernels_for_all_scenes(other: ls.Mesh) -> None:
    """Mirrors, glass and layers have no place in the kernel for opaque meshes."""
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH)
    assert FramePlan.of(config, ls.Scene(meshes=[FLOOR])).shades_opaque_paths
    assert not FramePlan.of(config, ls.Scene(meshes=[FLOOR, other])).shades_opaque_paths


def test_blocks_of_paths_do_not_depend_on_threads() -> None:
    """On one thread, a band follows more than one block; blocks at the sides have rays that do not exist.

    The lens shows all directions, and has no rays at the sides of the image.
    """
    lens = {"fx": 25.0, "fy": 25.0, "cx": 105.5, "cy": 48.5, "model": ls.CameraModel.FISHEYE}
    view = replace(VIEW, width=211, height=97, **lens)
    scene = ls.Scene(meshes=[body(MATERIALS["cut out"]), FLOOR, EMITTER], lights=LIGHTS[1:])
    config = ls.RenderConfig(pipeline=ls.Pipeline.PATH, samples=1, max_bounces=6, background=None)
    assert view.width * view.height > OPAQUE_BLOCK * TILE_BANDS_PER_THREAD
    one, three = (ls.Renderer(config, Launcher("cpu", threads=threads)).render(scene, view) for threads in (1, 3))
    layered = replace(config, aovs=("bounces",))
    waves = ls.Renderer(layered, Launcher("cpu", threads=2)).render(scene, view)
    assert 0.02 < one.alpha.mean() < 0.9
    for name in ("color", "alpha"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
        np.testing.assert_array_equal(getattr(one, name), getattr(waves, name))
