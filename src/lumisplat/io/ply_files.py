"""PLY files: captures, compressed or not, and meshes, which only their headers tell apart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lumisplat.errors import FormatError
from lumisplat.io.ply.header import PlyHeader, read_ply_header
from lumisplat.io.splats.compressed_ply import is_compressed_header, read_compressed_ply
from lumisplat.io.splats.splat_ply import is_gaussian_element, read_splat_ply

if TYPE_CHECKING:
    from lumisplat.io.splats.columns import SplatColumns
    from lumisplat.scene.mesh import Mesh


def read_ply(path: Path, progress: Callable[[float], None] | None, *, incident: bool) -> SplatColumns | Mesh:
    """Reads a capture or a mesh.

    Args:
        path: The file.
        progress: As of `lumisplat.io.load`.
        incident: As of `lumisplat.io.load`.

    Raises:
        FormatError: It is neither, or damaged.
        OSError: It cannot be read.
    """
    header = read_ply_header(path)
    if is_compressed_header(header):
        return read_compressed_ply(header)
    if _has_faces(header):
        from lumisplat.io.meshes.mesh_ply import read_ply_mesh

        return read_ply_mesh(header)
    return read_splat_ply(header, progress, incident=incident)


def holds_mesh(path: Path) -> bool:
    """Whether a file is a mesh, not a capture; False if it cannot be read.

    Args:
        path: A ``.ply`` file.
    """
    try:
        header = read_ply_header(path)
    except (OSError, FormatError):
        return False
    return not is_compressed_header(header) and _has_faces(header)


def _has_faces(header: PlyHeader) -> bool:
    """Whether there are faces or triangle strips, and no Gaussians."""
    vertex, surfaces = header.element("vertex"), map(header.element, ("face", "tristrips"))
    return any(one and one.count for one in surfaces) and not (vertex and is_gaussian_element(vertex))
