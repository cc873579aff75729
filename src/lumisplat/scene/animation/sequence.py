"""Sequences of Gaussian frames that are stored in files."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np

from lumisplat.config.checks import Range
from lumisplat.errors import SceneError
from lumisplat.scene.animation.keyframes import check_time
from lumisplat.scene.checks import take_scene_fields
from lumisplat.scene.gaussians import Gaussians

SEQUENCE_TIME_SLACK = 1e-6
"""Frames by which a time may precede the frame that it denotes: k / fps * fps is below k for some k."""

SEQUENCE_FRAMES_KEPT = 2
"""Frames that a sequence keeps in memory: the one shown, and the one before it. A frame may have a gigabyte."""


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSequence:
    """Frames of Gaussians at a constant rate, loaded when they are shown; made by `load_sequence`.

    A frame is shown unchanged from its time until that of the next one. Frames are not interpolated: formats reorder
    Gaussians and counts may differ, so that a Gaussian cannot be found again in the next frame. The last few frames
    stay in memory.

    Raises:
        SceneError: There are no frames, or ``fps`` is not a positive number.
    """

    paths: Sequence[Path]
    """Files of the frames, in order of time."""
    fps: Annotated[float, Range(0.0, above=True)]
    """Frames per second."""
    load: Callable[[Path], Gaussians]
    """Reads the file of a frame."""
    _cache: OrderedDict[int, Gaussians] = field(default_factory=OrderedDict[int, Gaussians], init=False)
    """The most recently shown frames by index, the latest last."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "paths", tuple(self.paths))
        if not self.paths:
            raise SceneError("a sequence of no frames: there is nothing to show")
        take_scene_fields(self)

    def __repr__(self) -> str:
        return f"GaussianSequence(frames={self.frame_count}, fps={self.fps:g}, first={self.paths[0].name!r})"

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.paths)

    @property
    def duration(self) -> float:
        """Time at which the last frame ends, seconds."""
        return self.frame_count / self.fps

    def at(self, time: float) -> Gaussians:
        """The frame at a time. Earlier times give the first frame, later ones the last.

        Args:
            time: Seconds.

        Raises:
            SceneError: The time is not finite.
            FormatError: The frame cannot be read; names its file.
        """
        check_time(time)
        # Rounding may have put a multiple of 1 / fps just before the frame that begins there.
        index = int(np.clip(np.floor(time * self.fps + SEQUENCE_TIME_SLACK), 0, self.frame_count - 1))
        if index not in self._cache:
            self._cache[index] = self.load(self.paths[index])
            while len(self._cache) > SEQUENCE_FRAMES_KEPT:
                self._cache.popitem(last=False)
        self._cache.move_to_end(index)
        return self._cache[index]
