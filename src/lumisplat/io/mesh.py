"""Mesh files: OBJ, PLY and STL become a `Mesh`, or a `Scene` where there are several materials."""

from __future__ import annotations

from pathlib import Path

from lumisplat.errors import FormatError
from lumisplat.io.mesh_obj import read_obj
from lumisplat.io.mesh_ply import read_ply_mesh
from lumisplat.io.mesh_stl import read_stl
from lumisplat.io.source import PathLike, parsing
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene


def read_mesh(path: PathLike) -> Mesh | Scene:
    """Reads a mesh file by its extension; its axes are taken as they are.

    Args:
        path: An ``.obj`` (with MTL), ``.ply`` or ``.stl`` file.

    Returns:
        A mesh; a scene of one mesh per material for an OBJ with several.

    Raises:
        FormatError: The file or something that it names is missing, malformed or truncated.
    """
    path = Path(path)
    match path.suffix.lower():
        case ".obj":
            with parsing(path, "an OBJ file"):
                meshes = read_obj(path)
                if len(meshes) == 1:
                    return meshes[0]
                return Scene(meshes=tuple(MeshInstance(mesh, name=mesh.name) for mesh in meshes))
        case ".ply":
            with parsing(path, "a PLY mesh"):
                return read_ply_mesh(path)
        case ".stl":
            with parsing(path, "an STL file"):
                return read_stl(path)
    raise FormatError(path, f"unknown mesh extension {path.suffix!r}: expected .obj, .ply or .stl")
