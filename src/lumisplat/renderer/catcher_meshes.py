"""Shadows on meshes that are shadow catchers: two extra frames measure the shadows, which darken the frame's pixels.

The method is in docs/method/lighting.md#meshes-that-catch-shadows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lumisplat.config import Pipeline, RenderConfig
from lumisplat.constants import CATCHER_AMBIENT
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import Flags, FloatArray
from lumisplat.math.tone_map import captured_radiance
from lumisplat.renderer.scene.materials import is_relit
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.materials import MESH_COLOR, MaterialPbr, MaterialSimple
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance

CATCHER_ALBEDO = 0.5
"""Albedo of catcher meshes whose material has no base colour. Path-traced light bounces off catchers with this albedo.
"""

CATCHER_ALBEDO_MIN = 0.02
"""Lowest albedo of a catcher mesh in each channel: on a black mesh the shadow ratio would be 0 / 0."""

CATCHER_FILL_PX = 3
"""Width of the margin, in pixels, by which a catcher's shadow ratio is extrapolated under objects in front of the
catcher.
"""

Render = Callable[[Scene], Frame]
"""Function that renders a scene with one camera: the camera of the frame to which shadows are added."""


def has_catcher_meshes(scene: Scene) -> bool:
    """Returns whether some mesh is a shadow catcher."""
    return any(instance.shadow_catcher for instance in scene.meshes)


def without_catcher_meshes(scene: Scene) -> Scene:
    """Returns the visible scene: it has no catcher meshes, and its captures do not catch shadows."""
    splats = tuple(
        replace(one, shadow_catcher=False, material=None) if one.shadow_catcher else one for one in scene.splats
    )
    return replace(scene, splats=splats, meshes=tuple(one for one in scene.meshes if not one.shadow_catcher))


def catcher_config(config: RenderConfig) -> RenderConfig:
    """Returns settings for the frames that measure shadows: samples at pixel centres, and a black background."""
    pipeline = Pipeline.HYBRID if config.pipeline.rasterises else config.pipeline
    return replace(
        config,
        pipeline=pipeline,
        background=(0.0, 0.0, 0.0),
        lighting=True,
        jitter=False,
        aovs=(),
        noise=None,
        time_limit=None,
        adaptive=None,
    )


def catcher_scenes(scene: Scene) -> list[Scene]:
    """Returns the two scenes that `with_caught_shadows` renders. Callers compile the scenes' kernels in advance.

    The first scene has only the catcher meshes, the second also the added objects.
    """
    added, catchers = _added(scene), tuple(one for one in scene.meshes if one.shadow_catcher)
    without_objects = replace(scene, splats=(), lights=_lights(scene), meshes=tuple(map(_matte, catchers)))
    return [
        without_objects,
        replace(added, lights=without_objects.lights, meshes=(*added.meshes, *without_objects.meshes)),
    ]


def with_caught_shadows(frame: Frame, scene: Scene, render: Render, *, returns_ratio: bool) -> Frame:
    """Returns ``frame`` with the shadows and reflections on the scene's catcher meshes, which the frame itself lacks.

    Args:
        frame: A lit frame of `without_catcher_meshes`, with its ``shadow_ratio``.
        scene: The scene with the catcher meshes.
        render: Renders with the settings from `catcher_config`.
        returns_ratio: Whether the result contains ``shadow_ratio``.
    """
    assert frame.captured is not None and frame.captured_weight is not None and frame.light is not None
    catchers = tuple(one for one in scene.meshes if one.shadow_catcher)
    added = _added(scene)
    without_objects = replace(scene, splats=(), lights=_lights(scene), meshes=tuple(map(_matte, catchers)))
    unshadowed, shadowed = (
        render(without_objects),
        render(replace(added, lights=without_objects.lights, meshes=(*added.meshes, *without_objects.meshes))),
    )
    shows_catcher = (unshadowed.instance_index >= 0) & ~_is_in_front(frame, scene, unshadowed)
    caught = (
        shows_catcher
        & (shadowed.instance_index >= len(added.splats) + len(added.meshes))
        & (unshadowed.color > 0.0).any(axis=2)
    )
    ratio = np.ones_like(unshadowed.color)
    is_defined = caught[..., None] & (unshadowed.color > 0.0)  # a light may have no red, green or blue
    ratio[is_defined] = shadowed.color[is_defined] / unshadowed.color[is_defined]
    ratio = np.where(shows_catcher[..., None], _dilated(ratio, caught), np.float32(1.0))
    reflected = np.where(shows_catcher[..., None], _reflections(scene, added, catchers, render), np.float32(0.0))
    captured = captured_radiance(frame.captured, frame.captured_weight)
    clear = 1.0 - frame.alpha if frame.background is None else np.zeros_like(frame.alpha)
    shown = np.clip(frame.captured_weight + clear, 0.0, 1.0)[..., None]
    is_environment = (frame.instance_index < 0)[..., None]
    light = frame.light * np.where(is_environment, ratio, 1.0) + captured * (ratio - 1.0) + shown * reflected
    darkness = 1.0 - np.clip(ratio.min(axis=2), 0.0, 1.0)
    changed = (light != frame.light).any(axis=2, keepdims=True)
    return replace(
        frame,
        light=light,
        color=np.where(changed, np.maximum(captured + light, 0.0), frame.color),
        alpha=frame.alpha + clear * np.maximum(darkness, np.clip(reflected.max(axis=2), 0.0, 1.0)),
        shadow_ratio=ratio if returns_ratio else None,
        accumulated=None,
    )


def with_scene_indices(frame: Frame, scene: Scene) -> Frame:
    """Returns a frame of `without_catcher_meshes` with its instance indices converted to those of the full scene."""
    numbers = np.array([k for k, one in enumerate(scene.meshes) if not one.shadow_catcher], np.int32)
    first, index = len(scene.splats), frame.instance_index
    if len(numbers) == 0:
        return frame
    shown = numbers[np.clip(index - first, 0, len(numbers) - 1)]
    return replace(frame, instance_index=np.where(index >= first, first + shown, index).astype(np.int32))


def _added(scene: Scene) -> Scene:
    """Returns the scene with only the objects added to the capture: without catcher meshes and background captures.

    The background is the captures that catch shadows; if there are none, the captures that are not relit.
    """
    plate = [one for one in scene.splats if one.shadow_catcher]
    if not plate:
        plate = [one for one in scene.splats if not is_relit(one)]
    splats: tuple[SplatInstance, ...] = tuple(one for one in scene.splats if not any(one is other for other in plate))
    return replace(scene, splats=splats, meshes=tuple(one for one in scene.meshes if not one.shadow_catcher))


def _lights(scene: Scene) -> tuple[Light, ...]:
    """Returns the lights for measuring shadows: the scene's, with environments hidden from the camera.

    If the scene enables no environment, a hidden constant environment is added. Its radiance is the first non-zero
    ``ambient`` of a catcher's material, else `CATCHER_AMBIENT`.
    """
    lights = [replace(one, visible=False) if isinstance(one, LightEnvironment) else one for one in scene.lights]
    if any(isinstance(one, LightEnvironment) and one.enabled for one in lights):
        return tuple(lights)
    materials = [one.mesh.material for one in scene.meshes if one.shadow_catcher]
    given = [one.ambient for one in materials if isinstance(one, MaterialSimple) and any(one.ambient)]
    ambient = given[0] if given else (CATCHER_AMBIENT,) * 3
    return (*lights, LightEnvironment(color=ambient, visible=False, name="ambient"))


def _matte(instance: MeshInstance) -> MeshInstance:
    """Returns a catcher with a diffuse material of its base colour; without a base colour, of `CATCHER_ALBEDO`.

    The base colour changes the shadow ratio only through light that bounces between the catcher and added objects.
    """
    color = instance.mesh.material.mesh_color
    given = CATCHER_ALBEDO if color == MESH_COLOR else np.maximum(color, CATCHER_ALBEDO_MIN)
    material = MaterialSimple(emissive=0.0, diffuse=1.0, base_color=given)
    return replace(instance, mesh=replace(instance.mesh, material=material, colors=None), shadow_catcher=False)


def _reflections(scene: Scene, added: Scene, catchers: tuple[MeshInstance, ...], render: Render) -> FloatArray:
    """Returns the linear radiance that shiny catchers reflect from added objects, shape (H, W, 3)."""
    shiny = tuple(one for one in catchers if isinstance(one.mesh.material, MaterialPbr) and _mirrors(one.mesh.material))
    if not shiny:
        return np.float32(0.0) * np.ones((1, 1, 3), np.float32)
    black = tuple(
        replace(
            one,
            mesh=replace(one.mesh, material=_without_diffuse(one.mesh.material), colors=None),
            shadow_catcher=False,
        )
        for one in shiny
    )
    lights = tuple(replace(one, visible=False) if isinstance(one, LightEnvironment) else one for one in scene.lights)
    without = render(replace(scene, splats=(), lights=lights, meshes=black)).color
    frame = render(replace(added, lights=lights, meshes=(*added.meshes, *black)))
    is_catcher = frame.instance_index >= len(added.splats) + len(added.meshes)
    mirrored = np.where(is_catcher[..., None], np.maximum(frame.color - without, 0.0), np.float32(0.0))
    return _dilated(mirrored, is_catcher)


def _mirrors(material: MaterialPbr) -> bool:
    return material.mesh_roughness < 0.5 or material.mesh_metallic > 0.0


def _without_diffuse(material: object) -> MaterialPbr:
    assert isinstance(material, MaterialPbr)
    color = material.mesh_color if material.mesh_metallic > 0.0 else (0.0, 0.0, 0.0)
    return replace(material, base_color=color, base_color_texture=None, emissive=0.0, transmission=0.0)


def _is_in_front(frame: Frame, scene: Scene, catchers: Frame) -> Flags:
    """Returns a mask, shape (H, W), of the pixels whose captured surface hides the catcher mesh.

    A surface hides the catcher if it is nearer than the catcher by more than the thickness of the surface's Gaussians.
    """
    height = ((frame.position - catchers.position) * catchers.normal).sum(axis=2)
    thickness = np.zeros_like(height)
    for number, splats in enumerate(scene.splats):
        at = (frame.instance_index == number) & (frame.gaussian_index >= 0)
        largest = splats.gaussians.scales[frame.gaussian_index[at]].max(axis=1) * splats.scale
        thickness[at] = _offset(frame) * largest
    is_captured = np.isfinite(frame.depth) & (frame.instance_index < len(scene.splats))
    return is_captured & (frame.depth < catchers.depth) & (height > thickness)


def _offset(frame: Frame) -> float:
    return (frame.config or RenderConfig()).shadow_rays.offset


def _dilated(image: FloatArray, is_defined: Flags) -> FloatArray:
    """Extrapolates an image by `CATCHER_FILL_PX` pixels: undefined pixels get the mean of their defined neighbours.

    ``is_defined`` marks the pixels that have a value.
    """
    values, is_defined = np.where(is_defined[..., None], image, np.float32(0.0)), is_defined.copy()
    filled = image.copy()
    for _ in range(CATCHER_FILL_PX):
        counts = _neighborhood_sum(is_defined.astype(np.float32)[..., None])
        means = _neighborhood_sum(values) / np.maximum(counts, 1.0)
        fresh = ~is_defined & (counts[..., 0] > 0.0)
        values[fresh] = filled[fresh] = means[fresh]
        is_defined |= fresh
    return filled


def _neighborhood_sum(image: FloatArray) -> FloatArray:
    """Returns the sum over the 3 x 3 pixels around each pixel."""
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    return np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1)).sum(axis=(3, 4), dtype=np.float32)
