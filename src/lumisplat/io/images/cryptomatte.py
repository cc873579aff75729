"""Cryptomatte: ids and coverages of what pixels show, as compositors read them.

Friedman and Jones, "Fully Automatic ID Mattes with Support for Motion Blur and Transparency" (2015), and version 1.2.0
of the specification. Of each pixel, the names that cover most of it: a pair of channels for each rank, the id, which is
the hash of the name taken for a float, and the share of the pixel.
"""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

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


def metadata(kind: str, names: Sequence[str]) -> dict[str, str]:
    """Header attributes by which compositors find the channels of a kind of matte, and the names behind ids."""
    key = f"cryptomatte/{murmur3_32(kind):08x}"[:-1]
    manifest = {name: f"{id_bits(name):08x}" for name in names}
    return {
        f"{key}/name": kind,
        f"{key}/hash": "MurmurHash3_32",
        f"{key}/conversion": "uint32_to_float32",
        f"{key}/manifest": json.dumps(manifest, ensure_ascii=False, separators=(",", ":")),
    }


def channels(
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
