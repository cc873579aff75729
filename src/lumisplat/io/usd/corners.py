"""Attributes of polygon meshes, one value for each corner, vertex, face or mesh, as values of vertices."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.math.arrays import FloatArray, Rows

_OF_VERTICES = ("vertex", "varying")


@dataclass(frozen=True, slots=True, eq=False)
class Attribute:
    """Values of a mesh."""

    values: FloatArray
    """Shape (N, C)."""
    interpolation: str
    """What has a value of its own: constant (the mesh), uniform (faces), vertex or varying, faceVarying (corners)."""
    label: str


@dataclass(slots=True)
class Polygons:
    """Polygons of a mesh.

    Raises:
        FormatError: There are more corners than the faces have, or fewer.
    """

    path: object
    """The file, for messages."""
    label: str
    positions: FloatArray
    """Vertices, shape (V, 3)."""
    counts: Rows
    """Corners of each face, shape (P,)."""
    indices: Rows
    """Vertex of each corner, shape (C,)."""
    attributes: dict[str, Attribute] = field(default_factory=dict[str, Attribute])

    def __post_init__(self) -> None:
        if (self.counts < 0).any() or int(self.counts.sum()) != len(self.indices):
            raise FormatError(
                str(self.path),
                f"{self.label} has faces of {int(self.counts.sum()):,} corners, but {len(self.indices):,} indices",
            )

    def add(self, name: str, attribute: Attribute | None) -> None:
        """Adds an attribute, if there is one.

        Raises:
            FormatError: It has fewer values than the mesh has vertices, faces or corners.
        """
        if attribute is None:
            return
        needed = self._needed(attribute.interpolation)
        if len(attribute.values) < needed:
            raise FormatError(
                str(self.path),
                f"{attribute.label} has {len(attribute.values):,} values, expected {needed:,} "
                f"({attribute.interpolation or 'no'} interpolation)",
            )
        self.attributes[name] = attribute

    def _needed(self, interpolation: str) -> int:
        sizes = {"uniform": len(self.counts), "faceVarying": len(self.indices), "constant": 1}
        return sizes.get(interpolation, len(self.positions))

    def vertices(self) -> tuple[Rows, dict[str, FloatArray]]:
        """The vertex of each corner, shape (C,), and the attributes of vertices, ``positions`` among them.

        Vertices whose corners have different values become several.
        """
        splitting = {
            name: a for name, a in self.attributes.items() if a.interpolation not in (*_OF_VERTICES, "constant")
        }
        arrays = {"positions": self.positions}
        for name, attribute in self.attributes.items():
            if attribute.interpolation == "constant":
                arrays[name] = np.repeat(attribute.values[:1], len(self.positions), axis=0)
            elif name not in splitting:
                arrays[name] = attribute.values[: len(self.positions)]
        inside = (self.indices >= 0) & (self.indices < len(self.positions))
        if not splitting or not len(self.indices):
            return np.where(inside, self.indices, -1), arrays
        corner_face = np.repeat(np.arange(len(self.counts)), self.counts)
        at_corners = {
            name: a.values[corner_face] if a.interpolation == "uniform" else a.values[: len(self.indices)]
            for name, a in splitting.items()
        }
        vertex = np.where(inside, self.indices, 0)
        keys = [vertex[:, None], *(np.ascontiguousarray(v, np.float32).view(np.int32) for v in at_corners.values())]
        _, first, merged = np.unique(np.concatenate(keys, axis=1), axis=0, return_index=True, return_inverse=True)
        arrays = {name: values[vertex[first]] for name, values in arrays.items()}
        arrays |= {name: np.asarray(values[first]) for name, values in at_corners.items()}
        return np.where(inside, merged.reshape(-1), -1), arrays
