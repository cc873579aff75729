"""Evaluates a loss of an unlit raster frame in float64, and its gradients by central differences.

Unlike ``raster_oracle``, parameters are float64, so that small steps are exact. The code repeats the equations (Zwicker
et al. 2001, Kerbl et al. 2023) for one Gaussian set without meshes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

import lumisplat as ls
from lumisplat.constants import ALPHA_MAX, ALPHA_MIN, JACOBIAN_CLAMP
from support.oracles.raster_oracle import normalized, rotation_from_quaternion, sh_basis

STEPS = (1e-5, 3e-6)
"""Two step sizes; if their central differences disagree, a pixel crosses a threshold between the two steps."""
AGREE = 1e-4
"""Largest disagreement of the two step sizes, relative to the mean magnitude of a parameter's gradients."""


@dataclass(frozen=True)
class Parameters:
    """One Gaussian set and a camera pose, float64."""

    means: np.ndarray
    rotations_wxyz: np.ndarray
    scales: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    background: np.ndarray
    camera_from_world: np.ndarray
    features: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    """C additional features of each of N Gaussians, shape (N, C)."""

    @classmethod
    def of(cls, gaussians: ls.Gaussians, background: tuple[float, float, float], camera: ls.Camera) -> Parameters:
        """Returns the parameters of a set, exactly as stored in float32."""
        names = ("means", "rotations_wxyz", "scales", "opacities", "sh")
        values = {name: np.array(getattr(gaussians, name), np.float64) for name in names}
        pose = np.array(camera.camera_from_world, np.float64)
        return cls(background=np.array(background), camera_from_world=pose, **values)


@dataclass(frozen=True)
class Loss:
    """Loss ``sum(by_color * color) + sum(by_alpha * alpha)`` of a frame, with prescribed gradients by pixels.

    ``by_features`` adds weighted sums of features: view depth, normal, and ``Parameters.features``.
    """

    camera: ls.Camera
    by_color: np.ndarray
    by_alpha: np.ndarray
    antialiased: bool
    dilation: float = 0.3
    transmittance_min: float = 1e-4
    by_features: np.ndarray | None = None

    def __call__(self, p: Parameters) -> float:
        """Returns the loss."""
        shown, transmittance = self.sums(p)
        total = (self.by_color * (shown[..., :3] + transmittance[..., None] * p.background)).sum()
        total += (self.by_alpha * (1.0 - transmittance)).sum()
        return float(total if self.by_features is None else total + (self.by_features * shown[..., 3:]).sum())

    def sums(self, p: Parameters) -> tuple[np.ndarray, np.ndarray]:
        """Returns blended colours and C features, shape (H, W, 3 + C), and transmittance, shape (H, W)."""
        camera = self.camera
        view = p.means @ p.camera_from_world[:3, :3].T + p.camera_from_world[:3, 3]
        slopes = view[:, :2] / view[:, 2:]
        focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        covariance = self._covariance(p, view, slopes, focal, center)
        sharp = np.linalg.det(covariance)
        covariance = covariance + self.dilation * np.eye(2)
        opacity = p.opacities * (np.sqrt(sharp / np.linalg.det(covariance)) if self.antialiased else 1.0)
        conic = np.linalg.inv(covariance)
        shown = self._color(p)
        if self.by_features is not None:
            shown = np.concatenate([shown, surfaces(p), p.features], axis=1)
        at = np.stack(np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5), axis=-1)
        size = camera.height, camera.width
        total, transmittance = np.zeros((*size, shown.shape[1])), np.ones(size)
        is_done = np.zeros(transmittance.shape, bool)
        for i in np.argsort(view[:, 2], kind="stable"):
            dx, dy = np.moveaxis(at - (focal * slopes[i] + center), -1, 0)
            (a, b), (_, c) = conic[i]
            alpha = opacity[i] * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            alpha = np.where(alpha >= ALPHA_MIN, np.minimum(alpha, ALPHA_MAX), 0.0)
            after = transmittance * (1.0 - alpha)
            is_done |= (after <= self.transmittance_min) & (alpha > 0.0)
            weight = np.where(is_done, 0.0, transmittance * alpha)
            total += weight[..., None] * shown[i]
            transmittance = np.where(is_done, transmittance, after)
        return total, transmittance

    def _covariance(
        self, p: Parameters, view: np.ndarray, slopes: np.ndarray, focal: np.ndarray, center: np.ndarray
    ) -> np.ndarray:
        """Returns covariances of splats before dilation, pixels^2, (N, 2, 2)."""
        size = np.array([self.camera.width, self.camera.height])
        margin = (JACOBIAN_CLAMP - 1.0) * 0.5 * size / focal
        clamped = np.clip(slopes, -center / focal - margin, (size - center) / focal + margin)
        jacobian = np.zeros((len(view), 2, 3))
        jacobian[:, [0, 1], [0, 1]] = focal / view[:, 2:]
        jacobian[:, :, 2] = -focal * clamped / view[:, 2:]
        axes = rotation_from_quaternion(normalized(p.rotations_wxyz)) * p.scales[:, None, :]
        spread = jacobian @ p.camera_from_world[:3, :3] @ axes
        return spread @ spread.transpose(0, 2, 1)

    @staticmethod
    def _color(p: Parameters) -> np.ndarray:
        eye = -p.camera_from_world[:3, :3].T @ p.camera_from_world[:3, 3]
        basis = sh_basis(normalized(p.means - eye))[:, : p.sh.shape[1]]
        return np.maximum(np.einsum("nk,nkc->nc", basis, p.sh) + 0.5, 0.0)


def surfaces(p: Parameters) -> np.ndarray:
    """Returns view depth, and the shortest axis towards the eye in world space, (N, 4)."""
    turn, offset = p.camera_from_world[:3, :3], p.camera_from_world[:3, 3]
    axes = rotation_from_quaternion(normalized(p.rotations_wxyz))
    normal = axes[np.arange(len(axes)), :, p.scales.argmin(axis=1)]
    away = ((p.means + turn.T @ offset) * normal).sum(axis=1) > 0.0
    return np.column_stack([p.means @ turn[2] + offset[2], np.where(away[:, None], -normal, normal)])


def differences(function: Callable[[Parameters], float], p: Parameters, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns central differences with respect to one parameter, and a mask where both step sizes agree."""
    base = getattr(p, name)
    found = np.zeros((len(STEPS), *base.shape))
    for number, step in enumerate(STEPS):
        for index in np.ndindex(base.shape):
            values = []
            for sign in (1.0, -1.0):
                moved = base.copy()
                moved[index] += sign * step
                values.append(function(replace(p, **{name: moved})))
            found[(number, *index)] = (values[0] - values[1]) / (2.0 * step)
    scale = np.abs(found[0]).mean()
    return found[1], np.abs(found[0] - found[1]) < AGREE * scale
