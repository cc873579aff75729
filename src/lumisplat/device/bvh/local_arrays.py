"""Arrays on the stack of a thread, as large as a constant says, which functions can share.

Warp passes vectors by value, and copies a vector of a struct to read one of its numbers. So what functions share are
arrays, which lie in a local variable of the kernel: ``wp.array(ptr=wp.address_of(variable), ...)``. Warp's own local
arrays, of ``wp.zeros``, hide from the optimiser where they lie: with them kernels take twice as long.
"""

from typing import Any

import warp as wp


def storage_of(noun: Any, count: int) -> Any:
    """The type of a variable that has room for ``count`` structs, and their alignment, that of 4-byte numbers."""
    return wp.types.vector(length=count * wp.types.type_size_in_bytes(noun) // 4, dtype=wp.int32)
