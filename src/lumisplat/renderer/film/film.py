"""The film, which accumulates the samples of rays in the images of a frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.config.render import PATH_PARTS, REALTIME_AOVS
from lumisplat.constants import COUNT_SUM_THREADS, NOISE_PIXELS, NOISE_SAMPLES_MIN
from lumisplat.device.structs.camera import FilmData, ListedRays, LitPixels, PixelData, PixelSums
from lumisplat.errors import ConfigError
from lumisplat.frame.frame import Frame, ReadPicture
from lumisplat.frame.sample_part import SamplePart
from lumisplat.math.arrays import FloatArray, IntArray
from lumisplat.renderer.film import film_kernels, picture_kernels
from lumisplat.renderer.film.adaptive_rays import AdaptiveRays, least_luminance, quantile
from lumisplat.renderer.film.catcher_ratios import CatcherRatios
from lumisplat.renderer.film.picture import encoded_lit_pixels, encoded_pixels, picture_data, picture_of
from lumisplat.renderer.film.pixel_buffers import PixelBuffers, pixel_sums
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import LightImages, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array, rows_of
from lumisplat.runtime.downloads import Awaited, Copies, HostCopy
from lumisplat.runtime.launcher import KernelModule, Launcher

CATCHER_LAYERS = {
    "captured_all": "captured_all",
    "captured_part": "captured_part",
    "captured_received": "received",
    "captured_unshadowed": "unshadowed",
    "captured_shadowed": "shadowed",
    "captured_emitted_unshadowed": "emitted_unshadowed",
    "captured_emitted_shadowed": "emitted_shadowed",
    "captured_ambient": "ambient",
    "captured_open": "open",
}
"""Images of the film for the components of the light on shadow catchers: from the name of the image to the field of
`RayRadiance` whose samples the image averages."""


class Film:
    """Accumulates the radiance of rays per pixel, and produces the images of the frame.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._size = (0, 0)
        self._light_count = 0
        self._samples = 0
        self._adaptive = AdaptiveRays(launcher, buffers)
        self._catchers = CatcherRatios(launcher, buffers)
        self._total = HostCopy(self._count_total)
        self.nonfinite_count: Callable[[], int] = lambda: 0
        """Returns the number of samples of the last finished frame that were NaN or infinite, and were dropped.

        On CUDA the call waits for the frame."""

    def modules(self, plan: FramePlan, *, encodes: bool) -> list[KernelModule]:
        """Returns the kernel modules that the film needs for a frame. On CUDA, every frame is encoded to 8 bits."""
        modules: list[KernelModule] = []
        if encodes or self._launcher.is_cuda:
            modules += [picture_kernels.LIT if plan.is_lit else picture_kernels]
        if plan.is_sampled:
            modules += [film_kernels, *(self._adaptive.modules() if plan.adapts else [])]
            modules += self._catchers.modules() if has_catchers(plan) else []
        return modules

    def begin(
        self, scene: DeviceScene, plan: FramePlan, resume: Frame | None = None, part: SamplePart | None = None
    ) -> None:
        """Starts a frame, or resumes one to add more samples to it.

        Args:
            scene: The scene.
            plan: Plan of the frame.
            resume: The frame to resume; None: a new frame.
            part: The range of samples to render, if processes share the frame; None: all. Samples that the part already
                holds are restored.

        Raises:
            ConfigError: The frame to resume lacks accumulated images.
        """
        self._plan = plan
        self._size = scene.image_size
        self._light_count = len(scene.lights.names)
        is_more = plan.samples > 1 or resume is not None or part is not None
        self._has_sums = is_more or self._has_catchers
        row = FilmData()
        row.width, row.height, row.in_blocks = *self._size, 1
        row.in_sequence = int(plan.has_history)
        row.first_sample = 0 if part is None else part.first
        row.pixels, row.count = self._pixels.data, self._count
        if plan.is_lit:
            row.lit = self._lit.data
        if plan.has_shadow_catchers:
            row.capture_factor = self._image("capture_factor")
        if plan.has_receivers:
            for name in CATCHER_LAYERS:
                setattr(row, name, self._image(name))
        if self._has_catchers:
            row.ratio = self._ratio
        if self._has_sums:
            row.sums = self._sums[0]
            self._sums[1].zero_()
        if plan.adapts:
            self._adaptive.begin(self._size)
            row.listed = self._adaptive.listed
        self._data = self._buffers.upload("film", FilmData, rows_of([row]))
        self._count.zero_()
        self._samples = 0
        if resume is not None:
            self._restore(resume.samples, resume.accumulated or {}, _images_of_frame(resume))
        elif part is not None and part.accumulated:
            self._restore(part.count, part.accumulated, _images_of_part(part))

    def rays_of(self, sample: int, exposure: float) -> ListedRays | None:
        """Returns the rays of the pixels that take part in a sample; None: all pixels take part.

        Args:
            sample: Index of the sample in the frame; pixels with a low sampling rate skip some indices.
            exposure: Exposure of the camera, stops.
        """
        self._samples += 1
        if not self._plan.adapts:
            return None
        if sample == NOISE_SAMPLES_MIN:
            self._adaptive.choose_rates(self._data, least_luminance(exposure, is_lit=self._plan.is_lit))
        return self._adaptive.list(sample, jitters=self._plan.jitters)

    def add(self, scene: DeviceScene, wave: RayWave, lights: LightImages) -> None:
        """Adds the current sample: the radiance of the camera rays ``wave``, and the layers ``lights``."""
        with self._launcher.stage("store"):
            for name, values in self._sampled_images(wave, lights).items():
                inputs = scene.shading, wave.data, self._data, values, self._image(name)
                self._launcher.run_banded(film_kernels.add_image, wave.count, *inputs)
            self._launcher.run_banded(film_kernels.add_samples, wave.count, scene.shading, wave.data, self._data)

    def noise(self, exposure: float) -> float:
        """Estimates the noise of the frame, a relative error: a fraction `NOISE_PIXELS` of all pixels has less.

        Args:
            exposure: Exposure of the camera, stops; dark pixels count as less noisy.
        """
        errors = self._buffers.get("film.errors", wp.float32, self._pixel_count)
        with self._launcher.stage("noise"):
            least = least_luminance(exposure, is_lit=self._plan.is_lit)
            self._launcher.run_banded(film_kernels.relative_errors, self._pixel_count, least, self._data, errors)
            return quantile(errors.numpy(), NOISE_PIXELS)

    def finish(self, scene: DeviceScene) -> None:
        """Computes the images from sums and counts after the last sample; on CUDA by a recorded CUDA graph."""
        self.nonfinite_count()  # of the frame before, whose copy of the count is now overwritten
        self._launcher.replay("finish", (scene.graph_key, self._has_sums), lambda: self._finish(scene))
        drawn = self._samples * self._pixel_count
        if self._plan.adapts:
            drawn = self._adaptive.total_before(self._samples)
        if self._launcher.is_parallel:
            self._total.update()
            total = self._total.values  # without the film: a frame must not keep the renderer's memory
            self.nonfinite_count = Awaited(self._launcher.mark(), lambda: drawn - int(total[0]))
        else:
            count = drawn - int(self._count.numpy().sum(dtype=np.int64))
            self.nonfinite_count = lambda: count

    def _finish(self, scene: DeviceScene) -> None:
        with self._launcher.stage("store"):
            if self._has_sums:
                self._launcher.run_banded(film_kernels.average_samples, self._pixel_count, self._data)
            if "variance" in self._plan.aovs:
                variance = self._image("variance")
                self._launcher.run_banded(film_kernels.estimate_variance, self._pixel_count, self._data, variance)
            if self._has_catchers:
                self._catchers.develop(scene, self._data, self._pixel_count)
            elif "shadow_ratio" in self._plan.aovs:
                self._ratio.fill_(1.0)
            if self._adds_captured:
                adds_color = self._plan.traces_paths
                inputs = adds_color, self._data, self._image("emission"), self._image("emission_total")
                self._launcher.run_banded(film_kernels.add_captured, self._pixel_count, *inputs)
            if self._launcher.is_parallel:  # so that only one number has to be downloaded
                self._count_total.zero_()
                self._launcher.run(film_kernels.sum_counts, COUNT_SUM_THREADS, self._count, self._count_total)

    def unlit_images(self, pixels: PixelBuffers[PixelData], *, transparent: bool, encodes: bool) -> dict[str, Any]:
        """Returns the images of an unlit frame that was rasterised directly to ``pixels``, by field name of `Frame`."""
        encode = partial(encoded_pixels, self._launcher, self._buffers, pixels, transparent=transparent)
        return self._copied(pixels, {}, encode, transparent=transparent, encodes=encodes)[1]

    def images(self, exposure: float, config: RenderConfig, *, encodes: bool) -> dict[str, Any]:
        """Returns the images of the frame by field name of `Frame`; on CUDA, functions that download the images.

        Args:
            exposure: Exposure of the camera for the 8-bit image, stops.
            config: Settings of the 8-bit image: background and tone map.
            encodes: Whether to encode an 8-bit image; on CUDA it is always encoded.
        """
        transparent = config.background is None
        arrays = self._accumulated()
        accumulated = [*arrays]
        if "variance" in self._plan.aovs:
            arrays["variance"] = self._image("variance")
        if "shadow_ratio" in self._plan.aovs:
            arrays["shadow_ratio"] = self._ratio
        if self._adds_captured:
            arrays["emission_total"] = self._image("emission_total")
        if self._plan.is_lit:
            arrays["lit"] = self._lit.block
        encode = partial(self._encoded, exposure, config)
        copies, images = self._copied(self._pixels, arrays, encode, transparent=transparent, encodes=encodes)
        if self._plan.is_lit:
            lit = self._lit.images(copies, "lit")
            images |= {"captured": images["color"], "captured_weight": lit["captured_weight"], "light": lit["light"]}
            images |= {"color": lit["color"], "color_space": "linear"}
        return images | self._layer_images(copies) | {"accumulated": copies.lazy(partial(_words, copies, accumulated))}

    def picture(self, exposure: float, config: RenderConfig) -> ReadPicture:
        """Encodes the 8-bit image again with another exposure or tone map, and returns the function that fetches it."""
        copies = self._buffers.downloads.copies({"picture": self._encoded(exposure, config)})
        return picture_of(copies, "picture", self._pixels.size, transparent=config.background is None)

    def _encoded(self, exposure: float, config: RenderConfig) -> DeviceArray:
        """Encodes the frame to 8 bits, and returns the bytes on the device."""
        transparent = config.background is None
        if not self._plan.is_lit:
            return encoded_pixels(self._launcher, self._buffers, self._pixels, transparent=transparent)
        display = picture_data(exposure, config.tone_map, transparent=transparent)
        return encoded_lit_pixels(self._launcher, self._buffers, self._pixels, self._lit, display)

    def _layer_images(self, copies: Copies) -> dict[str, Any]:
        """Returns the layers that the frame's settings request (AOVs), by field name of `Frame`."""
        images: dict[str, Any] = {}
        size, light_count = self._size, self._light_count
        for name in ("albedo", "reflection", "variance", "shadow_ratio", *PATH_PARTS, "cache"):
            if name in self._plan.aovs:
                source = "emission_total" if name == "emission" and self._adds_captured else name
                images[name] = copies.lazy(partial(self._layer, size, copies, source))
        for name in ("hits", "history"):
            if name in self._plan.aovs:
                images[name] = copies.lazy(partial(self._channel, size, copies, name))
        for name in ("probes", "cache_cells"):
            if name in self._plan.aovs:
                images[name] = copies.lazy(partial(self._integers, size, copies, name))
        if "motion" in self._plan.aovs:
            images["motion"] = copies.lazy(lambda: np.nan_to_num(self._layer(size, copies, "motion")))
            images["motion_known"] = copies.lazy(lambda: self._is_number(size, copies, "motion"))
        if "sample_count" in self._plan.aovs:
            images["sample_count"] = copies.lazy(lambda: copies.words("count").view(np.int32).reshape(*reversed(size)))
        if "lights" in self._plan.aovs:
            images["light_direct"] = copies.lazy(lambda: self._layers(size, copies, "direct", light_count))
            images["light_shadow"] = copies.lazy(lambda: self._shadow_shares(size, copies, light_count))
            if self._plan.traces_paths:
                images["light_total"] = copies.lazy(lambda: self._layers(size, copies, "total", light_count + 1))
        if "bounces" in self._plan.aovs:
            count = self._plan.max_bounces + 2
            images["bounces"] = copies.lazy(lambda: self._layers(size, copies, "bounce", count))
        return images

    def _sampled_images(self, wave: RayWave, lights: LightImages) -> dict[str, DeviceArray]:
        """Returns the layers (AOVs) of the current sample by name, each an array of one wp.vec3 per ray."""
        images: dict[str, DeviceArray] = {
            name: getattr(wave.row.radiance, name)
            for name in ("albedo", "emission", "reflection")
            if name in self._plan.aovs
        }
        if self._plan.has_receivers:
            radiance = wave.row.radiance
            images |= {name: device_array(getattr(radiance, field)) for name, field in CATCHER_LAYERS.items()}
        if self._plan.has_shadow_catchers:
            images["capture_factor"] = device_array(wave.row.radiance.capture_factor)
        if "hits" in self._plan.aovs:
            images["hits"] = self._buffers.get("film.hit_counts", wp.vec3, wave.count)
            self._launcher.run_banded(film_kernels.count_hits, wave.count, wave.data, images["hits"])
        images |= {f"direct{n}": image for n, image in enumerate(lights.direct)}
        return images | {f"arrived{n}": image for n, image in enumerate(lights.arrived)} | lights.layers

    def _accumulated(self) -> dict[str, DeviceArray]:
        """Returns the arrays of sums, counts and means to which samples are added, by name."""
        names = [
            name for name in ("albedo", "reflection", "hits", *PATH_PARTS, *REALTIME_AOVS) if name in self._plan.aovs
        ]
        names += ["capture_factor"] * self._plan.has_shadow_catchers
        names += CATCHER_LAYERS if self._plan.has_receivers else ()
        if "bounces" in self._plan.aovs:
            names += [f"bounce{n}" for n in range(self._plan.max_bounces + 2)]
        if "lights" in self._plan.aovs:
            names += [f"{kind}{n}" for kind in ("direct", "arrived") for n in range(self._light_count)]
            names += [f"total{n}" for n in range(self._light_count + 1) if self._plan.traces_paths]
        arrays: dict[str, DeviceArray] = {"count": self._count} | {name: self._image(name) for name in names}
        arrays |= {"rates": self._adaptive.rates} if self._plan.adapts else {}
        return arrays | ({"sums": self._sums[1]} if self._has_sums else {})

    def _copied(
        self,
        pixels: PixelBuffers[PixelData],
        arrays: dict[str, DeviceArray],
        encode: Callable[[], DeviceArray],
        *,
        transparent: bool,
        encodes: bool,
    ) -> tuple[Copies, dict[str, Any]]:
        """Copies pixels and other arrays; returns the copies, and functions or arrays for the pixels' images.

        The images include an 8-bit image on CUDA always, on the CPU if ``encodes``.
        """
        arrays = {"pixels": pixels.block} | arrays
        encodes = encodes or self._buffers.downloads.is_lazy
        if encodes:
            arrays["picture"] = encode()
        copies = self._buffers.downloads.copies(arrays)
        images = _images_of_pixels(pixels, copies)
        if encodes:
            images["picture"] = picture_of(copies, "picture", pixels.size, transparent=transparent)
        return copies, images

    @staticmethod
    def _layer(size: tuple[int, int], copies: Copies, name: str) -> FloatArray:
        return copies.words(name).reshape(*reversed(size), 3)

    @classmethod
    def _channel(cls, size: tuple[int, int], copies: Copies, name: str) -> FloatArray:
        """Returns the first channel of layer ``name``, shape (H, W), from downloaded copies of the film's arrays."""
        return cls._layer(size, copies, name)[..., 0]

    @classmethod
    def _integers(cls, size: tuple[int, int], copies: Copies, name: str) -> IntArray:
        """Returns the first channel of layer ``name`` as integers, shape (H, W), from downloaded copies."""
        return cls._channel(size, copies, name).astype(np.int32)

    @classmethod
    def _is_number(cls, size: tuple[int, int], copies: Copies, name: str) -> IntArray:
        """Returns 1 where a layer's first channel is a number and 0 where it is NaN, shape (H, W)."""
        return (~np.isnan(cls._channel(size, copies, name))).astype(np.int32)

    @classmethod
    def _layers(cls, size: tuple[int, int], copies: Copies, kind: str, count: int) -> FloatArray:
        layers = [cls._layer(size, copies, f"{kind}{n}") for n in range(count)]
        return np.stack(layers) if layers else np.zeros((0, *reversed(size), 3), np.float32)

    @classmethod
    def _shadow_shares(cls, size: tuple[int, int], copies: Copies, count: int) -> FloatArray:
        """Returns the fraction of each light's direct light that no object shadows, shape (count, H, W, 3)."""
        direct, arrived = (cls._layers(size, copies, kind, count) for kind in ("direct", "arrived"))
        return np.clip(np.divide(arrived, direct, out=np.ones_like(arrived), where=direct > 0.0), 0.0, 1.0)

    def _restore(
        self, samples: int, accumulated: Mapping[str, FloatArray], images: dict[str, npt.NDArray[Any]]
    ) -> None:
        """Uploads the accumulated arrays of ``samples`` samples, and the images that further samples do not change."""
        arrays = self._accumulated()
        implied = {"sums"} if samples == 1 else set[str]()  # a frame of one sample holds that sample in its images
        if missing := arrays.keys() - accumulated.keys() - implied:
            names = ", ".join(sorted(missing))
            raise ConfigError(
                f"cannot resume a frame that lacks accumulated images: {names}; render it again with these settings"
            )
        self._pixels.upload(images)
        if self._plan.is_lit:
            self._lit.upload(images | {"color": images["lit_color"]})
        for name, array in arrays.items():
            if name in accumulated:
                array.assign(_elements(accumulated[name], array))
        if "sums" not in accumulated:
            self._launcher.run_banded(film_kernels.restore_sums, self._pixel_count, self._data)
        self._samples = samples

    @property
    def _adds_captured(self) -> bool:
        """True if the emission layer still lacks captured colours, or the amount by which lights change them."""
        return "emission" in self._plan.aovs and (self._plan.traces_paths or self._plan.has_shadow_catchers)

    def _image(self, name: str) -> DeviceArray:
        return self._buffers.get(f"film.{name}", wp.vec3, self._pixel_count)

    @property
    def _ratio(self) -> DeviceArray:
        return self._catchers.ratios(self._pixel_count)

    @property
    def _has_catchers(self) -> bool:
        return has_catchers(self._plan)

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
    def _count(self) -> DeviceArray:
        return self._buffers.get("film.count", wp.int32, self._pixel_count)

    @property
    def _count_total(self) -> DeviceArray:
        return self._buffers.get("film.count_total", wp.int64, 1)

    @property
    def _sums(self) -> tuple[PixelSums, DeviceArray]:
        return pixel_sums(self._buffers, self._pixel_count, is_lit=self._plan.is_lit)


