"""Cryptomatte: hashes, ids that are normal floats, channels and the manifest."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lumisplat.frame.mattes import id_floats, matte_channels, matte_metadata, murmur3_32


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("", 0),
        ("test", 0xBA6BD213),
        ("Hello, world!", 0xC0363E43),
        ("The quick brown fox jumps over the lazy dog", 0x2E4FF723),
        ("aaa", 0xB4D05FB7),
        ("ab", 0x9BBFD75F),
        ("a", 0x3C2569B2),
        ("é café", 0x735C2790),
    ],
)
def test_cryptomatte_hashes_are_murmur3(name: str, expected: int) -> None:
    """The hashes match the package mmh3 5.2 with seed 0, for all lengths of the last block."""
    assert murmur3_32(name) == expected


def test_cryptomatte_ids_are_neither_denormal_nor_infinite_nor_nan() -> None:
    """No id is denormal, infinite or NaN, because readers may change such floats."""
    names = [f"thing {number}" for number in range(20_000)]
    hashes = np.array([murmur3_32(name) for name in names], dtype=np.uint32)
    exponents = hashes >> 23 & 255
    assert np.isin(exponents, (0, 255)).sum() > 50  # exponents 0 and 255 are NaN, infinite or denormal
    ids = id_floats(names)
    assert np.isfinite(ids).all() and (np.abs(ids) >= np.finfo(np.float32).tiny).all()
    turned = ids.view(np.uint32) ^ hashes
    assert set(turned[np.isin(exponents, (0, 255))]) == {1 << 23} and not turned[~np.isin(exponents, (0, 255))].any()


def test_cryptomatte_channels_hold_two_ranks_each() -> None:
    """Ids and coverage fill R and G, then B and A; the manifest maps names to ids."""
    ids = id_floats(["a", "b", "c"])[:, None, None] * np.ones((3, 2, 2), np.float32)
    shares = np.array([0.5, 0.3, 0.2], np.float32)[:, None, None] * np.ones((3, 2, 2), np.float32)
    named = matte_channels("CryptoObject", ids, shares)
    assert list(named) == [f"CryptoObject{group}" for group in ("00.R", "00.G", "00.B", "00.A", "01.R", "01.G")]
    assert (named["CryptoObject00.B"] == ids[1]).all() and (named["CryptoObject01.G"] == shares[2]).all()
    header = matte_metadata("CryptoObject", ["a", "é"])
    key = f"cryptomatte/{murmur3_32('CryptoObject'):08x}"[: len("cryptomatte/") + 7]
    assert header[f"{key}/name"] == "CryptoObject" and header[f"{key}/conversion"] == "uint32_to_float32"
    manifest = json.loads(header[f"{key}/manifest"])
    assert int(manifest["é"], 16) == int(id_floats(["é"]).view(np.uint32)[0])
