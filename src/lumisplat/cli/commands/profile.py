"""``lumisplat profile``: lists the Gaussians on the ray of a pixel, as a table, CSV or plot."""

from __future__ import annotations

import csv
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import camera_file, scene_file, scene_settings
from lumisplat.cli.options.camera import ViewpointGroup, ViewpointOptions
from lumisplat.cli.options.command import DeviceCommand, LoadingCommand, own_options_first, setting
from lumisplat.cli.output.console import counted, print_columns, progress_bars
from lumisplat.cli.output.images import check_folder

_HEADER = ("hit", "t", "alpha", "transmittance", "gaussian", "capture")


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Profile(LoadingCommand, DeviceCommand):
    """List the Gaussians on the ray of a pixel.

    They explain floaters and wrong depths.
    Guide: docs/guide/ray_queries.md.
    First try: lumisplat profile garden.ply --pixel 640,360 -o ray.png
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read captures, meshes, glTF, OpenUSD, or a scene.toml; several make one scene."""
    pixel: Annotated[str | None, setting("X,Y", "the middle")] = None
    """Follow the ray of this pixel, counted from the upper left corner."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="OUT", help_behavior_hint="")] = None
    """Write a plot, .png, or a table, .csv, instead of printing it; - prints CSV."""
    cameras: Annotated[Path | None, setting("FILE", "the scene's, else the front")] = None
    """Read the camera from this file."""
    camera: Annotated[str | None, setting("NAME", "the first")] = None
    """Use the camera with this name."""
    width: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image width (1280 without cameras); alone, it keeps the aspect ratio."""
    height: Annotated[int | None, setting("PX", "the camera's")] = None
    """Set the image height (720 without cameras); alone, it keeps the aspect ratio."""
    viewpoint: ViewpointGroup = field(default_factory=ViewpointOptions)
    """Set the camera, in place of those of the files (docs/guide/captures.md)."""

    def run(self) -> None:
        """Traces the ray and prints, writes or plots its Gaussians."""
        suffix = "" if self.output is None else self.output.suffix.lower()
        if self.output is not None and str(self.output) != "-":
            if suffix not in (".png", ".csv"):
                raise ls.ConfigError(f"{self.output}: expected .png for a plot or .csv for a table")
            check_folder(self.output.parent, self.output)
        self.viewpoint.check(self.cameras)
        self.quiet_warp()
        with progress_bars() as report:
            scene = self.viewpoint.upright(self.load_scene(self.scene, report))
        camera = self._camera(scene)
        origins, directions = ls.rays.pixel_ray(camera, *self._pixel(camera))
        config = scene_settings(scene_file(self.scene))
        hits = ls.trace_rays(scene, origins, directions, config, device=self.device, profile=True)
        assert hits.profile is not None
        if suffix == ".png":
            from lumisplat.io.images.texture import write_png

            assert self.output is not None
            write_png(self.output, hits.plot())
            print(f"{self.output}: {counted(len(hits.profile.t), 'Gaussian')}")
            return
        rows = _rows(hits.profile)
        if self.output is None:
            print_columns(list(_HEADER), rows)
            return
        if suffix == ".csv":
            with self.output.open("w", newline="") as file:
                csv.writer(file).writerows([_HEADER, *rows])
            print(f"{self.output}: {counted(len(rows), 'Gaussian')}")
            return
        csv.writer(sys.stdout, lineterminator="\n").writerows([_HEADER, *rows])

    def _camera(self, scene: ls.Scene) -> ls.Camera:
        """Returns the camera of ``--cameras``, the scene file or the viewpoint options."""
        path = self.cameras or camera_file(self.scene)
        given = [] if path is None or self.viewpoint.is_given else list(ls.load_cameras(path))
        if not given:
            if self.cameras is not None:
                raise ls.FormatError(self.cameras, "has no cameras")
            return self.viewpoint.camera(scene, self.width, self.height)
        names = [camera.name for camera in given]
        if self.camera is not None and self.camera not in names:
            raise ls.ConfigError(f"no camera is named '{self.camera}': there are {', '.join(names[:5])}")
        chosen = given[0 if self.camera is None else names.index(self.camera)]
        return chosen.scaled(self.width, self.height)

    def _pixel(self, camera: ls.Camera) -> tuple[int, int]:
        """Returns column and row of ``--pixel``, or of the middle of the image."""
        width, height = camera.image_size
        if self.pixel is None:
            return width // 2, height // 2
        try:
            x, y = (int(part) for part in self.pixel.split(","))
        except ValueError:
            x = y = -1
        if not (0 <= x < width and 0 <= y < height):
            raise ls.ConfigError(f"--pixel is {self.pixel}, expected X,Y from 0,0 to {width - 1},{height - 1}")
        return x, y


def _rows(profile: ls.rays.RayProfile) -> list[list[str]]:
    """Returns the table's cells, a row for each Gaussian on the ray."""
    values = zip(
        profile.t, profile.alpha, profile.transmittance, profile.gaussian_index, profile.instance_index, strict=True
    )
    return [
        [f"{number}", f"{t:.6g}", f"{alpha:.4f}", f"{behind:.5f}", f"{gaussian}", f"{instance}"]
        for number, (t, alpha, behind, gaussian, instance) in enumerate(values, 1)
    ]
