"""Captures of fewer Gaussians, for frames of views that move; each is made once, in the background."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable
from dataclasses import replace
from queue import SimpleQueue

import lumisplat as ls
from lumisplat.viewer.thresholds import LEVEL_FRACTIONS, LEVEL_GAUSSIANS_MIN


class Levels:
    """Makes levels of captures, finest first, and gives what there is.

    Args:
        on_made: Called when there is a new level, in the thread that made it.
    """

    def __init__(self, on_made: Callable[[], None]) -> None:
        self._on_made = on_made
        self._made: weakref.WeakKeyDictionary[ls.Gaussians, dict[int, ls.Gaussians]] = weakref.WeakKeyDictionary()
        self._scenes: dict[int, tuple[ls.Scene, ls.Scene]] = {}
        """By level: the last scene that was asked for, and its level."""
        self._wanted: SimpleQueue[weakref.ref[ls.Gaussians] | None] = SimpleQueue()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="lumisplat levels", daemon=True)
        self._thread.start()

    def scene(self, scene: ls.Scene, level: int) -> ls.Scene:
        """A scene whose captures have a level, or the finest coarser than all that there is of it.

        Args:
            scene: The scene.
            level: Number of `LEVEL_FRACTIONS`; 0: the scene itself.
        """
        if level == 0 or not scene.splats:
            return scene
        held = self._scenes.get(level)
        if held is not None and held[0] is scene:
            return held[1]
        chosen = [self._level(instance.gaussians, level) for instance in scene.splats]
        is_whole = all(level_there for _, level_there in chosen)
        splats = [replace(i, gaussians=g) for i, (g, _) in zip(scene.splats, chosen, strict=True)]
        coarse = replace(scene, splats=splats)
        if is_whole:
            self._scenes[level] = scene, coarse
        return coarse

    def close(self) -> None:
        """Ends the thread, after the level that it is making."""
        self._closing = True
        self._wanted.put(None)
        self._thread.join()

    def _level(self, gaussians: ls.Gaussians, level: int) -> tuple[ls.Gaussians, bool]:
        """A level of a capture, or the next finer one that there is, and whether it is the one that was asked for."""
        if round(gaussians.count * LEVEL_FRACTIONS[level]) < LEVEL_GAUSSIANS_MIN:
            return (gaussians, True) if level == 1 else self._level(gaussians, level - 1)
        if gaussians not in self._made:
            self._made[gaussians] = {}
            self._wanted.put(weakref.ref(gaussians))
        made = self._made[gaussians]
        finest = max((number for number in made if number <= level), default=0)
        return (made[finest] if finest else gaussians), finest == level

    def _work(self) -> None:
        while (wanted := self._wanted.get()) is not None:
            for level, fraction in enumerate(LEVEL_FRACTIONS[1:], start=1):
                gaussians = wanted()
                count = 0 if gaussians is None else round(gaussians.count * fraction)
                if self._closing or gaussians is None or count < LEVEL_GAUSSIANS_MIN:
                    break
                self._made[gaussians][level] = ls.decimate(self._made[gaussians].get(level - 1, gaussians), count)
                del gaussians
                self._on_made()
