"""Frames of an animation, from its scene and actors to files."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import lumisplat as ls
from lumisplat.cli.output.console import Report, print_table
from lumisplat.cli.output.frame_folder import FrameFolder
from lumisplat.cli.output.stats import print_stats

_log = logging.getLogger("lumisplat")


class Filming:
    """Renders frames of an animation to files.

    Args:
        animation: What moves, and how it is lit.
        cameras: One for each frame.
        renderer: With the settings of the frames.
        folder: Where they go.
        stats: Print what the frames took.
        remarks: What is to be said about the settings, of the first scene that is rendered.
    """

    def __init__(
        self,
        animation: ls.Animation,
        cameras: list[ls.Camera],
        renderer: ls.Renderer,
        folder: FrameFolder,
        *,
        stats: bool,
        remarks: Callable[[ls.Scene], Iterable[str]],
    ) -> None:
        self._animation, self._cameras, self._renderer = animation, cameras, renderer
        self._folder, self._stats, self._remarks = folder, stats, remarks
        self._lighter: ls.AvatarLighter | None = None
        self._seconds = {"lighting": 0.0, "rendering": 0.0, "writing": 0.0}

    def film(self, indices: list[int], report: Report) -> None:
        """Renders and writes frames."""
        report("frames", 0.0)
        if self._animation.scene.splats:
            self._lighter = ls.AvatarLighter(
                self._animation.scene,
                config=self._animation.lighting,
                background=self._renderer.config.background or (0.0, 0.0, 0.0),
                device=self._renderer.device,
                progress=report,
            )
            if indices[0] != 0:
                # Lights are looked for about the actors of the first frame, whichever frame comes first here.
                self._lit(0)
        for done, index in enumerate(indices, start=1):
            with self._timed("lighting"):
                scene = self._lit(index)
            # Of a lit scene, for actors may bring light into one that has none.
            for line in (*self._remarks(scene), *self._told_of(scene)) if done == 1 else ():
                _log.warning("%s", line)
            with self._timed("rendering"):
                frame = self._renderer.render(scene, self._cameras[index], progress=report)
            with self._timed("writing"):
                frame.save(self._folder.path(index))
            report("frames", done / len(indices))
            if self._stats and done == len(indices):
                rows = [(name, f"{1e3 * taken / done:8.1f} ms") for name, taken in self._seconds.items()]
                print_table(f"mean of {done} frames", rows)
                print_stats(frame, self._renderer.config.pipeline)

    def _lit(self, index: int) -> ls.Scene:
        """The scene with its actors at a frame."""
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

    def _told_of(self, scene: ls.Scene) -> Iterable[str]:
        """What is worth knowing of how the first frame is lit."""
        estimate = self._lighter.estimate if self._lighter is not None else None
        if estimate is not None:
            yield f"no lights are given, shadows fall from what was found: {told_lights(estimate.lights)}"
        environment = any(isinstance(light, ls.LightEnvironment) and light.enabled for light in scene.lights)
        if environment and scene.meshes and self._renderer.config.samples == 1:
            yield "meshes are lit from all around by chance: --samples 16 or more takes out the noise"

    def _timed(self, name: str) -> _Watch:
        return _Watch(self._seconds, name)


@dataclass
class _Watch:
    """Adds the seconds of a block to a sum."""

    sums: dict[str, float]
    name: str
    begun: float = 0.0

    def __enter__(self) -> None:
        self.begun = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self.sums[self.name] += time.perf_counter() - self.begun


def told_lights(lights: Iterable[ls.LightPoint]) -> str:
    """Where lights are, in a line."""
    return ", ".join("({:.3g}, {:.3g}, {:.3g})".format(*light.position) for light in lights)


def with_actors(scene: ls.Scene, actors: list[Any]) -> ls.Scene:
    """The scene with actors as they are."""
    splats = [actor for actor in actors if isinstance(actor, ls.SplatInstance)]
    meshes = [actor for actor in actors if isinstance(actor, ls.MeshInstance)]
    return replace(scene, splats=(*scene.splats, *splats), meshes=(*scene.meshes, *meshes))
