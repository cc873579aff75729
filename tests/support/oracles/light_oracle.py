"""Evaluates lights from their geometry in float64: points, spheres, cones, polygons and environment maps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


# --- Points and extents ---


def window(distance: npt.ArrayLike, reach: float) -> Array:
    """Returns the fade-out of KHR_lights_punctual towards the end of a light's range."""
    return np.clip(1.0 - (np.asarray(distance) / reach) ** 4, 0.0, 1.0)


def cone(angle: npt.ArrayLike, inner: float, outer: float) -> Array:
    """Returns the attenuation of a spot light by the angle from its axis in radians: glTF's factor, squared."""
    share = (np.cos(angle) - np.cos(outer)) / (np.cos(inner) - np.cos(outer))
    return np.clip(share, 0.0, 1.0) ** 2


def cap(half_angle: npt.ArrayLike) -> Array:
    """Returns the solid angle of a cone."""
    return 4.0 * np.pi * np.sin(0.5 * np.asarray(half_angle)) ** 2


def first_hit(origin: Array, direction: Array, center: Array, radius: float) -> Array:
    """Returns distances along rays, shape (N, 3), to a sphere; NaN where they miss."""
    to_center = center - origin
    along = direction @ to_center
    across2 = np.sum((to_center - along[:, None] * direction) ** 2, axis=1)
    with np.errstate(invalid="ignore"):
        return along - np.sqrt(radius**2 - across2)


def polygon_irradiance(corners: Array, point: Array, normal: Array) -> float:
    """Returns irradiance over radiance for a uniform polygon above the receiver's horizon (Lambert 1760).

    The result is half the sum over edges of the angle each subtends, times the cosine between the receiver's normal and
    the normal of the plane through the edge and the point.
    """
    total = 0.0
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        u, v = a - point, b - point
        across = np.cross(u, v)
        angle = np.arctan2(np.linalg.norm(across), u @ v)
        total += angle * float(normal @ across) / float(np.linalg.norm(across))
    return 0.5 * total


# --- Environments ---


def quaternion_rotated(wxyz: npt.ArrayLike, vectors: Array) -> Array:
    """Rotates vectors, shape (N, 3), by a unit quaternion with Hamilton's product q v q*."""
    w, *axis = np.asarray(wxyz, dtype=np.float64)
    q = np.array(axis)

    def product(a: Array, u: Array, b: Array, v: Array) -> tuple[Array, Array]:
        return a * b - np.sum(u * v, axis=1), a[:, None] * v + b[:, None] * u + np.cross(u, v)

    count = len(vectors)
    ws, qs = np.full(count, w), np.broadcast_to(q, (count, 3))
    scalar, vector = product(ws, qs, np.zeros(count), vectors)
    return product(scalar, vector, ws, -qs)[1]


def image_coordinates(wxyz: npt.ArrayLike, directions: Array) -> tuple[Array, Array]:
    """Returns the image coordinates u and v, 0..1, of world directions; ``wxyz`` is world_from_environment."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64)
    local = quaternion_rotated((w, -x, -y, -z), directions)
    u = 0.5 + np.arctan2(local[:, 0], -local[:, 2]) / (2.0 * np.pi)
    return u, np.arccos(np.clip(local[:, 1], -1.0, 1.0)) / np.pi


def direction_at(wxyz: npt.ArrayLike, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
    """Returns the world directions of image coordinates (u, v)."""
    turn, theta = 2.0 * np.pi * (np.asarray(u) - 0.5), np.pi * np.asarray(v)
    local = np.stack([np.sin(theta) * np.sin(turn), np.cos(theta), -np.sin(theta) * np.cos(turn)], axis=-1)
    return quaternion_rotated(wxyz, local.reshape(-1, 3)).reshape(local.shape)


def lookup(image: npt.NDArray[np.floating], u: Array, v: Array) -> Array:
    """Interpolates an image bilinearly; u wraps around, and the top and bottom rows are repeated beyond the poles."""
    height, width = image.shape[:2]
    around = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1).astype(np.float64)
    around = np.concatenate([around[:1], around, around[-1:]], axis=0)
    x, y = u * width + 0.5, v * height + 0.5
    j, i = np.minimum(x.astype(int), width), np.minimum(y.astype(int), height)
    fx, fy = (x - j)[:, None], (y - i)[:, None]
    above = (1.0 - fx) * around[i, j] + fx * around[i, j + 1]
    below = (1.0 - fx) * around[i + 1, j] + fx * around[i + 1, j + 1]
    return (1.0 - fy) * above + fy * below


def cell_pdf(image: npt.NDArray[np.floating], fine: int = 64) -> Array:
    """Returns the pdf of directions per steradian, shape (H, W), from the mean luminance of each texel's cell.

    The means are evaluated by brute force, over the image and not over the sphere; each row is weighted by its solid
    angle.
    """
    height, width = image.shape[:2]
    u, v = (np.arange(width * fine) + 0.5) / (width * fine), (np.arange(height * fine) + 0.5) / (height * fine)
    grid_u, grid_v = np.meshgrid(u, v)
    luminance = (lookup(image, grid_u.ravel(), grid_v.ravel()) @ LUMINANCE).reshape(height, fine, width, fine)
    mean = luminance.mean(axis=(1, 3))
    size = cell_sizes(height, width)
    return mean / np.sum(mean * size)


def cell_sizes(height: int, width: int) -> Array:
    """Returns the solid angles of the texels' cells, shape (H, W)."""
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return np.broadcast_to(((edges[:-1] - edges[1:]) * 2.0 * np.pi / width)[:, None], (height, width))
