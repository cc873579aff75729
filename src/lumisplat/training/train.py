"""Implements ``lumisplat.train``: trains a capture from a folder of images with known poses."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from lumisplat.config import TrainConfig
from lumisplat.config.checks import check_kind, check_positive, check_whole
from lumisplat.constants import KERNEL_DEGREE
from lumisplat.errors import ConfigError, FormatError
from lumisplat.io import save
from lumisplat.io.training_images.loading import TrainingImages, load_training_images
from lumisplat.math.arrays import Doubles
from lumisplat.progress import Progress, no_progress
from lumisplat.runtime.interrupts import deferred_interrupt
from lumisplat.scene.camera import Camera
from lumisplat.scene.gaussians import Gaussians, moved_orientation
from lumisplat.scene.local_frame import LocalFrame
from lumisplat.scene.ops.views import first_view_of, up_of_cameras
from lumisplat.training.parameters import warn_if_few_positions, with_random_points
from lumisplat.training.run_folder import (
    Curve,
    HeldOut,
    HeldOutScore,
    RunFolder,
    check_images,
    read_checkpoint,
    write_checkpoint,
)
from lumisplat.training.trainer import Trainer
from lumisplat.training.views import TrainingView

# Local frame of training: docs/adr/0086-one-local-origin.md

TRAINING_EXTENT = 4.4
"""Camera extent of every scene in the local frame in which Gaussians are trained, whatever the scene's unit.

NeRF's synthetic scenes have cameras four units from an object; the weights of scale regularisation and the noise
strengths were chosen for that size."""

_log = logging.getLogger("lumisplat")

CAPTURES = (".ply", ".spz")
CHECKPOINT_EVERY_S = 60.0
"""Seconds between two checkpoints."""
PROGRESS_EVERY_S = 0.5
EVALUATE_AT = (100, 200, 500)
"""Early iterations after which the held-out images are evaluated, because wrong poses show early."""
EVALUATE_EVERY = 1000
"""Iterations between two evaluations of the held-out images, after the early ones in `EVALUATE_AT`."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainResult:
    """Trained capture, its held-out score, and the optimised exposures and cameras."""

    gaussians: Gaussians
    iterations: int
    """Number of iterations completed, including those of earlier calls that this call resumed."""
    is_finished: bool
    """True if all iterations were run; False if ``stop_after`` ended the training early."""
    score: HeldOutScore | None
    """PSNR on the held-out images; None if none were held out."""
    seconds: float
    """Duration of this call in seconds, without kernel compilation."""
    exposures: dict[str, Doubles] | None = None
    """Exposure of each training image by name, shape (3, 4); None if exposures were not optimised.

    The first three columns are a matrix that multiplies the display-referred colour; the last column is added. The mean
    over the images is the identity."""
    pruned: int = 0
    """Number of Gaussians removed at the end because their largest blending weight was below ``prune_below``."""
    cameras: tuple[Camera, ...] | None = None
    """Refined cameras of the training images; None if poses were not refined."""


