"""Device arrays that hold NaN before they are written, to show what is never written."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lumisplat.runtime.buffers import Buffers, DeviceArray


def fill_with_nan(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """From now on, all elements of the array of that name are NaN whenever it is asked for; on a CPU."""
    get = Buffers.get

    def filled(self: Buffers, asked: str, *args: Any, **options: Any) -> DeviceArray:
        array = get(self, asked, *args, **options)
        if asked == name:
            array.numpy().view(np.float32)[...] = np.nan
        return array

    monkeypatch.setattr(Buffers, "get", filled)
