"""Lines about a frame's settings that are logged before it is rendered."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.options.lighting import LightOptions
from lumisplat.cli.options.rays import RayOptions
from lumisplat.cli.options.unused import unused_options

if TYPE_CHECKING:
    from lumisplat.scene.materials import Material


def frame_remarks(
    config: ls.RenderConfig,
    scene: ls.Scene,
    raster: list[str],
    rays: RayOptions,
    light: LightOptions,
    *,
    device: str = "auto",
) -> Iterator[str]:
    """Yields what has no effect, what comes out black or in patches; arguments as of `unused_options`."""
    yield from unused_options(config, scene, raster, rays, light)
    yield from _unused_albedos(config, scene)
    yield from _dark_sides(config, scene)
    yield from _lit_fog(config, scene, device)
    yield from _clipped_light(config, scene, light)


def _lit_fog(config: ls.RenderConfig, scene: ls.Scene, device: str) -> Iterator[str]:
    """A line for each capture that takes light or shadows, and has no surface for them."""
    if config.lighting is False or not any(light.enabled for light in scene.lights):
        return
    lit = {id(one.gaussians): one for one in scene.splats if one.shadow_catcher or one.material is not None}
    for one in lit.values():
        if (remark := ls.surface_remark(one.gaussians, device=device)) is not None:
            yield f"{one.name}: {remark}" if one.name else remark


def _unused_albedos(config: ls.RenderConfig, scene: ls.Scene) -> Iterator[str]:
    """A line if lights shine on captures that have an albedo, and show them as captured for lack of a material."""
    kept = [one for one in scene.splats if one.gaussians.albedo is not None and one.material is None]
    lights = [light for light in scene.lights if light.enabled]
    if config.lighting is not False and lights and any(not one.shadow_catcher for one in kept):
        yield (
            "captures with an albedo stay as captured without a material, whatever shines on them: material = {} of "
            "their [[splats]] in a scene.toml lights them"
        )


def _dark_sides(config: ls.RenderConfig, scene: ls.Scene) -> Iterator[str]:
    """A line if one lamp alone lights things beside a capture, which was captured in light from everywhere.

    Whoever has set up several lamps has thought of the sides.
    """
    lights = [light for light in scene.lights if light.enabled]
    is_surrounded = any(isinstance(light, ls.LightEnvironment) for light in lights)
    bounces = config.pipeline.bounces_light  # there, the capture itself lights them
    if config.lighting is False or len(lights) != 1 or is_surrounded or not scene.splats or bounces:
        return
    relit = [splats.material for splats in scene.splats if splats.material is not None and not splats.shadow_catcher]
    things = {
        "meshes": any(_needs_light(instance.mesh.material) for instance in scene.meshes),
        "relit captures": any(map(_needs_light, relit)),
    }
    dark = " and ".join(name for name, is_dark in things.items() if is_dark)
    if dark:
        yield (
            f"sides of {dark} that no light reaches are black: [environment] in a scene.toml (such as intensity = 0.3, "
            "visible = false) or --environment FILE lights them from all around"
        )


def _clipped_light(config: ls.RenderConfig, scene: ls.Scene, light: LightOptions) -> Iterator[str]:
    """A line if captures alone light what is added, by light that is clipped at a display's white."""
    bounces = config.pipeline.bounces_light and config.lighting is not False
    relit = [one for one in scene.splats if one.material is not None and not one.shadow_catcher]
    has_captures = len(relit) < len(scene.splats)
    asked = config.capture_gain != 0.0 or light.capture_gain is not None
    if bounces and has_captures and (scene.meshes or relit) and not scene.lights and not asked:
        yield (
            "captured light alone shines on what is added, and is clipped at a display's white: --capture-gain auto "
            "(capture_gain of [render] in a scene.toml, in stops) exposes it as its surroundings"
        )


def _needs_light(material: Material) -> bool:
    """Whether a surface is black where no light reaches it: mirrors and glass show something else."""
    own = material.emissive + (material.ambient if isinstance(material, ls.MaterialSimple) else ())
    return not material.is_smooth and not any(own)
