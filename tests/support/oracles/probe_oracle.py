"""Float64 reference of the transfer of a probe's light to Gaussians, one normal at a time (Mir et al., section 3.4)."""

from __future__ import annotations

import numpy as np

import lumisplat as ls
from lumisplat.constants import SH_C0
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.math.sh import sh_basis


def some_probe(seed: int = 0, degree: int = 3) -> ls.avatars.EnvironmentProbe:
    """Returns a probe of coloured light with some contrast and some negative radiance."""
    coefficients = np.random.default_rng(seed).normal(size=((degree + 1) ** 2, 3))
    coefficients[0] += 3.0
    return ls.avatars.EnvironmentProbe(coefficients)


def transfer_scales(coefficients: np.ndarray, normals: np.ndarray, config: ls.config.RelightConfig) -> np.ndarray:
    """Returns the scales by equations 9 and 10 of Mir et al. for unit normals, shape (N, 3)."""
    theta = (np.arange(config.rows) + 0.5) * np.pi / config.rows
    phi = (np.arange(2 * config.rows) + 0.5) * np.pi / config.rows
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, phi, indexing="ij"))
    # Theta is measured from y, as in environments.
    omega = np.stack([-np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=1)
    weights = np.sin(theta)
    radiance = sh_basis(omega, round(len(coefficients) ** 0.5) - 1) @ coefficients
    scales = []
    for normal in normals:
        lobe = weights * np.maximum(0.0, omega @ normal) ** config.exponent
        scales.append(lobe @ radiance / lobe.sum())
    return np.clip(scales, 0.0, config.scale_max)


def irradiance(coefficients: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Returns the irradiance at unit normals by the factors that Ramamoorthi and Hanrahan list, up to degree 4."""
    factors = np.repeat([np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24], 2 * np.arange(5) + 1)[: len(coefficients)]
    return sh_basis(normals, round(len(coefficients) ** 0.5) - 1) @ (factors[:, None] * coefficients)


def relit_sh(
    captured: np.ndarray, coefficients: np.ndarray, normals: np.ndarray, config: ls.config.RelightConfig
) -> np.ndarray:
    """Returns the SH of relit Gaussians, (N, M, 3), for normals of any length; in closed form for exponent 1."""
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    if config.exponent == 1.0:
        scales = np.clip(irradiance(coefficients, unit) / np.pi, 0.0, config.scale_max)
    else:
        scales = transfer_scales(coefficients, unit, config)
    mean = np.maximum(SH_C0 * captured[:, 0] + 0.5, 1e-4)
    gain = encode_srgb((config.gamma or 1.0) * scales * decode_srgb(mean)) / mean
    relit = gain[:, None] * captured
    relit[:, 0] += (gain - 1.0) * 0.5 / SH_C0  # the colour is SH plus 0.5, and all of it is multiplied
    return relit
