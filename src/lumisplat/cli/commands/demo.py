"""``lumisplat demo``: pictures of a scene that the package makes itself."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

import lumisplat as ls
from lumisplat.cli.options.command import DeviceCommand, Flag
from lumisplat.cli.output.console import Report, progress_bars
from lumisplat.cli.output.images import check_writable, make_folder, plan_shots


@dataclass(frozen=True, kw_only=True)
class Demo(DeviceCommand):
    """Render the demo scene; nothing is downloaded."""

    output: Annotated[Path, arg(aliases=("-o",), metavar="FOLDER")] = Path("out")
    """Write the images into this folder."""
    width: Annotated[int | None, arg(metavar="PX", help_behavior_hint="")] = None
    """Set the image width; lit images are twice as wide."""
    save_assets: Flag = False
    """Write demo.ply and transforms.json too, to try other commands."""

    def run(self) -> None:
        """Builds, renders, writes."""
        cameras = ls.demo_cameras()
        shots = plan_shots([camera.scaled(self.width) for camera in cameras], (), self.output, "png")
        check_writable(self.output)
        with progress_bars() as report:
            renderer = self.start_renderer(report, ls.RenderConfig(lighting=False))
            make_folder(self.output)
            scene = ls.demo_scene(report)
            if self.save_assets:
                self._save_assets(scene, cameras)
            for done, shot in enumerate(shots):
                report("rendering", done / len(shots))
                renderer.render(scene, shot.camera).save(shot.path)
                print(shot.path, flush=True)
            report("rendering", 1.0)
            self._write_lit_pictures(scene, shots[0].camera, report)

    def _write_lit_pictures(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> None:
        """Writes the lit pictures, and prints the path of each as soon as it is written."""
        from lumisplat.cli.output.demo_images import lit_pictures

        def start(config: ls.RenderConfig) -> ls.Renderer:
            return self.start_renderer(report, config)

        for path in lit_pictures(ls.demo_scene_lit(scene), camera, self.output, start, report):
            print(path, flush=True)

    def _save_assets(self, scene: ls.Scene, cameras: list[ls.Camera]) -> None:
        ls.save(self.output / "demo.ply", scene.splats[0].gaussians)
        ls.save_cameras(self.output / "transforms.json", cameras)
