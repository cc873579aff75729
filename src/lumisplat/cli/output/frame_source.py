"""Renders the frames of a command: sets the focus, warms up the realtime pipeline, and denoises."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted

_log = logging.getLogger("lumisplat.noise")  # the library logs noise under this name, too

NOISE_MAX = 0.1
"""Relative noise of a path-traced frame above which a warning says how to reduce it; at 0.1, one pixel in 20 is off by
10 % or more."""


REALTIME_FRAMES = 32
"""Default number of frames that the realtime pipeline renders of a new view; it keeps only the last, which reuses the
samples of all."""


@dataclass(frozen=True, kw_only=True)
class WarmUp:
    """How many frames the realtime pipeline renders of one view to gather samples, of which only the last is kept."""

    frames: int = REALTIME_FRAMES
    """Number of frames that are rendered of one view; the last one is kept, the others are discarded."""
    each: bool = False
    """True warms up before each image, for unrelated views; False only before the first frame of a sequence, and after
    `FrameSource.cut`."""


class SceneForView(Protocol):
    """Interface of an object that provides the part of a large scene that a camera sees."""

    def scene(self, camera: ls.Camera, release: Callable[[], None]) -> ls.Scene:
        """Returns the part of the scene that a camera sees; calls ``release`` before it loads a different part."""
        ...


@dataclass
class FrameSource:
    """Renders the frames of a command with focus, warm-up of the realtime pipeline, and denoising."""

    renderer: ls.Renderer
    aperture: float | None = None
    """Lens radius in scene units; None keeps the camera's own."""
    focus: tuple[int, int] | None = None
    """Column and row of the pixel whose surface is in focus; None keeps the camera's focus distance."""
    denoises: bool = False
    """True if frames that lights affect are denoised; unlit frames never are."""
    warm_up: WarmUp = field(default_factory=WarmUp)
    blocks: SceneForView | None = None
    """Loads the blocks of a capture that a camera sees; None if whole scenes are rendered."""
    _is_warm: bool = field(default=False, init=False)
    _has_warned: bool = field(default=False, init=False)

    def frame(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """Renders one frame, focused, warmed up and denoised as this object says.

        Args:
            scene: The scene; ignored if `blocks` provides it.
            camera: The camera.
            report: Receives the progress.

        Raises:
            ConfigError: ``--focus`` is given without an aperture, or with a pipeline without rays.
            DeviceError: Raised by `lumisplat.Renderer.render`.
            SceneError: Raised by `lumisplat.Renderer.render`, or no surface is in the pixel to focus on.
        """
        if self.blocks is not None:
            scene = self.blocks.scene(camera, self.renderer.release)
        return self.finished(self._rendered(scene, self.focused(scene, camera), report))

    def focused(self, scene: ls.Scene, camera: ls.Camera) -> ls.Camera:
        """Returns a camera with the lens radius of ``--aperture``, focused on the surface in the pixel of ``--focus``.

        Raises:
            ConfigError: ``--focus`` is given without an aperture, or with a pipeline without rays.
            SceneError: No surface is in the pixel to focus on.
        """
        camera = camera if self.aperture is None else replace(camera, aperture=self.aperture)
        return camera if self.focus is None else self._focused(scene, camera, *self.focus)

    def finished(self, frame: ls.Frame) -> ls.Frame:
        """Returns a lit frame denoised if `denoises` is True; else the frame itself, and warns once if it is noisy."""
        if self.denoises and frame.has("light"):
            return frame.denoised()
        if not self._has_warned and (line := noise_advice(frame)):
            self._has_warned = True
            _log.warning("%s", line)
        return frame

    def cut(self) -> None:
        """Declares that the next frame does not follow the last one, so that the realtime pipeline warms up again."""
        self._is_warm = False

    def _rendered(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """Renders one frame; in the realtime pipeline, first renders and discards frames if a warm-up is due."""
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
        """Returns the camera focused on the surface in the pixel of column ``x`` and row ``y``."""
        if camera.aperture == 0.0:
            raise ls.ConfigError(
                "--focus needs a lens: --aperture gives its radius in units of the scene, and --pipeline trace its rays"
            )
        return self.renderer.focused(scene, camera, x, y)


def noise_advice(frame: ls.Frame) -> str | None:
    """Returns how to reduce the noise of a path-traced frame; None if it is low, or if the settings limit the noise."""
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
