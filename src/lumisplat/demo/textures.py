"""Base-colour textures computed from formulas: sRGB-encoded uint8, shape (H, W, 3), seamless unless noted."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.math.color import encode_srgb

Rgb = tuple[float, float, float]
"""Red, green and blue, linear Rec.709, 0..1."""
Texture = npt.NDArray[np.uint8]

_Floats = npt.NDArray[np.floating]


def fractal_noise(
    height: int, width: int, cells: tuple[int, int], rng: np.random.Generator, *, octaves: int = 5
) -> _Floats:
    """Returns periodic value noise of about -1..1, shape (H, W).

    Octaves are summed, each twice as fine and half as strong as the one before.

    Args:
        height: Rows.
        width: Columns.
        cells: Lattice cells of the first octave, down and across.
        rng: Generator of the lattice values.
        octaves: Number of octaves.
    """
    total = np.zeros((height, width))
    for octave in range(octaves):
        rows, columns = cells[0] << octave, cells[1] << octave
        lattice = rng.uniform(-1.0, 1.0, (rows, columns))
        total += 0.5**octave * (_interpolation(height, rows) @ lattice @ _interpolation(width, columns).T)
    return total


def _interpolation(samples: int, cells: int) -> _Floats:
    """Returns smoothstep weights of the cells of a periodic lattice at evenly spaced samples, (samples, cells)."""
    position = (np.arange(samples) + 0.5) / samples * cells
    cell = np.floor(position).astype(np.int64)
    t = position - cell
    t = t * t * (3.0 - 2.0 * t)
    weights = np.zeros((samples, cells))
    rows = np.arange(samples)
    weights[rows, cell % cells] += 1.0 - t
    weights[rows, (cell + 1) % cells] += t
    return weights


def blend(a: Rgb | _Floats, b: Rgb | _Floats, share: _Floats) -> _Floats:
    """Mixes two linear colours: ``(1 - share) a + share b``, shape (H, W, 3)."""
    share = np.clip(share, 0.0, 1.0)[..., None]
    return np.asarray(a) * (1.0 - share) + np.asarray(b) * share


def texels(linear: _Floats) -> Texture:
    """Converts linear colours to an sRGB-encoded texture."""
    return np.round(255.0 * encode_srgb(np.clip(linear, 0.0, 1.0))).astype(np.uint8)


def plaster(color: Rgb, rng: np.random.Generator, *, size: int = 384, contrast: float = 0.14) -> Texture:
    """Returns hand-made lime wash: broad clouds and fine trowel marks of one colour."""
    clouds = fractal_noise(size, size, (3, 3), rng, octaves=4)
    marks = fractal_noise(size, size, (10, 36), rng, octaves=3)
    return texels(np.asarray(color) * (1.0 + contrast * (0.8 * clouds + 0.25 * marks))[..., None])


def marble(ground: Rgb, vein: Rgb, rng: np.random.Generator, *, size: int = 384, cells: int = 3) -> Texture:
    """Returns stone with thin veins where warped noise is 0, and faint clouds between them."""
    warp = fractal_noise(size, size, (cells, cells), rng, octaves=4)
    veins = np.abs(fractal_noise(size, size, (cells, cells), rng) + 0.35 * warp)
    hairs = np.abs(fractal_noise(size, size, (2 * cells, 2 * cells), rng) - 0.2 * warp)
    share = 0.85 * np.exp(-veins / 0.045) + 0.35 * np.exp(-hairs / 0.03) + 0.12 * (0.5 + 0.5 * warp)
    return texels(blend(ground, vein, share))


def travertine(light: Rgb, dark: Rgb, rng: np.random.Generator, *, size: int = 384) -> Texture:
    """Returns limestone in uneven horizontal layers, with small elongated pits."""
    layers = fractal_noise(size, size, (14, 2), rng, octaves=4)
    pits = fractal_noise(size, size, (48, 10), rng, octaves=2)
    share = 0.45 + 0.45 * layers
    return texels(blend(blend(light, dark, share), 0.55 * np.asarray(dark), 2.5 * (pits - 0.75)))


def herringbone(
    shape: tuple[int, int], plank_px: float, light: Rgb, dark: Rgb, rng: np.random.Generator, *, aspect: int = 5
) -> Texture:
    """Returns oak planks laid in herringbone at 45 degrees; not seamless.

    Args:
        shape: Rows and columns.
        plank_px: Width of a plank, texels.
        light: Colour of the palest wood.
        dark: Colour of the darkest wood.
        rng: Generator of tones and grain.
        aspect: Length of a plank over its width.
    """
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]] / (plank_px * 2.0**0.5)
    x: _Floats = column + row + 1000.0
    y: _Floats = column - row + 1000.0
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    # To the right, `aspect` cells belong to one horizontal plank, the next `aspect` each to a vertical plank.
    phase = (i - j) % (2 * aspect)
    level = phase < aspect
    along = np.where(level, x - (i - phase), y - (j - (2 * aspect - 1 - phase)))
    across = np.where(level, y - j, x - i)
    plank = np.where(level, (i - phase) * 7919 + j * 104729, i * 15485863 + (j - (2 * aspect - 1 - phase)) * 32452843)
    tone = rng.random(4096)[plank % 4096]
    grain = fractal_noise(512, 256, (48, 3), rng, octaves=4)
    streak = grain[
        ((across + 5.3 * tone) * 96).astype(np.int64) % 512, (along * 20 + 256 * tone).astype(np.int64) % 256
    ]
    linear = blend(light, dark, 0.12 + 0.6 * tone + 0.28 * streak)
    gap = np.minimum(np.minimum(across, 1.0 - across), np.minimum(along, aspect - along)) * plank_px * 2.0**0.5
    return texels(linear * (0.45 + 0.55 * np.clip(gap / 1.8, 0.0, 1.0))[..., None])


def painted_vase(ground: Rgb, paint: Rgb, rng: np.random.Generator, *, height: int = 768, width: int = 768) -> Texture:
    """Returns the paint of a vase, u around and v down: rings, a frieze of scales, a wave and a row of leaves."""
    v, u = (np.mgrid[0:height, 0:width] + 0.5) / np.array([[[height]], [[width]]])
    wobble = 0.004 * fractal_noise(height, width, (6, 12), rng, octaves=3)
    w = v + wobble
    ink = np.zeros((height, width))
    for centre, half in ((0.1, 0.006), (0.135, 0.012), (0.30, 0.006), (0.325, 0.006), (0.585, 0.006), (0.61, 0.012)):
        ink = np.maximum(ink, _edge(half - np.abs(w - centre), 0.003))
    ink = np.maximum(ink, _edge(0.006 - np.abs(w - 0.925), 0.003) + _edge(w - 0.955, 0.003))
    ink = np.maximum(ink, _scales(u, w) * _edge(0.075 - np.abs(w - 0.215), 0.003))
    angle = 2.0 * np.pi * 9.0 * u
    steepness = np.hypot(1.0, 1.4 * np.cos(angle))
    ink = np.maximum(ink, _edge(0.013 - np.abs(w - 0.455 - 0.055 * np.sin(angle)) / steepness, 0.004))
    for phase, level in ((0.25, 0.43), (0.75, 0.48)):
        across = (np.mod(9.0 * u - phase + 0.5, 1.0) - 0.5) / 9.0
        ink = np.maximum(ink, _edge(0.017 - np.hypot(2.0 * across, w - level), 0.004))
    leaf_u = np.abs(np.mod(18.0 * u, 1.0) - 0.5) * 2.0
    leaf = 0.9 * np.sqrt(np.clip(1.0 - ((w - 0.77) / 0.13) ** 2, 0.0, 1.0)) * (1.15 - (w - 0.64) / 0.26)
    ink = np.maximum(ink, _edge(leaf - leaf_u, 0.06) * _edge(0.13 - np.abs(w - 0.77), 0.003) * (leaf_u > 0.09))
    pooled = 1.0 + 0.18 * fractal_noise(height, width, (9, 14), rng, octaves=3)
    glaze = 1.0 + 0.04 * fractal_noise(height, width, (5, 5), rng, octaves=3)
    return texels(blend(np.asarray(ground) * glaze[..., None], np.asarray(paint) * pooled[..., None], 0.96 * ink))


def _edge(distance: _Floats, softness: float) -> _Floats:
    """Maps a distance from an edge to 0 on the negative side and 1 on the positive, with a smooth transition."""
    return np.clip(0.5 + 0.5 * distance / softness, 0.0, 1.0)


def _scales(u: _Floats, v: _Floats) -> _Floats:
    """Returns overlapping arcs like the scales of a fish: 1 on their outlines."""
    rows = v / 0.075
    row = np.floor(rows)
    x = np.mod(16.0 * u + 0.5 * np.mod(row, 2.0), 1.0) - 0.5
    y = rows - row
    radius = np.hypot(1.7 * x, y)
    return np.maximum(_edge(0.14 - np.abs(radius - 0.84), 0.05), _edge(0.3 - radius, 0.05))


def stripes(colors: tuple[Rgb, ...], repeats: int, rng: np.random.Generator, *, size: int = 512) -> Texture:
    """Returns the texture of a glass marble: stripes of colour along u that twist with v."""
    v, u = (np.mgrid[0:size, 0:size] + 0.5) / size
    swirl = 0.5 * fractal_noise(size, size, (3, 3), rng, octaves=3)
    phase = np.mod(repeats * u + 1.6 * v + 0.35 * swirl, 1.0) * len(colors)
    palette = np.asarray(colors)
    index = np.floor(phase).astype(np.int64) % len(colors)
    share = np.clip((phase - np.floor(phase) - 0.88) / 0.12, 0.0, 1.0)[..., None]
    return texels(palette[index] * (1.0 - share) + palette[(index + 1) % len(colors)] * share)
