"""OBJ files of one mesh, without a material: what a scene file says of it is better said there."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.files.source import PathLike
from lumisplat.math.color import encode_srgb
from lumisplat.scene.mesh import Mesh


def write_obj(path: PathLike, mesh: Mesh) -> None:
    """Writes a mesh; `lumisplat.load` gives the same numbers again, colours but for their rounding as sRGB.

    Args:
        path: The file, which appears complete or not at all.
        mesh: The mesh; its material is left out.

    Raises:
        FormatError: The file cannot be written.
    """
    positions = mesh.positions if mesh.colors is None else np.hstack([mesh.positions, encode_srgb(mesh.colors)])
    lines = [*_rows("v", positions)]
    if mesh.uvs is not None:
        lines += _rows("vt", mesh.uvs * (1.0, -1.0) + (0.0, 1.0))  # OBJ's v points up
    if mesh.normals is not None:
        lines += _rows("vn", mesh.normals)
    corner = "{0}" if mesh.uvs is None and mesh.normals is None else "{0}/{0}"
    if mesh.normals is not None:
        corner = "{0}//{0}" if mesh.uvs is None else "{0}/{0}/{0}"
    lines += (f"f {corner.format(a)} {corner.format(b)} {corner.format(c)}" for a, b, c in (mesh.indices + 1).tolist())
    with atomic_write(path) as temporary:
        Path(temporary).write_text("\n".join(lines) + "\n", encoding="ascii")


def _rows(name: str, values: npt.NDArray[np.floating]) -> Iterator[str]:
    return (f"{name} {' '.join(f'{number:.9g}' for number in row)}" for row in values.tolist())
