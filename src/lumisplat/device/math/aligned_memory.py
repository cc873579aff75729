"""Structs of whole 16-byte words, read and written by as many wide accesses on CUDA, not number by number.

Warp declares structs with the alignment of their numbers, and compilers may not assume more. The arrays here come from
allocators that align memory to 64 bytes at least, and are not cut within. On CPUs these are plain accesses.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})

_ELEMENT = "*static_cast<decltype(items.data)>(__builtin_assume_aligned(items.data + i, 16))"


def _on_cuda(wide: str, plain: str) -> str:
    """A statement for CUDA, and another for CPUs."""
    check = 'static_assert(sizeof(item) % 16 == 0, "not of whole 16-byte words");'
    return f"{check}\n#if defined(__CUDA_ARCH__)\n{wide};\n#else\n{plain};\n#endif\n"


def aligned_load_of(noun: Any) -> Any:
    """The function that reads a struct from a contiguous array into a variable."""

    @wp.func_native(_on_cuda(f"item = {_ELEMENT}", "item = items.data[i]"))
    def load_aligned(items: wp.array[noun], i: int, item: wp.ref[noun]): ...

    return load_aligned


def aligned_store_of(noun: Any) -> Any:
    """The function that writes a struct from a variable to a contiguous array."""

    @wp.func_native(_on_cuda(f"{_ELEMENT} = item", "items.data[i] = item"))
    def store_aligned(items: wp.array[noun], i: int, item: wp.ref[noun]): ...

    return store_aligned
