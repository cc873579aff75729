"""Animations of glTF files: keys of the translation, rotation and scale of nodes, and of morph weights."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from lumisplat.errors import FormatError
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.nodes import Matrix, node_label
from lumisplat.scene.animation.clips import Channel, Clip, Interpolation, Track

if TYPE_CHECKING:
    import pygltflib

_log = logging.getLogger("lumisplat")

_KINDS = {Channel.TRANSLATION: "VEC3", Channel.ROTATION: "VEC4", Channel.SCALE: "VEC3", Channel.WEIGHTS: "SCALAR"}


def read_clips(file: GltfFile) -> tuple[Clip, ...]:
    """All animations of a file, with distinct names; an animation without a name has its number instead.

    Channels without a node, and those of extensions, are left out; a log line counts the latter.

    Raises:
        FormatError: A channel or a sampler is malformed, or its keys are not finite or not in order.
    """
    clips: dict[str, Clip] = {}
    for index, animation in enumerate(file.model.animations or []):
        name = animation.name or str(index)
        while name in clips:
            name += f"_{index}"
        clips[name] = Clip(name, _tracks(file, animation, f"animations[{index}]"))
    return tuple(clips.values())


def _tracks(file: GltfFile, animation: pygltflib.Animation, where: str) -> tuple[Track, ...]:
    tracks: list[Track] = []
    unread = 0
    for k, channel in enumerate(animation.channels or []):
        target = channel.target
        if target is None or target.path not in {channel.value for channel in Channel}:
            unread += 1
        elif target.node is not None:
            label = f"{where}.channels[{k}]"
            sampler = _sampler(file, animation, channel.sampler, label)
            tracks.append(_track(file, sampler, Channel(target.path), target.node, label))
    if unread:
        _log.warning("%s: %s: %d channels left out, they move what is not read", file.path, where, unread)
    return tuple(tracks)


def _track(file: GltfFile, sampler: pygltflib.AnimationSampler, kind: Channel, node: int, where: str) -> Track:
    """The track of a channel that animates a property of a node."""
    item = file.item("nodes", node, where)
    if item.matrix is not None and kind is not Channel.WEIGHTS:
        raise FormatError(file.path, f"{where} moves {node_label(file, node)}, which has a matrix: expected its parts")
    if sampler.interpolation not in (None, *(way.value for way in Interpolation)):
        ways = ", ".join(way.value for way in Interpolation)
        raise FormatError(file.path, f"{where} has interpolation {sampler.interpolation!r}, expected one of {ways}")
    way = Interpolation(sampler.interpolation or "LINEAR")
    times = file.floats(sampler.input, "SCALAR", f"{where} input")[:, 0].astype(np.float64)
    _check_times(file, times, where)
    stored = file.floats(sampler.output, _KINDS[kind], f"{where} output").astype(np.float64)
    invalid = stored.size - np.count_nonzero(np.isfinite(stored))
    if invalid:
        raise FormatError(file.path, f"{where}: {invalid:,} of {stored.size:,} key values are not finite")
    width = _target_count(file, item, where) if kind is Channel.WEIGHTS else stored.shape[1]
    rows = 3 if way is Interpolation.CUBICSPLINE else 1
    if stored.size != rows * width * times.size:
        found = f"{len(stored):,} values for {times.size:,} keys"
        raise FormatError(file.path, f"{where} has {found}, expected {rows * width * times.size // stored.shape[1]:,}")
    keys = stored.reshape(times.size, rows, width)
    if kind is Channel.ROTATION:
        keys = np.roll(keys, 1, axis=2)  # the file has the scalar last
    values = keys[:, rows // 2]
    if kind is Channel.ROTATION:
        values = _unit(file, values, where)
    return Track(node, kind, way, times, values, keys[:, ::2] if rows == 3 else None)


def _sampler(
    file: GltfFile, animation: pygltflib.Animation, number: int | None, where: str
) -> pygltflib.AnimationSampler:
    """The sampler that a channel refers to."""
    samplers: list[pygltflib.AnimationSampler] = animation.samplers or []
    if number is None or number not in range(len(samplers)):
        raise FormatError(file.path, f"{where} refers to samplers[{number}], but there are {len(samplers)}")
    return samplers[number]


def _check_times(file: GltfFile, times: Matrix, where: str) -> None:
    invalid = times.size - np.count_nonzero(np.isfinite(times))
    if invalid:
        raise FormatError(file.path, f"{where}: {invalid:,} of {times.size:,} key times are not finite")
    falls = np.flatnonzero(np.diff(times) < 0.0)
    if falls.size:
        first = int(falls[0])
        raise FormatError(
            file.path, f"{where}: key times must rise, but {times[first + 1]:g} follows {times[first]:g} s"
        )


def _target_count(file: GltfFile, node: pygltflib.Node, where: str) -> int:
    """Number of morph targets of a node's mesh."""
    mesh = file.item("meshes", node.mesh, where)
    count = max((len(primitive.targets or []) for primitive in mesh.primitives), default=0)
    if not count:
        raise FormatError(file.path, f"{where} changes morph weights of a mesh without morph targets")
    return count


def _unit(file: GltfFile, quaternions: Matrix, where: str) -> Matrix:
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not lengths.all():
        raise FormatError(file.path, f"{where}: {np.count_nonzero(lengths == 0.0)} rotations have zero length")
    return quaternions / lengths
