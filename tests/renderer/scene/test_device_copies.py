"""What a GPU does with assets, played on the CPU: arrays are copied there, and kernels are given bare addresses."""

from __future__ import annotations

import dataclasses
import weakref
from typing import Any

import numpy as np
import pytest
import warp as wp

import lumisplat as ls
from lumisplat.demo.shapes import sphere
from lumisplat.renderer import checks
from lumisplat.renderer.scene import shading_scene, upload
from lumisplat.runtime.buffers import Buffers, DeviceArray
from support.scenes.lit_scene import config
from support.scenes.raster_scenes import random_gaussians


def polished() -> ls.Scene:
    """A relightable capture whose every attribute is an array."""
    ball = ls.gaussians_from_mesh(sphere(0.5, rows=10, columns=16), 900, seed=3)
    own: dict[str, Any] = {
        "normals": ball.means / np.linalg.norm(ball.means, axis=1, keepdims=True),
        "albedo": np.full((ball.count, 3), 0.7, np.float32),
        "roughness": np.full(ball.count, 0.2, np.float32),
        "metallic": np.full(ball.count, 1.0, np.float32),
    }
    splats = ls.SplatInstance(dataclasses.replace(ball, **own), material=ls.MaterialPbr())
    return ls.Scene(splats=[splats], lights=[ls.LightPoint((1.0, 2.0, -2.0), intensity=20.0)])


@pytest.fixture
def copies(monkeypatch: pytest.MonkeyPatch) -> list[np.ndarray]:
    """Makes uploads copies, whose memory becomes NaN as soon as nothing owns them."""
    kept: list[np.ndarray] = []
    share = upload.as_device_array

    def copy(values: np.ndarray, dtype: type[object], device: str) -> DeviceArray:
        memory = np.array(values)
        array = share(memory, dtype, device)
        kept.append(memory)
        weakref.finalize(array, memory.fill, np.nan)
        return array

    for module in (upload, shading_scene):
        monkeypatch.setattr(module, "as_device_array", copy)
    return kept


@pytest.mark.parametrize("pipeline", list(ls.Pipeline))
def test_copies_live_while_kernels_read_them(pipeline: ls.Pipeline, copies: list[np.ndarray]) -> None:
    """A lit capture looks the same whether its arrays are shared with the host or copied to a device."""
    scene, camera = polished(), ls.Camera.look_at((0.0, 0.5, -2.0), (0.0, 0.0, 0.0), width=48, height=32)
    renderer = ls.create_renderer(config(pipeline), "cpu", threads=1)
    copied = renderer.render(scene, camera)
    again = renderer.render(scene, camera)
    assert len(copies) >= 6, "means, scales, opacities, colours, roughness and metallic are copied"
    assert all(np.isfinite(memory).all() for memory in copies), "a copy was freed while tables point to it"
    with pytest.MonkeyPatch.context() as undo:
        for module in (upload, shading_scene):
            undo.setattr(module, "as_device_array", lambda values, dtype, device: DeviceArray(values, dtype=dtype))
        expected = ls.create_renderer(config(pipeline), "cpu", threads=1).render(scene, camera)
    np.testing.assert_array_equal(copied.color, expected.color)
    np.testing.assert_array_equal(again.color, expected.color)


def test_parts_of_a_block_keep_it() -> None:
    """An array that lies in a block is valid as long as it is held itself."""
    buffers = Buffers("cpu")
    block, parts = buffers.split("pixels", [("alpha", wp.float32, 1), ("color", wp.vec3, 3)], 8)
    parts["color"].fill_(1.0)
    watched = weakref.ref(block)
    color = parts["color"]
    del block, parts, buffers
    assert watched() is not None
    assert (color.numpy() == 1.0).all()
    del color
    assert watched() is None


def test_coefficients_beyond_32_bit_indices_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Kernels index spherical harmonics by one 32-bit number: 134 million Gaussians of degree 3 are too many."""
    gaussians = random_gaussians(1, 9, degree=3)
    scene = ls.Scene(splats=[gaussians])
    monkeypatch.setattr(checks, "ITEMS_MAX", 9 * 16)
    checks.check_scene(scene)
    monkeypatch.setattr(checks, "ITEMS_MAX", 9 * 16 - 1)
    with pytest.raises(ls.SceneError, match=r"9 Gaussians with 16 spherical harmonics.*cut it in two"):
        checks.check_scene(scene)
