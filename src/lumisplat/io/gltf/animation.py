"""Animations of glTF files as scenes that move: nodes, skins and morph targets, captures and a camera."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, parsing
from lumisplat.io.gltf.cameras import cameras_of
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.gaussians import GltfCaptures
from lumisplat.io.gltf.lights import EXTENSION as LIGHTS
from lumisplat.io.gltf.lights import read_lights
from lumisplat.io.gltf.materials import warn_unread
from lumisplat.io.gltf.meshes import read_skin
from lumisplat.io.gltf.nodes import hierarchy, node_label, scene_nodes
from lumisplat.io.gltf.rigs import read_clips, read_skeleton, rig_of
from lumisplat.io.gltf.scene import check_extensions, placed_in
from lumisplat.io.meshes.mesh_arrays import TriangleSieve
from lumisplat.math.arrays import Doubles
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.animation.keyframes import Keyframes
from lumisplat.scene.animation.rig import Channel, Clip, Interpolation, Skeleton
from lumisplat.scene.scene import Scene, SplatInstance, check_similarity

ANIMATION_SAMPLES_MAX = 400_000
"""Samples of a camera or capture of a glTF animation, which are made when it is read: more than an hour. So many take a
minute on one core, and 500 MB."""

_log = logging.getLogger("lumisplat")

_FPS = 25.0
"""Frames a second: glTF has none."""
_SAMPLES_A_FRAME = 4
"""Of captures and cameras, which move between samples as keyframes do; meshes are posed at each frame itself."""
_AROUND_STEP = (-2e-6, -1e-6, 1e-6)
"""When a step has samples but at its own time, seconds from it: two of the old value and two of the new one, so that
the cubics through them (Catmull-Rom) are flat on both of its sides."""


def read_gltf_animation(path: PathLike, drop_invalid: bool = False) -> Animation:
    """Reads the first animation of a file, with what stands still: 25 frames a second, from 0 to its last key.

    Meshes that nodes, skins or morph targets move are one actor, each capture that moves is one. The first camera that
    moves is a path; lights stay where they are at rest, with a log line.

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        drop_invalid: As of `lumisplat.io.load`, of captures.

    Raises:
        FormatError: The file cannot be read, or has no animation.
    """
    path = Path(path)
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        check_extensions(file)
        warn_unread(file)
        clips = read_clips(file)
        if not clips:
            raise FormatError(path, "has no animation: lumisplat render shows it, a scene.toml can move it")
        clip = clips[0]
        if len(clips) > 1:
            others = ", ".join(repr(one.name) for one in clips[1:4])
            _log.warning("%s: its first animation is played, %r, not %s", os.fspath(path), clip.name, others)
        frames = round(clip.duration * _FPS) + 1
        if frames > ANIMATION_FRAMES_MAX:
            raise FormatError(
                path, f"is animated for {clip.duration:g} s, expected at most {ANIMATION_FRAMES_MAX:,} frames"
            )
        return _Moving(file, clip, drop_invalid).animation(frames)


class _Moving:
    """A file, and its nodes at the times of an animation.

    Args:
        file: The open file.
        clip: The animation.
        drop_invalid: As of `lumisplat.io.load`.
    """

    def __init__(self, file: GltfFile, clip: Clip, drop_invalid: bool) -> None:
        self._file, self._clip, self._drop_invalid = file, clip, drop_invalid
        self._skeleton: Skeleton = read_skeleton(file)
        self._nodes = list(scene_nodes(file))
        self._moved = _moved_nodes(file, clip)

    def animation(self, frames: int) -> Animation:
        """All of it."""
        file, moved = self._file, self._moved
        deformed = [index for index in self._nodes if index in moved or self._is_deformed(index)]
        still = [index for index in self._nodes if index not in set(deformed)]
        rest = [*self._skeleton.world_from_node()]
        sieve = TriangleSieve(file.path)
        scene = placed_in(file, still, rest, sieve, drop_invalid=self._drop_invalid)
        sieve.report(anything_left=True)
        lit = [index for index in deformed if LIGHTS in (file.model.nodes[index].extensions or {})]
        if lit:
            named = ", ".join(node_label(file, index) for index in lit[:3])
            _log.warning("%s: lights that move stay where they are at rest (%s)", os.fspath(file.path), named)
        rig = rig_of(file, (self._clip,), deformed)
        actors = [Actor(rig, loop=False)] if rig is not None else []
        actors += self._captures(deformed)
        scene = replace(scene, lights=read_lights(file, self._nodes, rest), up="y-up")
        cameras = cameras_of(file, [index for index in self._nodes if file.model.nodes[index].camera is not None], rest)
        return Animation(scene, actors, cameras, fps=_FPS, frame_count=frames, camera_path=self._camera_path())

    def _is_deformed(self, index: int) -> bool:
        """Whether the mesh of a node changes, though the node stays."""
        node = self._file.model.nodes[index]
        if node.mesh is None:
            return False
        weighted = any(track.node == index and track.channel is Channel.WEIGHTS for track in self._clip.tracks)
        return weighted or (
            node.skin is not None and bool(self._moved.intersection(read_skin(self._file, node.skin).joints))
        )

    def _times(self) -> Doubles:
        """Times of samples: several a frame, and those of the keys, seconds."""
        count = round(self._clip.duration * _FPS * _SAMPLES_A_FRAME)
        if count > ANIMATION_SAMPLES_MAX:
            seconds = ANIMATION_SAMPLES_MAX / (_FPS * _SAMPLES_A_FRAME)
            raise FormatError(
                self._file.path,
                f"is animated for {self._clip.duration:g} s, expected at most {seconds:g} of a camera or of captures",
            )
        even = np.arange(count + 1) / (_FPS * _SAMPLES_A_FRAME)
        keys = [track.times for track in self._clip.tracks]
        stepped = [track.times for track in self._clip.tracks if track.interpolation is Interpolation.STEP]
        steps = [times + around for times in stepped for around in _AROUND_STEP]
        times = np.unique(np.concatenate([even, *keys, *steps]))
        return times[(times >= 0.0) & (times <= max(even[-1], self._clip.duration))]

    def _captures(self, nodes: list[int]) -> Iterator[Actor]:
        """Captures that move."""
        captures = GltfCaptures(self._file, self._drop_invalid)
        moving = [index for index in nodes if captures.is_in(index)]
        times = self._times() if moving else np.zeros(0)
        for index in moving:
            try:
                yield from self._capture_actors(captures, index, times)
            except SceneError as error:
                if isinstance(error, FormatError):
                    raise
                raise FormatError(self._file.path, f"{node_label(self._file, index)}: {error}") from None

    def _capture_actors(self, captures: GltfCaptures, index: int, times: Doubles) -> Iterator[Actor]:
        """The captures of a node, where it is at each time."""
        first: list[SplatInstance] = []
        placed: list[list[Doubles]] = []
        for time in times:
            world = self._skeleton.world_from_node(self._clip, float(time))
            at_time = list(captures.placed([index], [*world]))
            first = first or at_time
            if not at_time or any(
                one.gaussians is not other.gaussians for one, other in zip(at_time, first, strict=True)
            ):
                raise FormatError(
                    self._file.path,
                    f"{node_label(self._file, index)} is stretched or hidden by the animation, which its Gaussians "
                    "cannot be: expected a uniform scale above 0",
                )
            placed.append([one.transform for one in at_time])
        for one, places in zip(first, np.array(placed).swapaxes(0, 1), strict=True):
            for place in places:
                check_similarity(place[:3, :3])
            scales = np.cbrt(np.linalg.det(places[:, :3, :3]))
            turns = quaternions_from_matrices(places[:, :3, :3] / scales[:, None, None])
            still = Scene(splats=[replace(one, world_from_object=None)])
            yield Actor(still, Keyframes(times, places[:, :3, 3], turns, scales), name=one.name)

    def _camera_path(self) -> CameraPath | None:
        """The first camera that moves."""
        nodes = [index for index in self._nodes if self._file.model.nodes[index].camera is not None]
        moving = next((index for index in nodes if index in self._moved), None)
        if moving is None:
            return None
        times = self._times()
        worlds = (self._skeleton.world_from_node(self._clip, float(time)) for time in times)
        keys = [one for world in worlds for one in cameras_of(self._file, [moving], [*world])]
        return CameraPath(keys, times)


def _moved_nodes(file: GltfFile, clip: Clip) -> set[int]:
    """Nodes whose place changes: those that are moved, and all below them."""
    moved = {track.node for track in clip.tracks if track.channel is not Channel.WEIGHTS}
    tree = hierarchy(file)
    for index in tree.order:  # parents first
        if tree.parents[index] in moved:
            moved.add(index)
    return moved
