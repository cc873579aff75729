"""Actors that move through a scene: what is there at each time of an animation."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from lumisplat.config import AvatarLightingConfig
from lumisplat.config.checks import is_number
from lumisplat.constants import ANIMATION_FRAMES_MAX
from lumisplat.errors import SceneError
from lumisplat.math.arrays import matrix_4x4
from lumisplat.scene.animation.bound_gaussians import RiggedGaussians
from lumisplat.scene.animation.keyframes import Keyframes, check_time
from lumisplat.scene.animation.rig import Rig
from lumisplat.scene.animation.sequence import GaussianSequence
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.mesh import Mesh
from lumisplat.scene.scene import MeshInstance, Scene, SplatInstance, refuse_dissimilar

Subject = Gaussians | GaussianSequence | RiggedGaussians | Mesh | Rig | Scene
"""What an actor may be; of a `Scene`, its captures and meshes."""
Instance = SplatInstance | MeshInstance


@dataclass(frozen=True, slots=True, eq=False)
class Actor:
    """Something that moves through a scene, by its own clip or frames and by keyframes.

    A point of it is placed by ``world_from_object``, then carried by ``motion``: the pose at a time is
    ``motion.at(time) @ world_from_object``.

    Raises:
        SceneError: The subject is none, a transform is no similarity (a mesh takes any affine one), a number is out of
            its range, or there is no such clip.
    """

    subject: Subject
    motion: Keyframes | None = None
    """Carries the actor through the world, at the animation's times; None: it stays where it is placed."""
    world_from_object: npt.NDArray[np.float64] | None = None
    """Where it is placed, shape (4, 4); None: the identity."""
    name: str = field(default="", kw_only=True)
    casts_shadow: bool = field(default=True, kw_only=True)
    """It darkens what it stands before."""
    relight: bool = field(default=True, kw_only=True)
    """It takes the light of its place, instead of the colours that it has."""
    clip: str | None = field(default=None, kw_only=True)
    """Of a rig: which; None: the first."""
    loop: bool = field(default=True, kw_only=True)
    """Clip or frames begin again at their end; without, the last pose holds. Keyframes never repeat."""
    speed: float = field(default=1.0, kw_only=True)
    """Seconds of the clip or frames in a second of the animation, at least 0."""

    def __post_init__(self) -> None:
        if not isinstance(self.subject, Subject):
            raise SceneError(
                f"an actor is a {type(self.subject).__name__}, expected Gaussians, a GaussianSequence, "
                "RiggedGaussians, a Mesh, a Rig or a Scene"
            )
        if self.motion is not None and not isinstance(self.motion, Keyframes):
            raise SceneError(f"motion is a {type(self.motion).__name__}, expected Keyframes")
        for name in ("casts_shadow", "relight", "loop"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise SceneError(f"{name} is {getattr(self, name)}, expected True or False")
        if not is_number(self.speed) or not 0.0 <= self.speed < np.inf:
            raise SceneError(f"speed is {self.speed}, expected a number, at least 0")
        rig = self.rig
        if self.clip is not None:
            if rig is None:
                raise SceneError(f"clip is {self.clip!r}, but the actor has no rig")
            rig.duration(self.clip)
        matrix = matrix_4x4("world_from_object", self.world_from_object)
        if not isinstance(self.subject, Mesh | Rig):
            refuse_dissimilar(matrix[:3, :3])  # now, not at some frame
        object.__setattr__(self, "world_from_object", matrix)

    @property
    def rig(self) -> Rig | None:
        """The rig that poses it, if there is one."""
        if isinstance(self.subject, RiggedGaussians):
            return self.subject.rig
        return self.subject if isinstance(self.subject, Rig) else None

    def at(self, time: float) -> tuple[Instance, ...]:
        """What the actor is at a time of the animation: one instance, of a rig of several meshes one each.

        Args:
            time: Seconds.

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
                return tuple(
                    replace(i, world_from_object=world @ i.transform, name=self.name or i.name)
                    for i in (*scene.splats, *scene.meshes)
                )
            case Mesh() as mesh:
                return (MeshInstance(mesh, world, name=self.name or mesh.name),)
            case Rig() as rig:
                return tuple(MeshInstance(m, world, name=self.name or m.name) for m in rig.poses(own, self.clip))
            case RiggedGaussians() as rigged:
                gaussians = rigged.at(own, self.clip)
            case GaussianSequence() as sequence:
                gaussians = sequence.at(own)
            case Gaussians() as gaussians:
                pass
        return (SplatInstance(gaussians, world, name=self.name),)

    @property
    def own_duration(self) -> float:
        """How long its clip or its frames take once, at its speed, seconds; 0 without any."""
        return self._length() / self.speed if self.speed > 0.0 else 0.0

    def _length(self) -> float:
        """Of the clip or the frames, in their own seconds."""
        if isinstance(self.subject, GaussianSequence):
            return self.subject.duration
        rig = self.rig
        return rig.duration(self.clip) if rig is not None and rig.clips else 0.0

    def _own_time(self, time: float) -> float:
        """Time of the clip or of the frames."""
        own, length = self.speed * time, self._length()
        return own % length if self.loop and length > 0.0 else own


@dataclass(frozen=True, slots=True, eq=False)
class Animation:
    """A scene, the actors that move through it, and when they are looked at.

    Raises:
        SceneError: A part is none, or a number is out of its range.
    """

    scene: Scene
    """What does not move: captures, meshes and lights."""
    actors: tuple[Actor, ...] = ()
    cameras: tuple[Camera, ...] = ()
    fps: float = 25.0
    """Frames a second, above 0."""
    frame_count: int = 1
    """Number of frames, 1 to 1,000,000."""
    lighting: AvatarLightingConfig = field(default_factory=AvatarLightingConfig)
    """How actors take light and cast shadows."""

    def __post_init__(self) -> None:
        if not isinstance(self.scene, Scene):
            raise SceneError(f"scene is a {type(self.scene).__name__}, expected a Scene")
        for name, kind in (("actors", Actor), ("cameras", Camera)):
            items = tuple(getattr(self, name))
            for item in items:
                if not isinstance(item, kind):
                    raise SceneError(f"{name} holds a {type(item).__name__}, expected {kind.__name__}")
            object.__setattr__(self, name, items)
        if not isinstance(self.lighting, AvatarLightingConfig):
            raise SceneError(f"lighting is a {type(self.lighting).__name__}, expected an AvatarLightingConfig")
        if not is_number(self.fps) or not 0.0 < self.fps < np.inf:
            raise SceneError(f"fps is {self.fps}, expected a positive number")
        count = self.frame_count
        if not isinstance(count, int | np.integer) or isinstance(count, bool) or count < 1:
            raise SceneError(f"frame_count is {count}, expected a whole number, at least 1")
        if count > ANIMATION_FRAMES_MAX:
            raise SceneError(
                f"frame_count is {count:,.10g} at {self.fps:g} frames a second, "
                f"expected at most {ANIMATION_FRAMES_MAX:,}: lower duration or frames, or fps"
            )

    @property
    def times(self) -> npt.NDArray[np.float64]:
        """Time of each frame, seconds from 0, shape (frame_count,)."""
        return np.arange(self.frame_count) / self.fps

    @property
    def duration(self) -> float:
        """Until the last frame ends, seconds."""
        return self.frame_count / self.fps

    def actors_at(self, time: float) -> list[Instance]:
        """All actors at a time, in their order; `Actor.at` gives those of one, whose settings then are known.

        Raises:
            SceneError: The time is not finite.
            FormatError: A frame of a sequence cannot be read.
        """
        return [instance for actor in self.actors for instance in actor.at(time)]
