"""Reads from compiled CUDA code what each kernel asks of a GPU, without a GPU or the CUDA toolkit.

A CUBIN is an ELF file. Each kernel has its instructions in a section ``.text.NAME`` and attributes in ``.nv.info``.
tests/project/test_gpu_variants.py compares with ``cuobjdump`` where that is on the PATH.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import warp as wp

_HEADER, _SECTION, _SYMBOL = struct.Struct("<40xQ10xHHH"), struct.Struct("<IIQQQQIIQQ"), struct.Struct("<IBBHQQ")
"""Fields of ELF64: the section table's offset, entry size, count and name section; a section; a symbol."""
_SYMBOLS = 2
"""Type of the section with symbols."""
_FRAME_SIZE, _REGISTERS = 0x11, 0x2F
"""Attributes of ``.nv.info`` with a value per function: bytes of local memory a thread, and registers a thread."""
_WITH_SIZE = 4
"""Format of an attribute that is followed by its size."""
_INSTRUCTION_BYTES, _OPCODE, _NOP = 16, 0xFFF, 0x918
"""Size of an instruction from compute capability 7.0 on, the bits of its operation, and the one without effect."""

REGISTERS = 65_536
"""Registers of a multiprocessor."""
LIMITS = {75: (32, 16, 64), 80: (64, 32, 164), 86: (48, 16, 100), 89: (48, 24, 100), 90: (64, 32, 228)}
LIMITS |= {100: (64, 32, 228), 120: (48, 24, 100)}
"""By compute capability: most warps, most blocks, and KiB of shared memory of a multiprocessor (CUDA C++ Programming
Guide, table of technical specifications)."""
RESERVED_SHARED = 1024
"""Shared memory that each block takes for the system, bytes; compilers count it from compute capability 9.0 on."""


@dataclass(frozen=True)
class Resources:
    """Resources of a GPU that a thread or block of one kernel takes."""

    registers: int
    """Registers of a thread."""
    stack: int
    """Local memory of a thread, bytes: arrays with computed indices, and spilled registers."""
    shared: int
    """Static shared memory of a block, bytes."""
    instructions: int

    def text(self, architecture: int, threads: int) -> str:
        """Returns all figures in words; the arguments are those of `occupancy`."""
        warps, most = self.occupancy(architecture, threads)
        bytes_used = f"{self.stack:,} B stack, {self.shared:,} B shared"
        return f"{self.registers} registers, {bytes_used}, {self.instructions:,} instructions, {warps} of {most} warps"

    def occupancy(self, architecture: int, threads: int) -> tuple[int, int]:
        """Returns how many warps a multiprocessor runs at once, and the most it could.

        Args:
            architecture: Compute capability, such as 86; an unknown one counts as the next lower one that is known.
            threads: Threads per block.
        """
        most_warps, most_blocks, shared_kib = LIMITS[max(known for known in LIMITS if known <= architecture)]
        warps = -(-threads // 32)
        # Registers are given to warps in units of 256.
        by_registers = REGISTERS // (-(-self.registers * 32 // 256) * 256) // warps
        by_shared = shared_kib * 1024 // (self.shared + (RESERVED_SHARED if architecture < 90 else 0) or 1)
        return min(by_registers, by_shared, most_blocks, most_warps // warps) * warps, most_warps


def resources_of(module: Any, architecture: int) -> dict[str, Resources]:
    """Returns the resources of a Warp module's kernels by key; compiles into the kernel cache what it lacks."""
    (cubin,) = wp.compile_aot_module(module, arch=[architecture], use_ptx=False)
    by_name = read(Path(cubin).read_bytes())
    return {
        kernel.key: resources
        for kernel in module.kernels.values()
        for name, resources in by_name.items()
        if name.startswith(f"{kernel.get_mangled_name()}_")
    }


def read(cubin: bytes) -> dict[str, Resources]:
    """Returns the resources of each kernel of a CUBIN by the name of its function."""
    offset, size, count, names = _HEADER.unpack_from(cubin)
    sections = [_SECTION.unpack_from(cubin, offset + size * k) for k in range(count)]
    texts = sections[names][4]
    by_name = {_text(cubin, texts + section[0]): section for section in sections}
    attributes = dict(_attributes(cubin, by_name, sections))
    found = {}
    for name, section in by_name.items():
        function = name.removeprefix(".text.")
        if function == name:
            continue
        shared = by_name.get(f".nv.shared.{function}")
        words = range(section[4], section[4] + section[5], _INSTRUCTION_BYTES)
        found[function] = Resources(
            registers=attributes[function, _REGISTERS],
            stack=attributes[function, _FRAME_SIZE],
            shared=shared[5] if shared else 0,
            instructions=sum(int.from_bytes(cubin[at : at + 2], "little") & _OPCODE != _NOP for at in words),
        )
    return found


def _attributes(cubin: bytes, by_name: dict[str, Any], sections: list[Any]) -> Iterator[tuple[tuple[str, int], int]]:
    """Yields the values of ``.nv.info`` with the name of their function and their attribute."""
    symbols = next(section for section in sections if section[1] == _SYMBOLS)
    names = sections[symbols[6]][4]
    at, end = by_name[".nv.info"][4], by_name[".nv.info"][4] + by_name[".nv.info"][5]
    while at < end:
        kind, attribute, size = struct.unpack_from("<BBH", cubin, at)
        if kind == _WITH_SIZE and attribute in (_FRAME_SIZE, _REGISTERS):
            symbol, value = struct.unpack_from("<II", cubin, at + 4)
            name = _SYMBOL.unpack_from(cubin, symbols[4] + _SYMBOL.size * symbol)[0]
            yield (_text(cubin, names + name), attribute), value
        at += 4 + (size if kind == _WITH_SIZE else 0)


def _text(data: bytes, at: int) -> str:
    """Returns the string that starts at a byte and ends before a zero."""
    return data[at : data.index(b"\0", at)].decode()
