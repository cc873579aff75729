"""Transmittance of Gaussians from a light to points, and its gradients, in closed form and float64.

The equations are in docs/method/deep_shadow_maps.md#gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import erf, erfc  # pyright: ignore[reportMissingTypeStubs]

from lumisplat.config import Absorption, DeepShadowConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import ALPHA_MAX
from lumisplat.errors import SceneError, check_instance
from lumisplat.math.arrays import Doubles, finite_array
from lumisplat.math.transforms import matrices_from_quaternions
from lumisplat.renderer.gradients.arrays import SetGradient
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.lights import LightDirectional
from lumisplat.shadow_maps.atlas import Source, source_of

_SHORT = 1.0
"""Segments whose squared length in canonical space is below this are summed by quadrature: the closed form of the
moments divides by it, twice. Eight nodes are exact there to 1e-13."""
_PAIRS = 1 << 20
"""Largest number of (point, Gaussian) pairs that are in memory at once."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)


@dataclass(frozen=True, slots=True, eq=False)
class ShadowTransmittance:
    """Transmittance from a light to points, with what its gradients need."""

    transmittance: Doubles
    """Transmittance at each of P points, 0..1, shape (P,)."""
    _casters: Gaussians
    _light: Source
    _points: Doubles
    _config: DeepShadowConfig

    def gradients(self, dL_dtransmittance: npt.ArrayLike) -> tuple[SetGradient, Doubles]:
        """Returns the gradients of a loss by the casters, and by the position or direction of the light.

        Args:
            dL_dtransmittance: Gradient of the loss by ``transmittance``, shape (P,).

        Returns:
            Gradients by means, rotations, scales and opacities, as `SplatGradients.sets` has them (those by SH are 0),
            and the gradient by the light, shape (3,): by its position, or by ``direction`` of a `LightDirectional`. The
            latter is perpendicular to the direction, which is normalised after each update. Opacities of 0.99 and above
            have gradients of 0.

        Raises:
            SceneError: The shape is not (P,), or values are not finite.
        """
        upstream = finite_array("dL_dtransmittance", dL_dtransmittance, np.float64)
        if upstream.shape != self.transmittance.shape:
            raise SceneError(f"dL_dtransmittance has shape {upstream.shape}, expected {self.transmittance.shape}")
        model = _Model(self._casters, self._config)
        sums = _Sums(np.zeros_like(model.means), np.zeros((len(model.means), 3, 3)), np.zeros_like(model.scales))
        light, by_beta = np.zeros(3), np.zeros(len(model.means))
        weights = -self.transmittance * upstream
        for rows in _chunks(len(self._points), len(model.means)):
            segment = _Segment.of(model, self._light, self._points[rows])
            depth = model.beta * segment.length[:, None] * segment.moments[0]
            scale = weights[rows, None] * model.beta * segment.length[:, None]
            zeroth, first, second = (scale[..., None] * moment[..., None] for moment in segment.moments)
            by_start = -(zeroth * segment.start + first * segment.along)
            by_along = -(first * segment.start + second * segment.along)
            by_beta += (weights[rows, None] * depth).sum(axis=0) / np.where(model.beta > 0.0, model.beta, 1.0)
            start_world = np.einsum("nik,pnk->pni", model.world_from_canonical_gradient, by_start)
            along_world = np.einsum("nik,pnk->pni", model.world_from_canonical_gradient, by_along)
            sums.means -= start_world.sum(axis=0)
            if isinstance(self._light, LightDirectional):
                light -= along_world.sum(axis=(0, 1))
            else:
                light += (start_world - along_world).sum(axis=(0, 1))
                light -= ((weights[rows, None] * depth).sum(axis=1) / segment.length**2) @ segment.ray
            sums.scales -= (by_start * segment.start + by_along * segment.along).sum(axis=0) / model.scales
            offsets = segment.origin[:, None] - model.means
            sums.rotations += np.einsum("pni,pnk->nik", offsets, by_start) / model.scales[:, None]
            sums.rotations += np.einsum("pi,pnk->nik", segment.ray, by_along) / model.scales[:, None]
        if isinstance(self._light, LightDirectional):
            light -= (light @ self._light.direction) * np.array(self._light.direction)
        return model.gradient(sums, by_beta), light


