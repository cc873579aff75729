"""Settings of frames in real time."""

from __future__ import annotations

from dataclasses import dataclass, field

from lumisplat.config.checks import check_between, check_kind, check_whole
from lumisplat.config.probes import ProbeConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """How the noise of a frame is taken out (docs/method/realtime.md#filters).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    frames: int = 32
    """Frames over which light is averaged, 1..1024: more are less noisy, and slower to follow what changes."""
    indirect_frames: int = 8
    """The same of indirect light, 1..1024, if that is fewer: the probes that find it have histories of their own."""
    passes: int = 4
    """Times that each pixel is averaged with those around it, twice as far apart each time, 0..6."""
    radius: int = 1
    """Neighbours to each side in a pass, 1 or 2."""

    def __post_init__(self) -> None:
        check_whole("frames", self.frames, 1, 1024)
        check_whole("indirect_frames", self.indirect_frames, 1, 1024)
        check_whole("passes", self.passes, 0, 6)
        check_whole("radius", self.radius, 1, 2)


@dataclass(frozen=True, slots=True, kw_only=True)
class RadianceCacheConfig:
    """Settings of the cache of radiance in world space (docs/method/realtime.md#radiance-cache).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    tiles: int = 16_384
    """Most tiles that are kept, each 8 x 8 cells and 5.7 KiB. When all are in use, those unused longest go."""
    cell_size: float = 1.0 / 8.0
    """Largest width of a cell as a share of its distance from the eye; widths are powers of two."""
    history: int | None = None
    """Frames that a mean of direct light is taken over, 1..1024. None: 16 on CUDA, 32 on CPUs, whose frames have fewer
    rays."""
    bounce_history: int = 4
    """Rays that a mean of indirect light is taken over, 1..1024. Light that bounces often is the sooner there the fewer
    they are; probes average what noise they leave."""
    samples_min: int = 8
    """Samples below which a mean counts as noisy, and one over more cells is taken."""
    bounces: int = 8192
    """Cells of which a frame traces one ray each, for the light that they receive from other surfaces."""
    unused_frames: int = 50
    """A tile that no ray has hit for so many frames is forgotten."""

    def __post_init__(self) -> None:
        check_whole("tiles", self.tiles, 64, 2**20)
        check_between("cell_size", self.cell_size, 0.0, 1.0)
        if self.history is not None:
            check_whole("history", self.history, 1, 1024)
        check_whole("bounce_history", self.bounce_history, 1, 1024)
        check_whole("samples_min", self.samples_min, 1, 1024)
        check_whole("bounces", self.bounces, 64, 2**20)
        check_whole("unused_frames", self.unused_frames, 1, 10_000)


@dataclass(frozen=True, slots=True, kw_only=True)
class RealtimeConfig:
    """Settings of ``Pipeline.REALTIME`` (docs/method/realtime.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    filter: FilterConfig = field(default_factory=FilterConfig)
    """How the noise is taken out."""
    probes: ProbeConfig = field(default_factory=ProbeConfig)
    """How the pixels' surroundings are looked at."""
    cache: RadianceCacheConfig = field(default_factory=RadianceCacheConfig)
    """What is kept of the surfaces around."""

    def __post_init__(self) -> None:
        check_kind("filter", self.filter, FilterConfig)
        check_kind("probes", self.probes, ProbeConfig)
        check_kind("cache", self.cache, RadianceCacheConfig)
