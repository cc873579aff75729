"""A lit scene on the device: materials, what Gaussians carry for light, lights and settings."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from lumisplat.config import RenderConfig, Shadows
from lumisplat.device.structs.shading import (
    SEES_BACKGROUND,
    SEES_ENVIRONMENT,
    SEES_NOTHING,
    MaterialData,
    ShadingScene,
    ShadingSettings,
    SplatAttributes,
    SplatPlacement,
)
from lumisplat.renderer.scene.device_scene import DeviceScene, table_dtype
from lumisplat.renderer.scene.lights import LightTable
from lumisplat.renderer.scene.materials import material_table
from lumisplat.renderer.scene.upload import as_device_array, upload_structs
from lumisplat.runtime.buffers import Buffers
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light
from lumisplat.scene.scene import Scene


class LightScene:
    """Device tables of what light meets, and of the lights.

    Args:
        launcher: Whose device it is.
        buffers: Holds the tables.
        config: Settings.
    """

    def __init__(self, launcher: Launcher, buffers: Buffers, config: RenderConfig) -> None:
        self._launcher, self._buffers, self._config = launcher, buffers, config
        self._lights = LightTable()
        self._version = -1
        self._row = ShadingScene()
        self._table: Any = None
        self.data: Any = None
        """What kernels take: a 1-element ShadeScene array."""
        self.lights: tuple[Light, ...] = ()
        """Those that are on; none where a headlight stands in for them."""
        self.has_headlight = False
        """Whether there is one because there are no lights at all."""
        self.has_shadow_only = False
        """Whether some set is only darkened."""

    @property
    def light_names(self) -> tuple[str, ...]:
        """Of the lights that are on, in order."""
        return self._lights.names

    def sync(self, scene: Scene, device_scene: DeviceScene, camera: Camera, *, for_camera: bool) -> None:
        """Writes the tables.

        Args:
            scene: What ``device_scene`` was synchronised with last.
            device_scene: Its assets on the device.
            camera: From where it is seen.
            for_camera: Rays are those of its pixels; others see nothing behind what they meet.
        """
        self._lights.sync(scene, camera, self._buffers)
        self.lights = tuple(light for light in scene.lights if light.enabled)
        self.has_headlight = not scene.lights
        if self._version != device_scene.version:
            self._row.attributes = upload_structs(
                attribute_rows(device_scene, self._launcher.device), SplatAttributes, self._launcher.device
            )
            self._version = device_scene.version
        table = self._buffers.get
        materials = material_table(scene, device_scene.texture_first, table_dtype(MaterialData))
        self._row.materials = table("shade.materials", MaterialData, len(materials))
        placements = placement_table(scene, device_scene)
        self._row.splats = table("shade.splats", SplatPlacement, len(placements))
        self._row.settings = table("shade.settings", ShadingSettings, 1)
        self.has_shadow_only = any(instance.shadow_only for instance in scene.splats)
        self._table = self._settings(for_camera)
        for array, rows in (
            (self._row.materials, materials),
            (self._row.splats, placements),
            (self._row.settings, self._table),
        ):
            if len(rows):
                array.assign(rows)
        self._row.mesh_instances = device_scene.mesh_instances
        self._row.placements = device_scene.placements
        self._row.meshes = device_scene.mesh_data
        self._row.lights = self._lights.lights
        self._row.environment = self._lights.environment
        self.data = upload_structs([self._row], ShadingScene, self._launcher.device)

    def begin_sample(self, sample: int) -> None:
        """Before a sample is shaded."""
        self._table[:1]["sample"] = sample
        self._row.settings.assign(self._table)

    def _settings(self, for_camera: bool) -> np.ndarray:
        config = self._config
        row = table = np.zeros(1, dtype=table_dtype(ShadingSettings))
        row["background"] = config.background or (0.0, 0.0, 0.0)
        row["camera_sees"] = SEES_BACKGROUND
        if not for_camera or config.background is None:
            row["camera_sees"] = SEES_NOTHING
        elif self._lights.environment.exists and self._lights.environment.visible:
            row["camera_sees"] = SEES_ENVIRONMENT
        row["darkens"] = self.has_shadow_only
        row["light_count"] = self._lights.count
        row["soft"] = config.shadows is Shadows.SOFT
        row["shadow_offset"] = config.shadow.offset
        row["shadow_offset_absolute"] = config.shadow.offset_absolute
        return table


def attribute_rows(device_scene: DeviceScene, device: str) -> list[SplatAttributes]:
    """What the Gaussians of each asset carry for light."""
    rows = []
    for asset in device_scene.assets:
        row = SplatAttributes()
        row.scales = asset.data.scales
        for name in ("roughness", "metallic"):
            values = getattr(asset.gaussians, name)
            if values is not None:
                setattr(row, name, as_device_array(values, wp.float32, device))
        rows.append(row)
    return rows or [SplatAttributes()]  # an array without elements has no address


def placement_table(scene: Scene, device_scene: DeviceScene) -> np.ndarray:
    """One row a splat instance."""
    place_of = {id(asset.gaussians): place for place, asset in enumerate(device_scene.assets)}
    table = np.zeros(len(scene.splats), dtype=table_dtype(SplatPlacement))
    table["first"] = np.cumsum([0, *(instance.gaussians.count for instance in scene.splats[:-1])])[: len(table)]
    table["asset"] = [place_of[id(instance.gaussians)] for instance in scene.splats]
    table["scale"] = [instance.scale for instance in scene.splats]
    return table
