"""Reads rigs (meshes, joints and animations) from glTF files, and animated glTF files as whole scenes."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import FormatError, SceneError
from lumisplat.io.files.source import PathLike, is_list, parsing
from lumisplat.io.gltf.cameras import cameras_of
from lumisplat.io.gltf.container import GltfFile
from lumisplat.io.gltf.gaussians import GltfCaptures
from lumisplat.io.gltf.lights import EXTENSION as LIGHTS, read_lights
from lumisplat.io.gltf.materials import GltfMaterials, warn_unread
from lumisplat.io.gltf.meshes import Influences, RawPrimitive, Skin, read_raw, read_skin, usable_colors
from lumisplat.io.gltf.nodes import (
    Matrix,
    hierarchy,
    instance_transforms,
    node_columns,
    node_label,
    node_matrix,
    scene_nodes,
)
from lumisplat.io.gltf.scene import check_extensions, scene_of_nodes
from lumisplat.io.meshes.mesh_arrays import TriangleSieve, material_for_uvs
from lumisplat.math.arrays import Doubles, IntArray, read_only_view
from lumisplat.math.transforms import quaternions_from_matrices
from lumisplat.scene.animation.actors import Actor, Animation
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.animation.keyframes import Keyframes
from lumisplat.scene.animation.lights import LightPath
from lumisplat.scene.animation.rig import (
    Channel,
    Clip,
    Interpolation,
    MorphTargets,
    Rig,
    RigPart,
    RigPose,
    RigSurface,
    Skeleton,
    Track,
    join_triangles,
)
from lumisplat.scene.lights import AimedLight, Light, PlacedLight
from lumisplat.scene.scene import Scene, SplatInstance, check_similarity

if TYPE_CHECKING:
    import pygltflib


_log = logging.getLogger("lumisplat")

ANIMATION_SAMPLES_MAX = 400_000
"""Largest number of samples of a glTF camera or capture: more than an hour of animation. All samples are computed when
the file is read; this many take a minute on one core, and 500 MB."""

_LIGHT_POINTER = re.compile(r"/extensions/KHR_lights_punctual/lights/(\d+)/(intensity|color)")
"""Properties of lights that are read from KHR_animation_pointer."""

_KINDS = {Channel.TRANSLATION: "VEC3", Channel.ROTATION: "VEC4", Channel.SCALE: "VEC3", Channel.WEIGHTS: "SCALAR"}


class _LightTrack(NamedTuple):
    """Animation of the intensity or colour of a light, an index into the lights of the file."""

    light: int
    field: str
    track: Track


def _light_tracks(file: GltfFile, index: int) -> list[_LightTrack]:
    """Reads the channels of an animation that change intensities and colours of lights (KHR_animation_pointer)."""
    animation: pygltflib.Animation = file.item("animations", index, "animations")
    found: list[_LightTrack] = []
    for k, channel in enumerate(animation.channels or []):
        pointer = _light_pointer(channel)
        if pointer is not None:
            light, field = int(pointer[1]), pointer[2]
            where = f"animations[{index}].channels[{k}]"
            sampler = _sampler(file, animation, channel.sampler, where)
            width = 3 if field == "color" else 1
            mode, times, keys = _read_keys(file, sampler, "VEC3" if width == 3 else "SCALAR", width, where)
            tangents = keys[:, ::2] if mode is Interpolation.CUBICSPLINE else None
            track = Track(-1, Channel.WEIGHTS, mode, times, keys[:, keys.shape[1] // 2], tangents)
            found.append(_LightTrack(light, field, track))
    return found


def _light_pointer(channel: pygltflib.AnimationChannel) -> re.Match[str] | None:
    """Returns the light and property that a channel animates by KHR_animation_pointer; None for other channels."""
    extensions: dict[str, Any] = getattr(channel.target, "extensions", None) or {}
    pointer: object = extensions.get("KHR_animation_pointer", {}).get("pointer")
    return _LIGHT_POINTER.fullmatch(pointer) if isinstance(pointer, str) else None


def _read_clips(file: GltfFile, *, lights: bool = False) -> tuple[Clip, ...]:
    """Reads all animations of a file as clips with unique names; an animation without a name gets its index as name.

    Channels without a target node are skipped. Channels that animate extension properties are skipped and counted in a
    log line, but with ``lights`` not those of lights, which the caller reads.
    """
    clips: dict[str, Clip] = {}
    for index, animation in enumerate(file.model.animations or []):
        name = animation.name or str(index)
        while name in clips:
            name += f"_{index}"
        clips[name] = Clip(name, _tracks(file, animation, f"animations[{index}]", lights=lights))
    return tuple(clips.values())


def _tracks(file: GltfFile, animation: pygltflib.Animation, where: str, *, lights: bool) -> tuple[Track, ...]:
    """Reads the channels of nodes of an animation as tracks.

    Args:
        file: The file.
        animation: The animation.
        where: Name of the animation in messages.
        lights: Whether the caller reads channels of lights, so that they do not count as left out.
    """
    tracks: list[Track] = []
    unread = 0
    for k, channel in enumerate(animation.channels or []):
        target = channel.target
        if lights and _light_pointer(channel) is not None:
            continue
        if target is None or target.path not in {channel.value for channel in Channel}:
            unread += 1
        elif target.node is not None:
            label = f"{where}.channels[{k}]"
            sampler = _sampler(file, animation, channel.sampler, label)
            tracks.append(_track(file, sampler, Channel(target.path), target.node, label))
    if unread:
        _log.warning(
            "%s: %s: %d channels left out: they animate properties that are not read", file.path, where, unread
        )
    return tuple(tracks)


def _track(file: GltfFile, sampler: pygltflib.AnimationSampler, kind: Channel, node: int, where: str) -> Track:
    """Reads a sampler as the track of one node property.

    Args:
        file: The file.
        sampler: The sampler.
        kind: The node property.
        node: Index of the node.
        where: Name of the channel in messages.
    """
    item = file.item("nodes", node, where)
    if item.matrix is not None and kind is not Channel.WEIGHTS:
        raise FormatError(
            file.path,
            f"{where} animates {node_label(file, node)}, which has a matrix: expected translation, rotation and scale",
        )
    width = _target_count(file, item, where) if kind is Channel.WEIGHTS else 4 if kind is Channel.ROTATION else 3
    mode, times, keys = _read_keys(file, sampler, _KINDS[kind], width, where)
    if kind is Channel.ROTATION:
        keys = np.roll(keys, 1, axis=2)  # glTF quaternions are x, y, z, w
    values = keys[:, keys.shape[1] // 2]
    if kind is Channel.ROTATION:
        values = _unit(file, values, where)
    return Track(node, kind, mode, times, values, keys[:, ::2] if mode is Interpolation.CUBICSPLINE else None)


def _read_keys(
    file: GltfFile, sampler: pygltflib.AnimationSampler, kind: str, width: int, where: str
) -> tuple[Interpolation, Doubles, Doubles]:
    """Reads a sampler: its interpolation, K times in seconds, and values of shape (K, 1, ``width``).

    A cubic spline has three rows for each key: incoming tangent, value and outgoing tangent.

    Args:
        file: The file.
        sampler: The sampler.
        kind: glTF type of the output accessor.
        width: Numbers of a value.
        where: Name of the channel in messages.
    """
    if sampler.interpolation not in (None, *(mode.value for mode in Interpolation)):
        modes = ", ".join(mode.value for mode in Interpolation)
        raise FormatError(file.path, f"{where} has interpolation {sampler.interpolation!r}, expected one of {modes}")
    mode = Interpolation(sampler.interpolation or "LINEAR")
    times = file.floats(sampler.input, "SCALAR", f"{where} input")[:, 0].astype(np.float64)
    _check_times(file, times, where)
    stored = file.floats(sampler.output, kind, f"{where} output").astype(np.float64)
    invalid = stored.size - np.count_nonzero(np.isfinite(stored))
    if invalid:
        raise FormatError(file.path, f"{where}: {invalid:,} of {stored.size:,} key values are not finite")
    rows = 3 if mode is Interpolation.CUBICSPLINE else 1
    if stored.size != rows * width * times.size:
        found = f"{len(stored):,} values for {times.size:,} keys"
        raise FormatError(file.path, f"{where} has {found}, expected {rows * width * times.size // stored.shape[1]:,}")
    return mode, times, stored.reshape(times.size, rows, width)


def _sampler(
    file: GltfFile, animation: pygltflib.Animation, number: int | None, where: str
) -> pygltflib.AnimationSampler:
    """Returns ``animation.samplers[number]``, which a channel refers to, or raises `FormatError` if there is none."""
    samplers: list[pygltflib.AnimationSampler] = animation.samplers or []
    if number is None or number not in range(len(samplers)):
        raise FormatError(file.path, f"{where} refers to samplers[{number}], but there are {len(samplers)}")
    return samplers[number]


def _check_times(file: GltfFile, times: Matrix, where: str) -> None:
    """Checks that key times are finite and do not decrease."""
    invalid = times.size - np.count_nonzero(np.isfinite(times))
    if invalid:
        raise FormatError(file.path, f"{where}: {invalid:,} of {times.size:,} key times are not finite")
    falls = np.flatnonzero(np.diff(times) < 0.0)
    if falls.size:
        first = int(falls[0])
        raise FormatError(
            file.path, f"{where}: key times must increase, but {times[first + 1]:g} follows {times[first]:g} s"
        )


def _target_count(file: GltfFile, node: pygltflib.Node, where: str) -> int:
    """Returns the number of morph targets of a node's mesh."""
    mesh = file.item("meshes", node.mesh, where)
    count = max((len(primitive.targets or []) for primitive in mesh.primitives), default=0)
    if not count:
        raise FormatError(file.path, f"{where} animates morph weights of a mesh without morph targets")
    return count


