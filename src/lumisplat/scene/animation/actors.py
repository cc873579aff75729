"""Actors that move through a scene, file sequences of Gaussians, and animations: a scene that changes with time."""

from __future__ import annotations

import logging
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, TypeVar, cast

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.config.checks import Range
from lumisplat.config.setting import frozen, given
from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import SceneError
from lumisplat.math.arrays import matrix_4x4
from lumisplat.scene.animation.camera_path import CameraPath
from lumisplat.scene.animation.correspondence import correspond, interpolated
from lumisplat.scene.animation.keyframes import Keyframes, check_time
from lumisplat.scene.animation.lights import MaterialPath, MovingLight, light_at, moving_lights, with_materials
from lumisplat.scene.animation.rig import Rig
from lumisplat.scene.animation.rigged_gaussians import RiggedGaussians
from lumisplat.scene.camera import Camera
from lumisplat.scene.checks import check_kind, items_of, take_scene_fields
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, check_similarity

_log = logging.getLogger("lumisplat")

SEQUENCE_TIME_SLACK = 1e-6
"""A time at most this much, in frames, before the time of a frame already shows that frame: rounding makes k / fps *
fps less than k for some k."""

SEQUENCE_FRAMES_KEPT = 2
"""Number of frames that a sequence caches: the current and the previous one. A frame may take a gigabyte."""


@dataclass(frozen=True, slots=True, eq=False)
class GaussianSequence:
    """Frames of Gaussians at a constant rate, each loaded when first needed; made by `load_sequence`.

    Between two frames with the same Gaussians in the same order, Gaussians are interpolated. Some writers reorder
    Gaussians, and counts may differ: a frame is then returned unchanged until the time of the next one, and a log line
    says so once. The last few frames are cached.

    Raises:
        SceneError: There are no frames, or ``fps`` is not a positive number.
    """

    paths: Sequence[Path]
    """Files of the sequence's frames, one each, in order of time."""
    fps: Annotated[float, Range(0.0, above=True)]
    """Frames of the sequence per second, above 0."""
    load: Callable[[Path], Gaussians]
    """Function that reads the Gaussians of one frame from its file."""
    _cache: OrderedDict[int, Gaussians] = field(default_factory=OrderedDict[int, Gaussians], init=False)
    """Last used frames, at most `SEQUENCE_FRAMES_KEPT`, by frame number; the most recently used one is last."""
    _said_reordered: bool = field(default=False, init=False)
    """Whether the log line about frames in different orders was written."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "paths", tuple(self.paths))
        if not self.paths:
            raise SceneError("a sequence without frames, expected at least one")
        take_scene_fields(self)

    def __repr__(self) -> str:
        return f"GaussianSequence(frames={self.frame_count}, fps={self.fps:g}, first={self.paths[0].name!r})"

    @property
    def frame_count(self) -> int:
        """Number of frames of the sequence."""
        return len(self.paths)

    @property
    def duration(self) -> float:
        """Time at which the last frame ends, ``frame_count / fps``, seconds."""
        return self.frame_count / self.fps

    def at(self, time: float) -> Gaussians:
        """Returns the Gaussians at a time: the first frame before the sequence begins, the last frame after its end.

        Args:
            time: Seconds since the sequence began.

        Raises:
            SceneError: The time is not finite.
            FormatError: The frame's file cannot be read; the message names the file.
        """
        check_time(time)
        position = float(np.clip(time * self.fps, 0.0, self.frame_count - 1))
        # Rounding may put a multiple of 1 / fps just before the frame that begins there.
        index = int(np.floor(position + SEQUENCE_TIME_SLACK))
        share = position - index
        if share <= SEQUENCE_TIME_SLACK:
            return self._frame(index)
        first, second = self._frame(index), self._frame(index + 1)
        if correspond(first, second):
            return interpolated(first, second, share)
        if first.count == second.count and not self._said_reordered:
            object.__setattr__(self, "_said_reordered", True)
            _log.warning(
                "frames in %s hold their Gaussians in different orders, so that nothing can be interpolated: each is "
                "shown until the next one",
                self.paths[0].parent,
            )
        return first

    def _frame(self, index: int) -> Gaussians:
        """Returns a frame of the sequence by its number, from the cache or its file."""
        if index not in self._cache:
            self._cache[index] = self.load(self.paths[index])
            while len(self._cache) > SEQUENCE_FRAMES_KEPT:
                self._cache.popitem(last=False)
        self._cache.move_to_end(index)
        return self._cache[index]


Instances = tuple[SplatInstance | MeshInstance, ...]
Instance = SplatInstance | MeshInstance


Content = Gaussians | Mesh | Instance | Scene
"""Types of the objects that a function of time may return to an `Actor`; a `Scene` stands for its captures and meshes.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Deforming:
    """A subject that is computed or read from its file for each time: of `load_animation`, or a function of a program.

    The result of the last time is cached.
    """

    read: Callable[[float], Content | Iterable[Content]]
    """Function that returns Gaussians, a mesh, an instance of one, a scene, or a list of these, at a time in seconds.
    """
    _shown: dict[float, Instances] = field(default_factory=dict[float, Instances], init=False)
    """The last time that `at` was given, seconds, and its instances: a cache of at most one entry."""

    def at(self, time: float) -> Instances:
        """Returns the instances at a time in seconds; repeated calls for the same time return the same objects.

        Raises:
            SceneError: The time is not finite, or the function returns something else than `read` says.
            FormatError: The file cannot be read.
        """
        check_time(time)
        shown = self._shown.get(time)
        if shown is None:
            shown = _instances(self.read(time), time)
            self._shown.clear()
            self._shown[time] = shown
        return shown


