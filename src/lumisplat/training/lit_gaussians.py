"""Lights each Gaussian by its incident radiance, and returns gradients of its material; runs device kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.constants import ENVIRONMENT_CHUNK, SPREAD_SHARE
from lumisplat.device.training import DirectionalLight, GaussianMaterials, MaterialGradient
from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.progress import Progress
from lumisplat.relighting.irradiance import Irradiance, hit_radiance
from lumisplat.renderer.renderer import Renderer
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.neighbours import morton_order
from lumisplat.scene.scene import Scene
from lumisplat.training import material_gradient_kernels, material_kernels

LIFT_SHORTEST = 4.0
"""Lowest height at which rays start above a Gaussian, in units of its smallest scale; `LIFT_ALONG` may be higher. The
Gaussian's response there is 3e-4, so it does not block its own rays."""

LIFT_ALONG = 1.0
"""Lowest height at which rays start above a Gaussian, in units of its middle scale; `LIFT_SHORTEST` may be higher.
Overlapping neighbours reach that far above the Gaussian's plane."""


@dataclass(frozen=True, slots=True, eq=False)
class Materials:
    """Materials of N Gaussians and the environment that lights them."""

    albedo: Doubles
    """Linear base colour of N Gaussians, 0..1, shape (N, 3): diffuse albedo, and of metal the reflectance."""
    roughness: Doubles
    """Perceptual roughness of N Gaussians, above 0, at most 1, shape (N,)."""
    normals: Doubles
    """Unit normals of N Gaussians in world space, shape (N, 3)."""
    environment: Doubles
    """Radiance of the environment in K evenly spread directions, linear, in units of display white, shape (K, 3)."""

    def subset(self, rows: Rows) -> Materials:
        """Returns the materials of some of the Gaussians, in the same environment."""
        return Materials(self.albedo[rows], self.roughness[rows], self.normals[rows], self.environment)


