"""Pictures that are not shown but kept: all their samples, and layers, a step at a time."""

from __future__ import annotations

from collections.abc import Generator
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

    def renderer(self, config: ls.RenderConfig) -> ls.Renderer:
        """A renderer for stills of `still_config`.

        Raises:
            DeviceError: There is no such device, or it is out of memory.
        """
        return ls.create_renderer(config, self.device)

    def scene(self, document: ls.SceneDocument, config: ls.RenderConfig, time: float) -> ls.Scene:
        """All of a document at a time, seconds, with its actors lit.

        Raises:
            LumisplatError: It cannot be made.
        """
        return self.scenes.of(document, config, time, 0, waits=True)


def still_config(config: ls.RenderConfig, layers: tuple[str, ...] = ()) -> ls.RenderConfig:
    """Settings of one sample of a picture.

    Args:
        config: The settings of the scene.
        layers: Images to make besides those of every frame.

    Raises:
        ConfigError: There is no such image.
    """
    samples = None if config.pipeline is ls.Pipeline.REALTIME else 1
    return replace(config, samples=samples, noise=None, time_limit=None, adaptive=None, aovs=(*config.aovs, *layers))


def still(renderer: ls.Renderer, scene: ls.Scene, camera: ls.Camera, samples: int) -> Still:
    """Renders a picture.

    Args:
        renderer: With settings of `still_config`.
        scene: The scene.
        camera: The camera.
        samples: Samples a pixel; frames in real time follow each other that often. The sorted raster takes one.

    Raises:
        LumisplatError: It cannot be rendered.
    """
    follows = renderer.config.pipeline is ls.Pipeline.REALTIME
    frame = renderer.render(scene, camera)
    for done in range(1, samples):
        if frame.samples == 0:
            break
        yield done / samples
        frame = renderer.render(scene, camera, resume=None if follows else frame)
    return frame
