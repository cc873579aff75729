"""The deep Gaussian shadow map of a light (docs/method/deep_shadow_maps.md)."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import Absorption, DeepShadowConfig, ReceiverSampling, check_kind
from lumisplat.device.shadow_map.atlas import Atlas
from lumisplat.device.shadow_map.lookup import CENTER, RANDOM, STENCIL
from lumisplat.device.shadow_map.optical_depth import AVERAGE, MASS, SIMPLE
from lumisplat.device.structs.shadow_map import Casters, Column, Footprint, Look, Occluder, Receivers, Shade, Table
from lumisplat.errors import SceneError, check_shapes
from lumisplat.math.arrays import FloatArray, float_array
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher, Progress
from lumisplat.scene.ops.world_gaussians import PlacedGaussians, center_of
from lumisplat.shadow_maps import deep_shadow_map_kernels as kernels
from lumisplat.shadow_maps.atlas import Source, atlas_of, shade_of, source_of
from lumisplat.shadow_maps.casters import Content, MeshesAsGaussians, as_iterable
from lumisplat.shadow_maps.culling import BANDS_PER_THREAD, OneList, TileLists
from lumisplat.shadow_maps.map_files import read_map, write_map
from lumisplat.shadow_maps.region import Region, all_tiles, region_of_casters, region_of_receivers, whole_region

_log = logging.getLogger("lumisplat")

_MAPPING = {
    Absorption.SIMPLE: int(SIMPLE),
    Absorption.AVERAGE: int(AVERAGE),
    Absorption.MASS: int(MASS),
    Absorption.DIAGONAL: int(MASS),
}
_PATTERN = {
    ReceiverSampling.CENTER: int(CENTER),
    ReceiverSampling.STENCIL: int(STENCIL),
    ReceiverSampling.MONTE_CARLO: int(RANDOM),
}
STENCIL_POINTS = 7

Receiving = Content | Iterable[Content] | npt.ArrayLike
"""What looks at a map: Gaussians, or what can be turned into them, or points."""


@dataclass(frozen=True, slots=True)
class DeepShadowStats:
    """What the last build took."""

    casters: int
    """Gaussians that block light."""
    texels: int
    """Of the atlas, that are tabulated."""
    voxels: int
    """Bins over all of them."""
    pairs: int
    """Casters and texels whose rays were followed through them."""
    stage_ms: dict[str, float]
    """Wall time of each stage, milliseconds."""


class DeepShadowMap:
    """How much of a light passes casters: transmittance by direction and distance, in closed form.

    Gaussians absorb light all along its way, ``sigma(x) = sum beta exp(-1/2 d(x)^2)``, so that shadows are soft at
    their edges, tinted by nothing, and fall on whatever is behind, to the right degree for each distance. Made by
    `build`. Source: docs/method/deep_shadow_maps.md.

    Transmittance is tabulated at the centres of texels and bins and interpolated; with ``receivers``, only where they
    look. Elsewhere it is 1.
    """

    def __init__(self, config: DeepShadowConfig, source: Source, launcher: Launcher) -> None:
        self.config = config
        """Settings."""
        self._source, self._launcher = source, launcher
        self._buffers = Buffers(launcher.device)
        self._turned = MeshesAsGaussians()
        self._atlas = Atlas()
        self._region: Region | None = None
        """The same for all builds; None: it follows the casters."""
        self._lists: TileLists | None = None
        """Of that region."""
        self._laid_out: Region | None = None
        """What the arrays are of that follow."""
        self._texels: Any = None
        self._own_lists: Any = None
        self._table = Table()
        self._shade = Shade()
        self.stats = DeepShadowStats(0, 0, 0, 0, {})
        """Of the last build."""

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
        """Tabulates what casters leave of a light.

        Args:
            casters: Gaussians, meshes (which are turned into Gaussians), instances, a scene, or several of these.
            light_position: Where the light is, world space, shape (3,), or a light: of one with a radius, its
                centre; of a `LightDirectional`, light is parallel.
            receivers: What will look at the map, likewise, or points, shape (N, 3). None: anything might, behind
                the casters.
            config: Settings; None: the defaults.
            device: As for `create_renderer`.
            progress: Called with a label and a fraction 0..1 while kernels compile.

        Raises:
            ConfigError: ``config`` is no DeepShadowConfig.
            DeviceError: There is no such device, or it is out of memory.
            SceneError: There are no casters, something is of another kind, or a value is not finite.
        """
        config = DeepShadowConfig() if config is None else config
        check_kind("config", config, DeepShadowConfig)
        source = source_of(light_position)
        launcher = Launcher(device)
        launcher.load([kernels], progress)
        shadow = cls(config, source, launcher)
        blockers = shadow._blockers(casters)
        if receivers is not None:
            shadow._place_receivers(receivers, blockers)
        shadow._tabulate(blockers)
        return shadow

    def rebuild(self, casters: Content | Iterable[Content]) -> None:
        """Tabulates other casters, for the same light and receivers; memory is kept, and grows only if they need more.

        Args:
            casters: As for `build`.

        Raises:
            DeviceError: The device is out of memory.
            SceneError: As for `build`.
        """
        self._launcher.stage_ms.clear()
        self._tabulate(self._blockers(casters))

    def transmittance(self, points: npt.ArrayLike) -> FloatArray:
        """How much of the light reaches points.

        Args:
            points: World space, shape (N, 3). Of a map that was built for receivers, only theirs are tabulated:
                others may get 1.

        Returns:
            0..1, shape (N,).

        Raises:
            SceneError: The shape does not fit, or values are not finite.
        """
        return self._look_up(_points(points))

    def transmittance_of(self, receivers: Receiving) -> FloatArray:
        """How much of the light reaches Gaussians, as ``config.sampling`` says.

        Source: docs/method/deep_shadow_maps.md#lookup.

        Args:
            receivers: As for `build`: those that the map was built for, in the same order, or any others.

        Returns:
            0..1, shape (N,), in order.

        Raises:
            SceneError: Something is of another kind, or a value is not finite.
        """
        return self._look_up(_placed_receivers(receivers))

    @property
    def bytes(self) -> int:
        """Memory that the map holds on its device, bytes."""
        return self._buffers.bytes

    @property
    def device(self) -> str:
        """Warp name of the device, e.g. ``cpu`` or ``cuda:0``."""
        return self._launcher.device

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes the map to an ``.npz`` file, without its casters.

        Raises:
            FormatError: The file cannot be written.
        """
        assert self._laid_out is not None
        write_map(
            *(path, self.config, self._source, self._atlas),
            region=self._laid_out,
            table=self._table.values.numpy(),
            follows=self._region is None,
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str], *, device: str = "auto") -> DeepShadowMap:
        """Reads a map that `save` wrote; `rebuild` works as if it had been built here.

        Args:
            path: The ``.npz`` file.
            device: As for `create_renderer`.

        Raises:
            DeviceError: There is no such device, or it is out of memory.
            FormatError: The file is missing, or is none of these.
        """
        config, source, atlas, region, table, follows = read_map(path)
        launcher = Launcher(device)
        launcher.load([kernels])
        shadow = cls(config, source, launcher)
        shadow._atlas, shadow._region = atlas, None if follows else region
        shadow._lay_out(region, shadow._caster_lists())
        shadow._table.values.assign(table)
        shadow._shade = shade_of(atlas, None)  # what casts is not in the file
        return shadow

    def _blockers(self, casters: Content | Iterable[Content]) -> PlacedGaussians:
        placed = self._turned.placed("casters", casters)
        if not len(placed.means):
            raise SceneError("casters have no Gaussians: there is nothing to cast a shadow")
        return placed

    def _place_receivers(self, receivers: Receiving, blockers: PlacedGaussians) -> None:
        """Sets atlas and region by what will look at the map."""
        placed = _placed_receivers(receivers)
        rows = np.arange(len(placed.means), dtype=np.int32)
        if self.config.region_radius is not None:
            rows = rows[
                np.abs(placed.means - center_of(blockers)).max(axis=1, initial=0.0) <= self.config.region_radius
            ]
        if not len(rows):
            _log.warning("there are no receivers near the casters: nothing is shadowed")
        self._atlas = atlas_of(self._source, PlacedGaussians(*(column[rows] for column in placed)), self.config)
        if not self.config.region:
            self._region = whole_region(self._atlas)
            return
        with self._launcher.stage("region"):
            # Where a receiver looks goes by its place among all: the far ones must not be left out here.
            data, look = self._looking(placed)
            self._region = region_of_receivers(self._launcher, self._atlas, data, rows, look)

    def _tabulate(self, blockers: PlacedGaussians) -> None:
        """Writes the table for casters, and the rest that follows them where nothing else says it."""
        launcher = self._launcher
        if self._region is None:
            self._atlas = atlas_of(self._source, blockers, self.config)
        with launcher.stage("casters"):
            occluders, footprints = self._occluders(blockers)
            self._shade = shade_of(self._atlas, footprints.numpy() if self.config.culling else None)
        with launcher.stage("cull"):
            lists = self._caster_lists()
            lists.update(footprints)
        with launcher.stage("tabulate"):
            region = self._region or region_of_casters(self._atlas, blockers, lists)
            if region is not self._laid_out:
                self._lay_out(region, lists)
            launcher.run_banded(
                kernels.tabulate,
                *(len(region.texels), self._atlas, int(self.config.culling), self._texels, self._own_lists),
                *(lists.ends, lists.items, occluders, self._table),
                bands=BANDS_PER_THREAD * launcher.threads,
            )
            launcher.synchronize()
        pairs = int(lists.counts[lists.of_texels(region.texels)].sum(dtype=np.int64))
        self.stats = DeepShadowStats(
            len(blockers.means), len(region.texels), region.voxel_count, pairs, dict(launcher.stage_ms)
        )

    def _occluders(self, blockers: PlacedGaussians) -> tuple[Any, Any]:
        """Casters as tables need them, and what they cover."""
        launcher, buffers, count = self._launcher, self._buffers, len(blockers.means)
        casters = buffers.struct("casters", Casters, count)
        casters.means.assign(blockers.means)
        casters.rotations.assign(blockers.rotations_wxyz[:, [1, 2, 3, 0]])
        casters.scales.assign(blockers.scales)
        casters.opacities.assign(blockers.opacities)
        occluders = buffers.get("occluders", Occluder, count)
        footprints = buffers.get("footprints", Footprint, count)
        mapping = _MAPPING[self.config.absorption]
        launcher.run_banded(
            kernels.prepare_occluders,
            *(count, self._atlas, casters, mapping, self.config.strength, occluders, footprints),
        )
        return occluders, footprints

    def _caster_lists(self) -> TileLists | OneList:
        """The lists of what may be in the way, by tiles or for all."""
        if not self.config.culling:
            return OneList(self._buffers)
        if self._region is None:
            return TileLists(self._launcher, self._buffers, self._atlas, all_tiles(self._atlas))
        if self._lists is None:
            self._lists = TileLists(self._launcher, self._buffers, self._atlas, self._region.tiles)
        return self._lists

    def _lay_out(self, region: Region, lists: TileLists | OneList) -> None:
        """Uploads where the columns of a region are."""
        slots, columns = region.columns(self._atlas)
        self._table.slots = self._buffers.get("slots", wp.int32, len(slots))
        self._table.slots.assign(slots)
        self._table.columns = self._buffers.get("columns", Column, len(columns))
        self._table.columns.assign(columns)
        self._table.values = self._buffers.get("table", wp.float32, region.voxel_count)
        self._texels = self._buffers.get("texels", wp.int32, len(region.texels))
        self._texels.assign(region.texels)
        self._own_lists = self._buffers.get("own_lists", wp.int32, len(region.texels))
        self._own_lists.assign(lists.of_texels(region.texels))
        self._laid_out = region

    def _looking(self, placed: PlacedGaussians) -> tuple[Receivers, Look]:
        """Receivers on the device, and where they look; those without extent, at their means."""
        look = Look()
        look.pattern, look.count = _PATTERN[self.config.sampling], self.config.samples
        look.seed = wp.uint32(self.config.seed)
        if self.config.sampling is ReceiverSampling.STENCIL:
            look.count = STENCIL_POINTS
        if self.config.sampling is ReceiverSampling.CENTER or not placed.scales.any():
            look.pattern, look.count = int(CENTER), 1
        receivers = self._buffers.struct("receivers", Receivers, len(placed.means))
        receivers.means.assign(placed.means)
        receivers.rotations.assign(placed.rotations_wxyz[:, [1, 2, 3, 0]])
        receivers.scales.assign(placed.scales)
        return receivers, look

    def _look_up(self, placed: PlacedGaussians) -> FloatArray:
        receivers, look = self._looking(placed)
        found = self._buffers.get("found", wp.float32, len(placed.means))
        self._launcher.run_banded(
            kernels.look_up,
            *(len(placed.means), self._atlas, self._shade, self._table, receivers, look, found),
            bands=BANDS_PER_THREAD * self._launcher.threads,
        )
        return found.numpy().copy()  # on the CPU, the buffer itself


def _placed_receivers(receivers: Receiving) -> PlacedGaussians:
    """What looks at a map; points are Gaussians without extent."""
    if isinstance(receivers, Content):
        return MeshesAsGaussians().placed("receivers", receivers)
    items: Any = receivers if isinstance(receivers, np.ndarray) else list(as_iterable("receivers", receivers))
    if np.ndim(items) and len(items) and isinstance(items[0], Content):
        return MeshesAsGaussians().placed("receivers", items)
    return _points(items)


def _points(values: npt.ArrayLike) -> PlacedGaussians:
    points = float_array("points", values)
    if points.size == 0:
        points = points.reshape(0, 3)
    check_shapes(points=(points, "N 3"))
    turns = np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (len(points), 1))
    return PlacedGaussians(points, turns, np.zeros_like(points), np.zeros(len(points), np.float32))
