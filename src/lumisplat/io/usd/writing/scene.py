"""Captures and scenes as OpenUSD files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.library import pxr, writing_usd
from lumisplat.io.usd.lights import write_light
from lumisplat.io.usd.writing.assets import AssetWriter
from lumisplat.io.usd.writing.cameras import write_cameras
from lumisplat.io.usd.writing.materials import MaterialWriter
from lumisplat.io.usd.writing.motion import write_motion
from lumisplat.io.usd.writing.package import write_files
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.scene.animation.actors import Animation
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance


def write_usd(path: PathLike, subject: Gaussians | Mesh | Scene | Animation, cameras: Sequence[Camera] = ()) -> None:
    """Writes a capture, a mesh, a scene or an animation. One log line lists what OpenUSD has no place for.

    Args:
        path: ``.usda`` is text, ``.usdc`` and ``.usd`` are binary, ``.usdz`` is a package with its textures.
        subject: What to write.
        cameras: Cameras, besides those of an animation.

    Raises:
        FormatError: The file cannot be written.
        MissingExtraError: usd-core is not installed.
    """
    pxr()
    scene = _as_scene(subject)
    with writing_usd(path):
        writer = StageWriter(Path(path), scene.up_direction)
        assets = AssetWriter(writer, MaterialWriter(writer))
        assets.write((*scene.splats, *scene.meshes))
        for light in scene.lights:
            write_light(writer, light)
        write_cameras(writer, cameras)
        if isinstance(subject, Animation):
            write_cameras(writer, subject.cameras)
            write_motion(writer, assets, subject)
        write_files(writer)
    writer.remarks.report()


def _as_scene(subject: Gaussians | Mesh | Scene | Animation) -> Scene:
    """What stands still: a scene as it is, that of an animation; one of a single asset has it at the origin."""
    match subject:
        case Gaussians():
            return Scene(splats=(SplatInstance(subject),))
        case Mesh():
            return Scene(meshes=(MeshInstance(subject),))
        case Animation():
            return subject.scene
        case Scene():
            return subject
