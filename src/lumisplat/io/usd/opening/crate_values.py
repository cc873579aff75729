"""Values of binary layers: how many items they claim and what these name, checked before the library believes it.

One wrong bit in the length of a list made it allocate 8 GB, one in the number of a token ended the process. Layout as
of the sources of OpenUSD (pxr/usd/sdf/crateFile.cpp, crateDataTypes.h).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import IO

import numpy as np

from lumisplat.constants.usd import USD_ENTRIES_A_BYTE, USD_NESTING_MAX
from lumisplat.errors import FormatError
from lumisplat.io.files.limits import check_expansion
from lumisplat.io.files.source import PathLike

_IS_ARRAY, _IS_INLINED, _IS_COMPRESSED, _IS_EDIT = (1 << bit for bit in (63, 62, 61, 60))
_ITEM_BYTES = dict(
    enumerate(
        [0, 1, 1, 4, 4, 8, 8, 2, 4, 8, 4, 4, 4, 32, 72, 128, 32, 16, 8, 16, 8, 4, 8, 24, 12, 6, 12, 32, 16, 8, 16]
    )
) | {56: 8, 57: 4}
"""Of arrays, by the number of the type: bool, uchar, int, ..., vec4i; time codes, path expressions."""
_INDEXED = {10: "STRINGS", 11: "TOKENS", 12: "STRINGS", 57: "STRINGS"} | {
    32: "TOKENS", 33: "STRINGS", 34: "PATHS", 40: "PATHS", 41: "TOKENS", 45: "STRINGS", 50: "STRINGS", 58: "PATHS"
}  # fmt: skip
"""The section in which items of a type are, if they are numbers of what is in it: of arrays, lists and vectors."""
_INLINED = {10: "STRINGS", 11: "TOKENS", 12: "TOKENS"}
"""The same of values that are their own place."""
_LIST_ITEM_BYTES = {32: 4, 33: 4, 34: 4, 36: 4, 37: 8, 38: 4, 39: 8}
"""Of operations on lists, by the number of the type: tokens, strings, paths, integers."""
_REFERENCES, _VALUES, _PAYLOADS = 35, 54, 55
"""Operations on lists whose items hold further values, or none."""
_VECTOR_ITEM_BYTES = {40: 4, 41: 4, 45: 8, 48: 8, 49: 16, 50: 4, 58: 8, 59: 1}
"""Of paths, tokens, selections of variants, doubles, offsets of layers, strings, relocations and bytes of splines."""
_DICTIONARY, _TIME_SAMPLES, _VALUE, _UNREGISTERED = 31, 46, 52, 53
_HAS_ITEMS = 0b111_1110
"""Bits of an operation on lists, one for each of its lists."""


@dataclass(slots=True)
class CrateValues:
    """The values of a binary layer."""

    path: PathLike
    """Named in errors."""
    file: IO[bytes]
    size: int
    """Bytes of the layer."""
    version: tuple[int, int]
    counts: Mapping[str, int]
    """Entries of its sections."""
    _at: int = 0
    _steps: int = 0
    _checked: set[int] = field(default_factory=set[int])

    def check(self, values: Iterable[int]) -> None:
        """Checks values, each a type, flags and the place of what it holds, in 64 bits, and all that is in them.

        Raises:
            FormatError: One claims more items than the layer can hold, or is nested too deeply.
        """
        for value in values:
            self._check(value, 0)

    def _check(self, value: int, depth: int) -> None:
        if depth > USD_NESTING_MAX:
            raise self._error(f"values within values, more than {USD_NESTING_MAX} deep")
        kind, place = value >> 48 & 0xFF, value & (1 << 48) - 1
        if value & _IS_INLINED and not value & _IS_ARRAY and kind in _INLINED:
            self._known(place & 0xFFFF_FFFF, _INLINED[kind])
        if value & (_IS_INLINED | _IS_EDIT) or (value in self._checked and not depth):
            return
        self._checked.add(value)
        self._at = place
        if value & _IS_ARRAY:
            if place:
                self._array(kind, is_compressed=bool(value & _IS_COMPRESSED))
        elif kind in _VECTOR_ITEM_BYTES:
            self._items(_VECTOR_ITEM_BYTES[kind], kind)
        elif kind in (*_LIST_ITEM_BYTES, _REFERENCES, _VALUES, _PAYLOADS):
            self._lists(kind, depth)
        elif kind == _DICTIONARY:
            self._dictionary(depth)
        elif kind in (_VALUE, _UNREGISTERED):
            self._nested(depth)
        elif kind == _TIME_SAMPLES:
            self._nested(depth)
            self._jump()
            for sample in self._words():
                self._check(sample, depth + 1)

    def _array(self, kind: int, *, is_compressed: bool) -> None:
        item_bytes = _ITEM_BYTES.get(kind, 1)
        if self.version < (0, 5):
            self._read("<I")  # the number of dimensions
        (count,) = self._read("<I" if self.version < (0, 7) else "<Q")
        if is_compressed:
            self._refuse(count, USD_ENTRIES_A_BYTE * (self.size - self._at))
            check_expansion(self.path, f"{count:,} numbers of its binary layer", item_bytes * count, self.size)
        else:
            self._refuse(count * item_bytes, self.size - self._at, count)
            self._check_numbers(count, kind)

    def _items(self, item_bytes: int, kind: int) -> None:
        """Passes a number of items, and these."""
        (count,) = self._read("<Q")
        self._refuse(count * item_bytes, self.size - self._at, count)
        self._check_numbers(count * item_bytes // 4, kind)
        self._at += count * item_bytes

    def _check_numbers(self, count: int, kind: int) -> None:
        """Checks so many numbers of tokens, strings or paths, if the type has them."""
        if kind in _INDEXED and count:
            self.file.seek(self._at)
            self._known(int(np.frombuffer(self.file.read(4 * count), "<u4").max()), _INDEXED[kind])

    def _known(self, number: int, section: str) -> None:
        if number >= self.counts.get(section, 0):
            raise self._error(f"number {number:,} of {self.counts.get(section, 0):,} {section.lower()}")

    def _lists(self, kind: int, depth: int) -> None:
        (bits,) = self._read("<B")
        for _ in range((bits & _HAS_ITEMS).bit_count()):
            if kind in _LIST_ITEM_BYTES:
                self._items(_LIST_ITEM_BYTES[kind], kind)
                continue
            (count,) = self._read("<Q")
            self._refuse(count * 8, self.size - self._at, count)
            for _ in range(count):
                if kind == _VALUES:
                    self._nested(depth)
                    continue
                name, prim = self._read("<II")
                self._known(name, "STRINGS")
                self._known(prim, "PATHS")
                self._at += 16 if kind == _REFERENCES or self.version >= (0, 8) else 0
                if kind == _REFERENCES:
                    self._dictionary(depth)

    def _dictionary(self, depth: int) -> None:
        (count,) = self._read("<Q")
        self._refuse(count * 12, self.size - self._at, count)
        for _ in range(count):
            self._known(self._read("<I")[0], "STRINGS")
            self._nested(depth)

    def _nested(self, depth: int) -> None:
        """Checks a value that lies some bytes further on, and passes it."""
        self._jump()
        (value,) = self._read("<Q")
        after = self._at
        self._check(value, depth + 1)
        self._at = after

    def _jump(self) -> None:
        start = self._at
        (distance,) = self._read("<q")
        self._at = start + distance

    def _words(self) -> list[int]:
        (count,) = self._read("<Q")
        self._refuse(8 * count, self.size - self._at, count)
        return [*self._read(f"<{count}Q")]

    def _read(self, layout: str) -> tuple[int, ...]:
        length = struct.calcsize(layout)
        self._steps += 1
        if self._steps > self.size:
            raise self._error("values that are read again and again")
        if not 0 <= self._at <= self.size - length:
            raise self._error("a value that is not in it")
        self.file.seek(self._at)
        self._at += length
        return struct.unpack(layout, self.file.read(length))

    def _refuse(self, needed: int, left: int, count: int | None = None) -> None:
        if needed > left:
            raise self._error(f"a list of {needed if count is None else count:,} items")

    def _error(self, what: str) -> FormatError:
        return FormatError(self.path, f"damaged: its binary layer of {self.size:,} bytes has {what}")
