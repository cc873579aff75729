"""Normals of Gaussians, as the depths of the photographs' views have them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lumisplat.constants.training import SURFACE_ALPHA
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.progress import Progress
from lumisplat.renderer.splat_gradients import DifferentiableRenderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.normals import shortest_axes
from lumisplat.scene.scene import Scene


def seen_normals(
    gaussians: Gaussians, cameras: Sequence[Camera], renderer: DifferentiableRenderer, report: Progress
) -> tuple[Doubles, Doubles]:
    """Unit normals towards the side that cameras see, and how much of all views each Gaussian is.

    In each view, the surface of mean depth has a normal at each pixel; that of a Gaussian is the mean over all pixels
    of all views, weighted as it is blended there. One that no surface shows has its shortest axis.

    Args:
        gaussians: The capture.
        cameras: Pinholes.
        renderer: Of raster frames.
        report: Called with what is being done and the fraction done, 0..1.

    Returns:
        Normals, world space, shape (N, 3), and sums of the weights of blending over all pixels, shape (N,).
    """
    sums, towards = np.zeros((gaussians.count, 3)), np.zeros((gaussians.count, 3))
    weights = np.zeros(gaussians.count)
    for number, camera in enumerate(cameras):
        report("finding normals", number / len(cameras))
        frame = renderer.render(Scene([gaussians]), camera)
        ways = camera.eye - gaussians.means.astype(np.float64)
        depths = -(ways @ camera.camera_from_world[2, :3])
        shown = renderer.render_features(np.column_stack([depths, np.zeros((len(depths), 2))]))
        normals = surface_normals(camera, shown[..., 0], frame.alpha)
        found = renderer.gradients(np.zeros_like(frame.color), dL_dfeatures=normals)
        assert found.features is not None
        sums += found.features
        weights += found.weights
        towards += (found.weights / np.linalg.norm(ways, axis=1))[:, None] * ways
    axes = shortest_axes(gaussians)
    axes *= np.where((axes * towards).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    return np.where(length > 1e-6, sums / np.maximum(length, 1e-6), axes), weights


def surface_normals(camera: Camera, depth: FloatArray, alpha: FloatArray) -> FloatArray:
    """Of the surface of mean depth, towards the camera, unit, shape (H, W, 3); zero where there is none.

    Args:
        camera: A pinhole.
        depth: Sums of view depths, premultiplied, shape (H, W).
        alpha: Shape (H, W).
    """
    has = alpha > SURFACE_ALPHA
    z = np.where(has, depth / np.where(has, alpha, 1.0), 0.0).astype(np.float64)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    points = z[..., None] * rays
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    whole = has[1:-1, 1:-1] & has[1:-1, 2:] & has[1:-1, :-2] & has[2:, 1:-1] & has[:-2, 1:-1]
    area = -np.cross(across, down)
    length = np.linalg.norm(area, axis=-1)
    whole &= length > 0.0
    normals = np.zeros((camera.height, camera.width, 3))
    local = area / np.where(whole, length, 1.0)[..., None]
    normals[1:-1, 1:-1] = np.where(whole[..., None], local @ camera.camera_from_world[:3, :3], 0.0)
    return normals.astype(np.float32)
