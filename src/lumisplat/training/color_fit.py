"""Fits metals and the environment to captured colours of a sample of Gaussians, before images refine all materials.

Captured colours need no rendering, so that each step costs little and shows every Gaussian of the sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from lumisplat.math.arrays import Doubles, FloatArray, Rows
from lumisplat.math.color import decode_slope, decode_srgb, encode_srgb
from lumisplat.math.sh import sh_basis
from lumisplat.progress import Progress
from lumisplat.relighting.irradiance import ALBEDO_HIGH, LIGHTEST
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training import material_gradient_kernels, material_kernels
from lumisplat.training.lit_gaussians import IncidentRadiance, LitGaussians, Materials
from lumisplat.training.material_parameters import MaterialParameters, MaterialRates

SAMPLE = 2000
"""Number of Gaussians to whose colours the environment is fitted."""

VIEWS = 24
"""Largest number of images towards whose cameras colours are compared."""

STEPS = 400
"""Steps of the fit, each of one view."""

RATES = MaterialRates(albedo=0.03, roughness=0.0, environment=0.1)
"""Initial learning rates; they fall exponentially, to `RATE_FALL` of them. SH blur highlights, so roughness stays."""

RATE_FALL = 0.05

LOSS_WIDTH = 0.02
"""Display-referred difference below which the loss is quadratic; above, it is linear (Charbonnier)."""

NEIGHBOURS = 6
"""Number of Gaussians of the sample towards whose albedo that of a Gaussian is drawn, by inverse distance."""

DISTANCE_MIN = 1e-12
"""Smallest distance, scene units, by which is divided: a Gaussian may be its own neighbour, or where a camera is."""

CLIPPED_MIN = 0.98
"""Display value from which a captured colour counts as clipped at white."""

ALBEDO_PULL = 0.05
"""Weight of the albedo of its neighbours against that of a Gaussian's own colours, for the median Gaussian."""


@dataclass(frozen=True, slots=True, eq=False)
class CapturedColors:
    """Views from which colours of N Gaussians are taken, and how much of each Gaussian they show."""

    eyes: Sequence[Doubles]
    """Eye points of V views, world space, each of shape (3,)."""
    weights: FloatArray
    """Blending weights of N Gaussians summed over the pixels of V images, shape (V, N)."""

    def shown(self, gaussians: Gaussians, view: int, rows: Rows | slice) -> Doubles:
        """Returns the display-referred colours, 0..1, of rows of the Gaussians towards a view, shape (R, 3)."""
        away = gaussians.means[rows] - self.eyes[view]
        distances = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), DISTANCE_MIN)
        basis = sh_basis(away / distances, gaussians.sh_degree)
        return np.clip(np.einsum("nk,nkc->nc", basis, gaussians.sh[rows]) + 0.5, 0.0, 1.0)


def chosen_views(count: int) -> Sequence[int]:
    """Returns the indices of at most `VIEWS` of ``count`` images, evenly spaced."""
    return [int(index) for index in np.unique(np.linspace(0, count - 1, min(count, VIEWS)).round())]


def fit_colors(
    gaussians: Gaussians,
    incident: IncidentRadiance,
    start: Materials,
    colors: CapturedColors,
    *,
    seed: int,
    device: str,
    threads: int | None,
    report: Progress,
) -> Materials:
    """Returns metals with albedos, and the environment, that explain the captured colours of N Gaussians.

    Albedo and environment are optimised together for a sample of Gaussians, drawn in proportion to their blending
    weights. The environment is then scaled to be grey on average, and the lightest metals to an albedo of 0.8. At last,
    every Gaussian gets the albedo whose radiance is closest to its own colours. Roughness and normals stay.

    Args:
        gaussians: The capture.
        incident: Traced incident radiance.
        start: Initial materials and environment.
        colors: Views of the Gaussians.
        seed: Seed of the random numbers.
        device: As in `lumisplat.create_renderer`.
        threads: As in `lumisplat.create_renderer`.
        report: Called with a description of the current work and the fraction done, 0..1.
    """
    launcher = Launcher(device, threads)
    launcher.load([material_kernels, material_gradient_kernels], report)
    fit = _ColorFit(launcher, gaussians, incident, colors, report)
    weights, rng = colors.weights.sum(axis=0, dtype=np.float64), np.random.default_rng([seed, 9])
    size = min(SAMPLE, int(np.count_nonzero(weights)))
    rows = np.sort(rng.choice(len(weights), size, replace=False, p=weights / weights.sum()))
    sample = fit.sample(start, rows, rng)
    distances, near = cKDTree(gaussians.means[rows]).query(gaussians.means, k=range(1, min(NEIGHBOURS, size) + 1))
    shares = 1.0 / np.maximum(distances, DISTANCE_MIN)
    shares /= shares.sum(axis=1, keepdims=True)
    factor = np.exp(np.log(start.environment).mean(axis=0) - np.log(sample.environment).mean(axis=0))
    factor *= np.quantile((sample.albedo / factor).max(axis=1), LIGHTEST) / ALBEDO_HIGH
    spread = replace(
        start,
        albedo=np.einsum("nk,nkc->nc", shares, sample.albedo[near] / factor),
        environment=sample.environment * factor,
    )
    return replace(spread, albedo=fit.albedo(spread))


