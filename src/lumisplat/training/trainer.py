"""Optimises Gaussians one iteration at a time: loads an image, renders its view, differentiates, and updates."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
import numpy.typing as npt
import warp as wp

from lumisplat.config import (
    Antialiasing,
    Densification,
    Projection,
    RasterConfig,
    RenderConfig,
    TraceConfig,
    TrainConfig,
)
from lumisplat.config.checks import Color
from lumisplat.constants import ADAM_BETA_1, ADAM_BETA_2
from lumisplat.device.structs.camera import PixelData
from lumisplat.device.structs.gradients import GaussianGradient, PixelGradient
from lumisplat.device.training import SplatRecord, StepRates, TargetImage
from lumisplat.errors import LumisplatError
from lumisplat.math.arrays import FloatArray
from lumisplat.progress import Progress
from lumisplat.renderer.gradients.features import FeatureChannels
from lumisplat.runtime.buffers import Buffers, DeviceArray, device_array
from lumisplat.runtime.downloads import HostHistory
from lumisplat.runtime.launcher import Launcher
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians
from lumisplat.training import (
    exposure_kernels,
    loss_kernels,
    optimizer_kernels,
    surface_kernels,
    weight_kernels,
)
from lumisplat.training.backends import TrainingRaster, TrainingRays, TrainingUnscented
from lumisplat.training.densify import DensifyStats, densified
from lumisplat.training.exposure_and_pose import ExposedFrame, Exposures, Poses
from lumisplat.training.losses import ROW_SUMS, DeviceImage, ImageLoss, Loss, SurfaceLoss
from lumisplat.training.parameters import (
    DeviceParameters,
    SceneScale,
    TrainedParameters,
    first_gaussians,
    random_points,
)
from lumisplat.training.run_folder import RECORD, Checkpoint
from lumisplat.training.views import TargetPixels, TrainingView

SURFACES_AFTER = 0.23
"""Fraction of the iterations after which normal and depth terms join the loss: 7,000 of 30,000 in the code of Huang et
al. 2024."""

POSES_AFTER = 0.1
"""Fraction of the iterations after which poses are refined; before that, the geometry is too coarse."""

DENSIFY_AFTER = 500
"""Iterations before the first densification; trainings below 30,000 iterations start after a sixtieth of theirs."""

DENSIFY_EVERY = 100
"""Iterations between two densifications."""

DENSIFY_UNTIL = {"mcmc": 0.83, "adaptive": 0.5}
"""Fraction of the iterations after which densification stops: gsplat's 25,000 (MCMC) and 15,000 (adaptive) of 30,000.
"""

SH_REST_SHARE = 0.05
"""Learning rate of the SH coefficients above degree 0, as a fraction of the rate of degree 0. Kerbl et al. 2023."""

NOISE_STRENGTH = 5e5
"""Factor between the learning rate of the means and the strength of the MCMC position noise. gsplat's value."""

HISTORY = 100
"""Largest number of iterations that are launched before the host waits for one and reads its loss."""

IMAGES_SHARE = 0.25
"""Fraction of a GPU's free memory up to which it keeps the training images."""

PIXEL_BYTES = 20
"""Bytes of a pixel of a training image on the device: three floats of colour, weight and alpha."""


class DivergedError(LumisplatError, RuntimeError):
    """Training stopped because the loss or a parameter is not finite, or because no Gaussian is left."""


@dataclass(frozen=True, slots=True)
class _Pending:
    """A launched iteration, and what its loss is computed from besides its rows."""

    iteration: int
    size: tuple[int, int]
    """Width and height of the image in pixels."""
    weight_sum: float
    """Sum of the image's pixel weights."""