def _unit(file: GltfFile, quaternions: Matrix, where: str) -> Matrix:
    """Normalizes K quaternions, shape (K, 4).

    Raises:
        FormatError: A quaternion has zero length.
    """
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    if not lengths.all():
        raise FormatError(file.path, f"{where}: {np.count_nonzero(lengths == 0.0)} rotations have zero length")
    return quaternions / lengths


class _RigPrimitive(NamedTuple):
    """A triangle primitive of a node, as arrays of the file (``raw``) and as a `RigPart` (``part``)."""

    raw: RawPrimitive
    part: RigPart


def read_rig(path: Path, vertex_colors: bool = True) -> Rig:
    """Reads a rigged glTF file; see `lumisplat.avatars.load_rig`."""
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        check_extensions(file)
        if not is_rigged(file):
            raise FormatError(path, "is not a rig: it has neither a skin nor an animation (load reads it as a mesh)")
        warn_unread(file)
        rig = _rig_of(file, _read_clips(file), scene_nodes(file), vertex_colors)
        if rig is None:
            raise FormatError(path, "is not a rig: its scene has no triangle mesh")
        return rig


def read_motion(path: Path) -> tuple[Skeleton, tuple[Clip, ...]]:
    """Reads the nodes and animations of a glTF file, without its meshes.

    Raises:
        FormatError: The file cannot be read, or has no animation.
    """
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        clips = _read_clips(file)
        if not clips:
            raise FormatError(path, "has no animation, which moves a rig")
        return _read_skeleton(file), clips


