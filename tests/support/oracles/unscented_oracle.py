"""Rasterises frames along rays in float64, written from the definitions of the camera models.

Every Gaussian is tested against every pixel without tiles, so that bounding boxes that are too small show as errors.
The unscented transform stands alone (Julier and Uhlmann 1997; Wan and van der Merwe 2000, equations 15).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

import lumisplat as ls
from lumisplat.constants import ALPHA_MAX, ALPHA_MIN
from lumisplat.math.distortion import distort
from support.oracles.camera_oracle import world_from_row
from support.oracles.raster_oracle import rotation_from_quaternion, sh_basis


@dataclass(frozen=True)
class Rays:
    """One ray per pixel, in world space."""

    origin: np.ndarray  # (H, W, 3)
    direction: np.ndarray  # (H, W, 3), unit; 0 for pixels without a ray
    t_min: np.ndarray  # (H, W)


def rays_of(camera: ls.Camera) -> Rays:
    """Returns the rays of the pixel centres, each at the exposure time of its row."""
    local = camera.ray_directions()
    poses = np.stack([world_from_row(camera, row) for row in range(camera.height)])
    turned = np.einsum("yij,yxj->yxi", poses[:, :3, :3], local)
    near = np.full(local.shape[:2], camera.near)
    if camera.model is ls.CameraModel.PINHOLE:
        near = camera.near / np.maximum(local[..., 2], 1e-9)
    return Rays(np.broadcast_to(poses[:, None, :3, 3], turned.shape), turned, near)


def image_point(camera: ls.Camera, view: np.ndarray) -> np.ndarray:
    """Projects points of camera space to pixels, (..., 2); points of a pinhole must be in front of the camera."""
    across = np.linalg.norm(view[..., :2], axis=-1, keepdims=True)
    radius = across / view[..., 2:]
    if camera.model is ls.CameraModel.FISHEYE:
        radius = np.arctan2(across, view[..., 2:])
    plane = view[..., :2] / np.maximum(across, 1e-300) * radius
    return distort(plane, camera.distortion) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def time_of(camera: ls.Camera, point: np.ndarray) -> float:
    """Returns the time, 0..1, at which the row that sees a world point is exposed, by 20 fixed-point steps."""
    time = 0.5
    for _ in range(20 if camera.camera_from_world_end is not None else 0):
        pose = world_from_row(camera, time * camera.height - 0.5)
        view = pose[:3, :3].T @ (point - pose[:3, 3])
        time = float(np.clip(image_point(camera, view)[1] / camera.height, 0.0, 1.0))
    return time


@dataclass(frozen=True)
class Parameters:
    """One Gaussian set in world space, float64."""

    means: np.ndarray
    rotations_wxyz: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    background: np.ndarray

    @classmethod
    def of(cls, gaussians: ls.Gaussians, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Parameters:
        """Returns the parameters of a set, exactly as stored in float32."""
        names = ("means", "rotations_wxyz", "scales", "opacities", "sh")
        values = {name: np.array(getattr(gaussians, name), np.float64) for name in names}
        return cls(background=np.array(background), **values)


@dataclass(frozen=True)
class Twin:
    """Renders the frames of one camera."""

    camera: ls.Camera
    dilation: float = 0.3
    transmittance_min: float = 1e-4

    @cached_property
    def _rays(self) -> Rays:
        return rays_of(self.camera)

    def sums(self, p: Parameters) -> tuple[np.ndarray, np.ndarray]:
        """Returns weighted sums of colours, (H, W, 3), and transmittance, (H, W)."""
        rays = self._rays
        axes = rotation_from_quaternion(p.rotations_wxyz / np.linalg.norm(p.rotations_wxyz, axis=1, keepdims=True))
        times = [time_of(self.camera, mean) for mean in p.means]
        poses = [world_from_row(self.camera, time * self.camera.height - 0.5) for time in times]
        views = np.array([pose[:3, :3].T @ (mean - pose[:3, 3]) for pose, mean in zip(poses, p.means, strict=True)])
        depth = np.linalg.norm(views, axis=1) if self.camera.model is ls.CameraModel.FISHEYE else views[:, 2]
        away = p.means - np.array([pose[:3, 3] for pose in poses])
        basis = sh_basis(away / np.linalg.norm(away, axis=1, keepdims=True))[:, : p.sh.shape[1]]
        color = np.maximum(np.einsum("nk,nkc->nc", basis, p.sh) + 0.5, 0.0)
        scales = np.sqrt(p.scales**2 + self.dilation * self._pixel_variance(views)[:, None])
        total, transmittance = np.zeros(rays.direction.shape), np.ones(rays.t_min.shape)
        is_done = ~np.any(rays.direction, axis=-1)
        for i in np.argsort(depth, kind="stable"):
            alpha = alpha_on(rays, p.means[i], axes[i], scales[i], float(p.opacities[i]))
            after = transmittance * (1.0 - alpha)
            is_done |= (after <= self.transmittance_min) & (alpha > 0.0)
            weight = np.where(is_done, 0.0, transmittance * alpha)
            total += weight[..., None] * color[i]
            transmittance = np.where(is_done, transmittance, after)
        return total, transmittance

    def _pixel_variance(self, views: np.ndarray) -> np.ndarray:
        """Returns the squared width of a pixel at points of camera space: solid angle times squared distance."""
        distance = np.linalg.norm(views, axis=1)
        cosine = views[:, 2] / distance
        if self.camera.model is ls.CameraModel.FISHEYE:
            theta = np.arccos(cosine)
            solid_angle = np.sinc(theta / np.pi)
        else:
            solid_angle = np.maximum(cosine, 0.0) ** 3
        return solid_angle / (self.camera.fx * self.camera.fy) * distance**2


@dataclass(frozen=True)
class Loss:
    """Loss ``sum(by_color * color) + sum(by_alpha * alpha)`` of a frame."""

    twin: Twin
    by_color: np.ndarray
    by_alpha: np.ndarray

    def __call__(self, p: Parameters) -> float:
        """Returns the loss."""
        shown, transmittance = self.twin.sums(p)
        total = (self.by_color * (shown + transmittance[..., None] * p.background)).sum()
        return float(total + (self.by_alpha * (1.0 - transmittance)).sum())


def alpha_on(rays: Rays, mean: np.ndarray, axes: np.ndarray, scales: np.ndarray, opacity: float) -> np.ndarray:
    """Returns the alpha of a Gaussian on each ray, at the ray's point of smallest Mahalanobis distance."""
    start = (rays.origin - mean) @ axes / scales
    with np.errstate(invalid="ignore", divide="ignore"):
        along = rays.direction @ axes / scales
        t = -(start * along).sum(axis=-1) / (along**2).sum(axis=-1)
        nearest = start + t[..., None] * along
        alpha = opacity * np.exp(-0.5 * (nearest**2).sum(axis=-1))
    return np.where((alpha >= ALPHA_MIN) & (t > rays.t_min), np.minimum(alpha, ALPHA_MAX), 0.0)


def sigma_moments(
    function: Callable[[np.ndarray], np.ndarray],
    mean: np.ndarray,
    axes: np.ndarray,
    scales: np.ndarray,
    spread: tuple[float, float, float] = (1.0, 2.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Returns mean and covariance of a function of a Gaussian by sigma points; ``spread`` is alpha, beta and kappa."""
    alpha, beta, kappa = spread
    n = len(mean)
    scaling = alpha**2 * (n + kappa) - n
    steps = np.sqrt(n + scaling) * (axes * scales).T
    points = np.concatenate([mean[None], mean + steps, mean - steps])
    weights = np.full(2 * n + 1, 0.5 / (n + scaling))
    weights[0] = scaling / (n + scaling)
    images = np.array([function(point) for point in points])
    center = weights @ images
    weights[0] += 1.0 - alpha**2 + beta
    return center, np.einsum("k,ki,kj->ij", weights, images - center, images - center)
