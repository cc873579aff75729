"""Cryptomattes: object and material names and their coverage for each pixel, stored in EXR files.

Friedman and Jones, "Fully Automatic ID Mattes with Support for Motion Blur and Transparency" (2015), and version 1.2.0
of the specification. Each pixel stores its names in ranks of falling coverage. A rank is a pair of channels: the id of
a name (the name's hash, reinterpreted as a float) and the fraction of the pixel that the name covers.
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
    """Returns MurmurHash3 (x86, 32 bits, seed 0) of a name in UTF-8, as the specification requires."""
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
    """Returns the bits of a name's id: its hash, with one exponent bit flipped if the hash is not a normal float."""
    bits = murmur3_32(name)
    return bits ^ (1 << 23) if (bits >> 23 & 255) in (0, 255) else bits


def id_floats(names: Sequence[str]) -> npt.NDArray[np.float32]:
    """Returns the Cryptomatte id of each name as a float, shape (N,) for N names."""
    return np.array([id_bits(name) for name in names], dtype=np.uint32).view(np.float32)


def matte_metadata(kind: str, names: Sequence[str]) -> dict[str, str]:
    """Returns the EXR header attributes of a matte: they locate its channels and map its names to ids."""
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
    """Returns the EXR channels of a matte by name, two ranks in each RGBA group.

    Args:
        kind: Name of the matte, such as ``CryptoObject``.
        ids: Id of the name at each rank, shape (2 N, H, W) for N groups; 0: no name.
        coverage: Fraction of the pixel that each rank's name covers, 0..1, decreasing, same shape as ``ids``.
    """
    named: dict[str, npt.NDArray[np.float32]] = {}
    for rank, (one, share) in enumerate(zip(ids, coverage, strict=True)):
        group, (first, second) = f"{kind}{rank // 2:02d}", ("RG", "BA")[rank % 2]
        named |= {f"{group}.{first}": one, f"{group}.{second}": share}
    return named


@dataclass(frozen=True, slots=True, eq=False)
class Matte:
    """The names with the largest coverage in each pixel, and the fraction of the pixel that each covers.

    Compositors read them as Cryptomattes.
    """

    kind: str
    """Name of the matte for compositors: ``CryptoObject`` or ``CryptoMaterial``."""
    names: tuple[str, ...]
    ranks: IntArray
    """Index in ``names`` of the name at each of R ranks, largest coverage first, shape (R, H, W); -1: no name."""
    shares: FloatArray
    """Fraction of the pixel that the name at each of R ranks covers, 0..1, shape (R, H, W)."""

    def coverage(self, name: str) -> FloatArray:
        """Returns the fraction of each pixel that ``name`` covers, 0..1, shape (H, W).

        Raises:
            SceneError: The matte does not contain the name.
        """
        if name not in self.names:
            raise SceneError(
                f"no object or material is named '{name}', expected one of {', '.join(self.names) or '(none)'}"
            )
        return np.where(self.ranks == self.names.index(name), self.shares, 0.0).sum(axis=0, dtype=np.float32)

    def part(self) -> ExrPart:
        """Returns the EXR part of this matte."""
        ids = np.append(id_floats(self.names), np.float32(0.0))[self.ranks]
        named = matte_channels(self.kind, ids, self.shares)
        return ExrPart(self.kind, named, matte_metadata(self.kind, self.names))


@dataclass(frozen=True, slots=True, eq=False)
class Mattes:
    """Object and material mattes from `lumisplat.layers.render_mattes`; `lumisplat.Frame.save` adds them to an EXR."""

    objects: Matte
    """Coverage by the names of captures and mesh instances."""
    materials: Matte
    """Coverage by the names of materials; a capture counts as one material with the capture's name."""

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns, (H, W)."""
        return self.objects.shares.shape[1], self.objects.shares.shape[2]

    def parts(self) -> list[ExrPart]:
        """Returns the EXR parts of both mattes."""
        return [self.objects.part(), self.materials.part()]
