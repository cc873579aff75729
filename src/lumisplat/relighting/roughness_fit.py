"""Fits roughness to highlights: finds the roughness that best explains a capture's colours from all view directions.

Reflection lobes are tabulated once, in the local frame of a normal along z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.constants import RADIANCE_LEAST, RIDGE, SPREAD_SHARE
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows, read_only_view
from lumisplat.math.color import decode_slope, decode_srgb, encode_srgb
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting import lobe_kernels
from lumisplat.relighting.albedo_fit import EnvironmentCells, Light
from lumisplat.relighting.incident import normal_variances
from lumisplat.relighting.irradiance import Irradiance
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.ops.neighbours import Pairs

ROUGHNESS_UNKNOWN = 0.8
"""Roughness assigned to Gaussians without a highlight from which a roughness could be fitted."""

ROUGHNESS_GRID = (0.15, 0.22, 0.3, 0.4, 0.5, 0.6, 0.7, 0.85, 1.0)
"""Roughnesses that the fit tries. Below the first one, highlights in SH of degree 3 no longer change."""

ROUGHNESS_ROWS = 2048
"""Number of Gaussians whose roughness is fitted at once, in about 100 MB."""

LOBE_VIEWS = 96
"""Number of views of the upper hemisphere in which colours are compared. If there are too few, the part of a sharp
highlight that SH cannot represent aliases: 24 views give roughness 0.3 as 0.4, 48 give 0.33."""

VIEW_COSINE_LEAST = 0.2
"""Smallest cosine between the normal and a view direction at which colours are compared, because captures lack grazing
views of Gaussians."""

BIN_RINGS = 8
"""Number of rings of equal solid angle, from horizon to zenith, into which the hemisphere of incident light is
divided."""

BIN_SECTORS = 20
"""Number of equal sectors into which each ring of the hemisphere of incident light is divided; the resulting bins are
11 degrees wide."""

BIN_SAMPLES = 4
"""Number of sample directions along each side of a bin of incident light; reflection lobes are integrated over them."""

ALBEDO_STEPS = 4
"""Number of Gauss-Newton steps that fit a Gaussian's albedo for each trial roughness."""

HIGHLIGHT_NOISE = 0.008
"""Lower bound of the error of captured colours in the comparison of roughnesses, display values: 2 of 255."""

SAME_ALBEDO = 0.1
"""Standard deviation, in natural logarithms of albedo, of a weight: neighbours share their fit errors if their albedos
are similar, because similar albedos suggest one material."""

SAME_NORMALS = 4
"""Exponent of the cosine between normals in a weight: neighbouring Gaussians share their fit errors if their normals
are similar."""


