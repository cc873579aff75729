"""Mattes: which objects and which materials cover each pixel, and how much of it; EXR files hold them as Cryptomatte.

Friedman and Jones, "Fully Automatic ID Mattes with Support for Motion Blur and Transparency" (2015), and version 1.2.0
of the specification. Of each pixel, the names that cover most of it: a pair of channels for each rank, the id, which is
the hash of the name taken for a float, and the share of the pixel.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.io.images.exr import ExrPart
from lumisplat.math.arrays import FloatArray, IntArray

_WORD = 0xFFFFFFFF


def murmur3_32(name: str) -> int:
    """MurmurHash3 (x86, 32 bits, seed 0) of a name in UTF-8, the hash that the specification asks for."""
    data = name.encode()
    state = 0
    for start in range(0, len(data), 4):
        block = data[start : start + 4]
        mixed = int.from_bytes(block, "little") * 0xCC9E2D51 & _WORD
        mixed = (mixed << 15 | mixed >> 17) * 0x1B873593 & _WORD
        state ^= mixed
        if len(block) == 4:
            state = ((state << 13 | state >> 19) & _WORD) * 5 + 0xE6546B64 & _WORD
    state ^= len(data)
    state = (state ^ state >> 16) * 0x85EBCA6B & _WORD
    state = (state ^ state >> 13) * 0xC2B2AE35 & _WORD
    return state ^ state >> 16


def id_bits(name: str) -> int:
    """The bits of a name's id: its hash, with one bit of the exponent turned where it would be no ordinary float."""
    bits = murmur3_32(name)
    return bits ^ (1 << 23) if (bits >> 23 & 255) in (0, 255) else bits


def id_floats(names: Sequence[str]) -> npt.NDArray[np.float32]:
    """Ids of names, shape (N,)."""
    return np.array([id_bits(name) for name in names], dtype=np.uint32).view(np.float32)


def matte_metadata(kind: str, names: Sequence[str]) -> dict[str, str]:
    """Header attributes by which compositors find the channels of a kind of matte, and the names behind ids."""
    key = f"cryptomatte/{murmur3_32(kind):08x}"[:-1]
    manifest = {name: f"{id_bits(name):08x}" for name in names}
    return {
        f"{key}/name": kind,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }


def matte_channels(
    kind: str, ids: npt.NDArray[np.float32], coverage: npt.NDArray[np.float32]
) -> dict[str, npt.NDArray[np.float32]]:
    """Channels of ranks, two in each group of R, G, B and A.

    Args:
        kind: Name of the kind of matte, such as ``CryptoObject``.
        ids: Ids by rank, shape (2 N, H, W); 0: none.
        coverage: Shares of the pixel 0..1, falling with the rank, of the same shape.
    """
    named: dict[str, npt.NDArray[np.float32]] = {}
    for rank, (one, share) in enumerate(zip(ids, coverage, strict=True)):
        group, (first, second) = f"{kind}{rank // 2:02d}", ("RG", "BA")[rank % 2]
        named |= {f"{group}.{first}": one, f"{group}.{second}": share}
    return named


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
        ids = np.append(id_floats(self.names), np.float32(0.0))[self.ranks]
        named = matte_channels(self.kind, ids, self.shares)
        return ExrPart(self.kind, named, matte_metadata(self.kind, self.names))


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
