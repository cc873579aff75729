"""Renders single lit Gaussians, viewed from given directions, on the device (docs/method/relighting.md#baking)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from lumisplat.baking import gaussian_views_kernels as kernels
from lumisplat.config import RenderConfig
from lumisplat.device.structs.rays import EXTRA_FIELDS, GaussianHits, MeshHits, RayData
from lumisplat.math.arrays import Doubles, FloatArray
from lumisplat.math.color import decode_srgb
from lumisplat.progress import Progress
from lumisplat.renderer.rays import whole_packets
from lumisplat.renderer.renderer import Renderer
from lumisplat.renderer.scene.frame_plan import FramePlan
from lumisplat.renderer.trace.primary_hits import PrimaryHits
from lumisplat.runtime.buffers import device_array, grown_capacity
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.scene import Scene

VIEW_SPREAD = 0.5
"""Standard deviation of the points of a Gaussian at which its views are shaded, relative to that of the Gaussian. At
1, blending blurs edges a second time and Gaussians receive light around corners (1.1 dB less PSNR in a room). At 0,
shadow edges are jagged.
"""


@dataclass(frozen=True, slots=True)
class CatcherLight:
    """Irradiance of shadow catchers with and without the objects added to the scene; all arrays have the same shape.

    On the device, `catcher_change` evaluates the same equations for one channel.
    """

    unshadowed: Doubles
    """Irradiance of the shadow catcher from the scene's lights, as if no objects had been added to the scene."""
    change: Doubles
    """Change of the irradiance from the scene's lights, ``unshadowed``, by the objects added to the scene; includes
    indirect light."""
    emitted_unshadowed: Doubles
    """Irradiance of the shadow catcher from the captures that sampled rays hit, as if no objects had been added to the
    scene."""
    emitted_change: Doubles
    """Change of the irradiance from captures, ``emitted_unshadowed``, by the objects added to the scene; includes the
    light that these objects emit."""
    ambient: Doubles
    """Ambient irradiance of the shadow catcher that the scene specifies; 0 if it specifies none, so that the light of
    captures, ``emitted_unshadowed``, takes its place."""
    blocked: Doubles
    """Part of the ambient irradiance, ``ambient``, that the objects added to the scene block."""
    least: Doubles
    """Lower bound of the total irradiance: pi times the linear captured colour, because no surface reflects more than
    it receives."""

    def change_and_received(self) -> tuple[Doubles, Doubles]:
        """Returns a shadow catcher's change of irradiance by the added objects, and its irradiance without them."""
        has_ambient, remainder = self.ambient > 0.0, self.least - self.unshadowed
        ambient = np.maximum(np.where(has_ambient, self.ambient, self.emitted_unshadowed), remainder)
        emitted_share = np.divide(
            ambient,
            self.emitted_unshadowed,
            out=np.ones_like(remainder),
            where=has_ambient & (self.emitted_unshadowed > ambient),
        )
        blocked = np.divide(self.blocked, self.ambient, out=np.zeros_like(remainder), where=has_ambient)
        undetected = np.where(has_ambient, np.maximum(ambient - self.emitted_unshadowed, 0.0), 0.0)
        return self.change + emitted_share * self.emitted_change - undetected * blocked, self.unshadowed + ambient


@dataclass(frozen=True, slots=True, eq=False)
class ViewRadiance:
    """Radiance of V views, each of a single Gaussian from one direction; means over the samples of a view."""

    even: Doubles
    """Linear radiance of V views, means over their even samples, without captured colours, shape (V, 3)."""
    odd: Doubles
    """Linear radiance of V views, means over their odd samples, without captured colours, shape (V, 3)."""
    captured: Doubles
    """Display-referred captured colour of the Gaussian of each of V views if it is unlit, else 0, shape (V, 3)."""
    captured_weight: Doubles
    """1 for those of V views whose Gaussian is unlit and shows its captured colour, else 0, shape (V,)."""
    change: Doubles
    """Change of a shadow catcher's irradiance by the objects added to the scene, in each of V views, shape (V, 3)."""
    received: Doubles
    """Irradiance of a shadow catcher without the objects added to the scene, in each of V views, shape (V, 3); 0 for
    other Gaussians."""
    distance: Doubles
    """Distance from the Gaussian to the first occluder towards the camera, in each of V views, scene units, shape
    (V,)."""
    nonfinite: int
    """Number of samples that were dropped because they were not finite."""