def _rig_of(file: GltfFile, clips: tuple[Clip, ...], nodes: Iterable[int], vertex_colors: bool = True) -> Rig | None:
    """Builds a rig from the meshes of the given nodes; None if the meshes have no triangles."""
    skeleton = _read_skeleton(file)
    groups: dict[tuple[int, bool, bool], list[_RigPrimitive]] = {}
    for piece in _rig_primitives(file, clips, nodes):
        raw = piece.raw
        key = id(raw.material), raw.uvs is None, raw.normals is None
        groups.setdefault(key, []).append(piece)
    if not groups:
        return None
    surfaces = (_surface(file, group, skeleton, vertex_colors) for group in groups.values())
    return Rig(skeleton, _visible_surfaces(file, surfaces, skeleton), clips)


def _visible_surfaces(file: GltfFile, surfaces: Iterable[RigSurface], skeleton: Skeleton) -> tuple[RigSurface, ...]:
    """Returns the surfaces that have triangles in the rest pose. Files hide a mesh by scaling it to zero."""
    rest = RigPose(skeleton.world_from_node(), {})
    visible: list[RigSurface] = []
    for surface in surfaces:
        if surface.mesh(rest) is not None:
            visible.append(surface)
        else:
            _log.warning("%s: mesh %r left out: at rest it has no triangles with an area", file.path, surface.name)
    if not visible:
        raise FormatError(file.path, "has no triangles with an area at rest")
    return tuple(visible)


