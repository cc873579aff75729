"""Renderers that pages share, one for each use, so that what one keeps warm no other use replaces."""

from __future__ import annotations

import contextlib
import ctypes
import logging
from collections.abc import Callable, Collection, Hashable
from dataclasses import replace

import lumisplat as ls

Progress = Callable[[str, float], None]

THREAD = "lumisplat frames"
"""Name of the thread that renders."""

_grain_log = logging.getLogger("lumisplat.grain")


def frame_config(config: ls.RenderConfig, view: str) -> ls.RenderConfig:
    """Settings of one sample of a frame, with the images that a view needs.

    Args:
        config: The settings of the scene.
        view: ``color``, or one of `lumisplat.Frame.VIEWS`.
    """
    needed = ls.Frame.NEEDS.get(view)
    samples = None if config.pipeline.is_sequence else 1
    limits = {"samples": samples, "noise": None, "time_limit": None, "adaptive": None}
    return replace(config, **limits, aovs=() if needed is None else (needed,))


class Renderers:
    """Holds the renderers of the present settings.

    Args:
        device: As of `lumisplat.create_renderer`.
        progress: Likewise.
    """

    def __init__(self, device: str, progress: Progress) -> None:
        self._device, self._progress = device, progress
        self._held: dict[Hashable, ls.Renderer] = {}
        _grain_log.addFilter(self._is_news)

    def of(self, use: Hashable, config: ls.RenderConfig) -> ls.Renderer:
        """Returns the renderer of a use, with these settings; the scene stays on its device when they change.

        Raises:
            DeviceError: There is no such device, or it is out of memory.
        """
        held = self._held.get(use)
        if held is None:
            held = self._held[use] = ls.create_renderer(config, self._device, progress=self._progress, compiles=False)
        elif held.config != config:
            held.reconfigure(config)
            _return_freed_memory()
        return held

    def has(self, use: Hashable, config: ls.RenderConfig) -> bool:
        """Whether a use has a renderer with settings already."""
        held = self._held.get(use)
        return held is not None and held.config == config

    def close(self) -> None:
        """Forgets all of them."""
        self._held.clear()
        _grain_log.removeFilter(self._is_news)

    def keep(self, uses: Collection[Hashable]) -> None:
        """Frees the renderers of all other uses."""
        if gone := self._held.keys() - set(uses):
            for use in gone:
                self.drop(use)
            _return_freed_memory()

    def drop(self, use: Hashable) -> None:
        """Frees the renderer of a use."""
        self._held.pop(use, None)

    def _is_news(self, record: logging.LogRecord) -> bool:
        """Whether a line about grain is worth a log: that the first of many samples is grainy is not."""
        return record.threadName != THREAD


def _return_freed_memory() -> None:
    """Returns to the system what renderers have freed: glibc keeps blocks of up to 32 MiB, of other sizes each time."""
    with contextlib.suppress(OSError, AttributeError):  # only glibc has this
        ctypes.CDLL(None).malloc_trim(0)
