"""A kernel that tests whether a device compiles and runs kernels."""

from __future__ import annotations

import warp as wp


@wp.kernel
def trial_kernel(squares: wp.array[wp.float32]):
    """Writes the square of its index to each element."""
    i = wp.tid()
    squares[i] = wp.float32(i) * wp.float32(i)