def is_rigged(file: GltfFile) -> bool:
    """Returns whether a file has a skinned node or an animation."""
    return bool(file.model.animations) or any(node.skin is not None for node in file.model.nodes)


def _read_skeleton(file: GltfFile) -> Skeleton:
    """Reads all nodes of a file as a skeleton, including nodes outside of the scene."""
    tree = hierarchy(file)
    nodes = range(len(tree.parents))
    matrices = {index: matrix for index in nodes if (matrix := node_matrix(file, index)) is not None}
    identity = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.ones(3)
    columns = [identity if index in matrices else node_columns(file, index) for index in nodes]
    translations, rotations, scales = (np.array(column) for column in zip(*columns, strict=True))
    names = {index: node.name or "" for index, node in enumerate(file.model.nodes)} | _human_bones(file)
    return Skeleton(tree.parents, tree.order, translations, rotations, scales, matrices, tuple(names[k] for k in nodes))


def _human_bones(file: GltfFile) -> dict[int, str]:
    """Returns the names that VRM gives to nodes, such as leftUpperLeg, by their indices; empty for other files."""
    extensions: dict[str, Any] = file.model.extensions or {}
    named = [extensions[name] for name in ("VRMC_vrm", "VRMC_vrm_animation", "VRM") if name in extensions]
    bones: Any = named[0].get("humanoid", {}).get("humanBones", {}) if named else {}
    rows: list[Any] = bones if is_list(bones) else [{"bone": name, **bones[name]} for name in bones]  # VRM 0, or 1
    return {int(row["node"]): str(row["bone"]) for row in rows}


def _rig_primitives(file: GltfFile, clips: tuple[Clip, ...], nodes: Iterable[int]) -> Iterator[_RigPrimitive]:
    """Yields the triangle primitives of the given nodes' meshes, once per instance (EXT_mesh_gpu_instancing)."""
    materials = GltfMaterials(file)
    morphed = {track.node for clip in clips for track in clip.tracks if track.channel is Channel.WEIGHTS}
    for index in nodes:
        node = file.model.nodes[index]
        if node.mesh is None:
            continue
        mesh = file.item("meshes", node.mesh, f"nodes[{index}]")
        weights = np.array(getattr(node, "weights", None) or mesh.weights or (), dtype=np.float64)
        if not np.isfinite(weights).all():
            raise FormatError(file.path, f"meshes[{node.mesh}] has morph weights that are not finite")
        # Without a skin, the node is the only joint, once for each instance.
        if node.skin is None:
            skins = [Skin((index,), transform[None]) for transform in instance_transforms(file, index)]
        else:
            skins = [read_skin(file, node.skin)]
        raws = read_raw(
            file,
            node.mesh,
            materials,
            joint_count=None if node.skin is None else len(skins[0].joints),
            targets=None if index in morphed else set(np.flatnonzero(weights).tolist()),
        )
        for raw in raws:
            for skin in skins:
                yield _RigPrimitive(raw, _part(raw, skin, index, weights))


