"""Gaussian frames in files, shown one after the other."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lumisplat.config.checks import is_number
from lumisplat.constants import SEQUENCE_FRAMES_KEPT, SEQUENCE_TIME_SLACK
from lumisplat.errors import SceneError
from lumisplat.scene.animation.keyframes import check_time
from lumisplat.scene.gaussians import Gaussians


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSequence:
    """Frames of Gaussians at a steady rate, loaded when they are shown; made by `load_sequence`.

    A frame is shown as it is from its time until the next one's. Nothing is interpolated: formats reorder Gaussians,
    and counts may differ from frame to frame, so that no Gaussian is known again in the next frame. The last few
    frames are kept in memory.

    Raises:
        SceneError: There are no frames, or ``fps`` is not a positive number.
    """

    paths: Sequence[Path]
    """Files of the frames, in order."""
    fps: float
    """Frames a second, above 0."""
    load: Callable[[Path], Gaussians]
    """Reads a frame."""
    _kept: OrderedDict[int, Gaussians] = field(default_factory=OrderedDict, init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "paths", tuple(self.paths))
        if not self.paths:
            raise SceneError("a sequence of no frames: there is nothing to show")
        if not is_number(self.fps) or not 0.0 < self.fps < np.inf:
            raise SceneError(f"fps is {self.fps}, expected a positive number")

    def __repr__(self) -> str:
        return f"GaussianSequence(frames={self.frame_count}, fps={self.fps:g}, first={self.paths[0].name!r})"

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        return len(self.paths)

    @property
    def duration(self) -> float:
        """Until the last frame ends, seconds."""
        return self.frame_count / self.fps

    def at(self, time: float) -> Gaussians:
        """The frame at a time; before the first and after the last one, those.

        Args:
            time: Seconds.

        Raises:
            SceneError: The time is not finite.
            FormatError: The frame cannot be read; names its file.
        """
        check_time(time)
        # Times are multiples of 1 / fps that rounding may have put before the frame that begins there.
        index = int(np.clip(np.floor(time * self.fps + SEQUENCE_TIME_SLACK), 0, self.frame_count - 1))
        if index not in self._kept:
            self._kept[index] = self.load(self.paths[index])
            while len(self._kept) > SEQUENCE_FRAMES_KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(index)
        return self._kept[index]