class GaussianViewer(Renderer):
    """Renders single Gaussians of a scene, each as if a camera ray had hit no other Gaussian.

    Args:
        config: Settings, with ``Pipeline.PATH`` or ``Pipeline.TRACE``.
        launcher: The device to run on.
        progress: As for ``create_renderer``.
    """

    def __init__(self, config: RenderConfig, launcher: Launcher, progress: Progress | None = None) -> None:
        super().__init__(config, launcher, progress)
        self._plan: FramePlan
        self._far = 0.0

    def upload(self, scene: Scene, far: float, progress: Progress | None = None) -> None:
        """Uploads the scene; ``far`` is the largest distance of a camera from a Gaussian, scene units."""
        plan = self._sync_rays(scene)
        # Ray queries skip the irradiance of shadow catchers; views need it.
        receives = FramePlan.of(self.config, scene).has_receivers
        self._plan, self._far = replace(plan, has_receivers=receives), far
        self._load([*self._modules(self._plan, bounced=True), kernels], progress)

    @property
    def launcher(self) -> Launcher:
        """Launcher of the device that renders the views."""
        return self._launcher

    @property
    def is_lit(self) -> bool:
        """True if the scene has any source of light."""
        return self._plan.is_lit

    def render_views(
        self, first: int, gaussian: npt.NDArray[np.integer], direction: FloatArray, samples: int
    ) -> ViewRadiance:
        """Renders V views of single Gaussians.

        Args:
            first: Number of the first view, which seeds the random numbers.
            gaussian: Index of each view's Gaussian among all Gaussians of the scene, shape (V,).
            direction: Unit directions from the camera to the Gaussian, world space, shape (V, 3).
            samples: Samples per view, at least 2.
        """
        scene, buffers, run = self._scene, self._buffers, self._launcher.run_banded
        count = len(gaussian)
        capacity = whole_packets(grown_capacity(count))
        views = buffers.struct("bake.views", kernels.GaussianViews, capacity)
        device_array(views.gaussian)[:count].assign(gaussian.astype(np.int32))
        device_array(views.direction)[:count].assign(direction)
        rays, outward = (buffers.struct(f"bake.{name}", RayData, capacity) for name in ("rays", "outward"))
        meshes = buffers.struct("bake.meshes", MeshHits, capacity)
        gaussian_hits = buffers.struct("bake.hits", GaussianHits, capacity, EXTRA_FIELDS)
        sums = buffers.struct("bake.sums", kernels.ViewSums, capacity)
        hits = PrimaryHits(rays, meshes, gaussian_hits)
        degree = self.config.trace.sh_degree
        for sample in range(samples):
            scene.begin_sample(sample)
            run(
                kernels.hit_gaussians,
                capacity,
                *(first, count, degree, VIEW_SPREAD, scene.shading, scene.gaussians, views),
                *(rays, meshes, gaussian_hits, outward),
            )
            hidden = self._tracer.find_hits(scene, outward, "bake.hidden", bounced=True)
            wave = self._integrators.radiance(scene, self._plan, sample, lambda: hits, ("views", capacity))
            run(kernels.add_views, capacity, sample, self._far, wave.data, hidden.meshes, hidden.gaussians, sums)
        return self._means(sums, count, samples)

    def _means(self, sums: kernels.ViewSums, count: int, samples: int) -> ViewRadiance:
        """Downloads the sums of ``count`` views, and divides them by the number of finite samples of each view."""

        def read(array: Any) -> Doubles:
            return device_array(array).numpy()[:count].astype(np.float64)

        finite = read(sums.count)
        halves = (samples + 1) // 2, samples // 2
        # Dropped samples are few and are not counted per half, so both halves are scaled alike.
        scale = (samples / np.maximum(finite, 1.0))[:, None]
        captured, weight = read(sums.captured), read(sums.captured_weight)
        change: Doubles = np.zeros_like(captured)
        received: Doubles = change
        if self._plan.has_receivers:
            names = ("unshadowed", "shadowed", "emitted_unshadowed", "emitted_shadowed", "ambient", "open")
            light_sums = {name: read(getattr(sums, name)) * (scale / samples) for name in names}
            light = CatcherLight(
                unshadowed=light_sums["unshadowed"],
                change=light_sums["shadowed"] - light_sums["unshadowed"],
                emitted_unshadowed=light_sums["emitted_unshadowed"],
                emitted_change=light_sums["emitted_shadowed"] - light_sums["emitted_unshadowed"],
                ambient=light_sums["ambient"],
                blocked=light_sums["ambient"] - light_sums["open"],
                least=np.pi * decode_srgb(captured).astype(np.float64),
            )
            change, received = light.change_and_received()
        elif self._plan.has_shadow_catchers:
            change = read(sums.factor) * scale / samples - 1.0  # exactly 0 where nothing is shadowed
            received = np.broadcast_to(weight[:, None], captured.shape)
        return ViewRadiance(
            even=read(sums.even) * (scale / halves[0]),
            odd=read(sums.odd) * (scale / halves[1]),
            captured=captured,
            captured_weight=weight,
            change=change,
            received=received,
            distance=read(sums.distance) / samples,
            nonfinite=samples * count - int(finite.sum(dtype=np.float64)),
        )
