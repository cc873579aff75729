"""Fills device buffers with NaN before use, so that elements that a kernel never writes show in its results."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lumisplat.runtime.buffers import Buffers, DeviceArray


def fill_with_nan(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """Patches `Buffers.get` to fill the buffer called ``name`` with NaN at each request; CPU only."""
    get = Buffers.get

    def filled(self: Buffers, asked: str, *args: Any, **options: Any) -> DeviceArray:
        array = get(self, asked, *args, **options)
        if asked == name:
            array.numpy().view(np.float32)[...] = np.nan
        return array

    monkeypatch.setattr(Buffers, "get", filled)