def shadow_transmittance(
    casters: Gaussians, light_position: object, points: npt.ArrayLike, config: DeepShadowConfig | None = None
) -> ShadowTransmittance:
    """Computes the transmittance of Gaussians from a light to points, exactly and with gradients.

    It is what a `DeepShadowMap` tabulates, without texels, bins and culling. All pairs of a point and a Gaussian are
    visited in NumPy: it is for fits of thousands of points and Gaussians, not for frames.

    Args:
        casters: N Gaussians that block light, world space.
        light_position: A light, or the position of a point light, world space, shape (3,). Lights with an extent are
            treated as points at their centre. The rays of a `LightDirectional` are parallel.
        points: P points, world space, shape (P, 3), none of them at the light.
        config: Its ``absorption`` and ``strength`` count; None: the defaults.

    Returns:
        The transmittances, and a method for their gradients.

    Raises:
        ConfigError: ``config`` is no DeepShadowConfig.
        SceneError: An argument is of another type or shape, a value is not finite, or a point lies at the light.
    """
    config = DeepShadowConfig() if config is None else config
    check_kind("config", config, DeepShadowConfig)
    check_instance(casters, Gaussians, "shadow_transmittance takes Gaussians")
    light = source_of(light_position)
    given = finite_array("points", points, np.float64)
    if given.ndim != 2 or given.shape[1] != 3:
        raise SceneError(f"points has shape {given.shape}, expected (P, 3)")
    if not isinstance(light, LightDirectional) and (given == light).all(axis=1).any():
        raise SceneError("points has one at the light, where no direction is defined")
    model = _Model(casters, config)
    depth = np.zeros(len(given))
    for rows in _chunks(len(given), len(model.means)):
        segment = _Segment.of(model, light, given[rows])
        depth[rows] = segment.length * (segment.moments[0] @ model.beta)
    return ShadowTransmittance(np.exp(-depth), casters, light, given, config)


@dataclass(slots=True)
class _Sums:
    """Gradients of the loss by means (N, 3), rotation matrices (N, 3, 3) and scales (N, 3), without those by beta."""

    means: Doubles
    rotations: Doubles
    scales: Doubles


class _Model:
    """Gaussians in float64, and their absorption beta, as `device/shadow_map/optical_depth.py` has it."""

    def __init__(self, casters: Gaussians, config: DeepShadowConfig) -> None:
        self.means = casters.means.astype(np.float64) + casters.origin
        self.scales = casters.scales.astype(np.float64)
        self.quaternions = casters.rotations_wxyz.astype(np.float64)
        rotations = matrices_from_quaternions(self.quaternions)
        self.world_from_canonical_gradient = rotations / self.scales[:, None, :]
        """Transposes of the matrices that take world vectors to canonical space, shape (N, 3, 3)."""
        self._opacities = casters.opacities.astype(np.float64)
        self._strength = config.strength
        self._sh_shape = casters.sh.shape
        inverse2 = 1.0 / self.scales**2
        if config.absorption is Absorption.SIMPLE:
            factor, self._log_slope = np.ones(len(self.means)), np.zeros_like(self.scales)
        elif config.absorption is Absorption.AVERAGE:
            factor = np.sqrt(inverse2.mean(axis=1) / (2.0 * np.pi))
            self._log_slope = -inverse2 / self.scales / inverse2.sum(axis=1, keepdims=True)
        else:
            factor = (2.0 * np.pi) ** -1.5 / self.scales.prod(axis=1)
            self._log_slope = -1.0 / self.scales
        self._factor = factor
        self.beta = -config.strength * np.log1p(-np.minimum(self._opacities, ALPHA_MAX)) * factor
        """Absorption at the means, per scene unit, shape (N,)."""

    def gradient(self, sums: _Sums, by_beta: Doubles) -> SetGradient:
        """Returns the gradients by the stored parameters, from those by matrices and by beta."""
        w, x, y, z = self.quaternions.T / np.linalg.norm(self.quaternions, axis=1)
        slopes = 2.0 * np.array(
            [
                [[w, -z, y], [z, w, -x], [-y, x, w]],
                [[x, y, z], [y, -x, -w], [z, w, -x]],
                [[-y, x, w], [x, y, z], [-w, z, -y]],
                [[-z, -w, x], [w, -z, y], [x, y, z]],
            ]
        )
        unit = np.stack([w, x, y, z], axis=1)
        turned = np.einsum("nij,qijn->nq", sums.rotations, slopes)
        turned -= unit * (turned * unit).sum(axis=1, keepdims=True)
        opacities = np.where(self._opacities < ALPHA_MAX, self._strength * self._factor * by_beta, 0.0)
        opacities /= 1.0 - np.minimum(self._opacities, ALPHA_MAX)
        scales = sums.scales + (self.beta * by_beta)[:, None] * self._log_slope
        turned /= np.linalg.norm(self.quaternions, axis=1, keepdims=True)
        columns = (sums.means, turned, scales, opacities, np.zeros(self._sh_shape))
        return SetGradient(*(column.astype(np.float32) for column in columns))


