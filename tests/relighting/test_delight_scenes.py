"""Albedo of captures with baked light and known materials is accurate (deep)."""

from __future__ import annotations

import pytest
from bench.delighted import CASES, measured

pytestmark = pytest.mark.deep


@pytest.mark.usefixtures("data_dir")
@pytest.mark.parametrize("name", ["room", "spot in the sun"])
def test_albedo_found_by_delight_has_over_25_db_psnr_and_images_relit_with_it_over_28_db(name: str) -> None:
    """Captured colours taken as albedo have less than 18 dB; the estimate removes at least 60 % of the shadows."""
    figures, _ = measured(CASES[name]("cpu"), "cpu")
    assert figures["captured_db"] < 18.0
    assert figures["albedo_db"] > 25.0
    assert figures["relit_db"] > 28.0
    assert figures.get("shadow_left", 0.0) < 0.4
    assert figures["relit_db"] > figures["captured_relit_db"] + 5.0
