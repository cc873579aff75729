"""``lumisplat view``: a scene in a browser, to fly through, to edit and to light."""

from __future__ import annotations

import sys
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.options.command import DeviceCommand, Flag, LevelsCommand, PlacingCommand
from lumisplat.cli.options.lighting import LightGroup, LightOptions
from lumisplat.cli.options.rays import PipelineName, RayGroup, RayOptions
from lumisplat.cli.options.settings import Changes, changed_config, setting
from lumisplat.cli.options.up import UpOption, parse_up

_PORT = 8080


@dataclass(frozen=True, kw_only=True)
class View(LevelsCommand, PlacingCommand, DeviceCommand):
    """Look at a scene in a browser, edit it and light it.

    Prints one line, the address of the page, and serves it until it is interrupted. Drag to turn, scroll to come
    nearer, WASD to fly; click a thing to select it.
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Captures (.ply, .compressed.ply, .spz, .sog), meshes (.obj, .ply, .stl), both (.glb, .gltf, .usda, .usdc, .usdz,
    .usd), or a scene.toml. Files that cannot be read are left out, and listed on the page."""
    port: Annotated[int, arg(metavar="N")] = _PORT
    """Port to listen on; 0: a free one."""
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on. Others than 127.0.0.1 let other machines in, if they have the address with its token."""
    no_browser: Flag = False
    """Open no browser; the address is printed anyway."""
    height: Annotated[int, arg(metavar="PX")] = 720
    """Rows of pictures at rest; while the view moves, they may have fewer."""
    budget: Annotated[float, arg(metavar="MS")] = 40.0
    """Milliseconds that a frame may take while the view moves: fewer Gaussians are drawn first, then fewer pixels."""
    up: UpOption = "auto"
    """Which way is up: y-down, y-up, z-up, z-down, x-up, x-down or a direction. auto: as the scene.toml or
    the capture says, else y down with a capture, y up for meshes alone."""
    pipeline: Annotated[PipelineName | None, setting("{raster,trace,hybrid,path,realtime}", "hybrid if lit")] = None
    """How it is rendered at first; the page can change it."""
    rays: RayGroup = field(default_factory=RayOptions)
    """At first; the page can change them."""
    light: LightGroup = field(default_factory=LightOptions)
    """At first; the page can change them."""

    def run(self) -> None:
        """Serves the page until it is interrupted."""
        if not self.scene:
            raise ls.ConfigError("no scene given: name a capture, a mesh or a scene.toml")
        self.check_levels(self.scene)
        levels = self.levels
        self.quiet_warp()
        viewer = ls.view(
            list(self.scene),
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
        """Settings with those that were given in their place.

        Raises:
            ConfigError: A value is out of its range.
        """
        own: Changes = {} if self.pipeline is None else {"pipeline": ls.Pipeline(self.pipeline)}
        return changed_config(base, own, self.rays.changes(), self.light.changes())


def _open_browser(url: str) -> bool:
    """Opens the page; False: there is no browser."""
    try:
        return webbrowser.open(url)
    except webbrowser.Error:
        return False