@dataclass(frozen=True, slots=True)
class _Segment:
    """Segments of the rays that reach P points, in the canonical space of N Gaussians.

    Those of a point light lead from the light to the points; those of parallel light from the points against the light,
    without end. An axis of length 1 stands for all points.
    """

    origin: Doubles
    """Where the segments start, world space, shape (1, 3) or (P, 3)."""
    ray: Doubles
    """Vectors along the segments, world space, shape (P, 3) or (1, 3): to their ends, or of length 1."""
    length: Doubles
    """Lengths of these, scene units, shape (P,) or (1,)."""
    start: Doubles
    """The starts in canonical space, shape (1, N, 3) or (P, N, 3)."""
    along: Doubles
    """The vectors in canonical space, shape (P, N, 3) or (1, N, 3)."""
    moments: tuple[Doubles, Doubles, Doubles]
    """``integral of u^k exp(-1/2 |start + u along|^2)`` over 0..1, or 0..infinity, for k = 0, 1, 2, shape (P, N) each.
    """

    @classmethod
    def of(cls, model: _Model, light: Source, points: Doubles) -> _Segment:
        is_parallel = isinstance(light, LightDirectional)
        origin = points if is_parallel else light[None]
        ray = -np.array([light.direction]) if is_parallel else points - light
        start = np.einsum("nik,pni->pnk", model.world_from_canonical_gradient, origin[:, None] - model.means)
        along = np.einsum("nik,pi->pnk", model.world_from_canonical_gradient, ray)
        moments = _endless_moments(start, along) if is_parallel else _moments(start, along)
        return cls(origin, ray, np.linalg.norm(ray, axis=1), start, along, moments)


def _endless_moments(start: Doubles, along: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Returns the moments of `_Segment.moments` over 0..infinity, by the complementary error function."""
    a, b, peak = _lines(start, along)
    zeroth = peak * erfc(b / np.sqrt(2.0 * a))
    first = (_density(start) - b * zeroth) / a
    return zeroth, first, (zeroth - b * first) / a


def _moments(start: Doubles, along: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Returns the moments of `_Segment.moments` over 0..1: by error functions, and by quadrature for short segments."""
    a, b, peak = _lines(start, along)
    root = np.sqrt(2.0 * a)
    zeroth = peak * (erf((a + b) / root) - erf(b / root))
    last_value = _density(start + along)
    first = (_density(start) - last_value - b * zeroth) / a
    second = (zeroth - last_value - b * first) / a
    short = a < _SHORT
    if short.any():
        u = 0.5 * (_NODES + 1.0)
        begin = np.broadcast_to((start * start).sum(axis=2), a.shape)[short]
        value = np.exp(-0.5 * (begin[:, None] + 2.0 * u * b[short][:, None] + u * u * a[short][:, None]))
        for power, moment in enumerate((zeroth, first, second)):
            moment[short] = value @ (0.5 * _WEIGHTS * u**power)
    return zeroth, first, second


def _lines(start: Doubles, along: Doubles) -> tuple[Doubles, Doubles, Doubles]:
    """Returns ``along . along``, ``start . along``, and half the integral of `_density` over each whole line."""
    a, b = (along * along).sum(axis=2), (start * along).sum(axis=2)
    miss = start - (b / a)[..., None] * along
    return a, b, np.sqrt(np.pi / (2.0 * a)) * _density(miss)


def _density(canonical: Doubles) -> Doubles:
    """Returns ``exp(-1/2 |x|^2)`` of canonical vectors, shape (..., 3) to (...)."""
    return np.exp(-0.5 * (canonical * canonical).sum(axis=2))


def _chunks(points: int, casters: int) -> list[slice]:
    """Returns slices of the points, of at most `_PAIRS` pairs with the Gaussians each."""
    step = max(_PAIRS // max(casters, 1), 1)
    return [slice(start, start + step) for start in range(0, points, step)]
