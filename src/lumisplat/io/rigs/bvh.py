"""Reads BVH files (Biovision hierarchy): a skeleton and one motion of it."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.source import parsing, read_text
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import matrices_from_quaternions, quaternions_from_matrices
from lumisplat.scene.animation.rig import Channel, Clip, Interpolation, Skeleton, Track

_log = logging.getLogger("lumisplat")

_KIND = "a BVH file"
_AXES = "XYZ"


class _Joint(NamedTuple):
    """A joint of the hierarchy; its ``channels`` are words such as ``Zrotation``."""

    name: str
    parent: int | None
    offset: list[float]
    channels: list[str]


def read_bvh(path: Path) -> tuple[Skeleton, Clip]:
    """Reads a BVH file: the skeleton in its rest pose, in which no joint is rotated, and its motion, named as the file.

    Rotations multiply in the order of their channels. Positions replace the offset of the joint. Units are those of the
    file, often centimetres or inches.

    Raises:
        FormatError: The file cannot be read, or is malformed; the message names the line.
        MissingFileError: There is no such file.
    """
    with parsing(path, _KIND):
        text = read_text(path, errors="replace")
        lines = text.splitlines()
        joints, begin = _read_hierarchy(path, lines)
        frames, seconds, begin = _read_timing(path, lines, begin)
        width = sum(len(joint.channels) for joint in joints)
        rows = [line for line in lines[begin:] if line.strip()]
        values = np.loadtxt(rows, np.float64, comments=None, ndmin=2) if rows else np.zeros((0, 0))
        if len(values) == frames + 1:
            _log.warning("%s: has %d frames, but states %d: the last one is left out", path, frames + 1, frames)
            values = values[:frames]
        if width == 0 or values.shape != (frames, width):
            found = f"{len(values):,} frames of {values.shape[1]} numbers"
            raise FormatError(path, f"has {found}, expected {frames:,} of {width}, as it states")
        if not np.isfinite(values).all():
            raise FormatError(path, "has numbers that are not finite")
        return _assembled(path, joints, values, seconds)


def _read_hierarchy(path: Path, lines: list[str]) -> tuple[list[_Joint], int]:
    """Reads the joints up to the line ``MOTION``; returns them and the number of lines read."""
    joints: list[_Joint] = []
    open_joints: list[int | None] = []  # None for an end site
    upcoming: str | None = None  # name of the joint whose bracket is expected; "" for an end site
    for number, line in enumerate(lines, 1):
        words = line.split()
        match [word.upper() for word in words[:1]]:
            case [] | ["HIERARCHY"]:
                pass
            case ["ROOT" | "JOINT"] if len(words) > 1:
                upcoming = " ".join(words[1:])
            case ["END"]:
                upcoming = ""
            case ["{"] if upcoming is not None:
                if upcoming:
                    joints.append(_Joint(upcoming, _innermost(open_joints), [0.0, 0.0, 0.0], []))
                open_joints.append(len(joints) - 1 if upcoming else None)
                upcoming = None
            case ["}"] if open_joints:
                open_joints.pop()
            case ["OFFSET"] if open_joints and len(words) == 4:
                if open_joints[-1] is not None:
                    joints[open_joints[-1]].offset[:] = [float(word) for word in words[1:]]
            case ["CHANNELS"] if open_joints and open_joints[-1] is not None:
                joints[open_joints[-1]].channels[:] = _channels(path, words, number)
            case ["MOTION"] if joints and not open_joints:
                return joints, number
            case _:
                raise FormatError(path, f"line {number}: {line.strip()[:60]!r} is not expected here in {_KIND}")
    raise FormatError(path, f"ends before its MOTION: expected {_KIND}")


def _innermost(open_joints: list[int | None]) -> int | None:
    return open_joints[-1] if open_joints else None


def _channels(path: Path, words: list[str], number: int) -> list[str]:
    """Returns the words of a ``CHANNELS`` line, such as ``Zrotation``, after checking them."""
    channels = words[2:]
    known = {f"{axis}{kind}".lower() for axis in _AXES for kind in ("position", "rotation")}
    if len(words) < 2 or words[1] != str(len(channels)) or any(word.lower() not in known for word in channels):
        raise FormatError(path, f"line {number}: expected CHANNELS, their number and names such as Zrotation")
    return channels


def _read_timing(path: Path, lines: list[str], begin: int) -> tuple[int, float, int]:
    """Reads ``Frames`` and ``Frame Time``; returns both, and the number of lines read."""
    found: dict[str, float] = {}
    for number, line in enumerate(lines[begin:], begin + 1):
        key, colon, value = line.partition(":")
        if not line.strip():
            continue
        if not colon or key.strip().lower() not in ("frames", "frame time"):
            raise FormatError(path, f"line {number}: expected 'Frames: N' and 'Frame Time: SECONDS'")
        found[key.strip().lower()] = float(value)
        if len(found) == 2:
            frames, seconds = found["frames"], found["frame time"]
            if not (frames >= 1.0 and frames == int(frames) and 0.0 < seconds < np.inf):
                raise FormatError(path, f"has {frames:g} frames of {seconds:g} s, expected at least one above 0 s")
            return int(frames), seconds, number
    raise FormatError(path, f"ends before its frames: expected {_KIND}")


def _assembled(path: Path, joints: list[_Joint], values: Doubles, seconds: float) -> tuple[Skeleton, Clip]:
    """Returns the skeleton, and a clip from T frames of all channels, shape (T, C)."""
    count, frames = len(joints), len(values)
    times = np.arange(frames, dtype=np.float64) * seconds
    tracks: list[Track] = []
    column = 0
    for node, joint in enumerate(joints):
        rotations = np.tile(np.eye(3), (frames, 1, 1))
        positions = np.tile(joint.offset, (frames, 1))
        kinds: set[str] = set()
        for channel in joint.channels:
            axis, kind = _AXES.index(channel[0].upper()), channel[1:].lower()
            if kind == "rotation":
                half = np.radians(values[:, column]) / 2.0
                quaternions = np.zeros((frames, 4))
                quaternions[:, 0], quaternions[:, 1 + axis] = np.cos(half), np.sin(half)
                rotations = rotations @ matrices_from_quaternions(quaternions)
            else:
                positions[:, axis] = values[:, column]
            kinds.add(kind)
            column += 1
        if "rotation" in kinds:
            keys = np.asarray(quaternions_from_matrices(rotations), np.float64)
            tracks.append(Track(node, Channel.ROTATION, Interpolation.LINEAR, times, keys))
        if "position" in kinds:
            tracks.append(Track(node, Channel.TRANSLATION, Interpolation.LINEAR, times, positions))
    skeleton = Skeleton(
        tuple(joint.parent for joint in joints),
        tuple(range(count)),
        np.array([joint.offset for joint in joints]),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.ones((count, 3)),
        {},
        tuple(joint.name for joint in joints),
    )
    return skeleton, Clip(path.stem, tuple(tracks))
