"""The session: scene, settings and view options that all pages of a viewer share, with undo and selection."""

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

_SORTED = "Projection unscented works only with strategy sorted."
_ISO = "Projection unscented works only with surface iso."
_UNSCENTED = "Unscented works only with the pipelines raster and hybrid, strategy sorted and surface iso."
_BOUNCE_VIEWS = ("direct_diffuse", "indirect_diffuse", "direct_glossy", "indirect_glossy")
"""AOV views that only pipelines that trace indirect light can render."""
_REALTIME_VIEWS = ("motion", "history", "probes", "cache", "cache_cells")
"""AOV views of data that the realtime pipeline carries from frame to frame, such as motion vectors and probes."""
ERROR_VIEWS = {"albedo_error": 2.0, "roughness_error": 0.7}
"""Views of captures coloured by a field of `lumisplat.Gaussians`, by its name, with the error that is shown yellow."""
_LIT_VIEWS = ("shadow", "emission", *_BOUNCE_VIEWS, *_REALTIME_VIEWS)


def available_views(config: ls.RenderConfig, *, lit: bool) -> tuple[str, ...]:
    """Returns the names of views that a page can show: ``color``, and the AOVs in `Frame.VIEWS` that frames contain.

    Args:
        config: Render settings; they decide which AOVs a frame has.
        lit: True if lights affect frames; False if captures are shown as captured.
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
    """Returns the reason for each render setting, or group of settings, that has no effect or cannot be changed now.

    Keys are names such as ``raster.strategy``. A reason says which other setting to change first.

    Args:
        config: Render settings.
        lit: True if lights affect frames; False if captures are shown as captured.
    """
    return config.unused_settings(lit=lit) | _excluded(config)


def _excluded(config: ls.RenderConfig) -> dict[str, str]:
    """Returns the ``raster`` settings that the current projection, strategy or surface locks, each with the reason.

    The unscented projection excludes sorted rasterisation and iso-surfaces, and each of these excludes it.
    """
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
    """Snapshot that undo restores: the scene document, the render settings and the exposure."""

    document: ls.io.SceneDocument = field(default_factory=lambda: ls.io.SceneDocument.of(ls.Scene()))
    config: ls.RenderConfig = field(default_factory=ls.RenderConfig)
    exposure: float = 0.0
    """Exposure of lit frames, in stops; +1 doubles the brightness."""


VIEWS = ("color", *ls.Frame.VIEWS, *ERROR_VIEWS)
"""All names that option *view* accepts: ``color`` for the rendered image, the AOVs in `lumisplat.Frame.VIEWS`, and
`ERROR_VIEWS`."""


@dataclass(frozen=True)
class Options:
    """View options, shared by all pages, such as image height and grid; not undone, and not saved in scene files."""

    height: int = 720
    """Image height in pixels once the camera has stopped moving; frames during motion may be smaller."""
    budget_ms: float = 40.0
    """Time budget of a frame while the camera or the scene changes, milliseconds."""
    view: str = "color"
    """Image that pages show: one of `VIEWS`."""
    time: float = 0.0
    """Animation time at which the scene is shown, seconds."""
    outlines: bool = True
    """True if pages outline the lights and the selected object."""
    grid: bool = False
    """True if pages draw a grid on the ground."""
    insets: bool = False
    """True if pages show small images of depth and normals in a corner."""
    loading: tuple[str, ...] = ()
    """Options such as ``--lod 1`` that the scene's files were loaded with; the files panel repeats them in commands."""
    split: float | None = None
    """Option *compare*: fraction of the image width, from the left, that shows the marked earlier state, 0 to 1; None
    shows no comparison."""

    def __post_init__(self) -> None:
        for name, value, (low, high) in (("height", self.height, HEIGHTS), ("budget", self.budget_ms, BUDGETS_MS)):
            if not low <= value <= high:
                raise ls.ConfigError(f"{name} is {value}, expected {low:g} to {high:g}")
        if self.view not in VIEWS:
            raise ls.ConfigError(f"view is '{self.view}', expected one of {', '.join(VIEWS)}")


