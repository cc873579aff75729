"""Arrays of other packages: any object with ``__dlpack__`` is accepted as an array."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import lumisplat as ls
from support.files.mesh_files import QUAD, QUAD_TRIANGLES, QUAD_UVS
from support.scenes.raster_scenes import random_gaussians

RNG = np.random.default_rng(5)
WXYZ = np.array([0.8, 0.0, 0.6, 0.0])
MATRIX = np.array([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, 0.0, 2.0], [0.0, 0.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
IMAGE = RNG.uniform(0.0, 1.0, (6, 12, 3))
POINTS = RNG.normal(size=(5, 3))


class Foreign:
    """Array type with DLPack and nothing else."""

    def __init__(self, values: Any, device: int = 1) -> None:
        self._values, self._device = np.array(values), device

    def __dlpack__(self, **options: object) -> object:
        if self._device != 1:
            raise BufferError("this memory is on a GPU")
        return self._values.__dlpack__()

    def __dlpack_device__(self) -> tuple[int, int]:
        return self._device, 0


def _gaussians(of: Callable[[Any], Any]) -> ls.Gaussians:
    gaussians = random_gaussians(2, count=5, degree=1)
    return ls.Gaussians(
        *(
            of(values)
            for values in (
                gaussians.means,
                gaussians.rotations_wxyz,
                gaussians.scales,
                gaussians.opacities,
                gaussians.sh,
            )
        ),
        normals=of(np.tile((0.0, 0.0, 1.0), (5, 1))),
        albedo=of(np.full((5, 3), 0.25)),
        roughness=of(np.full(5, 0.5)),
        metallic=of(np.zeros(5)),
    )


def _mesh(of: Callable[[Any], Any]) -> ls.Mesh:
    return ls.Mesh(
        of(QUAD),
        of(QUAD_TRIANGLES),
        of(np.tile((0.0, 0.0, 1.0), (4, 1))),
        of(QUAD_UVS),
        colors=of(np.full((4, 3), 0.5)),
    )


def _camera(of: Callable[[Any], Any]) -> ls.Camera:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 2.0, 3.0
    return ls.Camera(
        width=8, height=6, fx=9.0, fy=9.0, cx=4.0, cy=3.0, camera_from_world=of(pose), distortion=of(np.full(6, 0.001))
    )


def _path(of: Callable[[Any], Any]) -> ls.CameraPath:
    cameras = [_camera(np.asarray)] * 3
    return ls.CameraPath(cameras, of(np.array([0.0, 1.0, 3.0])), targets=of(POINTS[:3]))


def _hits(of: Callable[[Any], Any]) -> dict[str, Any]:
    scene = ls.Scene(splats=[random_gaussians(2, count=50)])
    directions = np.tile((0.0, 0.0, 1.0), (5, 1))
    hits = ls.trace_rays(scene, of(POINTS), of(directions), device="cpu")
    passed = ls.transmittance(scene, of(POINTS), of(directions), of(np.full(5, 4.0)), device="cpu")
    return {"radiance": hits.radiance, "transmittance": hits.transmittance, "passed": passed}


TAKERS: dict[str, Callable[[Callable[[Any], Any]], Any]] = {
    "Gaussians": _gaussians,
    "Mesh": _mesh,
    "texture": lambda of: ls.MaterialPbr(base_color_texture=of(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))),
    "colour": lambda of: ls.MaterialPbr(base_color=of(np.array([0.1, 0.2, 0.3])), emissive=of(np.ones(3))),
    "environment": lambda of: ls.LightEnvironment(of(IMAGE), rotation_wxyz=of(WXYZ)),
    "point light": lambda of: ls.LightPoint(of(POINTS[0]), color=of(np.array([1.0, 0.5, 0.25]))),
    "spot": lambda of: ls.LightSpot(of(POINTS[0]), of(POINTS[1])),
    "sun": lambda of: ls.LightDirectional(of(POINTS[1])),
    "rect": lambda of: ls.LightRect(of(POINTS[0]), of(np.array([1.0, 0, 0])), of(np.array([0.0, 1, 0]))),
    "camera": _camera,
    "look_at": lambda of: ls.Camera.look_at(of(POINTS[0]), of(POINTS[1]), of(POINTS[2]), width=8, height=6),
    "camera path": _path,
    "placement": lambda of: ls.SplatInstance(random_gaussians(2, count=5), of(MATRIX)),
    "mesh placement": lambda of: ls.MeshInstance(_mesh(np.asarray), of(MATRIX)),
    "placed by parts": lambda of: ls.MeshInstance(
        _mesh(np.asarray), position=of(POINTS[0]), rotation_degrees=of(POINTS[1])
    ),
    "up": lambda of: ls.Scene(splats=[random_gaussians(2, count=5)], up=of(np.array([0.0, 0.0, 1.0]))),
    "keyframes": lambda of: ls.Keyframes(of(np.array([0.0, 1.0])), of(POINTS[:2]), of(np.tile(WXYZ, (2, 1)))),
    "transform": lambda of: ls.transform(random_gaussians(2, count=5), of(MATRIX), translation=of(POINTS[0])),
    "crop": lambda of: ls.editing.crop(
        random_gaussians(2, count=50), box=(of(np.full(3, -9.0)), of(np.array([9.0, 9.0, 3.0])))
    ),
    "probe": lambda of: ls.avatars.EnvironmentProbe(of(RNG.normal(size=(9, 3)).clip(0, 0) + 1.0)),
    "psnr": lambda of: ls.metrics.psnr(of(IMAGE), of(IMAGE[::-1])),
    "rays": _hits,
}
"""Public functions and classes that take arrays, each as a function of the conversion of its arrays."""


def _same(one: Any, other: Any) -> None:
    """Compares results of NumPy arrays and of foreign arrays."""
    if isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, other)
    elif isinstance(one, dict):
        for name in one:
            _same(one[name], other[name])
    elif hasattr(one, "__dataclass_fields__"):
        for name in one.__dataclass_fields__:
            _same(getattr(one, name), getattr(other, name))
    elif isinstance(one, tuple | list):
        for first, second in zip(one, other, strict=True):
            _same(first, second)
    else:
        assert one == other


@pytest.mark.parametrize("name", TAKERS)
def test_dlpack_arrays_give_the_same_results_as_numpy_arrays(name: str) -> None:
    """Every listed function and class accepts DLPack arrays and NumPy arrays."""
    _same(TAKERS[name](np.asarray), TAKERS[name](Foreign))


def test_arrays_given_to_a_capture_are_copied() -> None:
    """A capture does not change when the caller's array changes later."""
    means = Foreign(np.zeros((2, 3), np.float32))
    gaussians = ls.Gaussians(means, np.tile(WXYZ, (2, 1)), np.ones((2, 3)), np.ones(2), np.zeros((2, 1, 3)))  # pyright: ignore[reportArgumentType]
    means._values[:] = np.nan
    assert not gaussians.means.any()


@pytest.mark.parametrize("take", ["Gaussians", "Mesh", "placement", "environment"])
def test_arrays_in_gpu_memory_are_refused_with_a_one_line_error(take: str) -> None:
    """The message says to copy the array to the CPU."""
    with pytest.raises(ls.SceneError, match=r"cannot be read \(this memory is on a GPU\): copy it to the CPU"):
        TAKERS[take](lambda values: Foreign(values, device=2))
