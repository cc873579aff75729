"""What is shown and edited: one state for all pages, with undo, and which settings and views have an effect on it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt

import lumisplat as ls
from lumisplat.viewer.scene_extent import BoxCache, Extent
from lumisplat.viewer.thresholds import BUDGETS_MS, HEIGHTS, MERGE_S, UNDO_BYTES_MAX, UNDO_MAX
from lumisplat.viewer.words import page_words

_SORTED = "Projection unscented goes with strategy sorted alone."
_ISO = "Projection unscented goes with surface iso alone."
_UNSCENTED = "Unscented goes with the pipelines raster and hybrid, strategy sorted and surface iso alone."
_BOUNCE_VIEWS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy")
"""Views of light that pipelines have in which it bounces."""
_REALTIME_VIEWS = ("motion", "history", "probes", "cache", "cache_cells")
"""Views of what frames in real time keep for the next ones."""
_LIT_VIEWS = ("shadow", "emission", *_BOUNCE_VIEWS, *_REALTIME_VIEWS)


def available_views(config: ls.RenderConfig, *, lit: bool) -> tuple[str, ...]:
    """Returns what pages may show: ``color``, and those of `lumisplat.Frame.VIEWS` that such frames have.

    Args:
        config: The settings.
        lit: Whether frames are lit.
    """
    lacking: set[str] = set()
    if not lit:
        lacking.update(_LIT_VIEWS)
    elif not config.pipeline.bounces_light:
        lacking.update(_BOUNCE_VIEWS)
    if config.pipeline.is_sequence:
        lacking.add("shadow")
    else:
        lacking.update(_REALTIME_VIEWS)
    return ("color", *(view for view in ls.Frame.VIEWS if view not in lacking))


def unused_settings(config: ls.RenderConfig, *, lit: bool) -> dict[str, str]:
    """Returns the settings, and groups of settings, without an effect on frames, each with what would give it one.

    Args:
        config: The settings.
        lit: Whether frames are lit.
    """
    return config.unused_settings(lit=lit) | _excluded(config)


def _excluded(config: ls.RenderConfig) -> dict[str, str]:
    """Returns the settings whose other choices would be refused beside the rest, each with what excludes them."""
    raster, excluded = config.raster, dict[str, str]()
    is_sorted, is_iso = (
        raster.strategy is ls.config.RasterStrategy.SORTED,
        raster.surface is ls.config.GaussianSurface.ISO,
    )
    if raster.projection is ls.config.Projection.UNSCENTED:
        excluded |= {"raster.strategy": _SORTED} if is_sorted else {}
        excluded |= {"raster.surface": _ISO} if is_iso else {}
    elif config.pipeline.is_sequence or not is_sorted or not is_iso:
        excluded["raster.projection"] = _UNSCENTED
    return excluded


@dataclass(frozen=True)
class State:
    """All that can be undone."""

    document: ls.io.SceneDocument = field(default_factory=lambda: ls.io.SceneDocument.of(ls.Scene()))
    config: ls.RenderConfig = field(default_factory=ls.RenderConfig)
    exposure: float = 0.0
    """Stops, of lit frames."""


VIEWS = ("color", *ls.Frame.VIEWS)
"""What pages may show of frames."""


@dataclass(frozen=True)
class Options:
    """How the state is shown; nothing of it is part of what is made, or undone."""

    height: int = 720
    """Rows of frames at rest."""
    budget_ms: float = 40.0
    """What a frame of a view that moves may take."""
    view: str = "color"
    """Or one of `lumisplat.Frame.VIEWS`."""
    time: float = 0.0
    """Of the animation, seconds."""
    outlines: bool = True
    """Whether lines show where lights are, and what is selected."""
    grid: bool = False
    """Whether lines on the ground show how large the scene is."""
    insets: bool = False
    """Whether depth and normals are shown in the corner."""
    loading: tuple[str, ...] = ()
    """Options of the command line by which files were loaded."""
    split: float | None = None
    """Share of the picture, from the left, that shows the state before the edits; None: none of it."""

    def __post_init__(self) -> None:
        for name, value, (low, high) in (("height", self.height, HEIGHTS), ("budget", self.budget_ms, BUDGETS_MS)):
            if not low <= value <= high:
                raise ls.ConfigError(f"{name} is {value}, expected {low:g} to {high:g}")
        if self.view not in VIEWS:
            raise ls.ConfigError(f"view is '{self.view}', expected one of {', '.join(VIEWS)}")


class Session:
    """The state of the viewer. Safe to use from any thread.

    Args:
        options: How it is shown at first.
    """

    def __init__(self, options: Options) -> None:
        self.changed = threading.Condition(threading.RLock())
        """Notified when a frame may have become old; held by whoever changes anything."""
        self.state = self.opened = State()
        """What is shown, and what was at first."""
        self.selected: int | None = None
        """Id of the entry that people edit; None: none."""
        self.locked: frozenset[int] = frozenset()
        """Ids of entries that clicks pass by, and that are not edited until they are unlocked."""
        self.ground_points: tuple[tuple[float, float, float], ...] | None = None
        """Points of the ground that were clicked so far, world space; None: clicks select."""
        self.options = options
        self.revision = 0
        """Grows with every change of what frames show."""
        self.extent = Extent()
        """Of what was opened."""
        self.boxes = BoxCache()
        """Around what entries show; read it with the lock held."""
        self._past: list[State] = []
        self._future: list[State] = []
        self._merging: str | None = None
        self._edited_at = 0.0
        self._listeners: list[Callable[[], None]] = []
        self.error_listeners: list[Callable[[str], None]] = []
        """Told what went wrong, in a line."""

    def open(self, state: State) -> None:
        """Starts with a state; nothing before it can be undone."""
        with self.changed:
            self.extent, self.opened = Extent.of(state.document.scene(self.options.time)), state
            self._past, self._future, self._merging = [], [], None
            self.ground_points = None
            self._show(state)

    def edit(self, change: Callable[[State], State], merge: str | None = None, *, within: float = MERGE_S) -> None:
        """Goes on to a new state.

        Args:
            change: Makes it of the present one.
            merge: Edits of the same name that follow each other soon are undone as one; `end_merge` ends such a row.
            within: How soon, seconds.

        Raises:
            LumisplatError: The change is refused.
        """
        with self.changed:
            self._commit(change(self.state), merge, within)

    def _commit(self, state: State, merge: str | None, within: float) -> None:
        """Goes on to a state; the lock is held."""
        now = time.monotonic()
        if merge is None or merge != self._merging or now - self._edited_at > within:
            self._past = limit_undo_memory([*self._past[-UNDO_MAX:], self.state], state)
        self._merging, self._edited_at = merge, now
        self._future.clear()
        self._show(state)

    def apply(
        self,
        edit: Callable[[ls.io.SceneDocument], ls.io.SceneDocument],
        merge: str | None = None,
        *,
        within: float = MERGE_S,
    ) -> bool:
        """Edits the document; what cannot be done is reported, and changes nothing.

        Args:
            edit: Makes the new document of the present one. It may read files, which holds up nobody: if something else
                was edited meanwhile, it is asked once more.
            merge: As of `edit`.
            within: As of `edit`.

        Returns:
            Whether it was done.
        """
        try:
            while True:
                before = self.state.document
                after = edit(before)
                with self.changed:
                    if self.state.document is before:
                        self._commit(replace(self.state, document=after), merge, within)
                        break
        except ls.LumisplatError as error:
            self.report(" ".join(str(error).split()).removeprefix(f"{self.state.document.file}: "))
            self._notify()
            return False
        return True

    def configure(self, change: Callable[[ls.RenderConfig], ls.RenderConfig], merge: str | None = None) -> None:
        """Goes on with other settings.

        Args:
            change: Makes them of the present ones.
            merge: As of `edit`.

        Raises:
            ConfigError: A value is refused.
        """
        self.edit(lambda state: replace(state, config=change(state.config)), merge)

    def end_merge(self) -> None:
        """The next edit is undone on its own."""
        with self.changed:
            self._merging = None

    def undo(self) -> bool:
        """Goes back by one edit; False: there is none."""
        return self._step(self._past, self._future)

    def redo(self) -> bool:
        """Goes forward again; False: nothing was undone, or something else was done since."""
        return self._step(self._future, self._past)

    def mark(self) -> None:
        """What is shown now is what later states are compared with."""
        with self.changed:
            self.opened = self.state
            self._show(self.state)

    @property
    def scene(self) -> ls.Scene:
        """What is seen now."""
        return self.state.document.scene(self.options.time)

    @property
    def is_lit(self) -> bool:
        """Whether frames are lit."""
        return self.state.config.is_lit(by_default=self.scene.is_lit_by_default)

    @property
    def views(self) -> tuple[str, ...]:
        """What pages may show of the frames of the present state."""
        return available_views(self.state.config, lit=self.is_lit)

    @property
    def selected_entry(self) -> ls.io.SceneEntry | None:
        """The entry that people edit."""
        return next((entry for entry in self.state.document.entries if entry.id == self.selected), None)

    def select(self, entry: int | None) -> None:
        """Selects an entry, for all pages."""
        with self.changed:
            if entry != self.selected:
                self.selected, self._merging = entry, None
                self._show(self.state)

    def toggle_lock(self, entry: int) -> None:
        """Locks an entry, or unlocks it."""
        with self.changed:
            self.locked ^= {entry}
            self._show(self.state)

    def set_ground_points(self, points: tuple[tuple[float, float, float], ...] | None) -> None:
        """Takes clicks for points of the ground, after those given; None: no longer."""
        with self.changed:
            self.ground_points = points
            self._show(self.state)

    def set_options(self, **changes: object) -> None:
        """Shows the same state in another way.

        Raises:
            ConfigError: A value is refused.
        """
        with self.changed:
            self.options = replace(self.options, **changes)  # pyright: ignore[reportArgumentType]
            self._show(self.state)

    def on_change(self, listener: Callable[[], None]) -> None:
        """Calls a function after each change, in the thread that made it."""
        self._listeners.append(listener)

    def report(self, problem: str) -> None:
        """Tells people what went wrong, in the words of the page."""
        for notify in self.error_listeners:
            notify(page_words(problem))

    def _step(self, source: list[State], target: list[State]) -> bool:
        with self.changed:
            if not source:
                return False
            target.append(self.state)
            self._merging = None
            state = source.pop()
            if self.selected not in {entry.id for entry in state.document.entries}:
                self.selected = None
            self._show(state)
            return True

    def _show(self, state: State) -> None:
        if state.document is not self.state.document:
            self.boxes.prune(state.document)
        before, self.state = self.state, state
        if before.document.top.get("up") != state.document.top.get("up"):
            self.extent = self.extent.with_ground(self.scene)
        if self.options.view != "color" and self.options.view not in self.views:
            self.options = replace(self.options, view="color")  # such frames have no image of it
        self.revision += 1
        self.changed.notify_all()
        self._notify()

    def _notify(self) -> None:
        for listener in self._listeners:
            listener()


def limit_undo_memory(past: list[State], now: State, most: int = UNDO_BYTES_MAX) -> list[State]:
    """Returns the newest of the states that can be undone whose assets fit into memory.

    Args:
        past: The states, the oldest first.
        now: The state that follows them; what it shows is not counted.
        most: Bytes that assets of ``past`` may take that ``now`` does not have.
    """
    entries = {id(entry) for entry in now.document.entries}
    arrays = {id(array) for entry in now.document.entries for array in _arrays_of(entry)}
    held = 0
    for number in reversed(range(len(past))):
        for entry in past[number].document.entries:
            if id(entry) in entries:
                continue
            entries.add(id(entry))
            for array in _arrays_of(entry):
                held += 0 if id(array) in arrays else array.nbytes
                arrays.add(id(array))
        if held > most:
            return past[number + 1 :]
    return past


def _arrays_of(held: object) -> Iterator[npt.NDArray[Any]]:
    """Yields the arrays of an entry: of its captures, meshes, textures, lights and actor, wherever they are in it."""
    pending, seen = [held], set[int]()
    while pending:
        one = pending.pop()
        if id(one) in seen:
            continue
        seen.add(id(one))
        if isinstance(one, np.ndarray):
            yield one
        elif isinstance(one, Mapping):
            pending.extend(cast(Mapping[object, object], one).values())
        elif isinstance(one, list | tuple):
            pending.extend(cast(Iterable[object], one))
        elif type(one).__module__.startswith("lumisplat."):
            slots = (name for kind in type(one).__mro__ for name in vars(kind).get("__slots__", ()))
            pending.extend(getattr(one, name, None) for name in slots)
            pending.extend(getattr(one, "__dict__", {}).values())
