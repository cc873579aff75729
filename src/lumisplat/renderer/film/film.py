"""Host pass: accumulates the samples of rays in the images of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.device.structs.film import FilmShape, LitPixels, PixelData
from lumisplat.device.structs.shading import RayRadiance
from lumisplat.frame.frame import Frame
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.light.light_images import LightImages
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher


class Film:
    """Running means of what the rays of pixels see.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._shape = FilmShape()

    def begin(self, scene: DeviceScene, plan: FramePlan, resume: Frame | None = None) -> None:
        """Starts a frame, or resumes one to add more samples to it."""
        self._plan = plan
        self._shape.width, self._shape.height = scene.image_size
        self._shape.in_blocks = 1
        self._nonfinite.zero_()
        if resume is not None:
            self._restore(resume)

    def add(self, scene: DeviceScene, hits: PrimaryHits, radiance: RayRadiance, lights: LightImages) -> None:
        """Adds the scene's current sample: one ray a pixel."""
        with self._launcher.stage("store"):
            self._launcher.run_banded(
                film_kernels.add_samples,
                hits.count,
                *(self._shape, scene.shading, hits.rays, hits.meshes, hits.gaussians, radiance),
                *(self._pixels.data, self._lit_pixels, self._capture_factor, self._nonfinite),
            )
            for name, values in self._sampled_images(hits, radiance, lights).items():
                self._launcher.run_banded(
                    film_kernels.add_image, hits.count, self._shape, scene.shading, values, self._image(name)
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
        return int(self._nonfinite.numpy().sum())

    def _sampled_images(self, hits: PrimaryHits, radiance: RayRadiance, lights: LightImages) -> dict[str, DeviceArray]:
        """The layers of the sample, an array of wp.vec3 each."""
        images: dict[str, DeviceArray] = {
            name: getattr(radiance, name) for name in ("albedo", "emission", "reflection") if name in self._plan.aovs
        }
        if "hits" in self._plan.aovs:
            images["hits"] = self._buffers.get("film.hit_counts", wp.vec3, hits.count)
            self._launcher.run_banded(film_kernels.count_hits, hits.count, hits.rays, hits.gaussians, images["hits"])
        images |= {f"direct{n}": image for n, image in enumerate(lights.direct)}
        return images | {f"arrived{n}": image for n, image in enumerate(lights.arrived)}

    def _light_images(self, count: int) -> dict[str, FloatArray]:
        shape = (0, self._shape.height, self._shape.width, 3)
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
        return self._image(name).numpy().reshape(self._shape.height, self._shape.width, 3).copy()

    def _image(self, name: str) -> DeviceArray:
        return self._buffers.get(f"film.{name}", wp.vec3, self._pixel_count)

    @property
    def _pixel_count(self) -> int:
        return self._shape.width * self._shape.height

    @property
    def _pixels(self) -> PixelBuffers[PixelData]:
        return PixelBuffers.of(self._buffers, (self._shape.width, self._shape.height))

    @property
    def _lit(self) -> PixelBuffers[LitPixels]:
        return PixelBuffers.of_light(self._buffers, (self._shape.width, self._shape.height))

    @property
    def _lit_pixels(self) -> LitPixels:
        return self._lit.data if self._plan.is_lit else LitPixels()

    @property
    def _capture_factor(self) -> DeviceArray | None:
        return self._image("capture_factor") if self._plan.has_shadow_only else None

    @property
    def _nonfinite(self) -> DeviceArray:
        return self._buffers.get("film.nonfinite", wp.int32, self._pixel_count)


def images_of_pixels(pixels: PixelBuffers[PixelData]) -> dict[str, Any]:
    """Downloads the images of a frame, by the names of `Frame`'s fields."""
    images: dict[str, Any] = pixels.download()
    images["gaussian_index"], images["instance_index"] = images.pop("gaussian"), images.pop("instance")
    return images
