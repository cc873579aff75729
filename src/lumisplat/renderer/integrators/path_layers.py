"""Host side of the layers of paths: where kernels add up what paths bring (docs/method/paths.md#layers)."""

from __future__ import annotations

import warp as wp

from lumisplat.config.render import PATH_PARTS
from lumisplat.device.path.contributions import PARTS, PathImages
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.ray_wave import LightImages, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array


class PathLayers:
    """What the paths of a sample bring, by layer.

    Args:
        buffers: Holds the arrays.
    """

    def __init__(self, buffers: Buffers) -> None:
        self._buffers = buffers
        self._images = PathImages()

    def begin(self, plan: FramePlan, first: RayWave, lights: int) -> PathImages:
        """Images without light, but for what the first wave has.

        Args:
            plan: Says which layers the frame asks for.
            first: The first wave.
            lights: Of the frame.
        """
        count = first.count
        self._images = images = PathImages()
        images.light = first.row.radiance.light
        if plan.has_path_layers:
            images.parts = self._rows("parts", PARTS, count)
        if "bounces" in plan.aovs:
            images.bounces = self._rows("bounces", plan.max_bounces + 2, count)
        if "lights" in plan.aovs:
            images.lights_sent = self._rows("lights_sent", lights, count)
            images.lights_arrived = self._rows("lights_arrived", lights, count)
            images.lights_total = self._rows("lights_total", lights + 1, count)
        if plan.has_receivers:
            for name in ("received", "sent", "arrived", "own_sent", "own_arrived", "ambient", "open"):
                setattr(images, name, getattr(first.row.radiance, name))
        return images

    def images(self, plan: FramePlan) -> LightImages:
        """The layers that the frame asks for, one array an image."""
        images, layers = self._images, dict[str, DeviceArray]()
        if plan.has_path_layers:
            parts = dict(zip(PATH_PARTS, self._images_of(images.parts), strict=True))
            layers |= {name: image for name, image in parts.items() if name in plan.aovs}
        if "bounces" in plan.aovs:
            layers |= {f"bounce{number}": image for number, image in enumerate(self._images_of(images.bounces))}
        if "lights" not in plan.aovs:
            return LightImages(layers=layers)
        layers |= {f"total{number}": image for number, image in enumerate(self._images_of(images.lights_total))}
        return LightImages(self._images_of(images.lights_sent), self._images_of(images.lights_arrived), layers)

    def _rows(self, name: str, rows: int, count: int) -> DeviceArray:
        """Rows of zeros, end to end."""
        array = self._buffers.get(f"path.{name}", wp.vec3, rows * count)
        array.zero_()
        return array

    def _images_of(self, rows: wp.array[wp.vec3]) -> list[DeviceArray]:
        """Each row by itself."""
        count = len(self._images.light)
        return [device_array(rows)[first : first + count] for first in range(0, len(rows), count)]
