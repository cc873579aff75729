"""Tables that shading kernels read: materials, attributes of Gaussians, lights and settings."""

from __future__ import annotations

from typing import Any

import numpy as np

from lumisplat.config import RenderConfig, Shadows
from lumisplat.device.structs.shading import (
    SEES_BACKGROUND,
    SEES_ENVIRONMENT,
    SEES_NOTHING,
    MaterialData,
    ShadingScene,
    ShadingSettings,
    SplatAttributes,
)
from lumisplat.renderer.scene.assets import SplatAsset
from lumisplat.renderer.scene.frame_plan import FramePlan, environment_draws
from lumisplat.renderer.scene.lights import Emitters, LightTable
from lumisplat.renderer.scene.materials import TextureFirst, material_table
from lumisplat.runtime.buffers import Buffers, DeviceArray, rows_of
from lumisplat.runtime.struct_tables import table_dtype, upload_structs
from lumisplat.scene.camera import Camera
from lumisplat.scene.lights import Light, LightEnvironment
from lumisplat.scene.scene import Scene


class ShadingTables:
    """Device tables for shading: materials, attributes of Gaussians, lights and settings.

    Args:
        buffers: Holds the tables.
        config: Settings.
        device: Warp device name.
    """

    def __init__(self, buffers: Buffers, config: RenderConfig, device: str) -> None:
        self._buffers, self._config, self._device = buffers, config, device
        self._table = LightTable()
        self._emitters = Emitters()
        self._attributes: DeviceArray
        self._version: int | None = None
        self.data: Any = None
        """Shading data as a ShadingScene table with one row, for kernels; written by ``sync``."""
        self.lights: tuple[Light, ...] = ()
        """Enabled lights of the scene, without the headlight."""
        self.has_headlight = False
        """True if a headlight replaces missing lights."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the enabled lights, in the scene's order."""
        return self._table.names

    @property
    def has_emitters(self) -> bool:
        """True if emissive triangles are sampled as lights, which only path-traced frames do."""
        return len(self._emitters.data.ends) > 0

    @property
    def choice_count(self) -> int:
        """Number of lights that paths and real-time frames choose from; all emissive triangles together count once."""
        return self._table.count + self.has_emitters

    @property
    def graph_key(self) -> object:
        """Values of the lights that determine a frame's launches; a CUDA graph recorded with other values is stale."""
        return self.has_headlight, [(isinstance(light, LightEnvironment), light.casts_shadow) for light in self.lights]

    def sync(
        self,
        scene: Scene,
        camera: Camera,
        plan: FramePlan,
        *,
        row: ShadingScene,
        assets: list[SplatAsset],
        texture_first: TextureFirst,
        version: int,
    ) -> None:
        """Writes the tables.

        Args:
            scene: The scene with materials and lights.
            camera: The camera of the frame.
            plan: The plan of the frame.
            row: Struct with the camera's sample, the instances and the meshes; this method fills in the other fields.
            assets: The distinct Gaussian sets.
            texture_first: Returns the index of a texture's first texel among those of all meshes.
            version: Counter that changes when the device arrays of assets are replaced.
        """
        self._table.sync(scene, camera, self._buffers, is_lit=plan.is_lit, has_headlight=plan.has_headlight)
        self.lights = tuple(light for light in scene.lights if light.enabled) if plan.is_lit else ()
        self.has_headlight = plan.has_headlight
        if version != self._version:
            rows = [asset.attributes for asset in assets]
            self._attributes = upload_structs(rows, SplatAttributes, self._device)
            self._version = version
        row.attributes = self._attributes
        materials = material_table(
            scene,
            texture_first,
            is_lit=plan.is_lit,
            compensates=self._config.energy_compensation,
            is_sequence=self._config.pipeline.is_sequence,
        )
        row.materials = self._buffers.upload("shading.materials", MaterialData, materials)
        row.settings = self._buffers.upload("shading.settings", ShadingSettings, self._settings(scene, plan))
        row.lights = self._table.lights
        row.environment = self._table.environment
        if plan.traces_paths:
            self._emitters.sync(scene, self._buffers)
        row.emitters = self._emitters.data
        self.data = self._buffers.upload("shading", ShadingScene, rows_of([row]))

    def _settings(self, scene: Scene, plan: FramePlan) -> np.ndarray:
        config = self._config
        row = table = np.zeros(1, dtype=table_dtype(ShadingSettings))
        row["is_lit"] = plan.is_lit
        row["background"] = config.background or (0.0, 0.0, 0.0)
        row["camera_sees"] = SEES_BACKGROUND
        if not plan.for_camera or config.background is None:
            row["camera_sees"] = SEES_NOTHING
        elif self._table.environment.exists and self._table.environment.visible:
            row["camera_sees"] = SEES_ENVIRONMENT
        row["light_count"] = self._table.count
        row["absorbs"] = plan.absorbs
        row["soft"] = config.shadows is Shadows.SOFT or plan.traces_paths
        row["more_draws"] = environment_draws(plan, scene) - 1
        row["changes_shadows"] = config.shadow_rays.changes_shadows
        row["shadow_offset"] = config.shadow_rays.offset
        row["capture_gain"] = 2.0**config.capture_gain
        row["shadow_offset_absolute"] = config.shadow_rays.offset_absolute
        return table
