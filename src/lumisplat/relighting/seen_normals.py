"""Estimates normals of the surface that a capture shows, from the depths of given views, or of views chosen for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lumisplat.constants import SURFACE_ALPHA
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.progress import Progress
from lumisplat.renderer.gradients.differentiable_renderer import DifferentiableRenderer
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.normals import shortest_axes
from lumisplat.scene.scene import Scene

VIEWS = 64
"""Number of views that `normals_from_around` chooses."""

VIEW_SIZE, VIEW_ANGLE = 192, 1.0
"""Width and height, pixels, and field of view, radians, of the chosen views."""

VIEW_TILT = 0.5
"""Standard deviation, in each coordinate, of the random vector that is added to a Gaussian's normal: their sum is the
direction from the Gaussian to the camera of a chosen view."""

CLEAR_SHARE, EXTENT_SHARE = 0.7, 0.5
"""A chosen view's camera is at this share of the clear distance in front of the Gaussian at which it looks, and at most
at the second share of the capture's extent."""

NEAREST = 12.0
"""Smallest distance of a chosen view's camera from the Gaussian at which it looks, in units of its largest scale."""

SEEN_MIN = 0.05
"""Blending weight in all chosen views, pixels, from which a Gaussian has the normal that they show."""


class NormalSums:
    """Sums the normal maps of views over the pixels that N Gaussians cover, weighted by blending weights.

    Args:
        gaussians: The capture.
        renderer: Renderer of raster frames.
    """

    def __init__(self, gaussians: Gaussians, renderer: DifferentiableRenderer) -> None:
        self._gaussians, self._renderer = gaussians, renderer
        self._sums = np.zeros((gaussians.count, 3))
        self.weights: Doubles = np.zeros(gaussians.count)
        """Blending weights summed over all pixels of all views, shape (N,)."""

    def add(self, camera: Camera) -> FloatArray:
        """Adds the view of a pinhole camera, and returns the Gaussians' blending weights in it, shape (N,)."""
        frame = self._renderer.render(Scene([self._gaussians]), camera)
        depths = (self._gaussians.means.astype(np.float64) - camera.eye) @ camera.camera_from_world[2, :3]
        shown = self._renderer.render_features(np.column_stack([depths, np.zeros((len(depths), 2))]))
        normals = surface_normals(camera, shown[..., 0], frame.alpha)
        found = self._renderer.gradients(np.zeros_like(frame.color), dL_dfeatures=normals)
        assert found.features is not None
        self._sums += found.features
        self.weights += found.weights
        return found.weights

    def means(self, otherwise: Doubles, weight_min: float = 0.0) -> Doubles:
        """Returns unit normals, (N, 3); ``otherwise`` where weights are below ``weight_min`` or normals are unknown."""
        length = np.linalg.norm(self._sums, axis=1, keepdims=True)
        is_seen = (length > 1e-6) & (self.weights[:, None] >= weight_min)
        return np.where(is_seen, self._sums / np.maximum(length, 1e-6), otherwise)