def has_catchers(plan: FramePlan) -> bool:
    """Returns whether a frame estimates the light on shadow catchers, by any integrator."""
    return plan.has_shadow_catchers or plan.has_receivers


def _images_of_pixels(pixels: PixelBuffers[PixelData], copies: Copies) -> dict[str, Any]:
    """Returns the images of ``pixels`` by field name of `Frame`; ``copies`` holds their downloaded memory."""
    images = pixels.images(copies, "pixels")
    images["gaussian_index"], images["instance_index"] = images.pop("gaussian"), images.pop("instance")
    return images


def _images_of_frame(frame: Frame) -> dict[str, npt.NDArray[Any]]:
    """Returns the images of the frame to resume, under the names of the film's buffers."""
    images = {
        "color": frame.color if frame.captured is None else frame.captured,
        "alpha": frame.alpha,
        "depth": frame.depth,
        "normal": frame.normal,
        "gaussian": frame.gaussian_index,
        "instance": frame.instance_index,
    }
    if frame.light is not None and frame.captured_weight is not None:
        images |= {"captured_weight": frame.captured_weight, "light": frame.light, "lit_color": frame.color}
    return images


def _images_of_part(part: SamplePart) -> dict[str, npt.NDArray[Any]]:
    """Returns the film's images for a part of a frame: depths, normals and indices of the part; colours are 0.

    Colours are computed from the part's sums afterwards.
    """
    width, height = part.size
    empty = np.zeros((height, width), np.float32)
    black = np.zeros((height, width, 3), np.float32)
    lit = {"captured_weight": empty, "light": black, "lit_color": black}
    return {"color": black, "alpha": empty, **part.surfaces, **lit}


def _elements(words: FloatArray, array: DeviceArray) -> npt.NDArray[Any]:
    """Reinterprets downloaded 32-bit words as elements of the type of ``array``."""
    if array.dtype is wp.int32:
        return words.view(np.int32)
    return words.reshape(-1, 3) if array.dtype is wp.vec3 else words


def _words(copies: Copies, names: list[str]) -> dict[str, FloatArray]:
    """Returns the copied arrays with the given names as 32-bit words."""
    return {name: copies.words(name) for name in names}
