"""Host pass: samples of rays into the images of a frame."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig
from lumisplat.device.structs.rays import LensData
from lumisplat.math.arrays import FloatArray
from lumisplat.renderer.film import film_kernels
from lumisplat.renderer.film.pixel_buffers import PixelBuffers
from lumisplat.renderer.light.direct_light import LightImages
from lumisplat.renderer.scene.camera_table import lens_table
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.light_scene import LightScene
from lumisplat.renderer.trace import camera_ray_kernels
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera


class Film:
    """Running means of what the rays of pixels see.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        config: Settings.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self.lens: Any = buffers.get("film.lens", LensData, 1)
        """The camera as rays leave it for the current sample."""

    def begin(self, camera: Camera) -> None:
        """Before the samples that a frame adds, the first ones or more: starts to count anew."""
        self._nonfinite(camera).zero_()

    def begin_sample(self, camera: Camera, sample: int) -> None:
        """Before a sample's rays start; number 0 starts the frame anew."""
        self.lens.assign(lens_table(camera, self._config, sample))

    def add(self, scene: DeviceScene, camera: Camera, met: PrimaryHits, colors: Any) -> None:
        """Adds one ray a pixel, with display-referred colours."""
        with self._launcher.stage("store"):
            self._launcher.run_banded(
                camera_ray_kernels.store_rays,
                met.count,
                *(
                    self.lens,
                    wp.vec3(*(self._config.background or (0.0, 0.0, 0.0))),
                    met.rays,
                    met.radiance,
                    met.hits,
                    colors,
                ),
                *(scene.instances, scene.mesh_instances, scene.mesh_data),
                *(PixelBuffers.of(self._buffers, camera).data, self._nonfinite(camera)),
            )
        self._count(camera, met)

    def add_lit(
        self,
        lit: LightScene,
        camera: Camera,
        met: PrimaryHits,
        colors: Any,
        *,
        last: bool,
        lights: LightImages | None,
        reflection: Any,
    ) -> None:
        """Adds one lit ray a pixel, and the further images that the settings ask for.

        Colours are there after the ``last`` sample.
        """
        count = met.count
        kept = self._buffers.get("film.kept", wp.vec3, camera.width * camera.height if lit.has_shadow_only else 0)
        with self._launcher.stage("store"):
            self._launcher.run_banded(
                film_kernels.store_lit_rays,
                count,
                *(
                    last,
                    self.lens,
                    lit.data,
                    met.rays,
                    met.radiance,
                    met.hits,
                    colors,
                    PixelBuffers.of(self._buffers, camera).data,
                ),
                *(self._lit(camera).data, self._nonfinite(camera), kept),
            )
        images: dict[str, Any] = {}
        if {"albedo", "emission"} & set(self._config.aovs):
            images = {name: self._buffers.get(f"film.ray.{name}", wp.vec3, count) for name in ("albedo", "emission")}
            self._launcher.run_banded(
                film_kernels.write_surface_layers, count, lit.data, met.rays, met.hits, met.radiance, *images.values()
            )
        images = {name: image for name, image in images.items() if name in self._config.aovs}
        if reflection is not None:
            images["reflection"] = reflection
        if lights is not None:
            images |= {f"direct{n}": image for n, image in enumerate(lights.direct)}
            images |= {f"arrived{n}": image for n, image in enumerate(lights.arrived)}
        self._store(camera, images)
        self._count(camera, met)

    def developed(self, camera: Camera) -> dict[str, np.ndarray]:
        """The images of a lit frame beside those of the surface: weight, light, and the linear colour."""
        return self._lit(camera).download()

    def images(self, camera: Camera, light_count: int, *, lit: bool) -> dict[str, FloatArray]:
        """The further images that the settings ask for, by the names of the frame's fields."""
        asked = set(self._config.aovs) if lit else {"hits"} & set(self._config.aovs)
        images = {name: self._download(camera, name) for name in ("albedo", "emission", "reflection") if name in asked}
        if "hits" in asked:
            images["hits"] = self._download(camera, "hits")[..., 0]
        if "lights" in asked:
            shape = (0, camera.height, camera.width, 3)
            direct = [self._download(camera, f"direct{n}") for n in range(light_count)]
            arrived = [self._download(camera, f"arrived{n}") for n in range(light_count)]
            images["light_direct"] = np.stack(direct) if direct else np.zeros(shape, np.float32)
            shares = [np.divide(a, d, out=np.ones_like(a), where=d > 0.0) for a, d in zip(arrived, direct, strict=True)]
            images["light_shadow"] = np.clip(np.stack(shares), 0.0, 1.0) if shares else np.zeros(shape, np.float32)
        return images

    def resume(self, camera: Camera, images: dict[str, np.ndarray]) -> None:
        """Puts back the images of a frame, and of a lit one what it keeps beside them."""
        PixelBuffers.of(self._buffers, camera).upload(images)
        if "light" in images:
            lit = self._lit(camera)
            lit.upload(images | {"color": images["linear"]})

    def nonfinite_count(self, camera: Camera) -> int:
        """Samples since ``begin`` whose colour was NaN or infinite."""
        return int(self._nonfinite(camera).numpy().sum())

    def _count(self, camera: Camera, met: PrimaryHits) -> None:
        if "hits" in self._config.aovs:
            counts = self._buffers.get("film.ray.hits", wp.vec3, met.count)
            self._launcher.run_banded(film_kernels.count_hits, met.count, met.rays, met.radiance, counts)
            self._store(camera, {"hits": counts})

    def _store(self, camera: Camera, images: dict[str, Any]) -> None:
        for name, values in images.items():
            image = self._image(camera, name)
            self._launcher.run_banded(film_kernels.store_image, values.shape[0], self.lens, values, image)

    def _download(self, camera: Camera, name: str) -> FloatArray:
        return self._image(camera, name).numpy().reshape(camera.height, camera.width, 3).copy()

    def _image(self, camera: Camera, name: str) -> Any:
        return self._buffers.get(f"film.{name}", wp.vec3, camera.width * camera.height)

    def _lit(self, camera: Camera) -> PixelBuffers:
        return PixelBuffers.of_light(self._buffers, (camera.height, camera.width))

    def _nonfinite(self, camera: Camera) -> Any:
        return self._buffers.get("film.nonfinite", wp.int32, camera.width * camera.height)
