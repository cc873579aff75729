"""Host pass: accumulates the samples of rays in the images of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.constants import COUNT_SUM_THREADS
from lumisplat.device.structs.film import FilmData, LitPixels, PixelData
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.light.light_images import LightImages
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, rows_of
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

    def images(self, light_count: int) -> dict[str, Any]:
        """The images of the frame, by the names of `Frame`'s fields."""
        images = images_of_pixels(self._pixels)
        if self._plan.is_lit:
            lit = self._lit.download()
            images |= {"captured": images["color"], "captured_weight": lit["captured_weight"], "light": lit["light"]}
            images |= {"color": lit["color"], "color_space": "linear"}
        for name in ("albedo", "emission", "reflection"):
            if name in self._plan.aovs:
                images[name] = self._download(name)
        if "hits" in self._plan.aovs:
            images["hits"] = self._download("hits")[..., 0]
        if "lights" in self._plan.aovs:
            images |= self._light_images(light_count)
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

    def _light_images(self, count: int) -> dict[str, FloatArray]:
        shape = (0, *reversed(self._size), 3)
        direct = [self._download(f"direct{n}") for n in range(count)]
        arrived = [self._download(f"arrived{n}") for n in range(count)]
        shares = [np.divide(a, d, out=np.ones_like(a), where=d > 0.0) for a, d in zip(arrived, direct, strict=True)]
        return {
            "light_direct": np.stack(direct) if direct else np.zeros(shape, np.float32),
            "light_shadow": np.clip(np.stack(shares), 0.0, 1.0) if shares else np.zeros(shape, np.float32),
        }

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

    def _download(self, name: str) -> FloatArray:
        return self._image(name).numpy().reshape(*reversed(self._size), 3).copy()

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


def images_of_pixels(pixels: PixelBuffers[PixelData]) -> dict[str, Any]:
    """Downloads the images of a frame, by the names of `Frame`'s fields."""
    images: dict[str, Any] = pixels.download()
    images["gaussian_index"], images["instance_index"] = images.pop("gaussian"), images.pop("instance")
    return images