def train(
    images: TrainingImages | str | os.PathLike[str],
    config: TrainConfig | None = None,
    *,
    output: str | os.PathLike[str] | None = None,
    scale: float = 1.0,
    hold_out: int = 8,
    background: str | tuple[float, float, float] = "black",
    stop_after: float | None = None,
    overwrite: bool = False,
    preview: int | None = None,
    device: str = "auto",
    threads: int | None = None,
    progress: Progress | None = None,
) -> TrainResult:
    """Trains 3D Gaussians from images with known poses (Kerbl et al. 2023), on a GPU or a CPU.

    With ``output``, the folder ``NAME.training`` beside the capture holds a checkpoint written once a minute, the
    settings, the PSNR curve, and images and scores of the held-out views. Repeating the same call resumes from the
    checkpoint, and the result has the same bits as an uninterrupted run. Ctrl C stops after the current iteration and
    writes a checkpoint; a second Ctrl C stops at once.

    Args:
        images: Folder of images, or the result of `lumisplat.io.load_training_images`. A loaded result already fixes
            ``scale``, ``hold_out`` and ``background``. Lens distortion of a folder's images is kept if
            ``config.pipeline`` is ``TRACE`` or ``config.projection`` is ``UNSCENTED``, and removed otherwise.
        config: Training settings; None for the defaults.
        output: Capture to write, .ply or .spz; None to return the result without writing files.
        scale: As in `lumisplat.io.load_training_images`.
        hold_out: As in `lumisplat.io.load_training_images`.
        background: Colour behind the Gaussians and behind transparent pixels of the images.
        stop_after: Time limit in seconds, without kernel compilation; None for no limit.
        overwrite: If True, discards an existing checkpoint and starts again.
        preview: Iterations between two preview images of the first held-out view in the training folder; None for no
            previews.
        device: As in `lumisplat.create_renderer`.
        threads: As in `lumisplat.create_renderer`.
        progress: Called with a description of the current work and the fraction done, 0..1.

    Returns:
        The trained capture with its held-out score.

    Raises:
        ConfigError: A setting is out of its range.
        DeviceError: The device does not exist or is out of memory.
        DivergedError: The loss is no longer finite; the last checkpoint is kept.
        FormatError: An image cannot be read, a file cannot be written, the checkpoint belongs to another training, or
            ``output`` exists and has no training to resume.
    """
    config = config or TrainConfig()
    check_kind("config", config, TrainConfig)
    if stop_after is not None:
        check_positive("stop_after", stop_after)
    if preview is not None:
        check_whole("preview", preview, 1, config.iterations)
    if output is not None and Path(output).suffix.lower() not in CAPTURES:
        raise ConfigError(f"output is {output}, expected a file that ends in {' or '.join(CAPTURES)}")
    if output is not None and Path(output).suffix.lower() == ".spz" and config.kernel_degree != KERNEL_DEGREE:
        raise ConfigError(f"output is {output}, but .spz cannot store kernel degree {config.kernel_degree}: use .ply")
    if not isinstance(images, TrainingImages):
        straighten = not config.keeps_lenses
        images = load_training_images(
            images, scale=scale, hold_out=hold_out, background=background, straighten=straighten
        )
    folder = None if output is None else RunFolder.of(Path(output))
    if folder is not None and output is not None and Path(output).exists() and not (overwrite or folder.is_begun):
        raise FormatError(
            output,
            "exists and has no training to resume: overwrite it (--overwrite, overwrite=True) or choose another output",
        )
    run = _Run(images, config, folder, device=device, threads=threads, progress=progress or no_progress)
    run.start(overwrite=overwrite)
    run.run_steps(stop_after, preview)
    return run.finish(None if output is None else Path(output))


