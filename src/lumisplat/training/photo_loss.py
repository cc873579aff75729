"""Host pass: the loss between a frame and a photograph, and its derivatives by the frame's pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.training import LossGrid, LossMaps, LossWeights, Photograph
from lumisplat.math.arrays import FloatArray
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.training import loss_kernels


@dataclass(frozen=True, slots=True)
class Loss:
    """How far a frame is from a photograph; means over pixels and channels that count."""

    l1: float
    squared: float
    """Mean squared error."""
    ssim: float
    """-1..1."""
    alpha: float
    """Mean error of alpha; 0 where it is not known."""
    entropy: float
    """Mean cross entropy of alpha, likewise."""
    total: float
    """What is minimised."""


class PhotoLoss:
    """Compares frames with photographs.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        ssim: Share of SSIM, 0..1; the rest is L1.
        alpha: Weight of the error of alpha.
        entropy: Weight of the cross entropy of alpha.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, *, ssim: float, alpha: float, entropy: float = 0.0
    ) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._ssim, self._alpha, self._entropy = ssim, alpha, entropy
        self.counted = 1.0
        """Sum of what counts of the photograph, pixels."""

    def load(self, color: FloatArray, weight: FloatArray | None, alpha: FloatArray | None) -> Photograph:
        """A photograph on the device, until the next one is loaded.

        Args:
            color: Display-referred sRGB, 0..1, shape (H, W, 3).
            weight: What counts, 0..1, shape (H, W); None: all.
            alpha: What the frame's alpha should be, shape (H, W); None: nobody knows.
        """
        photograph = Photograph()
        self.counted = float(color.shape[0] * color.shape[1] if weight is None else weight.sum(dtype=np.float64)) or 1.0
        photograph.color = self._buffers.upload("photograph.color", wp.vec3, color.reshape(-1, 3))
        none = np.zeros(0, np.float32)
        for name, values in (("weight", weight), ("alpha", alpha)):
            array = none if values is None else np.ascontiguousarray(values.reshape(-1), np.float32)
            setattr(photograph, name, self._buffers.upload(f"photograph.{name}", wp.float32, array))
        return photograph

    def differentiate(
        self, size: tuple[int, int], pixels: PixelData, photograph: Photograph
    ) -> tuple[Loss, PixelGradient]:
        """The loss of a frame, and its derivatives.

        Args:
            size: Width and height, pixels.
            pixels: Of the frame.
            photograph: Of the same size.
        """
        width, height = size
        run, get, count = self._launcher.run_banded, self._buffers.get, width * height
        grid = LossGrid()
        grid.width, grid.height, grid.run = width, height, 1 if self._launcher.is_parallel else width
        runs = count // grid.run
        maps, derivatives = (self._buffers.struct(f"loss.{name}", LossMaps, count) for name in ("maps", "derivatives"))
        ssim, sums = get("loss.ssim", wp.float32, runs), get("loss.sums", wp.vec4, runs)
        gradient = PixelGradient()
        gradient.color, gradient.alpha = get("loss.color", wp.vec3, count), get("loss.alpha", wp.float32, count)
        with self._launcher.stage("loss"):
            run(loss_kernels.blur_rows, runs, grid, pixels.color, photograph, maps)
            run(loss_kernels.compare_rows, runs, grid, maps, derivatives, ssim)
            run(loss_kernels.spread_rows, runs, grid, derivatives, maps)
            inputs = (grid, self._weights(), pixels.color, pixels.alpha, photograph, maps)
            run(loss_kernels.differentiate_rows, runs, *inputs, gradient.color, gradient.alpha, sums)
            if runs > height:
                of_runs = ssim, sums
                ssim, sums = get("loss.row_ssim", wp.float32, height), get("loss.row_sums", wp.vec4, height)
                run(loss_kernels.add_rows, height, grid, *of_runs, ssim, sums)
        return self._loss(count, ssim.numpy(), sums.numpy()), gradient

    def _weights(self) -> LossWeights:
        weights = LossWeights()
        weights.l1 = (1.0 - self._ssim) / (3.0 * self.counted)
        weights.ssim = self._ssim / (3.0 * self.counted)
        weights.alpha = self._alpha / self.counted
        weights.entropy = self._entropy / self.counted
        return weights

    def _loss(self, count: int, ssim_rows: FloatArray, sums: FloatArray) -> Loss:
        """Means over pixels that count; where none does, frame and photograph are the same, and SSIM is 1."""
        total = self.counted
        ssim = 1.0 - (3.0 * count - float(ssim_rows.sum(dtype=np.float64))) / (3.0 * total)
        means = sums.sum(axis=0, dtype=np.float64) / (3.0 * total, 3.0 * total, total, total)
        l1, squared, alpha, entropy = (float(mean) for mean in means)
        loss = (1.0 - self._ssim) * l1 + self._ssim * (1.0 - ssim) + self._alpha * alpha + self._entropy * entropy
        return Loss(l1, squared, ssim, alpha, entropy, loss)
