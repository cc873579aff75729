"""``lumisplat delight``: estimates the materials of a capture, separated from the light in which it was captured."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import holds_materials
from lumisplat.cli.options.camera import UpOption, parse_up, upright, warn_if_up_is_guessed
from lumisplat.cli.options.command import (
    DeviceCommand,
    Flag,
    LevelsCommand,
    given_settings_of,
    own_options_first,
    setting,
)
from lumisplat.cli.output.console import Report, counted, progress_bars
from lumisplat.cli.output.images import STANDARD_OUTPUT, check_folder, standard_output

_INSIDE = {"auto": None, "yes": True, "no": False}


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Delight(LevelsCommand, DeviceCommand):
    """Find the materials of a capture, without its captured light.

    Needs no images. The lights of a scene then light the capture like a mesh.
    Takes a minute for 100,000 Gaussians; --cells 8 takes less.
    Guide: docs/guide/delight.md.
    First try: lumisplat delight garden.ply -o garden.relit.ply
    """

    capture: Positional[Annotated[Path, arg(metavar="CAPTURE")]]
    """Read this capture."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """Write .ply, glTF or OpenUSD, which hold materials; - is standard output."""
    inside: Annotated[Literal["auto", "yes", "no"], arg(metavar="auto|yes|no")] = "auto"
    """Treat the capture as a room, which has no environment: auto, yes or no."""
    save_environment: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the estimated environment as an image, .exr."""
    up: UpOption = "auto"
    """Set the up direction in the image of --save-environment."""
    cells: Annotated[int | None, setting("4..32", "12")] = None
    """Trace light at each Gaussian in N x N directions; slower for larger N."""
    matt: Flag = False
    """Take all captured colour as albedo; suits materials without specular reflection."""
    seed: Annotated[int | None, setting("N", "0")] = None
    """Set the random seed."""

    def run(self) -> None:
        """Loads the capture, estimates its materials and environment, and writes them."""
        if self.output == STANDARD_OUTPUT:
            with standard_output(".ply") as file:
                replace(self, output=file).run()
            return
        self._check_outputs()
        self.check_levels([self.capture])
        given = given_settings_of(self, ls.config.DelightConfig)
        given["inside"] = _INSIDE[self.inside]
        config = ls.config.DelightConfig(**given)
        with progress_bars() as report:
            self.quiet_warp()
            capture = self._loaded(report)
            try:
                found = ls.inverse.estimate_materials(capture, config, device=self.device, progress=report)
            except ls.SceneError as error:
                raise ls.FormatError(self.capture, str(error)) from None
            report("writing", 0.0)
            ls.save(self.output, found.gaussians)
            if self.save_environment is not None and not found.is_inside:
                self._save_environment(found, self.save_environment, capture)
        print(f"{self.output}: {counted(capture.count, 'Gaussian')} with albedo, roughness and normals")
        for remark in found.remarks:
            print(remark)
        if self.save_environment is not None:
            outcome = "the environment as an image" if not found.is_inside else "not written: a room has no environment"
            print(f"{self.save_environment}: {outcome}")

    def _save_environment(self, found: ls.inverse.MaterialEstimate, path: Path, capture: ls.Gaussians) -> None:
        """Writes the estimated environment as a latitude-longitude image, turned to the up direction of ``--up``."""
        try:
            scene = upright(ls.Scene([capture]), self.up)
            warn_if_up_is_guessed(scene)
            found.save_environment(path, scene.upright_wxyz)
        except ls.FormatError as error:
            error.add_note(f"{self.output} is written")
            raise

    def _check_outputs(self) -> None:
        """Raises an error if the capture or the environment cannot be written; called before the slow estimation."""
        parse_up(self.up)
        if self.save_environment is not None and self.inside == "yes":
            raise ls.ConfigError("--save-environment and --inside yes exclude each other: a room has no environment")
        if not holds_materials(self.output):
            raise ls.FormatError(
                self.output,
                "expected .ply, .glb, .gltf, .usda, .usdc, .usdz or .usd: others cannot store materials",
            )
        ls.io.check_format(self.output)  # also checks for the packages that write the format
        if self.save_environment is not None and self.save_environment.suffix.lower() != ".exr":
            raise ls.FormatError(self.save_environment, "unknown extension for an environment image, expected .exr")
        for path in (self.output, self.save_environment):
            if path is not None:
                check_folder(path.absolute().parent, path)

    def _loaded(self, report: Report) -> ls.Gaussians:
        """Loads the file, and raises a FormatError unless it is a single capture."""
        asset = self.load_asset(self.capture, report)
        if not isinstance(asset, ls.Gaussians):
            raise ls.FormatError(self.capture, "is not a capture: delight takes a file of Gaussians")
        return asset
