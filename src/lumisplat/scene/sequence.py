"""Gaussian frames in files, shown one after the other."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.scene.gaussians import Gaussians


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSequence:
    """Frames of Gaussians at a steady rate, loaded when they are shown; made by `load_sequence`.

    A frame is shown as it is from its time until the next one's. Nothing is interpolated: formats reorder Gaussians,
    and counts may differ from frame to frame, so that no Gaussian is known again in the next frame.
    """

    fps: float
    """Frames a second."""

    @property
    def frame_count(self) -> int:
        """Number of frames."""
        raise NotImplementedError

    @property
    def duration(self) -> float:
        """Until the last frame ends, seconds."""
        raise NotImplementedError

    def at(self, time: float) -> Gaussians:
        """The frame at a time; before the first and after the last one, those.

        Args:
            time: Seconds.

        Raises:
            SceneError: The time is not finite.
            FormatError: The frame cannot be read.
        """
        raise NotImplementedError
