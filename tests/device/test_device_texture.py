"""Tests of texture lookup on the device."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import warp as wp

from lumisplat.device.structs.scene import WRAP_CLAMP, WRAP_MIRROR, WRAP_REPEAT, TextureData
from lumisplat.renderer.scene.assets import pack_textures
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.materials import TextureWrap
from lumisplat.scene.ops.surface_points import wrapped
from support.probes import probe_texture_kernels

DEVICES = ["cpu", *(device.alias for device in wp.get_cuda_devices())]
MODES = {"wrap": WRAP_REPEAT, "symmetric": WRAP_MIRROR, "edge": WRAP_CLAMP}
"""Wrap modes by the names of ``numpy.pad``."""
TILES = 4
"""Copies of the texture that are padded on each side."""


def expected(image: np.ndarray, uvs: np.ndarray, modes: tuple[Any, Any]) -> np.ndarray:
    """Returns bilinear lookups in an image that is padded beyond all coordinates."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, 0), (TILES * width, TILES * width), (0, 0)), mode=modes[0])
    padded = np.pad(padded, ((TILES * height, TILES * height), (0, 0), (0, 0)), mode=modes[1])
    x, y = (uvs[:, 0] + TILES) * width - 0.5, (uvs[:, 1] + TILES) * height - 0.5
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    right, low = (x - x0)[:, None], (y - y0)[:, None]
    upper = padded[y0, x0] * (1 - right) + padded[y0, x0 + 1] * right
    lower = padded[y0 + 1, x0] * (1 - right) + padded[y0 + 1, x0 + 1] * right
    return upper * (1 - low) + lower * low


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("modes", list(itertools.product(MODES, MODES)), ids="-".join)
def test_device_texture_wrapping_matches_numpy_padding(modes: tuple[str, str], device: str) -> None:
    """Lookups match for each wrap mode on each axis, in alpha as in colours."""
    rng = np.random.default_rng(4)
    image = rng.integers(0, 256, (3, 5, 4)).astype(np.uint8)
    uvs = rng.uniform(-2.9, 3.9, (400, 2)).astype(np.float32)
    packed, first = pack_textures([image])
    texture = TextureData()
    texture.first, texture.height, texture.width = *first.values(), *image.shape[:2]
    texture.wrap_u, texture.wrap_v = MODES[modes[0]], MODES[modes[1]]
    values = wp.array(np.arange(256, dtype=np.float32) / np.float32(255.0), dtype=float, device=device)
    colors, alphas = wp.zeros(400, dtype=wp.vec3, device=device), wp.zeros(400, dtype=float, device=device)
    inputs = wp.array(packed, dtype=wp.uint32, device=device), values, texture
    points = wp.array(uvs, dtype=wp.vec2, device=device)
    Launcher(device, threads=1).run(probe_texture_kernels.probe_texture, 400, *inputs, points, colors, alphas)
    found = np.column_stack([colors.numpy(), alphas.numpy()])
    np.testing.assert_allclose(found, expected(image / 255.0, uvs.astype(np.float64), modes), atol=2e-5)


def test_host_texture_wrapping_equals_the_device_wrapping() -> None:
    """The host's ``wrapped`` maps coordinates outside 0..1 as the device does."""
    x = np.array([-1.75, -0.25, 0.25, 1.0, 1.25, 2.5])
    np.testing.assert_allclose(wrapped(x, TextureWrap.REPEAT), [0.25, 0.75, 0.25, 0.0, 0.25, 0.5])
    np.testing.assert_allclose(wrapped(x, TextureWrap.MIRROR), [0.25, 0.25, 0.25, 1.0, 0.75, 0.5])
    np.testing.assert_allclose(wrapped(x, TextureWrap.CLAMP), [0.0, 0.0, 0.25, 1.0, 1.0, 1.0])
