"""Keyframes: position, rotation and uniform scale of an object at given times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lumisplat.config.checks import is_number
from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import Doubles, finite_array
from lumisplat.math.transforms import matrices_from_quaternions, slerp


@dataclass(frozen=True, slots=True, eq=False)
class Keyframes:
    """Poses of an object at K times; between them, positions and scales are linear and rotations slerped.

    Before the first key and after the last one the pose is constant. Rotations take the shorter arc: for a full turn,
    give a key every 120 degrees.

    Raises:
        SceneError: There is no key, shapes do not match, a value is not finite, times do not increase, a scale is not
            positive, or a rotation has zero length.
    """

    times: npt.ArrayLike
    """Times in seconds, strictly increasing, shape (K,)."""
    positions: npt.ArrayLike | None = None
    """Positions of the object's origin, scene units, shape (K, 3); None: the world's origin."""
    rotations_wxyz: npt.ArrayLike | None = None
    """Quaternions of any length above 0, scalar first, shape (K, 4); None: no rotation."""
    scales: npt.ArrayLike | None = None
    """Uniform scale factors, above 0, shape (K,); None: 1."""

    def __post_init__(self) -> None:
        times = checked_times(self.times)
        count = times.size
        rest = {
            "positions": np.zeros((count, 3)),
            "rotations_wxyz": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            "scales": np.ones(count),
        }
        given = {name: getattr(self, name) for name in rest}
        values = {
            name: rest[name] if value is None else finite_array(name, value, np.float64)
            for name, value in given.items()
        }
        check_shapes(
            times=(times, "K"),
            positions=(values["positions"], "K 3"),
            rotations_wxyz=(values["rotations_wxyz"], "K 4"),
            scales=(values["scales"], "K"),
        )
        if not (values["scales"] > 0.0).all():
            raise SceneError(f"scales has {values['scales'].min():g}, expected positive numbers")
        lengths = np.linalg.norm(values["rotations_wxyz"], axis=1, keepdims=True)
        if not (lengths > 0.0).all():
            raise SceneError(f"rotations_wxyz has zero length at keyframe {int(lengths.argmin())}")
        values["rotations_wxyz"] = values["rotations_wxyz"] / lengths
        for name, array in {"times": times, **values}.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @property
    def count(self) -> int:
        """Number of keyframes, K."""
        return np.asarray(self.times).size

    @property
    def duration(self) -> float:
        """Time of the last keyframe, seconds."""
        return float(np.asarray(self.times)[-1])

    def at(self, time: float) -> npt.NDArray[np.float64]:
        """Returns the pose at a time: ``world_from_object``, shape (4, 4).

        Args:
            time: Seconds.

        Raises:
            SceneError: ``time`` is not a finite number.
        """
        times, positions, rotations, scales = map(
            np.asarray, (self.times, self.positions, self.rotations_wxyz, self.scales)
        )
        before, after, share = bracket(times, time)
        quaternion = slerp(rotations[before], rotations[after], share)
        scale = (1.0 - share) * scales[before] + share * scales[after]
        pose = np.eye(4)
        pose[:3, :3] = scale * matrices_from_quaternions(quaternion[None])[0]
        pose[:3, 3] = (1.0 - share) * positions[before] + share * positions[after]
        return pose


def check_time(time: float) -> None:
    """Raises a `SceneError` unless ``time`` is a finite number of seconds."""
    if not is_number(time) or not np.isfinite(time):
        raise SceneError(f"time is {time}, expected seconds, a finite number")


def checked_times(times: npt.ArrayLike, count: int | None = None) -> Doubles:
    """Returns the times of ``count`` keys, shape (count,); of any number if it is None.

    Raises:
        SceneError: There is no key, a time is not finite, their number differs, or they do not increase.
    """
    checked = finite_array("times", times, np.float64)
    if checked.size == 0 or count == 0:
        raise SceneError("times is empty: expected at least one key")
    if checked.ndim != 1 or checked.size != (checked.size if count is None else count):
        wanted = "one time for each key" if count is None else f"one time for each of {count} keys"
        raise SceneError(f"times has shape {checked.shape}, expected {wanted}")
    falls = np.flatnonzero(np.diff(checked) <= 0.0)
    if falls.size:
        k = int(falls[0])
        raise SceneError(f"times must increase, but {checked[k + 1]:g} follows {checked[k]:g} (key {k + 1})")
    return checked


def bracket(times: npt.NDArray[np.float64], time: float) -> tuple[int, int, float]:
    """Returns the indices of the keys before and after a time, and the time's place between them, 0 to below 1.

    Before the first and after the last key, both indices are that key.

    Raises:
        SceneError: ``time`` is not a finite number.
    """
    check_time(time)
    before = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, times.size - 1))
    after = min(before + 1, times.size - 1)
    if time <= times[before] or after == before:
        return before, before, 0.0
    return before, after, float((time - times[before]) / (times[after] - times[before]))
