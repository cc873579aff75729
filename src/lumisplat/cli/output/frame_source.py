"""Frames as a command asks for them: focused, rendered, and denoised."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted

_log = logging.getLogger("lumisplat.noise")  # as that of the noise of known lights

NOISE_MAX = 0.1
"""Noise of a frame of paths above which a line says what helps: 5 % of the pixels are off by a tenth or more."""


REALTIME_FRAMES = 32
"""Frames of a sequence in real time, of which the last is the first one that is shown."""


@dataclass(frozen=True, kw_only=True)
class WarmUp:
    """How frames in real time come to a picture."""

    frames: int = REALTIME_FRAMES
    """Of the same view, before what they have found is good enough to be shown: that of the last one is."""
    each: bool = False
    """Before every picture, which are of different places; else before the first of a sequence only."""


class SceneForView(Protocol):
    """What has a scene for each view."""

    def scene(self, camera: ls.Camera, release: Callable[[], None]) -> ls.Scene:
        """What a camera sees; ``release`` is called before something else than of the last view is loaded."""
        ...


@dataclass
class FrameSource:
    """Renders frames."""

    renderer: ls.Renderer
    aperture: float | None = None
    """Radius of the lens, scene units; None: the camera's own."""
    focus: tuple[int, int] | None = None
    """Column and row of the pixel that is in focus; None: the camera's focus stays."""
    denoises: bool = False
    """Whether the light of lit frames is denoised."""
    warm_up: WarmUp = field(default_factory=WarmUp)
    blocks: SceneForView | None = None
    """In place of scenes, what each camera sees of a capture in blocks."""
    _is_warm: bool = field(default=False, init=False)
    _has_warned: bool = field(default=False, init=False)

    def frame(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """One frame, finished.

        Raises:
            ConfigError: It is to be focused without a lens, or without rays.
            DeviceError: As of `lumisplat.Renderer.render`.
            SceneError: Likewise, or the pixel in focus shows nothing.
        """
        if self.blocks is not None:
            scene = self.blocks.scene(camera, self.renderer.release)
        return self.finished(self._rendered(scene, self.focused(scene, camera), report))

    def focused(self, scene: ls.Scene, camera: ls.Camera) -> ls.Camera:
        """The camera with the lens that was asked for.

        Raises:
            ConfigError: It is to be focused without a lens, or without rays.
            SceneError: The pixel in focus shows nothing.
        """
        camera = camera if self.aperture is None else replace(camera, aperture=self.aperture)
        return camera if self.focus is None else self._focused(scene, camera, *self.focus)

    def finished(self, frame: ls.Frame) -> ls.Frame:
        """A frame that was rendered, denoised if it is to be; one that is not may have a line of advice."""
        if self.denoises and frame.has("light"):
            return frame.denoised()
        if not self._has_warned and (line := noise_advice(frame)):
            self._has_warned = True
            _log.warning("%s", line)
        return frame

    def cut(self) -> None:
        """The next frame does not follow the last one."""
        self._is_warm = False

    def _rendered(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """One frame; in real time the last of those that it takes."""
        if not self.renderer.config.pipeline.is_sequence:
            return self.renderer.render(scene, camera, progress=report)
        if self._is_warm and not self.warm_up.each:
            return self.renderer.render(scene, camera)
        self.renderer.reset()
        for number in range(1, self.warm_up.frames):
            self.renderer.render(scene, camera)
            report(f"finding light, {counted(number, 'frame')}", number / self.warm_up.frames)
        self._is_warm = True
        frame = self.renderer.render(scene, camera)
        report(f"finding light, {counted(self.warm_up.frames, 'frame')}", 1.0)
        return frame

    def _focused(self, scene: ls.Scene, camera: ls.Camera, x: int, y: int) -> ls.Camera:
        """The camera, focused on what a pixel shows."""
        if camera.aperture == 0.0:
            raise ls.ConfigError("--focus needs a lens: --aperture gives its radius, in units of the scene")
        return self.renderer.focused(scene, camera, x, y)


def noise_advice(frame: ls.Frame) -> str | None:
    """Returns what helps against the noise of a frame of paths; None: there is little, or its noise was chosen."""
    config, noise = frame.config, None if frame.stats is None else frame.stats.noise
    if config is None or not config.pipeline.traces_paths or config.noise is not None:
        return None
    if frame.light is None or not frame.light.any():
        return None  # a kept capture: what is left are its edges
    if noise is None and frame.samples == 1:
        found = ""  # one sample does not tell
    elif noise is not None and noise > NOISE_MAX:
        found = f" (about {noise:.2g} of noise)"
    else:
        return None
    return (
        f"light that bounces is grainy with {counted(frame.samples, 'sample')} a pixel{found}: more --samples, "
        "or --set noise=0.02 make it smooth, and --denoise does so at once"
    )
