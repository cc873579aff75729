"""How each photograph was exposed: an affine map of colours, learnt with the Gaussians (Kerbl et al. 2023, code)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.constants.training import EXPOSURE_CHUNK
from lumisplat.device.structs.film import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.device.structs.training import Exposure
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.training.corrections import exposure_kernels as kernels

IDENTITY = np.eye(3, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Exposures:
    """Those of the photographs that are learnt from; their mean stays the identity, or colours would drift."""

    values: Doubles
    """By which colours are multiplied, and what is added to them, shape (K, 3, 4)."""
    adam: Adam

    @classmethod
    def neutral(cls, count: int) -> Exposures:
        """Of photographs that are as they are."""
        return cls(np.repeat(IDENTITY[None], count, axis=0), Adam.still((count, 12), by_rows=True))

    @property
    def state(self) -> dict[str, Doubles]:
        """All that the next step depends on."""
        return {"exposures": self.values} | self.adam.state("exposures")

    def restore(self, state: dict[str, Doubles]) -> None:
        """Goes on from a state."""
        for name, values in self.state.items():
            values[:] = state[name]

    def move(self, number: int, gradient: Doubles, rate: float) -> None:
        """A step of one of them.

        Args:
            number: The photograph.
            gradient: Derivatives of the loss by its exposure, shape (3, 4).
            rate: How far it moves.
        """
        self.values[number] += rate * self.adam.step(gradient.reshape(12), row=number).reshape(3, 4)
        self.values[:] -= self.values.mean(axis=0) - IDENTITY


class ExposedFrame:
    """A frame as a photograph was exposed, and what is before it in the chain rule.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        exposure: Of the photograph, shape (3, 4).
        background: Display-referred sRGB behind the Gaussians, which no exposure changes.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, exposure: Doubles, background: Sequence[float]) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._exposure = Exposure()
        self._exposure.matrix = wp.mat33(*exposure[:, :3].astype(float).reshape(-1))
        self._exposure.offset, self._exposure.background = wp.vec3(*exposure[:, 3]), wp.vec3(*background)

    def of(self, pixels: PixelData) -> PixelData:
        """What a photograph would have of them."""
        exposed, count = PixelData(), len(pixels.alpha)
        exposed.color, exposed.alpha = self._buffers.get("exposed.color", wp.vec3, count), pixels.alpha
        self._launcher.run_banded(kernels.expose, count, self._exposure, pixels, exposed.color)
        return exposed

    def backward(self, pixels: PixelData, by_exposed: PixelGradient) -> tuple[PixelGradient, Doubles]:
        """Derivatives by pixels, and by the exposure, shape (3, 4).

        Args:
            pixels: Of the frame, as it was before.
            by_exposed: Derivatives by what ``of`` has made of them.
        """
        get, count = self._buffers.get, len(pixels.alpha)
        chunks = -(-count // EXPOSURE_CHUNK)
        by_pixels = PixelGradient()
        by_pixels.color, by_pixels.alpha = (
            get("exposed.by_color", wp.vec3, count),
            get("exposed.by_alpha", wp.float32, count),
        )
        sums = get("exposed.by_matrix", wp.mat33, chunks), get("exposed.by_offset", wp.vec3, chunks)
        inputs = (self._exposure, pixels, by_exposed, by_pixels)
        self._launcher.run_banded(kernels.differentiate_chunks, chunks, *inputs, *sums)
        by_matrix, by_offset = (rows.numpy().sum(axis=0, dtype=np.float64) for rows in sums)
        return by_pixels, np.column_stack([by_matrix, by_offset])
