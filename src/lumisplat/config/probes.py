"""Settings of screen probes."""

from __future__ import annotations

from dataclasses import dataclass

from lumisplat.config.checks import check_range, check_whole


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeConfig:
    """Settings of screen probes: what gathers indirect light in real time (docs/method/realtime.md#screen-probes).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    tile: int = 8
    """Side of the square of pixels that has a probe, 8 to 64: 16 takes a tenth less time on CPUs, for errors nearly
    twice as large."""
    cells: int = 8
    """Cells along each side of a probe's map of all directions, 4 to 16; each refresh takes a ray a cell."""
    refreshed: float = 0.25
    """Probes that a frame refreshes, as a share of the number of tiles, 0.01..1: with 8-pixel tiles and 8 x 8 cells,
    0.25 is one ray for 4 pixels."""
    history: int = 4
    """Refreshes that a cell's mean goes back, 1 to 256: more of them are quieter, and follow light more slowly."""
    adaptive: float = 0.5
    """Most probes besides one a tile, as a share of the number of tiles, 0..1: for surfaces that those miss."""

    def __post_init__(self) -> None:
        check_whole("tile", self.tile, 8, 64)
        check_whole("cells", self.cells, 4, 16)
        check_range("refreshed", self.refreshed, 0.01, 1.0)
        check_whole("history", self.history, 1, 256)
        check_range("adaptive", self.adaptive, 0.0, 1.0)