def _part(raw: RawPrimitive, skin: Skin, node: int, weights: Doubles) -> RigPart:
    """Returns a primitive as a `RigPart`. Vertices without skin weights follow the skin's first joint.

    Args:
        raw: Arrays of the primitive.
        skin: Skin of the node; for a node without a skin, the node itself as the only joint.
        node: Index of the node; an animation of this node's morph weights applies to the part.
        weights: Default weights of the primitive's morph targets.
    """
    count = len(raw.positions)
    influences = raw.influences or Influences(np.zeros((count, 1), np.int32), np.ones((count, 1), np.float32))
    return RigPart(
        positions=raw.positions,
        normals=raw.normals,
        nodes=np.array(skin.joints, dtype=np.int32),
        joint_from_bind=skin.joint_from_bind,
        joints=influences.joints,
        weights=influences.weights,
        morphs=_morphs(raw, node, weights),
    )


def _morphs(raw: RawPrimitive, node: int, weights: Doubles) -> MorphTargets | None:
    """Returns a primitive's morph targets, zero where a target has no offsets; None if the primitive has no target."""
    numbers = sorted(raw.morph_positions.keys() | raw.morph_normals.keys())
    if not numbers:
        return None
    count = max(numbers[-1] + 1, weights.size)
    positions, normals = (np.zeros((count, *raw.positions.shape), np.float32) for _ in range(2))
    for number, offsets in raw.morph_positions.items():
        positions[number] = offsets
    for number, offsets in raw.morph_normals.items():
        normals[number] = offsets
    at_rest = np.zeros(count)
    at_rest[: weights.size] = weights
    return MorphTargets(node, at_rest, positions, normals if raw.morph_normals else None)


def _surface(file: GltfFile, pieces: list[_RigPrimitive], skeleton: Skeleton, vertex_colors: bool) -> RigSurface:
    """Joins the primitives ``pieces``, which have the same material and attributes, into one surface of the rig."""
    first = pieces[0].raw
    triangles: list[IntArray] = []
    for raw, part in pieces:
        usable = ((raw.triangles >= 0) & (raw.triangles < len(part.positions))).all(axis=1)
        if not usable.all():
            _log.warning("%s: %d triangles left out: their indices are out of range", file.path, (~usable).sum())
        triangles.append(raw.triangles[usable].astype(np.int32))
    parts = [piece.part for piece in pieces]
    colors = None
    if vertex_colors and any(raw.colors is not None for raw, _ in pieces):
        per_piece = [np.ones_like(raw.positions) if raw.colors is None else raw.colors for raw, _ in pieces]
        advice = "leave it out (vertex_colors = false)"
        colors = usable_colors(file.path, read_only_view(np.concatenate(per_piece)), first.material, first.name, advice)
    uv_parts = [raw.uvs for raw, _ in pieces if raw.uvs is not None]
    uvs = read_only_view(np.concatenate(uv_parts)) if uv_parts else None
    material = material_for_uvs(file.path, first.material, uvs, first.name)
    indices = join_triangles(parts, triangles, skeleton)
    return RigSurface(tuple(parts), indices, material, uvs, colors, first.name)


_FPS = 25.0
"""Frame rate of animations read from glTF, frames per second. glTF stores times in seconds and no frame rate."""
_SAMPLES_PER_FRAME = 4
"""Keyframes per frame that a moving capture or camera gets. Meshes need none: they are posed at each frame's time."""
_STEP_OFFSETS = (-2e-6, -1e-6, 1e-6)
"""Times of the extra samples around a key with STEP interpolation, in seconds from the key.

Two samples have the old value, before the key. Two have the new value, at the key and after it. The Catmull-Rom cubics
are then flat on both sides of the step."""


