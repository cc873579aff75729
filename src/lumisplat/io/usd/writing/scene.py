"""Captures, scenes and animations as OpenUSD files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.library import pxr, writing_usd
from lumisplat.io.usd.writing.package import write_files
from lumisplat.io.usd.writing.particles import define_field
from lumisplat.io.usd.writing.stage import StageWriter
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene, SplatInstance


def write_usd(path: PathLike, subject: Gaussians | Scene, cameras: Sequence[Camera] = ()) -> None:
    """Writes a capture or a scene.

    Args:
        path: ``.usda`` is text, ``.usdc`` and ``.usd`` are binary, ``.usdz`` is a package with its textures.
        subject: What to write.
        cameras: Cameras of the scene.

    Raises:
        FormatError: The file cannot be written.
        MissingExtraError: usd-core is not installed.
    """
    pxr()
    scene = subject if isinstance(subject, Scene) else Scene(splats=(SplatInstance(subject),))
    with writing_usd(path):
        writer = StageWriter(Path(path), scene.up_direction)
        for splat in scene.splats:
            place = writer.path_of(splat.name or "gaussians")
            prim = define_field(writer, place, splat.gaussians)
            writer.place(prim, splat.transform)
        write_files(writer)
    writer.remarks.report()
