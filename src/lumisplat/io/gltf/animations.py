"""Animations of glTF files: keys of nodes' translation, rotation and scale, and of morph weights."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

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
    """All animations of a file, each with a name of its own: its number where the file has none.

    Channels without a node, and those of extensions, move nothing that is read; a log line counts the latter.

    Raises:
        FormatError: A channel or a sampler is malformed, or its keys are not finite or fall back in time.
    """
    clips: list[Clip] = []
    for index, animation in enumerate(file.model.animations or []):
        name = animation.name or str(index)
        while any(clip.name == name for clip in clips):
            name += f"_{index}"
        clips.append(Clip(name, _tracks(file, animation, f"animations[{index}]")))
    return tuple(clips)


def _tracks(file: GltfFile, animation: pygltflib.Animation, where: str) -> tuple[Track, ...]:
    tracks, unread = [], 0
    for k, channel in enumerate(animation.channels or []):
        target = channel.target
        if target is None or target.path not in {channel.value for channel in Channel}:
            unread += 1
        elif target.node is not None:
            tracks.append(_track(file, animation, channel, f"{where}.channels[{k}]"))
    if unread:
        _log.warning("%s: %s: %d channels left out, they move what is not read", file.path, where, unread)
    return tuple(tracks)


def _track(file: GltfFile, animation: pygltflib.Animation, channel: Any, where: str) -> Track:
    kind, node = Channel(channel.target.path), channel.target.node
    item = file.item("nodes", node, where)
    if item.matrix is not None and kind is not Channel.WEIGHTS:
        raise FormatError(file.path, f"{where} moves {node_label(file, node)}, which has a matrix: expected its parts")
    samplers = animation.samplers or []
    if channel.sampler not in range(len(samplers)):
        raise FormatError(file.path, f"{where} refers to samplers[{channel.sampler}], but there are {len(samplers)}")
    sampler = samplers[channel.sampler]
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
    """Morph targets of a node's mesh."""
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
