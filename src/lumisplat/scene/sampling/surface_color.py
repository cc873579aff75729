"""Base colour at points of a mesh, averaged over the area that one sample represents."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.color import decode_srgb
from lumisplat.scene.materials import wraps_of
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.sampling.surface_points import interpolate_vertices
from lumisplat.scene.textures import TextureWrap, WrapPair
from lumisplat.scene.triangles import area_vectors

_Floats = npt.NDArray[np.floating]
_Ints = npt.NDArray[np.integer]


def base_colors(mesh: Mesh, faces: _Ints, weights: _Floats, width: float) -> _Floats:
    """Linear material colour times vertex colour times texture, clamped to 0..1, shape (M, 3).

    Args:
        mesh: The mesh.
        faces: Triangle of each point, shape (M,).
        weights: Barycentric coordinates of each point, shape (M, 3).
        width: Width over which the texture is averaged, scene units.
    """
    corners = mesh.indices[faces]
    colors = np.tile(np.asarray(mesh.material.base_color), (faces.size, 1))
    if mesh.colors is not None:
        colors *= interpolate_vertices(mesh.colors, corners, weights)
    texture = mesh.material.base_color_texture
    if texture is not None and mesh.uvs is not None:
        level = _texture_levels(mesh, mesh.uvs, texture.shape[0] * texture.shape[1], width)[faces]
        wraps = wraps_of(mesh.material, "base_color_texture")
        colors *= _filter_texture(texture, interpolate_vertices(mesh.uvs, corners, weights), level, wraps)
    return np.clip(colors, 0.0, 1.0)


def _texture_levels(mesh: Mesh, uvs: _Floats, texel_count: int, width: float) -> _Floats:
    """For each face, the pyramid level whose texels are ``width`` wide on average over both directions, shape (F,)."""
    area = np.linalg.norm(area_vectors(mesh.positions, mesh.indices), axis=1)
    p, q, r = uvs.astype(np.float64)[mesh.indices].swapaxes(0, 1)
    uv_area = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
    texels2 = width**2 * texel_count * uv_area / np.where(area > 0.0, area, np.inf)
    return 0.5 * np.log2(np.maximum(texels2, 1.0))


def _filter_texture(texture: npt.NDArray[np.uint8], uvs: _Floats, level: _Floats, wraps: WrapPair) -> _Floats:
    """Trilinear lookup of a texture, linear Rec.709, shape (M, 3); ``level`` 0 is the texture itself."""
    image = decode_srgb(np.arange(256) / 255.0).astype(np.float32)[texture[..., :3]]
    colors, step = np.zeros((uvs.shape[0], 3)), 0
    while True:
        last = max(image.shape[:2]) == 1
        share = np.maximum(1.0 - np.abs((np.minimum(level, step) if last else level) - step), 0.0)
        used = np.flatnonzero(share)
        colors[used] += share[used, None] * _bilinear(image, uvs[used], wraps)
        if last or step >= level.max():
            return colors
        image, step = _halve(_halve(image, 0), 1), step + 1


def _bilinear(image: _Floats, uvs: _Floats, wraps: WrapPair) -> _Floats:
    """Bilinear lookup of an image, shape (M, 3)."""
    height, width = image.shape[:2]
    x = wrapped(uvs[:, 0], wraps[0]) * width - 0.5
    y = wrapped(uvs[:, 1], wraps[1]) * height - 0.5
    left, top = np.floor(x), np.floor(y)
    right_share, bottom_share = (x - left)[:, None], (y - top)[:, None]
    columns = [_neighbour(left.astype(np.int64) + k, width, wraps[0]) for k in (0, 1)]
    rows = [_neighbour(top.astype(np.int64) + k, height, wraps[1]) for k in (0, 1)]
    upper, lower = (image[r, columns[0]] * (1.0 - right_share) + image[r, columns[1]] * right_share for r in rows)
    return upper * (1.0 - bottom_share) + lower * bottom_share


def _neighbour(texels: _Ints, size: int, wrap: TextureWrap) -> _Ints:
    """Texels next to an edge: across it in the same texture, or those at the edge."""
    return texels % size if wrap is TextureWrap.REPEAT else np.clip(texels, 0, size - 1)


def wrapped(coordinates: _Floats, wrap: TextureWrap) -> _Floats:
    """Texture coordinates within the texture, 0..1."""
    if wrap is TextureWrap.CLAMP:
        return np.clip(coordinates, 0.0, 1.0)
    if wrap is TextureWrap.MIRROR:
        return 1.0 - np.abs(coordinates % 2.0 - 1.0)
    return coordinates % 1.0


def _halve(image: _Floats, axis: int) -> _Floats:
    """Halves the number of rows or columns, to at least one; each is the mean over its share, also of odd numbers."""
    size = int(image.shape[axis])
    half = max(size // 2, 1)
    image = np.moveaxis(image, axis, 0)
    edges = np.linspace(0.0, size, half + 1)
    before = np.minimum(edges.astype(np.int64), size - 1)
    sums = np.concatenate([np.zeros_like(image[:1], dtype=np.float64), np.cumsum(image, axis=0, dtype=np.float64)])
    at_edges = sums[before] + (edges - before)[:, None, None] * (sums[before + 1] - sums[before])
    means = np.diff(at_edges, axis=0) * (half / size)
    return np.moveaxis(means, 0, axis).astype(np.float32)
