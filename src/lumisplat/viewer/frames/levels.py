"""Captures of fewer Gaussians, for frames of views that move; each is made once, in the background.

Until they are there, thinned captures stand in for them in large scenes: one Gaussian in so many, somewhat larger.
"""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Generator
from dataclasses import dataclass, field, replace
from queue import SimpleQueue

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.thresholds import (
    GAUSSIANS_AT_ONCE,
    LEVEL_BLOCK,
    LEVEL_CAPTURE_MIN,
    LEVEL_FRACTIONS,
    LEVEL_GAUSSIANS_MIN,
    LEVEL_PATIENCE_S,
)

_Rows = npt.NDArray[np.intp]


@dataclass(eq=False)
class _Made:
    """What there is of a capture, by level."""

    levels: dict[int, ls.Gaussians] = field(default_factory=dict[int, ls.Gaussians])
    thinned: dict[int, ls.Gaussians] = field(default_factory=dict[int, ls.Gaussians])
    """What stands in for levels that are not there yet."""
    coarsest: int = 0
    """The highest level that has been asked for."""


class Levels:
    """Makes levels of captures and gives what there is.

    Args:
        on_made: Called when there is a new level, in the thread that made it.
        progress: Told the fraction done of the levels of a capture, 0..1, in that thread.
        is_busy: Whether a view moves: levels are then made with pauses, so that frames have the processor.
    """

    def __init__(
        self,
        on_made: Callable[[], None],
        progress: Callable[[float], None] = lambda fraction: None,
        is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        self._on_made, self._progress, self._is_busy = on_made, progress, is_busy
        self._made: weakref.WeakKeyDictionary[ls.Gaussians, _Made] = weakref.WeakKeyDictionary()
        self._scenes: dict[int, tuple[ls.Scene, ls.Scene]] = {}
        """By level: the last scene that was asked for, and its level."""
        self._wanted: SimpleQueue[weakref.ref[ls.Gaussians] | None] = SimpleQueue()
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._work, name="lumisplat levels", daemon=True)
        self._thread.start()

    def scene(self, scene: ls.Scene, level: int) -> ls.Scene:
        """A scene whose captures have a level, or what stands in for it.

        Args:
            scene: The scene.
            level: Number of `LEVEL_FRACTIONS`; 0: the scene itself.
        """
        coarsest = _coarsest(scene.gaussian_count)
        level = min(level, coarsest)
        if level == 0 or not scene.splats:
            return scene
        held = self._scenes.get(level)
        if held is not None and held[0] is scene:
            return held[1]
        is_large = scene.gaussian_count > GAUSSIANS_AT_ONCE
        chosen = [self._level(instance.gaussians, level, coarsest, thins=is_large) for instance in scene.splats]
        is_whole = all(level_there for _, level_there in chosen)
        splats = [replace(i, gaussians=g) for i, (g, _) in zip(scene.splats, chosen, strict=True)]
        coarse = replace(scene, splats=splats)
        if is_whole:
            self._scenes[level] = scene, coarse
        return coarse

    def close(self) -> None:
        """Ends the thread, after the block that it is at."""
        self._closing.set()
        self._wanted.put(None)
        self._thread.join()

    def _level(self, gaussians: ls.Gaussians, level: int, coarsest: int, *, thins: bool) -> tuple[ls.Gaussians, bool]:
        """A level of a capture or what stands in for it, and whether it is the one that was asked for."""
        while level and gaussians.count * LEVEL_FRACTIONS[level] < LEVEL_CAPTURE_MIN:
            level -= 1
        if level == 0:
            return gaussians, True
        made = self._made.setdefault(gaussians, _Made())
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
        """Makes the levels of a capture that have been asked for, and that it has not; block by block."""
        made = self._made[gaussians]
        numbers = [number for number in range(1, made.coarsest + 1) if number not in made.levels]
        self._progress(0.0)
        self._give_way(LEVEL_PATIENCE_S)
        parts: dict[int, list[ls.Gaussians]] = {number: [] for number in numbers}
        done, pause = 0, 0.0
        for rows in _blocks(gaussians.means, np.arange(gaussians.count)):
            self._progress(done / gaussians.count)
            self._give_way(pause)
            if self._closing.is_set():
                return
            begun = time.monotonic()
            part = gaussians.subset(rows)
            for number in numbers:
                part = ls.decimate(part, max(1, round(rows.size * LEVEL_FRACTIONS[number])))
                parts[number].append(part)
            done, pause = done + rows.size, 2.0 * (time.monotonic() - begun)
        made.levels |= {number: ls.merge(parts[number]) for number in numbers}
        made.thinned.clear()
        self._progress(1.0)
        self._on_made()

    def _give_way(self, longest: float) -> None:
        """Waits while views move, but no longer than so many seconds."""
        until = time.monotonic() + longest
        while self._is_busy() and time.monotonic() < until and not self._closing.wait(0.02):
            pass


def thinned(gaussians: ls.Gaussians, fraction: float) -> ls.Gaussians:
    """One Gaussian in so many, larger by the cube root of that number.

    That is between what fills surfaces, its square root, and what keeps their outlines: the picture is nearest there to
    that of all of them.
    """
    step = round(1.0 / fraction)
    kept = gaussians.subset(np.arange(min(step // 2, gaussians.count - 1), gaussians.count, step))
    return replace(kept, scales=kept.scales * np.float32(step ** (1.0 / 3.0)))


def _coarsest(count: int) -> int:
    """The highest level of scenes of so many Gaussians."""
    return sum(round(count * fraction) >= LEVEL_GAUSSIANS_MIN for fraction in LEVEL_FRACTIONS[1:])


def _blocks(means: npt.NDArray[np.float32], rows: _Rows) -> Generator[_Rows]:
    """Rows of Gaussians in boxes of space of about as many each, `LEVEL_BLOCK` at most."""
    if rows.size <= LEVEL_BLOCK:
        yield rows
        return
    inside = means[rows]
    along = inside[:, int(np.argmax(np.ptp(inside, axis=0)))]
    half = rows.size // 2
    order = np.argpartition(along, half)
    yield from _blocks(means, rows[order[:half]])
    yield from _blocks(means, rows[order[half:]])
