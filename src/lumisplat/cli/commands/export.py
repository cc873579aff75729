"""``lumisplat export``: writes whole scenes for other programs."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

import lumisplat as ls
from lumisplat.cli.input.loading import USD, WITH_CAMERAS, gltf_document, has_motion, size_on_disk, toml_values
from lumisplat.cli.options.camera import UpOption, parse_up, upright, warn_if_up_is_guessed
from lumisplat.cli.options.command import InsertingCommand, own_options_first
from lumisplat.cli.output.console import Report, byte_size, counted, progress_bars
from lumisplat.cli.output.images import check_folder


@own_options_first
@dataclass(frozen=True, kw_only=True)
class Export(InsertingCommand):
    """Write a scene for other programs, as glTF or OpenUSD.

    OpenUSD also holds area lights, the environment and animation; a log line names what a format cannot hold.
    Guide: docs/guide/gltf.md, usd.md.
    First try: lumisplat export scene.toml -o scene.glb
    """

    scene: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE...", help_behavior_hint="")]] = ()
    """Read a scene.toml, or captures and meshes of any format."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="OUT")]
    """Write .glb, .gltf, .usdz, .usdc, .usd or .usda."""
    cameras: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")] = None
    """Write the cameras of this file, in place of the scene's."""
    up: UpOption = "auto"
    """Set the up direction: y-up, y-down, z-up ..., or a vector."""

    def run(self) -> None:
        """Loads the scene, writes it, and prints what the file holds."""
        ls.io.check_format(self.output, scene=True)  # fails before the slow work
        check_folder(self.output.absolute().parent, self.output)
        cameras = self._cameras()
        with progress_bars() as report:
            animation = self._animation(report)
            scene = upright(
                animation.scene if animation else self.load_scene(self.scene, report, given_up=parse_up(self.up)),
                self.up,
            )
            warn_if_up_is_guessed(scene)
            report("writing", 0.0)
            if animation:
                ls.save(self.output, replace(animation, scene=scene, cameras=cameras))
            else:
                ls.save(self.output, scene, cameras=cameras)
        lights, held_cameras = _written_counts(self.output, scene, cameras)
        counts = (
            (len(scene.splats), "capture"),
            (scene.gaussian_count, "Gaussian"),
            (len(scene.meshes), "mesh instance"),
            (lights, "light"),
            (held_cameras, "camera"),
            (animation.frame_count if animation else 0, "frame"),
        )
        held = ", ".join(counted(count, noun) for count, noun in counts if count)
        print(f"{self.output}: {byte_size(size_on_disk(self.output))}, of {held}")

    def _animation(self, report: Report) -> ls.Animation | None:
        """Loads the animation of a single scene.toml with actors or moving cameras for an OpenUSD file; else None."""
        if self.output.suffix.lower() not in USD or [file.suffix.lower() for file in self.scene] != [".toml"]:
            return None
        (file,) = self.scene
        if not _is_animated(file):
            return None
        report(f"loading {file.name}", 0.0)
        return ls.load_animation(file, drop_invalid=self.drop_invalid, allow_outside=self.allow_outside)

    def _cameras(self) -> list[ls.Camera]:
        """Returns the cameras to write: those of ``--cameras``, else those of the scene's files."""
        if self.cameras is not None:
            return ls.load_cameras(self.cameras)
        files = (file for file in self.scene if file.suffix.lower() in WITH_CAMERAS)
        return [camera for file in files for camera in ls.load_cameras(file)]


def _written_counts(path: Path, scene: ls.Scene, cameras: list[ls.Camera]) -> tuple[int, int]:
    """Returns the numbers of lights and cameras in the written file; the format may not hold all of the scene's."""
    if path.suffix.lower() in USD:
        return len(scene.lights), sum(camera.model is not ls.CameraModel.FISHEYE for camera in cameras)
    file = path / "scene.glb" if path.is_dir() else path
    nodes: list[dict[str, Any]] = gltf_document(file).get("nodes", []) if file.exists() else []
    lights = sum("KHR_lights_punctual" in node.get("extensions", {}) for node in nodes)
    return lights, sum("camera" in node for node in nodes)


def _is_animated(file: Path) -> bool:
    """True if a scene.toml has actors or keyframes; False also for a file that cannot be read."""
    with suppress(OSError, ValueError):
        return has_motion(toml_values(file))
    return False
