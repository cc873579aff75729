"""What rough surfaces show of light from around them, tabulated: the same for every Gaussian in its own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from lumisplat.constants.baking import RIDGE
from lumisplat.constants.delight import (
    BIN_RINGS,
    BIN_SAMPLES,
    BIN_SECTORS,
    LOBE_VIEWS,
    ROUGHNESS_GRID,
    VIEW_COSINE_LEAST,
)
from lumisplat.constants.materials import SPREAD_SHARE
from lumisplat.math.arrays import Doubles, Flags, FloatArray, Rows
from lumisplat.math.sh import even_directions, sh_basis
from lumisplat.relighting.delight import lobe_kernels
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher


@dataclass(frozen=True, slots=True, eq=False)
class Lobes:
    """Tables for R roughnesses, M views and Q bins of directions, around a normal that is z."""

    views: Doubles
    """Unit, shape (M, 3)."""
    matt: Doubles
    """Radiance to a view of the matt part of a surface of albedo 1, by the irradiance over pi from a bin, (R, M, Q)."""
    highlight: Doubles
    """That of the highlight, likewise."""
    kept: Doubles
    """What harmonics of the capture's degree keep of colours, shape (M, M)."""

    @staticmethod
    def of(degree: int) -> Lobes:
        """For captures of a degree. Tables are made on the CPU: they are small, and the same everywhere."""
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
        return Lobes(views, matt, highlight, kept_by_harmonics(views, degree))

    @property
    def compared(self) -> Flags:
        """Views whose colours are compared: not the grazing ones, shape (M,)."""
        return self.views[:, 2] > VIEW_COSINE_LEAST

    def in_even_light(self, roughness: FloatArray) -> tuple[Doubles, Doubles]:
        """What most views see in even light of radiance 1: of the matt part of a surface of albedo 1, and mirrored.

        Args:
            roughness: 0..1, shape (N,).

        Returns:
            Radiances, shape (N,) both.
        """
        cosines = bin_samples()[..., 2].mean(axis=1)
        shares = cosines / cosines.sum()
        matt, mirrored = (
            np.median((table @ shares)[:, self.compared], axis=1) for table in (self.matt, self.highlight)
        )
        return np.interp(roughness, ROUGHNESS_GRID, matt), np.interp(roughness, ROUGHNESS_GRID, mirrored)


def frames_of(normals: Doubles) -> Doubles:
    """Rotations that take z to the normals, world from local, shape (N, 3, 3) (Duff et al. 2017)."""
    x, y, z = normals.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    across = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    along = np.stack([b, sign + y * y * a, -y], axis=1)
    return np.stack([across, along, normals], axis=2)


def bins_of(directions: Doubles) -> Rows:
    """The bin of each direction above the horizon, local, shape (N,): rings of equal height in equal sectors."""
    ring = np.clip(directions[:, 2] * BIN_RINGS, 0, BIN_RINGS - 1).astype(int)
    sector = np.floor(np.arctan2(directions[:, 1], directions[:, 0]) / (2.0 * np.pi) * BIN_SECTORS).astype(int)
    return ring * BIN_SECTORS + sector % BIN_SECTORS


def bin_samples() -> Doubles:
    """Directions spread evenly over each bin, unit, shape (Q, S, 3)."""
    within = (np.arange(BIN_SAMPLES) + 0.5) / BIN_SAMPLES
    height = (np.arange(BIN_RINGS)[:, None] + within) / BIN_RINGS
    angle = 2.0 * np.pi * (np.arange(BIN_SECTORS)[:, None] + within) / BIN_SECTORS
    z = np.repeat(np.repeat(height[:, None, :, None], BIN_SECTORS, axis=1), BIN_SAMPLES, axis=3)
    phi = np.broadcast_to(angle[None, :, None, :], z.shape)
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=-1).reshape(-1, BIN_SAMPLES**2, 3)


def kept_by_harmonics(views: Doubles, degree: int) -> Doubles:
    """From colours less 0.5 in views to those of the harmonics nearest to them, as `bake` fits them, (M, M)."""
    basis = sh_basis(views, degree)
    level = np.floor(np.sqrt(np.arange((degree + 1) ** 2) + 0.5))
    shares = 4.0 * np.pi / len(views) * basis.T
    return basis @ np.linalg.solve(shares @ basis + RIDGE * np.diag((level * (level + 1.0)) ** 2), shares)


def _views() -> Doubles:
    """Even views of the upper hemisphere."""
    around = even_directions(2 * LOBE_VIEWS)
    return around[around[:, 2] > 0.0]
