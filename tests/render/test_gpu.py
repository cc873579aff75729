"""What only a CUDA device can show; skipped where there is none."""

from __future__ import annotations

import pytest
import warp as wp

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(wp.get_cuda_device_count() == 0, reason="no CUDA device"),
]
