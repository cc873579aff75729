"""Shares setups of tests of lights: a plane at y = 0 viewed from above, and lit frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

import lumisplat as ls
from lumisplat.scene.materials import Material
from support.compare.images import assert_close
from support.scenes.light_scenes import parallelogram
from support.scenes.pipelines import DIRECT

PIPELINES = pytest.mark.parametrize("pipeline", DIRECT, ids=lambda pipeline: pipeline.value)
RAYS = pytest.mark.parametrize("pipeline", [ls.Pipeline.TRACE, ls.Pipeline.HYBRID], ids=lambda pipeline: pipeline.value)


def above(
    height: float = 5.0, width: int = 64, rows: int = 48, fov_y: float = 0.6, eye: tuple[float, float] = (0.7, 0.9)
) -> ls.Camera:
    """Returns a camera above the origin that looks down slightly obliquely."""
    return ls.Camera.look_at(
        (eye[0], height, eye[1]), (0.0, 0.0, 0.0), (0.0, 0.0, -1.0), width=width, height=rows, fov_y=fov_y
    )


def floor(material: Material, half: float = 20.0) -> ls.Mesh:
    """Returns a plane that faces up."""
    return parallelogram((-half, 0.0, half), (2.0 * half, 0.0, 0.0), (0.0, 0.0, -2.0 * half), material)


def floor_points(camera: ls.Camera) -> np.ndarray:
    """Returns the points of the plane at the pixel centres, shape (H, W, 3)."""
    directions = camera.ray_directions() @ camera.world_from_camera[:3, :3].T
    return camera.eye - camera.eye[1] / directions[..., 1:2] * directions


def lit(scene: ls.Scene, camera: ls.Camera, pipeline: ls.Pipeline = ls.Pipeline.TRACE, **settings: object) -> ls.Frame:
    """Renders a lit frame."""
    config = ls.RenderConfig(pipeline=pipeline, lighting=True)
    return ls.render(scene, camera, replace(config, **settings), device="cpu")


def towards(point: npt.ArrayLike, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns unit directions to a point, shape (H, W, 3), and distances, shape (H, W)."""
    away = np.array(point) - points
    distances = np.linalg.norm(away, axis=-1)
    return away / distances[..., None], distances


def assert_relatively_close(actual: np.ndarray, expected: np.ndarray, rtol: float) -> None:
    """Asserts errors of at most ``rtol`` times the largest expected value."""
    assert_close(actual, expected, atol=rtol * float(np.max(expected)))


def tile_means(image: np.ndarray, size: int = 8) -> np.ndarray:
    """Returns means over square tiles of pixels; incomplete tiles are left out."""
    rows, columns = (n // size for n in image.shape)
    return image[: rows * size, : columns * size].reshape(rows, size, columns, size).mean(axis=(1, 3))
