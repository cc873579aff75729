"""The second stage of Relightable 3D Gaussians (Gao et al. 2024) by its own formulas, weights and rates.

Light is an environment map, blocked or not, and harmonics of local light of each Gaussian's own; each shades itself by
64 directions of its own. It is written from the paper and the settings of its code for NeRF's synthetic scenes
(script/run_nerf.sh): L1 and 0.2 SSIM of the lit picture, 0.01 of the distance of diffuse light from grey, 0.01 of
squared differences between neighbours of the map. Geometry and normals stay, as in its other scripts; stage 1, rays and
the rasteriser are ours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

import lumisplat as ls
from bench.relightable import r3dg_kernels
from bench.relightable.r3dg_light import (
    HEIGHT,
    WIDTH,
    Lookups,
    greyness_gradient,
    hemispheres,
    roughness_gradient,
    softplus,
    softplus_slope,
    visibility,
)
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import PixelGradient
from lumisplat.math.adam import Adam
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.directions import panorama_directions, panorama_lookup
from lumisplat.math.sh import sh_basis
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.launcher import Launcher
from lumisplat.training.materials.colored_gaussians import ColoredGaussians
from lumisplat.training.photo_loss import Loss, PhotoLoss
from lumisplat.training.views import TrainingView

Floats = npt.NDArray[np.floating]
DIRECTIONS, RELIT_DIRECTIONS = 64, 384
SSIM, GREY_LIGHT, EVEN_SKY = 0.2, 0.01, 0.01
ALBEDO, ROUGHNESS = (0.77, 0.03), (0.9, 0.09)
"""Factor and offset of the sigmoid."""
RATE, LOCAL_RATE, LOCAL_REST_RATE, SKY_RATE = 0.01, 0.001, 0.0001, 0.1


@dataclass
class Parameters:
    """What moves, before its activation; or the derivatives by it."""

    albedo: Doubles
    roughness: Doubles
    local: Doubles
    """Shape (N, 16, 3)."""
    sky: Doubles
    """Shape (512, 3)."""

    @classmethod
    def start(cls, count: int, rng: np.random.Generator) -> Parameters:
        """Where their training begins."""
        sky = 3.0 * rng.random((HEIGHT * WIDTH, 3))
        return cls(np.zeros((count, 3)), np.zeros(count), np.zeros((count, 16, 3)), sky)

    @property
    def albedo_value(self) -> Doubles:
        """Linear, 0.03..0.8."""
        return ALBEDO[0] * softplus_slope(self.albedo) + ALBEDO[1]

    @property
    def roughness_value(self) -> Doubles:
        """0.09..0.99."""
        return ROUGHNESS[0] * softplus_slope(self.roughness) + ROUGHNESS[1]


class R3dgShading:
    """Gaussians that their formulas light, and pictures of them.

    Args:
        gaussians: The capture.
        normals: Unit, shape (N, 3).
        directions: So many of each Gaussian.
        device: Where it is computed.
        background: Behind the Gaussians.
        seed: Of how directions are turned.
    """

    def __init__(
        self,
        gaussians: ls.Gaussians,
        normals: Doubles,
        directions: int,
        device: str,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        seed: int = 0,
    ) -> None:
        self.launcher, self._count, self._background = Launcher(device, None), gaussians.count, background
        self.buffers = Buffers(self.launcher.device)
        self._shown = ColoredGaussians(
            self.launcher, self.buffers, gaussians, background, kernels=(r3dg_kernels,), progress=None
        )
        self.ways = hemispheres(normals, directions, np.random.default_rng([seed, 21]))
        self.visible = visibility(gaussians, normals, self.ways, device)
        self._materials, self._light = r3dg_kernels.R3dgMaterials(), r3dg_kernels.R3dgLight()
        self._materials.means = self._put("means", wp.vec3, gaussians.means)
        self._materials.normals = self._put("normals", wp.vec3, normals)
        self._light.directions = self._put("ways", wp.vec3, self.ways)
        self._light.area = 2.0 * np.pi
        harmonics = sh_basis(self.ways.reshape(-1, 3), 3).reshape(gaussians.count, directions, 16)
        self._light.harmonics = self._put("harmonics", wp.float32, harmonics)
        self._diffuse_light = self.buffers.get("r3dg.diffuse_light", wp.vec3, gaussians.count)

    def draw(
        self, camera: ls.Camera, albedo: Floats, roughness: Floats, sky: FloatArray, local: Doubles
    ) -> tuple[PixelData, DeviceArray]:
        """Pixels as displays show them, and linear, premultiplied.

        Args:
            camera: A pinhole.
            albedo: Linear, shape (N, 3).
            roughness: Shape (N,).
            sky: What reaches each Gaussian from each of its directions, shape (N, S, 3).
            local: Harmonics of local light, shape (N, 16, 3).
        """
        self._eye = wp.vec3(*camera.eye)
        self._materials.albedo = self._put("albedo", wp.vec3, albedo)
        self._materials.roughness = self._put("roughness", wp.float32, roughness)
        self._light.sky, self._light.local = self._put("sky", wp.vec3, sky), self._put("local", wp.vec3, local)
        inputs = (self._eye, self._materials, self._light, self._diffuse_light, self._shown.sh)
        self.launcher.run_banded(r3dg_kernels.shade, self._count, *inputs)
        pixels = self._shown.draw(camera, self._background)
        linear = self.buffers.get("r3dg.linear", wp.vec3, camera.width * camera.height)
        wp.copy(linear, pixels.color, count=camera.width * camera.height)
        self.launcher.run_banded(r3dg_kernels.encode_pixels, camera.width * camera.height, linear, pixels.color)
        return pixels, linear

    def differentiate(
        self, pixels: PixelData, linear: DeviceArray, by_pixels: PixelGradient, by_diffuse_light: Doubles
    ) -> Parameters:
        """Derivatives by albedo, roughness, local light and the light of the sky from each direction."""
        self.launcher.run_banded(r3dg_kernels.decode_gradients, linear.shape[0], linear, by_pixels.color)
        wp.copy(pixels.color, linear, count=linear.shape[0])
        by_splats = self._shown.by_splats(pixels, by_pixels)
        gradient, get = r3dg_kernels.R3dgGradient(), self.buffers.get
        gradient.albedo = get("r3dg.by_albedo", wp.vec3, self._count)
        gradient.roughness = get("r3dg.by_roughness", wp.float32, self._count)
        gradient.local = get("r3dg.by_local", wp.vec3, (self._count, 16))
        gradient.sky = get("r3dg.by_sky", wp.vec3, self.ways.shape[:2])
        by_diffuse = self._put("by_diffuse_light", wp.vec3, by_diffuse_light)
        inputs = (self._eye, self._materials, self._light, self._shown.rects, by_splats, by_diffuse, gradient)
        self.launcher.run_banded(r3dg_kernels.differentiate, self._count, *inputs)
        parts = (gradient.albedo, gradient.roughness, gradient.local, gradient.sky)
        return Parameters(*(part.numpy().astype(np.float64) for part in parts))

    @property
    def diffuse_light(self) -> Doubles:
        """What reached each Gaussian last, shape (N, 3)."""
        return self._diffuse_light.numpy().astype(np.float64)

    def _put(self, name: str, element: type[Any], values: Floats) -> DeviceArray:
        shape = values.shape[:-1] if element is wp.vec3 else values.shape
        array = self.buffers.get(f"r3dg.{name}", element, shape)
        array.assign(np.ascontiguousarray(values, np.float32))
        return array


class R3dgFit:
    """Their second stage.

    Args:
        gaussians: The capture.
        normals: Unit, shape (N, 3).
        views: The photographs.
        device: Where it is computed.
        directions: Of each Gaussian.
        seed: Of the order of photographs, of directions and of the first map.
    """

    def __init__(
        self,
        gaussians: ls.Gaussians,
        normals: Doubles,
        views: Sequence[TrainingView],
        device: str,
        *,
        directions: int = DIRECTIONS,
        seed: int = 0,
    ) -> None:
        self._views, self._seed = views, seed
        background = views[0].background
        self._shading = R3dgShading(gaussians, normals, directions, device, background=background, seed=seed)
        self._loss = PhotoLoss(self._shading.launcher, self._shading.buffers, ssim=SSIM, alpha=0.0)
        self._lookups = Lookups.of(self._shading.ways.reshape(-1, 3), self._shading.visible.ravel()).matrix
        self.parameters = Parameters.start(gaussians.count, np.random.default_rng([seed, 22]))
        self._moments = {name: Adam.still(values.shape) for name, values in vars(self.parameters).items()}
        self._order = np.random.default_rng([seed, 23])
        self._left: list[int] = []

    def step(self) -> Loss:
        """Makes a step with the next photograph."""
        if not self._left:
            self._left = list(self._order.permutation(len(self._views)))
        loss, gradient = self.differentiate(self._views[self._left.pop()])
        rates = {"albedo": RATE, "roughness": RATE, "sky": SKY_RATE, "local": 1.0}
        of_local = np.where(np.arange(16) == 0, LOCAL_RATE, LOCAL_REST_RATE)[:, None]
        for name, moments in self._moments.items():
            moved = moments.step(getattr(gradient, name), rates[name])
            setattr(
                self.parameters, name, getattr(self.parameters, name) + (of_local * moved if name == "local" else moved)
            )
        return loss

    def differentiate(self, view: TrainingView) -> tuple[Loss, Parameters]:
        """The loss of a photograph without the terms on light, and the derivatives with them."""
        now, picture = self.parameters, view.read()
        photograph = self._loss.load(picture.color, picture.weight, None)
        map_ = softplus(now.sky)
        sky = np.asarray(self._lookups @ map_.astype(np.float32)).reshape(*self._shading.ways.shape)
        pixels, linear = self._shading.draw(view.camera, now.albedo_value, now.roughness_value, sky, now.local)
        loss, by_pixels = self._loss.differentiate((view.camera.width, view.camera.height), pixels, photograph)
        by_diffuse_light = GREY_LIGHT * greyness_gradient(self._shading.diffuse_light)
        by = self._shading.differentiate(pixels, linear, by_pixels, by_diffuse_light)
        slopes = [softplus_slope(raw) for raw in (now.albedo, now.roughness)]
        by_map = np.asarray(self._lookups.T @ by.sky.reshape(-1, 3).astype(np.float32)).astype(np.float64)
        by_map += EVEN_SKY * roughness_gradient(map_)
        return loss, Parameters(
            by.albedo * ALBEDO[0] * slopes[0] * (1.0 - slopes[0]),
            by.roughness * ROUGHNESS[0] * slopes[1] * (1.0 - slopes[1]),
            by.local,
            by_map * softplus_slope(now.sky),
        )

    def environment(self) -> FloatArray:
        """The map with the axes of `LightEnvironment`, shape (16, 32, 3)."""
        ways = panorama_directions(HEIGHT, WIDTH).reshape(-1, 3)
        found = Lookups.of(ways, np.ones(len(ways), np.float32)).matrix @ softplus(self.parameters.sky)
        return np.asarray(found).reshape(HEIGHT, WIDTH, 3).astype(np.float32)


def relit_pictures(
    gaussians: ls.Gaussians, skies: Mapping[str, FloatArray], cameras: Sequence[ls.Camera], device: str
) -> dict[str, list[FloatArray]]:
    """As their programs relight: 384 directions, visibility traced, local light left out; display colours over black.

    Args:
        gaussians: With albedo, roughness and normals.
        skies: Radiance of environments by name, with the axes of `LightEnvironment`, shape (H, W, 3) each.
        cameras: Pinholes.
        device: Where it is computed.
    """
    assert gaussians.albedo is not None and gaussians.roughness is not None and gaussians.normals is not None
    shading = R3dgShading(gaussians, gaussians.normals.astype(np.float64), RELIT_DIRECTIONS, device)
    local = np.zeros((gaussians.count, 16, 3))
    pictures: dict[str, list[FloatArray]] = {name: [] for name in skies}
    for name, radiance in skies.items():
        sky = (panorama_lookup(radiance, shading.ways) * shading.visible[..., None]).astype(np.float32)
        for camera in cameras:
            pixels, _ = shading.draw(camera, gaussians.albedo, gaussians.roughness, sky, local)
            shown = np.array(device_array(pixels.color).numpy()[: camera.height * camera.width], np.float32)
            pictures[name].append(shown.reshape(camera.height, camera.width, 3))
    return pictures
