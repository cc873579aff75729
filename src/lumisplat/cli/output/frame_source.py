"""Frames as a command asks for them: focused, rendered, and denoised."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import lumisplat as ls
from lumisplat.cli.output.console import Report, counted

_log = logging.getLogger("lumisplat.grain")  # as that of grain that lights are known for

GRAIN = 0.1
"""Noise of a frame of paths above which a line says what helps: 5 % of the pixels are off by a tenth or more."""


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
    _has_warned: bool = field(default=False, init=False)

    def frame(self, scene: ls.Scene, camera: ls.Camera, report: Report) -> ls.Frame:
        """One frame, finished.

        Raises:
            ConfigError: It is to be focused without a lens, or without rays.
            DeviceError: As of `lumisplat.Renderer.render`.
            SceneError: Likewise, or the pixel in focus shows nothing.
        """
        camera = camera if self.aperture is None else replace(camera, aperture=self.aperture)
        if self.focus is not None:
            camera = self._focused(scene, camera, *self.focus)
        frame = self.renderer.render(scene, camera, progress=report)
        if self.denoises and frame.has("light"):
            return frame.denoised()
        if not self._has_warned and (line := grain_line(frame)):
            self._has_warned = True
            _log.warning("%s", line)
        return frame

    def _focused(self, scene: ls.Scene, camera: ls.Camera, x: int, y: int) -> ls.Camera:
        """The camera, focused on what a pixel shows."""
        if camera.aperture == 0.0:
            raise ls.ConfigError("--focus needs a lens: --aperture gives its radius, in units of the scene")
        return self.renderer.focused(scene, camera, x, y)


def grain_line(frame: ls.Frame) -> str | None:
    """What helps against the grain of a frame of paths; None: there is little, or --noise says how much is left."""
    config, noise = frame.config, None if frame.stats is None else frame.stats.noise
    if config is None or config.pipeline is not ls.Pipeline.PATH or config.noise is not None:
        return None
    if frame.light is None or not frame.light.any():
        return None  # a kept capture: what is left are its edges
    if noise is None and frame.samples == 1:
        found = ""  # one sample does not tell
    elif noise is not None and noise > GRAIN:
        found = f" (about {noise:.2g} of noise)"
    else:
        return None
    return (
        f"light that bounces is grainy with {counted(frame.samples, 'sample')} a pixel{found}: more --samples, a "
        "longer --time or --noise 0.02 make it smooth, and --denoise does so at once"
    )
