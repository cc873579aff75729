"""What reaches each Gaussian of a capture from a fixed set of directions: its share of the sky, and what blocks it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants.materials import LIFT_ALONG, LIFT_SHORTEST
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.progress import Progress
from lumisplat.relighting.albedo.irradiance import Irradiance
from lumisplat.relighting.albedo.outgoing import radiance_met
from lumisplat.renderer.renderer import Renderer
from lumisplat.scene.editing.morton import morton_order
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.scene import Scene


@dataclass(frozen=True, slots=True, eq=False)
class IncidentRadiance:
    """Light on N Gaussians from K directions that stand for as much of the sphere each."""

    directions: Doubles
    """Unit, towards the light, shape (K, 3)."""
    open: FloatArray
    """Share of the sky that arrives, 0..1, shape (N, K)."""
    seen: FloatArray
    """Radiance of what blocks the rest, as it was captured, linear, in units of display white, shape (N, K, 3)."""

    @property
    def solid_angle(self) -> float:
        """Of each direction, steradians."""
        return 4.0 * np.pi / len(self.directions)

    def irradiance(self, normals: Doubles) -> Irradiance:
        """What shines on Gaussians with these normals, shape (N, 3), by cosines; there are no lamps."""
        cosines = np.maximum(normals @ self.directions.T, 0.0).astype(np.float32)
        shares = cosines * np.float32(self.solid_angle / np.pi)
        return Irradiance(
            observed=np.einsum("nk,nkc->nc", shares, self.seen).astype(np.float64),
            sky=shares * self.open,
            lamps=np.zeros((len(normals), 0), np.float32),
        )


def traced_incident(
    gaussians: Gaussians, normals: Doubles, directions: Doubles, renderer: Renderer, *, seed: int, report: Progress
) -> IncidentRadiance:
    """Follows a ray from each Gaussian into each direction above its horizon.

    Rays go anywhere within the part of the sphere that a direction stands for: where the part is blocked by half,
    every other Gaussian sees it. They begin above the Gaussian, as far as it is wide.

    Args:
        gaussians: The capture.
        normals: Unit, towards the lit side, shape (N, 3).
        directions: Evenly spread, unit, shape (K, 3).
        renderer: Traces unlit rays.
        seed: Of where rays go.
        report: Called with what is being done and the fraction done, 0..1.
    """
    count, steps = gaussians.count, len(directions)
    order = morton_order(gaussians.means)  # rays that go side by side are followed together
    scene, rng = Scene([gaussians]), np.random.default_rng([seed, 6])
    starts = ray_starts(gaussians, normals)
    open_, seen = np.zeros((count, steps), np.float32), np.zeros((count, steps, 3), np.float32)
    spread = np.sqrt(np.pi / steps)
    for k, direction in enumerate(directions):
        report("tracing light", k / steps)
        ways = direction + spread * rng.uniform(-1.0, 1.0, (count, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        rows = order[normals[order] @ direction > 0.0]
        hits = renderer.trace_rays(scene, starts[rows], ways[rows])
        alpha = 1.0 - hits.transmittance
        color = radiance_met(hits, alpha)
        open_[rows, k], seen[rows, k] = hits.transmittance, alpha[:, None] * color
    return IncidentRadiance(directions, open_, seen)


def ray_starts(gaussians: Gaussians, normals: Doubles) -> Doubles:
    """Where rays begin: above each Gaussian, so far that it does not block its own, shape (N, 3)."""
    scales = np.sort(gaussians.scales.astype(np.float64), axis=1)
    lift = np.maximum(LIFT_SHORTEST * scales[:, 0], LIFT_ALONG * scales[:, 1])
    return gaussians.means + lift[:, None] * normals
