"""Initialises Warp, and hides its warning that there is no CUDA driver."""

from __future__ import annotations

import os
from functools import cache

import warp as wp

from lumisplat.runtime.kernel_cache import cache_error, remove_abandoned_headers


@cache
def start_warp() -> None:
    """Initialises Warp, unless it is initialised already.

    Without a CUDA driver, Warp's native code writes a warning to file descriptor 2, whatever its log level. Running on
    a CPU is no mistake, so the warning is discarded.

    Raises:
        DeviceError: The folder of compiled kernels cannot be made. The next call tries again.
    """
    remove_abandoned_headers()
    saved = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        wp.init()
    except OSError as error:
        raise cache_error(error) from error
    finally:
        os.dup2(saved, 2)
        os.close(saved)
