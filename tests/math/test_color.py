"""The sRGB transfer function."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from lumisplat.math.color import decode_srgb, encode_srgb


@pytest.mark.parametrize(
    ("encoded", "linear"), [(0.0, 0.0), (1.0, 1.0), (0.04045, 0.04045 / 12.92), (0.5, 0.21404114), (0.73535698, 0.5)]
)
def test_srgb_transfer_function_matches_the_standard(encoded: float, linear: float) -> None:
    """Values match IEC 61966-2-1 at the ends, at the joint and in the middle."""
    assert decode_srgb(encoded) == pytest.approx(linear, abs=1e-7)
    assert encode_srgb(linear) == pytest.approx(encoded, abs=1e-6)


@given(st.floats(-20.0, 20.0))
def test_srgb_decoding_inverts_encoding(value: float) -> None:
    """Decoding inverts encoding, also below zero and above one."""
    assert decode_srgb(encode_srgb(np.float64(value))) == pytest.approx(value, rel=1e-5, abs=1e-7)
    assert encode_srgb(decode_srgb(np.float64(value))) == pytest.approx(value, rel=1e-5, abs=1e-7)
    assert encode_srgb(-value) == -encode_srgb(value)


def test_srgb_round_trip_preserves_bytes_and_float64_precision() -> None:
    """Every byte survives, integers become float32, and float64 stays float64."""
    codes = np.arange(256) / 255.0
    np.testing.assert_array_equal(np.round(encode_srgb(decode_srgb(codes)) * 255.0), np.arange(256))
    assert decode_srgb(np.array([0, 1])).dtype == np.float32
    assert decode_srgb(codes).dtype == np.float64
