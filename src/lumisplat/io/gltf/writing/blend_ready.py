"""Scenes as folders that Blender puts together with what it reads by itself: a GLB, PLYs of captures, and a script.

Blender reads no KHR_gaussian_splatting. It reads PLY with all columns as attributes of points, which add-ons for
Gaussian splats show as such. Captures are written where they stand in Blender's axes: z up, as its reader of glTF turns
y up.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.atomic import atomic_write, written_together
from lumisplat.io.files.source import PathLike
from lumisplat.io.gltf.lights import can_hold_light
from lumisplat.io.gltf.writing.blender_script import SCENE, SCRIPT, script_text
from lumisplat.io.gltf.writing.cameras import camera_losses, can_hold_camera
from lumisplat.io.gltf.writing.scene import light_losses, upright, write_gltf
from lumisplat.io.splats.splat_ply import write_splat_ply
from lumisplat.scene.camera import Camera
from lumisplat.scene.editing.transform import transform
from lumisplat.scene.scene import Scene, SplatInstance

_log = logging.getLogger("lumisplat")

BLENDER_FROM_GLTF = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
"""How Blender turns y up to z up, shape (4, 4)."""
CAPTURES = "captures"
_NAME_MAX = 60


def write_blend_ready(path: PathLike, scene: Scene, cameras: Sequence[Camera] = ()) -> None:
    """Writes a scene as a folder for Blender. Its script goes first if it is there, and comes last.

    What glTF cannot hold is listed in one log line, as are captures that are relit here and not there.

    Args:
        path: The folder, made if it is missing. Other files in it stay.
        scene: The scene.
        cameras: Its cameras.

    Raises:
        FormatError: There is nothing to write, or a file cannot be written.
    """
    folder = Path(path)
    if not (scene.splats or scene.meshes or scene.lights or cameras):
        raise FormatError(path, "the scene is empty: there is nothing to write")
    if folder.exists() and not folder.is_dir():
        raise FormatError(path, "is a file, expected a folder, which is made if it is missing")
    try:
        (folder / SCRIPT).unlink(missing_ok=True)
    except OSError as error:
        raise FormatError(folder / SCRIPT, f"cannot be written: {error.strerror or error}") from None
    with written_together(folder) as written:
        _write_all(folder, scene, cameras, written)


def _write_all(folder: Path, scene: Scene, cameras: Sequence[Camera], written: list[Path]) -> None:
    blender_from_world = BLENDER_FROM_GLTF @ upright(scene)
    captures: list[str] = []
    for splat in scene.splats:
        captures.append(_file_of(splat, captures))
        write_splat_ply(folder / captures[-1], transform(splat.gaussians, blender_from_world @ splat.transform))
        written.append(folder / captures[-1])
    others = replace(scene, splats=())
    losses = [f"light on captures ({relit} are relit here)"] if (relit := _relit(scene)) else []
    glb = SCENE if _fits_gltf(others, cameras) else None
    if glb:
        write_gltf(folder / SCENE, others, cameras)
        written.append(folder / SCENE)
    else:
        losses += [*light_losses(scene.lights), *camera_losses(cameras)]
    if not (glb or captures):
        raise FormatError(folder, f"glTF cannot hold {'; '.join(losses)}: there is nothing else to write")
    if losses:
        _log.warning("%s: Blender will not show %s", os.fspath(folder), "; ".join(losses))
    with atomic_write(folder / SCRIPT) as temporary:
        temporary.write_text(script_text(folder.stem, glb, captures), encoding="utf-8")


def _fits_gltf(scene: Scene, cameras: Sequence[Camera]) -> bool:
    """Whether there is something besides captures that glTF can hold."""
    return bool(scene.meshes) or any(map(can_hold_light, scene.lights)) or any(map(can_hold_camera, cameras))


def _relit(scene: Scene) -> int:
    """How many captures are lit here."""
    return sum(splat.material is not None for splat in scene.splats)


def _file_of(splat: SplatInstance, taken: Sequence[str]) -> str:
    """The file of a capture, named after it as far as files can be."""
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", splat.name)[:_NAME_MAX] or "capture"
    numbered = (stem if number == 1 else f"{stem}_{number}" for number in range(1, len(taken) + 2))
    return next(file for name in numbered if (file := f"{CAPTURES}/{name}.ply") not in taken)
