"""Meshes of a scene file that need no file: boxes, spheres and planes."""

from __future__ import annotations

from typing import Any, cast

from lumisplat.errors import SceneError
from lumisplat.io.scene_toml.toml_table import Kind, TomlTable, Values, is_list, suggestion
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.primitives import box, plane, sphere

SHAPES = ("box", "plane", "sphere")


def _is_size(value: object) -> bool:
    return not isinstance(value, bool | str | dict) and (not is_list(value) or len(value) in (2, 3))


SIZE = Kind("a number, two (plane) or three (box)", _is_size)
"""Edges of a box or a plane, or the diameter of a sphere."""


def shape_mesh(table: TomlTable, given: Values) -> Mesh:
    """The mesh of an entry with a ``shape``: of size 1, unless ``size`` says otherwise.

    Raises:
        FormatError: There is no such shape, or the size does not suit it.
    """
    shape, size = given["shape"], given.get("size", 1.0)
    if shape not in SHAPES:
        raise table.error(f"shape is {shape!r}, {suggestion(shape, SHAPES)}", "shape")
    try:
        if shape == "box":
            return box(size)
        if shape == "sphere" and not is_list(size):
            return sphere(0.5 * size)
        if shape == "plane" and not (is_list(size) and len(size) != 2):
            edges = cast(list[Any], size if isinstance(size, list) else [size, size])
            return plane(*edges)
    except (SceneError, TypeError):
        pass
    expected = {"box": "one positive number or three", "plane": "one positive number or two", "sphere": "its diameter"}
    raise table.wrong("size", expected[shape])
