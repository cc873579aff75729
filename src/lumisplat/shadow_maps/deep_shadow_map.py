"""The deep Gaussian shadow map of a light (docs/method/deep_shadow_maps.md)."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import Absorption, DeepShadowConfig
from lumisplat.config.checks import check_kind
from lumisplat.constants import SHADOW_FOOTPRINT, SHADOW_TILE
from lumisplat.device.shadow_map.atlas import Atlas
from lumisplat.device.shadow_map.culling import Footprint
from lumisplat.device.shadow_map.light_extent import LightExtent
from lumisplat.device.shadow_map.lookup import ShadowBound
from lumisplat.device.shadow_map.optical_depth import AVERAGE, MASS, SIMPLE, Casters, Column, Occluder, Table
from lumisplat.errors import SceneError
from lumisplat.math.arrays import FloatArray
from lumisplat.progress import Progress
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.lights import LightDirectional
from lumisplat.scene.local_frame import LocalFrame, PlacedGaussians, distance_from_body, rendered_frame
from lumisplat.scene.scene import Scene
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels
from lumisplat.shadow_maps.atlas import (
    SHADOW_BLOCKING_REACH,
    Region,
    Source,
    all_tiles,
    atlas_of,
    region_of_casters,
    region_of_receivers,
    shadow_bound,
    source_of,
    whole_region,
)
from lumisplat.shadow_maps.casters_and_receivers import (
    Content,
    MeshesAsGaussians,
    Receiving,
    footprint_sampling,
    placed_points,
    placed_receivers,
    upload_receivers,
)
from lumisplat.shadow_maps.culling import BANDS_PER_THREAD, CulledCasters, OneList, TileLists
from lumisplat.shadow_maps.light_extent import bound_depths, extent_of, has_extent, widen_bound
from lumisplat.shadow_maps.map_files import StoredMap, read_map, write_map

_log = logging.getLogger("lumisplat")

SOFT_RESOLUTION = 0.7
"""Texels across the map of a light with an extent for each one of ``DeepShadowConfig.resolution``: half as many texels
in all. All that casters cover is tabulated, and penumbrae hide texels."""

SHADOW_RAYS_PER_SAMPLE = 4
"""Number of rays from a receiver to points of a light with an extent, for each of ``DeepShadowConfig.samples``."""

_MAPPING = {
    Absorption.SIMPLE: SIMPLE,
    Absorption.AVERAGE: AVERAGE,
    Absorption.MASS: MASS,
    Absorption.DIAGONAL: MASS,
}


@dataclass(frozen=True, slots=True)
class DeepShadowStats:
    """Sizes and times of the last build of a deep shadow map."""

    casters: int
    """Number of Gaussians that block light."""
    texels: int
    """Number of texels that are tabulated."""
    voxels: int
    """Number of depth bins over all tabulated texels."""
    pairs: int
    """Number of (texel, caster) pairs, summed over the caster lists that texels evaluated."""
    stage_ms: dict[str, float]
    """Wall time of each stage of the build, milliseconds, by name."""


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """Texels and depth bins of the last build, on the device."""

    region: Region
    texels: DeviceArray
    """Index of each tabulated texel."""
    list_of_texel: DeviceArray
    """For each texel in ``texels``, the index of the list of casters that may shadow it."""
    values: DeviceArray
    """Transmittance of all tabulated bins, texel by texel; for a light with an extent, optical depth. ``table`` refers
    to this array."""
    table: Table


class DeepShadowMap:
    """Deep shadow map of a light: tabulates the light's transmittance through casters by direction and distance.

    Optical depth is integrated in closed form: Gaussians absorb light along the whole ray, ``sigma(x) = sum beta
    exp(-1/2 d(x)^2)``. Shadows therefore have soft edges and no tint, and each point behind or inside the casters is
    darkened by the Gaussians between the point and the light. Create a map with `build`. Source:
    docs/method/deep_shadow_maps.md.

    Transmittance is tabulated at the centres of texels and bins and interpolated. With ``receivers``, only the texels
    and bins that the receivers sample are tabulated, and the transmittance is 1 elsewhere.

    Lights with an extent cast penumbrae: their maps tabulate what the casters cover, and lookups follow rays to points
    of the light through it.
    """

    def __init__(self, config: DeepShadowConfig, source: Source, extent: LightExtent, launcher: Launcher) -> None:
        self.config = config
        """Settings of the map."""
        self._source, self._extent, self._launcher = source, extent, launcher
        self._frame = LocalFrame(np.zeros(3))
        """Origin and unit to which the map is relative, chosen around the casters of the first build."""
        self._buffers = Buffers(launcher.device)
        self._meshes = MeshesAsGaussians()
        self._atlas = Atlas()
        self._follows_casters = True
        """Whether each build fits the atlas to its casters; False: it was fitted to receivers."""
        self._fixed_region: Region | None = None
        """Texels and depth bins that all builds tabulate, chosen for receivers; None: each build tabulates what its
        casters can shadow."""
        self._fixed_tiles: TileLists | None = None
        """Culls casters for an atlas that was fitted to receivers; created by the first build that needs it."""
        self._layout: _Layout | None = None
        """Texels and depth bins of the last build on the device; None before the first build."""
        self._bound = ShadowBound()
        self.stats = DeepShadowStats(0, 0, 0, 0, {})
        """Sizes and times of the last build."""

    @classmethod
    def build(
        cls,
        casters: Content | Iterable[Content],
        light_position: object,
        receivers: Receiving | None = None,
        config: DeepShadowConfig | None = None,
        *,
        device: str = "auto",
        progress: Progress | None = None,
    ) -> DeepShadowMap:
        """Builds a deep shadow map: tabulates the transmittance of a light through casters.

        Args:
            casters: Gaussians, meshes (which are converted to Gaussians), instances, a scene, or several of these.
            light_position: A light, or the position of a point light, world space, shape (3,). Lights with a radius,
                an angle or an area cast penumbrae. The rays of a `LightDirectional` are parallel.
            receivers: Objects or points whose shadows will be looked up: the types allowed for ``casters``, or points
                of shape (N, 3) for N points. None: any point behind the casters.
            config: Settings; None: the defaults.
            device: As for `create_renderer`.
            progress: Called with a label and a fraction 0..1 while kernels compile.

        Raises:
            ConfigError: ``config`` is no DeepShadowConfig.
            DeviceError: The device does not exist or is out of memory.
            SceneError: There are no casters, an argument is of another type, or a value is not finite.
        """
        config = DeepShadowConfig() if config is None else config
        check_kind("config", config, DeepShadowConfig)
        source = source_of(light_position)
        launcher = Launcher(device)
        launcher.load([kernels], progress)
        shadow = cls(config, source, extent_of(light_position), launcher)
        shadow._frame, _ = rendered_frame(Scene(shadow._meshes.instances("casters", casters)))
        if not isinstance(source, LightDirectional):
            shadow._source = shadow._frame.points(source)
        placed = shadow._placed_casters(casters)
        if receivers is not None:
            shadow._fix_region(placed_receivers(receivers, shadow._frame.origin), placed)
        shadow._tabulate(placed)
        return shadow

    def rebuild(self, casters: Content | Iterable[Content]) -> None:
        """Tabulates other casters for the light and receivers of `build`; memory is reused, and grows only if needed.

        Args:
            casters: As for `build`.

        Raises:
            DeviceError: The device is out of memory.
            SceneError: As for `build`.
        """
        self._launcher.stage_ms.clear()
        self._tabulate(self._placed_casters(casters))

    def transmittance(self, points: npt.ArrayLike) -> FloatArray:
        """Returns the transmittance from the light to N points.

        Args:
            points: N world-space points, shape (N, 3). A map built for receivers is tabulated only around them: the
                transmittance at other points may be 1 although they are shadowed.

        Returns:
            Transmittance at each point, 0..1, shape (N,).

        Raises:
            SceneError: The shape is not (N, 3), or values are not finite.
        """
        return self._sample(placed_points(points, self._frame.origin))

    def transmittance_of(self, receivers: Receiving) -> FloatArray:
        """Returns the transmittance from the light to receivers, averaged over samples in each receiver's footprint.

        Settings ``sampling`` and ``samples`` choose the samples. Source: docs/method/deep_shadow_maps.md#lookup.

        Args:
            receivers: As for `build`. Give the receivers for which the map was built, in the same order; other
                receivers may be given, but the transmittance is 1 where the map is not tabulated.

        Returns:
            Transmittance of each of N Gaussians or points, in the order of the receivers, 0..1, shape (N,).

        Raises:
            SceneError: A receiver is of another type, or a value is not finite.
        """
        return self._sample(placed_receivers(receivers, self._frame.origin))

    @property
    def bytes(self) -> int:
        """Device memory that the map occupies, bytes."""
        return self._buffers.bytes

    @property
    def device(self) -> str:
        """Warp name of the device, e.g. ``cpu`` or ``cuda:0``."""
        return self._launcher.device

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the map to an ``.npz`` file. The casters are not stored.

        Raises:
            FormatError: The file cannot be written.
        """
        assert self._layout is not None
        region, values = self._layout.region, self._layout.values.numpy()
        light = self._source, self._extent, self._frame.origin
        write_map(path, StoredMap(self.config, *light, self._atlas, region, values, self._follows_casters))

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: str = "auto") -> DeepShadowMap:
        """Reads a map written by `save`. `rebuild` works as on the map that was saved.

        Args:
            path: The ``.npz`` file.
            device: As for `create_renderer`.

        Raises:
            DeviceError: The device does not exist or is out of memory.
            FormatError: The file is not a deep shadow map.
            MissingFileError: There is no such file.
        """
        stored = read_map(path)
        launcher = Launcher(device)
        launcher.load([kernels])
        shadow = cls(stored.config, stored.source, stored.extent, launcher)
        shadow._atlas, shadow._frame = stored.atlas, LocalFrame(stored.about)
        shadow._follows_casters = stored.follows_casters
        if not stored.follows_casters and not has_extent(stored.extent):
            shadow._fixed_region = stored.region
        shadow._layout_for(stored.region, shadow._culling()).values.assign(stored.values)
        shadow._bound = shadow_bound(stored.atlas, None)  # the file does not hold the casters
        return shadow

    def _placed_casters(self, casters: Content | Iterable[Content]) -> PlacedGaussians:
        placed = self._meshes.placed("casters", casters, self._frame.origin)
        if not len(placed.means):
            raise SceneError("casters have no Gaussians: there is nothing to cast a shadow")
        return placed

    def _fix_region(self, receivers: PlacedGaussians, casters: PlacedGaussians) -> None:
        """Fits the atlas to receivers, and lets all builds tabulate only what lookups of these receivers read.

        Rays to a light with an extent may read all that casters cover, which a plane of parallel light must cover, too.
        """
        rows = np.arange(len(receivers.means), dtype=np.int32)
        if self.config.region_radius is not None:
            rows = rows[distance_from_body(receivers.means, casters) <= self.config.region_radius]
        if not len(rows):
            _log.warning(
                "no receivers are near the casters, so the map shadows nothing: "
                "pass receivers, or increase DeepShadowConfig.region_radius"
            )
        near = PlacedGaussians(*(column[rows] for column in receivers))
        self._follows_casters = False
        if has_extent(self._extent) and isinstance(self._source, LightDirectional):
            near = PlacedGaussians(*(np.concatenate(columns) for columns in zip(near, casters, strict=True)))
        self._fit_atlas(near)
        if has_extent(self._extent):
            return
        if not self.config.region:
            self._fixed_region = whole_region(self._atlas)
            return
        with self._launcher.stage("region"):
            # All receivers are uploaded, because the samples of a receiver depend on its index.
            uploaded, sampling = (
                upload_receivers(self._buffers, receivers),
                footprint_sampling(self.config, receivers),
            )
            self._fixed_region = region_of_receivers(self._launcher, self._atlas, uploaded, rows, sampling)

    def _fit_atlas(self, around: PlacedGaussians) -> None:
        """Fits the atlas to Gaussians."""
        config = self.config
        if has_extent(self._extent):
            across = math.ceil(SOFT_RESOLUTION * config.resolution / SHADOW_TILE) * SHADOW_TILE
            config = replace(config, resolution=across)
        self._atlas = atlas_of(self._source, around, config)

    def _tabulate(self, casters: PlacedGaussians) -> None:
        """Tabulates casters. Atlas and region are first fitted to the casters unless they are fixed for receivers."""
        launcher = self._launcher
        if self._follows_casters:
            self._fit_atlas(casters)
        with launcher.stage("casters"):
            occluders, footprints = self._occluders(casters)
            self._bound = shadow_bound(self._atlas, footprints.numpy() if self.config.culling else None)
        with launcher.stage("cull"):
            culling = self._culling()
            culled = culling.cull(footprints)
        with launcher.stage("tabulate"):
            region = self._fixed_region
            if region is None:
                region = self._region(casters, culling, culled)
            layout = self._layout_for(region, culling)
            if has_extent(self._extent):
                widen_bound(self._bound, self._atlas, self._extent)
            launcher.run_banded(
                kernels.tabulate,
                *(len(region.texels), self._atlas, self.config.culling, has_extent(self._extent)),
                *(layout.texels, layout.list_of_texel, culled.lists, occluders, layout.table),
                bands=BANDS_PER_THREAD * launcher.threads,
            )
            launcher.synchronize()
        pairs = int(culled.counts[culling.list_numbers(region.texels)].sum(dtype=np.int64))
        self.stats = DeepShadowStats(
            len(casters.means), len(region.texels), region.voxel_count, pairs, dict(launcher.stage_ms)
        )

    def _occluders(self, placed: PlacedGaussians) -> tuple[DeviceArray, DeviceArray]:
        """Prepares casters for the light: returns rows of Occluder (absorption) and rows of Footprint (bounds)."""
        launcher, buffers, count = self._launcher, self._buffers, len(placed.means)
        casters = Casters()
        casters.means = buffers.upload("casters.means", wp.vec3, placed.means)
        casters.rotations = buffers.upload("casters.rotations", wp.quat, placed.rotations_xyzw)
        casters.scales = buffers.upload("casters.scales", wp.vec3, placed.scales)
        casters.opacities = buffers.upload("casters.opacities", wp.float32, placed.opacities)
        occluders = buffers.get("occluders", Occluder, count)
        footprints = buffers.get("footprints", Footprint, count)
        mapping = _MAPPING[self.config.absorption]
        launcher.run_banded(
            kernels.prepare_occluders,
            *(count, self._atlas, casters, mapping, self.config.strength, occluders, footprints),
        )
        return occluders, footprints

    def _culling(self) -> TileLists | OneList:
        """Returns the object that lists casters by tile, or one that makes a single list if ``culling`` is disabled."""
        if not self.config.culling:
            return OneList(self._buffers)
        if self._follows_casters:
            return TileLists(self._launcher, self._buffers, self._atlas, all_tiles(self._atlas))
        if self._fixed_tiles is None:
            tiles = all_tiles(self._atlas) if self._fixed_region is None else self._fixed_region.tiles
            self._fixed_tiles = TileLists(self._launcher, self._buffers, self._atlas, tiles)
        return self._fixed_tiles

    def _region(self, casters: PlacedGaussians, culling: TileLists | OneList, culled: CulledCasters) -> Region:
        """Returns the region that the casters of a build can shadow; without culling, all of the atlas."""
        if isinstance(culling, OneList):
            return whole_region(self._atlas)
        items = np.asarray(culled.lists.items.numpy(), np.int32)[: int(culled.counts.sum(dtype=np.int64))]
        deviations = SHADOW_FOOTPRINT if has_extent(self._extent) else SHADOW_BLOCKING_REACH
        return region_of_casters(
            self._atlas, casters, culling.tiles, items=items, counts=culled.counts, deviations=deviations
        )

    def _layout_for(self, region: Region, culling: TileLists | OneList) -> _Layout:
        """Uploads the layout of a region's texels and depth bins, unless the last build used the same layout."""
        if self._layout is None or self._layout.region is not region:
            slots, columns = region.columns(self._atlas)
            values = self._buffers.get("table", wp.float32, region.voxel_count)
            table = Table()
            table.slots = self._buffers.upload("slots", wp.int32, slots)
            table.columns = self._buffers.upload("columns", Column, columns)
            table.values = values
            texels = self._buffers.upload("texels", wp.int32, region.texels)
            lists = self._buffers.upload("list_of_texel", wp.int32, culling.list_numbers(region.texels))
            self._layout = _Layout(region, texels, lists, values, table)
            bound_depths(self._extent, self._atlas, region)
        return self._layout

    def _sample(self, placed: PlacedGaussians) -> FloatArray:
        """Returns the mean transmittance from the light over each receiver's footprint."""
        assert self._layout is not None
        receivers, sampling = upload_receivers(self._buffers, placed), footprint_sampling(self.config, placed)
        transmittance = self._buffers.get("transmittance", wp.float32, len(placed.means))
        inputs = len(placed.means), self._atlas, self._bound, self._layout.table, receivers, sampling
        bands = BANDS_PER_THREAD * self._launcher.threads
        if has_extent(self._extent):
            rays = sampling.count * math.ceil(SHADOW_RAYS_PER_SAMPLE * self.config.samples / sampling.count)
            soft = kernels.average_soft_transmittance
            self._launcher.run_banded(soft, *inputs, self._extent, rays, transmittance, bands=bands)
        else:
            self._launcher.run_banded(kernels.average_transmittance, *inputs, transmittance, bands=bands)
        return transmittance.numpy().copy()  # on the CPU, numpy() is a view of the buffer
