"""Settings of real-time frames."""

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
    """Quality and time of real-time frames (docs/guide/realtime.md)."""

    PREVIEW = "preview"
    """Fewer samples, rays and filter passes, to judge the light of a scene."""
    BALANCED = "balanced"
    """The default settings, for animations."""
    HIGH = "high"
    """More rays, and means over more frames, for still images. They follow changes more slowly."""


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
"""Default values that each quality replaces: by quality, then group (empty for ``RealtimeConfig`` itself), then
setting."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterConfig:
    """Settings of the denoising filters (docs/method/realtime.md#filters).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    frames: Annotated[int, Range(1, 1024)] = 32
    """Frames over which direct light is averaged: more frames are less noisy, and follow changes more slowly."""
    indirect_frames: Annotated[int, Range(1, 1024)] = 8
    """Frames over which indirect light is averaged, at most ``frames``. Few suffice, because screen probes average,
    too."""
    passes: Annotated[int, Range(0, 6)] = 4
    """Spatial filter passes, each a weighted mean over pixels whose spacing doubles from pass to pass (a-trous)."""
    radius: Annotated[int, Range(1, 2)] = 1
    """Number of neighbouring pixels to each side that a filter pass reads."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class ProbeConfig:
    """Settings of screen probes, which gather indirect light (docs/method/realtime.md#screen-probes).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    tile: Annotated[int, Range(8, 64, "pixels")] = 8
    """Side of the square of pixels that has one probe. 16 takes a tenth less time on CPUs, with errors nearly twice as
    large."""
    cells: Annotated[int, Range(4, 16)] = 8
    """Cells along each side of a probe's octahedral map of directions; updating a probe traces one ray per cell."""
    refreshed: Annotated[float, Range(0.01, 1.0)] = 0.25
    """Number of probes that a frame updates, as a fraction of the number of tiles. With 8-pixel tiles and 8 x 8 cells,
    0.25 is one ray for 4 pixels."""
    history: Annotated[int, Range(1, 256)] = 4
    """Updates of a probe over which its radiance is averaged: more are less noisy, and follow changes more slowly."""
    adaptive: Share = 0.5
    """Largest number of probes in addition to one per tile, as a fraction of the number of tiles. They cover surfaces
    that the probes of the tiles miss."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class RadianceCacheConfig:
    """Settings of the world-space radiance cache (docs/method/realtime.md#radiance-cache).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    tiles: Annotated[int, Range(64, 2**20)] = 16_384
    """Largest number of tiles in the cache: squares of 8 x 8 cells on surfaces in world space, 5.9 KiB each. A full
    cache drops the least recently used."""
    cell_size: Annotated[float, Range(0.0, 1.0, above=True, below=True)] = 1.0 / 8.0
    """Largest width of a cell as a fraction of its distance from the camera; widths are powers of two."""
    history: Annotated[int, Range(1, 1024)] | None = None
    """Frames over which a cell's direct light is averaged. None: 16 on CUDA, 32 on CPUs, whose frames have fewer rays.
    """
    bounce_history: Annotated[int, Range(1, 1024)] = 4
    """Rays over which a cell's indirect light is averaged. With fewer, light of many bounces arrives sooner; screen
    probes average the remaining noise."""
    samples_min: Annotated[int, Range(1, 1024)] = 8
    """Smallest number of samples, at most ``history``, from which a cell's own mean is used; with fewer, a mean over
    several cells is."""
    bounces: Annotated[int, Range(128, 2**20)] = 8192
    """Number of rays per frame from cells of the cache, which find their indirect light: one per cell, or up to 16 if
    there are few cells."""
    unused_frames: Annotated[int, Range(1, 10_000)] = 50
    """Number of frames after which a tile that no ray has hit is dropped from the cache."""

    __post_init__ = take_fields


@dataclass(frozen=True, slots=True, kw_only=True)
class RealtimeConfig:
    """Settings of ``Pipeline.REALTIME`` (docs/method/realtime.md).

    Raises:
        ConfigError: A value is of the wrong type or outside its range.
    """

    quality: RealtimeQuality = RealtimeQuality.BALANCED
    """Preset of the other real-time settings; it applies to those that still have their default value."""
    light_interval: Annotated[int, Range(1, 2)] = 1
    """Number of frames in which each pixel gets one sample of direct and of indirect light. With 2, each frame samples
    every other block of 4 x 4 pixels. Where ``filter.passes`` is below 2, 1 is used, as newly visible surfaces would be
    black; otherwise direct light uses 2 where captures act as lights."""
    highlight_rays: bool = True
    """Traces a ray for every four pixels of narrow highlights; otherwise highlights show the blurred radiance of
    probes. Needs ``max_bounces`` above 0, as all indirect light."""
    antialiasing: bool = True
    """Averages pixels of lit frames over frames with changing sample positions, which smooths edges; not with
    ``RenderConfig.jitter`` off."""
    filter: FilterConfig = field(default_factory=FilterConfig)
    """Settings of the denoising filters."""
    probes: ProbeConfig = field(default_factory=ProbeConfig)
    """Settings of the screen probes."""
    cache: RadianceCacheConfig = field(default_factory=RadianceCacheConfig)
    """Settings of the radiance cache."""

    __post_init__ = take_fields

    @property
    def of_quality(self) -> RealtimeConfig:
        """Settings that frames use: settings with default values are replaced by those of the preset ``quality``."""
        changes = _QUALITY_PRESETS[self.quality]
        groups = {
            "filter": _changed(self.filter, changes.get("filter", {})),
            "probes": _changed(self.probes, changes.get("probes", {})),
            "cache": _changed(self.cache, changes.get("cache", {})),
        }
        chosen = replace(_changed(self, changes.get("", {})), **groups)
        return chosen if chosen.filter.passes >= 2 else replace(chosen, light_interval=1)


def _changed(settings: _Settings, changes: Mapping[str, Any]) -> _Settings:
    """Returns settings with changed values; a setting that already differs from its default is left as it is."""
    defaults = type(settings)()
    free = {name: value for name, value in changes.items() if getattr(settings, name) == getattr(defaults, name)}
    return replace(settings, **free)