@dataclass(frozen=True, slots=True, eq=False)
class RoughnessFit:
    """Fits the roughness of N dielectric Gaussians with ior 1.5 under estimated light.

    For each roughness of a grid, the albedo is fitted with which the modelled colours are nearest to the captured ones.
    Colours are compared as clipped display values, projected onto SH of the capture's degree. The remaining errors,
    averaged over similar neighbours, give the likelihood of the roughness.
    """

    gaussians: Gaussians
    normals: Doubles
    """Unit normals towards the visible side of the N Gaussians, shape (N, 3)."""
    near: Pairs
    """Pairs of neighbouring Gaussians, in both orders and with themselves; fit errors are averaged over them."""
    lobes: Lobes

    def fitted(self, arriving: FloatArray, tried: Callable[[int], object] = lambda count: None) -> FloatArray:
        """Fits the perceptual roughness, 0..1, of N Gaussians, shape (N,); 0.8 where highlights do not show it.

        Args:
            arriving: Irradiance over pi from each of Q bins of the Gaussian's hemisphere, shape (N, Q, 3).
            tried: Called after each batch with the number of Gaussians in the batch.
        """
        variances = normal_variances(self.gaussians, self.normals, self.near)
        parts: list[tuple[Doubles, Doubles]] = []
        for rows in np.array_split(np.arange(len(arriving)), -(-len(arriving) // ROUGHNESS_ROWS)):
            parts.append(self._misfits(rows, arriving[rows].astype(np.float64), widened(variances[rows])))
            tried(len(rows))
        misfit, albedo = (np.concatenate(values) for values in zip(*parts, strict=True))
        probabilities = self._probabilities(self._pooled(misfit, np.median(albedo, axis=1)))
        grid = np.array(ROUGHNESS_GRID)
        mean = probabilities @ grid
        variance = np.maximum(probabilities @ np.square(grid) - np.square(mean), 0.0)
        known = np.clip(1.0 - variance / grid.var(), 0.0, 1.0)
        return read_only_view((ROUGHNESS_UNKNOWN + known * (mean - ROUGHNESS_UNKNOWN)).astype(np.float32))

    def _misfits(self, rows: Rows, arriving: Doubles, wider: Doubles) -> tuple[Doubles, Doubles]:
        """Returns the mean squared error and the best albedo of n Gaussians for each of R roughnesses.

        Args:
            rows: Indices of the n Gaussians.
            arriving: Irradiance over pi from each of Q bins, shape (n, Q, 3).
            wider: Weights from `widened`, which account for varying normals, shape (n, R, R).

        Returns:
            Errors, shape (n, R), and albedos, shape (n, R, 3).
        """
        lobes, compared = self.lobes, self.lobes.compared
        captured = self._captured(rows)
        linear = decode_srgb(captured)
        misfits: list[Doubles] = []
        albedos: list[Doubles] = []
        for matt_table, highlight_table in zip(lobes.matt, lobes.highlight, strict=True):
            matt, highlight = (np.tensordot(table, arriving, (1, 1)) for table in (matt_table, highlight_table))
            most = ((linear - highlight) / np.maximum(matt, RADIANCE_LEAST))[compared]
            albedo = np.clip(np.median(most, axis=0), 0.0, 1.0)
            for _ in range(ALBEDO_STEPS):
                error, slope = self._errors(albedo * matt + highlight, captured)
                by_albedo = np.tensordot(lobes.projection, slope * matt, (1, 0))[compared]
                step = (error * by_albedo).sum(axis=0) / np.maximum(np.square(by_albedo).sum(axis=0), 1e-9)
                albedo = np.clip(albedo - step, 0.0, 1.0)
            error, _ = self._errors(albedo * matt + highlight, captured)
            misfits.append(np.square(error).mean(axis=(0, 2)))
            albedos.append(albedo)
        return np.einsum("nrs,ns->nr", wider, np.stack(misfits, axis=1)), wider @ np.stack(albedos, axis=1)

    def _errors(self, linear: Doubles, captured: Doubles) -> tuple[Doubles, Doubles]:
        """Returns errors of modelled display colours in the compared views, and slopes of the sRGB curve in all views.

        The model's colours are given as linear radiance, ``linear``. Before the comparison they are clipped, encoded
        and projected onto SH.
        """
        displayed, slope = _displayed(linear)
        projection = np.tensordot(self.lobes.projection, displayed - 0.5, (1, 0)) + 0.5
        return (projection - captured)[self.lobes.compared], slope

    def _captured(self, rows: Rows) -> Doubles:
        """Returns the captured display colours of the n Gaussians ``rows`` in M views of their hemispheres."""
        some = self.gaussians.subset(rows)
        directions = np.einsum("nij,mj->mni", frames_of(self.normals[rows]), self.lobes.views)
        return np.array(
            [np.clip(colors_along(some, -view_directions), 0.0, 1.0) for view_directions in directions],
            dtype=np.float64,
        )

    def _pooled(self, misfit: Doubles, albedo: Doubles) -> Doubles:
        """Averages the errors at each of R roughnesses over neighbours with similar normals and albedo, (N, R)."""
        first, second = self.near.first, self.near.second
        logs = np.log(np.maximum(albedo, RADIANCE_LEAST))
        apart = np.abs(logs[first] - logs[second]).max(axis=1) / SAME_ALBEDO
        facing = np.maximum(np.einsum("ij,ij->i", self.normals[first], self.normals[second]), 0.0)
        weights = np.exp(-0.5 * np.square(apart)) * facing**SAME_NORMALS
        total = np.bincount(first, weights, len(misfit))
        sums = [np.bincount(first, weights * column[second], len(misfit)) for column in misfit.T]
        return np.stack(sums, axis=1) / total[:, None]

    def _probabilities(self, misfit: Doubles) -> Doubles:
        """Returns each Gaussian's probability of each of R roughnesses, (N, R); its smallest error counts as noise."""
        least = misfit.min(axis=1, keepdims=True)
        coefficients = (self.gaussians.sh_degree + 1) ** 2 - 1
        probabilities = np.exp(-0.5 * coefficients * (misfit - least) / np.maximum(least, HIGHLIGHT_NOISE**2))
        return probabilities / probabilities.sum(axis=1, keepdims=True)


def widened(variances: Doubles) -> Doubles:
    """Returns weights that replace each of R trial roughnesses by a larger one where normals vary, shape (N, R, R).

    Row r of a Gaussian holds the weights of the R trial roughnesses that interpolate values at the larger roughness.
    The slopes of microfacets have the variance alpha^2 / 2 along an axis. The variance v of the normals adds to this
    variance (Toksvig 2005), so that alpha^2 becomes alpha^2 + 2 v. Cubics (Lagrange) interpolate between roughnesses of
    the grid.

    Args:
        variances: Variances of normals within N Gaussians, radians^2 along an axis, shape (N,).
    """
    grid = np.array(ROUGHNESS_GRID)
    rougher = np.minimum((grid**4 + 2.0 * variances[:, None]) ** 0.25, grid[-1])
    first = np.clip(np.searchsorted(grid, rougher, side="right") - 2, 0, len(grid) - 4)
    shares = np.zeros((*rougher.shape, len(grid)))
    for node in range(4):
        others = [grid[first + other] for other in range(4) if other != node]
        share = np.prod([(rougher - other) / (grid[first + node] - other) for other in others], axis=0)
        np.put_along_axis(shares, (first + node)[..., None], share[..., None], axis=2)
    return shares


def arriving_light(normals: Doubles, cells: EnvironmentCells, incident: Irradiance, light: Light) -> FloatArray:
    """Returns the irradiance over pi of N Gaussians from each of Q bins of their hemispheres, shape (N, Q, 3).

    Args:
        normals: Unit normals, shape (N, 3).
        cells: Environment cells.
        incident: Irradiance by source; its ``by_direction`` must be stored.
        light: Estimated radiances of the environment cells.
    """
    frames, rows = frames_of(normals), np.arange(len(normals))
    arriving = np.zeros((len(normals), BIN_RINGS * BIN_SECTORS, 3), np.float32)

    def add(directions: Doubles, irradiance: FloatArray | Doubles, k: int) -> None:
        arriving[rows, bins_of(np.einsum("nij,i->nj", frames, directions[k]))] += irradiance

    for k in range(len(incident.by_direction)):
        add(incident.directions, incident.by_direction[k], k)
    for k in range(len(cells)):
        add(cells.directions, incident.environment[:, k, None] * light.environment[k], k)
    return arriving


def _displayed(linear: Doubles) -> tuple[Doubles, Doubles]:
    """Returns sRGB values of linear light clipped at 1, and their derivatives by the light, 0 where clipped."""
    inside = np.clip(linear, RADIANCE_LEAST, 1.0)
    displayed = np.asarray(encode_srgb(inside), np.float64)
    return displayed, np.where(linear < 1.0, 1.0 / decode_slope(displayed), 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Lobes:
    """Tables of the light that surfaces with normal z and R roughnesses reflect from Q direction bins to M views."""

    views: Doubles
    """Unit view directions in the local frame whose z axis is the normal, shape (M, 3)."""
    matt: Doubles
    """Diffuse radiance towards each view at albedo 1, divided by the irradiance / pi from each bin of directions,
    shape (R, M, Q)."""
    highlight: Doubles
    """Specular radiance towards each view, divided by the irradiance / pi from each bin of directions, shape (R, M,
    Q)."""
    projection: Doubles
    """Matrix that projects colours in the M views onto SH of the capture's degree and back, shape (M, M)."""

    @staticmethod
    def of(degree: int) -> Lobes:
        """Tabulates the lobes for captures of SH degree ``degree``; on the CPU, for equal results on all devices."""
        launcher = Launcher("cpu")
        buffers, samples, views = Buffers("cpu"), bin_samples(), _views()
        shape = len(ROUGHNESS_GRID), len(views), len(samples)
        inputs = [
            buffers.get("lobes.roughness", wp.float32, shape[0]),
            buffers.get("lobes.views", wp.vec3, shape[1]),
            buffers.get("lobes.samples", wp.vec3, samples.shape[:2]),
        ]
        for array, values in zip(inputs, (np.array(ROUGHNESS_GRID), views, samples), strict=True):
            array.assign(values.astype(np.float32))
        tables = [buffers.get(f"lobes.{name}", wp.float32, int(np.prod(shape))) for name in ("matt", "highlight")]
        spread = SPREAD_SHARE**2 * 2.0 * np.pi / (shape[2] * BIN_SAMPLES**2)
        launcher.load([lobe_kernels])
        launcher.run_banded(lobe_kernels.tabulate_lobes, int(np.prod(shape)), spread, *inputs, *tables)
        matt, highlight = (table.numpy().reshape(shape).astype(np.float64) for table in tables)
        return Lobes(views, matt, highlight, sh_projection(views, degree))

    @property
    def compared(self) -> Flags:
        """True for views in which colours are compared, those with a cosine above `VIEW_COSINE_LEAST`, shape (M,)."""
        return self.views[:, 2] > VIEW_COSINE_LEAST

    def in_constant_environment(self, roughness: FloatArray) -> tuple[Doubles, Doubles]:
        """Returns diffuse (albedo 1) and specular radiance in an environment of constant radiance 1.

        Both are medians over the views.

        Args:
            roughness: Roughness of N surfaces, 0..1, shape (N,).

        Returns:
            Diffuse and specular radiance, shape (N,) each.
        """
        cosines = bin_samples()[..., 2].mean(axis=1)
        shares = cosines / cosines.sum()
        matt, mirrored = (
            np.median((table @ shares)[:, self.compared], axis=1) for table in (self.matt, self.highlight)
        )
        return np.interp(roughness, ROUGHNESS_GRID, matt), np.interp(roughness, ROUGHNESS_GRID, mirrored)


def frames_of(normals: Doubles) -> Doubles:
    """Returns rotations, world from local, that take z to the N normals, shape (N, 3, 3) (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    across = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    along = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([across, along, normals], axis=2)


def bins_of(directions: Doubles) -> Rows:
    """Returns the bin of each of N local directions with z > 0, (N,): rings of equal height, cut into equal sectors."""
    ring = np.clip(directions[:, 2] * BIN_RINGS, 0, BIN_RINGS - 1).astype(int)
    sector = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) / (2.0 * np.pi) * BIN_SECTORS).astype(int)
    return ring * BIN_SECTORS + sector % BIN_SECTORS


def bin_samples() -> Doubles:
    """Returns S unit directions evenly spread over each of the Q bins of incident light, z up, shape (Q, S, 3)."""
    within = (np.arange(BIN_SAMPLES) + 0.5) / BIN_SAMPLES
    height = (np.arange(BIN_RINGS)[:, None] + within) / BIN_RINGS
    angle = 2.0 * np.pi * (np.arange(BIN_SECTORS)[:, None] + within) / BIN_SECTORS
    z = np.repeat(np.repeat(height[:, None, :, None], BIN_SECTORS, axis=1), BIN_SAMPLES, axis=3)
    phi = np.broadcast_to(angle[None, :, None, :], z.shape)
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1).reshape(-1, BIN_SAMPLES**2, 3)


def sh_projection(views: Doubles, degree: int) -> Doubles:
    """Returns the matrix, (M, M), that fits SH to colours in M views, as `bake` does, and evaluates the fit there.

    The matrix applies to colours minus 0.5.
    """
    basis = sh_basis(views, degree)
    level = np.floor(np.sqrt(np.arange((degree + 1) ** 2) + 0.5))
    shares = 4.0 * np.pi / len(views) * basis.T
    return basis @ np.linalg.solve(shares @ basis + RIDGE * np.diag((level * (level + 1.0)) ** 2), shares)


def _views() -> Doubles:
    """Returns `LOBE_VIEWS` unit view directions evenly spread over the upper hemisphere."""
    around = even_directions(2 * LOBE_VIEWS)
    return around[around[:, 2] > 0.0]