class Trainer:
    """Optimises Gaussians against training images.

    All random numbers are functions of the seed and the iteration. Two trainers with the same images, settings and
    state therefore make updates that are equal to the bit, on any number of threads.

    Args:
        views: Training views, at least one.
        config: Training settings.
        background: Display-referred sRGB behind the Gaussians.
        points: Initial means in world space, shape (N, 3); None for random points.
        colors: Display-referred sRGB of ``points``, 0..1, shape (N, 3); None for random colours.
        device: As in `lumisplat.create_renderer`.
        threads: As in `lumisplat.create_renderer`.
        progress: As in `lumisplat.create_renderer`.
    """

    def __init__(
        self,
        views: Sequence[TrainingView],
        config: TrainConfig,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        points: npt.NDArray[np.floating] | None = None,
        colors: FloatArray | None = None,
        device: str = "auto",
        threads: int | None = None,
        progress: Progress | None = None,
    ) -> None:
        self._views, self.config = views, config
        self.scene_scale = SceneScale.of([view.camera for view in views])
        self._launcher = Launcher(device, threads)
        self._buffers = Buffers(self._launcher.device)
        settings = frame_settings(config, background)
        self._backend = backend_type(config)(self._launcher, self._buffers, settings)
        kernels = [optimizer_kernels, loss_kernels, weight_kernels, *([exposure_kernels] if config.exposures else [])]
        if config.makes_flat:
            kernels += [surface_kernels, *FeatureChannels.modules()]
        self._launcher.load([*self._backend.modules(), *kernels], progress)
        of_alpha = {"alpha": config.alpha, "entropy": config.mask_entropy}
        self._loss = ImageLoss(self._launcher, self._buffers, ssim=config.ssim, **of_alpha)
        self._surfaces = self._surface_loss()
        self._device_splats = DeviceParameters(self._buffers)
        self.exposures = Exposures.neutral(len(views)) if config.exposures else None
        """Exposures in the order of the views; None if they are not optimised."""
        self.poses = (
            Poses.of([view.camera for view in views], self.scene_scale.distance) if config.refine_poses else None
        )
        """Camera poses in the order of the views; None if they are not refined."""
        self._exposed = ExposedFrame(self._launcher, self._buffers) if config.exposures else None
        self._background = background
        self._images = Buffers(self._launcher.device)
        """Owner of the arrays of images that stay on the device, whose addresses no recorded graph contains."""
        self._kept: dict[int, tuple[int, DeviceImage]] | None = {} if self._can_keep_images else None
        """Images on the device by the number of their view, with the number of halvings; None: uploaded each time."""
        self._waits = not self._launcher.is_cuda or bool(self._corrections)
        """True if each iteration is waited for: the CPU has finished anyway, and corrections need its gradients."""
        rows = ROW_SUMS * max(view.camera.height for view in views)
        self._history = HostHistory(self._launcher.device, HISTORY, rows)
        """Rows of the losses of the latest iterations."""
        self._pending: deque[_Pending] = deque()
        """Launched iterations whose losses have not been read."""
        self._losses: list[tuple[int, Loss]] = []
        self.iteration = 0
        """Number of iterations completed."""
        rng = np.random.default_rng([config.seed, 0])
        if points is None:
            cameras = [view.camera for view in views]
            points = random_points(cameras, self.scene_scale, min(config.initial, config.cap), rng)
        elif len(points) > config.cap:
            chosen = np.sort(rng.choice(len(points), config.cap, replace=False))
            points, colors = points[chosen], None if colors is None else colors[chosen]
        self._upload(first_gaussians(points, colors, config, rng))

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self._count

    def gaussians(self) -> Gaussians:
        """Returns the current Gaussians as a capture, in the coordinates of the views."""
        return self._parameters().gaussians(self.config)

    def largest_weights(self) -> FloatArray:
        """Returns the largest blending weight of each of N Gaussians over all pixels of all views, 0..1, shape (N,)."""
        self._settle()
        largest = self._buffers.get("weights.largest", wp.float32, self.count)
        largest.zero_()
        for number, view in enumerate(self._views):
            camera = view.camera if self.poses is None else self.poses.posed(number, view.camera)
            self._backend.draw(camera, self.config.sh_degree, self._background)
            self._backend.add_largest_weights(largest)
        return np.array(largest.numpy(), np.float32)

    @property
    def checkpoint(self) -> Checkpoint:
        """Returns the state of the training: parameters, Adam moments, statistics, exposures, poses and iteration."""
        self._settle()
        record = {name: np.array(device_array(getattr(self._record, name)).numpy()) for name in RECORD}
        per_image = {name: values for correction in self._corrections for name, values in correction.state.items()}
        return Checkpoint(self.iteration, self._parameters(), record, per_image)

    def restore(self, checkpoint: Checkpoint) -> None:
        """Continues from the state that ``checkpoint`` returned."""
        self._settle()
        self._upload(checkpoint.parameters)
        for name, values in checkpoint.record.items():
            device_array(getattr(self._record, name)).assign(values)
        for correction in self._corrections:
            correction.restore(checkpoint.per_image)
        self.iteration = checkpoint.iteration

    def step(self) -> None:
        """Runs one iteration on the next training image. A GPU is not waited for, except in `_settle`.

        Raises:
            DivergedError: The loss or a parameter is not finite, or no Gaussian is left. On a GPU, some iterations may
                have been launched meanwhile; they change nothing.
        """
        if self._waits:
            self._losses.append((self.iteration + 1, self._checked()))
        else:
            self._launch()
            if len(self._pending) == HISTORY or self._was_stopped:
                self._settle()
        number = self._number_of(self.iteration)
        if self.exposures is not None and self._exposed is not None:
            rate = decayed_rate(self.config.rates.exposures, self.config.rates.exposures_last, self._done)
            self.exposures.update(number, self._exposed.by_exposure(), rate)
        if self.poses is not None and self._refines_poses:
            rate = decayed_rate(self.config.rates.poses, self.config.rates.poses_last, self._done)
            self.poses.update(number, self._backend.by_pose(self._camera_of(number)), rate)
        self.iteration += 1
        if self._changes_count:
            self._densify()

    def take_losses(self) -> list[tuple[int, Loss]]:
        """Returns the losses since the last call, each with the number of iterations completed by then.

        Raises:
            DivergedError: A loss is not finite.
        """
        self._settle()
        taken, self._losses = self._losses, []
        return taken

    # --- Parts of an iteration ---

    def _launch(self) -> None:
        """Uploads what the iteration needs, and launches it; on CUDA it is one recorded graph."""
        number = self._number_of(self.iteration)
        camera = self._camera_of(number)
        target, background = self._load_target(number)
        self._backend.begin(camera, self._degree, background)
        if self._exposed is not None and self.exposures is not None:
            self._exposed.begin(self.exposures.values[number], background)
        surfaces = self._surfaces if self._done >= SURFACES_AFTER else None
        if surfaces is not None:
            surfaces.begin(self._loss.weight_sum)
        rates = self._buffers.table("training.rates", StepRates, [self._rates()])
        parts = len(target.weight) > 0, len(target.alpha) > 0
        work = partial(self._run, camera.image_size, target, rates, surfaces)
        rows = self._backend.replay(f"step {parts}", (surfaces is None, self._refines_poses), work)
        self._history.add(self.iteration, rows)
        self._pending.append(_Pending(self.iteration, camera.image_size, self._loss.weight_sum))

    def _run(
        self, size: tuple[int, int], target: TargetImage, rates: DeviceArray, surfaces: SurfaceLoss | None
    ) -> DeviceArray:
        """Launches all kernels of an iteration, and returns the rows of its loss; see `ImageLoss.rows`."""
        pixels = self._backend.launch()
        exposed = pixels if self._exposed is None else self._exposed.apply(pixels)
        by_pixels = self._loss.differentiate(size, exposed, target)
        if self._exposed is not None:
            by_pixels = self._exposed.backward(pixels, by_pixels)
        checked = (*self._backend.lengths, self._loss.rows, self._record.stopped)
        self._launcher.run(optimizer_kernels.check_step, size[1], 0, *checked)
        by_gaussians = self._backward(pixels, target, by_pixels, surfaces)
        if isinstance(self._backend, TrainingRaster) and self._refines_poses:
            self._backend.sum_pose()
        if isinstance(self._backend, TrainingRaster) and self.config.densification is Densification.ADAPTIVE:
            half = wp.vec2(0.5 * size[0], 0.5 * size[1])
            inputs = (half, self._backend.drawn.splats.rects, self._backend.by_splat, self._record)
            self._launcher.run_banded(optimizer_kernels.add_screen_gradients, self.count, *inputs)
        self._update(by_gaussians, rates)
        return self._loss.rows

    def _update(self, gradient: GaussianGradient, rates: DeviceArray) -> None:
        """Launches the update of the Gaussians; ``rates`` is an array with one `StepRates`."""
        run, stopped = self._launcher.run_banded, self._record.stopped
        data, on = self._backend.data, self._device_splats
        with self._launcher.stage("optimiser"):
            inputs = (rates, stopped, gradient, data, on.values, on.first, on.second)
            run(optimizer_kernels.update, self.count, *inputs)
            if self.config.densification is Densification.MCMC:
                seed = wp.uint32(self.config.seed)
                run(optimizer_kernels.explore, self.count, rates, seed, stopped, data, on.values)

    def _checked(self) -> Loss:
        """Runs the iteration until its lists of Gaussians are long enough, and returns its loss.

        Raises:
            DivergedError: The loss is not finite.
        """
        while True:
            self._launch()
            self._launcher.synchronize()
            loss = self._loss_of(self._pending.pop())
            if np.isfinite(loss.total):
                return loss
            device_array(self._record.stopped).zero_()
            if self._backend.finish():
                raise DivergedError(
                    f"training stopped at iteration {self.iteration + 1:,}: the loss is {loss.total}: check that the "
                    "images hold finite values, or lower TrainConfig.rates"
                )

    def _settle(self) -> None:
        """Waits for all launched iterations, and repeats those that have changed nothing since one was stopped.

        Raises:
            DivergedError: A loss is not finite.
        """
        if not self._pending:
            return
        self._launcher.synchronize()
        while self._pending and np.isfinite((loss := self._loss_of(self._pending[0])).total):
            self._losses.append((self._pending.popleft().iteration + 1, loss))
        if self._pending:
            stopped, self._pending = self._pending, deque()
            before = self.iteration
            device_array(self._record.stopped).zero_()
            for pending in stopped:
                self.iteration = pending.iteration
                self._losses.append((self.iteration + 1, self._checked()))
            self.iteration = before

    def _loss_of(self, pending: _Pending) -> Loss:
        return self._loss.loss_of(self._history[pending.iteration], pending.size, pending.weight_sum)

    @property
    def _was_stopped(self) -> bool:
        """True if an iteration is known to have been stopped by a short list; the GPU is not waited for."""
        return bool(np.isnan(self._history.values[:, 0]).any())

    def _camera_of(self, number: int) -> Camera:
        """Returns the camera of a view in the current iteration."""
        camera = self._views[number].downscaled_camera(self._halvings)
        return camera if self.poses is None else self.poses.posed(number, camera)

    def _load_target(self, number: int) -> tuple[TargetImage, Color]:
        """Loads the image of a view on the device, and returns it with the background behind the Gaussians."""
        if self._kept is None:
            image, background = self._image_of(number)
            return self._loss.load(image.color, image.weight, image.alpha), background
        halvings, kept = self._kept.get(number, (-1, None))
        if kept is None or halvings != self._halvings:
            image, _ = self._image_of(number)
            kept = DeviceImage.of(self._images, str(number), image.color, image.weight, image.alpha)
            self._kept[number] = self._halvings, kept
        return self._loss.load_copy(kept), self._background

    def _image_of(self, number: int) -> tuple[TargetPixels, Color]:
        """Reads the image of a view for the current iteration, and returns it with the background."""
        view = self._views[number]
        image = view.read_downscaled(self._halvings)
        if not self.config.random_background or image.alpha is None:
            return image, self._background
        red, green, blue = np.random.default_rng([self.config.seed, 3, self.iteration]).uniform(size=3).tolist()
        behind = (red, green, blue)
        return image.over(np.subtract(behind, view.background)), behind

    def _number_of(self, iteration: int) -> int:
        """Returns the index of the view that an iteration uses; each epoch visits all views in a new random order."""
        epoch, index = divmod(iteration, len(self._views))
        return view_order(self.config.seed, epoch, len(self._views))[index]

    @property
    def _can_keep_images(self) -> bool:
        """True on a GPU with room for all images; not if their background changes, because the host composites it."""
        pixels = sum(view.camera.width * view.camera.height for view in self._views)
        limit = IMAGES_SHARE * self._launcher.free_memory
        return self._launcher.is_cuda and not self.config.random_background and PIXEL_BYTES * pixels < limit

    @property
    def _corrections(self) -> list[Exposures | Poses]:
        """Optimised exposures and poses of the images: none, one or both, in this order."""
        return [correction for correction in (self.exposures, self.poses) if correction is not None]

    def _backward(
        self, pixels: PixelData, target: TargetImage, gradient: PixelGradient, surfaces: SurfaceLoss | None
    ) -> GaussianGradient:
        """Returns the gradient of the whole loss with respect to the Gaussians.

        ``gradient`` is that of the image loss with respect to the pixels; surface and flatness terms are added to it.
        """
        raster = self._backend
        if not isinstance(raster, TrainingRaster):
            return raster.backward(pixels, gradient)
        if surfaces is not None:
            raster.compare_surfaces(surfaces, pixels, target, gradient)
        record = self._record if self.config.grow_turn > 0.0 else None
        by_gaussians = raster.backward(pixels, gradient, surfaces, record)
        if self.config.flatness > 0.0:
            raster.flatten(self.config.flatness / self.scene_scale.extent, by_gaussians)
        return by_gaussians

    def _surface_loss(self) -> SurfaceLoss | None:
        """Returns the surface terms of the loss; None if all weights are 0 or the backend is not the rasteriser."""
        config = self.config
        weights = {"normals": config.normals, "depth": config.depth_spread, "smooth": config.normal_smoothness}
        if not any(weights.values()) or not isinstance(self._backend, TrainingRaster):
            return None
        scale = {"middle": self.scene_scale.distance, "extent": self.scene_scale.extent}
        return SurfaceLoss(self._launcher, self._buffers, self._backend.channels(), **weights, **scale)

    @property
    def _done(self) -> float:
        """Fraction of the iterations completed, 0..1."""
        return self.iteration / self.config.iterations

    @property
    def _refines_poses(self) -> bool:
        """True if the current iteration updates the pose of its image."""
        return self.poses is not None and self._done >= POSES_AFTER

    @property
    def _degree(self) -> int:
        """SH degree that the current iteration renders, which grows up to ``config.sh_degree`` during training."""
        return min(self.config.sh_degree, 12 * self.iteration // self.config.iterations)

    @property
    def _halvings(self) -> int:
        """Number of times that the sides of the images are halved in the current iteration.

        Sizes grow from the smallest to full size over the first quarter of the iterations.
        """
        coarse = self.config.coarse
        return max(coarse - 4 * coarse * self.iteration // self.config.iterations, 0)

    def _rates(self) -> StepRates:
        config = self.config
        learning, row = config.rates, StepRates()
        row.means = decayed_rate(learning.means, learning.means_last, self._done) * self.scene_scale.extent
        row.rotations, row.log_scales, row.logits = learning.rotations, learning.log_scales, learning.logits
        row.sh, row.sh_rest = learning.sh, SH_REST_SHARE * learning.sh
        row.sh_active = (self._degree + 1) ** 2
        row.first_scale = 1.0 / (1.0 - ADAM_BETA_1 ** (self.iteration + 1))
        row.second_scale = 1.0 / (1.0 - ADAM_BETA_2 ** (self.iteration + 1))
        if config.densification is Densification.MCMC:
            row.by_opacity = config.opacity_decay / self.count
            row.by_scale = config.scale_decay / (3 * self.count)
            row.noise = NOISE_STRENGTH * row.means
        row.iteration = self.iteration
        return row

    # --- Densification ---

    @property
    def _changes_count(self) -> bool:
        total = self.config.iterations
        first = min(DENSIFY_AFTER, max(DENSIFY_EVERY, total // 60))
        last = DENSIFY_UNTIL[self.config.densification.value] * total
        return first < self.iteration < last and self.iteration % DENSIFY_EVERY == 0

    def _densify(self) -> None:
        self._settle()
        motion, turns, frames = (device_array(getattr(self._record, name)).numpy() for name in RECORD)
        frames = np.maximum(frames, 1.0).astype(np.float64)
        record = DensifyStats(self.iteration, self.scene_scale.extent, motion / frames, turns / frames)
        rng = np.random.default_rng([self.config.seed, 2, self.iteration])
        parameters = densified(self._parameters(), record, self.config, rng)
        if parameters.count == 0:
            raise DivergedError(
                f"training stopped at iteration {self.iteration:,}: all Gaussians were pruned as nearly transparent or "
                "larger than a tenth of the camera extent: use densification mcmc"
            )
        self._upload(parameters)

    def _parameters(self) -> TrainedParameters:
        """Downloads the parameters and their moments from the device.

        Raises:
            DivergedError: A parameter is not finite.
        """
        self._settle()
        parameters = self._device_splats.download()
        for name, values in parameters.values.items():
            finite = np.isfinite(values)
            if not finite.all():
                nonfinite = int((~finite.reshape(parameters.count, -1)).any(axis=1).sum())
                raise DivergedError(
                    f"training stopped at iteration {self.iteration:,}: {name} of {nonfinite:,} of "
                    f"{parameters.count:,} Gaussians are not finite: lower TrainConfig.rates"
                )
        return parameters

    def _upload(self, parameters: TrainedParameters) -> None:
        """Uploads parameters with their Adam moments, and zeroes the densification statistics."""
        self._device_splats.upload(parameters)
        self._count = parameters.count
        self._backend.bind(parameters.gaussians(self.config), self._device_splats.values)
        self._record = self._buffers.struct("training.record", SplatRecord, parameters.count, {"stopped"})
        self._record.stopped = self._buffers.get("training.stopped", wp.int32, 1)
        for name in (*RECORD, "stopped"):
            device_array(getattr(self._record, name)).zero_()


@lru_cache(maxsize=1)
def view_order(seed: int, epoch: int, count: int) -> list[int]:
    """Returns the order in which an epoch visits ``count`` views."""
    return np.random.default_rng([seed, 1, epoch]).permutation(count).tolist()


def decayed_rate(first: float, last: float, done: float) -> float:
    """Returns a learning rate that decays exponentially over the training.

    Args:
        first: Learning rate at the first iteration.
        last: Learning rate after the last iteration.
        done: Fraction of the iterations completed, 0..1.
    """
    return first * (last / first) ** done


def backend_type(config: TrainConfig) -> type[TrainingRaster | TrainingRays | TrainingUnscented]:
    """Returns the class of the backend that renders and differentiates the Gaussians."""
    if not config.pipeline.rasterises:
        return TrainingRays
    return TrainingUnscented if config.projection is Projection.UNSCENTED else TrainingRaster


def frame_settings(config: TrainConfig, background: tuple[float, float, float]) -> RenderConfig:
    """Returns the render settings of the frames that are compared with training images."""
    antialiasing = Antialiasing.ON if config.antialiased else Antialiasing.OFF
    return RenderConfig(
        pipeline=config.pipeline,
        background=background,
        raster=RasterConfig(projection=config.projection, sh_degree=config.sh_degree, antialiasing=antialiasing),
        trace=TraceConfig(sh_degree=config.sh_degree, antialiasing=antialiasing),
        lighting=False,
    )
