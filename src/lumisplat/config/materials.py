"""Settings of materials and light found from photographs."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.config.checks import check_range, check_whole


@dataclass(frozen=True, slots=True, kw_only=True)
class MaterialsConfig:
    """Settings of `lumisplat.find_materials` (docs/method/relightable.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    directions: int = 256
    """In which light is traced and the sky is known, 32 to 2048: memory is some 40 bytes for each and each Gaussian."""
    sky_steps: int = 300
    """By which the sky is found from albedos that are to be alike, 1 to 100,000."""
    iterations: int = 300
    """Steps that refine materials and sky by a photograph each, 0 to 10,000,000."""
    roughness: float = 0.5
    """Of all Gaussians at the start, 0.1 to 1."""
    seed: int = 0
    """Of everything that is random: one seed, one result, on any number of threads."""

    def __post_init__(self) -> None:
        check_whole("directions", self.directions, 32, 2048)
        check_whole("sky_steps", self.sky_steps, 1, 100_000)
        check_whole("iterations", self.iterations, 0, 10_000_000)
        check_range("roughness", self.roughness, 0.1, 1.0)
        check_whole("seed", self.seed, 0, 2**32 - 1)
