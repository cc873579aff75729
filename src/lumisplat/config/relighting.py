"""Settings of relighting: how a probe's light changes the colours of Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from lumisplat.config.checks import check_flag, check_range, check_whole, take_enum


class NormalEstimate(Enum):
    """Where normals of Gaussians come from."""

    AUTO = "auto"
    """The set's own ``normals``; a set without any uses `SMALLEST_AXIS`."""
    SMALLEST_AXIS = "smallest-axis"
    """Each Gaussian's thinnest axis: sharp, and noisy where Gaussians are round."""
    PCA = "pca"
    """Normal of the plane through the neighbouring means, weighted by opacity and distance: smooth, and blunt at
    edges."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelightConfig:
    """Settings of the transfer of a probe's light to Gaussians (docs/method/relighting.md#transfer).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    exponent: float = 1.0
    """Exponent q of the cosine lobe about the normal that gathers light, 0.1..64: 1 is matt, more is glossier."""
    scale_max: float = 4.0
    """Largest factor t_max of a Gaussian's colour, before ``gamma``, 0..1000."""
    gamma: float = 1.0
    """Linear factor of all light, 0..1000. At 1, surroundings of radiance 1 (display white) leave colours as they
    are."""
    normals: NormalEstimate = NormalEstimate.AUTO
    """Where normals come from if none are given."""
    rows: int = 16
    """Rows of the latitude-longitude grid, twice as wide as high, over which light is summed, 8..128: with 16, the sum
    is within 1 % of that over a fine grid, for probes of degree 3 and any exponent."""

    def __post_init__(self) -> None:
        check_range("exponent", self.exponent, 0.1, 64.0)
        check_range("scale_max", self.scale_max, 0.0, 1000.0)
        check_range("gamma", self.gamma, 0.0, 1000.0)
        take_enum(self, "normals", NormalEstimate)
        check_whole("rows", self.rows, 8, 128)


@dataclass(frozen=True, slots=True, kw_only=True)
class DelightConfig:
    """Settings of the separation of a capture into materials and light (docs/method/delighting.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    cells: int = 12
    """The light at each Gaussian is traced in so many times so many cells of all directions, 4..32."""
    inside: bool | None = None
    """Whether the capture was taken from inside of it, as a room is; None: if a good part of it sees no sky."""
    matt: bool = False
    """Whether the materials that will relight the capture are matt (``MaterialPbr(specular=0)``): then all that it
    shows is of the albedo. Else they are as `MaterialPbr` has them, and what such a surface mirrors is not."""
    seed: int = 0
    """Of rays and of which Gaussians are compared."""

    def __post_init__(self) -> None:
        check_whole("cells", self.cells, 4, 32)
        check_flag("matt", self.matt)
        if self.inside is not None:
            check_flag("inside", self.inside)
        check_whole("seed", self.seed, 0, 2**32 - 1)
