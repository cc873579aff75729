"""Models the radiance cache in float64, with cells in dictionaries and one sample at a time.

Values that choose a sample's cell are rounded to float32 as in the kernels; the rest is float64.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from support.oracles.means_oracle import mean_weight

FINER_NEAR = 3
ALBEDO_MAX = 0.99
TILE = 8


class Cell(NamedTuple):
    """A square cell on one side of a surface, one cell thick."""

    level: int
    is_near: bool
    face: int
    u: int
    v: int
    w: int


@dataclass
class Mean:
    """A running mean."""

    value: np.ndarray
    weight: float = 0.0
    frames: int = 0
    updated: int = -1


@dataclass
class Samples:
    """Hits of N active rays, with fields as in ``CacheSamples``."""

    position: np.ndarray
    normal: np.ndarray
    distance: np.ndarray
    from_eye: np.ndarray
    albedo: np.ndarray
    radiance: np.ndarray
    extent: np.ndarray

    def __len__(self) -> int:
        return len(self.position)


@dataclass
class RadianceCacheOracle:
    """A radiance cache that evicts nothing."""

    cell_size: float
    history: int
    samples_min: float
    bounce_history: int
    direct: dict[Cell, Mean] = field(default_factory=dict)
    indirect: dict[Cell, Mean] = field(default_factory=dict)

    def insert(self, samples: Samples, frame: int) -> None:
        """Adds the samples of a frame to the means of their cells."""
        batches: dict[Cell, list[np.ndarray]] = {}
        for i in range(len(samples)):
            batches.setdefault(self.cell_of(samples, i), []).append(samples.radiance[i].astype(float))
        for cell, batch in batches.items():
            mean = self.direct.setdefault(cell, Mean(np.zeros(3)))
            if mean.updated != frame:
                if mean.frames == self.history:
                    mean.weight *= 1.0 - 1.0 / self.history
                mean.frames = min(mean.frames + 1, self.history)
                mean.updated = frame
            total = mean.value * mean.weight + np.sum(batch, axis=0)
            mean.weight += len(batch)
            mean.value = total / mean.weight

    def add_bounces(self, rays: Mapping[Cell, Sequence[int]], hits: Samples) -> None:
        """Adds the radiance at a frame's hits to the cells that sent the rays.

        ``rays`` holds the indices of each cell's hits. The step repeats four times, so that hits see each other's
        light.
        """
        before = {cell: copy(self.indirect.get(cell, Mean(np.zeros(3)))) for cell in rays}
        for _ in range(4):
            radiance_found = self.look_up(hits)
            for cell, numbers in rays.items():
                mean, count = before[cell], len(numbers)
                weight = mean_weight(mean.weight, self.bounce_history)
                total = radiance_found[numbers].sum(axis=0)
                weight_after = min(mean.weight + count, max(self.bounce_history, self.samples_min))
                self.indirect[cell] = Mean((mean.value * weight + total) / (weight + count), weight_after)

    def outdate(self, share: float) -> None:
        """Scales the weights of all means by ``share``."""
        for mean in (*self.direct.values(), *self.indirect.values()):
            mean.weight *= share
            mean.frames = min(mean.frames, max(int(share * mean.frames), 1))

    def look_up(self, samples: Samples) -> np.ndarray:
        """Returns the radiance of each sample's surface."""
        return np.array([self.radiance(samples, i) for i in range(len(samples))])

    def look_up_indirect(self, samples: Samples) -> np.ndarray:
        """Returns the reflected indirect light of each sample's surface, from cells of long rays."""
        return np.array([reflected(samples, i, self.far_indirect(samples, i)) for i in range(len(samples))])

    def radiance(self, samples: Samples, i: int) -> np.ndarray:
        """Returns the direct and indirect radiance of one sample's surface."""
        cell = self.cell_of(samples, i)
        indirect = self.far_indirect(samples, i)
        if cell.is_near:
            near = self.best(self.indirect, [cell], 1.0)
            return samples.radiance[i] + reflected(samples, i, indirect if near is None else near)
        direct = self.best(self.direct, self.far_cells(samples, i), self.samples_min)
        return (samples.radiance[i] if direct is None else direct) + reflected(samples, i, indirect)

    def far_indirect(self, samples: Samples, i: int) -> np.ndarray | None:
        """Returns the indirect irradiance over pi at one sample, from cells of long rays; None if unknown."""
        return self.best(self.indirect, self.far_cells(samples, i), self.samples_min)

    def far_cells(self, samples: Samples, i: int) -> list[Cell]:
        """Returns the cell of long rays at a sample, and those of the next coarser and finer levels."""
        level = self.level_of(samples, i)
        return [cell_at(samples, i, at, is_near=False) for at in (level, level + 1, level - 1)]

    def best(self, means: dict[Cell, Mean], cells: list[Cell], weight_min: float) -> np.ndarray | None:
        """Returns the mean of the finest square of cells with enough samples, around the first cell that has one.

        If no square has enough samples, the mean with the most samples is returned, or None without samples.
        """
        found, weight_max = None, 0.0
        for cell in cells:
            for mip in range(4):
                inside = [means[other] for other in square(cell, mip) if other in means]
                weight = sum(mean.weight for mean in inside)
                if weight > weight_max:
                    weight_max = weight
                    found = sum((mean.value * mean.weight for mean in inside), np.zeros(3)) / weight
                if weight_max >= weight_min:
                    return found
        return found

    def level_of(self, samples: Samples, i: int) -> int:
        """Returns the level of the cells of long rays at a sample; such cells are 2^level scene units wide."""
        wanted = np.float32(self.cell_size) * np.float32(samples.from_eye[i])
        least = np.abs(samples.position[i].astype(np.float32)).max() / np.float32(8191)
        return int(np.clip(np.floor(np.log2(float(max(wanted, least)))), -13, 14))

    def cell_of(self, samples: Samples, i: int) -> Cell:
        """Returns the cell of a sample."""
        level = self.level_of(samples, i)
        is_near = bool(np.float32(samples.distance[i]) < np.float32(2.0**level) + np.float32(samples.extent[i]))
        return cell_at(samples, i, level - FINER_NEAR * is_near, is_near=is_near)


def cell_at(samples: Samples, i: int, level: int, *, is_near: bool) -> Cell:
    """Returns the cell that a sample would have at a level."""
    normal = samples.normal[i]
    axis = int(np.argmax(np.abs(normal)))
    shift = np.where(np.arange(3) == axis, 0.382, 0.0)
    x = np.floor(samples.position[i].astype(np.float32).astype(float) / 2.0**level + shift).astype(int)
    face = 2 * axis + int(normal[axis] < 0)
    return Cell(level, is_near, face, int(x[(axis + 1) % 3]), int(x[(axis + 2) % 3]), int(x[axis]))


def square(cell: Cell, mip: int) -> list[Cell]:
    """Returns the aligned 2^mip x 2^mip cells around a cell, at most its whole tile."""
    assert 2**mip <= TILE
    side = 2**mip
    u, v = cell.u - cell.u % side, cell.v - cell.v % side
    return [cell._replace(u=u + i, v=v + j) for j in range(side) for i in range(side)]


def reflected(samples: Samples, i: int, indirect: np.ndarray | None) -> np.ndarray:
    """Returns the indirect light that a sample's surface reflects; zero if the light is unknown."""
    return np.zeros(3) if indirect is None else np.minimum(samples.albedo[i], ALBEDO_MAX) * indirect
