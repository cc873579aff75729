"""What deforms in a file that has its shape at any time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from lumisplat.scene.animation.keyframes import check_time
from lumisplat.scene.scene import MeshInstance, SplatInstance

Instances = tuple[SplatInstance | MeshInstance, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Deforming:
    """A mesh or capture whose shape is read from its file for each time that is shown; made by `load_animation`."""

    read: Callable[[float], Instances]
    """What there is at a time, seconds, where it stands."""
    _shown: dict[float, Instances] = field(default_factory=dict[float, Instances], init=False)
    """That of the last time."""

    def at(self, time: float) -> Instances:
        """What there is at a time, seconds; the same objects as long as that is asked for.

        Raises:
            SceneError: The time is not finite.
            FormatError: It cannot be read.
        """
        check_time(time)
        shown = self._shown.get(time)
        if shown is None:
            shown = self.read(time)
            self._shown.clear()
            self._shown[time] = shown
        return shown
