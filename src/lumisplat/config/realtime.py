"""Settings of frames in real time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from lumisplat.config.checks import Range
from lumisplat.config.setting import Share, take_fields

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Settings = TypeVar("_Settings", bound="DataclassInstance")


class RealtimeQuality(Enum):
    """How good a frame in real time is, and how long it takes (docs/guide/realtime.md)."""

    PREVIEW = "preview"
    """To see how a scene is lit: fewer samples, rays and passes of the filter."""
    BALANCED = "balanced"
    """For animations: the settings as they are by default."""
    HIGH = "high"
    """For pictures to keep: more rays, and means over more frames, which follow changes more slowly."""


_QUALITY_PRESETS: Mapping[RealtimeQuality, Mapping[str, Mapping[str, Any]]] = {
    RealtimeQuality.PREVIEW: {
        "": {"light_interval": 2, "highlight_rays": False, "antialiasing": False},
        "filter": {"passes": 2},
        "probes": {"tile": 16, "refreshed": 0.1},
        "cache": {"bounces": 2048},
    },
    RealtimeQuality.BALANCED: {},
    RealtimeQuality.HIGH: {
        "filter": {"frames": 64, "indirect_frames": 16},
        "probes": {"refreshed": 0.5},
        "cache": {"tiles": 32_768, "cell_size": 1.0 / 16.0, "bounces": 16_384},
    },
}
"""Settings that take the place of defaults, by group; those of ``RealtimeConfig`` itself under no name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """How the noise of a frame is taken out (docs/method/realtime.md#filters).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    frames: Annotated[int, Range(1, 1024)] = 32
    """Frames over which light is averaged: more are less noisy, and slower to follow what changes."""
    indirect_frames: Annotated[int, Range(1, 1024)] = 8
    """The same of indirect light, if that is fewer: the probes that find it have histories of their own."""
    passes: Annotated[int, Range(0, 6)] = 4
    """Times that each pixel is averaged with those around it, twice as far apart each time."""
    radius: Annotated[int, Range(1, 2)] = 1
    """Neighbours to each side in a pass."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeConfig:
    """Settings of screen probes: what gathers indirect light in real time (docs/method/realtime.md#screen-probes).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    tile: Annotated[int, Range(8, 64, "pixels")] = 8
    """Side of the square of pixels that has a probe: 16 takes a tenth less time on CPUs, for errors nearly
    twice as large."""
    cells: Annotated[int, Range(4, 16)] = 8
    """Cells along each side of a probe's map of all directions; each refresh takes a ray a cell."""
    refreshed: Annotated[float, Range(0.01, 1.0)] = 0.25
    """Probes that a frame refreshes, as a share of the number of tiles: with 8-pixel tiles and 8 x 8 cells,
    0.25 is one ray for 4 pixels."""
    history: Annotated[int, Range(1, 256)] = 4
    """Refreshes that a cell's mean goes back: more of them are quieter, and follow light more slowly."""
    adaptive: Share = 0.5
    """Most probes besides one a tile, as a share of the number of tiles: for surfaces that those miss."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class RadianceCacheConfig:
    """Settings of the cache of radiance in world space (docs/method/realtime.md#radiance-cache).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    tiles: Annotated[int, Range(64, 2**20)] = 16_384
    """Most tiles that are kept, each 8 x 8 cells and 4.9 KiB. When all are in use, those unused longest go."""
    cell_size: Annotated[float, Range(0.0, 1.0, above=True, below=True)] = 1.0 / 8.0
    """Largest width of a cell as a share of its distance from the eye; widths are powers of two."""
    history: Annotated[int, Range(1, 1024)] | None = None
    """Frames that a mean of direct light is taken over. None: 16 on CUDA, 32 on CPUs, whose frames have fewer
    rays."""
    bounce_history: Annotated[int, Range(1, 1024)] = 4
    """Rays that a mean of indirect light is taken over. Light that bounces often is the sooner there the fewer
    they are; probes average what noise they leave."""
    samples_min: Annotated[int, Range(1, 1024)] = 8
    """Samples below which a mean counts as noisy, and one over more cells is taken."""
    bounces: Annotated[int, Range(128, 2**20)] = 8192
    """Rays of a frame that leave cells, for the light that these receive from other surfaces: one a cell, or up to 16
    where fewer cells share them."""
    unused_frames: Annotated[int, Range(1, 10_000)] = 50
    """A tile that no ray has hit for so many frames is forgotten."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class RealtimeConfig:
    """Settings of ``Pipeline.REALTIME`` (docs/method/realtime.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    quality: RealtimeQuality = RealtimeQuality.BALANCED
    """What all other settings here are that have their defaults; those that differ from them stay as they are."""
    light_interval: Annotated[int, Range(1, 2)] = 1
    """Frames in which each pixel has one sample of direct and of indirect light: with 2, half of the blocks of
    4 x 4 pixels in one frame, the others in the next. It is 1 where ``filter.passes`` is below 2: new surfaces would be
    black."""
    highlight_rays: bool = True
    """Narrow highlights show what rays of their own see, one for four pixels; else what probes see, blurred."""
    antialiasing: bool = True
    """Pixels are means over frames, whose samples are elsewhere in them each time: edges are smooth."""
    filter: FilterConfig = field(default_factory=FilterConfig)
    """How the noise is taken out."""
    probes: ProbeConfig = field(default_factory=ProbeConfig)
    """How the pixels' surroundings are looked at."""
    cache: RadianceCacheConfig = field(default_factory=RadianceCacheConfig)
    """What is kept of the surfaces around."""

    __post_init__ = take_fields

    @property
    def of_quality(self) -> RealtimeConfig:
        """The settings that frames have: what ``quality`` says in place of defaults."""
        changes = _QUALITY_PRESETS[self.quality]
        groups = {
            "filter": _changed(self.filter, changes.get("filter", {})),
            "probes": _changed(self.probes, changes.get("probes", {})),
            "cache": _changed(self.cache, changes.get("cache", {})),
        }
        chosen = replace(_changed(self, changes.get("", {})), **groups)
        return chosen if chosen.filter.passes >= 2 else replace(chosen, light_interval=1)


def _changed(settings: _Settings, changes: Mapping[str, Any]) -> _Settings:
    """Settings with changes, except of those that are not at their defaults."""
    defaults = type(settings)()
    free = {name: value for name, value in changes.items() if getattr(settings, name) == getattr(defaults, name)}
    return replace(settings, **free)