def read_gltf_animation(path: PathLike, drop_invalid: bool = False) -> Animation:
    """Reads the first animation of a file and its static content, at 25 frames per second from 0 to the last key.

    All meshes that nodes, skins or morph targets move form one actor. Each moving capture is an actor. The first moving
    camera becomes the camera path. Lights move with their nodes, and their intensities and colours change by
    KHR_animation_pointer.

    Args:
        path: A ``.glb`` or ``.gltf`` file.
        drop_invalid: Drop invalid Gaussians of captures, as in `lumisplat.io.load`.

    Raises:
        FormatError: The file cannot be read, or has no animation.
    """
    path = Path(path)
    with parsing(path, "a glTF file"):
        file = GltfFile(path)
        check_extensions(file)
        warn_unread(file)
        clips = _read_clips(file, lights=True)
        if not clips:
            raise FormatError(
                path, "has no animation: render a still with lumisplat render, or animate it in a scene.toml"
            )
        clip, light_tracks = clips[0], _light_tracks(file, 0)
        if len(clips) > 1:
            others = ", ".join(repr(one.name) for one in clips[1:4])
            _log.warning("%s: only its first animation is played, %r, not %s", os.fspath(path), clip.name, others)
        duration = max(clip.duration, *(float(one.track.times[-1]) for one in light_tracks), 0.0)
        frames = round(duration * _FPS) + 1
        if frames > ANIMATION_FRAMES_MAX:
            raise FormatError(path, f"is animated for {duration:g} s, expected at most {ANIMATION_FRAMES_MAX:,} frames")
        return _AnimationReader(file, clip, light_tracks, duration, drop_invalid).animation(frames)


