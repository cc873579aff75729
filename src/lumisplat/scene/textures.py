"""Textures of materials: their texels, and what they show beyond their edges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import Enum

import numpy as np
import numpy.typing as npt

from lumisplat.errors import SceneError
from lumisplat.math.arrays import host_array, read_only_array

Texture = npt.NDArray[np.uint8]


class TextureWrap(Enum):
    """What a texture shows beyond its edges."""

    REPEAT = "repeat"
    """The texture again."""
    MIRROR = "mirror"
    """The texture again, every second time mirrored."""
    CLAMP = "clamp"
    """The texels of its edge."""


WrapPair = tuple[TextureWrap, TextureWrap]
"""How a texture wraps along u and along v."""
Wraps = Mapping[str, WrapPair]
"""The same of several textures, by the names of their fields."""
WrapsLike = Mapping[str, TextureWrap | str | Sequence[TextureWrap | str]]
"""What is taken for `Wraps`: also one value for both axes, and values of the enum."""


def to_texture(value: npt.ArrayLike | None, name: str = "texture") -> Texture | None:
    """Converts texels of a material to a read-only array.

    Raises:
        SceneError: They are not (H, W, 3 or 4) uint8.
    """
    if value is None:
        return None
    texture = np.asarray(host_array(value))
    if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] not in (3, 4) or texture.size == 0:
        raise SceneError(f"{name} is {texture.dtype} {texture.shape}, expected uint8 (H, W, 3 or 4)")
    return read_only_array(texture, np.uint8)


def checked_wraps(given: WrapsLike | None, known: Sequence[str]) -> Wraps | None:
    """The wraps of single textures of a material, as pairs.

    Args:
        given: What the material was given.
        known: Names of its textures.

    Raises:
        SceneError: There is no such texture, or no such way to wrap.
    """
    if given is None:
        return None
    wraps: dict[str, WrapPair] = {}
    for name, value in given.items():
        if name not in known:
            raise SceneError(f"texture_wraps names {name!r}, expected one of {', '.join(known)}")
        pair = [value] * 2 if isinstance(value, str | TextureWrap) else value
        try:
            u, v = map(TextureWrap, pair)
        except (TypeError, ValueError):
            ways = ", ".join(repr(way.value) for way in TextureWrap)
            raise SceneError(f"texture_wraps of {name} is {value!r}, expected one of {ways}, or two of them") from None
        wraps[name] = u, v
    return wraps