def _instances(content: object, time: float) -> Instances:
    """Returns what a function of time returned as instances.

    Raises:
        SceneError: It is not of the types of `Content`; the message names the time.
    """
    items = [content] if isinstance(content, Content) else content
    if not isinstance(items, Iterable):
        items = [content]
    found: list[Instance] = []
    for item in cast("Iterable[object]", items):
        match item:
            case Scene():
                found += (*item.splats, *item.meshes)
            case Gaussians():
                found.append(SplatInstance(item))
            case Mesh():
                found.append(MeshInstance(item))
            case SplatInstance() | MeshInstance():
                found.append(item)
            case _:
                raise SceneError(
                    f"the actor's function returned a {type(item).__name__} at {time:g} s, expected Gaussians, a Mesh, "
                    "an instance of one, a Scene, or a list of these"
                )
    return tuple(found)


Subject = (
    Gaussians
    | GaussianSequence
    | RiggedGaussians
    | Mesh
    | Rig
    | Scene
    | Deforming
    | Callable[[float], Content | Iterable[Content]]
)
"""Types that an actor may show. A `Scene` shows its captures and meshes; a function returns what to show at a time in
seconds.
"""
_KINDS = (Gaussians, GaussianSequence, RiggedGaussians, Mesh, Rig, Scene, Deforming)
_Item = TypeVar("_Item")


