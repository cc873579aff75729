"""Draws the Gaussians on a ray as a plot: transmittance over distance, the alpha of each, and the surface."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lumisplat.errors import ConfigError

_SCALE = 2
"""Factor of the size at which the plot is drawn, before it is reduced: this antialiases lines and text."""
_MARGIN = (44, 12, 12, 28)
"""Space left, above, right and below the axes, pixels."""
_SIZE_MIN, _SIZE_MAX = 160, 8192
_SPACE, _AXES, _TEXT = (18, 18, 22), (88, 88, 98), (200, 200, 208)
_ALPHA, _TRANSMITTANCE, _SURFACE = (232, 150, 60), (90, 180, 250), (120, 220, 120)
_PAD = 0.05
"""Space beside the first and behind the last Gaussian, as a fraction of the distance between them."""


def profile_plot(
    t: npt.NDArray[np.floating],
    alpha: npt.NDArray[np.floating],
    transmittance: npt.NDArray[np.floating],
    surface: float,
    size: tuple[int, int],
) -> npt.NDArray[np.uint8]:
    """Returns a plot of the Gaussians on one ray, sRGB, shape (height, width, 3).

    The blue line is the transmittance, orange stems are the alpha of each Gaussian, the green line is the surface.

    Args:
        t: Distance of each of N Gaussians, ascending, shape (N,).
        alpha: Alpha of each, 0..1, shape (N,).
        transmittance: Transmittance behind each, 0..1, shape (N,).
        surface: Distance of the surface; inf: none.
        size: Width and height in pixels.

    Raises:
        ConfigError: The size is out of range.
    """
    from PIL import Image, ImageDraw, ImageFont

    if not all(_SIZE_MIN <= side <= _SIZE_MAX for side in size):
        raise ConfigError(f"the plot has size {size[0]} x {size[1]}, expected {_SIZE_MIN} to {_SIZE_MAX} pixels a side")
    width, height = (_SCALE * side for side in size)
    left, above, right, below = (_SCALE * space for space in _MARGIN)
    low, high = (float(t[0]), float(t[-1])) if len(t) else (0.0, 1.0)
    pad = _PAD * (high - low) or 0.5 * max(abs(high), 1.0) * _PAD
    low, high = low - pad, high + pad
    image = Image.new("RGB", (width, height), _SPACE)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(10 * _SCALE)

    def at(distance: float, value: float) -> tuple[float, float]:
        across = left + (distance - low) / (high - low) * (width - left - right)
        return across, height - below - value * (height - above - below)

    for value in (0.0, 0.5, 1.0):
        draw.line([at(low, value), at(high, value)], fill=_AXES)
        draw.text((left - 6 * _SCALE, at(low, value)[1]), f"{value:g}", _TEXT, font, anchor="rm")
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        distance = low + share * (high - low)
        x, y = at(distance, 0.0)
        draw.text((x, y + 6 * _SCALE), f"{distance:.4g}", _TEXT, font, anchor=("la", "ma", "ra")[round(2 * share)])
    for distance, value in zip(t.tolist(), alpha.tolist(), strict=True):
        draw.line([at(distance, 0.0), at(distance, value)], fill=_ALPHA, width=_SCALE)
    steps, before = [at(low, 1.0)], 1.0
    for distance, value in zip(t.tolist(), transmittance.tolist(), strict=True):
        steps += [at(distance, before), at(distance, value)]
        before = value
    draw.line([*steps, at(high, before)], fill=_TRANSMITTANCE, width=2 * _SCALE)
    texts = [("transmittance", _TRANSMITTANCE), ("alpha", _ALPHA)]
    if low <= surface <= high:
        draw.line([at(surface, 0.0), at(surface, 1.0)], fill=_SURFACE, width=_SCALE)
        texts.append((f"surface at {surface:.4g}", _SURFACE))
    x = width - right - 4 * _SCALE
    for number, (text, color) in enumerate(texts):
        draw.text((x, above + (4 + 13 * number) * _SCALE), text, color, font, anchor="ra")
    return np.asarray(image.resize(size, Image.Resampling.BOX))
