"""``lumisplat relight``: relights an avatar by the light of a scene, and writes it as a capture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import scene_file, scene_settings
from lumisplat.cli.input.numbers import vector
from lumisplat.cli.options.camera import UpOption, parse_up, warn_if_up_is_guessed
from lumisplat.cli.options.command import (
    DeviceCommand,
    InsertingCommand,
    SetCommand,
    changed_config,
    given_settings_of,
    own_options_first,
    setting,
)
from lumisplat.cli.output.console import Report, counted, progress_bars
from lumisplat.cli.output.images import STANDARD_OUTPUT, standard_output

_SH_Y00 = 0.5 / math.sqrt(math.pi)
"""Value of the SH basis function of degree 0, ``1 / (2 sqrt(pi))``; times the degree-0 coefficient of a light probe,
it gives the probe's mean radiance."""
_GAMMA_MAX = 1000.0
"""Largest value that ``--gamma`` accepts."""


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Relight(InsertingCommand, DeviceCommand, SetCommand):
    """Relight an avatar or object by the light of a scene.

    Scales each Gaussian's colour by the light that reaches its normal.
    Guide: docs/guide/relight.md.
    First try: lumisplat relight avatar.ply room.ply -o relit.ply
    """

    avatar: Positional[Annotated[Path, arg(metavar="AVATAR")]]
    """Read a capture, or a scene.toml that places one."""
    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Gather light from these captures and meshes, or a scene.toml."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")] = Path("relit.ply")
    """Write .ply, .compressed.ply, .spz or .glb; - is standard output."""
    at: Annotated[str | None, arg(metavar="X,Y,Z", help_behavior_hint="(default: the avatar's centre)")] = None
    """Gather the light at this point, in the scene's coordinates."""
    gamma: Annotated[float | None, setting("0..1000", "1")] = None
    """Multiply the gathered light by this factor."""
    exponent: Annotated[float | None, setting("0.1..64", "1")] = None
    """Set the exponent of the cosine lobe that gathers light: 1 is matt, more glossier."""
    scale_max: Annotated[float | None, setting("0..1000", "4")] = None
    """Limit the factor by which light scales a colour, before --gamma."""
    normals: Annotated[Literal["auto", "smallest-axis", "pca"] | None, setting("NAME", "auto")] = None
    """Take normals from the file, else smallest-axis (auto), always smallest-axis, or from neighbours (pca)."""
    degree: Annotated[int, arg(metavar="0..8")] = 3
    """Store the light as SH of this degree."""
    near: Annotated[float, arg(metavar="UNITS")] = 0.01
    """Ignore parts of the scene nearer than this to the point of --at."""
    background: Annotated[str | None, setting("COLOR", "black")] = None
    """Set the colour of light from directions in which the scene is empty."""
    probe: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the gathered light as an image, .exr."""
    up: UpOption = "auto"
    """Set the up direction of the scene, and of the image of --probe."""

    def run(self) -> None:
        """Gathers the light of the scene, relights the avatar and writes it."""
        if self.output == STANDARD_OUTPUT:
            with standard_output(".ply") as file:
                replace(self, output=file).run()
            return
        config = ls.config.RelightConfig(**given_settings_of(self, ls.config.RelightConfig))
        at = None if self.at is None else vector("--at", self.at, "0,1,2.5")
        self._check_outputs()
        rendering = scene_settings(scene_file(self.scene))
        if self.background is not None:
            rendering = changed_config(rendering, {"background": self.background})
        rendering = self.changed(rendering)
        with progress_bars() as report:
            renderer = self.start_renderer(report, rendering)
            avatar = self._loaded_avatar(report)
            scene = self.load_scene(self.scene, report, given_up=parse_up(self.up))
            position = at or _center_of_bulk(avatar)
            report("gathering light", 0.0)
            probe = ls.avatars.EnvironmentProbe.capture(scene, position, self.degree, near=self.near, renderer=renderer)
            report("relighting", 0.0)
            relit = ls.relight(avatar, probe, config).gaussians
            report("writing", 0.0)
            ls.save(self.output, relit)
            if self.probe is not None:
                warn_if_up_is_guessed(scene)
                probe.save(self.probe, rotation_wxyz=scene.upright_wxyz)
        self._print_summary(relit, probe, position)

    def _check_outputs(self) -> None:
        """Raises a FormatError if an output cannot be written, before the slow relighting."""
        ls.io.check_format(self.output)
        if self.probe is not None and self.probe.suffix.lower() != ".exr":
            raise ls.FormatError(self.probe, "unknown extension for the image of a probe, expected .exr")

    def _loaded_avatar(self, report: Report) -> ls.SplatInstance:
        """Loads the avatar as an instance: a scene.toml also gives it a transform, a capture file none."""
        asset = self.load_asset(self.avatar, report)
        if isinstance(asset, ls.Gaussians):
            return ls.SplatInstance(asset)
        if isinstance(asset, ls.Scene) and len(asset.splats) == 1:
            return asset.splats[0]
        raise ls.FormatError(
            self.avatar,
            "is not a capture, nor a scene.toml with one: relight takes Gaussians (Python: ls.gaussians_from_mesh)",
        )

    def _print_summary(
        self, relit: ls.Gaussians, probe: ls.avatars.EnvironmentProbe, position: tuple[float, float, float]
    ) -> None:
        """Prints where the result was written, and the mean of the gathered light.

        If the light is much darker or brighter than display white, suggests the ``--gamma`` that keeps the avatar's
        brightness.

        Args:
            relit: The result.
            probe: Light gathered from the scene.
            position: World position at which it was gathered.
        """
        mean = _SH_Y00 * probe.coefficients[0]
        print(
            f"{self.output}: {counted(relit.count, 'Gaussian')} in the light at "
            f"({', '.join(f'{x:g}' for x in position)})"
        )
        print(f"mean light there, red green blue, 1 is display white: {' '.join(f'{x:.3f}' for x in mean)}")
        brightness = float(mean.mean())
        if brightness * _GAMMA_MAX < 1.0:
            print("there is almost no light: choose another position by --at, or give a --background")
        elif self.gamma in (None, 1.0) and not 0.5 < brightness < 2.0:
            print(f"to keep the avatar about as bright as it was: --gamma {1.0 / brightness:.2g}")
        if self.probe is not None:
            print(f"{self.probe}: the light as an image")


def _center_of_bulk(avatar: ls.SplatInstance) -> tuple[float, float, float]:
    """Returns the world-space centre of an avatar's bounding box, which leaves out stray Gaussians."""
    low, high = ls.Scene(splats=(avatar,)).bulk_bounds()
    x, y, z = (float(value) for value in 0.5 * (low + high))
    return x, y, z
