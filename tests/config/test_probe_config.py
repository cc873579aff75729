"""Tests that settings of screen probes are refused if out of range."""

from __future__ import annotations

import pytest

from lumisplat.config import ProbeConfig
from lumisplat.errors import ConfigError


@pytest.mark.parametrize(
    ("name", "value"),
    [("tile", 7), ("tile", 16.5), ("cells", 3), ("cells", 17), ("refreshed", 0.0), ("history", 0), ("adaptive", 1.5)],
)
def test_error_for_a_screen_probe_setting_out_of_range_names_the_setting(name: str, value: float) -> None:
    """The settings are tile, cells, refreshed, history and adaptive."""
    with pytest.raises(ConfigError, match=name):
        ProbeConfig(**{name: value})  # pyright: ignore[reportArgumentType]
