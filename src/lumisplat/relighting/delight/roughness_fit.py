"""Roughness from highlights: which of some roughnesses shows the colours of a capture from all sides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lumisplat.constants.delight import (
    ALBEDO_STEPS,
    BIN_RINGS,
    BIN_SECTORS,
    HIGHLIGHT_NOISE,
    LIKE_ALBEDO,
    LIKE_NORMALS,
    RADIANCE_LEAST,
    ROUGHNESS_GRID,
    ROUGHNESS_ROWS,
    ROUGHNESS_UNKNOWN,
)
from lumisplat.math.arrays import Doubles, FloatArray, Rows, read_only_view
from lumisplat.math.color import decode_srgb, encode_srgb
from lumisplat.relighting.albedo.irradiance import Irradiance
from lumisplat.relighting.delight.albedo_fit import Light
from lumisplat.relighting.delight.lobes import Lobes, bins_of, frames_of
from lumisplat.relighting.delight.neighbours import normal_variances
from lumisplat.relighting.delight.sky_cells import SkyCells
from lumisplat.scene.gaussians import Gaussians
from lumisplat.scene.ops.colors import colors_along
from lumisplat.scene.sampling.blue_noise import Pairs


@dataclass(frozen=True, slots=True, eq=False)
class Roughness:
    """What highlights tell of N Gaussians."""

    value: FloatArray
    """0..1, shape (N,)."""
    sureness: FloatArray
    """By how much highlights narrow down what it may be, 0..1: at 0, it is `ROUGHNESS_UNKNOWN`; shape (N,)."""

    @staticmethod
    def unknown(count: int) -> Roughness:
        """Of Gaussians that look the same from everywhere."""
        value = read_only_view(np.full(count, ROUGHNESS_UNKNOWN, np.float32))
        return Roughness(value, read_only_view(np.zeros(count, np.float32)))


@dataclass(frozen=True, slots=True, eq=False)
class RoughnessFit:
    """Of surfaces of ior 1.5 without metal, under light that is known.

    For each roughness of a grid, albedo is such that colours come as near to the captured ones as they can, display
    values, clipped, and through harmonics of the capture's degree. What is left, of neighbours that are alike together,
    is how unlikely the roughness is.
    """

    gaussians: Gaussians
    normals: Doubles
    """Unit, shape (N, 3)."""
    near: Pairs
    """Neighbours, in both orders."""
    lobes: Lobes

    def found(self, arriving: FloatArray) -> Roughness:
        """Roughness of each Gaussian.

        Args:
            arriving: Irradiance over pi from each bin of its hemisphere, shape (N, Q, 3).
        """
        variances = normal_variances(self.gaussians, self.normals, self.near)
        parts = [
            self._misfits(rows, arriving[rows].astype(np.float64), widened(variances[rows]))
            for rows in np.array_split(np.arange(len(arriving)), -(-len(arriving) // ROUGHNESS_ROWS))
        ]
        misfit, albedo = (np.concatenate(values) for values in zip(*parts, strict=True))
        likely = self._likely(self._pooled(misfit, np.median(albedo, axis=1)))
        grid = np.array(ROUGHNESS_GRID)
        mean = likely @ grid
        variance = np.maximum(likely @ np.square(grid) - np.square(mean), 0.0)
        sure = np.clip(1.0 - variance / grid.var(), 0.0, 1.0)
        value = ROUGHNESS_UNKNOWN + sure * (mean - ROUGHNESS_UNKNOWN)
        return Roughness(read_only_view(value.astype(np.float32)), read_only_view(sure.astype(np.float32)))

    def _misfits(self, rows: Rows, arriving: Doubles, wider: Doubles) -> tuple[Doubles, Doubles]:
        """Of each roughness: mean squared error and albedo, shapes (n, R), (n, R, 3)."""
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
                by_albedo = np.tensordot(lobes.kept, slope * matt, (1, 0))[compared]
                move = (error * by_albedo).sum(axis=0) / np.maximum(np.square(by_albedo).sum(axis=0), 1e-9)
                albedo = np.clip(albedo - move, 0.0, 1.0)
            error, _ = self._errors(albedo * matt + highlight, captured)
            misfits.append(np.square(error).mean(axis=(0, 2)))
            albedos.append(albedo)
        return np.einsum("nrs,ns->nr", wider, np.stack(misfits, axis=1)), wider @ np.stack(albedos, axis=1)

    def _errors(self, linear: Doubles, captured: Doubles) -> tuple[Doubles, Doubles]:
        """Of display values that harmonics keep, in the views that are compared; slopes of the encoding in all."""
        shown, slope = _displayed(linear)
        kept = np.tensordot(self.lobes.kept, shown - 0.5, (1, 0)) + 0.5
        return (kept - captured)[self.lobes.compared], slope

    def _captured(self, rows: Rows) -> Doubles:
        """Colours in the views, display-referred, shape (M, n, 3)."""
        some = self.gaussians.subset(rows)
        ways = np.einsum("nij,mj->mni", frames_of(self.normals[rows]), self.lobes.views)
        return np.array([np.clip(colors_along(some, -way), 0.0, 1.0) for way in ways], dtype=np.float64)

    def _pooled(self, misfit: Doubles, albedo: Doubles) -> Doubles:
        """Means over neighbours that face the same way and have about the same albedo, shape (N, R)."""
        first, second = self.near.first, self.near.second
        logs = np.log(np.maximum(albedo, RADIANCE_LEAST))
        apart = np.abs(logs[first] - logs[second]).max(axis=1) / LIKE_ALBEDO
        facing = np.maximum(np.einsum("ij,ij->i", self.normals[first], self.normals[second]), 0.0)
        weights = np.exp(-0.5 * np.square(apart)) * facing**LIKE_NORMALS
        total = np.bincount(first, weights, len(misfit))
        sums = [np.bincount(first, weights * column[second], len(misfit)) for column in misfit.T]
        return np.stack(sums, axis=1) / total[:, None]

    def _likely(self, misfit: Doubles) -> Doubles:
        """Probability of each roughness, shape (N, R): the error of the best one is noise, of what harmonics hold."""
        least = misfit.min(axis=1, keepdims=True)
        held = (self.gaussians.sh_degree + 1) ** 2 - 1
        likely = np.exp(-0.5 * held * (misfit - least) / np.maximum(least, HIGHLIGHT_NOISE**2))
        return likely / likely.sum(axis=1, keepdims=True)


def widened(variances: Doubles) -> Doubles:
    """Shares of what each roughness of the grid shows where a surface turns, shape (N, R, R): that of rougher ones.

    Slopes of microfacets have a variance of alpha^2 / 2 along an axis, and those of the surface add theirs (Toksvig
    2005): alpha^2 + 2 variances. Between roughnesses of the grid, what they show is interpolated by cubics (Lagrange).

    Args:
        variances: Of normals within Gaussians, radians^2 along an axis, shape (N,).
    """
    grid = np.array(ROUGHNESS_GRID)
    rougher = np.minimum((grid**4 + 2.0 * variances[:, None]) ** 0.25, grid[-1])
    first = np.clip(np.searchsorted(grid, rougher, side="right") - 2, 0, len(grid) - 4)
    shares = np.zeros((*rougher.shape, len(grid)))
    for one in range(4):
        others = [grid[first + other] for other in range(4) if other != one]
        share = np.prod([(rougher - other) / (grid[first + one] - other) for other in others], axis=0)
        np.put_along_axis(shares, (first + one)[..., None], share[..., None], axis=2)
    return shares


def arriving_light(normals: Doubles, cells: SkyCells, incident: Irradiance, light: Light) -> FloatArray:
    """Irradiance over pi from each bin of the hemispheres of Gaussians, shape (N, Q, 3).

    Args:
        normals: Unit, shape (N, 3).
        cells: Of the sky.
        incident: Light with what the capture shows in each direction.
        light: That was found.
    """
    frames, rows = frames_of(normals), np.arange(len(normals))
    arriving = np.zeros((len(normals), BIN_RINGS * BIN_SECTORS, 3), np.float32)

    def add(directions: Doubles, irradiance: FloatArray | Doubles, k: int) -> None:
        arriving[rows, bins_of(np.einsum("nij,i->nj", frames, directions[k]))] += irradiance

    for k in range(len(incident.by_way)):
        add(incident.ways, incident.by_way[k], k)
    for k in range(len(cells)):
        add(cells.directions, incident.sky[:, k, None] * light.sky[k], k)
    return arriving


def _displayed(linear: Doubles) -> tuple[Doubles, Doubles]:
    """Display values, and their derivatives; what is above 1 is clipped."""
    inside = np.clip(linear, RADIANCE_LEAST, 1.0)
    shown = np.asarray(encode_srgb(inside), np.float64)
    # Of the encoding's power: 1.055 / 2.4 x^(1 / 2.4 - 1) is (shown + 0.055) / (2.4 x).
    slope = np.where(inside <= 0.0031308, 12.92, (shown + 0.055) / (2.4 * inside))
    return shown, np.where(linear < 1.0, slope, 0.0)
