"""Reads AMASS files: poses of SMPL, SMPL-H or SMPL-X bodies over time (Mahmood et al. 2019).

AMASS has z up. Poses are rotated to the axes of the body models, y up.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.files.arrays import checked_array, read_arrays
from lumisplat.io.files.source import parsing
from lumisplat.io.rigs.body_model import FAMILY, FLAME
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import (
    matrices_from_quaternions,
    multiply_quaternions,
    quaternions_from_rotation_vectors,
)
from lumisplat.scene.animation.rig import Channel, Clip, Interpolation, Skeleton, Track

_log = logging.getLogger("lumisplat")

_RATES = ("mocap_framerate", "mocap_frame_rate")
_KIND = "a file of AMASS poses"
_Y_FROM_Z = np.array([0.5**0.5, -(0.5**0.5), 0.0, 0.0])
"""Rotation that turns z up into y up, wxyz: a quarter turn about x."""
_Y_UP_MIN = 0.8
"""A file counts as y up if the mean of its bodies' up directions has at least this y."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyPoses:
    """Content of an AMASS file: T frames of a body with J joints."""

    path: Path
    name: str
    """Model of the body, a key of `lumisplat.io.rigs.body_model.FAMILY`."""
    rotations: Doubles
    """Rotations of each joint relative to its parent, of the root in the world, y up: unit quaternions, (T, J, 4)."""
    translations: Doubles
    """Translation of the body after its rotation, metres, y up, shape (T, 3)."""
    world_from_body: Doubles
    """Rotation that was applied to all frames, wxyz: z up to y up, or none."""
    fps: float
    betas: Doubles
    """Coefficients of the body's shape; empty if the file has none."""

    def clip(self, skeleton: Skeleton) -> Clip:
        """Returns the motion for the skeleton of a body model, named after the file; logs which joints do not move."""
        nodes = {name: node for node, name in enumerate(skeleton.names)}
        times = np.arange(len(self.rotations)) / self.fps
        tracks = [
            Track(nodes[name], Channel.ROTATION, Interpolation.LINEAR, times, self.rotations[:, joint])
            for joint, name in enumerate(FAMILY[self.name])
            if name in nodes
        ]
        turned = matrices_from_quaternions(self.world_from_body[None])[0] @ skeleton.translations[0]
        roots = turned + self.translations
        tracks.append(Track(0, Channel.TRANSLATION, Interpolation.LINEAR, times, roots))
        still = sorted(set(skeleton.names) - set(FAMILY[self.name]))
        if still:
            listed = ", ".join(still[:3]) + (f" and {len(still) - 3} more" if len(still) > 3 else "")
            _log.warning(
                "%s: has poses of %s, so these joints rest: %s; heights of the pelvis may differ",
                self.path,
                self.name,
                listed,
            )
        return Clip(self.path.stem, tuple(tracks))


def read_body_poses(path: Path) -> BodyPoses:
    """Reads an AMASS file.

    Args:
        path: A ``.npz`` file with ``poses``, rotation vectors in radians, shape (T, 72), (T, 156) or (T, 165), and
            ``mocap_framerate`` or ``mocap_frame_rate``; optional ``trans``, metres, shape (T, 3), and ``betas``.

    Raises:
        FormatError: The file is damaged, or holds no poses.
        MissingFileError: There is no such file.
    """
    with parsing(path, _KIND):
        arrays = read_arrays(path, _KIND, compressed=True, names=("poses", "trans", "betas", *_RATES))
        if "poses" not in arrays:
            raise FormatError(path, f"lacks poses: expected {_KIND}, as .npz")
        rate = next((rate for rate in _RATES if rate in arrays), None)
        if rate is None:
            raise FormatError(path, f"lacks {_RATES[0]}, the frames per second of its poses")
        poses = checked_array(arrays, "poses", (None, None), np.float64)
        frames, width = poses.shape
        name = next((name for name, names in FAMILY.items() if names is not FLAME and 3 * len(names) == width), None)
        if name is None or not frames:
            raise FormatError(path, f"poses has shape {poses.shape}, expected (T, 72), (T, 156) or (T, 165)")
        fps = float(checked_array(arrays, rate, arrays[rate].shape, np.float64).reshape(-1)[0])
        if not fps > 0.0:
            raise FormatError(path, f"{rate} is {fps:g}, expected frames per second, above 0")
        translations = np.zeros((frames, 3))
        if "trans" in arrays:
            translations = checked_array(arrays, "trans", (frames, 3), np.float64)
        betas = checked_array(arrays, "betas", (None,), np.float64) if "betas" in arrays else np.zeros(0)
    rotations = quaternions_from_rotation_vectors(poses.reshape(frames, -1, 3))
    turn = _Y_FROM_Z
    if float(matrices_from_quaternions(rotations[:, 0])[:, 1, 1].mean()) >= _Y_UP_MIN:
        _log.warning("%s: its bodies stand along y, so y is taken as up, not z as in AMASS", path)
        turn = np.array([1.0, 0.0, 0.0, 0.0])
    rotations[:, 0] = multiply_quaternions(turn, rotations[:, 0])
    translations = translations @ matrices_from_quaternions(turn[None])[0].T
    return BodyPoses(path, name, rotations, translations, turn, fps, betas)