class _Run:
    """One call of `train`: the trainer, the training folder, the PSNR curve and the held-out images."""

    def __init__(
        self,
        images: TrainingImages,
        config: TrainConfig,
        folder: RunFolder | None,
        *,
        device: str,
        threads: int | None,
        progress: Progress,
    ) -> None:
        self._images, self._config, self._folder, self._progress = images, config, folder, progress
        views = [TrainingView.of(image) for image in images.training]
        self._frame = training_frame(images)
        """Local frame in which the Gaussians are trained."""
        views = [replace(view, camera=self._frame.camera(view.camera)) for view in views]
        cameras = [view.camera for view in views]
        warn_if_few_positions(cameras)
        local_points = None if images.points is None else self._frame.points(images.points)
        points, colors = with_random_points(local_points, images.point_colors, cameras, config)
        self._trainer = Trainer(
            views,
            config,
            background=images.training[0].background or (0.0, 0.0, 0.0),
            points=points,
            colors=colors,
            device=device,
            threads=threads,
            progress=progress,
        )
        self._held_out = HeldOut(images.held_out, device, threads, config)
        self._curve = Curve()
        self._begun = 0.0
        """Time at which the first iteration of this call began, seconds."""
        self._first = 0

    def start(self, *, overwrite: bool) -> None:
        """Prepares the training folder and resumes from its checkpoint, if there is one."""
        if self._folder is None:
            return
        self._folder.prepare(overwrite=overwrite)
        fingerprint = self._fingerprint  # hashed now, before an image can change
        if self._folder.checkpoint.exists():
            checkpoint, self._curve = read_checkpoint(self._folder.checkpoint, self._config, fingerprint)
            check_images(self._folder.checkpoint, checkpoint, self._trainer.checkpoint)
            self._trainer.restore(checkpoint)
        self._folder.write_settings(self._config, self._images.read_from)  # only after the checkpoint is accepted
        self._first = self._trainer.iteration

    def run_steps(self, stop_after: float | None, preview: int | None) -> None:
        """Runs the remaining iterations, or as many as fit into the time limit."""
        trainer, total = self._trainer, self._config.iterations
        saved = reported = self._begun = time.monotonic()
        with deferred_interrupt() as is_interrupted:
            while trainer.iteration < total and not is_interrupted():
                trainer.step()
                now = time.monotonic()
                if now - reported >= PROGRESS_EVERY_S:
                    reported = now
                    self._add_losses()
                    self._progress(self._progress_text(now), trainer.iteration / total)
                if is_evaluated(trainer.iteration) and trainer.iteration < total:
                    self._curve.measure(trainer.iteration, self._held_out.psnr(self._gaussians()))
                if preview is not None and self._folder is not None and trainer.iteration % preview == 0:
                    self._held_out.preview(self._gaussians(), self._folder.preview(trainer.iteration))
                if now - saved >= CHECKPOINT_EVERY_S:
                    saved = now
                    self._save()
                if stop_after is not None and now - self._begun >= stop_after:
                    break
            self._progress("training", 1.0)
            self._save()
        if is_interrupted():
            raise KeyboardInterrupt

    def finish(self, output: Path | None) -> TrainResult:
        """Prunes Gaussians, evaluates the held-out images, writes capture and report, and returns the result."""
        trained, pruned = self._pruned()
        exposures, cameras = self._exposures(), self._cameras()
        gaussians = _oriented(trained, cameras or tuple(image.camera for image in self._images.training))
        score = self._held_out.score(gaussians, self._progress)
        if score is not None:
            self._curve.measure(self._trainer.iteration, score.psnr)
        if output is not None and self._folder is not None:
            save(output, gaussians)
            self._folder.write_report(self._curve, score, self._held_out, gaussians)
            if exposures is not None:
                self._folder.write_exposures(exposures)
            if cameras is not None:
                self._folder.write_poses(cameras)
        done = self._trainer.iteration
        seconds = time.monotonic() - self._begun
        return TrainResult(gaussians, done, done == self._config.iterations, score, seconds, exposures, pruned, cameras)

    def _gaussians(self) -> Gaussians:
        """Returns the current Gaussians in world space."""
        return self._frame.gaussians(self._trainer.gaussians())

    def _pruned(self) -> tuple[Gaussians, int]:
        """Returns the Gaussians whose largest blending weight is at least ``prune_below``, and the number removed.

        If all Gaussians are below, none is removed and a warning is logged.
        """
        gaussians, least = self._gaussians(), self._config.prune_below
        if least == 0.0:
            return gaussians, 0
        weights = self._trainer.largest_weights()
        shows = weights >= least
        if not shows.any():
            _log.warning(
                "TrainConfig.prune_below is %g, but the largest blending weight of any Gaussian is %.2g: "
                "no Gaussian is pruned",
                least,
                weights.max(),
            )
            return gaussians, 0
        return gaussians.subset(np.flatnonzero(shows)), int((~shows).sum())

    def _exposures(self) -> dict[str, Doubles] | None:
        """Returns the optimised exposures by image name; None if they were not optimised."""
        if self._trainer.exposures is None:
            return None
        names = (image.name for image in self._images.training)
        return dict(zip(names, self._trainer.exposures.values, strict=True))

    def _cameras(self) -> tuple[Camera, ...] | None:
        """Returns the refined cameras of the training images in world space; None if poses were not refined."""
        if self._trainer.poses is None:
            return None
        return tuple(
            replace(image.camera, camera_from_world=self._frame.world_pose(pose))
            for pose, image in zip(self._trainer.poses.values, self._images.training, strict=True)
        )

    def _add_losses(self) -> None:
        """Adds the losses of all iterations so far to the curve; a GPU is waited for."""
        for step, loss in self._trainer.take_losses():
            self._curve.add(step, loss)

    def _save(self) -> None:
        self._add_losses()
        if self._folder is not None:
            state = self._trainer.checkpoint
            write_checkpoint(self._folder.checkpoint, state, self._curve, self._config, self._fingerprint)
            self._folder.write_curve(self._curve)

    def _progress_text(self, now: float) -> str:
        rate = (self._trainer.iteration - self._first) / max(now - self._begun, 1e-3)
        return f"training, {self._curve.psnr:.1f} dB, {self._trainer.count:,} Gaussians, {rate:.1f} iterations/s"

    @cached_property
    def _fingerprint(self) -> str:
        """Hash of the training images: their bytes, lenses, poses, masks and points."""
        return self._images.fingerprint


def training_frame(images: TrainingImages) -> LocalFrame:
    """Returns the local frame of training: centred on the cameras, and scaled to a camera extent of `TRAINING_EXTENT`.

    In this frame, the result of a training depends neither on the scene's unit nor on its origin.
    """
    return LocalFrame.of_cameras([image.camera for image in images.training], TRAINING_EXTENT)


def _oriented(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Returns the capture with an up direction and a first view, derived from the training cameras in world space."""
    origin, to_origin = np.array(gaussians.origin), np.eye(4)
    view = first_view_of(cameras, gaussians.means + origin)
    oriented = replace(gaussians, up=up_of_cameras(cameras), first_view=view)
    to_origin[:3, 3] = -origin
    return replace(oriented, **moved_orientation(oriented, to_origin))


def is_evaluated(step: int) -> bool:
    """Returns whether the held-out images are evaluated after iteration ``step``, which is not the last one."""
    return step in EVALUATE_AT or step % EVALUATE_EVERY == 0
