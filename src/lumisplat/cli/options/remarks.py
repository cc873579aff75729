"""Lines about a frame's settings that are logged before it is rendered."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import lumisplat as ls
from lumisplat.cli.options.lighting import EnvironmentOptions
from lumisplat.cli.options.settings import given_options

if TYPE_CHECKING:
    from lumisplat.scene.materials import Material


_OF_SAMPLES = ("samples", "time_limit", "noise", "seed", "jitter")
_OF_RAYS = ("trace.", "max_bounces", "glossy_reflections")
_NOT_OF_PATHS = ("trace.strategy", "glossy_reflections")


def frame_remarks(
    config: ls.RenderConfig,
    scene: ls.Scene,
    given: Mapping[str, str],
    light: EnvironmentOptions,
    *,
    device: str = "auto",
) -> Iterator[str]:
    """Yields lines about what has no effect, and what comes out black or in patches.

    Args:
        config: Settings of the frame.
        scene: What it shows.
        given: The settings that were given, each with the option that gives it.
        light: The options of light.
        device: As of ``--device``.
    """
    yield from unused_options(config, scene, given, light)
    yield from _unused_albedos(config, scene)
    yield from _dark_sides(config, scene)
    yield from _lit_fog(config, scene, device)
    yield from _clipped_light(config, scene, light)


def unused_options(
    config: ls.RenderConfig, scene: ls.Scene, given: Mapping[str, str], light: EnvironmentOptions
) -> Iterator[str]:
    """Yields a line for each reason why options are not used; arguments as of `frame_remarks`."""

    def options(*names: str) -> list[str]:
        """Those given, of these settings and groups."""
        return [text for name, text in given.items() if name in names or name.startswith(_groups(names))]

    is_path = config.pipeline.traces_paths
    bounces = config.pipeline.bounces_light
    lit = config.is_lit(by_default=scene.is_lit_by_default)
    shadowed = lit and config.shadows is not ls.Shadows.OFF
    if not config.pipeline.rasterises and (unused := options("raster.")):
        yield not_used(config, unused, "raster and hybrid")
    if not config.pipeline.spawns_rays:
        used = _used_by_raster(config, lit=lit, shadowed=shadowed)
        unused = [one for one in options(*_OF_SAMPLES, *_OF_RAYS, "response.") if one not in options(*used)]
        if unused:
            yield not_used(config, unused, "trace and hybrid")
    if not is_path and (unused := options("path.")):
        yield not_used(config, unused, "path")
    if not config.pipeline.is_sequence and (unused := options("realtime.")):
        yield not_used(config, unused, "realtime")
    if is_path and (unused := options(*_NOT_OF_PATHS)):
        yield (
            f"not used by --pipeline path: {', '.join(unused)} (its rays meet one relit Gaussian, by chance, blend "
            "captures that are kept, and reflect what is around)"
        )
    if not lit:
        unused = [*(option for option in given_options(light) if option != "--lighting"), *options("shadow_rays.")]
        if unused:
            why = "--lighting is off" if config.lighting is False else "no lights: --lighting on has one at the camera"
            yield f"not used in an unlit frame: {', '.join(unused)} ({why})"
    elif bounces and light.shadows == "hard":
        yield f"not used by --pipeline {config.pipeline.value}: --shadows hard (its shadows are soft)"
    elif not shadowed and (unused := options("shadow_rays.")):
        yield f"not used without shadows: {', '.join(unused)} (--shadows hard or soft has some)"


def not_used(config: ls.RenderConfig, options: list[str], others: str) -> str:
    """Returns the line that a pipeline does not use options, and which others do."""
    are = "it is" if len(options) == 1 else "they are"
    return f"not used by --pipeline {config.pipeline.value}: {', '.join(options)} ({are} of --pipeline {others})"


def _groups(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in names if name.endswith("."))


def _used_by_raster(config: ls.RenderConfig, *, lit: bool, shadowed: bool) -> list[str]:
    """Settings of samples and rays that a rasterised frame uses: those of samples, and those of shadow rays."""
    used: list[str] = []
    raster = config.raster
    if (
        lit
        or raster.strategy is ls.config.RasterStrategy.STOCHASTIC
        or raster.projection is ls.config.Projection.UNSCENTED
    ):
        used += _OF_SAMPLES
    if shadowed:
        used.append("response.")
    return used


def _lit_fog(config: ls.RenderConfig, scene: ls.Scene, device: str) -> Iterator[str]:
    """A line for each capture that takes light or shadows, and has no surface for them."""
    if config.lighting is False or not any(light.enabled for light in scene.lights):
        return
    lit = {id(one.gaussians): one for one in scene.splats if one.shadow_catcher or one.material is not None}
    for one in lit.values():
        if (remark := ls.inverse.surface_remark(one.gaussians, device=device)) is not None:
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


def _clipped_light(config: ls.RenderConfig, scene: ls.Scene, light: EnvironmentOptions) -> Iterator[str]:
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