def rendered_normals(
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    renderer: DifferentiableRenderer,
    report: Progress,
    *,
    kept: Sequence[int] = (),
) -> tuple[Doubles, Doubles, FloatArray]:
    """Estimates the unit normal of each of N Gaussians towards the cameras, and its blending weights.

    Each view gives a normal map of the surface at mean depth. The normal of a Gaussian is the mean of these maps over
    all pixels of all views, weighted by the Gaussian's blending weights. A Gaussian visible in no pixel with a normal
    gets its shortest axis.

    Args:
        gaussians: The capture.
        cameras: Pinhole cameras.
        renderer: Renderer of raster frames.
        report: Called with a description of the current work and the fraction done, 0..1.
        kept: Indices of K cameras whose blending weights are returned one by one.

    Returns:
        Normals in world space, shape (N, 3); blending weights summed over all pixels of all cameras, shape (N,), and of
        the kept cameras, shape (K, N).
    """
    sums, towards = NormalSums(gaussians, renderer), np.zeros((gaussians.count, 3))
    kept_weights = np.zeros((len(kept), gaussians.count), np.float32)
    for number, camera in enumerate(cameras):
        report("finding normals", number / len(cameras))
        weights = sums.add(camera)
        if number in kept:
            kept_weights[kept.index(number)] = weights
        to_camera = camera.eye - gaussians.means.astype(np.float64)
        towards += (weights / np.linalg.norm(to_camera, axis=1))[:, None] * to_camera
    axes = shortest_axes(gaussians)
    axes *= np.where((axes * towards).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    return sums.means(axes), sums.weights, kept_weights


def normals_from_around(
    gaussians: Gaussians,
    normals: Doubles,
    renderer: DifferentiableRenderer,
    clear: Callable[[int, Doubles], float],
    *,
    rng: np.random.Generator,
    shown: Callable[[], object] = lambda: None,
) -> Doubles:
    """Estimates the unit normal of each of N Gaussians by views like those of `rendered_normals`, chosen for it.

    Each view looks at a Gaussian that is drawn by opacity, from the clear space on its visible side. Gaussians that no
    view shows keep their normal.

    Args:
        gaussians: The capture.
        normals: Unit normals towards the visible side, shape (N, 3).
        renderer: Renderer of raster frames.
        clear: Returns the distance, scene units, from a Gaussian to the next surface in a unit direction, shape (3,);
            infinity if there is none.
        rng: Generator that chooses the views.
        shown: Called after each view, for progress.

    Returns:
        Normals in world space, shape (N, 3).
    """
    chances = gaussians.opacities / gaussians.opacities.sum(dtype=np.float64)
    nearest = NEAREST * gaussians.scales.max(axis=1).astype(np.float64)
    low, high = np.quantile(gaussians.means, (0.02, 0.98), axis=0)
    extent, sums = float(np.linalg.norm(high - low)), NormalSums(gaussians, renderer)
    for row in rng.choice(gaussians.count, VIEWS, p=chances):
        towards = normals[row] + VIEW_TILT * rng.normal(size=3)
        towards /= np.linalg.norm(towards)
        distance = min(CLEAR_SHARE * clear(row, towards), EXTENT_SHARE * extent)
        mean = gaussians.means[row].astype(np.float64)
        eye, up = mean + max(distance, nearest[row]) * towards, np.eye(3)[np.argmin(np.abs(towards))]
        sums.add(Camera.look_at(eye, mean, up, width=VIEW_SIZE, height=VIEW_SIZE, fov_y=VIEW_ANGLE))
        shown()
    return sums.means(normals, SEEN_MIN)


def surface_normals(camera: Camera, depth: FloatArray, alpha: FloatArray) -> FloatArray:
    """Returns unit normals, towards the camera, of the surface at mean depth, shape (H, W, 3); zero without a surface.

    Args:
        camera: A pinhole camera.
        depth: Alpha-blended view depths, not divided by alpha, shape (H, W).
        alpha: Alpha of each pixel, shape (H, W).
    """
    has = alpha > SURFACE_ALPHA
    z = np.where(has, depth / np.where(has, alpha, 1.0), 0.0).astype(np.float64)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    points = z[..., None] * rays
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    is_defined = has[1:-1, 1:-1] & has[1:-1, 2:] & has[1:-1, :-2] & has[2:, 1:-1] & has[:-2, 1:-1]
    area = -np.cross(across, down)
    length = np.linalg.norm(area, axis=-1)
    is_defined &= length > 0.0
    normals = np.zeros((camera.height, camera.width, 3))
    local = area / np.where(is_defined, length, 1.0)[..., None]
    normals[1:-1, 1:-1] = np.where(is_defined[..., None], local @ camera.camera_from_world[:3, :3], 0.0)
    return normals.astype(np.float32)
