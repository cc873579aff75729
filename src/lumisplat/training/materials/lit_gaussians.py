"""Host pass: Gaussians that reflect light each by itself, and the derivatives of what they show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.constants.materials import SKY_CHUNK, SPREAD_SHARE
from lumisplat.device.structs.training import DirectionalLight, GaussianMaterials, MaterialGradient
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.training.materials import material_gradient_kernels, material_kernels
from lumisplat.training.materials.incident import IncidentRadiance


@dataclass(frozen=True, slots=True, eq=False)
class Materials:
    """What N Gaussians are made of, and the sky."""

    albedo: Doubles
    """Linear, 0..1, shape (N, 3)."""
    roughness: Doubles
    """Above 0, at most 1, shape (N,)."""
    normals: Doubles
    """Unit, shape (N, 3)."""
    sky: Doubles
    """Radiance in K directions, shape (K, 3)."""


class LitGaussians:
    """Gaussians under what was traced for them.

    Args:
        launcher: Runs the kernels.
        buffers: Holds the arrays.
        means: Of the Gaussians, shape (N, 3).
        incident: What reaches them.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, means: FloatArray, incident: IncidentRadiance) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._count, self._directions = incident.open.shape
        self._materials, self._light = GaussianMaterials(), DirectionalLight()
        self._materials.means = self._vectors("means", means)
        self._light.directions = self._vectors("directions", incident.directions)
        self._light.solid_angle = incident.solid_angle
        self._light.spread = SPREAD_SHARE * SPREAD_SHARE * incident.solid_angle
        for name, element in (("open", wp.float32), ("seen", wp.vec3)):
            array = buffers.get(f"materials.{name}", element, (self._count, self._directions))
            array.assign(getattr(incident, name))
            setattr(self._light, name, array)
        self._radiance = buffers.get("materials.radiance", wp.vec3, self._count)
        self._by_radiance = buffers.get("materials.by_radiance", wp.vec3, self._count)
        self._eye = wp.vec3()

    def shade(self, materials: Materials, eye: Doubles, sh_out: DeviceArray) -> None:
        """What they show to an eye.

        Args:
            materials: What they are made of.
            eye: World space.
            sh_out: Receives it, display-referred, as constant harmonics, shape (N,).
        """
        self._eye, on = wp.vec3(*eye), self._materials
        on.normals, on.albedo = self._vectors("normals", materials.normals), self._vectors("albedo", materials.albedo)
        on.roughness = self._buffers.upload("materials.roughness", wp.float32, _floats(materials.roughness))
        self._light.sky = self._vectors("sky", materials.sky)
        inputs = (self._eye, on, self._light, self._radiance, sh_out)
        with self._launcher.stage("materials"):
            self._launcher.run_banded(material_kernels.shade, self._count, *inputs)

    def decode(self, rects: DeviceArray, by_splats: DeviceArray) -> None:
        """Takes derivatives by the colours of splats of the last frame, for ``differentiate``.

        Args:
            rects: Of the splats.
            by_splats: Derivatives of the loss by them.
        """
        inputs = (rects, by_splats, self._radiance, self._by_radiance)
        self._launcher.run_banded(material_kernels.decode_gradients, self._count, *inputs)

    def differentiate(self) -> Materials:
        """Derivatives of the loss, in place of what they are by."""
        run, get, count = self._launcher.run_banded, self._buffers.get, self._count
        gradient = MaterialGradient()
        gradient.albedo, gradient.normals = (get(f"materials.by_{x}", wp.vec3, count) for x in ("albedo", "normals"))
        gradient.roughness = get("materials.by_roughness", wp.float32, count)
        chunks = -(-count // SKY_CHUNK)
        by_sky = get("materials.by_sky", wp.vec3, (chunks, self._directions))
        inputs = (self._eye, self._materials, self._light, self._by_radiance)
        with self._launcher.stage("materials: backward"):
            run(material_gradient_kernels.differentiate, count, *inputs, gradient)
            run(material_kernels.differentiate_sky, chunks, *inputs, by_sky)
        parts = (gradient.albedo, gradient.roughness, gradient.normals)
        albedo, roughness, normals = (np.array(part.numpy(), np.float64) for part in parts)
        return Materials(albedo, roughness, normals, by_sky.numpy().sum(axis=0, dtype=np.float64))

    @property
    def radiance(self) -> Doubles:
        """What was shown last, linear, shape (N, 3)."""
        return np.array(self._radiance.numpy(), np.float64)

    def _vectors(self, name: str, values: Doubles | FloatArray) -> DeviceArray:
        return self._buffers.upload(f"materials.{name}", wp.vec3, _floats(values))


def _floats(values: Doubles | FloatArray) -> FloatArray:
    return np.ascontiguousarray(values, np.float32)
