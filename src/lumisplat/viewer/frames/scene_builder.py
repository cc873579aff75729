"""Builds the scene that a frame renders: at an animation time and level of detail, with lit actors.

A background thread reduces each capture to its levels of detail once.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace
from queue import SimpleQueue

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.thresholds import (
    LEVEL_BLOCK,
    LEVEL_CAPTURE_MIN,
    LEVEL_DELAY_S,
    LEVEL_FRACTIONS,
    LEVEL_GAUSSIANS_MIN,
    MOVING_GAUSSIANS_MAX,
)

Progress = Callable[[str, float], None]
"""Function that receives a label and the completed fraction, 0 to 1."""


@dataclass(eq=False)
class _ActorLighting:
    """Cache of the objects that light actors by the captures around them; valid for one scene, lighting, background."""

    scene: ls.Scene
    lighting: ls.config.AvatarLightingConfig
    background: tuple[float, float, float]
    lighters: dict[int, tuple[ls.Scene, ls.AvatarLighter]] = field(default_factory=lambda: {})
    """Static scene at a level of detail and the `AvatarLighter` made for it, by level."""
    has_failed: bool = False
    """True if estimating the scene's lights failed; actors are then shown in their captured colours, unlit."""

    def matches(
        self, scene: ls.Scene, lighting: ls.config.AvatarLightingConfig, background: tuple[float, float, float]
    ) -> bool:
        """True if this object was made for the given static scene, lighting settings and background."""
        return (
            (self.lighting, self.background) == (lighting, background)
            and _are_same_objects(self.scene.splats, scene.splats)
            and _are_same_objects(self.scene.meshes, scene.meshes)
            and _are_same_objects(self.scene.lights, scene.lights)
        )


class SceneBuilder:
    """Builds the scene of each frame from a scene document.

    Actors cast shadows on captures and receive the light at their position, as in ``lumisplat animate``.

    Args:
        levels: Levels of detail of captures.
        device: Device, as in `lumisplat.create_renderer`.
        progress: Receives progress messages of long steps.
        report: Receives a message that says why actors cannot be lit.
    """

    def __init__(self, levels: Levels, device: str, progress: Progress, report: Callable[[str], None]) -> None:
        self._levels, self._device, self._progress, self._report = levels, device, progress, report
        self._animation: tuple[ls.io.SceneDocument, ls.Animation | None] | None = None
        self._stage: _ActorLighting | None = None
        self._last: dict[int, tuple[tuple[object, ...], ls.Scene]] = {}
        """Arguments and result of the last call of `of`, by level of detail. Equal arguments get the same scene
        object, which the renderer does not upload again."""

    def of(
        self, document: ls.io.SceneDocument, config: ls.RenderConfig, time: float, level: int, *, waits: bool
    ) -> ls.Scene:
        """Returns the scene that a frame renders: static objects at a level of detail, and actors at a time.

        Args:
            document: Document to show.
            config: Render settings of the frame, for its background.
            time: Animation time, seconds.
            level: Level of detail, an index into `LEVEL_FRACTIONS`; 0 has all Gaussians.
            waits: True prepares the lighting of actors after a change, which takes time. False shows actors unlit until
                the lighting is prepared.

        Raises:
            FormatError: A frame of an actor cannot be read.
            DeviceError: The device is out of memory.
        """
        animation = self._animation_of(document)
        if animation is None or not animation.actors:
            return self._levels.scene(document.scene(time), level)
        stage = self._actor_lighting_of(animation, config.background or (0.0, 0.0, 0.0), waits=waits)
        still = self._levels.scene(animation.scene, level)
        key = (document, time, stage, still)
        held = self._last.get(level)
        if held is None or held[0] != key:
            held = key, self._with_actors(animation, stage, still, time, level)
            self._last[level] = held
        return held[1]

    def _with_actors(
        self, animation: ls.Animation, stage: _ActorLighting | None, still: ls.Scene, time: float, level: int
    ) -> ls.Scene:
        """Returns a static scene with the actors added at a time in seconds, lit by ``stage`` or, if None, unlit."""
        placed = animation.placed_at(time)
        instances = [instance for instance, _, _ in placed]
        if stage is not None:
            try:
                lighter = self._avatar_lighter(animation, stage, still, level)
                lighter.update(replace(animation, scene=still).scene_at(time))
                return lighter.light(
                    instances,
                    casts_shadow=[actor.casts_shadow for _, actor, _ in placed],
                    relit=[actor.relight for _, actor, _ in placed],
                    keys=[key for _, _, key in placed],
                )
            except ls.SceneError as error:
                stage.has_failed = True
                self._report(f"actors keep their captured colours: {error}")
        splats = [instance for instance in instances if isinstance(instance, ls.SplatInstance)]
        meshes = [instance for instance in instances if isinstance(instance, ls.MeshInstance)]
        still = replace(animation, scene=still).scene_at(time)
        return replace(still, splats=(*still.splats, *splats), meshes=(*still.meshes, *meshes))

    def _avatar_lighter(
        self, animation: ls.Animation, stage: _ActorLighting, still: ls.Scene, level: int
    ) -> ls.AvatarLighter:
        """Returns the actors' lighter for a level of detail; levels > 0 use the lights estimated at full detail.

        Args:
            animation: Actors, and the lights of the scene if it has any.
            stage: Cache of lighters.
            still: Static scene at the level of detail.
            level: Level of detail; 0 is full detail, at which lights are estimated from frame 0.
        """
        held = stage.lighters.get(level)
        if held is not None and held[0] is still:
            return held[1]
        lights = None
        if level > 0:
            finest = self._avatar_lighter(animation, stage, stage.scene, 0)
            lights = finest.lights if finest.estimate is not None or finest.sun is not None else None
        lighter = ls.AvatarLighter(
            replace(animation, scene=still).scene_at(0.0),
            lights,
            stage.lighting,
            background=stage.background,
            device=self._device,
            progress=self._progress,
        )
        if level == 0:
            # Lights, exposures and normals are those of frame 0, whatever is shown first.
            first = animation.placed_at(0.0)
            lighter.light([instance for instance, _, _ in first], keys=[key for _, _, key in first])
        stage.lighters[level] = still, lighter
        return lighter

    def _animation_of(self, document: ls.io.SceneDocument) -> ls.Animation | None:
        if self._animation is None or self._animation[0] is not document:
            self._animation = document, document.animation
        return self._animation[1]

    def _actor_lighting_of(
        self, animation: ls.Animation, background: tuple[float, float, float], *, waits: bool
    ) -> _ActorLighting | None:
        """Returns the cached actor lighting if it is still valid; None means that actors are shown unlit.

        Args:
            animation: Scene, and the settings of actor lighting.
            background: Linear RGB of the background.
            waits: True replaces a cache that is out of date, which takes time; False returns None for it.
        """
        lighting, scene = animation.lighting, animation.scene
        if not scene.splats or not (lighting.shadows or lighting.relight):
            return None
        if self._stage is None or not self._stage.matches(scene, lighting, background):
            if not waits:
                return None
            self._stage = _ActorLighting(scene, lighting, background)
        return None if self._stage.has_failed else self._stage


