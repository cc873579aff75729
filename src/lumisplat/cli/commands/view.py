"""``lumisplat view``: shows a scene in a browser, to fly through, edit and light."""

from __future__ import annotations

import sys
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.programs import PROGRAM, run_program
from lumisplat.cli.options.camera import UpOption, parse_up
from lumisplat.cli.options.command import (
    DeviceCommand,
    Flag,
    InsertingCommand,
    LevelsCommand,
    PipelineName,
    SamplesCommand,
    own_options_first,
    setting,
)
from lumisplat.cli.options.frame import LightGroup, LightOptions

_PORT = 8080


@own_options_first
@dataclass(frozen=True, kw_only=True)
class View(LevelsCommand, InsertingCommand, DeviceCommand, SamplesCommand):
    """Look at a scene in a browser, edit it and light it.

    Prints the address of the page, and serves it until interrupted.
    Guide: docs/guide/viewer.md.
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read captures, meshes, glTF, OpenUSD, a scene.toml, or a Python file with an animation."""
    port: Annotated[int, arg(metavar="N")] = _PORT
    """Listen on this port; 0 chooses a free one."""
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Listen on this address; addresses other than 127.0.0.1 let other machines in."""
    no_browser: Flag = False
    """Print the address without opening a browser."""
    height: Annotated[int, arg(metavar="PX")] = 720
    """Set the image height while the view is still."""
    budget: Annotated[float, arg(metavar="MS", help_behavior_hint="(default: 40)")] = 40.0
    """Limit the time of each frame while the view moves, by reducing detail."""
    up: UpOption = "auto"
    """Set the up direction: y-up, y-down, z-up ..., or a vector."""
    pipeline: Annotated[PipelineName | None, setting("NAME", "the file's; else hybrid if lit, or raster")] = None
    """Render by raster, trace, hybrid, path or realtime."""
    light: LightGroup = field(default_factory=LightOptions)
    """Start with these light settings; the page can change them."""

    def run(self) -> None:
        """Serves the page until interrupted."""
        if not self.scene:
            raise ls.ConfigError("no scene given: name a capture, a mesh or a scene.toml")
        programs = [path for path in self.scene if path.suffix.lower() == PROGRAM]
        if programs and len(self.scene) > 1:
            raise ls.ConfigError(f"{programs[0]} is a program, which is a scene of its own: view it alone")
        self.check_levels(self.scene)
        self._config(ls.RenderConfig())  # mistakes in --set are found before the page opens
        levels = self.levels
        self.quiet_warp()
        viewer = ls.view(
            run_program(programs[0]) if programs else list(self.scene),
            config=self._config,
            port=self.port,
            host=self.host,
            device=self.device,
            height=self.height,
            budget_ms=self.budget,
            up=parse_up(self.up),
            drop_invalid=self.drop_invalid,
            lod=levels["lod"],
            lod_budget=levels["budget"],
            keep_coordinates=self.keep_coordinates,
        )
        try:
            print(viewer.url, flush=True)
            if self.host not in ("127.0.0.1", "localhost", "::1"):
                print(
                    f"open to all machines that reach {self.host}, if they have this address, with this machine's name "
                    "in place of 127.0.0.1; the connection is not encrypted",
                    file=sys.stderr,
                )
            if not self.no_browser and not _open_browser(viewer.url):
                print("no browser could be opened: open the address above", file=sys.stderr)
            viewer.wait()
        finally:
            viewer.close()

    def _config(self, base: ls.RenderConfig) -> ls.RenderConfig:
        """Returns render settings, the scene file's or the defaults, changed by the command's options."""
        return self.pipeline_config(base, self.light.changes())


def _open_browser(url: str) -> bool:
    """Opens an address in the default browser; returns False if there is none."""
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
