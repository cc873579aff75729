"""Decoded photographs, of which the least recently used make room for others."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock

import numpy as np
import numpy.typing as npt

Plane = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """A photograph in 8 bits, as a pinhole sees it."""

    color: Plane
    """Display-referred sRGB, premultiplied by alpha, shape (H, W, 3)."""
    alpha: Plane | None
    """How much of the pixel shows something, shape (H, W); None: all of it everywhere."""
    mask: Plane | None
    """How much of the pixel counts, shape (H, W); None: all of it everywhere."""

    @property
    def size(self) -> int:
        """Bytes."""
        return sum(plane.nbytes for plane in (self.color, self.alpha, self.mask) if plane is not None)


@dataclass(slots=True, eq=False)
class PixelCache:
    """Keeps what was decoded last, up to a number of bytes. May be used by several threads."""

    limit: int
    """Bytes."""
    held: int = field(default=0, init=False)
    """Bytes that are in use."""
    _entries: OrderedDict[Path, Pixels] = field(default_factory=OrderedDict[Path, Pixels], init=False)
    _lock: Lock = field(default_factory=Lock, init=False)

    def get(self, key: Path, decode: Callable[[], Pixels]) -> Pixels:
        """What is kept under a key, else what ``decode`` returns."""
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key]
        pixels = decode()
        with self._lock:
            if key not in self._entries:
                self._entries[key] = pixels
                self.held += pixels.size
            while self.held > self.limit:
                self.held -= self._entries.popitem(last=False)[1].size
        return pixels
