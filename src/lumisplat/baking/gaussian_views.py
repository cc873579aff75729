"""Host pass: single Gaussians as they are seen from given directions, lit (docs/method/relighting.md#baking)."""

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
"""Within how much of a Gaussian it is seen, standard deviations of its own. Frames blur once more what they blend of
neighbours: at 1, edges are blurred twice, and Gaussians see around corners (1.1 dB in a room); at 0, the edge of a
shadow is jagged."""


@dataclass(frozen=True, slots=True)
class CatcherLight:
    """Irradiance of shadow catchers, arrays of one shape; `catcher_change` of the device is the same in one channel."""

    sent: Doubles
    """Irradiance by the scene's lights, without anything that was added."""
    change: Doubles
    """Its change by all that was added, bounced light included."""
    own_sent: Doubles
    """Irradiance by the captures around the surface, without anything that was added, as far as it was found."""
    own_change: Doubles
    """Its change by all that was added; what added surfaces emit counts here."""
    ambient: Doubles
    """Given irradiance besides that of lights; 0: what was found of the captures is all there is."""
    blocked: Doubles
    """The part of ``ambient`` that something added blocks."""
    least: Doubles
    """Lower bound of the irradiance: no surface reflects more than it receives."""

    def change_and_received(self) -> tuple[Doubles, Doubles]:
        """Returns the change of the irradiance by all that was added, and the irradiance before."""
        given, rest = self.ambient > 0.0, self.least - self.sent
        ambient = np.maximum(np.where(given, self.ambient, self.own_sent), rest)
        own_share = np.divide(ambient, self.own_sent, out=np.ones_like(rest), where=given & (self.own_sent > ambient))
        blocked = np.divide(self.blocked, self.ambient, out=np.zeros_like(rest), where=given)
        unseen = np.where(given, np.maximum(ambient - self.own_sent, 0.0), 0.0)
        return self.change + own_share * self.own_change - unseen * blocked, self.sent + ambient


@dataclass(frozen=True, slots=True, eq=False)
class ViewRadiance:
    """Holds what V views show, as means over the samples."""

    even: Doubles
    """Linear light that does not come from captured colours, by every other sample, (V, 3)."""
    odd: Doubles
    """Linear light by the other samples, (V, 3)."""
    captured: Doubles
    """Display-referred captured colour that is kept, (V, 3)."""
    captured_weight: Doubles
    """1 where there is one, else 0, (V,)."""
    change: Doubles
    """Change of the irradiance of a shadow catcher by all that was added, (V, 3)."""
    received: Doubles
    """Irradiance of the catcher as it was captured, (V, 3); 0 elsewhere."""
    distance: Doubles
    """To what hides the Gaussian from eyes that are farther away, scene units, (V,)."""
    nonfinite: int
    """Samples that were left out."""


class GaussianViewer(Renderer):
    """Shows single Gaussians of a scene, each alone, as rays that meet it see it.

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
        """Uploads the scene; eyes are at most ``far`` scene units away from what they see."""
        plan = self._sync_rays(scene)
        # Rays of queries do not find what shadow catchers receive; views do.
        receives = FramePlan.of(self.config, scene).has_receivers
        self._plan, self._far = replace(plan, has_receivers=receives), far
        self._load([*self._modules(self._plan, bounced=True), kernels], progress)

    @property
    def launcher(self) -> Launcher:
        """Launches on the views' device."""
        return self._launcher

    @property
    def is_lit(self) -> bool:
        """Whether anything in the scene gives light."""
        return self._plan.is_lit

    def render_views(
        self, first: int, gaussian: npt.NDArray[np.integer], direction: FloatArray, samples: int
    ) -> ViewRadiance:
        """Renders views of single Gaussians; returns what they show.

        Args:
            first: Number of the first view, by which random numbers are chosen.
            gaussian: Among all of the scene's, shape (V,).
            direction: From the eye to the Gaussian, world space, unit, shape (V, 3).
            samples: A view, at least 2.
        """
        scene, buffers, run = self._scene, self._buffers, self._launcher.run_banded
        count = len(gaussian)
        room = whole_packets(grown_capacity(count))
        views = buffers.struct("bake.views", kernels.GaussianViews, room)
        device_array(views.gaussian)[:count].assign(gaussian.astype(np.int32))
        device_array(views.direction)[:count].assign(direction)
        rays, outward = (buffers.struct(f"bake.{name}", RayData, room) for name in ("rays", "outward"))
        meshes = buffers.struct("bake.meshes", MeshHits, room)
        gaussian_hits = buffers.struct("bake.hits", GaussianHits, room, EXTRA_FIELDS)
        sums = buffers.struct("bake.sums", kernels.ViewSums, room)
        hits = PrimaryHits(rays, meshes, gaussian_hits)
        degree = self.config.trace.sh_degree
        for sample in range(samples):
            scene.begin_sample(sample)
            run(
                kernels.hit_gaussians,
                room,
                *(first, count, degree, VIEW_SPREAD, scene.shading, scene.gaussians, views),
                *(rays, meshes, gaussian_hits, outward),
            )
            hidden = self._tracer.find_hits(scene, outward, "bake.hidden", bounced=True)
            wave = self._integrators.of(self._plan).shade(scene, self._plan, hits, sample)
            run(kernels.add_views, room, sample, self._far, wave.data, hidden.meshes, hidden.gaussians, sums)
        return self._means(sums, count, samples)

    def _means(self, sums: kernels.ViewSums, count: int, samples: int) -> ViewRadiance:
        """The means of sums over samples."""

        def read(array: Any) -> Doubles:
            return device_array(array).numpy()[:count].astype(np.float64)

        finite = read(sums.count)
        halves = (samples + 1) // 2, samples // 2
        # Samples that are not finite are few, and not told apart: both halves are scaled for them alike.
        scale = (samples / np.maximum(finite, 1.0))[:, None]
        captured, weight = read(sums.captured), read(sums.captured_weight)
        change: Doubles = np.zeros_like(captured)
        received: Doubles = change
        if self._plan.has_receivers:
            names = ("sent", "arrived", "own_sent", "own_arrived", "ambient", "open")
            light_sums = {name: read(getattr(sums, name)) * (scale / samples) for name in names}
            light = CatcherLight(
                sent=light_sums["sent"],
                change=light_sums["arrived"] - light_sums["sent"],
                own_sent=light_sums["own_sent"],
                own_change=light_sums["own_arrived"] - light_sums["own_sent"],
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