@dataclass(frozen=True, slots=True, eq=False)
class _ColorFit:
    """One call of `fit_colors`."""

    launcher: Launcher
    gaussians: Gaussians
    incident: IncidentRadiance
    colors: CapturedColors
    report: Progress

    def sample(self, start: Materials, rows: Rows, rng: np.random.Generator) -> Materials:
        """Returns materials of the Gaussians ``rows``, and the environment, optimised for their captured colours."""
        lit, sh = self._lit(rows)
        parameters = MaterialParameters(start.subset(rows), self.incident.directions)
        wanted = [self.colors.shown(self.gaussians, view, rows) for view in range(len(self.colors.eyes))]
        seen = self.colors.weights[:, rows].astype(np.float64)
        views = np.flatnonzero(seen.any(axis=1))
        for step in range(STEPS):
            self.report("finding the environment of metals", step / STEPS)
            if step % len(views) == 0:
                rng.shuffle(views)
            view = int(views[step % len(views)])
            lit.shade(parameters.materials, self.colors.eyes[view], sh)
            radiance = lit.radiance
            encoded = encode_srgb(np.clip(radiance, 0.0, 1.0))
            difference = encoded - wanted[view]
            slope = difference / np.sqrt(difference**2 + LOSS_WIDTH**2) / decode_slope(encoded)
            by_radiance = seen[view][:, None] / (3.0 * seen[view].sum()) * slope
            by_radiance[(radiance >= 1.0) & (by_radiance < 0.0)] = 0.0  # the display clips at white
            parameters.step(lit.differentiate(by_radiance), RATES.scaled(RATE_FALL ** (step / STEPS)))
        return parameters.materials

    def albedo(self, materials: Materials) -> Doubles:
        """Returns albedos of N Gaussians, shape (N, 3), by least squares of their linear radiance in all views.

        Radiance is linear in the albedo: that of black, plus the albedo times the difference of white and black.
        Colours that are clipped at white do not count. ``materials.albedo`` counts a little, or alone where no view
        shows a Gaussian.
        """
        lit, sh = self._lit(slice(None))
        black, white = (replace(materials, albedo=np.full_like(materials.albedo, value)) for value in (0.0, 1.0))
        above, below = np.zeros((2, self.gaussians.count, 3))
        for view, eye in enumerate(self.colors.eyes):
            self.report("finding albedo", view / len(self.colors.eyes))
            lit.shade(black, eye, sh)
            least = lit.radiance
            lit.shade(white, eye, sh)
            rise = lit.radiance - least
            shown = self.colors.shown(self.gaussians, view, slice(None))
            weights = self.colors.weights[view][:, None] * (shown < CLIPPED_MIN)
            above += weights * rise * (decode_srgb(shown) - least)
            below += weights * rise * rise
        lit_parts = below[below > 0.0]
        pull = ALBEDO_PULL * np.median(lit_parts) if lit_parts.size else 1.0
        return np.maximum((above + pull * materials.albedo) / (below + pull), 0.0)

    def _lit(self, rows: Rows | slice) -> tuple[LitGaussians, DeviceArray]:
        """Returns some of the Gaussians, to be shaded, and the array that receives their display colours."""
        buffers, means = Buffers(self.launcher.device), self.gaussians.means[rows]
        lit = LitGaussians(self.launcher, buffers, means, self.incident.subset(rows), metal=True)
        return lit, buffers.get("materials.sh", wp.vec3, len(means))