class _AnimationReader:
    """Builds an `Animation` from a glTF file and one of the file's animations.

    Args:
        file: The open file.
        clip: The animation.
        light_tracks: Tracks of lights.
        duration: Time of the last key, seconds.
        drop_invalid: Drop invalid Gaussians, as in `lumisplat.io.load`.
    """

    def __init__(
        self, file: GltfFile, clip: Clip, light_tracks: list[_LightTrack], duration: float, drop_invalid: bool
    ) -> None:
        self._file, self._clip, self._drop_invalid = file, clip, drop_invalid
        self._light_tracks, self._duration = light_tracks, duration
        self._skeleton: Skeleton = _read_skeleton(file)
        self._nodes = list(scene_nodes(file))
        self._moved = _moved_nodes(file, clip)

    def animation(self, frames: int) -> Animation:
        """Returns the animation, ``frames`` frames long, with scene, actors, cameras and camera path."""
        file, moved = self._file, self._moved
        deformed = [index for index in self._nodes if index in moved or self._is_deformed(index)]
        still = [index for index in self._nodes if index not in set(deformed)]
        rest = [*self._skeleton.world_from_node()]
        sieve = TriangleSieve(file.path)
        scene = scene_of_nodes(file, still, rest, sieve, drop_invalid=self._drop_invalid)
        sieve.report(any_usable=True)
        changed = {one.light for one in self._light_tracks}
        on_nodes = {index: (file.model.nodes[index].extensions or {}).get(LIGHTS) for index in self._nodes}
        shining = {index: which.get("light") for index, which in on_nodes.items() if which}
        moving = [index for index, light in shining.items() if index in moved or light in changed]
        lights = read_lights(file, [index for index in shining if index not in moving], rest)
        rig = _rig_of(file, (self._clip,), deformed)
        actors = [Actor(rig, loop=False)] if rig is not None else []
        actors += self._captures(deformed)
        scene = replace(scene, lights=lights, up="y-up")
        cameras = cameras_of(file, [index for index in self._nodes if file.model.nodes[index].camera is not None], rest)
        paths = [path for index in moving for path in self._light_paths(index, shining[index], rest)]
        path = self._camera_path()
        return Animation(scene, actors, cameras, fps=_FPS, frame_count=frames, camera_path=path, lights=paths)

    def _light_paths(self, index: int, light: int, rest: list[Matrix]) -> Iterator[LightPath]:
        """Yields the light of a node that moves, or whose light changes; nothing for a node that is hidden at rest."""
        tracks = [one for one in self._light_tracks if one.light == light]
        for first in read_lights(self._file, [index], rest):
            times, keys = self._times(), list[Light]()
            for time in times.tolist():
                changes: dict[str, Any] = {}
                for one in tracks:
                    value = np.maximum(one.track.at(time), 0.0)  # splines may overshoot
                    changes[one.field] = value if one.field == "color" else float(value[0])
                if index in self._moved:
                    world = self._skeleton.world_from_node(self._clip, time)[index]
                    is_hidden = not world[:3, :3].any()
                    changes |= {"position": world[:3, 3]} if isinstance(first, PlacedLight) else {}
                    changes |= {"direction": -world[:3, 2]} if isinstance(first, AimedLight) and not is_hidden else {}
                    changes |= {"intensity": 0.0} if is_hidden else {}
                keys.append(replace(first, **changes))
            yield LightPath(keys, times)

    def _is_deformed(self, index: int) -> bool:
        """Returns whether the animation changes the shape of a node's mesh, by morph weights or the skin's joints."""
        node = self._file.model.nodes[index]
        if node.mesh is None:
            return False
        weighted = any(track.node == index and track.channel is Channel.WEIGHTS for track in self._clip.tracks)
        return weighted or (
            node.skin is not None and bool(self._moved.intersection(read_skin(self._file, node.skin).joints))
        )

    def _times(self) -> Doubles:
        """Returns the times in seconds at which captures, lights and cameras are sampled: evenly spaced, and at keys.

        A STEP key gets further samples just before and after it, see `_STEP_OFFSETS`.
        """
        count = round(self._duration * _FPS * _SAMPLES_PER_FRAME)
        if count > ANIMATION_SAMPLES_MAX:
            seconds = ANIMATION_SAMPLES_MAX / (_FPS * _SAMPLES_PER_FRAME)
            raise FormatError(
                self._file.path,
                f"is animated for {self._duration:g} s, "
                f"expected at most {seconds:g} s for cameras, lights and captures",
            )
        even = np.arange(count + 1) / (_FPS * _SAMPLES_PER_FRAME)
        tracks = (*self._clip.tracks, *(one.track for one in self._light_tracks))
        keys = [track.times for track in tracks]
        stepped = [track.times for track in tracks if track.interpolation is Interpolation.STEP]
        steps = [times + around for times in stepped for around in _STEP_OFFSETS]
        times = np.unique(np.concatenate([even, *keys, *steps]))
        return times[(times >= 0.0) & (times <= max(even[-1], self._duration))]

    def _captures(self, nodes: list[int]) -> Iterator[Actor]:
        """Yields an actor for each capture of the animated nodes ``nodes``."""
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
        """Yields the captures of a node as actors, with a keyframe at each time."""
        first: list[SplatInstance] = []
        sampled: list[list[Doubles]] = []
        for time in times:
            world = self._skeleton.world_from_node(self._clip, float(time))
            at_time = list(captures.instances([index], [*world]))
            first = first or at_time
            if not at_time or any(
                one.gaussians is not other.gaussians for one, other in zip(at_time, first, strict=True)
            ):
                raise FormatError(
                    self._file.path,
                    f"{node_label(self._file, index)} is stretched or hidden by the animation, which Gaussians "
                    "do not support: expected a uniform scale above 0",
                )
            sampled.append([one.transform for one in at_time])
        for one, transforms in zip(first, np.array(sampled).swapaxes(0, 1), strict=True):
            for transform in transforms:
                check_similarity(transform[:3, :3])
            scales = np.cbrt(np.linalg.det(transforms[:, :3, :3]))
            rotations = quaternions_from_matrices(transforms[:, :3, :3] / scales[:, None, None])
            still = Scene(splats=[replace(one, world_from_object=None)])
            yield Actor(still, Keyframes(times, transforms[:, :3, 3], rotations, scales), name=one.name)

    def _camera_path(self) -> CameraPath | None:
        """Returns the path of the first moving camera; None if no camera moves."""
        nodes = [index for index in self._nodes if self._file.model.nodes[index].camera is not None]
        moving = next((index for index in nodes if index in self._moved), None)
        if moving is None:
            return None
        times = self._times()
        worlds = (self._skeleton.world_from_node(self._clip, float(time)) for time in times)
        keys = [one for world in worlds for one in cameras_of(self._file, [moving], [*world])]
        return CameraPath(keys, times)


def _moved_nodes(file: GltfFile, clip: Clip) -> set[int]:
    """Returns the indices of the nodes that an animation moves, and of all their descendants, which move along."""
    moved = {track.node for track in clip.tracks if track.channel is not Channel.WEIGHTS}
    tree = hierarchy(file)
    for index in tree.order:  # parents first
        if tree.parents[index] in moved:
            moved.add(index)
    return moved
