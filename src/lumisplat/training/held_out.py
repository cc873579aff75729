"""What is measured on photographs that were not learnt from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from lumisplat.config import RasterConfig, RenderConfig, TrainConfig
from lumisplat.io.files.atomic import atomic_write
from lumisplat.io.training_images.loading import Photograph
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.renderer import Renderer, create_renderer
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene
from lumisplat.training.curve import decibels


@dataclass(frozen=True, slots=True)
class HeldOutScore:
    """How near a capture is to photographs that it was not learnt from."""

    psnr: float
    """Mean over photographs, dB."""
    of_views: dict[str, float]
    """PSNR of each, dB."""


class HeldOut:
    """Renders and compares what was held out.

    Args:
        photographs: Those that were not learnt from; there may be none.
        device: As of `lumisplat.create_renderer`.
        threads: As of `lumisplat.create_renderer`.
        config: What draws captures; None: ellipses.
    """

    def __init__(
        self,
        photographs: Sequence[Photograph],
        device: str,
        threads: int | None,
        config: TrainConfig | None = None,
    ) -> None:
        self._photographs = photographs
        self._renderer: Renderer | None = None
        if photographs:
            background = photographs[0].background or (0.0, 0.0, 0.0)
            drawn_by = config or TrainConfig()
            raster = RasterConfig(projection=drawn_by.projection)
            settings = RenderConfig(pipeline=drawn_by.pipeline, background=background, raster=raster, lighting=False)
            self._renderer = create_renderer(settings, device, threads=threads)
            self._renderer.render(Scene(), photographs[0].camera)  # so that no kernel is compiled while others wait

    def psnr(self, gaussians: Gaussians) -> float | None:
        """The mean, dB; None: nothing was held out."""
        score = self.score(gaussians)
        return None if score is None else score.psnr

    def score(self, gaussians: Gaussians, progress: Callable[[str, float], None] | None = None) -> HeldOutScore | None:
        """Of each photograph, over what counts of it; None: nothing was held out."""
        found: dict[str, float] = {}
        for number, photograph in enumerate(self._photographs):
            if progress is not None:
                progress("measuring", number / len(self._photographs))
            mask = photograph.mask()
            if mask is None or mask.any():  # what a lens does not show may be all that a mask shows
                found[photograph.name] = masked_psnr(self.shown(gaussians, photograph), photograph)
        if progress is not None:
            progress("measuring", 1.0)
        return HeldOutScore(float(np.mean(list(found.values()))), found) if found else None

    def shown(self, gaussians: Gaussians, photograph: Photograph) -> FloatArray:
        """What a capture shows in place of a photograph, 0..1, shape (H, W, 3)."""
        assert self._renderer is not None
        frame = self._renderer.render(Scene([gaussians]), photograph.camera)
        return np.clip(frame.color, 0.0, 1.0).astype(np.float32)

    def preview(self, gaussians: Gaussians, path: Path) -> None:
        """Writes the first photograph beside what a capture shows in its place."""
        if self._photographs:
            write_pair(path, self._photographs[0].pixels(), self.shown(gaussians, self._photographs[0]))

    def write_pairs(self, gaussians: Gaussians, folder: Path) -> None:
        """Writes all photographs beside what a capture shows in their places."""
        for photograph in self._photographs:
            write_pair(
                folder / f"{file_name(photograph.name)}.png", photograph.pixels(), self.shown(gaussians, photograph)
            )


def file_name(name: str) -> str:
    """A name that any file may have, another one for each name: what may not be in it becomes its number."""
    return "".join(char if char.isalnum() or char in "-_." else f"%{ord(char):02X}" for char in name)


def masked_psnr(shown: FloatArray, photograph: Photograph) -> float:
    """PSNR over the pixels that count, by how much they do, dB."""
    squared = ((shown - photograph.pixels()) ** 2).mean(axis=2)
    return decibels(float(np.average(squared, weights=photograph.mask())))


def write_pair(path: Path, photograph: FloatArray, shown: FloatArray) -> None:
    """Writes a photograph and, to its right, what stands for it."""
    pair = (255.0 * np.concatenate([photograph, shown], axis=1) + 0.5).astype(np.uint8)
    with atomic_write(path) as temporary:
        Image.fromarray(pair).save(temporary, format="PNG")
