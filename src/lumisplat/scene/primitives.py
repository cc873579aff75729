"""Simple meshes by formula, with y up, normals and uvs: ground planes, boxes, spheres."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import Doubles, finite_numbers
from lumisplat.scene.checks import check_positive, check_whole
from lumisplat.scene.materials import Material, MaterialPbr
from lumisplat.scene.mesh import Mesh


def plane(width: float = 1.0, depth: float = 1.0, *, material: Material | None = None) -> Mesh:
    """Makes a rectangle in the plane y = 0, centred at the origin, that faces +y.

    Args:
        width: Extent along x, scene units.
        depth: Extent along z, scene units.
        material: Material; None: the default.

    Raises:
        SceneError: A size is not positive.
    """
    check_positive("width", width)
    check_positive("depth", depth)
    corners = np.array([(-0.5, 0.0, -0.5), (0.5, 0.0, -0.5), (0.5, 0.0, 0.5), (-0.5, 0.0, 0.5)])
    return Mesh(
        corners * (width, 1.0, depth),
        [(0, 2, 1), (0, 3, 2)],
        normals=np.tile((0.0, 1.0, 0.0), (4, 1)),
        uvs=corners[:, [0, 2]] + 0.5,
        material=MaterialPbr() if material is None else material,
        name="plane",
    )


def box(size: float | npt.ArrayLike = 1.0, *, material: Material | None = None) -> Mesh:
    """Makes a box centred at the origin, with hard edges; each side shows the whole texture.

    Args:
        size: Extent along x, y and z, scene units: one number, or shape (3,).
        material: Material; None: the default.

    Raises:
        SceneError: A size is not positive.
    """
    sizes = finite_numbers(np.broadcast_to(np.asarray(size), (3,)) if np.ndim(size) == 0 else size, (3,))
    if sizes is None or not (sizes > 0.0).all():
        raise SceneError(f"size is {size}, expected one positive number or three")
    # Each side is the +z side, rotated; its corners run counter-clockwise from the bottom left.
    side = np.array([(-0.5, -0.5, 0.5), (0.5, -0.5, 0.5), (0.5, 0.5, 0.5), (-0.5, 0.5, 0.5)])
    turns = [
        _axes(right, up) for right, up in (("x", "y"), ("-x", "y"), ("-z", "y"), ("z", "y"), ("x", "-z"), ("x", "z"))
    ]
    return Mesh(
        np.concatenate([side @ turn.T for turn in turns]) * sizes,
        np.concatenate([np.array([(0, 1, 2), (0, 2, 3)]) + 4 * k for k in range(6)]),
        normals=np.repeat([turn[:, 2] for turn in turns], 4, axis=0),
        uvs=np.tile([(0.0, 1.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)], (6, 1)),
        material=MaterialPbr() if material is None else material,
        name="box",
    )


def sphere(radius: float = 0.5, *, rows: int = 32, material: Material | None = None) -> Mesh:
    """Makes a sphere centred at the origin, with the poles along y and smooth normals.

    Args:
        radius: Radius, scene units.
        rows: Number of rings of faces from pole to pole, 2 to 1024; each ring has 2 * ``rows`` faces.
        material: Material; None: the default.

    Raises:
        SceneError: The radius is not positive, or ``rows`` is out of range.
    """
    check_positive("radius", radius)
    check_whole("rows", rows, 2, 1024)
    columns = 2 * rows
    v, u = np.mgrid[: rows + 1, : columns + 1] / np.array([rows, columns])[:, None, None]
    polar, around = np.pi * v.ravel(), 2.0 * np.pi * (u.ravel() % 1.0)  # seam and poles close to the bit
    radii = np.where((v.ravel() == 0.0) | (v.ravel() == 1.0), 0.0, np.sin(polar))
    normals = np.stack([radii * np.sin(around), np.cos(polar), radii * np.cos(around)], axis=1)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    below = first + columns + 1
    upper = np.asarray(np.stack([first, below + 1, first + 1], axis=1), dtype=np.int64)
    lower = np.asarray(np.stack([first, below, below + 1], axis=1), dtype=np.int64)
    # At the poles, one triangle of each quad has no area.
    return Mesh(
        radius * normals,
        np.concatenate([upper[columns:], lower[:-columns]]),
        normals=normals,
        uvs=np.stack([u.ravel(), v.ravel()], axis=1),
        material=MaterialPbr() if material is None else material,
        name="sphere",
    )


def _axes(right: str, up: str) -> Doubles:
    """Returns the rotation, (3, 3), with the signed axes ``right`` and ``up`` and their cross product as columns."""
    x: Doubles
    y: Doubles
    x, y = (np.eye(3)["xyz".index(name[-1])] * (-1.0 if name[0] == "-" else 1.0) for name in (right, up))
    return np.stack([x, y, np.cross(x, y)], axis=1)
