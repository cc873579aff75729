"""The scene of a frame: at a time, with fewer Gaussians if it has to be quick, and with actors in the light around."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import lumisplat as ls
from lumisplat.viewer.frames.levels import Levels
from lumisplat.viewer.frames.renderers import Progress


@dataclass(eq=False)
class _Stage:
    """What stands still, and what lights actors in it."""

    scene: ls.Scene
    lighting: ls.AvatarLightingConfig
    background: tuple[float, float, float]
    lighters: dict[int, tuple[ls.Scene, ls.AvatarLighter]] = field(default_factory=lambda: {})
    """By level: its scene, and the lighter of that."""
    has_failed: bool = False
    """Whether no light could be found; actors then keep their own."""

    def is_of(self, scene: ls.Scene, lighting: ls.AvatarLightingConfig, background: tuple[float, float, float]) -> bool:
        """Whether this is what stands still, and how it is lit."""
        return (
            (self.lighting, self.background) == (lighting, background)
            and _same(self.scene.splats, scene.splats)
            and _same(self.scene.meshes, scene.meshes)
            and _same(self.scene.lights, scene.lights)
        )


class ShownScenes:
    """Makes the scenes of frames.

    Actors cast their shadows on captures and take on the light of their place, as ``lumisplat animate`` has them.

    Args:
        levels: Captures of fewer Gaussians.
        device: As of `lumisplat.create_renderer`.
        progress: Told when something takes long.
        report: Told why actors cannot be lit.
    """

    def __init__(self, levels: Levels, device: str, progress: Progress, report: Callable[[str], None]) -> None:
        self._levels, self._device, self._progress, self._report = levels, device, progress, report
        self._animation: tuple[ls.SceneDocument, ls.Animation | None] | None = None
        self._stage: _Stage | None = None
        self._last: dict[int, tuple[tuple[object, ...], ls.Scene]] = {}
        """By level: what the last scene was made of, and that scene: the same objects are not uploaded again."""

    def of(
        self, document: ls.SceneDocument, config: ls.RenderConfig, time: float, level: int, *, waits: bool
    ) -> ls.Scene:
        """The scene of a frame.

        Args:
            document: What is shown.
            config: Settings of the frame, for its background.
            time: Of the animation, seconds.
            level: Number of `LEVEL_FRACTIONS`; 0: all Gaussians.
            waits: Whether there is time to prepare the light of actors, where something else has changed; without,
                they are shown unlit until there is.

        Raises:
            FormatError: A frame of an actor cannot be read.
            DeviceError: The device is out of memory.
        """
        animation = self._animation_of(document)
        if animation is None or not animation.actors:
            return self._levels.scene(document.scene(time), level)
        stage = self._stage_of(animation, config.background or (0.0, 0.0, 0.0), waits=waits)
        still = self._levels.scene(animation.scene, level)
        key = (document, time, stage, still)
        held = self._last.get(level)
        if held is None or held[0] != key:
            held = key, self._with_actors(animation, stage, still, time, level)
            self._last[level] = held
        return held[1]

    def _with_actors(
        self, animation: ls.Animation, stage: _Stage | None, still: ls.Scene, time: float, level: int
    ) -> ls.Scene:
        """A scene with the actors of a time, lit if there is a stage."""
        placed = [(instance, actor) for actor in animation.actors for instance in actor.at(time)]
        instances = [instance for instance, _ in placed]
        if stage is not None:
            try:
                return self._lighter_of(animation, stage, still, level).light(
                    instances,
                    casts_shadow=[actor.casts_shadow for _, actor in placed],
                    relit=[actor.relight for _, actor in placed],
                )
            except ls.SceneError as error:
                stage.has_failed = True
                self._report(f"actors keep their own light: {error}")
        splats = [instance for instance in instances if isinstance(instance, ls.SplatInstance)]
        meshes = [instance for instance in instances if isinstance(instance, ls.MeshInstance)]
        return replace(still, splats=(*still.splats, *splats), meshes=(*still.meshes, *meshes))

    def _lighter_of(self, animation: ls.Animation, stage: _Stage, still: ls.Scene, level: int) -> ls.AvatarLighter:
        """What lights actors among captures of a level; lights are found once, around the actors of the first frame."""
        held = stage.lighters.get(level)
        if held is not None and held[0] is still:
            return held[1]
        lights = None
        if level > 0:
            finest = self._lighter_of(animation, stage, stage.scene, 0)
            lights = finest.lights if finest.estimate is not None or finest.sun is not None else None
        lighter = ls.AvatarLighter(
            still,
            lights,
            stage.lighting,
            background=stage.background,
            device=self._device,
            progress=self._progress,
        )
        if level == 0 and lighter.lights is None:
            lighter.light([instance for actor in animation.actors for instance in actor.at(0.0)])
        stage.lighters[level] = still, lighter
        return lighter

    def _animation_of(self, document: ls.SceneDocument) -> ls.Animation | None:
        if self._animation is None or self._animation[0] is not document:
            self._animation = document, document.animation
        return self._animation[1]

    def _stage_of(
        self, animation: ls.Animation, background: tuple[float, float, float], *, waits: bool
    ) -> _Stage | None:
        """The present stage, or a new one where there is time for it; None: actors are shown unlit."""
        lighting, scene = animation.lighting, animation.scene
        if not scene.splats or not (lighting.shadows or lighting.relight):
            return None
        if self._stage is None or not self._stage.is_of(scene, lighting, background):
            if not waits:
                return None
            self._stage = _Stage(scene, lighting, background)
        return None if self._stage.has_failed else self._stage


def _same(first: Sequence[object], second: Sequence[object]) -> bool:
    """Whether two rows hold the same objects."""
    return len(first) == len(second) and all(a is b for a, b in zip(first, second, strict=True))
