"""Renders the frames of a command, with focus, real-time warm-up and denoising."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted

_log = logging.getLogger("lumisplat.noise")  # the library logs noise under this name, too

NOISE_MAX = 0.1
"""Relative noise of a path-traced frame above which a log line gives advice: 5 % of the pixels are off by a tenth or
more."""


REALTIME_FRAMES = 32
"""Default number of real-time frames rendered for the first view; only the last one is shown."""


@dataclass(frozen=True, kw_only=True)
class WarmUp:
    """Number of real-time frames that are rendered before one is shown, and when."""

    frames: int = REALTIME_FRAMES
    """Number of frames rendered for one view; only the last one is shown."""
    each: bool = False
    """True if each image needs a warm-up, because views are unrelated; False if only the first frame of a sequence
    does."""


class SceneForView(Protocol):
    """Provider of a scene for each view."""

    def scene(self, camera: ls.Camera, release: Callable[[], None]) -> ls.Scene:
        """Returns the part of the scene that a camera sees; calls ``release`` before it loads another part."""
        ...


@dataclass
class FrameSource:
    """Renders frames with focus, warm-up and denoising."""

    renderer: ls.Renderer
    aperture: float | None = None
    """Lens radius in scene units; None keeps the camera's own."""
    focus: tuple[int, int] | None = None
    """Column and row of the pixel in focus; None keeps the camera's focus."""
    denoises: bool = False
    """True if lit frames are denoised."""
    warm_up: WarmUp = field(default_factory=WarmUp)
    blocks: SceneForView | None = None
    """Provider of the visible part of a capture in blocks; None if whole scenes are rendered."""
    _is_warm: bool = field(default=False, init=False)
    _has_warned: bool = field(default=False, init=False)

    def frame(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """Renders and finishes one frame.

        Raises:
            ConfigError: ``--focus`` is given without an aperture, or with a pipeline without rays.
            DeviceError: Raised by `lumisplat.Renderer.render`.
            SceneError: Raised by `lumisplat.Renderer.render`, or no surface is in the pixel to focus on.
        """
        if self.blocks is not None:
            scene = self.blocks.scene(camera, self.renderer.release)
        return self.finished(self._rendered(scene, self.focused(scene, camera), report))

    def focused(self, scene: ls.Scene, camera: ls.Camera) -> ls.Camera:
        """Returns the camera with the options' aperture and focus.

        Raises:
            ConfigError: ``--focus`` is given without an aperture, or with a pipeline without rays.
            SceneError: No surface is in the pixel to focus on.
        """
        camera = camera if self.aperture is None else replace(camera, aperture=self.aperture)
        return camera if self.focus is None else self._focused(scene, camera, *self.focus)

    def finished(self, frame: ls.Frame) -> ls.Frame:
        """Returns a rendered frame, denoised if asked; otherwise logs advice about noise, at most once."""
        if self.denoises and frame.has("light"):
            return frame.denoised()
        if not self._has_warned and (line := noise_advice(frame)):
            self._has_warned = True
            _log.warning("%s", line)
        return frame

    def cut(self) -> None:
        """Marks the next frame as unrelated to the previous one, so that real-time frames need a new warm-up."""
        self._is_warm = False

    def _rendered(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """Renders one frame; in the realtime pipeline, after a warm-up if one is needed."""
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
        """Returns the camera focused on the surface in a pixel."""
        if camera.aperture == 0.0:
            raise ls.ConfigError("--focus needs a lens: --aperture gives its radius, in units of the scene")
        return self.renderer.focused(scene, camera, x, y)


def noise_advice(frame: ls.Frame) -> str | None:
    """Returns advice on reducing the noise of a path-traced frame; None if noise is low or was chosen by the user."""
    config, noise = frame.config, None if frame.stats is None else frame.stats.noise
    if config is None or not config.pipeline.traces_paths or config.noise is not None:
        return None
    if frame.light is None or not frame.light.any():
        return None  # unlit captures are noisy only at edges
    if noise is None and frame.samples == 1:
        found = ""  # one sample allows no noise estimate
    elif noise is not None and noise > NOISE_MAX:
        found = f" (about {noise:.2g} of noise)"
    else:
        return None
    return (
        f"indirect light is noisy with {counted(frame.samples, 'sample')} a pixel{found}: more --samples "
        "or --set noise=0.02 reduce the noise, and --denoise removes it"
    )
