"""Clips of a rig: keyed values for the translation, rotation and scale of joints, and for morph weights."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import slerp


class Channel(Enum):
    """Property of a node that a track animates."""

    TRANSLATION = "translation"
    """Vector, shape (3,)."""
    ROTATION = "rotation"
    """Unit quaternion wxyz, shape (4,)."""
    SCALE = "scale"
    """Factors along the axes, shape (3,)."""
    WEIGHTS = "weights"
    """Weights of the morph targets of the node's mesh, shape (T,)."""


class Interpolation(Enum):
    """Interpolation of values between keys (glTF 2.0 appendix C)."""

    STEP = "STEP"
    LINEAR = "LINEAR"
    """Linear; slerp for rotations."""
    CUBICSPLINE = "CUBICSPLINE"
    """Cubic Hermite spline."""


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """One channel of one node over time."""

    node: int
    channel: Channel
    interpolation: Interpolation
    times: Doubles
    """Seconds, not falling, shape (K,)."""
    values: Doubles
    """Shape (K, C)."""
    tangents: Doubles | None = None
    """Tangents of a spline, incoming and outgoing at each key, units per second, shape (K, 2, C)."""

    def at(self, time: float) -> Doubles:
        """The value at a time, shape (C,). It is constant before the first key and after the last one."""
        before = int(np.searchsorted(self.times, time, side="right")) - 1
        if before < 0 or before + 1 >= self.times.size or self.interpolation is Interpolation.STEP:
            return self._normalise(self.values[max(before, 0)])
        first, second = self.values[before], self.values[before + 1]
        span = float(self.times[before + 1] - self.times[before])
        share = (time - float(self.times[before])) / span
        if self.tangents is not None:
            square, cube = share * share, share * share * share
            value = (2.0 * cube - 3.0 * square + 1.0) * first + (3.0 * square - 2.0 * cube) * second
            value = value + span * (cube - 2.0 * square + share) * self.tangents[before, 1]
            return self._normalise(value + span * (cube - square) * self.tangents[before + 1, 0])
        if self.channel is Channel.ROTATION:
            return slerp(first, second, share)
        return (1.0 - share) * first + share * second

    def _normalise(self, value: Doubles) -> Doubles:
        """Rotations scaled back to length 1, which splines do not keep; other values as they are."""
        return value / np.linalg.norm(value) if self.channel is Channel.ROTATION else value


@dataclass(frozen=True, slots=True, eq=False)
class Clip:
    """A named animation of a rig."""

    name: str
    tracks: tuple[Track, ...]

    @property
    def duration(self) -> float:
        """Time of the last key, seconds."""
        return max((float(track.times[-1]) for track in self.tracks), default=0.0)
