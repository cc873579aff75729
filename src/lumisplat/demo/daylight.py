"""Bakes daylight into the colours of the demo's capture, so that it looks photographed.

The light is a sun and an overcast sky. Shadow maps of points on the scene's surfaces, one per direction, give
visibility (Williams 1978); many directions give ambient occlusion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import FloatArray

_Floats = npt.NDArray[np.floating]


@dataclass(frozen=True, kw_only=True)
class Daylight:
    """Sun light, sky light, and light reflected by the room."""

    sun_direction: tuple[float, float, float]
    """Direction towards the sun, of any length."""
    sun_color: tuple[float, float, float] = (2.6, 1.95, 1.2)
    """Irradiance of a surface that faces the sun, linear Rec.709; white paper with irradiance 1 is shown as display
    white."""
    sky_color: tuple[float, float, float] = (0.74, 0.80, 0.86)
    """Irradiance of a horizontal, unoccluded surface from the sky alone, linear Rec.709."""
    bounce_color: tuple[float, float, float] = (0.36, 0.28, 0.20)
    """Irradiance that the lit floor reflects, linear Rec.709.

    A surface that faces down receives 1.35 times this colour, one that faces up 0.35 times, via the ceiling. Surfaces
    receive less where the sky in front of them is blocked."""
    sky_directions: int = 48
    """Number of shadow maps for the sky."""
    texel: float = 0.012
    """Side of a texel of the shadow maps, scene units: at least half the distance between neighbouring casters."""


def irradiance(
    casters: npt.ArrayLike, receivers: npt.ArrayLike, normals: npt.ArrayLike, light: Daylight
) -> npt.NDArray[np.float32]:
    """Returns the daylight at N surface points, linear Rec.709, compressed to 0..1 by `shoulder`, shape (N, 3).

    Args:
        casters: Points that block light, dense enough to leave no gaps, shape (M, 3).
        receivers: Points to light, shape (N, 3).
        normals: Unit normals of the receivers, shape (N, 3).
        light: The daylight.
    """
    casters, receivers, normals = (np.asarray(a, dtype=np.float32) for a in (casters, receivers, normals))
    sun = np.asarray(light.sun_direction, dtype=np.float32)
    sun /= np.linalg.norm(sun)
    sun_cosine = np.maximum(normals @ sun, 0.0)
    sunlit = _visibility(casters, receivers + 3.0 * light.texel * normals, sun, light.texel, blur=2) * sun_cosine
    open_sky, openness = _sky(casters, receivers, normals, light)
    downwards = 0.5 - 0.5 * normals[:, 1:2]
    total = (
        sunlit[:, None] * np.asarray(light.sun_color, dtype=np.float32)
        + open_sky[:, None] * np.asarray(light.sky_color, dtype=np.float32)
        + (0.35 + downwards) * (0.3 + 0.7 * openness[:, None]) * np.asarray(light.bounce_color, dtype=np.float32)
    )
    return shoulder(total)


def _sky(casters: _Floats, receivers: _Floats, normals: _Floats, light: Daylight) -> tuple[_Floats, _Floats]:
    """Returns the light from the sky at N receivers, and the fraction of the sky that each sees, shape (N,) each.

    Sky light is relative to that of a horizontal, unoccluded surface.
    """
    start = receivers + 2.2 * light.texel * normals
    lit, weight = (np.zeros(receivers.shape[0], dtype=np.float32) for _ in range(2))
    for direction in _hemisphere(light.sky_directions):
        cosine = normals @ direction
        facing = np.flatnonzero(cosine > 0.0)
        if not facing.size:
            continue
        lit[facing] += cosine[facing] * _visibility(casters, start[facing], direction, light.texel, blur=1)
        weight += np.maximum(cosine, 0.0)
    # Surfaces that face down see the floor, but no sky: they count as open.
    return lit * (2.0 / light.sky_directions), (lit + 1.0) / (weight + 1.0)


def _hemisphere(count: int) -> FloatArray:
    """Returns evenly spread directions of the upper hemisphere (Fibonacci lattice), shape (count, 3)."""
    k = np.arange(count) + 0.5
    y = k / count
    around = k * (np.pi * (1.0 + 5.0**0.5))
    ring = np.sqrt(1.0 - y * y)
    return np.stack([ring * np.cos(around), y, ring * np.sin(around)], axis=1).astype(np.float32)


def _visibility(casters: _Floats, receivers: _Floats, direction: _Floats, texel: float, *, blur: int) -> _Floats:
    """Returns the fraction of a directional light that reaches each of N receivers, 0..1, shape (N,).

    Each texel stores the caster nearest to the light, including those in neighbouring texels, so that points form
    closed surfaces. Depths are compared at texels; the results are interpolated bilinearly or, if ``blur`` is 2, by a
    cubic B-spline.
    """
    axes = _basis(direction) / np.float32(texel)
    # Sums of columns: BLAS starts threads for products this thin, and they cost more than they help.
    caster, receiver = ([p[:, 0] * x + p[:, 1] * y + p[:, 2] * z for x, y, z in axes] for p in (casters, receivers))
    low = [np.floor(min(c.min(), r.min())) - 2.0 for c, r in zip(caster[:2], receiver[:2], strict=True)]
    high = [max(c.max(), r.max()) for c, r in zip(caster[:2], receiver[:2], strict=True)]
    width, height = (int(np.ceil(end - start)) + 3 for start, end in zip(low, high, strict=True))
    column, row = ((c - start).astype(np.int32) for c, start in zip(caster[:2], low, strict=True))
    nearest = np.full(width * height, -np.inf, dtype=np.float32)
    np.maximum.at(nearest, row * width + column, caster[2])
    nearest = _dilate(nearest.reshape(height, width)).reshape(-1)

    x, y = (r - (start + 0.5) for r, start in zip(receiver[:2], low, strict=True))
    left, top = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    s, t = x - left, y - top
    if blur > 1:
        taps = [(i, j) for j in range(-1, 3) for i in range(-1, 3)]
        sides = [_spline(s, i) for i in range(-1, 3)], [_spline(t, j) for j in range(-1, 3)]
        shares = [sides[0][i + 1] * sides[1][j + 1] for i, j in taps]
    else:
        taps = [(0, 0), (1, 0), (0, 1), (1, 1)]
        shares = [(1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t]
    total = np.zeros(receivers.shape[0], dtype=np.float32)
    for (i, j), share in zip(taps, shares, strict=True):
        above = nearest[(top + j) * width + left + i] - receiver[2]
        total += share * np.clip(1.5 - above, 0.0, 1.0)
    return total


def _spline(t: _Floats, tap: int) -> _Floats:
    """Returns a cubic B-spline's weight of the texel at -1, 0, 1 or 2, for a position ``t`` between texels 0 and 1."""
    distance = np.abs(t - tap)
    near = (4.0 + distance * distance * (3.0 * distance - 6.0)) / 6.0
    return np.where(distance < 1.0, near, np.maximum(2.0 - distance, 0.0) ** 3 / 6.0)


def _dilate(depth: _Floats) -> _Floats:
    """Returns the depth map with each texel replaced by the maximum over itself and its neighbours."""
    padded = np.pad(depth, 1, constant_values=-np.inf)
    tall = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.maximum(np.maximum(tall[:, :-2], tall[:, 1:-1]), tall[:, 2:])


def _basis(direction: _Floats) -> FloatArray:
    """Returns two unit vectors perpendicular to ``direction``, and ``direction`` itself, as rows."""
    helper = np.eye(3, dtype=np.float32)[np.abs(direction).argmin()]
    across = np.cross(helper, direction)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(direction, across), direction])


def shoulder(light: _Floats) -> _Floats:
    """Compresses light above 0.6 towards 1, so that nothing clips; light below stays linear."""
    knee = np.float32(0.6)
    over = np.maximum(light - knee, 0.0) / (1.0 - knee)
    return np.where(light < knee, light, knee + (1.0 - knee) * over / (1.0 + over)).astype(np.float32)
