"""Evaluates a loss of unlit traced rays in float64: every Gaussian against every ray, with all hits sorted.

The code follows the equations (Moenne-Loccoz et al. 2024; docs/method/ray_tracing.md#footprints) with covariances and
their inverses, while the kernels work along the axes of each Gaussian. ``gradient_oracle.differences`` differentiates
the loss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants import ALPHA_MAX, ALPHA_MIN
from lumisplat.device.bvh.nodes import FOOTPRINT_LEAD, FOOTPRINT_MAX, FOOTPRINT_REACH
from lumisplat.renderer.scene.instance_tables import KERNEL_LINEAR_SLOPE
from support.oracles.gradient_oracle import Parameters
from support.oracles.raster_oracle import normalized, rotation_from_quaternion, sh_basis


@dataclass(frozen=True)
class RayLoss:
    """Loss ``sum(by_color * color) + sum(by_alpha * alpha)`` of R rays, whose derivatives are the given weights."""

    origins: np.ndarray  # (R, 3)
    directions: np.ndarray  # (R, 3), unit
    spreads: np.ndarray  # (R,), width of a ray's pixel over the length of its path
    t_min: np.ndarray  # (R,)
    by_color: np.ndarray  # (R, 3)
    by_alpha: np.ndarray  # (R,)
    degree: int = 2
    dilation: float = 0.3
    transmittance_min: float = 1e-4
    by_peak: bool = False  # True to sort hits by peaks, False by means

    def __call__(self, p: Parameters) -> float:
        """Returns the loss."""
        color, transmittance = self.shown(p)
        total = (self.by_color * (color + transmittance[:, None] * p.background)).sum()
        return float(total + (self.by_alpha * (1.0 - transmittance)).sum())

    def shown(self, p: Parameters) -> tuple[np.ndarray, np.ndarray]:
        """Returns premultiplied colours, (R, 3), and transmittance, (R,)."""
        offset = p.means - self.origins[:, None, :]  # (R, N, 3)
        middle = (offset * self.directions[:, None, :]).sum(axis=2)
        inverse = self._inverse_covariance(p, middle)
        v = np.broadcast_to(self.directions[:, None, :], offset.shape)
        vv, vo, oo = (np.einsum("rni,rnij,rnj->rn", a, inverse, b) for a, b in ((v, v), (v, offset), (offset, offset)))
        peak = vo / vv
        distance = np.sqrt(np.maximum(oo - vo * peak, 0.0))
        if self.degree == 0:
            response = np.maximum(1.0 - KERNEL_LINEAR_SLOPE * distance, 0.0)
        else:
            response = np.exp(-4.5 * (distance / 3.0) ** self.degree)
        alpha = p.opacities * response
        alpha = np.where((alpha >= ALPHA_MIN) & (peak > self.t_min[:, None]), np.minimum(alpha, ALPHA_MAX), 0.0)
        order = np.argsort(peak if self.by_peak else middle, axis=1, kind="stable")
        alpha = np.take_along_axis(alpha, order, axis=1)
        color = np.take_along_axis(self._color(p, offset), order[:, :, None], axis=1)
        after = np.cumprod(1.0 - alpha, axis=1)
        before = np.concatenate([np.ones((len(after), 1)), after[:, :-1]], axis=1)
        goes_on = before > self.transmittance_min
        alpha = np.where(goes_on, alpha, 0.0)
        return ((before * alpha)[:, :, None] * color).sum(axis=1), np.prod(1.0 - alpha, axis=1)

    def _inverse_covariance(self, p: Parameters, middle: np.ndarray) -> np.ndarray:
        """Returns inverse covariances of the Gaussians, widened by each ray's footprint, (R, N, 3, 3)."""
        longest = p.scales.max(axis=1)
        path = np.maximum(np.minimum(middle, FOOTPRINT_LEAD * (middle - FOOTPRINT_REACH * longest)), 0.0)
        width = np.minimum(np.sqrt(self.dilation) * self.spreads, FOOTPRINT_MAX)[:, None] * path
        axes = rotation_from_quaternion(normalized(p.rotations_wxyz))
        covariance = (axes * p.scales[:, None, :] ** 2) @ axes.transpose(0, 2, 1)
        return np.linalg.inv(covariance + width[:, :, None, None] ** 2 * np.eye(3))

    @staticmethod
    def _color(p: Parameters, offset: np.ndarray) -> np.ndarray:
        """Returns the colour of each Gaussian from each ray, (R, N, 3)."""
        basis = sh_basis(normalized(offset.reshape(-1, 3)))[:, : p.sh.shape[1]].reshape(*offset.shape[:2], -1)
        return np.maximum(np.einsum("rnk,nkc->rnc", basis, p.sh) + 0.5, 0.0)
