"""``lumisplat shadowmap``: bakes the shadows of added objects into a capture."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file
from lumisplat.cli.input.numbers import vector
from lumisplat.cli.options.command import (
    LIGHTING,
    DeviceCommand,
    InsertingCommand,
    SetCommand,
    own_options_first,
    setting,
    without_none,
)
from lumisplat.cli.output.console import Report, byte_size, counted, found_light, progress_bars, up_name
from lumisplat.cli.output.images import (
    STANDARD_OUTPUT,
    Shot,
    check_writable,
    make_folder,
    plan_shots,
    refuse_standard_output,
    standard_output,
)

if TYPE_CHECKING:
    from lumisplat.scene.lights import Light

_CAPTURES = (".ply", ".spz")


@own_options_first
@dataclass(frozen=True, kw_only=True)
class ShadowMap(InsertingCommand, DeviceCommand, SetCommand):
    """Bake the shadows of avatars and objects into a capture.

    Guide: docs/guide/shadow_maps.md.
    First try: lumisplat shadowmap statue.obj --onto garden.ply --light 0.5,-4,2 -o shadowed.ply
    """

    casters: Positional[Annotated[tuple[Path, ...], arg(metavar="CASTER...", help_behavior_hint="")]] = ()
    """Read the objects that cast shadows: captures, meshes, or a scene.toml."""
    onto: Annotated[Path, arg(metavar="FILE")]
    """Cast the shadows onto this capture."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """Write a .ply or .spz, a map .npz, or images; - is standard output."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write images of shadow strength, white where no light arrives, one for each camera."""
    light: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="X,Y,Z")] = ()
    """Place a light at this point; without, use the files' lights or estimated ones."""
    sun: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="")] = None
    """Set the direction in which sunlight travels, in place of --light."""
    direct: Annotated[float | None, setting("0..1", "0.7")] = None
    """Set the largest fraction of the capture's light that shadows remove."""
    strength: Annotated[float | None, setting("FACTOR", "1")] = None
    """Multiply the absorption of light by the casters by this factor."""
    absorption: Annotated[Literal["simple", "avg", "mass", "diag"] | None, setting("NAME", "avg")] = None
    """Convert opacity to absorption: avg, or the ablations simple, mass and diag."""
    sampling: Annotated[Literal["center", "stencil", "monte-carlo"] | None, setting("NAME", "monte-carlo")] = None
    """Sample the map per Gaussian by center, stencil (7 points) or monte-carlo (random points)."""
    resolution: Annotated[int | None, setting("TEXELS", "2048")] = None
    """Set the number of texels across the map."""
    changes: Annotated[UseAppendAction[tuple[str, ...]], arg(name="set", metavar="NAME=VALUE")] = ()
    """Change a setting of animation.lighting, such as animation.lighting.estimation.evidence=0."""

    def run(self) -> None:
        """Casts the shadows, and writes the darkened capture or, for an .npz output, the shadow map."""
        if self.cameras is not None:
            refuse_standard_output(self.output)
        if self.output == STANDARD_OUTPUT:
            with standard_output(".ply") as file:
                replace(self, output=file).run()
            return
        is_map = self.output.suffix.lower() == ".npz"
        shots = self._shots()
        if not shots and not is_map and self.output.suffix.lower() not in _CAPTURES:
            raise ls.ConfigError(
                f"{self.output}: expected .ply, .compressed.ply, .spz, or .npz for the map; images need --cameras"
            )
        if self.direct is not None and (is_map or shots):
            what = (
                "a map stores the transmittance of a light" if is_map else "images hold the whole shadow of the lights"
            )
            raise ls.ConfigError(f"--direct needs a capture as output: {what}")
        lights, config = self._lights(), self._config()
        self.quiet_warp()
        with progress_bars() as report:
            capture = self.load_asset(self.onto, report)
            if not isinstance(capture, ls.Gaussians):
                raise ls.FormatError(self.onto, "is not a capture: shadows are cast onto Gaussians only")
            receiver = ls.Scene(splats=(ls.SplatInstance(capture),))
            up = receiver.up_direction
            casters = self.load_scene(self.casters, report, up, around=receiver)
            report("casting shadows", 0.0)
            lights = lights or casters.lights
            if shots:
                lighter = ls.AvatarLighter(receiver, lights or None, config, device=self.device, progress=report)
                summary = self._save_images(shots, casters, capture, lighter, report)
            else:
                save = self._save_map if is_map else self._save_capture
                summary = save(casters, capture, lights, config, report)
            report("casting shadows", 1.0)
        print(summary)
        if scene_file(self.casters):
            whose = "as in the capture" if casters.up == up else "as their scene.toml says"
            print(f"casters: up is {up_name(casters.up_direction)}, {whose}")

    def _save_capture(
        self,
        casters: ls.Scene,
        capture: ls.Gaussians,
        lights: tuple[Light, ...],
        config: ls.config.AvatarLightingConfig,
        report: Report,
    ) -> str:
        """Writes the capture darkened by the shadows of the casters; returns a summary line."""
        scene = ls.Scene(splats=(ls.SplatInstance(capture),))
        lighter = ls.AvatarLighter(scene, lights or None, config, device=self.device, progress=report)
        shadowed = lighter.light([*casters.splats, *casters.meshes]).splats[0].gaussians
        ls.save(self.output, shadowed)
        changed = int((shadowed.sh != capture.sh).any(axis=(1, 2)).sum())
        return f"{self.output}: {changed:,} of {capture.count:,} Gaussians are in shadow{_found_light(lighter)}"

    def _save_images(
        self,
        shots: list[Shot],
        casters: ls.Scene,
        capture: ls.Gaussians,
        lighter: ls.AvatarLighter,
        report: Report,
    ) -> str:
        """Writes images of shadow strength, which show the capture without the casters; returns a summary line.

        A pixel is the strength S of Mir et al. (2026, section 4.2): 0 where the light of all lights arrives, 1 where
        none does, of the Gaussians that it shows, blended as colours are; over the background it is 0.
        """
        if lighter.lights is None:
            lighter.light([*casters.splats, *casters.meshes])  # finds lights around the casters
        casting = lighter.lights or ()
        maps = [
            ls.DeepShadowMap.build(
                casters, one, capture, lighter.config.shadow_map, device=self.device, progress=report
            )
            for one in casting
        ]
        receivers = ls.avatars.shadow_strength(capture, casting, [one.transmittance_of(capture) for one in maps])
        renderer = self.start_renderer(report, ls.RenderConfig(lighting=False))
        if shots[0].path != self.output:
            make_folder(self.output)
        for shot in shots:
            renderer.render(ls.Scene(splats=(ls.SplatInstance(receivers),)), shot.camera).save(shot.path)
        return f"{self.output}: shadow strength in {counted(len(shots), 'image')}{_found_light(lighter)}"

    def _shots(self) -> list[Shot]:
        """Returns the cameras of ``--cameras`` and the file of each one's image; empty without the option.

        Raises:
            ConfigError: The output is no PNG and no folder, or one file for several cameras.
            FormatError: The file has no cameras.
        """
        if self.cameras is None:
            return []
        cameras = ls.load_cameras(self.cameras)
        if not cameras:
            raise ls.FormatError(self.cameras, "has no cameras")
        if self.output.suffix.lower() not in ("", ".png"):
            raise ls.ConfigError(f"{self.output}: --cameras writes images, expected .png or a folder")
        check_writable(self.output)
        if self.output.suffix and len(cameras) > 1:
            raise ls.ConfigError(f"{self.output}: {len(cameras)} images do not fit into one file: give a folder")
        return plan_shots(cameras, (), self.output, "png")

    def _save_map(
        self,
        casters: ls.Scene,
        capture: ls.Gaussians,
        lights: tuple[Light, ...],
        config: ls.config.AvatarLightingConfig,
        report: Report,
    ) -> str:
        """Writes the deep shadow map of the only light as .npz; returns a summary line.

        Raises:
            ConfigError: There is not exactly one light.
        """
        if len(lights) != 1:
            raise ls.ConfigError(f"a map needs one light, got {len(lights)}: give one --light or a --sun")
        shadow = ls.DeepShadowMap.build(
            casters, lights[0], capture, config.shadow_map, device=self.device, progress=report
        )
        shadow.save(self.output)
        stats = shadow.stats
        return (
            f"{self.output}: {stats.voxels:,} bins of {stats.texels:,} texels behind "
            f"{counted(stats.casters, 'Gaussian')}, {byte_size(self.output.stat().st_size)}"
        )

    def _config(self) -> ls.config.AvatarLightingConfig:
        """Returns the settings of the shadows, from the command's options and, last, ``--set``.

        Raises:
            ConfigError: A setting is unknown or its value is out of range.
        """
        if others := [*self.set_values()]:
            raise ls.ConfigError(f"--set {others[0]}: expected a setting of {LIGHTING.rstrip('.')}")
        changes = without_none({"strength": self.strength, "resolution": self.resolution})
        if self.absorption is not None:
            changes["absorption"] = ls.config.Absorption(self.absorption)
        if self.sampling is not None:
            changes["sampling"] = ls.config.ReceiverSampling(self.sampling)
        shadow_map = replace(ls.config.DeepShadowConfig(), **changes)
        config = ls.config.AvatarLightingConfig(shadow_map=shadow_map, **without_none({"direct": self.direct}))
        return replace(self.changed(config, LIGHTING), relight=False)

    def _lights(self) -> tuple[ls.LightPoint | ls.LightDirectional, ...]:
        """Returns the lights of ``--light`` or ``--sun``; empty without these options."""
        if self.sun is not None and self.light:
            raise ls.ConfigError("--sun and --light are both given: choose one")
        if self.sun is not None:
            return (ls.LightDirectional(vector("--sun", self.sun)),)
        return tuple(ls.LightPoint(vector("--light", text)) for text in self.light)


def _found_light(lighter: ls.AvatarLighter) -> str:
    """Returns a further line for the summary about lights that were found; empty if lights were given."""
    found = found_light(lighter)
    return "" if found is None else f"\nno lights were given; shadows use those that were found: {found}"
