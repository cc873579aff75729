"""What shines on Gaussians: what the capture shows of it, and the shares of a sky and of lamps."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lumisplat.math.arrays import Doubles, FloatArray

HalfArray = npt.NDArray[np.float16]


@dataclass(frozen=True, slots=True, eq=False)
class Irradiance:
    """Irradiance over pi of N Gaussians: what a white surface would show. Linear, in units of display white."""

    observed: Doubles
    """Of what the capture shows, without its lamps, shape (N, 3)."""
    sky: FloatArray
    """Of each of K cells of a sky of radiance 1, shape (N, K)."""
    lamps: FloatArray
    """Of each of L lamps of radiance 1, shape (N, L)."""
    ways: Doubles = field(default_factory=lambda: np.zeros((0, 3)))
    """Directions in which what the capture shows was kept apart, unit, shape (W, 3); none if it was not."""
    by_way: HalfArray = field(default_factory=lambda: np.zeros((0, 0, 3), np.float16))
    """The share of ``observed`` that comes from each, shape (W, N, 3)."""

    def total(self, sky: Doubles | FloatArray, lamps: Doubles) -> Doubles:
        """That of a sky and lamps, shape (N, 3).

        Args:
            sky: Radiances, shape (K, 3); float32 are multiplied as such, in half the memory.
            lamps: Likewise, shape (L, 3).
        """
        return self.observed + self.sky @ sky + self.lamps @ lamps
