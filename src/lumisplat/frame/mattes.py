"""Mattes: which objects and which materials cover each pixel, and how much of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.errors import SceneError
from lumisplat.io.images import cryptomatte
from lumisplat.io.images.exr import ExrPart
from lumisplat.math.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Matte:
    """Of each pixel, the names that cover most of it."""

    kind: str
    """``CryptoObject`` or ``CryptoMaterial``, as compositors call them."""
    names: tuple[str, ...]
    ranks: IntArray
    """Index into ``names``, -1: none; the one that covers most comes first, shape (R, H, W)."""
    shares: FloatArray
    """Share of the pixel that each covers, 0..1, shape (R, H, W)."""

    def coverage(self, name: str) -> FloatArray:
        """Share of each pixel that a name covers, 0..1, shape (H, W).

        Raises:
            SceneError: Nothing has this name.
        """
        if name not in self.names:
            raise SceneError(f"nothing is called '{name}', expected one of {', '.join(self.names) or '(none)'}")
        return np.where(self.ranks == self.names.index(name), self.shares, 0.0).sum(axis=0, dtype=np.float32)

    def part(self) -> ExrPart:
        """The part of an EXR by which compositors select by name."""
        ids = np.append(cryptomatte.id_floats(self.names), np.float32(0.0))[self.ranks]
        named = cryptomatte.channels(self.kind, ids, self.shares)
        return ExrPart(self.kind, named, cryptomatte.metadata(self.kind, self.names))


@dataclass(frozen=True, slots=True, eq=False)
class Mattes:
    """What `lumisplat.layers.render_mattes` has found; `lumisplat.Frame.save` writes them into an EXR."""

    objects: Matte
    """By the names of captures and meshes."""
    materials: Matte
    """By the names of materials; captures are materials of their own."""

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.objects.shares.shape[1], self.objects.shares.shape[2]

    def parts(self) -> list[ExrPart]:
        """Parts of an EXR."""
        return [self.objects.part(), self.materials.part()]