@frozen
class Actor:
    """A subject that moves through a scene by keyframes, and may itself play a clip or a sequence of frames.

    Any function of time is a subject, too: ``Actor(dance)``, where ``dance(seconds)`` returns Gaussians, a mesh, an
    instance of one, a scene, or a list of these. It is called once for each frame; only its last result is cached, so
    it may return millions of Gaussians. It should depend on the time alone, so that frames can be rendered in any
    order. Where it returns as many Gaussians as the frame before, in the same order, their normals are carried on.

    The subject is placed by ``world_from_object``, then moved by ``motion``: the pose at a time is
    ``motion.at(time) @ world_from_object``.

    Raises:
        SceneError: A field has the wrong type, a transform is not a similarity (meshes and rigs accept any affine
            transform), a number is out of range, or the clip does not exist.
    """

    subject: Subject
    motion: Keyframes | None = None
    """Keyframed motion through the world, in seconds of the animation; None: the actor stays at ``world_from_object``.
    """
    world_from_object: npt.NDArray[np.float64] | None = None
    """Transform of the subject, shape (4, 4), applied before ``motion``; None: the identity."""
    name: str = field(default="", kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    """Whether the actor casts shadows on the captures of the scene."""
    relight: bool = field(default=True, kw_only=True)
    """Relight the actor's Gaussians by a probe of the scene at the actor's position; False: the Gaussians keep their
    captured colours.
    """
    clip: str | None = field(default=None, kw_only=True)
    """Name of the animation clip of the actor's rig; None: the rig's first clip."""
    loop: bool = field(default=True, kw_only=True)
    """Whether the clip or file sequence starts over at its end; False: its last pose is held. ``motion`` never
    repeats."""
    speed: Annotated[float, Range(0.0)] = field(default=1.0, kw_only=True)
    """Playback speed of the clip or file sequence: its seconds per second of the animation; 0 holds the first pose."""

    def __post_init__(self) -> None:
        subjects = "Gaussians, a GaussianSequence, RiggedGaussians, a Mesh, a Rig, a Scene or a function of time"
        if callable(self.subject):
            object.__setattr__(self, "subject", Deforming(self.subject))
        check_kind("an actor", self.subject, _KINDS, subjects)
        if isinstance(self.subject, Rig) and not self.subject.surfaces:
            raise SceneError("the rig has no meshes to show: bind Gaussians to it by bind_gaussians")
        if self.motion is not None:
            check_kind("motion", self.motion, Keyframes, "Keyframes")
        take_scene_fields(self)
        rig = self.rig
        if self.clip is not None:
            if rig is None:
                raise SceneError(f"clip is {self.clip!r}, but the actor has no rig")
            rig.duration(self.clip)
        matrix = matrix_4x4("world_from_object", self.world_from_object)
        if not isinstance(self.subject, Mesh | Rig):
            check_similarity(matrix[:3, :3])  # reported now rather than at a later frame
        object.__setattr__(self, "world_from_object", matrix)

    @property
    def rig(self) -> Rig | None:
        """Rig of the actor's subject, a `Rig` or `RiggedGaussians`; None for other subjects."""
        if isinstance(self.subject, RiggedGaussians):
            return self.subject.rig
        return self.subject if isinstance(self.subject, Rig) else None

    def at(self, time: float) -> tuple[Instance, ...]:
        """Returns the actor's world-space instances at a time: one per mesh of a rig or object of a scene, else one.

        Args:
            time: Seconds of the animation.

        Raises:
            SceneError: The time is not finite.
            FormatError: A frame cannot be read.
        """
        check_time(time)
        placed = np.asarray(self.world_from_object)
        world = placed if self.motion is None else self.motion.at(time) @ placed
        own = self._own_time(time)
        match self.subject:
            case Scene() as scene:
                return self._placed((*scene.splats, *scene.meshes), world)
            case Deforming() as deforming:
                return self._placed(deforming.at(own), world)
            case Mesh() as mesh:
                return (MeshInstance(mesh, world, name=self.name or mesh.name),)
            case Rig() as rig:
                return tuple(MeshInstance(m, world, name=self.name or m.name) for m in rig.poses(own, self.clip))
            case RiggedGaussians() as rigged:
                gaussians = rigged.at(own, self.clip)
            case GaussianSequence() as sequence:
                gaussians = sequence.at(own)
            case _:
                gaussians = cast("Gaussians", self.subject)
        return (SplatInstance(gaussians, world, name=self.name),)

    def part_names(self, time: float, count: int) -> list[str]:
        """Returns the ``count`` instances' names in the subject; empty ones if its parts are constant."""
        if isinstance(self.subject, Deforming):
            return [part.name for part in self.subject.at(self._own_time(time))]
        return [""] * count

    def _placed(self, instances: tuple[Instance, ...], world: npt.NDArray[np.float64]) -> tuple[Instance, ...]:
        """Returns the instances, named after the actor, with the matrix ``world``, (4, 4), applied after their own."""
        return tuple(replace(i, world_from_object=world @ i.transform, name=self.name or i.name) for i in instances)

    @property
    def own_duration(self) -> float:
        """Duration of one pass of the clip or file sequence at the actor's speed, seconds; 0 without, or at speed 0."""
        return self._length() / self.speed if self.speed > 0.0 else 0.0

    def _length(self) -> float:
        """Returns the duration of the clip or file sequence at speed 1, seconds; 0 if the actor has neither."""
        if isinstance(self.subject, GaussianSequence):
            return self.subject.duration
        rig = self.rig
        return rig.duration(self.clip) if rig is not None and rig.clips else 0.0

    def _own_time(self, time: float) -> float:
        """Returns ``speed`` times the animation's time; for loops, modulo the length of the clip or file sequence."""
        own, length = self.speed * time, self._length()
        return own % length if self.loop and length > 0.0 else own


def _actors(items: Iterable[Actor], name: str = "actors") -> tuple[Actor, ...]:
    return _items(name, items, Actor)


def _cameras(items: Iterable[Camera], name: str = "cameras") -> tuple[Camera, ...]:
    return _items(name, items, Camera)


def _items(name: str, items: Iterable[_Item], kind: type[_Item]) -> tuple[_Item, ...]:
    """Converts a list to a tuple of ``kind`` objects.

    Raises:
        SceneError: An entry is no ``kind``; the message calls the list ``name``.
    """
    taken = tuple(items_of(name, items))
    for item in taken:
        if not isinstance(item, kind):
            raise SceneError(f"{name} holds a {type(item).__name__}, expected {kind.__name__}")
    return cast("tuple[_Item, ...]", taken)


def _materials(items: Iterable[MaterialPath], name: str = "materials") -> tuple[MaterialPath, ...]:
    return _items(name, items, MaterialPath)


@frozen
class Animation:
    """A scene, the actors that move through it, lights and materials that change, and the times of the frames.

    Raises:
        SceneError: A field has the wrong type, or a number is out of range.
    """

    scene: Scene
    """The static part of the animation: captures, meshes and lights that do not move."""
    actors: tuple[Actor, ...] = given(converter=_actors, default=())
    cameras: tuple[Camera, ...] = given(converter=_cameras, default=())
    fps: Annotated[float, Range(0.0, above=True)] = 25.0
    """Frames of the animation per second, above 0."""
    frame_count: Annotated[int, Range(1)] = 1
    """Number of frames to render, 1 to 1,000,000."""
    lighting: AvatarLightingConfig = field(default_factory=AvatarLightingConfig)
    """Settings for relighting the actors and for their shadows on the captures."""
    camera_path: CameraPath | None = None
    """Path of a moving camera, in seconds of the animation; None: the fixed ``cameras`` are used."""
    lights: tuple[MovingLight, ...] = given(converter=moving_lights, default=())
    """Lights and environments that change with time, after those of ``scene``: `lumisplat.lights.LightPath` objects, or
    functions that return the light at a time in seconds."""
    materials: tuple[MaterialPath, ...] = given(converter=_materials, default=())
    """Materials of ``scene`` that change with time."""

    def __post_init__(self) -> None:
        check_kind("scene", self.scene, Scene, "a Scene")
        take_scene_fields(self)
        if self.camera_path is not None:
            check_kind("camera_path", self.camera_path, CameraPath, "a CameraPath")
        count = self.frame_count
        if count > ANIMATION_FRAMES_MAX:
            raise SceneError(
                f"frame_count is {count:,.10g} at {self.fps:g} frames a second, "
                f"expected at most {ANIMATION_FRAMES_MAX:,}: lower the duration, the frames or the fps"
            )

    @property
    def times(self) -> npt.NDArray[np.float64]:
        """Time of each frame, seconds from 0, shape (frame_count,)."""
        return np.arange(self.frame_count) / self.fps

    @property
    def duration(self) -> float:
        """Time at which the last frame ends, ``frame_count / fps``, seconds."""
        return self.frame_count / self.fps

    @property
    def has_moving_content(self) -> bool:
        """Whether anything but the camera may change with time: an actor, a light or a material."""
        return bool(self.actors or self.lights or self.materials)

    def scene_at(self, time: float) -> Scene:
        """Returns the scene without actors at a time: its lights, then the moving lights in their order, and materials.

        Captures and meshes that do not change stay the same objects.

        Args:
            time: Seconds of the animation.

        Raises:
            SceneError: The time is not finite, a function returns no light, or a material refuses a value.
        """
        check_time(time)
        scene = with_materials(self.scene, self.materials, time)
        if not self.lights:
            return scene
        return replace(scene, lights=(*scene.lights, *(light_at(light, time) for light in self.lights)))

    def actors_at(self, time: float) -> list[Instance]:
        """Returns the instances of all actors at a time, in the actors' order; `Actor.at` returns those of one actor.

        Raises:
            SceneError: The time is not finite.
            FormatError: A frame of a sequence cannot be read.
        """
        return [instance for instance, _, _ in self.placed_at(time)]

    def placed_at(self, time: float) -> list[tuple[Instance, Actor, tuple[int, str, int]]]:
        """Returns the instances of `actors_at`, each with its actor and a key that identifies it at all times.

        The key is the actor's number, the part's own name, and its number among parts of that name: parts that come and
        go change no others' keys, unless they share a name.

        Raises:
            SceneError: The time is not finite.
            FormatError: A frame of a sequence cannot be read.
        """
        placed: list[tuple[Instance, Actor, tuple[int, str, int]]] = []
        for number, actor in enumerate(self.actors):
            instances, seen = actor.at(time), Counter[str]()
            for instance, name in zip(instances, actor.part_names(time, len(instances)), strict=True):
                placed.append((instance, actor, (number, name, seen[name])))
                seen[name] += 1
        return placed
