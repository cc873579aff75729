"""Radiance of rays without direct light, and the interactions with surfaces that direct light reads."""

from __future__ import annotations

import warp as wp

from lumisplat.constants import SHADE_BANDS_PER_THREAD
from lumisplat.device.structs.shading import Interactions, RayRadiance, WaveData
from lumisplat.renderer.light import surface_kernels as kernels
from lumisplat.renderer.scene.device_scene import DeviceScene
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.renderer.trace.ray_wave import CarriedState, RayWave
from lumisplat.runtime.buffers import Buffers, DeviceArray
from lumisplat.runtime.launcher import KernelModule, Launcher

SHADOW_RAY_FIELDS = ("spawn_point", "spawn_t_min", "geometric_normal", "smooth_height")
"""Fields of `Interactions` that only shadow rays need; frames without shadow rays leave the arrays empty."""

ROUGH_GLASS_FIELDS = {"transmitted", "thin_walled", "metallic", "metal"}
"""Fields of `Interactions` that only rough glass needs; frames without rough glass leave the arrays empty."""

LAYER_FIELDS = {"rescattered", "coat", "coat_alpha", "sheen", "sheen_alpha", "sheen_curve"}
"""Fields of `Interactions` that only clearcoat, sheen and multiple scattering need; the arrays of other frames are
empty.
"""

RECEIVED_FIELDS = frozenset(
    {
        "captured_all",
        "captured_part",
        "received",
        "unshadowed",
        "shadowed",
        "emitted_unshadowed",
        "emitted_shadowed",
        "ambient",
        "open",
    }
)
"""Fields of `RayRadiance` that hold the light on shadow catchers, which path tracing estimates."""


class Surfaces:
    """Evaluates the surfaces that rays hit, and returns the rays with their radiance as a wave (rays of one bounce)."""

    def __init__(self, launcher: Launcher, buffers: Buffers) -> None:
        self._launcher, self._buffers = launcher, buffers
        self._unentered: DeviceArray
        """Flag for each mesh instance: 1 if a ray left the mesh without having entered it. Set only in scenes with
        media."""

    @staticmethod
    def modules() -> list[KernelModule]:
        """Returns the modules of the kernels that this class launches."""
        return [kernels]

    def shade(
        self,
        scene: DeviceScene,
        plan: FramePlan,
        hits: PrimaryHits,
        number: int,
        *,
        carried: CarriedState | None = None,
        may_branch: bool,
        on_paths: bool = True,
        table: str | None = None,
    ) -> RayWave:
        """Returns a wave: rays with their radiance, still without direct light, reflection and refraction.

        Args:
            scene: The device scene.
            plan: The plan of the frame.
            hits: The rays and their hits.
            number: Number of reflections and refractions that the rays have behind them.
            carried: State that the rays inherit from earlier ones; None for camera rays.
            may_branch: Whether smooth meshes may reflect and refract rays.
            on_paths: In path-traced frames, whether the rays belong to paths.
            table: Name of the buffer with the struct that kernels read; None: ``wave.`` followed by ``number``. Two
                waves with the same number need different names if both exist at once.
        """
        with self._launcher.stage("shade"):
            if plan.has_media and number == 0:
                self._unentered = self._buffers.get("wave.unentered", wp.int32, scene.mesh_instances.shape[0])
                self._unentered.zero_()
            row = self._row(plan, hits, number, carried or CarriedState(), may_branch=may_branch, on_paths=on_paths)
            row.interactions = self._interactions(plan, hits.count)
            wave = RayWave(number, hits, row, self._buffers.table(table or f"wave.{number}", WaveData, [row]))
            self._launcher.run_banded(
                kernels.shade_surfaces,
                wave.count,
                *(scene.shading, wave.data),
                bands=SHADE_BANDS_PER_THREAD * self._launcher.threads,
            )
        return wave

    def unshaded(self, plan: FramePlan, hits: PrimaryHits, number: int, table: str) -> RayWave:
        """Returns a wave of paths without interactions, whose radiance another kernel writes; arguments as above."""
        row = self._row(plan, hits, number, CarriedState(), may_branch=False, on_paths=True)
        return RayWave(number, hits, row, self._buffers.table(table, WaveData, [row]))

    def _row(
        self,
        plan: FramePlan,
        hits: PrimaryHits,
        number: int,
        carried: CarriedState,
        *,
        may_branch: bool,
        on_paths: bool,
    ) -> WaveData:
        count, get = hits.count, self._buffers.get
        row = WaveData()
        row.from_camera, row.may_branch = int(number == 0), int(may_branch)
        row.traces_paths = int(plan.traces_paths and on_paths)
        row.rays, row.meshes, row.gaussians = hits.rays, hits.meshes, hits.gaussians
        row.radiance = self._radiance(plan, count, number)
        row.path_weights = path_weights = get(f"wave.path_weights{number % 2}", wp.float32, count)
        if carried.weights is None:
            path_weights.fill_(1.0)
        else:
            row.weights = carried.weights
        if plan.has_media and number == 0:
            row.unentered = self._unentered
        if carried.media is not None:
            row.media = carried.media
        if carried.sees_environment is not None:
            row.sees_environment = carried.sees_environment
        row.spawns_lobes = int(plan.has_lobes and may_branch and number == 0)
        slots = (3 if plan.has_lobes else 2) * count
        row.branches = get(f"wave.{number}.branches", wp.int32, slots)
        row.branch_ends = get(f"wave.{number}.branch_ends", wp.int32, slots)
        return row

    def _interactions(self, plan: FramePlan, count: int) -> Interactions:
        if not plan.is_lit:
            return Interactions()
        without: set[str] = set() if plan.spawns_shadow_rays else set(SHADOW_RAY_FIELDS)
        if not plan.has_rough_glass:
            without |= ROUGH_GLASS_FIELDS
        if not plan.has_coatings:
            without |= LAYER_FIELDS
        return self._buffers.struct("interactions", Interactions, 2 * count, without)

    def _radiance(self, plan: FramePlan, count: int, number: int) -> RayRadiance:
        """Returns the radiance arrays that the frame needs; only camera rays (``number`` 0) have arrays for layers."""
        without: set[str] = set() if plan.has_shadow_catchers else {"capture_factor"}
        if number > 0 or not plan.has_receivers:
            without |= RECEIVED_FIELDS
        if number > 0 or "reflection" not in plan.aovs:
            without |= {"reflection"}
        if number > 0 or not {"albedo", "emission"} & plan.aovs:
            without |= {"albedo", "emission"}
        return self._buffers.struct(f"wave.{number}.radiance", RayRadiance, count, without)