class Session:
    """State that all pages of a viewer share: scene, settings, view options, undo history and selection. Thread-safe.

    Args:
        options: View options at the start.
    """

    def __init__(self, options: Options) -> None:
        self.changed = threading.Condition(threading.RLock())
        """Condition that is notified after each change of scene, settings or view options. Every change holds its
        lock."""
        self.state = self.opened = State()
        """Current document, settings and exposure. ``opened`` is the state that option *compare* shows on the left:
        the loaded state, or the state when *mark* was last pressed."""
        self.selected: int | None = None
        """Id of the scene entry that is selected on all pages; None if nothing is selected."""
        self.locked: frozenset[int] = frozenset()
        """Ids of locked scene entries: a click in the image does not select them, and they cannot be edited."""
        self.ground_points: tuple[tuple[float, float, float], ...] | None = None
        """Up to two world positions clicked so far to define the ground plane; None while clicks select objects
        instead."""
        self.options = options
        self.revision = 0
        """Counter that grows with every change of scene, settings or view options that affects frames."""
        self.extent = Extent()
        """Centre, size and ground height of the scene as loaded; edits change only the ground height."""
        self.boxes = BoxCache()
        """Bounding box of each scene entry; use it only while holding the lock of `changed`."""
        self._past: list[State] = []
        self._future: list[State] = []
        self._merging: str | None = None
        self._edited_at = 0.0
        self._listeners: list[Callable[[], None]] = []
        self.error_listeners: list[Callable[[str], None]] = []
        """Functions that `report` calls with each error message, one line of text."""

    def open(self, state: State) -> None:
        """Replaces document, settings and exposure by a loaded state, and clears the undo history."""
        with self.changed:
            self.extent, self.opened = Extent.of(state.document.scene(self.options.time)), state
            self._past, self._future, self._merging = [], [], None
            self.ground_points = None
            self._show(state)

    def edit(self, change: Callable[[State], State], merge: str | None = None, *, within: float = MERGE_S) -> None:
        """Replaces the state by a changed one, as an edit that can be undone.

        Args:
            change: Returns the new state, given the current one.
            merge: Name of a series of edits. Consecutive edits of one name are undone as one; `end_merge` ends the
                series.
            within: Longest time between two edits of a series, seconds.

        Raises:
            LumisplatError: The change is invalid.
        """
        with self.changed:
            self._commit(change(self.state), merge, within)

    def _commit(self, state: State, merge: str | None, within: float) -> None:
        """Makes a state the current one, and pushes the previous one to the undo history unless both edits are merged.

        The caller holds the lock of ``changed``. See `edit` for the arguments.
        """
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
        """Edits the document, as an edit that can be undone. If it fails, pages show the error and nothing changes.

        Args:
            edit: Returns the new document, given the current one. It runs without the lock, so it may read files; if
                the document changes meanwhile, it runs again.
            merge: Name of a series of edits that undo as one, as in `edit`.
            within: Longest time between two edits of a series, seconds.

        Returns:
            True if the edit succeeded.
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
        """Changes the render settings, as an edit that can be undone.

        Args:
            change: Returns the new settings, given the current ones.
            merge: Name of a series of edits that undo as one, as in `edit`.

        Raises:
            ConfigError: A value is invalid.
        """
        self.edit(lambda state: replace(state, config=change(state.config)), merge)

    def end_merge(self) -> None:
        """Ends a series of merged edits: the next edit is undone separately."""
        with self.changed:
            self._merging = None

    def undo(self) -> bool:
        """Undoes the last edit; returns False if there is none."""
        return self._step(self._past, self._future)

    def redo(self) -> bool:
        """Redoes the last undone edit; returns False if there is none."""
        return self._step(self._future, self._past)

    def mark(self) -> None:
        """Stores the current state as the one that option *compare* shows on the left side of the image."""
        with self.changed:
            self.opened = self.state
            self._show(self.state)

    @property
    def scene(self) -> ls.Scene:
        """The document's scene at the animation time of the view options."""
        return self.state.document.scene(self.options.time)

    @property
    def is_lit(self) -> bool:
        """True if lights affect frames of the current state; False if captures are shown as captured."""
        return self.state.config.is_lit(by_default=self.scene.is_lit_by_default)

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views that pages can show: ``color``, AOVs that frames have, and errors that captures have."""
        shown = self.scene.splats
        errors = (name for name in ERROR_VIEWS if any(getattr(one.gaussians, name) is not None for one in shown))
        return (*available_views(self.state.config, lit=self.is_lit), *errors)

    @property
    def selected_entry(self) -> ls.io.SceneEntry | None:
        """The selected entry of the document; None if nothing is selected."""
        return next((entry for entry in self.state.document.entries if entry.id == self.selected), None)

    def select(self, entry: int | None) -> None:
        """Selects an entry on all pages; None clears the selection."""
        with self.changed:
            if entry != self.selected:
                self.selected, self._merging = entry, None
                self._show(self.state)

    def toggle_lock(self, entry: int) -> None:
        """Locks an entry, or unlocks a locked one."""
        with self.changed:
            self.locked ^= {entry}
            self._show(self.state)

    def set_ground_points(self, points: tuple[tuple[float, float, float], ...] | None) -> None:
        """Sets the points clicked so far to define the ground plane; clicks then add points. None ends this mode."""
        with self.changed:
            self.ground_points = points
            self._show(self.state)

    def set_options(self, **changes: object) -> None:
        """Changes the view options that are passed by name, such as ``height=1080``.

        Raises:
            ConfigError: A value is invalid.
        """
        with self.changed:
            self.options = replace(self.options, **changes)  # pyright: ignore[reportArgumentType]
            self._show(self.state)

    def on_change(self, listener: Callable[[], None]) -> None:
        """Registers a function that is called after each change of the session, in the thread that made the change."""
        self._listeners.append(listener)

    def report(self, problem: str) -> None:
        """Passes an error message to all `error_listeners`; names of settings are replaced by their control labels."""
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
            self.options = replace(self.options, view="color")  # these frames do not have the view
        self.revision += 1
        self.changed.notify_all()
        self._notify()

    def _notify(self) -> None:
        for listener in self._listeners:
            listener()


def limit_undo_memory(past: list[State], now: State, most: int = UNDO_BYTES_MAX) -> list[State]:
    """Drops the oldest undo states until the arrays that only the undo history holds fit into a memory limit.

    Args:
        past: Undo states, oldest first.
        now: The current state; arrays that it also holds are not counted.
        most: Memory limit, bytes.
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
    """Yields every NumPy array that an object of the package refers to, directly or through nested objects."""
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
