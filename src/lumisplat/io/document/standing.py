"""Entries of a scene that gets another up: what stood upright in it stands upright again."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumisplat.io.document.entries import EntryReader, SceneEntry
from lumisplat.io.document.opening import read_entry
from lumisplat.io.document.written import PLACED_IN_WORDS, placement_table
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import quaternions_from_matrices, rotation_between, rotation_matrix
from lumisplat.scene.ops.ground import lowest
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance
from lumisplat.scene.up import Vector

_OF_UP = ("look_at", "upright", "ground")
"""Keys whose meaning depends on up."""
_UPRIGHT = 1e-4
"""Largest distance of the y axis of what stands upright from up, both of length 1."""


def turned_with_up(reader: EntryReader, entry: SceneEntry, before: Vector, *, is_among_captures: bool) -> SceneEntry:
    """Returns an entry as it stands in a scene with another up.

    A mesh or an actor among captures whose y axis was up is turned about its foot, by the smallest rotation between
    both ups: it stays on its ground, and its front stays in front. Captures stay, as up is measured by their ground,
    and so do meshes without captures. Tables then say places in numbers, as ``upright`` and its like would mean others.

    Args:
        reader: Has the new up.
        entry: The entry.
        before: The old up, a unit vector.
        is_among_captures: Whether the scene has a capture.
    """
    turn = rotation_between(np.array(before), np.array(reader.up))
    if entry.kind == "environment" and "path" in entry.table:
        light: Any = entry.lights[0]
        return _turned_image(reader, entry, rotation_matrix(light.rotation_wxyz), turn, before)
    matrix = entry.world_from_file
    if matrix is None or (entry.actor is not None and "path" not in entry.table):
        return entry
    start = np.eye(4) if entry.actor is None or entry.actor.motion is None else entry.actor.motion.at(0.0)
    stands = is_among_captures and entry.kind != "splats" and _is_upright((start @ matrix)[:3, :3], before)
    if stands:
        about_foot, foot = np.eye(4), _foot(entry, before)
        about_foot[:3, :3], about_foot[:3, 3] = turn, foot - turn @ foot
        matrix = np.linalg.inv(start) @ about_foot @ start @ matrix
    elif not any(key in entry.table for key in _OF_UP):
        return entry
    rest = {key: value for key, value in entry.table.items() if key not in PLACED_IN_WORDS}
    return read_entry(reader, entry.id, entry.kind, rest | placement_table(matrix))


def _turned_image(
    reader: EntryReader, entry: SceneEntry, rotation: Doubles, turn: Doubles, before: Vector
) -> SceneEntry:
    """Returns an environment turned with up, if the upper edge of its image was up."""
    if not _is_upright(rotation, before):
        return entry
    wxyz = quaternions_from_matrices((turn @ rotation)[None])[0]
    turned = {"rotation_wxyz": [float(f"{x:.12g}") for x in wxyz]}
    return read_entry(reader, entry.id, entry.kind, dict(entry.table) | turned)


def _is_upright(linear: Doubles, up: Vector) -> bool:
    """Returns whether a rotation with a scale turns y to up."""
    y = linear[:, 1] / np.linalg.norm(linear[:, 1])
    return bool(np.linalg.norm(y - np.array(up)) < _UPRIGHT)


def _foot(entry: SceneEntry, up: Vector) -> Doubles:
    """Returns the point of the ground below the middle of what an entry shows, world space, shape (3,)."""
    instances = entry.at(0.0)
    splats = [instance for instance in instances if isinstance(instance, SplatInstance)]
    meshes = [instance for instance in instances if isinstance(instance, MeshInstance)]
    low, high = Scene(splats, meshes).bulk_bounds()
    middle, upward = 0.5 * (low + high), np.array(up)
    return middle + (min(lowest(instance, up) for instance in instances) - middle @ upward) * upward
