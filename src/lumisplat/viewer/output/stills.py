"""Pictures that are not shown but kept: all their samples, and layers, a step at a time."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace

import lumisplat as ls
from lumisplat.viewer.frames.shown_scenes import ShownScenes

Still = Generator[float, None, ls.Frame]
"""Gives the share that is done after each sample, and the frame at last."""


@dataclass(frozen=True)
class Studio:
    """What stills are made with, in the thread of the frames."""

    scenes: ShownScenes
    device: str
    """As of `lumisplat.create_renderer`."""
    stop: Callable[[], bool]
    """Whether stills have to give way."""

    def renderer(self, config: ls.RenderConfig) -> ls.Renderer:
        """A renderer for stills of `still_config`.

        Raises:
            DeviceError: There is no such device, or it is out of memory.
        """
        return ls.create_renderer(config, self.device, compiles=False)

    def scene(self, document: ls.SceneDocument, config: ls.RenderConfig, time: float) -> ls.Scene:
        """All of a document at a time, seconds, with its actors lit.

        Raises:
            LumisplatError: It cannot be made.
        """
        return self.scenes.of(document, config, time, 0, waits=True)

    def still(self, renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera, samples: int) -> Still:
        """Renders a picture; a sample that had to give way is made again.

        Args:
            renderer: With settings of `still_config`.
            scene: The scene.
            camera: The camera.
            samples: Samples a pixel; frames in real time follow each other that often. The sorted raster takes one.

        Raises:
            LumisplatError: It cannot be rendered.
        """
        follows = renderer.config.pipeline.is_sequence
        frame: ls.Frame | None = None
        done = 0
        while frame is None or (done < samples and frame.samples > 0):
            with contextlib.suppress(ls.StoppedError):
                resume = None if follows else frame
                frame = renderer.render(scene, camera, resume=resume, stop=self.stop)
                done += 1
            yield done / samples
        return frame


def still_config(config: ls.RenderConfig, layers: tuple[str, ...] = ()) -> ls.RenderConfig:
    """Settings of one sample of a picture.

    Args:
        config: The settings of the scene.
        layers: Images to make besides those of every frame.

    Raises:
        ConfigError: There is no such image.
    """
    samples = None if config.pipeline.is_sequence else 1
    needed = [name for name in layers if name not in ls.Frame.LAYERS or name in ls.Frame.NEEDS]
    return replace(config, samples=samples, noise=None, time_limit=None, adaptive=None, aovs=(*config.aovs, *needed))