def _are_same_objects(first: Sequence[object], second: Sequence[object]) -> bool:
    """True if two sequences have the same length and hold identical objects (``is``) in the same order."""
    return len(first) == len(second) and all(a is b for a, b in zip(first, second, strict=True))


_Indices = npt.NDArray[np.intp]


@dataclass(eq=False)
class _CaptureLevels:
    """Reduced versions of one capture that have been built so far, by level of detail."""

    levels: dict[int, ls.Gaussians] = field(default_factory=dict[int, ls.Gaussians])
    thinned: dict[int, ls.Gaussians] = field(default_factory=dict[int, ls.Gaussians])
    """Every N-th Gaussian of the capture, by level of detail; shown until the merged level has been built."""
    coarsest: int = 0
    """Largest level number that scenes with this capture need; levels 1 to this one are built."""


class Levels:
    """Builds reduced versions of captures (levels of detail) in a background thread.

    Args:
        on_made: Called in the background thread when the levels of a capture are ready.
        progress: Called in the background thread with the completed fraction of a capture's levels, 0 to 1.
        is_busy: Returns True while a view moves; the thread then pauses, so that frames get the processor.
    """

    def __init__(
        self,
        on_made: Callable[[], None],
        progress: Callable[[float], None] = lambda fraction: None,
        is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        self._on_made, self._progress, self._is_busy = on_made, progress, is_busy
        self._made: weakref.WeakKeyDictionary[ls.Gaussians, _CaptureLevels] = weakref.WeakKeyDictionary()
        self._scenes: dict[int, tuple[ls.Scene, ls.Scene]] = {}
        """Argument and result of the last call of `scene` for which all captures had the level, by level."""
        self._wanted: SimpleQueue[weakref.ref[ls.Gaussians] | None] = SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="lumisplat levels", daemon=True)
        self._thread.start()

    def scene(self, scene: ls.Scene, level: int) -> ls.Scene:
        """Returns a scene with its captures reduced to a level of detail; requests levels that do not exist yet.

        Until a level exists, a scene of more than `MOVING_GAUSSIANS_MAX` Gaussians is thinned; a smaller one is not
        reduced.

        Args:
            scene: Scene with all Gaussians.
            level: Level of detail, an index into `LEVEL_FRACTIONS`; 0 returns the scene itself.
        """
        coarsest = _coarsest(scene.gaussian_count)
        level = min(level, coarsest)
        if level == 0 or not scene.splats:
            return scene
        held = self._scenes.get(level)
        if held is not None and held[0] is scene:
            return held[1]
        is_large = scene.gaussian_count > MOVING_GAUSSIANS_MAX
        chosen = [self._level(instance.gaussians, level, coarsest, thins=is_large) for instance in scene.splats]
        is_whole = all(level_there for _, level_there in chosen)
        splats = [replace(i, gaussians=g) for i, (g, _) in zip(scene.splats, chosen, strict=True)]
        coarse = replace(scene, splats=splats)
        if is_whole:
            self._scenes[level] = scene, coarse
        return coarse

    def close(self) -> None:
        """Ends the thread once the block of Gaussians that it is merging is done."""
        self._closing.set()
        self._wanted.put(None)
        self._thread.join()

    def _level(self, gaussians: ls.Gaussians, level: int, coarsest: int, *, thins: bool) -> tuple[ls.Gaussians, bool]:
        """Returns a capture at a level of detail, and True; or a stand-in, and False, while the level is being built.

        Args:
            gaussians: The capture with all Gaussians.
            level: Level of detail; lowered until the level has at least `LEVEL_CAPTURE_MIN` Gaussians.
            coarsest: Largest level number to build for this capture.
            thins: True makes every N-th Gaussian the stand-in; False returns the whole capture instead.
        """
        while level and gaussians.count * LEVEL_FRACTIONS[level] < LEVEL_CAPTURE_MIN:
            level -= 1
        if level == 0:
            return gaussians, True
        made = self._made.setdefault(gaussians, _CaptureLevels())
        if made.coarsest < coarsest:
            made.coarsest = coarsest
            self._wanted.put(weakref.ref(gaussians))
        if level in made.levels:
            return made.levels[level], True
        if not thins:
            return gaussians, False
        if level not in made.thinned:
            made.thinned[level] = thinned(gaussians, LEVEL_FRACTIONS[level])
        return made.thinned[level], False

    def _work(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            gaussians = wanted()
            if gaussians is not None and not self._closing.is_set():
                self._make(gaussians)
            del gaussians

    def _make(self, gaussians: ls.Gaussians) -> None:
        """Builds the missing levels of a capture by merging neighbours, block by block; pauses while views move."""
        made = self._made[gaussians]
        numbers = [number for number in range(1, made.coarsest + 1) if number not in made.levels]
        self._progress(0.0)
        self._pause_while_busy(LEVEL_DELAY_S)
        parts: dict[int, list[ls.Gaussians]] = {number: [] for number in numbers}
        done, pause = 0, 0.0
        for rows in _blocks(gaussians.means, np.arange(gaussians.count)):
            self._progress(done / gaussians.count)
            self._pause_while_busy(pause)
            if self._closing.is_set():
                return
            begun = time.monotonic()
            part = gaussians.subset(rows)
            for number in numbers:
                part = ls.editing.decimate(part, max(1, round(rows.size * LEVEL_FRACTIONS[number])))
                parts[number].append(part)
            done, pause = done + rows.size, 2.0 * (time.monotonic() - begun)
        made.levels |= {number: ls.merge(parts[number]) for number in numbers}
        made.thinned.clear()
        self._progress(1.0)
        self._on_made()

    def _pause_while_busy(self, longest: float) -> None:
        """Waits until no view moves, at most ``longest`` seconds."""
        until = time.monotonic() + longest
        while self._is_busy() and time.monotonic() < until and not self._closing.wait(0.02):
            pass


def thinned(gaussians: ls.Gaussians, fraction: float) -> ls.Gaussians:
    """Returns every N-th Gaussian of a capture, N = ``1 / fraction``, with scales multiplied by the cube root of N.

    The square root would preserve covered area, and no scaling would preserve outlines. The cube root is between them
    and gives the image closest to that of all Gaussians.
    """
    step = round(1.0 / fraction)
    remaining = gaussians.subset(np.arange(min(step // 2, gaussians.count - 1), gaussians.count, step))
    return replace(remaining, scales=remaining.scales * np.float32(step ** (1.0 / 3.0)))


def _coarsest(count: int) -> int:
    """Returns the largest level number for which ``count`` Gaussians are reduced to at least `LEVEL_GAUSSIANS_MIN`."""
    return sum(round(count * fraction) >= LEVEL_GAUSSIANS_MIN for fraction in LEVEL_FRACTIONS[1:])


def _blocks(means: npt.NDArray[np.float32], rows: _Indices) -> Generator[_Indices]:
    """Yields the indices of a capture's Gaussians in k-d tree boxes of neighbours, at most `LEVEL_BLOCK` in each."""
    if rows.size <= LEVEL_BLOCK:
        yield rows
        return
    inside = means[rows]
    along = inside[:, int(np.argmax(np.ptp(inside, axis=0)))]
    half = rows.size // 2
    order = np.argpartition(along, half)
    yield from _blocks(means, rows[order[:half]])
    yield from _blocks(means, rows[order[half:]])
