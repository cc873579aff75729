"""Captures with light baked in, whose albedo is known (deep): how much of it is found."""

from __future__ import annotations

import pytest
from bench.delighted import CASES, measured

pytestmark = pytest.mark.deep


@pytest.mark.usefixtures("data_dir")
@pytest.mark.parametrize("name", ["room", "spot in the sun"])
def test_albedo_and_new_light(name: str) -> None:
    """Albedo of 25 dB, captured colours have less than 18; 28 dB in a new light; 60 % of shadows are gone."""
    figures, _ = measured(CASES[name]("cpu"), "cpu")
    assert figures["captured_db"] < 18.0
    assert figures["albedo_db"] > 25.0
    assert figures["relit_db"] > 28.0
    assert figures.get("shadow_left", 0.0) < 0.4
    assert figures["relit_db"] > figures["captured_relit_db"] + 5.0


@pytest.mark.usefixtures("data_dir")
def test_roughness_of_glossy_surfaces() -> None:
    """A cow and a floor of four roughnesses, degree 3: what is sure is nearer than 0.8 is, and albedo is kept."""
    figures, _ = measured(CASES["glossy spot"]("cpu"), "cpu")
    rough = figures["roughness"]
    assert rough["rmse_of_sure"] < 0.25
    assert rough["rmse"] < 0.7 * rough["rmse_all_0.8"]
    assert rough["floor 0.3"]["mean"] < rough["floor 0.5"]["mean"] - 0.1
    assert rough["floor 0.5"]["mean"] < rough["floor 0.8"]["mean"] - 0.2
    for value in (0.3, 0.5, 0.8):
        assert rough[f"floor {value}"]["rmse"] < 0.15
    assert figures["albedo_db"] > figures["captured_db"] + 5.0
    assert figures["relit_db"] > 28.0
