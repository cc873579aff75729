"""Frames of an animation, from its scene and actors to files."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import contextmanager
from dataclasses import replace

import lumisplat as ls
from lumisplat.cli.output.console import Report, found_light, print_stats, print_table
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.frame_source import FrameSource

_log = logging.getLogger("lumisplat")

_SURROUNDED_STOPS = 1.4
"""Largest `estimate_capture_gain` of a place that captures surround: they cover three quarters of all directions."""


class AnimationFrames:
    """Renders frames of an animation to files.

    Args:
        animation: The scene, its actors, and how they are lit.
        cameras: One for each frame.
        source: Renders them.
        folder: The folder of the frames.
        remarks: Gives the lines to log about the settings, from the first scene that is rendered.
    """

    def __init__(
        self,
        animation: ls.Animation,
        cameras: list[ls.Camera],
        source: FrameSource,
        folder: FrameFolder,
        *,
        remarks: Callable[[ls.Scene], Iterable[str]],
    ) -> None:
        self._animation, self._cameras, self._source = animation, cameras, source
        self._folder, self._remarks = folder, remarks
        self._last: int | None = None
        self._lighter: ls.AvatarLighter | None = None
        self._seconds = {"lighting": 0.0, "rendering": 0.0, "writing": 0.0}

    def render(self, index: int, report: Report) -> ls.Frame:
        """Renders a frame."""
        is_first = self._last is None
        if is_first and self._animation.scene.splats and self._animation.actors:
            self._start_lighter(report)
        with self._timed("lighting"):
            scene = self._lit_scene(index)
        if is_first:
            # Remarks are about the lit scene, as actors may bring light into a scene without any.
            for line in (*self._remarks(scene), *self._light_remarks()):
                _log.warning("%s", line)
        if self._last != index - 1:
            self._source.cut()
        with self._timed("rendering"):
            frame = self._source.frame(scene, self._cameras[index], report)
        self._last = index
        return frame

    def write(self, frame: ls.Frame, index: int) -> None:
        """Writes a frame."""
        with self._timed("writing"):
            frame.save(self._folder.path(index))

    def summarise(self, frame: ls.Frame, count: int) -> None:
        """Prints what so many frames took, of which the given one is the last."""
        rows = [(name, f"{1e3 * taken / count:8.1f} ms") for name, taken in self._seconds.items()]
        print_table(f"mean of {count} frames", rows)
        print_stats(frame, self._source.renderer.config.pipeline)

    def _start_lighter(self, report: Report) -> None:
        """Finds the lights around the actors of frame 0, whichever frame is rendered first; none: no shadows."""
        self._lighter = ls.AvatarLighter(
            self._animation.scene,
            config=self._exposed_lighting(),
            background=self._source.renderer.config.background or (0.0, 0.0, 0.0),
            device=self._source.renderer.device,
            progress=report,
        )
        try:
            self._lit_scene(0)
        except ls.SceneError as error:
            if self._lighter.lights is not None:
                raise
            _log.warning("actors cast no shadows: %s", error)
            self._lighter.config = replace(self._lighter.config, shadows=False)

    def _exposed_lighting(self) -> ls.config.AvatarLightingConfig:
        """The settings, with a gamma if captures alone light the actors, do not surround them, and none is given."""
        config, scene = self._animation.lighting, self._animation.scene
        start = float(self._animation.times[0])
        relit = [one for actor in self._animation.actors if actor.relight for one in actor.at(start)]
        if not relit or scene.lights or not config.relight or config.transfer.gamma != ls.config.RelightConfig().gamma:
            return config
        stops = _capture_gain(scene, relit, self._source.renderer.device)
        if stops <= _SURROUNDED_STOPS:
            return config
        _log.warning(
            "the captures do not surround the actors: their light is brightened by %g stops, as if they did (gamma in "
            "[animation.lighting.transfer] of the scene.toml is then %.3g)",
            stops,
            2.0**stops,
        )
        return replace(config, transfer=replace(config.transfer, gamma=2.0**stops))

    def _lit_scene(self, index: int) -> ls.Scene:
        """The scene of a frame: with its actors, their shadows and their light."""
        animation, now = self._animation, float(self._animation.times[index])
        placed = [(instance, actor) for actor in animation.actors for instance in actor.at(now)]
        instances = [instance for instance, _ in placed]
        if self._lighter is None:
            return with_actors(animation.scene, instances)
        return self._lighter.light(
            instances,
            casts_shadow=[actor.casts_shadow for _, actor in placed],
            relit=[actor.relight for _, actor in placed],
        )

    def _light_remarks(self) -> Iterable[str]:
        """Lines about the light of the first frame: which lights were found."""
        found = found_light(self._lighter) if self._lighter is not None else None
        if found is not None:
            yield f"no lights are given, shadows fall from what was found: {found}"

    @contextmanager
    def _timed(self, name: str) -> Generator[None]:
        """Adds the seconds of a block to those of its name."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] += time.perf_counter() - begun


def _capture_gain(scene: ls.Scene, actors: Sequence[ls.SplatInstance | ls.MeshInstance], device: str) -> float:
    """Stops by which captured light exposes actors as their surroundings; 0 where nothing is as captured."""
    around = ls.Scene(splats=tuple(one for one in scene.splats if one.material is None or one.shadow_catcher))
    if not around.splats:
        return 0.0
    low, high = with_actors(ls.Scene(), actors).bulk_bounds()
    middle = 0.5 * (low + high)
    return ls.avatars.estimate_capture_gain(around, middle, device=device)


def with_actors(scene: ls.Scene, actors: Sequence[ls.SplatInstance | ls.MeshInstance]) -> ls.Scene:
    """The scene and actors, without their light and shadows."""
    splats = [actor for actor in actors if isinstance(actor, ls.SplatInstance)]
    meshes = [actor for actor in actors if isinstance(actor, ls.MeshInstance)]
    return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes))
