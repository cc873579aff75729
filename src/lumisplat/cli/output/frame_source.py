"""Frames as a command asks for them: focused, rendered, and denoised."""

from __future__ import annotations

from dataclasses import dataclass, replace

import lumisplat as ls
from lumisplat.cli.output.console import Report


@dataclass(frozen=True)
class FrameSource:
    """Renders frames."""

    renderer: ls.Renderer
    aperture: float | None = None
    """Radius of the lens, scene units; None: the camera's own."""
    focus: tuple[int, int] | None = None
    """Column and row of the pixel that is in focus; None: the camera's focus stays."""
    denoises: bool = False
    """Whether the light of lit frames is denoised."""

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
        return frame.denoised() if self.denoises and frame.has("light") else frame

    def _focused(self, scene: ls.Scene, camera: ls.Camera, x: int, y: int) -> ls.Camera:
        """The camera, focused on what a pixel shows."""
        if camera.aperture == 0.0:
            raise ls.ConfigError("--focus needs a lens: --aperture gives its radius, in units of the scene")
        return self.renderer.focused(scene, camera, x, y)
