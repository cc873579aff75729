"""One primitive of a glTF mesh: access to its attributes, with errors that name it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from lumisplat.errors import FormatError
from lumisplat.io.gltf.container import GltfFile

if TYPE_CHECKING:
    import pygltflib


@dataclass(frozen=True, slots=True)
class GltfPrimitive:
    """A primitive in its file."""

    file: GltfFile
    item: pygltflib.Primitive
    where: str
    """Its name in errors: ``meshes[2].primitives[0]``."""

    def floats(self, name: str, kind: str) -> npt.NDArray[np.float32] | None:
        """An attribute by name, shape (V, components); None if the primitive has none."""
        accessor = self._accessor(name)
        return None if accessor is None else self.file.floats(accessor, kind, f"{self.where} {name}")

    def integers(self, name: str, kind: str) -> npt.NDArray[np.int64] | None:
        """An attribute of integers by name, shape (V, components); None if the primitive has none."""
        accessor = self._accessor(name)
        return None if accessor is None else self.file.integers(accessor, kind, f"{self.where} {name}")

    def error(self, problem: str) -> FormatError:
        """An error about the primitive."""
        return FormatError(self.file.path, f"{self.where} {problem}")

    def _accessor(self, name: str) -> int | None:
        return getattr(self.item.attributes, name, None)
