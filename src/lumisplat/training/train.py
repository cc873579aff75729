"""From a folder of photographs to a capture: ``lumisplat.train``."""

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

# The frame (docs/adr/0086-one-local-origin.md)

TRAINING_EXTENT = 4.4
"""Extent of the cameras in the frame in which Gaussians are learnt, whatever the unit of the scene: cameras four units
around an object, as in NeRF's synthetic sets, for which weights of scales and strengths of noise are chosen."""

_log = logging.getLogger("lumisplat")

CAPTURES = (".ply", ".spz")
CHECKPOINT_EVERY_S = 60.0
"""Seconds between two checkpoints."""
PROGRESS_EVERY_S = 0.5
EVALUATE_AT = (100, 200, 500)
"""Steps after which what is held out is measured, too: whether poses are right shows early."""
EVALUATE_EVERY = 1000
"""Steps between two further points of the curve of what is held out."""


@dataclass(frozen=True, slots=True, eq=False)
class TrainResult:
    """What came of a training."""

    gaussians: Gaussians
    iterations: int
    """Steps that were made, also before this call."""
    is_finished: bool
    """Whether these are all; else it was stopped by its time."""
    score: HeldOutScore | None
    """Of what was held out; None: nothing was."""
    seconds: float
    """Of this call, without the compilation of kernels."""
    exposures: dict[str, Doubles] | None = None
    """How each photograph that was learnt from was exposed, by name, shape (3, 4): what its colours, display-referred,
    were multiplied by, and what was added; their mean is the identity. None: it was not learnt."""
    pruned: int = 0
    """Gaussians that were removed at the end, for they showed too little."""
    cameras: tuple[Camera, ...] | None = None
    """Of the photographs that were learnt from, where they have moved to; None: they stayed."""


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
    """Fits Gaussians to photographs with poses (Kerbl et al. 2023), without a GPU if need be.

    With ``output``, everything that is needed to go on is kept beside it, in a folder of its name with ``.training``: a
    checkpoint each minute, settings, a curve, pictures and figures of what was held out. The same call again goes on
    from the checkpoint: the result has the same bits as if it had never ended. Ctrl C ends a training after its step,
    with a checkpoint; pressed once more, at once.

    Args:
        images: A folder, or what `lumisplat.io.load_training_images` has read; then ``scale``, ``hold_out`` and
            ``background`` are those of it. A folder's lenses stay as they are if ``config.pipeline`` is ``TRACE``,
            or ``config.projection`` is ``UNSCENTED``.
        config: Settings; None: the defaults.
        output: The capture, .ply or .spz; None: it is returned alone.
        scale: As of `lumisplat.io.load_training_images`.
        hold_out: As of `lumisplat.io.load_training_images`.
        background: Behind the Gaussians, and behind what is transparent in photographs.
        stop_after: Seconds of training, without the compilation of kernels, after which it ends before all steps are
            made.
        overwrite: Whether to begin anew where there is a checkpoint.
        preview: Steps between two pictures of the first view that is held out, in the folder; None: none are made.
        device: As of `lumisplat.create_renderer`.
        threads: As of `lumisplat.create_renderer`.
        progress: Called with what is being done and the fraction done, 0..1.

    Raises:
        ConfigError: A setting is out of its range.
        DeviceError: There is no such device, or it is out of memory.
        DivergedError: The loss is no longer finite: the last checkpoint stays.
        FormatError: Photographs cannot be read, a file cannot be written, a checkpoint is of another training, or the
            output is there already and of none.
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
        raise ConfigError(f"output is {output}, which cannot say its kernel degree of {config.kernel_degree}: use .ply")
    if not isinstance(images, TrainingImages):
        straighten = not config.keeps_lenses
        images = load_training_images(
            images, scale=scale, hold_out=hold_out, background=background, straighten=straighten
        )
    folder = None if output is None else RunFolder.of(Path(output))
    if folder is not None and output is not None and Path(output).exists() and not (overwrite or folder.is_begun):
        raise FormatError(
            output, "is there already, and of no training that could go on: overwrite it, or name another"
        )
    run = _Run(images, config, folder, device=device, threads=threads, progress=progress or no_progress)
    run.start(overwrite=overwrite)
    run.run_steps(stop_after, preview)
    return run.finish(None if output is None else Path(output))


class _Run:
    """One call of ``train``."""

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
        """The frame in which Gaussians are learnt."""
        views = [replace(view, camera=self._frame.camera(view.camera)) for view in views]
        cameras = [view.camera for view in views]
        warn_if_few_positions(cameras)
        known = None if images.points is None else self._frame.points(images.points)
        points, colors = with_random_points(known, images.point_colors, cameras, config)
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
        """When the first step of this call began, seconds."""
        self._first = 0

    def start(self, *, overwrite: bool) -> None:
        """Begins anew, or where the last call has ended."""
        if self._folder is None:
            return
        self._folder.prepare(overwrite=overwrite)
        fingerprint = self._fingerprint  # of the photographs as they are now, not after the first minute
        if self._folder.checkpoint.exists():
            checkpoint, self._curve = read_checkpoint(self._folder.checkpoint, self._config, fingerprint)
            check_images(self._folder.checkpoint, checkpoint, self._trainer.checkpoint)
            self._trainer.restore(checkpoint)
        self._folder.write_settings(self._config, self._images.read_from)  # not before: those of another training stay
        self._first = self._trainer.iteration

    def run_steps(self, stop_after: float | None, preview: int | None) -> None:
        """Makes the steps that are left, or those for which there is time."""
        trainer, total = self._trainer, self._config.iterations
        saved = reported = self._begun = time.monotonic()
        with deferred_interrupt() as is_interrupted:
            while trainer.iteration < total and not is_interrupted():
                loss = trainer.step()
                self._curve.add(trainer.iteration, loss)
                now = time.monotonic()
                if now - reported >= PROGRESS_EVERY_S:
                    reported = now
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
        """Writes the capture, and measures it."""
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
        """What has been learnt so far, in the world."""
        return self._frame.gaussians(self._trainer.gaussians())

    def _pruned(self) -> tuple[Gaussians, int]:
        """What has been learnt without what shows too little, and how many these were; all of it, if all does."""
        gaussians, least = self._gaussians(), self._config.prune_below
        if least == 0.0:
            return gaussians, 0
        weights = self._trainer.largest_weights()
        shows = weights >= least
        if not shows.any():
            _log.warning(
                "TrainConfig.prune_below is %g, but the largest weight of any Gaussian is %.2g: nothing is pruned",
                least,
                weights.max(),
            )
            return gaussians, 0
        return gaussians.subset(np.flatnonzero(shows)), int((~shows).sum())

    def _exposures(self) -> dict[str, Doubles] | None:
        """Those that were learnt, by name."""
        if self._trainer.exposures is None:
            return None
        names = (image.name for image in self._images.training)
        return dict(zip(names, self._trainer.exposures.values, strict=True))

    def _cameras(self) -> tuple[Camera, ...] | None:
        """Those of the photographs, if they have moved."""
        if self._trainer.poses is None:
            return None
        return tuple(
            replace(image.camera, camera_from_world=self._frame.world_pose(pose))
            for pose, image in zip(self._trainer.poses.values, self._images.training, strict=True)
        )

    def _save(self) -> None:
        if self._folder is not None:
            state = self._trainer.checkpoint
            write_checkpoint(self._folder.checkpoint, state, self._curve, self._config, self._fingerprint)
            self._folder.write_curve(self._curve)

    def _progress_text(self, now: float) -> str:
        rate = (self._trainer.iteration - self._first) / max(now - self._begun, 1e-3)
        return f"training, {self._curve.psnr:.1f} dB, {self._trainer.count:,} Gaussians, {rate:.1f} steps a second"

    @cached_property
    def _fingerprint(self) -> str:
        """What tells these photographs, their bytes, lenses, poses, masks and points from others."""
        return self._images.fingerprint


def training_frame(images: TrainingImages) -> LocalFrame:
    """Returns the frame in which Gaussians are learnt: about the cameras, in a unit in which all sets are alike.

    What comes of a training does not depend on the unit of a scene, nor on where its zero is.
    """
    return LocalFrame.of_cameras([image.camera for image in images.training], TRAINING_EXTENT)


def _oriented(gaussians: Gaussians, cameras: Sequence[Camera]) -> Gaussians:
    """Returns a capture that states up and first view, from the cameras of its images, world space."""
    origin, to_origin = np.array(gaussians.origin), np.eye(4)
    view = first_view_of(cameras, gaussians.means + origin)
    stated = replace(gaussians, up=up_of_cameras(cameras), first_view=view)
    to_origin[:3, 3] = -origin
    return replace(stated, **moved_orientation(stated, to_origin))


def is_evaluated(step: int) -> bool:
    """Whether what is held out is measured after a step that is not the last."""
    return step in EVALUATE_AT or step % EVALUATE_EVERY == 0
