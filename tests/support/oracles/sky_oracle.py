"""Random walks of light through the atmosphere of `lumisplat.math.atmosphere`: the truth about its scattering."""

from __future__ import annotations

import numpy as np

from lumisplat.math import atmosphere as model
from lumisplat.math.arrays import Doubles, Flags


def sky_radiance(
    direction: Doubles, elevation: float, turbidity: float, albedo: float, wavelength: int, walks: int
) -> float:
    """Returns the sky's radiance for sunlight of 1, by walks from the ground that look at the sun after each turn.

    Free paths are sampled by delta tracking (Woodcock 1965), turns by Rayleigh's and Henyey and Greenstein's laws.

    Args:
        direction: Unit direction, y up, the sun in the half plane of -z, shape (3,).
        elevation: Elevation of the sun, degrees.
        turbidity: Haze.
        albedo: Albedo of the ground.
        wavelength: Index into `model.WAVELENGTHS`.
        walks: Number of walks.
    """
    rng, medium = np.random.default_rng(0), model.medium_of(turbidity)
    air, ozone = medium.air[wavelength], medium.ozone[wavelength]
    haze = medium.scattering[wavelength] / model.AEROSOL_ALBEDO
    angle = np.radians(elevation)
    sun = np.array([0.0, np.sin(angle), -np.cos(angle)])
    points = np.tile([0.0, model.GROUND + 1e-3, 0.0], (walks, 1))
    towards, weights, total = np.tile(direction, (walks, 1)), np.ones(walks), 0.0
    for _ in range(20):
        points, towards, weights, on_ground = _flown(rng, points, towards, weights, air, haze, ozone)
        if not len(points):
            break
        radius = np.linalg.norm(points, axis=1)
        up, density = points / radius[:, None], model.densities(radius - model.GROUND)
        columns = model.columns(radius, up @ sun)
        lit = np.exp(-columns @ (air, haze, ozone)) * model.visible_sun(radius, up @ sun)
        parts = density * (air, haze, ozone)
        cosine, g = towards @ sun, model.AEROSOL_FORWARD
        lobe = (1.0 - g * g) / (4.0 * np.pi * (1.0 + g * g - 2.0 * g * cosine) ** 1.5)
        turned = parts[:, 0] * 0.75 * (1.0 + cosine**2) / (4.0 * np.pi) + model.AEROSOL_ALBEDO * parts[:, 1] * lobe
        reflected = albedo / np.pi * np.maximum(up @ sun, 0.0)
        total += float((weights * lit * np.where(on_ground, reflected, turned / parts.sum(axis=1))).sum())
        scattered = parts[:, 0] + model.AEROSOL_ALBEDO * parts[:, 1]
        weights = weights * np.where(on_ground, albedo, scattered / parts.sum(axis=1))
        by_air = rng.random(len(points)) < parts[:, 0] / scattered
        towards = _turned(rng, np.where(on_ground[:, None], up, towards), on_ground, by_air)
        points = np.where(on_ground[:, None], up * (model.GROUND + 1e-4), points)
    return total / walks


def _flown(
    rng: np.random.Generator, points: Doubles, towards: Doubles, weights: Doubles, *coefficients: float
) -> tuple[Doubles, Doubles, Doubles, Flags]:
    """Returns the walks that meet air, haze or ground next: points, directions, weights, and whether on the ground."""
    points, flies = points.copy(), np.ones(len(points), bool)
    escaped, grounded = np.zeros(len(points), bool), np.zeros(len(points), bool)
    while flies.any():
        i = np.flatnonzero(flies)
        radius = np.linalg.norm(points[i], axis=1)
        slope = (points[i] * towards[i]).sum(axis=1) / radius
        down = slope < model.horizon(radius)
        low = np.where(down, model.GROUND, np.where(slope < 0.0, radius * np.sqrt(1.0 - slope**2), radius))
        most = model.densities(low - model.GROUND)
        most[:, 2] = 1.0
        bound = most @ coefficients
        free = -np.log(1.0 - rng.random(len(i))) / bound
        below = np.sqrt(np.maximum((radius * slope) ** 2 - radius**2 + model.GROUND**2, 0.0))
        end = np.where(down, -radius * slope - below, model.reach(radius, slope, model.TOP))
        points[i] += np.minimum(free, end)[:, None] * towards[i]
        ends = free >= end
        escaped[i[ends & ~down]], grounded[i[ends & down]] = True, True
        height = np.linalg.norm(points[i], axis=1) - model.GROUND
        meets = rng.random(len(i)) < model.densities(height) @ coefficients / bound
        flies[i[ends | meets]] = False
    return points[~escaped], towards[~escaped], weights[~escaped], grounded[~escaped]


def _turned(rng: np.random.Generator, axis: Doubles, on_ground: Flags, by_air: Flags) -> Doubles:
    """Returns directions about axes: diffuse ones about the ground's normal, else scattered ones."""
    u, g = rng.random(len(axis)), model.AEROSOL_FORWARD
    haze = (1.0 + g * g - ((1.0 - g * g) / (1.0 - g + 2.0 * g * u)) ** 2) / (2.0 * g)
    root = np.cbrt(4.0 * u - 2.0 + np.sqrt(1.0 + (4.0 * u - 2.0) ** 2))
    cosine = np.clip(np.where(on_ground, np.sqrt(u), np.where(by_air, root - 1.0 / root, haze)), -1.0, 1.0)
    around = 2.0 * np.pi * rng.random(len(axis))
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin(axis=1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    across = np.cos(around)[:, None] * side + np.sin(around)[:, None] * np.cross(axis, side)
    return cosine[:, None] * axis + np.sqrt(1.0 - cosine**2)[:, None] * across