class LitGaussians:
    """Shades N Gaussians by traced incident radiance, and differentiates the result, on the device.

    Args:
        launcher: Runs the kernels.
        buffers: Owner of the device arrays.
        means: Means of the Gaussians, shape (N, 3).
        incident: Incident radiance of each Gaussian.
        metal: Whether all Gaussians are metals instead of dielectrics.
    """

    def __init__(
        self, launcher: Launcher, buffers: Buffers, means: FloatArray, incident: IncidentRadiance, *, metal: bool
    ) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._count, self._directions = incident.open.shape
        self._materials, self._light = GaussianMaterials(), DirectionalLight()
        self._materials.means, self._materials.metallic = self._vectors("means", means), float(metal)
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
        """Computes each Gaussian's radiance towards an eye point; stores it as ``radiance``, and as display colour.

        Args:
            materials: Materials of the Gaussians.
            eye: Eye point in world space, shape (3,).
            sh_out: Receives each Gaussian's display-referred colour as SH coefficient of degree 0, shape (N,).
        """
        self._eye, on = wp.vec3(*eye), self._materials
        on.normals, on.albedo = self._vectors("normals", materials.normals), self._vectors("albedo", materials.albedo)
        on.roughness = self._buffers.upload("materials.roughness", wp.float32, _floats(materials.roughness))
        self._light.environment = self._vectors("sky", materials.environment)
        inputs = (self._eye, on, self._light, self._radiance, sh_out)
        with self._launcher.stage("materials"):
            self._launcher.run_banded(material_kernels.shade, self._count, *inputs)

    def decode(self, rects: DeviceArray, by_splats: DeviceArray) -> None:
        """Converts the loss gradient of the splats' display colours to that of the Gaussians' linear radiance.

        The result stays on the device, for ``differentiate``.

        Args:
            rects: Tile rectangles of the splats of the last frame.
            by_splats: Gradient of the loss with respect to the splats.
        """
        inputs = (rects, by_splats, self._radiance, self._by_radiance)
        self._launcher.run_banded(material_kernels.decode_gradients, self._count, *inputs)

    def differentiate(self, by_radiance: Doubles | None = None) -> Materials:
        """Returns the gradient of the loss with respect to materials and environment, in the form of `Materials`.

        Args:
            by_radiance: Gradient of the loss with respect to the linear radiance of the Gaussians, shape (N, 3); None:
                the one that the last ``decode`` computed.
        """
        if by_radiance is not None:
            self._by_radiance.assign(_floats(by_radiance))
        run, get, count = self._launcher.run_banded, self._buffers.get, self._count
        gradient = MaterialGradient()
        gradient.albedo, gradient.normals = (get(f"materials.by_{x}", wp.vec3, count) for x in ("albedo", "normals"))
        gradient.roughness = get("materials.by_roughness", wp.float32, count)
        chunks = -(-count // ENVIRONMENT_CHUNK)
        by_environment = get("materials.by_sky", wp.vec3, (chunks, self._directions))
        inputs = (self._eye, self._materials, self._light, self._by_radiance)
        with self._launcher.stage("materials: backward"):
            run(material_gradient_kernels.differentiate, count, *inputs, gradient)
            run(material_kernels.differentiate_environment, chunks, *inputs, by_environment)
        parts = (gradient.albedo, gradient.roughness, gradient.normals)
        albedo, roughness, normals = (np.array(part.numpy(), np.float64) for part in parts)
        return Materials(albedo, roughness, normals, by_environment.numpy().sum(axis=0, dtype=np.float64))

    @property
    def radiance(self) -> Doubles:
        """Linear radiance of each of N Gaussians towards the eye point of the last call of ``shade``, shape (N, 3)."""
        return np.array(self._radiance.numpy(), np.float64)

    def _vectors(self, name: str, values: Doubles | FloatArray) -> DeviceArray:
        return self._buffers.upload(f"materials.{name}", wp.vec3, _floats(values))


def _floats(values: Doubles | FloatArray) -> FloatArray:
    return np.ascontiguousarray(values, np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class IncidentRadiance:
    """Radiance that arrives at N Gaussians from K evenly spread directions: environment and other Gaussians."""

    directions: Doubles
    """Unit directions, K in number, from Gaussians towards the light that arrives at them, world space, shape (K, 3).
    """
    open: FloatArray
    """Transmittance from each of N Gaussians to the environment in K directions, 0..1, shape (N, K)."""
    seen: FloatArray
    """Captured radiance that arrives at N Gaussians from blocking Gaussians in K directions, linear, in units of
    display white, shape (N, K, 3)."""

    def subset(self, rows: Rows | slice) -> IncidentRadiance:
        """Returns the radiance that arrives at some of the Gaussians."""
        return IncidentRadiance(self.directions, self.open[rows], self.seen[rows])

    @property
    def solid_angle(self) -> float:
        """Solid angle that each of the K evenly spread directions represents: 4 pi / K steradians."""
        return 4.0 * np.pi / len(self.directions)

    def irradiance(self, normals: Doubles) -> Irradiance:
        """Returns the irradiance over pi of N Gaussians: captured light, K environment directions, no emitters.

        Args:
            normals: Unit normals of the Gaussians, world space, shape (N, 3).
        """
        cosines = np.maximum(normals @ self.directions.T, 0.0).astype(np.float32)
        shares = cosines * np.float32(self.solid_angle / np.pi)
        return Irradiance(
            observed=np.einsum("nk,nkc->nc", shares, self.seen).astype(np.float64),
            environment=shares * self.open,
            emitters=np.zeros((len(normals), 0), np.float32),
        )


def traced_incident(
    gaussians: Gaussians, normals: Doubles, directions: Doubles, renderer: Renderer, *, seed: int, report: Progress
) -> IncidentRadiance:
    """Traces one ray from each of N Gaussians in each of K directions above its horizon.

    Rays are jittered within the solid angle of their direction. Where half of that solid angle is blocked, about half
    of the Gaussians' rays therefore reach the environment. Rays start above the Gaussian, at a height given by its
    scales.

    Args:
        gaussians: The capture.
        normals: Unit normals towards the lit side, shape (N, 3).
        directions: Evenly spread unit vectors, shape (K, 3).
        renderer: Ray tracer of unlit frames.
        seed: Seed of the jitter.
        report: Called with a description of the current work and the fraction done, 0..1.
    """
    count, steps = gaussians.count, len(directions)
    order = morton_order(gaussians.means)  # neighbouring rays are traced together
    scene, rng = Scene([gaussians]), np.random.default_rng([seed, 6])
    starts = ray_starts(gaussians, normals)
    open_, seen = np.zeros((count, steps), np.float32), np.zeros((count, steps, 3), np.float32)
    spread = np.sqrt(np.pi / steps)
    for k, direction in enumerate(directions):
        report("tracing incident radiance", k / steps)
        ray_directions = direction + spread * rng.uniform(-1.0, 1.0, (count, 3))
        ray_directions /= np.linalg.norm(ray_directions, axis=1, keepdims=True)
        rows = order[normals[order] @ direction > 0.0]
        hits = renderer.trace_rays(scene, starts[rows], ray_directions[rows])
        alpha = 1.0 - hits.transmittance
        color = hit_radiance(hits, alpha)
        open_[rows, k], seen[rows, k] = hits.transmittance, alpha[:, None] * color
    return IncidentRadiance(directions, open_, seen)


def ray_starts(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Returns a ray origin above each of N Gaussians, so high that it does not block its own rays, shape (N, 3)."""
    scales = np.sort(gaussians.scales.astype(np.float64), axis=1)
    lift = np.maximum(LIFT_SHORTEST * scales[:, 0], LIFT_ALONG * scales[:, 1])
    return gaussians.means + lift[:, None] * normals
