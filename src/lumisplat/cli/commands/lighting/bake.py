"""``lumisplat bake``: a lit scene as a capture that every viewer shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.options.command import DeviceCommand, Flag, PlacingCommand
from lumisplat.cli.options.lighting import LightOptions
from lumisplat.cli.options.settings import changed_config, setting, without_none
from lumisplat.cli.options.up import UpOption, parse_up
from lumisplat.cli.output.console import byte_size, counted, progress_bars
from lumisplat.cli.output.pictures import check_folder
from lumisplat.cli.output.standard_output import STANDARD_OUTPUT, standard_output


@dataclass(frozen=True, kw_only=True)
class Bake(PlacingCommand, DeviceCommand):
    """Write the splat sets of a scene as a capture of how they look in its light, shadows and bounces included.

    Every viewer of captures shows it. Meshes and lights do their part, and are not in it.
    First try: lumisplat bake scene.toml -o baked.ply

    Minutes on a CPU: each Gaussian is seen from --directions, along --samples paths each.
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """A scene.toml whose splat sets have a material, or captures with albedo, such as delight writes. Sets without stay
    as captured. Several become one."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """.ply, .compressed.ply or .spz, in the scene's coordinates, or .glb. - is standard output, a .ply."""
    degree: Annotated[int, arg(metavar="0..3")] = 3
    """How much of what changes with the direction of view is kept, such as highlights; 0 is one colour."""
    samples: Annotated[int, arg(metavar="N")] = 8
    """Paths of light of each ray, at least 2. The time is in proportion; the noise falls with its root."""
    directions: Annotated[int, arg(metavar="N")] = 32
    """From which each Gaussian is seen, 4 to 1024. The time is in proportion; 64 are 0.7 dB nearer in a room."""
    direct: Flag = False
    """Lights and their shadows only, without bounces: faster, and without their noise."""
    max_bounces: Annotated[int | None, setting("0..64", "8")] = None
    """How often light bounces."""
    exposure: Annotated[float, arg(metavar="STOPS")] = 0.0
    """1 is twice as bright, -1 half. What is brighter than a display's white becomes white."""
    tone_map: Annotated[Literal["none", "neutral", "agx"] | None, setting("{none,neutral,agx}", "none")] = None
    """How light becomes display colours, as for render."""
    environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Light from everywhere by a latitude-longitude image, .hdr or .exr, in place of the scene's own."""
    environment_rotation: Annotated[float | None, setting("DEGREES", "0")] = None
    """Turns --environment about the vertical, counter-clockwise seen from above."""
    up: UpOption = "auto"
    """Which way is up, for --environment; auto: as the scene.toml or the capture says, else y down."""
    seed: Annotated[int | None, setting("N", "0")] = None
    """Of all random numbers: the same seed gives the same capture."""

    def run(self) -> None:
        """Loads, bakes, joins, writes."""
        if self.output == STANDARD_OUTPUT:
            with standard_output(".ply") as file:
                replace(self, output=file).run()
            return
        ls.check_format(self.output)  # found now, rather than after the work
        check_folder(self.output.absolute().parent, self.output)
        config = self._config()
        light = LightOptions(environment=self.environment, environment_rotation=self.environment_rotation)
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
        print(f"{self.output}: {joined.count:,} Gaussians, SH degree {joined.sh_degree}, {size}")
        if scene.meshes:
            print(f"{counted(len(scene.meshes), 'mesh instance')} cast shadows and light, and are not in the result")

    def _config(self) -> ls.RenderConfig:
        """The settings: those of a scene.toml, and the options.

        Raises:
            ConfigError: They contradict each other.
        """
        if self.direct and self.max_bounces is not None:
            raise ls.ConfigError("--direct leaves out the bounces that --max-bounces counts: give one of them")
        base = scene_settings(scene_file(self.scene))
        given = {"max_bounces": self.max_bounces, "seed": self.seed, "tone_map": self.tone_map}
        pipeline = ls.Pipeline.TRACE if self.direct else ls.Pipeline.PATH
        whole = {"pipeline": pipeline, "samples": self.samples, "lighting": None}
        return changed_config(base, whole, without_none(given))


def _with_material(instance: ls.SplatInstance) -> ls.SplatInstance:
    """A capture with albedo, of which its file says how it reflects."""
    if instance.material is None and not instance.shadow_catcher and instance.gaussians.albedo is not None:
        return replace(instance, material=ls.MaterialPbr())
    return instance


def _joined(scene: ls.Scene) -> ls.Gaussians:
    """All sets as one, in the coordinates of the scene."""
    placed = [_placed(instance) for instance in scene.splats]
    return placed[0] if len(placed) == 1 else ls.merge(placed)


def _placed(instance: ls.SplatInstance) -> ls.Gaussians:
    """A set where its instance places it."""
    gaussians = ls.limit_sh_degree(instance.gaussians, instance.sh_degree)
    matrix = instance.transform
    return gaussians if (matrix == ls.SplatInstance(gaussians).transform).all() else ls.transform(gaussians, matrix)
