"""Binary layers ("crates"): what the library believes, checked before it sees them.

It takes memory and time for as many entries as a section claims, and follows the tree of paths wherever its jumps lead:
one wrong bit in them makes it visit subtrees again and again, for ever in effect. Layout as of the sources of OpenUSD
(pxr/usd/sdf/crateFile.cpp, integerCoding.cpp; LZ4's block format), versions 0.4 and later.
"""

from __future__ import annotations

import struct
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from lumisplat.constants.usd import LZ4_EXPANSION_MAX, USD_ENTRIES_A_BYTE, USD_ENTRY_BYTES
from lumisplat.errors import FormatError
from lumisplat.io.files.limits import check_expansion
from lumisplat.io.files.source import PathLike
from lumisplat.io.usd.opening.crate_values import CrateValues

MAGIC = b"PXR-USDC"
_COUNTED = ("TOKENS", "STRINGS", "FIELDS", "FIELDSETS", "PATHS", "SPECS")
"""Sections that begin with the number of their entries."""
_COMPRESSED_SINCE = (0, 4)
"""Version from which on paths are compressed integers."""
_WIDTHS = np.array([0, 1, 2, 4])
"""Bytes of an integer by its code of two bits; 0 is the most common one, which is stored once."""


def check_crate(path: PathLike, file: IO[bytes], size: int) -> None:
    """Checks a binary layer; one in text passes.

    Args:
        path: Named in errors.
        file: The layer.
        size: Its bytes.

    Raises:
        FormatError: A section has more entries than its bytes, or a file of this size, can hold, or is not in the file,
            or paths are no tree.
    """
    magic, major, minor, table = _unpack(file, "<8sBB6xq", 0)
    if magic != MAGIC:
        return
    if not 0 < table <= size - 8:
        raise FormatError(path, "truncated: the table of contents of its binary layer is missing")
    (sections,) = _unpack(file, "<Q", table)
    if sections > (size - table) // 32:
        raise FormatError(path, f"damaged: its binary layer lists {sections:,} sections")
    counts: dict[str, int] = {}
    content: dict[str, bytes] = {}
    for number in range(sections):
        stored, start, length = _unpack(file, "<16sqq", table + 8 + 32 * number)
        name = stored.rstrip(b"\0").decode("latin-1")
        if not (0 <= start and 0 <= length and start + length <= size):
            raise FormatError(path, "truncated: a section of its binary layer is missing")
        if name not in _COUNTED or length < 8:
            continue
        (count,) = _unpack(file, "<Q", start)
        if count > USD_ENTRIES_A_BYTE * length:
            raise FormatError(path, f"damaged: {count:,} entries in {length:,} bytes of its binary layer")
        check_expansion(path, f"{count:,} entries of its binary layer", USD_ENTRY_BYTES * count, size)
        file.seek(start)
        counts[name], content[name] = count, file.read(length)
    if (major, minor) < _COMPRESSED_SINCE:
        return
    try:
        values = _check_sections(path, content, counts)
    except (struct.error, IndexError, ValueError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError(path, "damaged: the sections of its binary layer cannot be decoded") from None
    CrateValues(path, file, size, (major, minor), counts).check(values)


def _check_sections(path: PathLike, content: dict[str, bytes], counts: dict[str, int]) -> list[int]:
    """Checks that what entries of sections name is there, and returns the values of fields.

    Raises:
        FormatError: Something is not there, or paths are no tree.
        struct.error: A section ends too early.
        IndexError: Likewise.
        ValueError: Likewise, or it cannot be decoded.
    """

    def known(numbers: npt.NDArray[np.integer], section: str) -> None:
        if numbers.size and not 0 <= int(numbers.min()) <= int(numbers.max()) < counts.get(section, 0):
            raise FormatError(path, f"damaged: a number of its binary layer is none of its {section.lower()}")

    if "TOKENS" in content:
        (text,) = struct.unpack_from("<Q", content["TOKENS"], 8)
        if text > LZ4_EXPANSION_MAX * len(content["TOKENS"]):
            raise FormatError(path, f"damaged: {text:,} bytes of text in its binary layer")
    if counts.get("STRINGS"):
        known(np.frombuffer(content["STRINGS"], "<u4", counts["STRINGS"], 8), "TOKENS")
    if "PATHS" in content:
        count = struct.unpack_from("<Q", content["PATHS"], 8)[0]
        (numbers, names, jumps), _ = _lists_of_integers(content["PATHS"], 16, count, 3)
        known(numbers, "PATHS")
        known(np.abs(names), "TOKENS")
        if not _is_tree(jumps.tolist()):
            raise FormatError(path, "damaged: the paths in its binary layer are no tree")
    if counts.get("FIELDSETS"):
        (fields,), _ = _lists_of_integers(content["FIELDSETS"], 8, counts["FIELDSETS"], 1)
        known(fields[fields != -1], "FIELDS")  # -1 ends a set
    if counts.get("SPECS"):
        (paths, sets, _), _ = _lists_of_integers(content["SPECS"], 8, counts["SPECS"], 3)
        known(paths, "PATHS")
        known(sets, "FIELDSETS")
    if not counts.get("FIELDS"):
        return []
    section, count = content["FIELDS"], counts["FIELDS"]
    (names,), at = _lists_of_integers(section, 8, count, 1)
    known(names, "TOKENS")
    (length,) = struct.unpack_from("<Q", section, at)
    return [*struct.unpack_from(f"<{count}Q", _uncompressed(section[at + 8 : at + 8 + length], 8 * count + 64))]


def _lists_of_integers(section: bytes, at: int, count: int, lists: int) -> tuple[list[npt.NDArray[np.int64]], int]:
    """So many compressed lists of integers, from a place on, and where they end."""
    found: list[npt.NDArray[np.int64]] = []
    for _ in range(lists):
        (length,) = struct.unpack_from("<Q", section, at)
        found.append(_integers(_uncompressed(section[at + 8 : at + 8 + length], 5 * count + 64), count))
        at += 8 + length
    return found, at


def _unpack(file: IO[bytes], layout: str, at: int) -> tuple[Any, ...]:
    file.seek(at)
    return struct.unpack(layout, file.read(struct.calcsize(layout)))


def _is_tree(jumps: list[int]) -> bool:
    """Whether a walk visits each entry once.

    An entry's child, if it has one, is the next; its sibling, if it has one, is behind its subtree. The jump is the
    distance to the sibling if there are both, -1 if there is only a child, 0 if only a sibling (the next), else -2.
    """
    waiting, end, count = [0] if jumps else [], 0, len(jumps)
    while waiting:
        at = waiting.pop()
        if at != end:
            return False  # what was visited before, or something that was left out
        while True:
            if at >= count:
                return False
            jump = jumps[at]
            end = at + 1
            if jump > 0:
                waiting.append(at + jump)
            elif jump not in (-1, 0):
                break
            at = end
    return end == count


def _integers(data: bytes, count: int) -> npt.NDArray[np.int64]:
    """Integers of 32 bits that are stored as differences, by codes of two bits.

    Raises:
        ValueError: The data end too early.
    """
    code_bytes = (2 * count + 7) // 8
    packed = np.frombuffer(data, np.uint8, code_bytes, 4)
    codes = (packed[:, None] >> np.array([0, 2, 4, 6], np.uint8) & 3).reshape(-1)[:count]
    widths = _WIDTHS[codes]
    starts: npt.NDArray[np.int64] = 4 + code_bytes + np.cumsum(widths) - widths
    differences = np.full(count, struct.unpack_from("<i", data)[0], np.int64)
    held = np.frombuffer(data, np.uint8)
    for code, kind in ((1, "<i1"), (2, "<i2"), (3, "<i4")):
        rows = np.flatnonzero(codes == code)
        columns = starts[rows][:, None] + np.arange(int(_WIDTHS[code]))
        if rows.size and int(columns.max()) >= held.size:
            raise ValueError("the integers end too early")
        differences[rows] = np.ascontiguousarray(held[columns]).view(kind)[:, 0]
    return np.cumsum(differences).astype(np.int32).astype(np.int64)


def _uncompressed(data: bytes, limit: int) -> bytes:
    """Data that are compressed in one block, or in several with their sizes before them.

    Raises:
        ValueError: They are longer than the limit, or refer to what is not there.
        IndexError: They end too early.
        struct.error: They end too early.
    """
    if data[0] == 0:
        return _lz4_block(data[1:], limit)
    whole, at = b"", 1
    for _ in range(data[0]):
        (size,) = struct.unpack_from("<i", data, at)
        whole += _lz4_block(data[at + 4 : at + 4 + size], limit)
        at += 4 + size
    return whole


def _lz4_block(data: bytes, limit: int) -> bytes:
    """A block of LZ4: runs of literals, each followed by a copy of what is some bytes back."""
    out, at = bytearray(), 0
    while at < len(data):
        token = data[at]
        literals, at = _length(data, at + 1, token >> 4)
        out += data[at : at + literals]
        at += literals
        if at >= len(data):
            break
        (offset,) = struct.unpack_from("<H", data, at)
        size, at = _length(data, at + 2, token & 15)
        size += 4
        if not 0 < offset <= len(out) or len(out) + size > limit:
            raise ValueError("a copy of what is not there")
        while size > 0:  # which may overlap with what it makes
            piece = out[len(out) - offset : len(out) - offset + size]
            out += piece
            size -= len(piece)
    return bytes(out)


def _length(data: bytes, at: int, length: int) -> tuple[int, int]:
    """A length whose four bits may go on in bytes of 255, and where what follows begins."""
    if length == 15:
        more = 255
        while more == 255:
            more = data[at]
            length, at = length + more, at + 1
    return length, at
