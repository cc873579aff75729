"""Host pass: accumulates the samples of rays in the images of a frame."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.constants import COUNT_SUM_THREADS
from lumisplat.device.structs.film import FilmData, LitPixels, PixelData
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.picture import encoded_lit_pixels, encoded_pixels, picture_data, picture_of
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.light.light_images import LightImages
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, rows_of
from lumisplat.runtime.downloads import Copies
from lumisplat.runtime.launcher import Launcher


class Film:
    """Running means of what the rays of pixels see.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._size = (0, 0)

    def begin(self, scene: DeviceScene, plan: FramePlan, resume: Frame | None = None) -> None:
        """Starts a frame, or resumes one to add more samples to it."""
        self._plan = plan
        self._size = scene.image_size
        row = FilmData()
        row.width, row.height, row.in_blocks = *self._size, 1
        row.pixels, row.nonfinite = self._pixels.data, self._nonfinite
        if plan.is_lit:
            row.lit = self._lit.data
        if plan.has_shadow_only:
            row.capture_factor = self._image("capture_factor")
        self._data = self._buffers.upload("film", FilmData, rows_of([row]))
        self._nonfinite.zero_()
        if resume is not None:
            self._restore(resume)

    def add(self, scene: DeviceScene, wave: RayWave, lights: LightImages) -> None:
        """Adds the scene's current sample: the first wave, with one ray a pixel; on CUDA by a captured graph."""
        self._launcher.replay("store", scene.graph_key, lambda: self._store(scene, wave, lights))

    def _store(self, scene: DeviceScene, wave: RayWave, lights: LightImages) -> None:
        with self._launcher.stage("store"):
            self._launcher.run_banded(film_kernels.add_samples, wave.count, scene.shading, wave.data, self._data)
            if self._launcher.is_parallel:  # then the frame's count is one number to download
                self._nonfinite_total.zero_()
                self._launcher.run(film_kernels.sum_counts, COUNT_SUM_THREADS, self._nonfinite, self._nonfinite_total)
            for name, values in self._sampled_images(wave, lights).items():
                self._launcher.run_banded(
                    film_kernels.add_image, wave.count, scene.shading, self._data, values, self._image(name)
                )

    def unlit_images(self, pixels: PixelBuffers[PixelData], *, transparent: bool) -> dict[str, Any]:
        """As ``images``, of a frame whose ``pixels`` were drawn in one go."""
        encode = partial(encoded_pixels, self._launcher, self._buffers, pixels, transparent=transparent)
        return self._copied(pixels, {}, encode, transparent=transparent)[1]

    def images(self, light_count: int, exposure: float, config: RenderConfig) -> dict[str, Any]:
        """The images of the frame, by the names of `Frame`'s fields; on CUDA functions that download them.

        Args:
            light_count: Lights of the frame, for its layers.
            exposure: Of the camera, for the picture that is encoded on CUDA.
            config: Says how that is shown.
        """
        transparent = config.background is None
        layers = [name for name in ("albedo", "emission", "reflection", "hits") if name in self._plan.aovs]
        if "lights" in self._plan.aovs:
            layers += [f"{kind}{n}" for kind in ("direct", "arrived") for n in range(light_count)]
        arrays = {name: self._image(name) for name in layers}
        if self._plan.is_lit:
            arrays["lit"] = self._lit.block
            display = picture_data(exposure, config.tone_map, transparent=transparent)
            encode = partial(encoded_lit_pixels, self._launcher, self._buffers, self._pixels, self._lit, display)
        else:
            encode = partial(encoded_pixels, self._launcher, self._buffers, self._pixels, transparent=transparent)
        copies, images = self._copied(self._pixels, arrays, encode, transparent=transparent)
        if self._plan.is_lit:
            lit = self._lit.images(copies, "lit")
            images |= {"captured": images["color"], "captured_weight": lit["captured_weight"], "light": lit["light"]}
            images |= {"color": lit["color"], "color_space": "linear"}
        for name in ("albedo", "emission", "reflection"):
            if name in self._plan.aovs:
                images[name] = copies.give(partial(self._layer, self._size, copies, name))
        size = self._size
        if "hits" in self._plan.aovs:
            images["hits"] = copies.give(lambda: self._layer(size, copies, "hits")[..., 0])
        if "lights" in self._plan.aovs:
            images["light_direct"] = copies.give(lambda: self._layers(size, copies, "direct", light_count))
            images["light_shadow"] = copies.give(lambda: self._shadow_shares(size, copies, light_count))
        return images

    @property
    def nonfinite_count(self) -> int:
        """Samples since ``begin`` whose colour was NaN or infinite."""
        if self._launcher.is_parallel:
            return int(self._nonfinite_total.numpy()[0])
        counts = self._nonfinite.numpy()
        return int(counts.sum()) if counts.any() else 0

    def _sampled_images(self, wave: RayWave, lights: LightImages) -> dict[str, DeviceArray]:
        """The layers of the sample, an array of wp.vec3 each."""
        images: dict[str, DeviceArray] = {
            name: getattr(wave.row.radiance, name)
            for name in ("albedo", "emission", "reflection")
            if name in self._plan.aovs
        }
        if "hits" in self._plan.aovs:
            images["hits"] = self._buffers.get("film.hit_counts", wp.vec3, wave.count)
            self._launcher.run_banded(film_kernels.count_hits, wave.count, wave.data, images["hits"])
        images |= {f"direct{n}": image for n, image in enumerate(lights.direct)}
        return images | {f"arrived{n}": image for n, image in enumerate(lights.arrived)}

    def _copied(
        self,
        pixels: PixelBuffers[PixelData],
        arrays: dict[str, DeviceArray],
        encode: Callable[[], DeviceArray],
        *,
        transparent: bool,
    ) -> tuple[Copies, dict[str, Any]]:
        """Copies of pixels and of other arrays, and the images of the pixels; on CUDA a picture, too."""
        arrays = {"pixels": pixels.block} | arrays
        is_lazy = self._buffers.downloads.is_lazy
        if is_lazy:
            arrays["picture"] = encode()
        copies = self._buffers.downloads.copies(arrays)
        images = _images_of_pixels(pixels, copies)
        if is_lazy:
            images["picture"] = picture_of(copies, "picture", pixels.size, transparent=transparent)
        return copies, images

    @staticmethod
    def _layer(size: tuple[int, int], copies: Copies, name: str) -> FloatArray:
        return copies.words(name).reshape(*reversed(size), 3)

    @classmethod
    def _layers(cls, size: tuple[int, int], copies: Copies, kind: str, count: int) -> FloatArray:
        layers = [cls._layer(size, copies, f"{kind}{n}") for n in range(count)]
        return np.stack(layers) if layers else np.zeros((0, *reversed(size), 3), np.float32)

    @classmethod
    def _shadow_shares(cls, size: tuple[int, int], copies: Copies, count: int) -> FloatArray:
        """What of the direct light of each light arrives."""
        direct, arrived = (cls._layers(size, copies, kind, count) for kind in ("direct", "arrived"))
        return np.clip(np.divide(arrived, direct, out=np.ones_like(arrived), where=direct > 0.0), 0.0, 1.0)

    def _restore(self, frame: Frame) -> None:
        """Uploads the images of a frame whose samples are continued."""
        self._pixels.upload(
            {
                "color": frame.color if frame.captured is None else frame.captured,
                "alpha": frame.alpha,
                "depth": frame.depth,
                "normal": frame.normal,
                "gaussian": frame.gaussian_index,
                "instance": frame.instance_index,
            }
        )
        if frame.light is not None and frame.captured_weight is not None:
            lit = {"captured_weight": frame.captured_weight, "light": frame.light, "color": frame.color}
            self._lit.upload(lit)

    def _image(self, name: str) -> DeviceArray:
        return self._buffers.get(f"film.{name}", wp.vec3, self._pixel_count)

    @property
    def _pixel_count(self) -> int:
        return self._size[0] * self._size[1]

    @property
    def _pixels(self) -> PixelBuffers[PixelData]:
        return PixelBuffers.of(self._buffers, self._size)

    @property
    def _lit(self) -> PixelBuffers[LitPixels]:
        return PixelBuffers.of_light(self._buffers, self._size)

    @property
    def _nonfinite(self) -> DeviceArray:
        return self._buffers.get("film.nonfinite", wp.int32, self._pixel_count)

    @property
    def _nonfinite_total(self) -> DeviceArray:
        return self._buffers.get("film.nonfinite_total", wp.int64, 1)


def _images_of_pixels(pixels: PixelBuffers[PixelData], copies: Copies) -> dict[str, Any]:
    """The images of a frame, by the names of `Frame`'s fields, in copies of its ``pixels``."""
    images = pixels.images(copies, "pixels")
    images["gaussian_index"], images["instance_index"] = images.pop("gaussian"), images.pop("instance")
    return images
