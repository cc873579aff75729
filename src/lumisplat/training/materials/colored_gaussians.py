"""Host pass: frames of Gaussians of one colour each, which changes from frame to frame, and derivatives by colours."""

from __future__ import annotations

from types import ModuleType

import numpy as np

from lumisplat.config import TrainConfig
from lumisplat.config.checks import Color
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.progress import Progress
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training import loss_kernels, optimizer_kernels
from lumisplat.training.parameters import DeviceParameters, TrainedParameters
from lumisplat.training.trainer import frame_settings
from lumisplat.training.training_raster import TrainingRaster

LOGIT_MAX = 16.0
"""Of opacities."""


class ColoredGaussians:
    """Gaussians whose geometry stays.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        gaussians: The capture.
        background: Behind it, display-referred sRGB.
        kernels: Further modules that are used.
        progress: Told what is compiled.
    """

    def __init__(
        self,
        launcher: Launcher,
        buffers: Buffers,
        gaussians: Gaussians,
        background: Color,
        *,
        kernels: tuple[ModuleType, ...],
        progress: Progress | None,
    ) -> None:
        flat = TrainConfig(sh_degree=0, antialiased=gaussians.antialiased, cap=gaussians.count)
        settings = frame_settings(flat, background)
        own = (optimizer_kernels, loss_kernels, *kernels)
        self._raster = TrainingRaster(launcher, buffers, settings)
        launcher.load([*self._raster.modules(), *own], progress)
        self._drawn = DeviceParameters(buffers)
        learnt = _unlit(gaussians)
        self._drawn.upload(learnt)
        self._raster.place(learnt.gaussians(flat), self._drawn.values)

    @property
    def sh(self) -> DeviceArray:
        """Receives what each shows, as its constant harmonic, ``wp.vec3``, shape (N,)."""
        return device_array(self._drawn.values.sh)

    @property
    def rects(self) -> DeviceArray:
        """Of the splats of the last frame, ``TileRect``: what was not drawn is in none."""
        return self._raster.drawn.splats.rects

    def draw(self, camera: Camera, background: Color) -> PixelData:
        """The pixels of a frame."""
        return self._raster.draw(camera, 0, background)

    def by_splats(self, pixels: PixelData, gradient: PixelGradient) -> DeviceArray:
        """Derivatives by the splats of the last frame, ``SplatGradient``; undefined where none was drawn."""
        return self._raster.by_splats(pixels, gradient)


def _unlit(gaussians: Gaussians) -> TrainedParameters:
    """The Gaussians as training has them, with one colour each."""
    with np.errstate(divide="ignore"):  # of 0 and 1
        opacities = gaussians.opacities.astype(np.float64)
        logits = np.log(opacities) - np.log1p(-opacities)
    return TrainedParameters.new(
        {
            "means": gaussians.means,
            "rotations": gaussians.rotations_wxyz,
            "log_scales": np.log(gaussians.scales),
            "logits": np.clip(logits, -LOGIT_MAX, LOGIT_MAX).astype(np.float32),
            "sh": np.zeros((gaussians.count, 1, 3), np.float32),
        }
    )
