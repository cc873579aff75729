"""``lumisplat bake``: writes a lit scene as a capture that every viewer shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.options.camera import UpOption, parse_up
from lumisplat.cli.options.command import (
    DeviceCommand,
    Flag,
    InsertingCommand,
    SetCommand,
    changed_config,
    own_options_first,
    setting,
    without_none,
)
from lumisplat.cli.options.frame import EnvironmentOptions
from lumisplat.cli.output.console import byte_size, counted, progress_bars
from lumisplat.cli.output.images import STANDARD_OUTPUT, check_folder, standard_output


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Bake(InsertingCommand, DeviceCommand, SetCommand):
    """Write a lit scene as a capture that every viewer shows.

    Bakes lights, shadows and bounces into the colours of Gaussians; meshes and lights are not in the result.
    Takes minutes on a CPU.
    Guide: docs/guide/bake.md.
    First try: lumisplat bake scene.toml -o baked.ply
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read a scene.toml with materials, or captures with albedo; several files become one capture."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """Write .ply, .compressed.ply, .spz or .glb; - is standard output."""
    degree: Annotated[int, arg(metavar="0..3")] = 3
    """Keep view-dependent colour up to this SH degree."""
    samples: Annotated[int, arg(metavar="N")] = 8
    """Trace N paths for each viewing direction, at least 2."""
    directions: Annotated[int, arg(metavar="N")] = 32
    """View each Gaussian from N directions, 4 to 1024."""
    direct: Flag = False
    """Bake lights and shadows only, without bounces."""
    exposure: Annotated[float, arg(metavar="STOPS", help_behavior_hint="(default: 0)")] = 0.0
    """Brighten the baked colours by this many stops."""
    tone_map: Annotated[Literal["none", "neutral", "agx"] | None, setting("NAME", "none")] = None
    """Tone-map lit colours by none (clips), neutral (preserves hues) or agx (filmic)."""
    environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Light the scene with this latitude-longitude image, .hdr or .exr."""
    environment_rotation: Annotated[float | None, setting("N", "0")] = None
    """Rotate the environment by N degrees about the vertical, counter-clockwise from above."""
    up: UpOption = "auto"
    """Set the up direction: y-up, y-down, z-up ..., or a vector."""

    def run(self) -> None:
        """Loads the scene, bakes its light, and writes all captures as one."""
        if self.output == STANDARD_OUTPUT:
            with standard_output(".ply") as file:
                replace(self, output=file).run()
            return
        ls.io.check_format(self.output)  # fails before the slow work
        check_folder(self.output.absolute().parent, self.output)
        config = self._config()
        light = EnvironmentOptions(environment=self.environment, environment_rotation=self.environment_rotation)
        environment = light.environment_light()
        with progress_bars() as report:
            self.quiet_warp()
            scene = self.load_scene(self.scene, report, given_up=parse_up(self.up))
            scene = light.lit_scene(replace(scene, splats=tuple(map(_with_material, scene.splats))), environment)
            baked = ls.bake(
                scene,
                config,
                degree=self.degree,
                directions=self.directions,
                exposure=self.exposure,
                device=self.device,
                progress=report,
            )
            report("writing", 0.0)
            joined = _joined(baked)
            ls.save(self.output, joined)
        size = byte_size(self.output.stat().st_size)
        print(f"{self.output}: {counted(joined.count, 'Gaussian')}, SH degree {joined.sh_degree}, {size}")
        if scene.meshes:
            print(f"{counted(len(scene.meshes), 'mesh instance')} cast shadows and light, but are not in the result")

    def _config(self) -> ls.RenderConfig:
        """Returns the render settings of the scene.toml, or the defaults, changed by the command's options."""
        if self.direct and "max_bounces" in self.set_values():
            raise ls.ConfigError("--direct has no bounces for --set max_bounces to count: leave out one of them")
        base = scene_settings(scene_file(self.scene))
        pipeline = ls.Pipeline.TRACE if self.direct else ls.Pipeline.PATH
        whole = {"pipeline": pipeline, "samples": self.samples, "lighting": None}
        return self.changed(changed_config(base, whole, without_none({"tone_map": self.tone_map})))


def _with_material(instance: ls.SplatInstance) -> ls.SplatInstance:
    """Returns a capture instance with a default material if its file stores an albedo, so that lights affect it.

    An instance with a material, and a shadow catcher, is returned unchanged.
    """
    if instance.material is None and not instance.shadow_catcher and instance.gaussians.albedo is not None:
        return replace(instance, material=ls.MaterialPbr())
    return instance


def _joined(scene: ls.Scene) -> ls.Gaussians:
    """Returns the Gaussians of all captures of a scene as one capture in world coordinates."""
    placed = [_placed(instance) for instance in scene.splats]
    return placed[0] if len(placed) == 1 else ls.merge(placed)


def _placed(instance: ls.SplatInstance) -> ls.Gaussians:
    """Returns an instance's Gaussians in world coordinates, their SH reduced to the instance's degree."""
    gaussians = ls.editing.limit_sh_degree(instance.gaussians, instance.sh_degree)
    matrix = instance.transform
    return gaussians if (matrix == ls.SplatInstance(gaussians).transform).all() else ls.transform(gaussians, matrix)
