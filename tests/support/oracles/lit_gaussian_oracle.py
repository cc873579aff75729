"""Shades Gaussians one by one under incident light in float64 (docs/method/relightable.md#shading)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from support.oracles.bsdf_oracle import pbr_diffuse, pbr_specular

Array = np.ndarray


@dataclass(frozen=True)
class Lit:
    """N Gaussians with incident light from K directions.

    ``open`` is the visibility of the environment, ``seen`` the indirect light of other Gaussians.
    """

    means: Array
    normals: Array
    albedo: Array
    roughness: Array
    metallic: float
    directions: Array
    environment: Array
    open: Array
    seen: Array
    spread: float


def radiance(lit: Lit, eye: Array) -> Array:
    """Returns the linear radiance of each Gaussian towards an eye, shape (N, 3)."""
    return np.array([_of_one(lit, i, lit_view(lit.normals[i], eye - lit.means[i])) for i in range(len(lit.means))])


def lit_view(normal: Array, to_eye: Array) -> Array:
    """Returns the unit direction to the eye, mirrored to the upper side if the eye is below the surface."""
    view = to_eye / np.linalg.norm(to_eye)
    return view if view @ normal >= 0.0 else view - 2.0 * (view @ normal) * normal


def _of_one(lit: Lit, i: int, view: Array) -> Array:
    normal, alpha = lit.normals[i], lit.roughness[i] ** 2
    cosines = lit.directions @ normal
    above = cosines > 0.0
    light = (lit.open[i][:, None] * lit.environment + lit.seen[i])[above]
    weights = (cosines[above] * 4.0 * np.pi / len(lit.directions))[:, None]
    metal = lit.metallic
    matte = {"diffuse": (1.0 - metal) * lit.albedo[i], "dielectric": 1.0, "eta": 1.0 / 1.5, "alpha": alpha}
    shine = {
        "specular": 0.04 * (1.0 - metal) + metal * lit.albedo[i],
        "grazing": 1.0,
        "alpha": np.sqrt(alpha**2 + lit.spread),
    }
    light_directions = lit.directions[above]
    views, normals = np.broadcast_to(view, light_directions.shape), np.broadcast_to(normal, light_directions.shape)
    reflected = pbr_diffuse(matte, normals, views, light_directions) + pbr_specular(
        shine, normals, views, light_directions
    )
    return (weights * reflected * light).sum(axis=0)
